"""Moments to a tolerance: the pupil rule that a scene needs, found by trials.

The number of rays cannot depend on the values of tracers. So inside `jax.jit` and `jax.vmap`,
`psf_moments` and `focus_moments` take a rule that `converge` made outside.
"""

import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..compilation import LARGE, jit
from ..inputs import require_tolerance
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import Numbers, concrete, known_values
from ..pupil.clipped import Clipped
from ..pupil.rules import (
    Gauss,
    Pattern,
    PupilRule,
    Symmetry,
    fits,
    gauss_points,
    require_fit,
    symmetry_of,
)
from ..rays.find import Found
from ..rays.solve import Solver, reattach, solve, solve_aimed
from ..rays.trace import aims, bundle_of, trace_bundle
from .diagnose import check_order, crossed, reasons
from .moments import FocusMoments, check_focus, weigh
from .orders import Group, rules_by_order
from .rounding import hit_rounding, warn_dtype
from .spot import Moments
from .tiles import AT_ONCE, Traced, trace_rule, weigh_rules

# Smallest spot size that errors are taken relative to, mm: below 1 nm rounding would prevent
# convergence.
_SMALLEST = 1e-6
# Order of the rule that finds out why no light arrives.
_DIAGNOSIS = 8

# Default relative error of the RMS spot size.
_TOLERANCE = 1e-6


def psf_moments(lens: Lens, scene: Scene, sampling: float | PupilRule = _TOLERANCE) -> Moments:
    """Centroid, covariance and throughput of the rays on the sensor. Paper section 4.3.

    lens, scene: the lens, and object points with their wavelengths.
    sampling: a tolerance, the relative error of the RMS spot size, from which a pupil rule is
        chosen; or a pupil rule, which is needed inside `jax.jit` and `jax.vmap`: `converge` makes
        one outside. In float32 the error of a camera's spot is about 1e-3 of its size or of 4 um;
        warns if that is above the tolerance.

    Returns `Moments`, with the points of the scene as first axes. Rays fill the stop uniformly.
    Differentiable in every mode, in the lens and the scene. ValueError as in
    `lens.scene.checked_scene`, and if no ray of a wavelength arrives, with the surfaces that stop
    its light. Inside a trace its `throughput` is then 0 and its covariance inf.
    """
    found = _moments(lens, scene, sampling, at_sensor)
    return found.at(lens.sensor)


def focus_moments(
    lens: Lens, scene: Scene, sampling: float | PupilRule = _TOLERANCE
) -> FocusMoments:
    """Moments of the rays as functions of the sensor position; the sensor is flat.

    lens, scene: as in `psf_moments`.
    sampling: as there, but a tolerance holds at every sensor position.

    Returns `FocusMoments`. ValueError as in `psf_moments`, for an afocal lens, and for an element
    that rotates surfaces about the sensor.
    """
    check_focus(lens)
    return _moments(lens, scene, sampling, best_focus)


def converged_rule(lens: Lens, scene: Scene, tolerance: float = _TOLERANCE) -> PupilRule:
    """The pupil rule that keeps the relative error of the RMS spot size on the sensor within a
    tolerance, for every point of a scene.

    lens, scene, tolerance: as in `psf_moments`.

    Returns a Gauss rule on the stop or, if rays are clipped or fail, a rule fitted to the rest of
    the pupil. It is the first order whose covariance, relative to its trace, differs from those of
    the next two orders by at most the tolerance; two orders alone may agree by accident. Warns if
    no order does. ValueError inside a trace, or if no ray arrives.
    """
    return find_rule(lens, scene, tolerance, at_sensor).rule


def converged_focus_rule(lens: Lens, scene: Scene, tolerance: float = _TOLERANCE) -> PupilRule:
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
    lens: Lens, scene: Scene, sampling: float | PupilRule, places: Callable
) -> FocusMoments:
    """`psf_moments` and `focus_moments`; `places` is `at_sensor` or `best_focus`."""
    if not isinstance(sampling, PupilRule):
        trial = find_rule(lens, scene, sampling, places)
        scene = checked_scene(lens, scene)
        if concrete((lens, scene)):
            return _stacked(trial.moments, scene)
        # The rays are already found: only weigh them, with derivatives.
        pairs = zip(scene.each(), trial.found, strict=True)
        return _stacked([_weigh_known(lens, one, trial.used, found) for one, found in pairs], scene)
    scene, rule = checked_scene(lens, scene), sampling
    require_fit(rule.symmetry, scene.field)
    found = _weigh(lens, scene, rule)
    throughput = known_values(found.throughput)
    if throughput is not None and not np.all(np.asarray(throughput) > 0):
        dark = np.min(np.asarray(throughput).reshape(-1, len(scene.wavelengths)), axis=1)
        worst = int(np.argmin(dark))
        light = np.asarray(throughput).reshape(len(dark), -1)[worst]
        _no_light(lens, scene.each()[worst], rule.symmetry, light)
    return found


def _stacked(each: Sequence[FocusMoments], scene: Scene) -> FocusMoments:
    """Moments of the points of a scene with its shape as first axes."""
    if not scene.shape:
        return jax.tree.map(jnp.asarray, each[0])
    joined = lambda *values: jnp.stack(values).reshape(*scene.shape, *values[0].shape)  # noqa: E731
    return jax.tree.map(joined, *each)


@partial(jit, wanted=LARGE)
def _weigh(lens: Lens, scene: Scene, rule: PupilRule) -> FocusMoments:
    """Moments of a rule: traces its rays and weighs them."""

    def one(point: Scene) -> FocusMoments:
        points, weights = rule.points(lens, point)
        weights = jnp.where(fits(rule.symmetry, point.field), weights, 0)
        return weigh(lens, rule, weights, trace_bundle(lens, point, points))

    return over_points(one, scene)


@jax.jit
def _weigh_known(lens: Lens, scene: Scene, rule: PupilRule, found: Found) -> FocusMoments:
    """Moments, with derivatives, of rays that were found before; no search."""
    points, weights = rule.points(lens, scene)
    system, target = aims(lens, scene, points)
    bundle = bundle_of(lens, scene, system, target, reattach(found, system, target))
    return weigh(lens, rule, weights, bundle)


class _Trial(NamedTuple):
    """A rule tried on scenes.

    rule: the rule.
    used: the rule as it was evaluated, with points of other orders and padding, which have weight
        0.
    moments: its moments of each scene, NumPy arrays.
    found: its rays of each scene.
    """

    rule: Gauss | Clipped
    used: PupilRule
    moments: tuple[FocusMoments, ...]
    found: tuple[Found, ...]


def find_rule(
    lens: Lens, scene: Scene, tolerance: float, places: Callable, warns: bool = True
) -> _Trial:
    """Finds the rule that meets a tolerance for all points of a scene.

    lens, scene: the lens and the scene.
    tolerance: relative error of the RMS spot size.
    places: `at_sensor` or `best_focus`.
    warns: whether it warns of rounding.

    Returns the trial of that rule. ValueError inside a trace.
    """
    tolerance = require_tolerance(tolerance)
    known = known_values((lens, scene))
    if known is None:
        raise ValueError(
            "inside jax.jit or jax.vmap the number of rays cannot follow from a tolerance: make "
            "the rule outside and pass it on, sampling=drt_jax.converge(drt_jax.psf_moments, lens, "
            "scene, tolerance)"
        )
    # `eval_context` leaves any trace that this is called in, so all that follows is known.
    with jax.core.eval_context():
        lens, scene = known
        scene = checked_scene(lens, scene)
        symmetry = symmetry_of(lens, scene.field)
        return _try_orders(lens, scene.each(), symmetry, tolerance, places, warns)


def _try_orders(
    lens: Lens, scenes: Sequence[Scene], symmetry: Symmetry, tolerance: float, places: Callable,
    warns: bool
) -> _Trial:  # fmt: skip
    """The trial of the first of three successive orders that agree. Gauss rules on the stop are
    tried first; if a ray fails or is clipped, rules fitted to the open part of the pupil."""
    # The rays of a rule on the whole stop may all pass by a small obscuration.
    blocked = lens.apertures is not None and any(lens.apertures.blocks)
    solver: Solver = solve_aimed
    for clipped in (False, True)[blocked:]:
        trials: list[_Trial] = []
        for group in rules_by_order(lens, symmetry, clipped):
            trace = partial(_trace, lens, scenes, group.traced)
            rays, failing, cut = trace(solver)
            if failing and solver is solve_aimed and (clipped or not cut):
                solver = solve  # aiming failed for some rays: search for them
                rays, failing, cut = trace(solver)
            if failing and solver is solve:
                check_order(lens)
            if (failing or cut) and not clipped:
                break
            for trial in _weighed(lens, scenes, group, rays):
                trials = [*trials, trial][-3:]
                changes = (_change(trials[0], later, places) for later in trials[1:])
                change = max(changes, default=np.inf)
                rounded = max(_rounding(lens, found) for found in trial.moments)
                if len(trials) == 3 and change <= max(tolerance, 100 * _eps(lens), 2 * rounded):
                    if warns:
                        warn_dtype(lens, "the spot", rounded, tolerance, " of its size", 4)
                    # If rounding hides the differences, take the last of the three.
                    return trials[-1 if 2 * rounded > tolerance else 0]
        else:
            break
    warnings.warn(
        f"the spot size has converged to {change:.1e} only, not to {tolerance:.1e}, with "
        f"the order {trials[-1].rule.order}; does the edge of the beam fail?{crossed(lens)}",
        stacklevel=4,
    )
    return trials[-1]


def _trace(
    lens: Lens, scenes: Sequence[Scene], used: PupilRule, solver: Solver
) -> tuple[list[Traced], bool, bool]:
    """Rays of a rule for all scenes; whether a ray fails; and whether one is clipped."""
    rays = [trace_rule(lens, scene, used, solver) for scene in scenes]
    return rays, any(one.failing for one in rays), any(one.cut for one in rays)


def _weighed(
    lens: Lens, scenes: Sequence[Scene], group: Group, rays: Sequence[Traced]
) -> Iterator[_Trial]:
    """Trials of the rules of a group, from its traced rays. ValueError if no light of a
    wavelength arrives."""
    found = tuple(one.found for one in rays)
    for start in range(0, len(group.rules), AT_ONCE):
        batch = group.rules[start : start + AT_ONCE]
        each = [weigh_rules(lens, [used for _, used in batch], one) for one in rays]
        for (rule, used), *moments in zip(batch, *each, strict=True):
            for scene, one in zip(scenes, moments, strict=True):
                if not np.all(one.throughput > 0):
                    _no_light(lens, scene, rule.symmetry, one.throughput)
            yield _Trial(rule, used, tuple(moments), found)


def _eps(lens: Lens) -> float:
    """Machine epsilon of the lens's dtype."""
    return float(jnp.finfo(lens.curvature.dtype).eps)


def _rounding(lens: Lens, found: FocusMoments) -> float:
    """Relative rounding error of the smallest spot."""
    size = np.sqrt(np.min(np.sum(np.asarray(found.spread)[0, :, :2], axis=-1)))
    return hit_rounding(lens) / max(float(size), _SMALLEST)


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


def _no_light(lens: Lens, scene: Scene, symmetry: Symmetry, throughput: Numbers) -> None:
    """Raises the ValueError that names the surfaces where the light of a wavelength without
    throughput ends.

    throughput: (W,).
    """
    wavelength = int(np.argmin(np.asarray(throughput) > 0))
    lens, scene = known_values((lens, scene))
    with jax.core.eval_context():
        # In an eager gradient the values were not known before, so check them now.
        checked_scene(lens, scene)
        rule = Pattern(*gauss_points(_DIAGNOSIS, symmetry), symmetry)
        found = trace_rule(lens, scene, rule, solve).found
        raise ValueError(
            f"no ray at {float(scene.wavelengths[wavelength]):g} um reaches the sensor: "
            f"{reasons(lens, scene, rule, found, wavelength)}{crossed(lens)}; see "
            "trace_rays(...).status"
        )
