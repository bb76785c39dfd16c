"""Randomly damaged prescriptions, lens files and settings: each must raise an error of one line, or
give a right result.

The damage changes bytes, words, or values of the YAML tree.
"""

import copy
import pathlib
import signal
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
import yaml
from tqdm import tqdm

import drt_jax
from drt_jax import Lens, Scene, Status
from drt_jax.inputs import InputError, shown

from ._common import settings_files
from .runs import config as configs

FAULTS = ("wrong", "traceback", "hang")
OUTCOMES = ("refused", "survived", *FAULTS)
# Largest number of characters of a message, and of examples of faults for each kind.
_LONGEST, _EXAMPLES = 300, 5
_LENSES = pathlib.Path(drt_jax.__file__).parent / "lens" / "catalogue" / "lenses"
# Lines of .zmx files that we do not write.
_ZMX = (
    *("TYPE COORDBRK", "TYPE SZERNSAG", "TYPE QED_TYPE", "TYPE BINARY_2", "TYPE XPOLYNOM", "STOP"),
    *("TYPE TOROIDAL", "TYPE BICONICX", "TYPE TILTSURF", "PARM 1 .1", "PARM 3 20", "PARM 6 1"),
    *("XDAT 1 4", "XDAT 2 20", "XDAT 3 .01", "XDAT 5 1e-3", "DISZ 0", "DISZ INFINITY", "SQAP 3 4"),
    *("OBSC 0 1", "CLAP 1 9", "OBDC 1 2", "FLAP", "GLAS MIRROR", "GLAS ___BLANK 1 0 1.6 40 0"),
    *("FNUM 2 1", "ENPD 5", "OBNA .1", "FTYP 2 0 1 1", "FTYP 1 1 3 9", "UNIT IN", "PWAV 9"),
)
# Number of files after which JAX's caches are cleared: too many compiled programs exceed the limit
# of memory maps of a process.
_KEPT = 200
# Words that a careless or malicious author may write.
_WORDS = (
    *("0", "-1", "1e-320", "1e308", "-1e39", ".inf", "-.inf", ".nan", "nan", "inf", "null", "~"),
    *("true", "no", "''", "'0x10'", "0x10", "1:30", "2001-99-99", "1_000", "1e", "--5", "9" * 400),
    *("9" * 5000, "[]", "{}", "[1, 2]", "{a: 1}", "[[1]]", "[asphere]", "{2: 1}", "!!int abc"),
    *("!!python/object/apply:os.getcwd []", "&a", "*a", "<<", "---", "...", "#", "\t", ": ", "- "),
    *("\x00", "\x1b[31m", "\ud83d\ude00", "\u202e", "é", "x" * 3000, "[" * 400, "{a: " * 400, "|"),
    *("surfaces", "radius", "coefficients", "sellmeier", "zernike", "qbfs", "toroid", "1.5", "inf"),
)
_VALUES: tuple[Any, ...] = (
    *(0, -1, 1, 2, 3, 1e-320, 1e308, -1e39, 1e30, float("inf"), float("-inf"), float("nan")),
    *(None, True, False, "", "a", "inf", "N-BK7", "835427", "air", [], {}, [1, 2], [1, 2, 3]),
    *({"circle": 1}, {2: 1e-3}, {4: 1e30}, {"x1y1": 1}, 10**30, -(10**18), "x" * 500, 1e-7),
    *("asphere", "zernike", "qbfs", "toroid", "biconic", "polynomial_xy", "linear", "sensor"),
)
# Changes of a few bytes and of a value; one that is listed more often is drawn more often.
_OF_BYTES = ("remove", "double", "flip", "write a word", "write a word", "cut", "double a line")
_OF_VALUES = ("exchange",) * 3 + ("scale",) * 2 + ("drop", "copy another", "rename")


def damaged(text: str, rng: np.random.Generator, values: float = 0.6) -> bytes:
    """A file with one to four random changes. values: fraction of changes to values of the YAML
    tree; the rest are to bytes."""
    content = text.encode("utf-8", "surrogatepass")
    for _ in range(rng.integers(1, 5)):
        change = _change_value if rng.random() < values else _change_bytes
        content = change(content, rng)
    return content


def _one(items: Sequence[Any], rng: np.random.Generator) -> Any:
    return items[rng.integers(len(items))]


def _change_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    kind = _one(_OF_BYTES, rng)
    if kind == "double a line":
        lines = content.split(b"\n")
        k = int(rng.integers(len(lines)))
        return b"\n".join([*lines[: k + 1], *lines[k:]])
    first = int(rng.integers(len(content) + 1))
    last = min(len(content), first + int(rng.integers(1, 40)))
    before, after = content[:first], content[last:]
    if kind == "double":
        return content[:last] + content[first:]
    if kind == "flip":
        return before + bytes([rng.integers(256)]) + content[first + 1 :]
    if kind == "write a word":
        word = _one(_WORDS, rng).encode("utf-8", "surrogatepass")
        return before + word + (after if rng.random() < 0.5 else content[first:])
    return before if kind == "cut" else before + after


def _places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Container and key of each value of a tree, at any depth."""
    keys = node if isinstance(node, dict) else range(len(node)) if type(node) is list else ()
    yield from ((node, key) for key in keys)
    for key in reversed([*keys]):
        yield from _places(node[key])


def _change_value(content: bytes, rng: np.random.Generator) -> bytes:
    """Changes one value of a YAML file, at any depth; nothing if the file is no longer YAML."""
    kind = _one(_OF_VALUES, rng)
    try:
        tree = yaml.safe_load(content) if len(content) < 50_000 else None
        places = [*_places(tree)]
    except (yaml.YAMLError, ValueError, RecursionError):
        return content
    if not places:
        return content
    node, key = _one(places, rng)
    if kind == "exchange":
        node[key] = copy.deepcopy(_one(_VALUES, rng))
    elif kind == "scale":
        if isinstance(node[key], int | float) and not isinstance(node[key], bool):
            node[key] = node[key] * float(rng.choice([-1, 0, 0.1, 3, 10, 1e6, 1e200]))
    elif kind == "drop":
        del node[key]
    elif kind == "copy another":
        other, place = _one(places, rng)
        node[key] = copy.deepcopy(other[place])
    elif isinstance(node, dict):
        node[str(key) + "x"] = node.pop(key)
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
    return text.encode("utf-8", "surrogatepass")


def row_of(kind: str, trials: Iterable[tuple[str, object]], count: int) -> dict[str, Any]:
    """The row of a kind of trial for results.json. trials: outcome of each trial, and the text that
    is shown for a fault."""
    counts, examples = dict.fromkeys(OUTCOMES, 0), list[str]()
    for outcome, example in tqdm(trials, kind, count, leave=False, dynamic_ncols=True):
        counts[outcome] += 1
        if outcome in FAULTS and len(examples) < _EXAMPLES:
            examples.append(f"{outcome}: {example!r}"[:1000])
    return {"kind": kind, "tried": sum(counts.values()), **counts, "examples": examples}


def clear(message: str) -> bool:
    """True for a message of one short printable line."""
    return 0 < len(message) <= _LONGEST and message.isprintable()


class _TooLong(BaseException):
    """A trial took too long."""


def outcome_of(call: Callable[[], bool], seconds: float = 5.0) -> tuple[str, str]:
    """Outcome and message of a call that returns True for a right result. seconds: time limit."""

    def ring(number: int, frame: Any) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ("survived", "") if call() else ("wrong", "the result")
    except InputError as error:
        return ("refused" if clear(str(error)) else "wrong"), str(error)
    except _TooLong:
        return "hang", f"over {seconds:g} s"
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {error}"[:_LONGEST]
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def _loaded(
    kind: str, path: pathlib.Path, content: Callable[[], bytes], count: int
) -> tuple[dict[str, Any], list[Lens]]:
    """Row of files with random content, which are written to a path; and the lenses of those that
    load. Their numbers must be finite."""
    lenses = list[Lens]()

    def load() -> bool:
        lenses.append(drt_jax.load_lens(path))
        return finite(lenses[-1])

    def trials() -> Iterator[tuple[str, object]]:
        for k in range(count):
            if k % _KEPT == 0:
                jax.clear_caches()
            path.write_bytes(written := content())
            outcome, message = outcome_of(load)
            yield outcome, (message, written[:500])

    return row_of(kind, trials(), count), lenses


def prescriptions(
    folder: pathlib.Path, count: int, rng: np.random.Generator
) -> tuple[dict[str, Any], list[Lens]]:
    """Row of damaged prescriptions; and the lenses of those that load."""
    texts = [path.read_text() for path in sorted(_LENSES.glob("*.yaml"))]
    content = lambda: damaged(_one(texts, rng), rng)  # noqa: E731
    return _loaded("prescriptions", folder / "lens.yaml", content, count)


def lens_files(folder: pathlib.Path, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Row of damaged .zmx files with lines of other files, in two encodings."""
    path, texts = folder / "lens.zmx", []
    for name in ("cooke_triplet", "phone", "hubble", "singlet"):
        drt_jax.save_lens(drt_jax.load_lens(name), path)
        texts.append(path.read_text())

    def content() -> bytes:
        lines = _one(texts, rng).splitlines()
        for _ in range(rng.integers(4)):
            lines.insert(int(rng.integers(len(lines))), f"  {_one(_ZMX, rng)}")
        own = damaged("\n".join(lines), rng, values=0.0)
        return own if rng.random() < 0.5 else own.decode("utf-8", "replace").encode("utf-16")

    return _loaded("lens files", path, content, count)[0]


def finite(lens: Lens) -> bool:
    """True if all numbers of a lens are finite, except apertures, for which inf means open."""
    for path, leaf in jax.tree.leaves_with_path(lens):
        may_be_open = jax.tree_util.keystr(path) in (".semi_diameter", ".apertures.half")
        if np.any(np.isnan(leaf) if may_be_open else ~np.isfinite(leaf)):
            return False
    return True


def traced(lenses: list[Lens]) -> dict[str, Any]:
    """Row of lenses that load: their rays must be finite and have a known status."""
    pupil = np.array([[0.0, 0.0], [0.0, 0.9], [0.5, -0.5], [0.0, -1.0]])

    def trace(lens: Lens) -> bool:
        wave = float(np.clip(np.mean(lens.dispersion.range), 0.4, 0.7))
        try:
            rays = drt_jax.trace_rays(lens, Scene.point(0.05, np.inf, [wave]), pupil)
        except ValueError as error:
            raise InputError(str(error)) from error
        known = np.isin(rays.status, [*Status])
        return bool(np.all(known) and np.all(np.isfinite(rays.points)))

    def trials() -> Iterator[tuple[str, object]]:
        for lens in lenses:
            jax.clear_caches()
            outcome, message = outcome_of(lambda: trace(lens), 120.0)
            yield outcome, (message, lens.name, shown(lens.forms))

    return row_of("lenses that load, traced", trials(), len(lenses))


def settings(path: pathlib.Path, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Row of damaged settings of all experiments, written to a path, half of them by --set.
    Accepted settings must be the same after they are written and read again."""
    kinds = settings_files()

    def trials() -> Iterator[tuple[str, object]]:
        for k in range(count):
            source, experiment = kinds[rng.integers(len(kinds))]
            content, overrides = damaged(source.read_text(), rng), list[str]()
            if k % 2:
                lines = [line for line in content.decode("utf-8", "replace").splitlines() if line]
                line = _one(lines, rng) if lines else ""
                overrides, content = [line.replace(": ", "=", 1)], source.read_bytes()
            path.write_bytes(content)

            def load() -> bool:
                taken = configs.load_config(experiment.Config, path, overrides)
                path.write_text(configs.dump_config(taken))
                return configs.load_config(experiment.Config, path) == taken

            outcome, message = outcome_of(load)
            yield outcome, (message, overrides or content[:500])

    return row_of("settings", trials(), count)
