"""Tries drt_jax with other releases of Python and of what it needs.

    python .ci/versions.py [3.12-newest 3.11-oldest ...] [--write]

Each gets an environment, `.venv-py3.12-newest`, kept for the next time, and runs README's examples
and a cross-section of the tests there. "newest" is what pip installs; "oldest" is what the lower
bounds of pyproject.toml name or, where that has no wheel for this Python, the next that has. What
has no interpreter is skipped, and the end says so. --write puts the outcome into docs/versions.md.
"""

import contextlib
import os
import pathlib
import re
import subprocess
import sys
import time
import tomllib

ROOT = pathlib.Path(__file__).resolve().parent.parent
# The newest on 3.11 is what the other tests run with.
WAYS = ("3.11-oldest", "3.12-newest", "3.13-newest")
PROGRAMS = ("Python", "JAX", "NumPy", "optimistix")
TESTS = (
    "tests/test_readme.py",
    "tests/test_compilation.py",
    "tests/test_numerics.py",
    "tests/files/test_specs.py",
    "tests/files/test_write.py",
    "tests/rays/test_solve.py::test_forward_is_the_transpose_of_reverse",
    "tests/image/test_kernel.py",
    "tests/image/test_moments.py::test_an_eager_gradient_is_that_of_a_program_and_of_differences",
    "tests/image/test_moments.py::test_inside_a_trace_the_rule_must_be_given",
    "tests/design/test_optimum.py::test_bounded_minima_are_those_of_scipy",
    "tests/design/test_optimum.py::test_singlet_reaches_the_known_optimum_in_twenty_jacobians",
    "tests/learn/test_train.py::test_training_moves_the_sensor_to_focus_and_compiles_once",
    "tests/learn/test_images.py",
    "tests/experiments/runs",
    "tests/test_devices.py::test_a_mesh_of_one_shares_all",
)


def interpreter(version: str) -> str | None:
    """A Python of this version that starts, by its name or from pyenv."""
    pyenv = pathlib.Path(os.environ.get("PYENV_ROOT", "~/.pyenv")).expanduser()
    name = f"python{version}"
    for found in (name, *sorted(pyenv.glob(f"versions/{version}.*/bin/{name}"))):
        # A shim of pyenv may be there and fail.
        with contextlib.suppress(OSError, subprocess.CalledProcessError):
            subprocess.run([found, "-c", "import ssl"], capture_output=True, check=True)
            return str(found)
    return None


def oldest(python: pathlib.Path) -> list[str]:
    """Constraints NAME==VERSION: of each dependency the oldest release that is allowed and has a
    wheel."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    pip = [python, "-m", "pip", "--disable-pip-version-check"]
    found = []
    for name, bound in (line.split(">=") for line in project["dependencies"]):
        said = subprocess.run(
            [*pip, "index", "versions", name], capture_output=True, text=True, check=True
        )
        listed = re.search("Available versions: (.*)", said.stdout)[1].split(", ")
        plain = [v for v in listed if re.fullmatch(r"[\d.]+", v)]
        for version in sorted((v for v in plain if key(v) >= key(bound)), key=key):
            wheel = [*pip, "install", "--dry-run", "--no-deps", "--ignore-installed", "-q"]
            wheel += ["--only-binary", ":all:", f"{name}=={version}"]
            if not subprocess.run(wheel, capture_output=True).returncode:
                found.append(f"{name}=={version}")
                break
        else:
            sys.exit(f"{name}: no release from {bound} on has a wheel")
        if key(version) != key(bound):
            print(f"  {name}: {version} instead of {bound}")
    jax = next(line for line in found if line.startswith("jax=="))
    return [*found, jax.replace("jax", "jaxlib")]


def key(version: str) -> list[int]:
    """To sort by."""
    numbers = [int(part) for part in version.split(".")]
    return numbers + [0] * (4 - len(numbers))


def environment(way: str, interpreter: str) -> pathlib.Path:
    """The Python of an environment, made unless it is there and fits pyproject.toml."""
    folder = ROOT / f".venv-py{way}"
    python, made_for = folder / "bin" / "python", folder / "made-for"
    wanted = (ROOT / "pyproject.toml").read_text()
    if made_for.is_file() and made_for.read_text() == wanted:
        return python
    subprocess.run([interpreter, "-m", "venv", "--clear", folder], check=True)
    constraints = folder / "constraints.txt"
    constraints.write_text("\n".join(oldest(python)) if way.endswith("oldest") else "")
    install = [python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*install, "-c", constraints, "-e", f"{ROOT}[test]"], check=True, cwd=ROOT)
    made_for.write_text(wanted)
    return python


def tried(way: str) -> str:
    """What came of a way."""
    version = way.split("-")[0]
    if not (base := interpreter(version)):
        return f"skipped: no Python {version}"
    python = environment(way, base)
    # Programs may be shared: that of another release is another program.
    cache = os.environ.get("JAX_COMPILATION_CACHE_DIR", str(python.parent.parent / "compiled"))
    names = (
        "import jax, numpy, optimistix, sys; print(sys.version.split()[0], *(m.__version__ for m"
    )
    names += " in (jax, numpy, optimistix)))"
    said = subprocess.run([python, "-c", names], capture_output=True, text=True).stdout.strip()
    said = " ".join(f"{name} {text}" for name, text in zip(PROGRAMS, said.split()))
    print(f"{way}: {said}", flush=True)
    start = time.monotonic()
    command = [python, "-m", "pytest", "-m", "", "--durations=5", *TESTS]
    if way.endswith("oldest"):  # what old packages call in new ones is not ours to mend
        command[3:3] = ["-W", "default::DeprecationWarning"]
    done = subprocess.run(command, cwd=ROOT, env=os.environ | {"JAX_COMPILATION_CACHE_DIR": cache})
    word = "FAILED" if done.returncode else "passed"
    return f"{word}, {said}, {time.monotonic() - start:.0f} s"


def write(results: dict[str, str]) -> None:
    """Puts the outcome of each way into the table of docs/versions.md."""
    page = ROOT / "docs" / "versions.md"
    rows = [f"| {way} | {' | '.join(result.split(', ', 2))} |" for way, result in results.items()]
    head = "| way | outcome | with | tests |\n|--|--|--|--|\n"
    table = head + "\n".join(rows) + "\n"
    page.write_text(re.sub(r"(?m)(^\|.*\n)+", lambda found: table, page.read_text()))


if __name__ == "__main__":
    ways = [word for word in sys.argv[1:] if word != "--write"] or WAYS
    results = {way: tried(way) for way in ways}
    print("\n".join(f"{way}: {result}" for way, result in results.items()))
    if "--write" in sys.argv:
        write(results)
    sys.exit(any(result.startswith("FAILED") for result in results.values()))
