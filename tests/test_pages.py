"""The code of each page of `docs/` runs, each page in a fresh process as one notebook."""

import importlib.util
import os
import pathlib
import re
import subprocess
import sys

import pytest

DOCS = pathlib.Path(__file__).resolve().parent.parent / "docs"
# Packages that the package and its tests do not install: without them, blocks that start with them
# are left out.
EXTRA = ("flax",)


def blocks(page):
    """The blocks of code of a page that can run here."""
    found = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    absent = tuple(f"from {name} " for name in EXTRA if not importlib.util.find_spec(name))
    return [block for block in found if not block.startswith(absent)]


CODE = {page.name: blocks(page) for page in sorted(DOCS.glob("*.md"))}
X64 = 'jax.config.update("jax_enable_x64", True)'


# Pages that trace thousands of lenses, for which faster machine code saves time.
MANY = ("tolerances.md",)


def said_by(folder, page, code, *warnings):
    """The text on stderr of a fresh process that ends with an error; None if it succeeds."""
    given = os.environ["XLA_FLAGS"]
    given = given.replace("level=0", "level=1") if page in MANY else given
    flags = {"XLA_FLAGS": given, "JAX_PLATFORMS": "cpu"}
    ran = subprocess.run(
        [sys.executable, "-W", "error", *warnings, "-c", code],
        cwd=folder,
        env=os.environ | flags,
        capture_output=True,
        text=True,
    )
    return ran.stderr if ran.returncode else None


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page, blocks in CODE.items() if blocks])
def test_code_runs(tmp_path, page):
    assert said_by(tmp_path, page, "\n".join(CODE[page])) is None


@pytest.mark.slow
def test_your_own_loop_runs_in_float32(tmp_path):
    code = "\n".join(CODE["your_own_loop.md"])
    assert code.count(X64) == 1
    # The library warns of the limits of float32, which the page also mentions.
    code = code.replace(X64, "")
    assert said_by(tmp_path, "your_own_loop.md", code, "-W", "ignore:in float32") is None


def test_pages_have_code():
    assert any(CODE.values())
