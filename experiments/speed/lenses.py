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
from jax import Array

import drt_jax
from drt_jax import Lens, Scene, show
from drt_jax.pupil import PupilRule, pupil_points

from . import _command, _common, _peers, _plots, _work
from ._common import Numbers, Wavelengths, not_empty, within
from ._reference import reference
from .runs.folder import Run

_LOOSE, _TIGHT = 1e-3, 1e-6
# Relative perturbation of copies.
_SPREAD = 1e-4
# Values and slopes below this (mm, or throughput) are rounding.
_NOTHING = 1e-9
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


def sigmas(lens: Lens, field: Any, waves: Array, rule: PupilRule) -> Array:
    """RMS spot radii (W,), mm."""
    covariance = drt_jax.psf_moments(
        lens, Scene.point(field, math.inf, waves), sampling=rule
    ).covariance
    return jnp.sqrt(jnp.trace(covariance, axis1=1, axis2=2))


def _error(truth: np.ndarray, covariance: Array) -> float:
    found = np.sqrt(np.trace(np.asarray(covariance), axis1=1, axis2=2))
    return float(np.max(np.abs(found / truth - 1)))


def measure(config: Config, lens: Lens, field: float) -> dict[str, Any]:
    """A row of one lens at one field (radians); everything is compiled anew."""
    waves = np.array(config.wavelengths_um)
    scene = Scene.point(field, math.inf, waves)
    converged = partial(drt_jax.psf_moments, lens, scene)
    jax.clear_caches()
    start = time.perf_counter()
    loose = jax.block_until_ready(converged(_LOOSE))
    first = time.perf_counter() - start
    tight = converged(_TIGHT)
    calls = [lambda: converged(_LOOSE), lambda: converged(_TIGHT)]
    seconds = _common.medians(calls, config.repeats)
    rule = drt_jax.converge(drt_jax.psf_moments, lens, scene, _TIGHT)
    value, measured = _work.compiled(
        lambda lens: sigmas(lens, field, jnp.asarray(waves), rule), lens
    )

    def slopes(lens):
        return jnp.sum(sigmas(lens, field, jnp.asarray(waves), rule))

    gradient, more = _work.compiled(jax.value_and_grad(slopes), lens)
    truth = np.array([m.sigma for m in reference(lens, field, math.inf, config.wavelengths_um)])
    peers = _peers_of(config, lens, field, truth)
    ready = [(name, call, error) for name, call, error, _ in peers if call]
    timed = _common.medians([value, gradient, *(call for _, call, _ in ready)], config.repeats)
    others = {name: (s, error) for (name, _, error), s in zip(ready, timed[2:])}
    notes = {name: note for name, call, _, note in peers if not call}
    points, _ = pupil_points(lens, scene, rule)
    return {
        "rays": points.shape[1],
        "passed": float(np.mean(loose.throughput)),
        "first_s": first,
        "loose_s": seconds[0],
        "tight_s": seconds[1],
        "loose_error": _error(truth, loose.covariance),
        "tight_error": _error(truth, tight.covariance),
        "value_s": timed[0],
        "gradient_s": timed[1],
        "compile_s": [measured["compile_s"], more["compile_s"]],
        "peers": others,
        "notes": notes,
    }


def _peers_of(config: Config, lens: Lens, field: float, truth: np.ndarray) -> list[tuple]:
    """(name, call, error, note) of each peer; call is None if it is missing or fails, error if its
    spot is not finite."""
    found = []
    for name, spot in (("optiland", _peers.optiland_spot), ("batoid", _peers.batoid_spot)):
        try:
            numbers = _peers.Lens(lens, field, math.inf, config.wavelengths_um)
            call = spot(numbers, config.rays)[0]
            error = float(np.max(np.abs(call()[0] / truth - 1)))
            found.append((name, call, error if math.isfinite(error) else None, ""))
        except ImportError:
            found.append((name, None, None, "not installed: pip install -e '.[peers]'"))
        except (ValueError, RuntimeError) as failure:
            found.append((name, None, None, str(failure)[:80]))
    return found


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

    def all_of(batch, fields):
        one = lambda lens, field: sigmas(lens, field, waves, rule)  # noqa: E731
        return jax.vmap(lambda lens: jax.vmap(partial(one, lens))(fields))(batch)

    call, known = _work.compiled(all_of, batch, fields)
    bad = int(jnp.sum(~jnp.isfinite(call())))
    return {"s": _common.medians([call], 3)[0], "compile_s": known["compile_s"], "bad": bad}


def sweep(config: Config, lens: Lens, widest: float, rule: PupilRule) -> dict[str, Any]:
    """sigma (mm), height of the centroid (mm) and throughput of one wavelength over the field, and
    their derivatives by a common factor of curvatures and apertures."""
    waves = jnp.asarray(config.wavelengths_um[len(config.wavelengths_um) // 2 :][:1])
    fields = jnp.linspace(0.0, widest, config.sweep)

    def spot(growth, field):
        scaled = dataclasses.replace(
            lens,
            curvature=lens.curvature * (1 + growth),
            semi_diameter=lens.semi_diameter * (1 + growth),
        )
        found = drt_jax.psf_moments(scaled, Scene.point(field, math.inf, waves), sampling=rule)
        sigma = jnp.sqrt(found.covariance[0, 0, 0] + found.covariance[0, 1, 1])
        return jnp.stack([sigma, found.mean[0, 1], found.throughput[0]])

    def both(field):
        return jax.jvp(lambda growth: spot(growth, field), (jnp.zeros(()),), (jnp.ones(()),))

    values, slopes = jax.jit(jax.vmap(both))(fields)
    found = {"values": np.asarray(values.T), "slopes": np.asarray(slopes.T)}
    steps = {key: [_roughness(row) for row in rows] for key, rows in found.items()}
    known = {key: rows.tolist() for key, rows in found.items()}
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
    name = {"lens": of.lens}
    parts = {"copies": copies, "sweep": sweep}
    return {"rows": rows} | {key: name | f(config, lens, widest, rule) for key, f in parts.items()}


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
            series = {
                swept["lens"]: (
                    np.array(swept["field_deg"]) / swept["field_deg"][-1],
                    np.array(swept[key][row]) / max(np.max(np.abs(swept[key][row])), _NOTHING),
                )
                for swept in results["sweeps"]
            }
            _plots.curves(ax, series, "field / widest field", f"{what}{name} / its largest")
        figure.savefig(figures / f"fields_{key}.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
