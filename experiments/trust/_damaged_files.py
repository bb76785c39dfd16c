"""Randomly damaged prescriptions, lens files and settings: refused in one line, or right."""

import dataclasses
import pathlib
import signal
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Lens, Scene, Status
from drt_jax.inputs import InputError, shown

from ._common import settings_files
from ._damage import damaged
from .runs import config as configs

FAULTS = ("wrong", "traceback", "hang")
OUTCOMES = ("refused", "survived", *FAULTS)
# Most characters of a message; examples of faults that are kept for a kind.
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
# Files between clearings of JAX's caches: too many programs exhaust the maps of a process.
_KEPT = 200


def row_of(kind: str, trials: Iterable[tuple[str, object]], count: int) -> dict[str, Any]:
    """The row of a kind of trial for results.json. trials: outcome of each, and what to show of a
    fault."""
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
    """Outcome and message of a call that returns True for a right result. seconds: most time."""

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


def prescriptions(count: int, rng: np.random.Generator) -> tuple[dict[str, Any], list[Lens]]:
    """Row of damaged prescriptions, of which those that load must be finite; and the lenses."""
    texts = [path.read_text() for path in sorted(_LENSES.glob("*.yaml"))]
    return _loaded("prescriptions", "lens.yaml", lambda: damaged(_one(texts, rng), rng), count)


def lens_files(count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Row of damaged .zmx files with lines of other files, in two encodings."""
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "lens.zmx"
        texts = []
        for name in ("cooke_triplet", "phone", "hubble", "singlet"):
            drt_jax.save_lens(drt_jax.load_lens(name), path)
            texts.append(path.read_text())

    def content() -> bytes:
        lines = _one(texts, rng).splitlines()
        for _ in range(rng.integers(4)):
            lines.insert(int(rng.integers(len(lines))), f"  {_one(_ZMX, rng)}")
        own = damaged("\n".join(lines), rng, values=0.0)
        return own if rng.random() < 0.5 else own.decode("utf-8", "replace").encode("utf-16")

    return _loaded("lens files", "lens.zmx", content, count)[0]


def _one(items: Sequence[str], rng: np.random.Generator) -> str:
    return items[rng.integers(len(items))]


def _loaded(
    kind: str, name: str, content: Callable[[], bytes], count: int
) -> tuple[dict[str, Any], list[Lens]]:
    """Row of files of a name and random content, and the lenses of those that load."""
    lenses = list[Lens]()

    def trials(path: pathlib.Path) -> Iterator[tuple[str, object]]:
        for k in range(count):
            if k % _KEPT == 0:
                jax.clear_caches()
            path.write_bytes(written := content())

            def load() -> bool:
                lenses.append(drt_jax.load_lens(path))
                return finite(lenses[-1])

            outcome, message = outcome_of(load)
            yield outcome, (message, written[:500])

    with tempfile.TemporaryDirectory() as folder:
        return row_of(kind, trials(pathlib.Path(folder) / name), count), lenses


def finite(lens: Lens) -> bool:
    """True if all numbers of a lens are finite, except open apertures."""
    open_ones = dataclasses.replace(lens, semi_diameter=lens.curvature * 0)
    if lens.apertures is not None:
        half = dataclasses.replace(lens.apertures, half=lens.apertures.half * 0)
        open_ones = dataclasses.replace(open_ones, apertures=half)
    known = not np.any(np.isnan(lens.semi_diameter))
    return known and all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(open_ones))


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


def settings(count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Row of damaged settings of all experiments, half of them by --set: accepted ones must be the
    same when written and read again."""
    kinds = settings_files()

    def trials(path: pathlib.Path) -> Iterator[tuple[str, object]]:
        for k in range(count):
            source, experiment = kinds[rng.integers(len(kinds))]
            content, overrides = damaged(source.read_text(), rng), list[str]()
            if k % 2:
                lines = [line for line in content.decode("utf-8", "replace").splitlines() if line]
                line = lines[rng.integers(len(lines))] if lines else ""
                overrides, content = [line.replace(": ", "=", 1)], source.read_bytes()
            path.write_bytes(content)

            def load() -> bool:
                taken = configs.load_config(experiment.Config, path, overrides)
                path.write_text(configs.dump_config(taken))
                return configs.load_config(experiment.Config, path) == taken

            outcome, message = outcome_of(load)
            yield outcome, (message, overrides or content[:500])

    with tempfile.TemporaryDirectory() as folder:
        return row_of("settings", trials(pathlib.Path(folder) / "config.yaml"), count)
