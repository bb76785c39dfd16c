"""Structure of the package: imports go one way, each external package has its place, no file and no
room is too large."""

import ast
import graphlib
import pathlib
import re
import subprocess
import sys
import tomllib

import pytest

import drt_jax

PACKAGE = pathlib.Path(drt_jax.__file__).parent
ROOT = PACKAGE.parent
# Floors in order: each imports only from those above it. A floor is a folder, or a module next to
# the folders.
FLOORS = (
    "inputs",
    "numerics",
    "compilation",
    "devices",
    "lens",
    "rays",
    "pupil",
    "image",
    "results",
    "design",
    "learn",
    "files",
    "show",
    "check",
    "__main__",
)
# Floors without rays and, except `files`, without formulas of optics: all that they may import of
# the package.
ALLOWED = {
    "learn": {"inputs", "numerics", "compilation", "devices"}
    | {f"image.{name}" for name in ("kernel", "sensor", "spot", "wiener")},
    "files": {"inputs", "numerics", "lens"},
    "show": set(),
}
# Drawings of rays; and the namespace of `learn`.
_ANALYSES = "aberrations", "analyses", "command", "configurations", "glasses", "layout", "more"
_DRAWN = (*_ANALYSES, "prescription", "sheet", "tolerances")
ALLOWED_ALL = {"learn.__init__", *(f"show.{name}" for name in _DRAWN)}
# Most lines of code of each room; no blank, comment, docstring or import is counted. They
# fall, and rise only by a new capability, whose commit says by how much: text is free, code is not.
ROOMS = {
    "drt_jax": 375,
    "drt_jax/check": 329,
    "drt_jax/design": 3179,
    "drt_jax/files": 3114,
    "drt_jax/image": 3012,
    "drt_jax/learn": 655,
    "drt_jax/lens": 1850,
    "drt_jax/pupil": 774,
    "drt_jax/rays": 1320,
    "drt_jax/show": 1463,
    "experiments": 499,
    "experiments/designing": 921,
    "experiments/imaging": 453,
    "experiments/paper": 599,
    "experiments/runs": 447,
    "experiments/speed": 1369,
    "experiments/together": 704,
    "experiments/trust": 1964,
}
PUBLIC = 60
# External packages that only some modules or floors may import.
ONLY = {
    "optimistix": {"rays.aim", "rays.find", "image.field"},
    "matplotlib": {"show"},
    "skimage": {"learn.data", "learn.train"},
    "PIL": {"learn.images"},
    "yaml": {"inputs", "files"},
    "tqdm": set(),
    "experiments": set(),
    "tests": set(),
}
# Packages that are installed under another name.
NAMED = {"skimage": "scikit-image", "PIL": "pillow", "yaml": "pyyaml"}
MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path != PACKAGE / "__init__.py"
}
OURS = [*PACKAGE.rglob("*.py"), *(ROOT / "experiments").rglob("*.py")]


def imports(path):
    """Modules of the package, and outside packages, that a file imports."""
    inside, outside = set(), set()
    here = path.relative_to(PACKAGE).parent.parts
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            base = [*here[: len(here) - node.level + 1], *(node.module or "").split(".")]
            name = ".".join(filter(None, base))
            inside |= {name} if name in MODULES else {f"{name}.{a.name}" for a in node.names}
        elif isinstance(node, ast.ImportFrom):
            outside.add(node.module.split(".")[0])
        elif isinstance(node, ast.Import):
            outside |= {alias.name.split(".")[0] for alias in node.names}
    return inside, outside


def floor(name):
    return name.split(".")[0]


@pytest.mark.parametrize("name", MODULES)
def test_imports_point_upwards(name):
    assert floor(name) in FLOORS
    inside, outside = imports(MODULES[name])
    above = FLOORS[: FLOORS.index(floor(name)) + 1]
    assert {floor(other) for other in inside} <= set(above)
    if floor(name) in ALLOWED and name not in ALLOWED_ALL:
        allowed = ALLOWED[floor(name)] | {floor(name)}
        assert all({other, floor(other)} & allowed for other in inside)
    for package in outside & set(ONLY):
        assert {name, floor(name)} & ONLY[package], f"{package} belongs to {ONLY[package]}"
    assert "drt_jax" not in outside, "inside the package, imports are relative"


def test_no_module_imports_itself_by_a_detour():
    order = graphlib.TopologicalSorter({n: imports(path)[0] for n, path in MODULES.items()})
    place = {name: k for k, name in enumerate(order.static_order())}  # CycleError for a detour
    assert set(MODULES) <= set(place)
    assert place["numerics"] < place["rays.solve"] < place["image.moments"] < place["image.depth"]


@pytest.mark.parametrize("name", [name for name in MODULES if name != "__main__"])
def test_the_library_is_silent_and_changes_no_global_setting(name):
    tree = ast.parse(MODULES[name].read_text())
    # Modules that a user imports by name.
    tree.body = [n for n in tree.body if getattr(n, "name", "") != "keep_programs"]
    calls = [node.func for node in ast.walk(tree) if type(node) is ast.Call]
    for call in map(ast.unparse, calls):
        assert call != "print" and not call.endswith("config.update")


def test_what_is_imported_is_declared():
    """The packages of pyproject.toml are those that the package imports, and one for
    experiments."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = {re.split("[<>=]", line)[0] for line in project["dependencies"]}
    outside = set().union(*(imports(path)[1] for path in MODULES.values()))
    named = {NAMED.get(name, name) for name in outside - sys.stdlib_module_names}
    assert named == declared - {"tqdm"}


def test_importing_the_package_draws_nothing_in():
    code = "import sys, drt_jax; print(*sorted({n.split('.')[0] for n in sys.modules}))"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert not {"matplotlib", "skimage", "experiments"} & set(loaded.stdout.split())


def code(path):
    """Numbers of the lines of a file that are code: without blank lines, comments, docstrings and
    imports."""
    text = path.read_text()
    free = {k for k, line in enumerate(text.splitlines(), 1) if not line.split("#")[0].strip()}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            free |= set(range(node.lineno, node.end_lineno + 1))
        documented = isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
        if documented and ast.get_docstring(node) is not None:
            free |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
    return set(range(1, len(text.splitlines()) + 1)) - free


@pytest.mark.parametrize("path", OURS, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_grows_too_large(path):
    lines = code(path)
    assert len(lines) <= 300
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            own = lines & set(range(node.lineno, node.end_lineno + 1))
            assert len(own) < 60, node.name


@pytest.mark.parametrize("room", ROOMS)
def test_the_house_is_small(room):
    assert sum(len(code(path)) for path in (ROOT / room).glob("*.py")) <= ROOMS[room]


def test_every_room_has_its_limit():
    rooms = {str(path.parent.relative_to(ROOT)) for path in OURS if code(path)}
    assert rooms <= ROOMS.keys() | {"drt_jax/lens/catalogue"}


def test_public_names_are_few():
    tree = ast.parse((PACKAGE / "__init__.py").read_text())
    names = [
        a.asname or a.name for n in tree.body if isinstance(n, ast.ImportFrom) for a in n.names
    ]
    assert len(names) == len({*names}) <= PUBLIC
