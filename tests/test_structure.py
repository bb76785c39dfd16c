"""Data flows one way: a module imports only from those above it."""

import ast
import pathlib

import pytest

import drt_jax

ROOT = pathlib.Path(drt_jax.__file__).parent
# From what knows least to what knows most.
ORDER = (
    "numerics",
    "surface",
    "glass",
    "lens",
    "prescription",
    "paraxial",
    "pupil",
    "fermat",
    "sequential",
    "aiming",
    "search",
    "implicit",
    "snell",
    "trace",
    "wavefront",
    "vignetting",
    "moments",
    "depth",
    "psf",
    "sensor",
    "convolution",
    "network",
    "adam",
    "data",
    "config",
    "runs",
    "train",
    "drawing",
    "plot",
)
NO_OPTICS = ("convolution", "network", "adam", "data", "config", "runs", "plot")
OPTICS = ORDER[: ORDER.index("sensor") + 1]
ONLY = {"optimistix": "implicit", "matplotlib": "plot", "skimage": ("data", "train")}


def imports(name):
    """Modules of the package and outside packages that a module imports."""
    inside, outside = set(), set()
    for node in ast.walk(ast.parse((ROOT / f"{name}.py").read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            inside |= {node.module} if node.module else {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            outside.add(node.module.split(".")[0])
        elif isinstance(node, ast.Import):
            outside |= {alias.name.split(".")[0] for alias in node.names}
    return inside, outside


def test_every_module_has_its_place():
    assert {path.stem for path in ROOT.glob("*.py")} - {"__init__"} == set(ORDER)


@pytest.mark.parametrize("name", ORDER)
def test_imports_point_upwards(name):
    inside, outside = imports(name)
    assert inside <= set(ORDER[: ORDER.index(name)])
    if name in NO_OPTICS:
        assert not inside & set(OPTICS)
    for package, allowed in ONLY.items():
        assert package not in outside or name in allowed
    text = (ROOT / f"{name}.py").read_text()
    assert "config.update" not in text, "the library changes no global setting"
    assert "print(" not in text, "the library is silent"
