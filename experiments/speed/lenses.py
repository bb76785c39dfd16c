"""Ordinary lenses: times and errors of the first and the next calls.

Each lens at some fields, for an object at infinity, with its clear apertures. Errors are relative,
of the RMS spot radius sigma at the worst wavelength, against an integral over a sequential trace by
Snell's law. Optiland and batoid trace the same lens without clear apertures, as their users would;
their errors are against the same truth. Writes results.json: `rows` hold `lens`, `field_deg`,
`rays` a wavelength, `passed` (throughput), `first_s` (first call to a tolerance of 1e-3, with
compilation), `loose_s` and `tight_s` (to 1e-3 and 1e-6, warm), their `loose_error` and
`tight_error`, `value_s` and `gradient_s` (with the rule of 1e-6, compiled: sigma of all
wavelengths, and its gradient by every number of the lens), `compile_s`, `peers`; `copies`, the
seconds of perturbed copies x fields under vmap; `sweeps`, the spot over many fields and its
roughness.
"""

import dataclasses
import math
import pathlib
import sys
import time
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Lens, Scene, show
from drt_jax.pupil import PupilRule, pupil_points

from . import _command, _common, _plots, _work
from ._common import Numbers, Wavelengths, not_empty, within
from ._reference import reference, relative_error, sigmas
from .runs.folder import Run

_LOOSE, _TIGHT = 1e-3, 1e-6
# Relative perturbation of copies.
_SPREAD = 1e-4
# Values and slopes below this (mm, or throughput) are rounding.
_NOTHING = 1e-9
_GROWN = "curvature", "semi_diameter"
_SWEEP = "sigma", "centroid", "share of light"


@dataclasses.dataclass(frozen=True)
class LensFields:
    """A lens and its widest field.

    lens: bundled name or YAML path.
    field_deg: widest field.
    """

    lens: str
    field_deg: Annotated[float, within(1e-6, 89.9)]


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/lenses.yaml.

    parts: fields relative to the widest.
    copies, fields: numbers of perturbed lenses and of fields traced at once.
    sweep: number of fields from the axis to the widest.
    repeats: timed turns of each program.
    """

    lenses: Annotated[tuple[LensFields, ...], not_empty]
    parts: Annotated[Numbers, within(0, 1)] = (0.0, 0.5, 1.0)
    wavelengths_um: Wavelengths = (0.6562725, 0.5875618, 0.4861327)
    copies: Annotated[int, within(1, 1e4)] = 64
    fields: Annotated[int, within(1, 1e4)] = 5
    sweep: Annotated[int, within(8, 1e5)] = 200
    rays: Annotated[int, within(7, 1e6)] = 271
    repeats: Annotated[int, within(1, 1e4)] = 9
    seed: int = 0


def measure(config: Config, lens: Lens, field: float) -> dict[str, Any]:
    """A row of one lens at one field (radians); everything is compiled anew."""
    scene = Scene.point(field, math.inf, np.array(config.wavelengths_um))
    converged = partial(drt_jax.psf_moments, lens, scene)
    jax.clear_caches()
    start = time.perf_counter()
    loose = jax.block_until_ready(converged(_LOOSE))
    first = time.perf_counter() - start
    tight = converged(_TIGHT)
    calls = [partial(converged, _LOOSE), partial(converged, _TIGHT)]
    seconds = _common.medians(calls, config.repeats)
    rule = drt_jax.converge(drt_jax.psf_moments, lens, scene, _TIGHT)

    def sigma(lens):
        return sigmas(drt_jax.psf_moments(lens, scene, sampling=rule))

    value, measured = _work.compiled(sigma, lens)
    gradient, more = _work.compiled(jax.value_and_grad(lambda lens: jnp.sum(sigma(lens))), lens)
    truth = reference(lens, field, math.inf, config.wavelengths_um)

    def error(sigma: Any) -> float | None:
        """None if the spot of a peer is not finite."""
        found = relative_error(truth, sigma)
        return found if math.isfinite(found) else None

    given = lens, field, math.inf, config.wavelengths_um
    peers = _work.spot_peers(given, config.rays, error)
    (value_s, gradient_s), found = _work.timed([value, gradient], peers, config.repeats)
    return {
        "rays": pupil_points(lens, scene, rule)[0].shape[1],
        "passed": float(np.mean(loose.throughput)),
        "first_s": first,
        "loose_s": seconds[0],
        "tight_s": seconds[1],
        "loose_error": relative_error(truth, sigmas(loose)),
        "tight_error": relative_error(truth, sigmas(tight)),
        "value_s": value_s,
        "gradient_s": gradient_s,
        "compile_s": [measured["compile_s"], more["compile_s"]],
        "peers": {name.split()[0]: peer for name, peer in found.items()},
        "notes": {name: note for name, note in peers.items() if name not in found},
    }


def perturbed(lens: Lens, count: int, seed: int) -> Lens:
    """Copies of a lens with curvatures, thicknesses and sensor perturbed by about 1e-4."""
    rng = np.random.default_rng(seed)
    vary = lambda a: a[None] * (1 + _SPREAD * rng.normal(size=(count, *a.shape)))  # noqa: E731
    parts = {"curvature": vary(lens.curvature), "thickness": vary(lens.thickness)}
    batch = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), lens)
    return dataclasses.replace(batch, **parts, sensor=vary(lens.sensor))


def copies(config: Config, lens: Lens, widest: float, rule: PupilRule) -> dict[str, float]:
    """Seconds of perturbed copies at several fields under `vmap`, and of its compilation."""
    waves = jnp.asarray(config.wavelengths_um)
    fields = jnp.linspace(0.0, widest, config.fields)
    batch = perturbed(lens, config.copies, config.seed)

    def one(lens, field):
        scene = Scene.point(field, math.inf, waves)
        return sigmas(drt_jax.psf_moments(lens, scene, sampling=rule))

    all_of = jax.vmap(jax.vmap(one, (None, 0)), (0, None))
    call, known = _work.compiled(all_of, batch, fields)
    bad = int(jnp.sum(~jnp.isfinite(call())))
    return {"s": _common.medians([call], 3)[0], "compile_s": known["compile_s"], "bad": bad}


def sweep(config: Config, lens: Lens, widest: float, rule: PupilRule) -> dict[str, Any]:
    """sigma (mm), height of the centroid (mm) and throughput of one wavelength over the field, and
    their derivatives by a common factor of curvatures and apertures."""
    waves = jnp.asarray(config.wavelengths_um[len(config.wavelengths_um) // 2 :][:1])
    fields = jnp.linspace(0.0, widest, config.sweep)

    def spot(field, growth):
        parts = {name: getattr(lens, name) * (1 + growth) for name in _GROWN}
        scaled = dataclasses.replace(lens, **parts)
        found = drt_jax.psf_moments(scaled, Scene.point(field, math.inf, waves), sampling=rule)
        return jnp.stack([sigmas(found)[0], found.mean[0, 1], found.throughput[0]])

    def both(field):
        return jax.jvp(partial(spot, field), (jnp.zeros(()),), (jnp.ones(()),))

    parts = zip(("values", "slopes"), jax.jit(jax.vmap(both))(fields))
    found = {name: np.asarray(rows.T) for name, rows in parts}
    steps = {name: [*map(_roughness, rows)] for name, rows in found.items()}
    known = {name: rows.tolist() for name, rows in found.items()}
    return {"field_deg": np.degrees(fields).tolist(), **known, "steps": steps}


def _roughness(row: np.ndarray) -> float:
    """Largest distance of a value from the parabola through its neighbours, relative to the largest
    value: about the size of a step, nearly 0 for a smooth function."""
    return float(np.max(np.abs(np.diff(row, 3))) / 3 / max(np.max(np.abs(row)), _NOTHING))


def lens_rows(config: Config, of: LensFields) -> dict[str, Any]:
    """All results of one lens."""
    lens = drt_jax.load_lens(of.lens)
    widest = math.radians(of.field_deg)
    rows = []
    for part in config.parts:
        found = measure(config, lens, part * widest)
        rows.append({"lens": of.lens, "field_deg": part * of.field_deg} | found)
    jax.clear_caches()
    waves = np.array(config.wavelengths_um)
    fields = [[0.0, part * widest] for part in (0.5, 1)]
    rule = drt_jax.converge(drt_jax.psf_moments, lens, Scene.grid(fields, math.inf, waves), _LOOSE)
    group, swept = (f(config, lens, widest, rule) for f in (copies, sweep))
    name = {"lens": of.lens}
    return {"rows": rows, "copies": name | group, "sweep": name | swept}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Measures the lenses one by one."""
    # Programs saved by another run would hide the time of compilation.
    jax.config.update("jax_enable_compilation_cache", False)
    jobs = {of.lens: partial(lens_rows, config, of) for of in config.lenses}
    found = _common.measured(run, "lens", jobs)
    return {
        "rows": sum((each["rows"] for each in found), []),
        "copies": [each["copies"] for each in found],
        "sweeps": [each["sweep"] for each in found],
        "seconds": run.seconds,
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of all lenses and fields, and of copies under vmap and roughness over the field."""
    lines = []
    for row in results["rows"]:
        times = (row[key] for key in ("first_s", "loose_s", "tight_s", "value_s", "gradient_s"))
        peers = [row["peers"].get(name, (None, None)) for name in ("optiland", "batoid")]
        words = [(s, "nan" if e is None else f"{e:.0e}") for s, e in peers]
        theirs = [f"{_common.duration(s)}, {error}" if s else "" for s, error in words]
        errors = (f"{row[key]:.0e}" for key in ("loose_error", "tight_error"))
        start = row["lens"], row["field_deg"], f"{100 * row['passed']:.0f} %", row["rays"]
        lines.append((*start, *map(_common.duration, times), *errors, *theirs))
    header = ("lens", "field, deg", "light", "rays", "first call", "rule to 1e-3", "to 1e-6")
    header += ("sigma", "and gradient", "error at 1e-3", "at 1e-6", "Optiland", "batoid")
    both = zip(results["copies"], results["sweeps"], strict=True)
    more = []
    for group, swept in both:
        steps = (f"{max(swept['steps'][key]):.0e}" for key in ("values", "slopes"))
        more.append((group["lens"], _common.duration(group["s"]), *steps))
    columns = "lens", "64 copies x 5 fields", "largest step of a value", "of a gradient"
    return {"lenses": _common.table(header, lines), "lenses, batches": _common.table(columns, more)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the spot over the field."""
    for key, what in (("values", ""), ("slopes", "change of ")):
        figure, axes = show.new(1, 3, 4.5, 3.6)
        for ax, name, row in zip(axes, _SWEEP, range(3)):
            series = {}
            for swept in results["sweeps"]:
                fields, values = np.array(swept["field_deg"]), np.array(swept[key][row])
                largest = max(np.max(np.abs(values)), _NOTHING)
                series[swept["lens"]] = fields / fields[-1], values / largest
            _plots.curves(ax, series, "field / widest field", f"{what}{name} / its largest")
        figure.savefig(figures / f"fields_{key}.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
