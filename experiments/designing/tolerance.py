"""Tolerances of a lens: sensitivities, predictions, Monte Carlo.

Every lens is compensated, by focus or focus and tilt. A spot is the root mean square over the
fields of the RMS radius of all wavelengths about their centroid, um. Writes results.json:

- `rows`, one for each error, with its `kind`, `place`, `size`, the change of the spot at minus and
  plus this size as predicted from second derivatives (`predicted_um`) and as traced (`traced_um`,
  and `before_um` without compensation), and the `moves` and `predicted_moves` of the compensators,
  mm and radians;
- `scales`, one for each scale of all sizes, with the spots of Monte Carlo and of each order of
  prediction;
- `worst`, the spot with all errors at those limits for which second derivatives predict the largest
  spot.

A lens with a failed ray has no spot (null), and counts as the worst.

Orders of prediction, as functions of all errors: "first", q = spot^2 from its gradient; "rays",
from the sum of squares with first derivatives of all rays; "second", from all second derivatives.
Their means and percentiles are those of many draws, which take nearly no time.
"""

import dataclasses
import functools
import math
import os
import pathlib
import sys
import time
from typing import Annotated, Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Scene, design
from drt_jax.design.deviations import KINDS
from drt_jax.design.tolerance import Order

from . import _command, _common, _plots, _sharing
from ._common import LensFile, Numbers, not_empty, within
from .runs.folder import Run

_ORDERS = get_args(Order)
_SAMPLES = ("traced", *_ORDERS)
_SHOWN, _BINS = 14, 60
# Styles of _SAMPLES, whose lines may coincide: wide and pale for traced lenses, dotted on top.
_STYLES: tuple[dict[str, Any], ...] = (
    {"color": "black", "alpha": 0.35, "linewidth": 4},
    {"color": "C1", "linestyle": "--", "linewidth": 1.5},
    {"color": "black", "linestyle": ":", "linewidth": 2.2, "zorder": 4},
    {"color": "C3", "linestyle": "-", "linewidth": 1.5},
)
_LEVELS = np.linspace(0, 1, 201)


def _pairs(fields: tuple[tuple[float, ...], ...]) -> str:
    wrong = [p for p in fields if len(p) != 2 or not all(-89 <= angle <= 89 for angle in p)]
    return f"expected pairs x, y from -89 to 89, got {wrong[0]}" if wrong else ""


@dataclasses.dataclass(frozen=True)
class Config(LensFile):
    """Settings of the experiment; see configs/tolerance.yaml.

    tolerances: see drt_jax.design.
    fields_deg: fields as pairs x, y, degrees.
    wavelengths_um, colour_weights: wavelengths and their weights; empty for equal weights.
    compensator: what is adjusted in every lens.
    errors: "uniform" up to their sizes, or "normal" with half the sizes as standard deviation,
        truncated at the sizes.
    scales: factors of all sizes.
    count: number of Monte Carlo lenses for each scale.
    draws: number of draws of the predictions.
    limits_um: spots for which the yield is reported.
    devices: number of devices for the Monte Carlo lenses, see docs/devices.md.
    """

    tolerances: Annotated[tuple[design.Tolerance, ...], not_empty]
    fields_deg: Annotated[tuple[tuple[float, ...], ...], not_empty, _pairs] = ((0.0, 0.0),)
    distance_mm: float = math.inf
    wavelengths_um: Annotated[tuple[float, ...], within(1e-4, 1e6), not_empty] = (0.5875618,)
    colour_weights: tuple[float, ...] = ()
    order: Annotated[int, within(1, 40)] = 4
    compensator: Literal["none", "focus", "focus and tilt"] = "focus"
    errors: Literal["uniform", "normal"] = "uniform"
    scales: Annotated[Numbers, within(1e-3, 1e3)] = (1.0,)
    count: Annotated[int, within(1, 1e7)] = 10000
    draws: Annotated[int, within(1, 1e7)] = 100000
    limits_um: Annotated[tuple[float, ...], within(1e-6, 1e6)] = ()
    seed: int = 0
    devices: Annotated[int, within(1, 1e4)] = dataclasses.field(default=1, compare=False)


class Study:
    """The lens of the settings, with its errors.

    perturbed: the lens and its errors.
    problem: problem that evaluates it.
    normal: True for normal errors.
    """

    def __init__(self, config: Config) -> None:
        self.config, self.normal = config, config.errors == "normal"
        lens = config.load()
        radius = self._problem(lens).beam_radius(lens)
        self.perturbed = design.PerturbedLens.from_lens(lens, radius, config.tolerances)
        self.problem = self._problem(self.perturbed.lens)

    def _problem(self, lens: drt_jax.Lens) -> design.Problem:
        config = self.config
        variables = design.Variables.from_lens(lens, ["sensor"])
        fields, weights = np.radians(config.fields_deg), config.colour_weights or None
        given = fields, config.distance_mm, config.wavelengths_um
        scene = Scene.grid(*given, wavelength_weights=weights)
        return design.Problem.from_variables(variables, ["spot"], scene, config.order)

    def draws(self, count: int, seed: int) -> np.ndarray:
        """Random errors (count, P), in units of their sizes."""
        return design.draw_perturbations(self.perturbed, count, seed, self.normal)

    def traced(self, perturbations: np.ndarray, title: str) -> design.AsBuilt:
        """The lenses with errors (K, P), in units of their sizes, with a progress bar."""
        mesh = _sharing.mesh_of(self.config.devices)
        with tqdm(total=len(perturbations), desc=title, unit="lens", dynamic_ncols=True) as bar:
            given = self.problem, self.perturbed, perturbations, self.config.compensator
            return design.monte_carlo(*given, lambda done: bar.update(done - bar.n), mesh=mesh)


def derivatives(study: Study) -> dict[str, Any]:
    """The fields of `design.Predicted` as lists, times, and the relative error of the rule."""
    config, problem, perturbed = study.config, study.problem, study.perturbed
    nominal = jax.jit(lambda p, lens: design.as_built(p, lens, config.compensator).spot)
    finer = problem.with_order(min(config.order + 4, 40))
    spots = [float(nominal(other, perturbed.lens)) for other in (problem, finer)]
    seconds = []
    for _ in range(2):
        begun = time.perf_counter()
        found = jax.block_until_ready(design.predict(problem, perturbed, config.compensator))
        seconds.append(time.perf_counter() - begun)
    return {
        "fields": jax.tree.map(lambda array: np.asarray(array).tolist(), found),
        "derivatives_s": seconds[1],
        "derivatives_compile_s": seconds[0] - seconds[1],
        "rule_error": abs(spots[0] / spots[1] - 1),
    }


def _um(squares: Any) -> np.ndarray:
    """Square roots, in um, of values in mm^2; negative values count as 0."""
    return 1e3 * np.sqrt(np.maximum(squares, 0))


def _model(fields: list) -> design.Predicted:
    """The model from its fields as `derivatives` returns them."""
    *arrays, before = fields
    return design.Predicted(*map(jnp.asarray, arrays), before and _model(before))


def sensitivity(study: Study, predicted: design.Predicted) -> dict[str, Any]:
    """Each error alone at both limits, and all errors at the worst limits."""
    perturbed = study.perturbed
    given = study.problem, perturbed, study.config.compensator
    traced, foretold = (design.sensitivity(*given, model) for model in (None, predicted))
    worst = design.worst_case(perturbed, predicted)
    spot = float(study.traced(worst[None], "worst case").spot[0])
    variances = design.variances(perturbed, study.normal)
    share = np.diag(np.asarray(predicted.hessian)) * variances / 2
    rows = []
    for k, error in enumerate(perturbed.deviations):
        rows.append({
            "error": str(error), "kind": error.kind, "place": error.place, "axis": error.axis,
            "size": float(perturbed.sizes[k]), "unit": KINDS[error.kind].unit,
            "predicted_um": (1e3 * foretold.after[k]).tolist(),
            "traced_um": (1e3 * traced.after[k]).tolist(),
            "before_um": (1e3 * traced.before[k]).tolist(),
            "predicted_moves": foretold.moves[k].tolist(),
            "moves": traced.moves[k].tolist(),
            "growth_um2": 1e6 * float(share[k]),
        })  # fmt: skip
    orders = {order: float(_um(predicted.at(worst, order))) for order in _ORDERS}
    worst_um = {"traced": 1e3 * spot, **orders}
    return {"rows": rows, "nominal_um": 1e3 * traced.nominal, "worst": worst_um}


def monte_carlo(study: Study, predicted: design.Predicted, scale: float) -> dict[str, Any]:
    """Traced and predicted spots at one scale of the sizes.

    `config.count` lenses are traced, after a first one that compiles. The predictions are evaluated
    at `config.draws` other draws, with the same statistics: mean, percentiles, yields, histogram. A
    normal distribution of q gives a further 90th percentile without draws.
    """
    config = study.config
    perturbations = scale * study.draws(config.count, config.seed)
    begun = time.perf_counter()
    study.traced(perturbations[:1], "compilation")
    warm = time.perf_counter()
    built = study.traced(perturbations, f"sizes x {scale:g}")
    seconds = time.perf_counter() - warm
    spots = 1e3 * np.asarray(built.spot)
    whole = np.isfinite(spots)
    message = f"scales: {scale:g}: light passes through no lens; take less"
    _common.require(bool(whole.any()), message)
    low, high = np.quantile(spots[whole], [0, 0.999])
    edges = np.linspace(0.98 * low, 1.1 * high, _BINS + 1)
    row: dict[str, Any] = {
        "scale": scale,
        "edges_um": edges.tolist(),
        "seconds": seconds,
        "compile_s": warm - begun,
        "failed": int(np.sum(~whole)),
        "moves_deviation": np.std(built.moves[whole], axis=0).tolist(),
        "rays": design.rays_of(study.problem) * len(perturbations),
    }
    draws = scale * study.draws(config.draws, config.seed + 1)
    variances = scale**2 * design.variances(study.perturbed, study.normal)
    for name in _SAMPLES:
        values = spots if name == "traced" else _um(predicted.at(draws, name))
        finite = values[np.isfinite(values)]
        row[name] = {
            "mean_um": float(finite.mean()),
            "p90_um": float(np.quantile(values, 0.9, method="higher")),
            "yields": [float(np.mean(values <= limit)) for limit in config.limits_um],
            "quantiles_um": np.quantile(finite, _LEVELS).tolist(),
            "shares": (100 / len(values) * np.histogram(finite, edges)[0]).tolist(),
        }
        if name != "traced":
            mean, deviation = predicted.moments(variances, name)
            # Root sum of squares: q is assumed to be normally distributed.
            row[name]["rss_p90_um"] = float(_um(mean + 1.2815516 * deviation))
    return row


def run(config: Config, run: Run) -> dict[str, Any]:
    """Derivatives, then each error alone, then Monte Carlo at each scale."""
    study = Study(config)
    (found,) = _common.measured(run, "step", {"derivatives": lambda: derivatives(study)})
    given = study, _model(found.pop("fields"))
    jobs: dict[str, Any] = {"one error": lambda: sensitivity(*given)}
    for scale in config.scales:
        jobs[f"sizes x {scale:g}"] = functools.partial(monte_carlo, *given, scale)
    alone, *scales = _common.measured(run, "step", jobs)
    about = {"threads": os.cpu_count(), "count": config.count, "errors": config.errors}
    return alone | found | about | {"limits_um": list(config.limits_um), "scales": scales}


def main_scale(results: dict[str, Any]) -> dict[str, Any]:
    """The row of scale 1, or of the first scale."""
    return next((row for row in results["scales"] if row["scale"] == 1), results["scales"][0])


def merged(results: dict[str, Any]) -> list[dict]:
    """The largest change for each kind of error and part of the lens, over x and y, minus and plus;
    the largest first. The change is inf for a lens without a spot."""
    found = []
    for (kind, place), some in _common.grouped(results["rows"], "kind", "place").items():
        changes = [
            (math.inf if traced is None else traced, predicted, row)
            for row in some
            for traced, predicted in zip(row["traced_um"], row["predicted_um"])
        ]
        traced, predicted, worst = max(changes, key=lambda change: change[0])
        moves = [abs(move[0]) for row in some for move in row["moves"] if move]
        found.append({
            "name": f"{kind}, {KINDS[kind].whole} {place}",
            "size": f"{worst['size']:g} {worst['unit']}".strip(),
            "predicted_um": predicted, "traced_um": traced, "move": max(moves, default=0),
        })  # fmt: skip
    return sorted(found, key=lambda row: -row["traced_um"])


def table_of_scales(results: dict[str, Any]) -> str:
    """Table of traced spots by scale, and of the errors of each order of prediction."""
    lines = []

    def add(scale: str, words: str, truth: float | None, predicted: dict[str, float]) -> None:
        """Adds a line, with the relative errors of predictions by order."""
        off = (f"{100 * (predicted[order] / (truth or 1) - 1):+.1f} %" for order in _ORDERS)
        errors = [""] * len(_ORDERS) if truth is None else off
        lines.append((scale, words, _common.number(truth, ".2f"), *errors))

    for row in results["scales"]:
        for key, of, words in (
            ("mean_um", "mean_um", "mean"),
            ("p90_um", "p90_um", "90 % are below"),
            ("rss_p90_um", "p90_um", "the same by RSS"),
        ):
            predicted = {order: row[order][key] for order in _ORDERS}
            add(f"{row['scale']:g}", words, row["traced"][of], predicted)
    add("1", "worst case", results["worst"]["traced"], results["worst"])
    return _common.table(["sizes times", "spot", "traced (µm)", *_ORDERS], lines)


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of spots by scale, yields, the worst errors, and shares of the kinds."""
    row, limits = main_scale(results), results["limits_um"]
    yields = [(name, *(f"{100 * part:.1f} %" for part in row[name]["yields"])) for name in _SAMPLES]
    worst = []
    for some in merged(results)[:_SHOWN]:
        changes = (f"{some[key]:+.3f}" for key in ("predicted_um", "traced_um"))
        worst.append((some["name"], some["size"], *changes, f"{some['move']:.3f}"))
    whole = sum(row["growth_um2"] for row in results["rows"])
    kinds = [
        (kind, len(some), f"{100 * sum(row['growth_um2'] for row in some) / whole:.1f} %")
        for (kind,), some in _common.grouped(results["rows"], "kind").items()
    ]
    columns = ("as predicted (µm)", "as traced (µm)", "refocus (mm)")
    return {
        "tolerance": table_of_scales(results),
        "tolerance, yield": _common.table(("spot at most", *(f"{x:g} µm" for x in limits)), yields),
        "tolerance, worst": _common.table(("error", "at most", *columns), worst),
        "tolerance, kinds": _common.table(("kind", "errors", "share of the mean growth"), kinds),
    }


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the yield by scale, the worst errors, and a histogram of the spots."""
    scales = results["scales"]
    with _plots.picture(figures / "yield.png", 5.2, 3.7, len(scales)) as axes:
        for ax, row in zip(axes, scales):
            parts = dict.fromkeys(_SAMPLES, 100 * _LEVELS)
            parts["traced"] = parts["traced"] * (1 - row["failed"] / results["count"])
            lines = {name: (row[name]["quantiles_um"], parts[name]) for name in _SAMPLES}
            labels = "spot (µm)", "lenses at least so good (%)"
            _plots.curves(ax, lines, *labels, styles=_STYLES)
            ax.set_title(f"sizes × {row['scale']:g}", fontsize=10)
            ax.set_xlim(0, 1.05 * row["traced"]["quantiles_um"][-1])
    some = merged(results)[:_SHOWN]
    with _plots.picture(figures / "offenders.png", 7, 5) as (ax,):
        names = [f"{m['name']}: {m['size']}" for m in some]
        traced, predicted = ([m[key] for m in some] for key in ("traced_um", "predicted_um"))
        ax.barh(names, traced, 0.8, label="traced", color="C0", alpha=0.7)
        ax.barh(names, predicted, 0.55, label="predicted", fill=False, edgecolor="C1", lw=1.4)
        ax.tick_params("y", labelsize=8)
        ax.invert_yaxis()  # the largest on top
        _plots.label_axes(ax, "spot grows by (µm)", "", "x")
    row = main_scale(results)
    with _plots.picture(figures / "histogram.png", 6.5, 4) as (ax,):
        fill = {"color": "black", "alpha": 0.2, "fill": True}
        for name, style in zip(_SAMPLES, (fill, *_STYLES[1:])):
            ax.stairs(row[name]["shares"], row["edges_um"], label=name, **style)
        marks = {"nominal": results["nominal_um"], "mean": row["traced"]["mean_um"]}
        if row["traced"]["p90_um"] is not None:
            marks["90 %"] = row["traced"]["p90_um"]
        for k, (name, place) in enumerate(marks.items()):
            ax.axvline(place, color="black", linestyle="-.", linewidth=0.8)
            at = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
            ax.annotate(name, (place, 1), (3, -10 - 11 * k), fontsize=8, **at)
        _plots.label_axes(ax, "spot (µm)", "share (%)", loc="center right")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
