"""Randomly damaged prescriptions and settings: refused in one line, or right."""

import dataclasses
import pathlib
import tempfile
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Lens, Status
from drt_jax.inputs import InputError, shown

from ._common import settings_files
from ._mutants import mutated
from ._outcomes import Tally, judged
from .runs import config as configs

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


def prescriptions(count: int, rng: np.random.Generator) -> tuple[dict[str, Any], list[Lens]]:
    """Row of damaged prescriptions, of which those that load must be finite; and the lenses."""
    texts = [path.read_text() for path in sorted(_LENSES.glob("*.yaml"))]
    loaded = list[Lens]()
    spoilt = lambda: mutated(_one(texts, rng), rng)  # noqa: E731
    return _tried("prescriptions", "lens.yaml", spoilt, count, loaded), loaded


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
        own = mutated("\n".join(lines), rng, trees=0.0)
        return own if rng.random() < 0.5 else own.decode("utf-8", "replace").encode("utf-16")

    return _tried("lens files", "lens.zmx", content, count, [])


def _one(items: Sequence[str], rng: np.random.Generator) -> str:
    return items[rng.integers(len(items))]


def _tried(
    kind: str, name: str, spoilt: Callable[[], bytes], count: int, loaded: list[Lens]
) -> dict[str, Any]:
    """Row of damaged files of a name; `loaded` gets the lenses."""
    tally = Tally(kind)
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / name
        for k in tqdm(range(count), unit="lens", leave=False, dynamic_ncols=True):
            if k % _KEPT == 0:
                jax.clear_caches()
            path.write_bytes(content := spoilt())

            def load() -> bool:
                loaded.append(drt_jax.load_lens(path))
                return finite(loaded[-1])

            tally.add((found := judged(load))[0], (found[1], content[:500]))
    return tally.row


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
    tally = Tally("lenses that load, traced")
    pupil = np.array([[0.0, 0.0], [0.0, 0.9], [0.5, -0.5], [0.0, -1.0]])
    for lens in tqdm(lenses, unit="lens", leave=False, dynamic_ncols=True):
        jax.clear_caches()
        wave = float(np.clip(np.mean(lens.dispersion.range), 0.4, 0.7))

        def trace(lens: Lens = lens, wave: float = wave) -> bool:
            try:
                rays = drt_jax.trace_rays(lens, 0.05, np.inf, [wave], pupil)
            except ValueError as error:
                raise InputError(str(error)) from error
            known = np.isin(rays.status, [*Status])
            return bool(np.all(known) and np.all(np.isfinite(rays.points)))

        tally.add((found := judged(trace, 120.0))[0], (found[1], lens.name, shown(lens.forms)))
    return tally.row


def settings(count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Row of damaged settings of all experiments, half of them by --set: accepted ones must be the
    same when written and read again."""
    kinds = settings_files()
    tally = Tally("settings")
    with tempfile.TemporaryDirectory() as folder:
        path = pathlib.Path(folder) / "config.yaml"
        for k in tqdm(range(count), unit="config", leave=False, dynamic_ncols=True):
            source, experiment = kinds[rng.integers(len(kinds))]
            content, overrides = mutated(source.read_text(), rng), list[str]()
            if k % 2:
                lines = [line for line in content.decode("utf-8", "replace").splitlines() if line]
                line = lines[rng.integers(len(lines))] if lines else ""
                overrides, content = [line.replace(": ", "=", 1)], source.read_bytes()
            path.write_bytes(content)

            def load(kind: type = experiment.Config, overrides: list[str] = overrides) -> bool:
                taken = configs.load_config(kind, path, overrides)
                path.write_text(configs.dump_config(taken))
                return configs.load_config(kind, path) == taken

            tally.add((found := judged(load))[0], (found[1], overrides or content[:500]))
    return tally.row
