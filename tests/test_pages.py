"""The code of each page of `docs/` runs, in a fresh process as a notebook of one page."""

import os
import pathlib
import re
import subprocess
import sys

import pytest

DOCS = pathlib.Path(__file__).resolve().parent.parent / "docs"
CODE = {
    page.name: re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    for page in sorted(DOCS.glob("*.md"))
}


# Pages that trace thousands of lenses: faster machine code pays.
MANY = ("tolerances.md",)


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page, blocks in CODE.items() if blocks])
def test_code_runs(tmp_path, page):
    given = os.environ["XLA_FLAGS"]
    given = given.replace("level=0", "level=1") if page in MANY else given
    flags = {"XLA_FLAGS": given, "JAX_PLATFORMS": "cpu"}
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", "\n".join(CODE[page])],
        cwd=tmp_path,
        env=os.environ | flags,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr


def test_pages_have_code():
    assert any(CODE.values())
