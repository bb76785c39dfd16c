"""Moments to a tolerance: the pupil rule that a scene needs, found by trials.

The number of rays cannot depend on the values of tracers. So inside `jax.jit` and `jax.vmap`,
`psf_moments` and `focus_moments` take a rule that `converge` made outside.

Rules are tried in rising order. Their rays are traced in tiles of a fixed size, so that rules of
all sizes share a compiled program.
"""

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..compilation import LARGE, jit
from ..inputs import require_tolerance, warn
from ..lens.lens import Lens
from ..lens.order import may_cross
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import Numbers, concrete, known_values
from ..pupil.clipped import Clipped, ClippedGroup, Fitted
from ..pupil.rules import (
    Gauss,
    Pattern,
    PupilRule,
    Symmetry,
    fits,
    gauss_points,
    planned,
    require_fit,
    rule_rays,
    symmetry_of,
)
from ..rays.known import Known, joined, tiles, trace_tile, wide
from ..rays.solve import Solver, solve, solve_aimed
from ..rays.status import Status
from ..rays.trace import Bundle, trace_bundle
from .diagnose import check_order, crossed, reasons
from .moments import FocusMoments, check_focus, weigh
from .refined import refine, require_known
from .rounding import check_dtype, hit_rounding
from .spot import Moments

# Smallest spot size that errors are taken relative to, mm: below 1 nm rounding would prevent
# convergence.
_SMALLEST = 1e-6
# Order of the rule that finds out why no light arrives.
_DIAGNOSIS = 8
# Default relative error of the RMS spot size.
_TOLERANCE = 1e-6
_MAX_ORDER = 40
# Orders for a clipped pupil and their sizes (`Clipped.size`). Three orders form a group, because
# three must agree and one search finds the points of all three. Groups of equal sizes share a
# compiled program.
_CLIPPED = (
    ((4, 5, 6), (10, 11, 12)),
    ((7, 8, 9), (10, 11, 12)),
    ((10, 11, 12), (10, 11, 12)),
    ((14, 17, 20), (14, 17, 20)),
    ((24, 28, 32), (36, 39, 42)),
    ((36, 39, 42), (36, 39, 42)),
)
# Numbers of rays that patterns are padded to, so that only a few programs are compiled.
_SIZES = {"rotational": (_MAX_ORDER + 2,), "bilateral": (208, 416, 1768, 3696)}
_SIZES["none"] = _SIZES["bilateral"]
# Number of rules whose moments one program computes: the orders of a clipped group.
_AT_ONCE = 3


def psf_moments(lens: Lens, scene: Scene, sampling: float | PupilRule | None = None) -> Moments:
    """Centroid, covariance and throughput of the rays on the sensor. Paper section 4.3.

    lens, scene: the lens, and object points with their wavelengths.
    sampling: a tolerance, the relative error of the RMS spot size, from which a pupil rule is
        chosen; or a pupil rule, which is needed inside `jax.jit` and `jax.vmap`: `converge` makes
        one outside. None: 1e-6 or what the dtype allows, of which it warns. In float32 the error of
        a camera's spot is about 1e-3 of its size or of 4 um.

    Returns `Moments`, with the points of the scene as first axes. Rays fill the stop uniformly.
    Differentiable in every mode, in the lens and the scene. ValueError as in
    `lens.scene.checked_scene`, for a tolerance that the dtype does not allow, and if no ray of a
    wavelength arrives, with the surfaces that stop its light. Inside a trace its `throughput` is
    then 0 and its covariance inf.
    """
    return _moments(lens, scene, sampling, at_sensor).at(lens.sensor)


def focus_moments(
    lens: Lens, scene: Scene, sampling: float | PupilRule | None = None
) -> FocusMoments:
    """Moments of the rays as functions of the sensor position; the sensor is flat.

    lens, scene: as in `psf_moments`.
    sampling: as there, but a tolerance holds at every sensor position.

    Returns `FocusMoments`. ValueError as in `psf_moments`, for an afocal lens, and for an element
    that rotates surfaces about the sensor.
    """
    check_focus(lens)
    return _moments(lens, scene, sampling, best_focus)


def converged_rule(lens: Lens, scene: Scene, tolerance: float | None = None) -> PupilRule:
    """The pupil rule that keeps the relative error of the RMS spot size on the sensor within a
    tolerance, for every point of a scene.

    lens, scene, tolerance: as in `psf_moments`.

    Returns a Gauss rule on the stop or, if rays are clipped or fail, a rule fitted to the rest of
    the pupil. It is the first order whose covariance, relative to its trace, differs from those of
    the next two orders by at most the tolerance; two orders alone may agree by accident. Warns if
    no order does. ValueError inside a trace, or if no ray arrives.
    """
    return find_rule(lens, scene, tolerance, at_sensor).rule


def converged_focus_rule(lens: Lens, scene: Scene, tolerance: float | None = None) -> PupilRule:
    """`converged_rule` for every sensor position: the tolerance also holds where the spot is
    smallest.

    lens, scene, tolerance: as in `converged_rule`.

    ValueError as in `focus_moments`.
    """
    check_focus(lens)
    return find_rule(lens, scene, tolerance, best_focus).rule


def at_sensor(spread: np.ndarray) -> list[np.ndarray]:
    """Sensor positions where the tolerance must hold: at the sensor, (W,) zeros, mm from the
    reference."""
    return [np.zeros(spread.shape[1])]


def best_focus(spread: np.ndarray) -> list[np.ndarray]:
    """Sensor positions where the tolerance must hold, (W,) mm from the reference: at the sensor,
    and where the spot of each wavelength is smallest. The variance c + b d + a d^2 has its minimum
    at d = -b / (2 a).

    spread: (3, W, C), as in `FocusMoments`.
    """
    _, linear, square = np.sum(spread[..., :2], axis=-1)
    return [*at_sensor(spread), -linear / np.where(square > 0, 2 * square, 1)]


def _moments(
    lens: Lens, scene: Scene, sampling: float | PupilRule | None, places: Callable
) -> FocusMoments:
    """`psf_moments` and `focus_moments`; `places` is `at_sensor` or `best_focus`."""
    if not isinstance(sampling, PupilRule):
        trial = find_rule(lens, scene, sampling, places)
        scene = checked_scene(lens, scene)
        if concrete((lens, scene)):
            return _stacked(trial.moments, scene)
        # The rays are already found: only weigh them, with derivatives.
        pairs = zip(scene.each(), trial.known, strict=True)
        return _stacked([_weigh(lens, one, trial.used, known) for one, known in pairs], scene)
    scene, rule = checked_scene(lens, scene), sampling
    require_fit(rule.symmetry, scene.field)
    found = _weigh(lens, scene, rule, rule_rays(lens, scene, rule))
    throughput = known_values(found.throughput)
    if throughput is not None:
        _require_light(lens, scene, rule.symmetry, throughput)
    return found


def _stacked(each: Sequence[FocusMoments], scene: Scene) -> FocusMoments:
    """Moments of the points of a scene with its shape as first axes."""
    if not scene.shape:
        return jax.tree.map(jnp.asarray, each[0])
    joined = lambda *values: jnp.stack(values).reshape(*scene.shape, *values[0].shape)  # noqa: E731
    return jax.tree.map(joined, *each)


@partial(jit, wanted=LARGE)
def _weigh(lens: Lens, scene: Scene, rule: PupilRule, known: Known) -> FocusMoments:
    """Moments of a rule: traces its rays and weighs them."""

    def one(point: Scene, known: Known) -> FocusMoments:
        points, weights = rule.points(lens, point, known.plan)
        weights = jnp.where(fits(rule.symmetry, point.field), weights, 0)
        return weigh(lens, rule, weights, trace_bundle(lens, point, points, known))

    return over_points(one, scene, known)


class _Trial(NamedTuple):
    """A rule tried on scenes.

    rule: the rule.
    used: the rule as it was evaluated, with points of other orders and padding, which have weight
        0.
    moments: its moments of each scene, NumPy arrays.
    known: its rays of each scene.
    """

    rule: Gauss | Clipped
    used: PupilRule
    moments: tuple[FocusMoments, ...]
    known: tuple[Known, ...]


def find_rule(
    lens: Lens, scene: Scene, tolerance: float | None, places: Callable, warns: bool = True
) -> _Trial:
    """Finds the rule that meets a tolerance for all points of a scene.

    lens, scene: the lens and the scene.
    tolerance: relative error of the RMS spot size, see `psf_moments`.
    places: `at_sensor` or `best_focus`.
    warns: whether it warns of rounding, or refuses a tolerance because of it.

    Returns the trial of that rule. ValueError inside a trace.
    """
    asked = tolerance is not None
    tolerance = require_tolerance(tolerance if asked else _TOLERANCE)
    known = require_known((lens, scene), "the number of rays", "psf_moments")
    # `eval_context` leaves any trace that this is called in, so all that follows is known.
    with jax.core.eval_context():
        lens, scene = known
        scene = checked_scene(lens, scene)
        eps = float(jnp.finfo(lens.curvature.dtype).eps)

        def rounding(trial: _Trial) -> float:
            """Relative rounding error of the smallest spot."""
            areas = (np.min(np.sum(one.spread[0, :, :2], axis=-1)) for one in trial.moments)
            return hit_rounding(lens) / max(float(np.sqrt(min(areas))), _SMALLEST)

        def error(*trials: _Trial) -> float:
            """Change between three successive orders; 0 if rounding hides it."""
            if len({type(trial.rule) for trial in trials}) > 1:
                return np.inf  # a Gauss rule on the stop is no order of a fitted one
            first, *later = trials
            change = max(_change(first, one, places) for one in later)
            return change if change > max(100 * eps, 2 * rounding(later[-1])) else 0.0

        tried = _trials(lens, scene.each(), symmetry_of(lens, scene.field))
        trials, change = refine(tried, error, tolerance, together=3)
        if change > tolerance:
            warn(
                f"the spot size has converged to {change:.1e} only, not to {tolerance:.1e}, "
                f"with the order {trials[-1].rule.order}; does the edge of the beam fail?"
                f"{crossed(lens)}"
            )
            return trials[-1]
        rounded = rounding(trials[-1])
        if warns:
            check_dtype(lens, "the spot", rounded, tolerance, " of its size", asked)
        # If rounding hides the differences, take the last of the three.
        return trials[-1 if 2 * rounded > tolerance else 0]


def _trials(lens: Lens, scenes: Sequence[Scene], symmetry: Symmetry) -> Iterator[_Trial]:
    """Tries rules on scenes, in rising order: Gauss rules on the stop and, from the order on for
    which a ray fails or is clipped, rules fitted to the open part of the pupil."""
    # The rays of a rule on the whole stop may all pass by a small obscuration.
    blocked = lens.apertures is not None and any(lens.apertures.blocks)
    solver: Solver = solve_aimed
    for clipped in (False, True)[blocked:]:
        for group in _rules_by_order(lens, symmetry, clipped):
            trace = partial(_trace_all, lens, scenes, group.traced)
            rays, failing, cut = trace(solver)
            if failing and solver is solve_aimed and (clipped or not cut):
                solver = solve  # aiming failed for some rays: search for them
                rays, failing, cut = trace(solver)
            if failing and solver is solve:
                check_order(lens)
            if (failing or cut) and not clipped:
                break
            yield from _weighed(lens, scenes, group, rays)
        else:
            return


def _trace_all(
    lens: Lens, scenes: Sequence[Scene], rule: PupilRule, solver: Solver
) -> tuple[list["_Traced"], bool, bool]:
    """Rays of a rule for all scenes; whether a ray fails; and whether one is clipped."""
    rays = [_trace_rule(lens, scene, rule, solver) for scene in scenes]
    return rays, any(one.failing for one in rays), any(one.cut for one in rays)


def _weighed(
    lens: Lens, scenes: Sequence[Scene], group: "_Group", rays: Sequence["_Traced"]
) -> Iterator[_Trial]:
    """Trials of the rules of a group, from its traced rays. ValueError if no light of a
    wavelength arrives."""
    known = tuple(one.known for one in rays)
    for start in range(0, len(group.rules), _AT_ONCE):
        batch = group.rules[start : start + _AT_ONCE]
        each = [_weigh_rules(lens, [used for _, used in batch], one) for one in rays]
        for (rule, used), *moments in zip(batch, *each, strict=True):
            for scene, one in zip(scenes, moments, strict=True):
                _require_light(lens, scene, rule.symmetry, one.throughput)
            yield _Trial(rule, used, tuple(moments), known)


def _change(before: _Trial, now: _Trial, places: Callable) -> float:
    """Largest change of a covariance from one trial to another, relative to its trace, at the
    sensor positions `places`."""
    worst = 0.0
    for pair in zip(now.moments, before.moments, strict=True):
        spreads = [np.asarray(found.spread, float) for found in pair]
        for place in places(spreads[0]):
            d = place[:, None]
            new, old = (s[0] + d * (s[1] + d * s[2]) for s in spreads)
            size = np.sum(new[:, :2], axis=-1, keepdims=True)
            worst = max(worst, float(np.max(np.abs(new - old) / np.maximum(size, _SMALLEST**2))))
    return worst


def _require_light(lens: Lens, scene: Scene, symmetry: Symmetry, throughput: Numbers) -> None:
    """ValueError if no light of a wavelength of a point arrives, with the surfaces where it ends.

    throughput: (..., W), known.
    """
    dark = np.argwhere(~(np.asarray(throughput).reshape(-1, scene.wavelengths.size) > 0))
    if not len(dark):
        return
    point, wavelength = dark[0].tolist()
    lens, scene = known_values((lens, scene))
    with jax.core.eval_context():
        # In an eager gradient the values were not known before, so check them now.
        checked_scene(lens, scene)
        scene = scene.each()[point]
        rule = Pattern(*gauss_points(_DIAGNOSIS, symmetry), symmetry)
        bundle = _trace_rule(lens, scene, rule, solve).bundle
        raise ValueError(
            f"no ray at {float(scene.wavelengths[wavelength]):g} um reaches the sensor: "
            f"{reasons(lens, scene, rule, bundle, wavelength)}{crossed(lens)}; see "
            "trace_rays(...).status"
        )


class _Group(NamedTuple):
    """Rules that are traced together.

    traced: a rule that has the points of all of them.
    rules: pairs of each rule and a rule with the points of `traced` in which only its own points
        have weight.
    """

    traced: Pattern | ClippedGroup
    rules: Sequence[tuple[Gauss | Clipped, Pattern | ClippedGroup]]


def _rules_by_order(lens: Lens, symmetry: Symmetry, clipped: bool) -> Iterator[_Group]:
    """Rules in rising order, in groups.

    lens: the lens.
    symmetry: of the rules, see `symmetry_of`.
    clipped: whether the rules are fitted to the open part of a clipped pupil.
    """
    if not clipped:
        order = 2
        while order <= _MAX_ORDER + 1:
            yield (group := _gauss_group(order, symmetry))
            order = group.rules[-1][0].order + 1
        return
    crossing = may_cross(lens)
    for orders, sizes in _CLIPPED:
        rules = [Clipped(n, symmetry, n, crossing) for n in orders]
        traced, *own = (
            ClippedGroup(np.array(orders, np.int32), np.int32(k), sizes, symmetry, crossing)
            for k in range(-1, len(orders))
        )
        yield _Group(traced, [*zip(rules, own)])


@cache
def _gauss_group(first: int, symmetry: Symmetry) -> _Group:
    """The Gauss rule of an order, and those of the next orders as long as all their points
    together are at most half of the smallest size. The pattern is padded with rays of weight 0
    along the rim of the stop, where clear apertures clip first."""
    sizes, rules = _SIZES[symmetry], [gauss_points(first, symmetry)]
    total, order = rules[0][1].size, first + 1
    while total + (following := gauss_points(order, symmetry))[1].size <= sizes[0] / 2:
        rules.append(following)
        total, order = total + following[1].size, order + 1
    columns = rules[0][0].shape[1]
    size = next(size for size in sizes if size >= total + columns)
    missing = size - total
    span = np.pi if symmetry == "bilateral" else 2 * np.pi
    angle = np.linspace(-np.pi / 2, span - np.pi / 2, missing)
    rim = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rim = rim if columns == 2 else np.ones((missing, 1))
    points = np.concatenate([*(p for p, _ in rules), rim])
    found, start = [], 0
    for k, (_, weights) in enumerate(rules):
        padded = np.pad(weights, (start, size - start - weights.size))
        found.append((Gauss(first + k, symmetry), Pattern(points, padded, symmetry)))
        start += weights.size
    return _Group(found[0][1], found)


class _Traced(NamedTuple):
    """Traced rays of a rule.

    weights: (1 or W, Q), weights of the rule.
    bundle: the rays.
    known: their hits on the active surfaces; MISSED for rays that were not traced.
    failing: True if a ray fails.
    cut: True if a ray is clipped.
    """

    weights: np.ndarray
    bundle: Bundle
    known: Known
    failing: bool
    cut: bool


def _trace_rule(lens: Lens, scene: Scene, rule: PupilRule, solver: Solver) -> _Traced:
    """Traces the rays of a rule. Rays of weight 0 are left out if the rule is fitted to a
    clipped pupil."""
    points, weights, plan = jax.tree.map(np.asarray, planned(lens, scene, rule))
    total = weights.shape[-1]
    # Rays of weight 0 are padding in fitted rules. In other rules they show whether light is
    # clipped.
    fitted = isinstance(rule, Fitted)
    rays = np.flatnonzero(np.any(weights, axis=0)) if fitted else np.arange(total)
    parts = tiles(wide(scene, points)[..., rays if len(rays) else [0]])
    traced = joined((trace_tile(lens, scene, (*own,), solver) for own in parts), len(rays))

    def whole(known: np.ndarray) -> np.ndarray:  # from rays that were traced to all Q
        if not known.ndim or len(rays) == total:
            return known
        blank = Status.MISSED if known.dtype == np.int32 else 0
        found = np.full((*known.shape[:-1], total), blank, known.dtype)
        found[..., rays] = known
        return found

    bundle, found = jax.tree.map(whole, traced)
    status = traced[0].status
    cut = status == Status.CLIPPED
    failing = np.any((status != Status.OK) & ~cut)
    return _Traced(weights, bundle, Known(found, plan), bool(failing), bool(np.any(cut)))


def _weigh_rules(
    lens: Lens, rules: Sequence[Pattern | ClippedGroup], traced: _Traced
) -> list[FocusMoments]:
    """Moments, as NumPy arrays, of traced rays by several rules.

    lens: the lens.
    rules: up to `_AT_ONCE` rules with the points of the rule that the rays were traced for: orders
        of the group, or patterns.
    traced: the rays.
    """

    def own(rule: Pattern | ClippedGroup) -> np.ndarray:
        """Weights (1 or W, Q) of one rule."""
        if isinstance(rule, ClippedGroup):
            return np.where(rule.own(lens)[None], traced.weights, 0)
        return np.asarray(rule.weights, lens.curvature.dtype)[None]

    # Always `_AT_ONCE` rules, so that all calls share a program.
    weights = np.stack([own(rules[min(k, len(rules) - 1)]) for k in range(_AT_ONCE)])
    found = jax.tree.map(np.asarray, _weigh_each(lens, rules[0], weights, traced.bundle))
    return [jax.tree.map(lambda a: a[k], found) for k in range(len(rules))]


_weigh_each = jit(jax.vmap(weigh, (None, None, 0, None)), LARGE)
