"""The README's notebook lines run, and the files that it and the pages of `docs/` name exist."""

import pathlib
import re

import jax
import pytest
import yaml

from drt_jax import load_lens

ROOT = pathlib.Path(__file__).resolve().parent.parent
TEXT = (ROOT / "README.md").read_text()
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))


@pytest.mark.slow
def test_notebook_lines_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert blocks
    names: dict = {}  # one notebook
    with jax.numpy_rank_promotion("allow"):  # a notebook has JAX's own settings
        for block in blocks:
            exec(compile(block, "README.md", "exec"), names)
    assert names["gradient"].curvature.shape == (7,)  # the sensor is the last row
    assert names["metrics"]["loss"] < 0.1  # sharp images, evenly bright
    for picture in ("psf.png", "restored.png"):
        assert (tmp_path / picture).stat().st_size > 5000


def test_readme_is_short():
    assert len(TEXT.splitlines()) <= 200


def test_lens_of_your_own_loads(tmp_path):
    page = (ROOT / "docs" / "lenses.md").read_text()
    lens, elements = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    (tmp_path / "my_lens.yaml").write_text(lens)
    assert load_lens(tmp_path / "my_lens.yaml").stop == 2
    planes = [{"radius": float("inf"), "thickness": 9.0} for _ in range(7)]
    planes[0] |= {"stop": True, "semi_diameter": 1.0}
    folded = load_lens({"surfaces": planes} | yaml.safe_load(elements))
    assert folded.elements.spans == ((2, 4), (6, 7)) and folded.elements.about == (2, 5)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_experiments_exist(page):
    for name in re.findall(r"experiments\.([a-z]\w*)", page.read_text()):
        assert name == "tables" or (ROOT / "configs" / f"{name}.yaml").exists(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_exist(page):
    for target in re.findall(r"\]\(([^)#:]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target
