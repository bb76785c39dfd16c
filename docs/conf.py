"""Settings of the site: `make site` builds it into docs/_build/html."""

import pathlib
import sys
import tomllib

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]
import _api  # noqa: E402

from tests.flags import set_flags  # noqa: E402

set_flags()  # for the notebooks

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

project, version = PROJECT["name"], PROJECT["version"]
author = copyright = "the drt_jax authors"
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.viewcode"]
exclude_patterns = ["_build"]

html_theme = "sphinx_book_theme"
html_title = f"drt_jax {version}"
html_theme_options = {"show_toc_level": 2, "home_page_in_toc": True}
html_copy_source = False

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3

# Notebooks are text; each asserts its headline number, and one that raises fails the build.
nb_execution_mode = "force"
nb_execution_timeout = 900  # s a cell; a busy machine compiles slowly
nb_execution_raise_on_error = True
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
default_role = "code"  # what docstrings put in single backquotes


def setup(app):
    """Write the API pages before the build, and read our form of docstrings."""
    _api.write(HERE / "api")
    app.connect("autodoc-process-docstring", _api.with_fields)
