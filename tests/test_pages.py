"""The code of each page of `docs/` runs, in a fresh process as a notebook of one page."""

import importlib.util
import os
import pathlib
import re
import subprocess
import sys

import pytest

DOCS = pathlib.Path(__file__).resolve().parent.parent / "docs"
# What the package and its tests do not install: blocks that begin with it are left out without it.
EXTRA = ("flax",)


def blocks(page):
    """The blocks of code of a page that can run here."""
    found = re.findall(r"```python\n(.*?)```", page.read_text(), re.DOTALL)
    absent = tuple(f"from {name} " for name in EXTRA if not importlib.util.find_spec(name))
    return [block for block in found if not block.startswith(absent)]


CODE = {page.name: blocks(page) for page in sorted(DOCS.glob("*.md"))}
X64 = 'jax.config.update("jax_enable_x64", True)'


# Pages that trace thousands of lenses: faster machine code pays.
MANY = ("tolerances.md",)


def said_by(folder, page, code, *warnings):
    """What a fresh process writes to stderr that ends with an error; None if it ends well."""
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
    # The library says what float32 cannot do, which is no more than the page does.
    code = code.replace(X64, "")
    assert said_by(tmp_path, "your_own_loop.md", code, "-W", "ignore:in float32") is None


def test_pages_have_code():
    assert any(CODE.values())
