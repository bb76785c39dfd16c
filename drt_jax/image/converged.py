"""Moments to a tolerance: the pupil rule that a scene needs, found by trials.

A trace cannot choose a number of rays from values: inside `jax.jit` and `jax.vmap`, `psf_moments`
and `focus_moments` take a rule that was made outside.
"""

import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, field_array, scene_of
from ..numerics import Numbers, concrete, known_values, real_array
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

# Smallest spot, mm: below 1 nm rounding would never converge.
_SMALLEST = 1e-6
# Order of the rule that finds where light ends.
_DIAGNOSIS = 8

# Default relative error of the RMS spot size.
_TOLERANCE = 1e-6


def psf_moments(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    tolerance: float | None = None,
    rule: PupilRule | None = None,
) -> Moments:
    """Centroid, covariance and throughput of the rays on the sensor. Paper section 4.3.

    field: angle along y, or (x, y), radians.
    distance: from the object plane to the first vertex, inf allowed, mm.
    wavelengths: (W,), um.
    tolerance: relative error of the RMS spot size, 1e-6 by default, which chooses the rule. In
        float32 the error of a camera's spot is about 1e-3 of its size or of 4 um; warns if that is
        above the tolerance.
    rule: pupil rule instead of a tolerance; needed inside `jax.jit` and `jax.vmap`: make it outside
        with `converged_rule`.

    Rays fill the stop uniformly. Differentiable in every mode, in the lens, field, distance and
    wavelengths. ValueError as in `scene_of`, and if no ray of a wavelength arrives, with where its
    light ends; inside a trace its `throughput` is then 0 and its covariance inf.
    """
    found = _moments(lens, field, distance, wavelengths, tolerance, rule, at_sensor)
    return found.at(lens.sensor)


def focus_moments(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    tolerance: float | None = None,
    rule: PupilRule | None = None,
) -> FocusMoments:
    """Moments of the rays as functions of the sensor position; the sensor is flat.

    Arguments as in `psf_moments`, but the tolerance holds at every sensor position, and
    `converged_focus_rule` makes the rule. ValueError also for an afocal lens, and for an element
    that rotates surfaces about the sensor.
    """
    check_focus(lens)
    return _moments(lens, field, distance, wavelengths, tolerance, rule, best_focus)


def converged_rule(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    tolerance: float = _TOLERANCE,
) -> PupilRule:
    """The rule that keeps the relative error of the RMS spot size on the sensor within a tolerance,
    for every field at every distance.

    field: angle along y, or (x, y), or many pairs (F, 2), radians.
    distance: one or (Z,), mm.
    wavelengths, tolerance: as in `psf_moments`.

    A Gauss rule on the stop; if rays are clipped or fail, a rule fitted to the rest. It is the
    first order whose covariance, relative to its trace, differs from those of the next two orders
    by at most the tolerance: two alone may agree by accident. Warns if no order does. ValueError
    inside a trace, or if no ray arrives.
    """
    seen = field, distance, wavelengths
    return converge(scenes_of, lens, seen, tolerance, at_sensor).rule


def converged_focus_rule(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    tolerance: float = _TOLERANCE,
) -> PupilRule:
    """`converged_rule` for every sensor position: the tolerance also holds where the spot is
    smallest. ValueError as in `focus_moments`."""
    check_focus(lens)
    seen = field, distance, wavelengths
    return converge(scenes_of, lens, seen, tolerance, best_focus).rule


def at_sensor(spread: np.ndarray) -> list[np.ndarray]:
    """Where the tolerance must hold: at the sensor, (W,) 0 mm from the reference."""
    return [np.zeros(spread.shape[1])]


def best_focus(spread: np.ndarray) -> list[np.ndarray]:
    """Where the tolerance must hold: at the sensor, and where the spot of each wavelength is
    smallest, (W,) mm behind the reference."""
    _, linear, square = np.sum(spread[..., :2], axis=-1)
    return [*at_sensor(spread), -linear / np.where(square > 0, 2 * square, 1)]


def _moments(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    tolerance: float | None,
    rule: PupilRule | None,
    places: Callable,
) -> FocusMoments:
    if not (tolerance is None or rule is None):
        raise ValueError("tolerance and rule: give one of them; a rule has its own precision")
    if rule is None:
        tolerance = _TOLERANCE if tolerance is None else tolerance
        seen = field, distance, wavelengths
        trial = converge(lambda *one: [scene_of(*one)], lens, seen, tolerance, places)
        if concrete((lens, seen)):
            return jax.tree.map(jnp.asarray, trial.moments[0])
        # The rays are known: only weigh and differentiate them.
        scene = scene_of(lens, field, distance, wavelengths)
        return _weigh_known(lens, scene, trial.used, trial.found[0])
    scene = scene_of(lens, field, distance, wavelengths)
    require_fit(rule.symmetry, scene.field)
    found = _weigh(lens, scene, rule)
    throughput = known_values(found.throughput)
    if throughput is not None and not np.all(np.asarray(throughput) > 0):
        _say_why(lens, scene, rule.symmetry, throughput)
    return found


@partial(jit, wanted=LARGE)
def _weigh(lens: Lens, scene: Scene, rule: PupilRule) -> FocusMoments:
    """Moments of a rule."""
    points, weights = rule.points(lens, scene)
    weights = jnp.where(fits(rule.symmetry, scene.field), weights, 0)
    return weigh(lens, rule, weights, trace_bundle(lens, scene, points))


@jax.jit
def _weigh_known(lens: Lens, scene: Scene, rule: PupilRule, found: Found) -> FocusMoments:
    """Moments of known rays with derivatives, without a search."""
    points, weights = rule.points(lens, scene)
    system, target = aims(lens, scene, points)
    bundle = bundle_of(lens, scene, system, target, reattach(found, system, target))
    return weigh(lens, rule, weights, bundle)


class _Trial(NamedTuple):
    """A rule tried on scenes.

    rule: the rule.
    used: the rule as it was evaluated, with points of other orders and padding.
    moments: its moments of each scene, NumPy arrays.
    found: its rays of each scene.
    """

    rule: Gauss | Clipped
    used: PupilRule
    moments: tuple[FocusMoments, ...]
    found: tuple[Found, ...]


def scenes_of(lens: Lens, field: Numbers, distance: Numbers, wavelengths: Numbers) -> list[Scene]:
    """A scene of each field at each distance."""
    lens.check()
    dtype = lens.curvature.dtype
    fields = _each(field_array(field, dtype), 2)
    distances = _each(real_array("distance", distance, dtype), 1)
    return [scene_of(lens, *pair, wavelengths) for pair in itertools.product(fields, distances)]


def _each(values: Array, rank: int) -> list[Array]:
    """Rows of an array of a rank; for another rank the array itself."""
    return [*values] if values.ndim == rank and values.size else [values]


def converge(
    make: Callable[..., list[Scene]],
    lens: Lens,
    seen: tuple[Numbers, Numbers, Numbers],
    tolerance: float,
    places: Callable,
    says: bool = True,
) -> _Trial:
    """The rule that meets the tolerance, as tried, for the scenes that `make` makes of fields,
    distances and wavelengths `seen`. says: whether it warns of rounding."""
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}")
    known = known_values((lens, seen))
    if known is None:
        raise ValueError(
            "inside jax.jit or jax.vmap the number of rays cannot follow from a tolerance: make "
            "the rule outside and pass it on, rule=drt_jax.converged_rule(lens, field, distance, "
            "wavelengths, tolerance)"
        )
    # Outside of any trace, even if this is called inside one: all that follows is known.
    with jax.core.eval_context():
        lens, seen = known
        scenes = make(lens, *seen)
        return _try_orders(lens, scenes, symmetry_of(lens, seen[0]), tolerance, places, says)


def _try_orders(
    lens: Lens, scenes: Sequence[Scene], symmetry: Symmetry, tolerance: float, places: Callable,
    says: bool
) -> _Trial:  # fmt: skip
    """The first of three orders that agree: of Gauss rules or, if a ray fails or is clipped, of
    rules fitted to the rest of the light."""
    # A rule on the whole stop may miss an obscuration.
    blocked = lens.apertures is not None and any(lens.apertures.blocks)
    solver: Solver = solve_aimed
    for clipped in (False, True)[blocked:]:
        trials: list[_Trial] = []
        for group in rules_by_order(lens, symmetry, clipped):
            trace = partial(_trace, lens, scenes, group.traced)
            rays, failing, cut = trace(solver)
            if failing and solver is solve_aimed and (clipped or not cut):
                solver = solve  # some rays must be searched for
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
                    if says:
                        warn_dtype(lens, "the spot", rounded, tolerance, " of its size", 4)
                    # If rounding hides their difference, take the last.
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
    """The rays of a rule for all scenes, whether a ray fails, and whether one is clipped."""
    rays = [trace_rule(lens, scene, used, solver) for scene in scenes]
    return rays, any(one.failing for one in rays), any(one.cut for one in rays)


def _weighed(
    lens: Lens, scenes: Sequence[Scene], group: Group, rays: Sequence[Traced]
) -> Iterator[_Trial]:
    """Rules of a group with their moments. ValueError if no light of a wavelength arrives."""
    found = tuple(one.found for one in rays)
    for start in range(0, len(group.rules), AT_ONCE):
        some = group.rules[start : start + AT_ONCE]
        each = [weigh_rules(lens, [used for _, used in some], one) for one in rays]
        for (rule, used), *moments in zip(some, *each, strict=True):
            for scene, one in zip(scenes, moments, strict=True):
                if not np.all(one.throughput > 0):
                    _say_why(lens, scene, rule.symmetry, one.throughput)
            yield _Trial(rule, used, tuple(moments), found)


def _eps(lens: Lens) -> float:
    return float(jnp.finfo(lens.curvature.dtype).eps)


def _rounding(lens: Lens, found: FocusMoments) -> float:
    """Relative rounding error of the smallest spot."""
    size = np.sqrt(np.min(np.sum(np.asarray(found.spread)[0, :, :2], axis=-1)))
    return hit_rounding(lens) / max(float(size), _SMALLEST)


def _change(before: _Trial, now: _Trial, places: Callable) -> float:
    """Largest change of a covariance relative to its trace, at `places`, see `at_sensor`."""
    worst = 0.0
    for pair in zip(now.moments, before.moments, strict=True):
        spreads = [np.asarray(found.spread, float) for found in pair]
        for place in places(spreads[0]):
            d = place[:, None]
            new, old = (s[0] + d * (s[1] + d * s[2]) for s in spreads)
            size = np.sum(new[:, :2], axis=-1, keepdims=True)
            worst = max(worst, float(np.max(np.abs(new - old) / np.maximum(size, _SMALLEST**2))))
    return worst


def _say_why(lens: Lens, scene: Scene, symmetry: Symmetry, throughput: Numbers) -> None:
    """Raises ValueError that says where the light of a wavelength without throughput ends.
    throughput: (W,)."""
    wavelength = int(np.argmin(np.asarray(throughput) > 0))
    lens, scene = known_values((lens, scene))
    with jax.core.eval_context():
        # Checks the values of an eager gradient, which were not known before.
        scene_of(lens, scene.field, scene.distance, scene.wavelengths)
        rule = Pattern(*gauss_points(_DIAGNOSIS, symmetry), symmetry)
        found = trace_rule(lens, scene, rule, solve).found
        raise ValueError(
            f"no ray at {float(scene.wavelengths[wavelength]):g} um reaches the sensor: "
            f"{reasons(lens, scene, rule, found, wavelength)}{crossed(lens)}; see "
            "trace_rays(...).status"
        )
