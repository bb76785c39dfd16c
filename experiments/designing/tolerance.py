"""Tolerances of a lens: sensitivities, predictions, Monte Carlo.

Every lens is compensated, by focus or focus and tilt. A spot is the root mean square over the
fields of the RMS radius of all wavelengths about their centroid, um. Writes results.json: `rows`,
one for each error, with its `kind`, `place`, `size`, the change of the spot at minus and plus this
size as predicted from second derivatives (`predicted_um`) and as traced (`traced_um`), and the
`moves` and `predicted_moves` of the compensators, mm and radians; `scales`, one for each scale of
all sizes, with the spots of Monte Carlo and of each order of prediction; `worst`, the spot with all
errors at the limits where second derivatives predict the largest. A lens with a failed ray has no
spot (null), and counts as the worst.

Orders of prediction, as functions of all errors: "first", q = spot^2 from its gradient; "rays",
from the sum of squares with first derivatives of all rays; "second", from all second derivatives.
Their means and percentiles are those of many draws, which cost nothing.
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
from drt_jax import Scene, design, show
from drt_jax.design.perturbed import KINDS
from drt_jax.design.tolerance import Order

from . import _command, _common, _plots, _sharing
from ._common import Numbers, not_empty, within
from .runs.folder import Run

_ORDERS = get_args(Order)
_SAMPLES = ("traced", *_ORDERS)
_SHOWN, _BINS = 14, 60
_LEVELS = np.linspace(0, 1, 201)


def _pairs(fields: tuple[tuple[float, ...], ...]) -> str:
    wrong = [p for p in fields if len(p) != 2 or not all(-89 <= angle <= 89 for angle in p)]
    return f"expected pairs x, y from -89 to 89, got {wrong[0]}" if wrong else ""


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/tolerance.yaml.

    lens: bundled name or YAML path.
    tolerances: see drt_jax.design.
    fields_deg: pairs x, y.
    wavelengths_um, colour_weights: wavelengths and their weights; empty for equal weights.
    compensator: adjusted in every lens.
    errors: "uniform" up to their sizes, or "normal" with half the sizes as standard deviation,
        truncated at the sizes.
    scales: scales of all sizes.
    count: lenses of Monte Carlo for each scale.
    draws: draws of the predictions.
    limits_um: spots for which the yield is reported.
    devices: that share the lenses of Monte Carlo, see docs/devices.md.
    """

    lens: str
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


def prepare(config: Config, order: int = 0) -> tuple[design.Problem, design.PerturbedLens]:
    """The problem that evaluates the lens, and the lens with its errors. order: order of the pupil
    rule; 0 for that of the settings."""
    lens = drt_jax.load_lens(config.lens)

    def problem_of(lens: drt_jax.Lens) -> design.Problem:
        return design.Problem.from_variables(
            design.Variables.from_lens(lens, ["sensor"]),
            ["spot"],
            Scene.grid(
                np.radians(config.fields_deg),
                config.distance_mm,
                config.wavelengths_um,
                wavelength_weights=config.colour_weights or None,
            ),
            order or config.order,
        )

    radius = problem_of(lens).beam_radius(lens)
    perturbed = design.PerturbedLens.from_lens(lens, radius, config.tolerances)
    return problem_of(perturbed.lens), perturbed


def derivatives(config: Config) -> dict[str, Any]:
    """The fields of `design.Predicted` as lists, times, and the relative error of the rule."""
    problem, perturbed = prepare(config)
    spots = []
    for order in (config.order, min(config.order + 4, 40)):
        other, _ = prepare(config, order)
        nominal = jax.jit(lambda p, lens: design.as_built(p, lens, config.compensator).spot)
        spots.append(float(nominal(other, perturbed.lens)))
    seconds = []
    for _ in range(2):
        begun = time.perf_counter()
        found = jax.block_until_ready(design.predict(problem, perturbed, config.compensator))
        seconds.append(time.perf_counter() - begun)
    fields = {name: np.asarray(a).tolist() for name, a in found._asdict().items()}
    about = {"seconds": seconds[1], "compile_s": seconds[0] - seconds[1]}
    return {"fields": fields, "rule_error": abs(spots[0] / spots[1] - 1), **about}


def predicted_of(found: dict[str, Any]) -> design.Predicted:
    """The predictions of `derivatives`."""
    return design.Predicted(**{name: jnp.asarray(a) for name, a in found["fields"].items()})


def traced(
    config: Config, perturbations: np.ndarray, title: str, problem: design.Problem, perturbed: Any
) -> design.AsBuilt:
    """Monte Carlo with a progress bar."""
    with tqdm(total=len(perturbations), desc=title, unit="lens", dynamic_ncols=True) as bar:
        return design.monte_carlo(
            problem,
            perturbed,
            perturbations,
            config.compensator,
            lambda done: bar.update(done - bar.n),
            mesh=_sharing.mesh_of(config.devices),
        )


def sensitivity(config: Config, found: dict[str, Any]) -> dict[str, Any]:
    """Each error alone at both limits, and all errors at the worst limits."""
    problem, perturbed = prepare(config)
    predicted, count = predicted_of(found), len(perturbed.deviations)
    worst = design.worst_case(perturbed, predicted)
    perturbations = np.concatenate(
        [-np.eye(count), np.eye(count), np.zeros((1, count)), worst[None]]
    )
    built = traced(config, perturbations, "one error", problem, perturbed)
    spots, nominal = _um(built.spot), float(_um(built.spot[-2]))
    changes = _um(predicted.at(perturbations, "second"), root=True)
    changes = changes - float(_um(predicted.nominal, True))
    moves = np.asarray(predicted.moves) + perturbations @ np.asarray(predicted.move_slopes)
    variances = design.variances(perturbed, config.errors == "normal")
    share = np.diag(np.asarray(predicted.hessian)) * variances / 2
    rows = []
    for k, error in enumerate(perturbed.deviations):
        pair = [k, count + k]
        rows.append({
            "error": str(error), "kind": error.kind, "place": error.place, "axis": error.axis,
            "size": float(perturbed.sizes[k]), "unit": KINDS[error.kind].unit,
            "predicted_um": changes[pair].tolist(),
            "traced_um": (spots[pair] - nominal).tolist(),
            "predicted_moves": (moves[pair] - moves[-2]).tolist(),
            "moves": (built.moves[pair] - built.moves[-2]).tolist(),
            "growth_um2": 1e6 * float(share[k]),
        })  # fmt: skip
    orders = {order: float(_um(predicted.at(worst, order), True)) for order in _ORDERS}
    return {"rows": rows, "nominal_um": nominal, "worst": {"traced": float(spots[-1]), **orders}}


def _um(mm: Any, root: bool = False) -> np.ndarray:
    """mm in um. root: True for squares in mm^2, of which negative ones count as 0."""
    return 1e3 * (np.sqrt(np.maximum(mm, 0)) if root else np.asarray(mm))


def monte_carlo(config: Config, found: dict[str, Any], scale: float) -> dict[str, Any]:
    """Traced and predicted spots at one scale of the sizes."""
    problem, perturbed = prepare(config)
    predicted, normal = predicted_of(found), config.errors == "normal"
    perturbations = scale * design.draw_perturbations(perturbed, config.count, config.seed, normal)
    begun = time.perf_counter()
    mesh = _sharing.mesh_of(config.devices)
    design.monte_carlo(problem, perturbed, perturbations[:1], config.compensator, mesh=mesh)
    warm = time.perf_counter()
    built = traced(config, perturbations, f"sizes x {scale:g}", problem, perturbed)
    seconds = time.perf_counter() - warm
    spots, whole = _um(built.spot), np.isfinite(built.spot)
    message = f"scales: {scale:g}: light passes through no lens; take less"
    _common.require(bool(whole.any()), message)
    draws = scale * design.draw_perturbations(perturbed, config.draws, config.seed + 1, normal)
    samples = {"traced": spots}
    samples |= {order: _um(predicted.at(draws, order), True) for order in _ORDERS}
    low, high = np.quantile(spots[whole], [0, 0.999])
    edges = np.linspace(0.98 * low, 1.1 * high, _BINS + 1)
    variances = scale**2 * design.variances(perturbed, normal)
    row: dict[str, Any] = {"scale": scale, "edges_um": edges.tolist(), "seconds": seconds}
    row |= {"compile_s": warm - begun, "failed": int(np.sum(~whole))}
    row |= {"moves_deviation": np.std(built.moves[whole], axis=0).tolist()}
    row["rays"] = design.rays_of(problem) * len(perturbations)
    for name, values in samples.items():
        finite = values[np.isfinite(values)]
        ninth = np.quantile(values, 0.9, method="higher")
        sums: dict[str, Any] = {"mean_um": float(finite.mean()), "p90_um": float(ninth)}
        sums["yields"] = [float(np.mean(values <= limit)) for limit in config.limits_um]
        sums["quantiles_um"] = np.quantile(finite, _LEVELS).tolist()
        sums["shares"] = (100 / len(values) * np.histogram(finite, edges)[0]).tolist()
        if name != "traced":
            mean, deviation = predicted.moments(variances, name)
            # Root sum of squares: the distribution of q taken as normal.
            sums["rss_p90_um"] = float(_um(mean + 1.2815516 * deviation, True))
        row[name] = sums
    return row


def run(config: Config, run: Run) -> dict[str, Any]:
    """Derivatives, then each error alone, then Monte Carlo at each scale."""
    (found,) = _common.measured(run, "step", {"derivatives": lambda: derivatives(config)})
    jobs: dict[str, Any] = {"one error": lambda: sensitivity(config, found)}
    for scale in config.scales:
        jobs[f"sizes x {scale:g}"] = functools.partial(monte_carlo, config, found, scale)
    alone, *scales = _common.measured(run, "step", jobs)
    about = {"derivatives_s": found["seconds"], "derivatives_compile_s": found["compile_s"]}
    about |= {"rule_error": found["rule_error"], "threads": os.cpu_count(), "count": config.count}
    about |= {"errors": config.errors, "limits_um": list(config.limits_um)}
    return alone | about | {"scales": scales}


def main_scale(results: dict[str, Any]) -> dict[str, Any]:
    """The row of scale 1, or of the first scale."""
    return next((row for row in results["scales"] if row["scale"] == 1), results["scales"][0])


def known(spot: float | None) -> float:
    """A spot; inf for None."""
    return math.inf if spot is None else spot


def merged(results: dict[str, Any]) -> list[dict]:
    """The largest change of each kind and part, of x and y, minus and plus; largest first."""
    found = []
    for (kind, place), some in _common.grouped(results["rows"], "kind", "place").items():
        changes = [(known(um), row, k) for row in some for k, um in enumerate(row["traced_um"])]
        change, worst, most = max(changes, key=lambda change: change[0])
        name = f"{kind}, {KINDS[kind].whole} {place}"
        row = {"name": name, "size": f"{worst['size']:g} {worst['unit']}".strip()}
        row |= {"predicted_um": worst["predicted_um"][most], "traced_um": change}
        row["move"] = max((abs(m[0]) for row in some for m in row["moves"] if m), default=0)
        row["growth"] = sum(row["growth_um2"] for row in some)
        found.append(row)
    return sorted(found, key=lambda row: -row["traced_um"])


def off_by(row: dict[str, Any], truth: float | None) -> list[str]:
    """Relative errors of the predicted spots of all orders."""
    if truth is None:
        return [""] * len(_ORDERS)
    return [f"{100 * (row[order] / truth - 1):+.1f} %" for order in _ORDERS]


def table_of_scales(results: dict[str, Any]) -> str:
    """Table of traced spots by scale, and of the errors of each order of prediction."""
    header = ["sizes times", "spot", "traced (µm)", *_ORDERS]
    lines = []
    for row in results["scales"]:
        scale, true = f"{row['scale']:g}", row["traced"]
        for key, of, words in (
            ("mean_um", "mean_um", "mean"),
            ("p90_um", "p90_um", "90 % are below"),
            ("rss_p90_um", "p90_um", "the same by RSS"),
        ):
            some = {order: row[order][key] for order in _ORDERS}
            lines.append((scale, words, _common.number(true[of], ".2f"), *off_by(some, true[of])))
    worst = results["worst"]
    lines.append(
        ("1", "worst case", _common.number(worst["traced"], ".2f"), *off_by(worst, worst["traced"]))
    )
    return _common.table(header, lines)


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
    figure, axes = _common.panels(len(results["scales"]), 5.2, 3.7)
    for ax, row in zip(axes, results["scales"]):
        parts = dict.fromkeys(_SAMPLES, 100 * _LEVELS)
        parts["traced"] = parts["traced"] * (1 - row["failed"] / results["count"])
        lines = {name: (row[name]["quantiles_um"], parts[name]) for name in _SAMPLES}
        _plots.yields(ax, lines, "spot (µm)", "lenses at least so good (%)")
        ax.set_title(f"sizes × {row['scale']:g}", fontsize=10)
        ax.set_xlim(0, 1.05 * row["traced"]["quantiles_um"][-1])
    figure.savefig(figures / "yield.png")
    some = merged(results)[:_SHOWN]
    figure, ax = show.new(1, 1, 7, 5)
    bars = {name: np.array([m[f"{name}_um"] for m in some]) for name in ("traced", "predicted")}
    names = [f"{m['name']}: {m['size']}" for m in some]
    _plots.offenders(ax, names, bars, "spot grows by (µm)")
    figure.savefig(figures / "offenders.png")
    row = main_scale(results)
    figure, ax = show.new(1, 1, 6.5, 4)
    shares = {name: np.array(row[name]["shares"]) for name in _SAMPLES}
    marks = {"nominal": results["nominal_um"], "mean": row["traced"]["mean_um"]}
    if row["traced"]["p90_um"] is not None:
        marks["90 %"] = row["traced"]["p90_um"]
    _plots.histogram(ax, np.array(row["edges_um"]), shares, marks, "spot (µm)")
    figure.savefig(figures / "histogram.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
