"""Moments over a range of object distances, and the cheapest model of the moments for trained
parameters.

`FocusMoments` are interpolated in 1/distance, of which they are smooth functions up to infinity.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, warn
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, distance_array, vergence_of
from ..numerics import Numbers, concrete, tensordot
from ..rays.solve import solve_reverse
from .converged import converged_focus_rule, focus_moments
from .moments import FocusMoments, moments
from .refined import refine
from .rounding import below_double
from .spot import Moments
from .zernike import chebyshev

# Numbers of Chebyshev nodes to try.
_NODES = (4, 8, 16, 32, 64)
# Relative amount by which a distance may exceed its range, because 1 / (1 / far) is not exactly
# far.
_ROUNDED = 1e-5
# Default tolerances: of `depth_moments` in float64 and float32, and of `moments_model`.
_DOUBLE, _SINGLE, _MODEL = 1e-9, 1e-6, 1e-6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class DepthMoments:
    """`FocusMoments` as Chebyshev series in 1/distance.

    near, far: (), range of the distance, mm.
    series: `FocusMoments` whose leaves have a first axis of Chebyshev coefficients in 1/distance.
    """

    near: Array
    far: Array
    series: FocusMoments

    def at(self, distance: Numbers) -> FocusMoments:
        """`FocusMoments` of an object at a distance between near and far.

        distance: (), mm. ValueError for a known distance outside.
        """
        far = distance_array(distance, self.far.dtype)
        if concrete((distance, self.near, self.far)):
            place, near, end = np.array([distance, self.near, self.far], float).tolist()
            if not (1 - _ROUNDED) * near <= place <= (1 + _ROUNDED) * end:
                raise ValueError(f"distance: {place:g} mm is not within {near:g} and {end:g} mm")
        low, high = 1 / self.far, 1 / self.near
        x = (2 * vergence_of(far) - high - low) / (high - low)
        count = self.series.mean.shape[0]
        basis = chebyshev(x, count - 1)[0]
        return jax.tree.map(lambda c: tensordot(basis, c, axes=1), self.series)


def depth_moments(lens: Lens, scene: Scene, tolerance: float | None = None) -> DepthMoments:
    """Moments for every sensor position and every distance within the range of a scene.

    lens: the lens.
    scene: one field at the nearest and the farthest distance, as of `Scene.point`.
    tolerance: bound of the last coefficients of the moments, relative to the largest. None: 1e-9;
        in float32 1e-6, with rules as exact as that allows.

    Returns `DepthMoments`. The number of Chebyshev nodes in 1/distance doubles until the tolerance
    is met, from 4 to at most 64, where it warns; each node has its own converged rule. ValueError
    inside a trace, and unless 0 < near < far.
    """
    if not concrete(scene.distance):
        raise ValueError("inside jax.jit or jax.vmap nodes cannot be chosen: give known distances")
    near, far = (float(end(scene.distance)) for end in (np.min, np.max))
    require(0 < near < far, f"expected 0 < near < far, got near {near!r} and far {far!r} mm")
    low, high = 1 / far, 1 / near
    bound = tolerance
    if bound is None:
        bound = _SINGLE if below_double(lens) else _DOUBLE
    each = tolerance if below_double(lens) else bound

    def interpolated(count: int) -> FocusMoments:
        """Chebyshev coefficients from the moments at a number of nodes."""
        angle = np.pi * (np.arange(count) + 0.5) / count
        nodes = (high + low) / 2 + (high - low) / 2 * np.cos(angle)
        transform = 2 / count * np.cos(np.outer(np.arange(count), angle))
        transform[0] /= 2
        traced = [focus_moments(lens, scene.at(scene.field, 1 / node), each) for node in nodes]

        def series(*values: Array) -> Array:
            return tensordot(jnp.asarray(transform, values[0].dtype), jnp.stack(values), axes=1)

        return jax.tree.map(series, *traced)

    def tail(series: FocusMoments) -> float:
        """The last two coefficients relative to the largest."""
        parts = (c for c in (series.spread, series.mean) if jnp.any(c != 0))
        tails = (float(jnp.max(jnp.abs(c[-2:])) / jnp.max(jnp.abs(c))) for c in parts)
        return max(tails, default=0.0)

    (series,), left = refine(map(interpolated, _NODES), tail, bound, together=1)
    if left > bound:
        warn(
            f"the moments between {near:g} and {far:g} mm are interpolated to {left:.1e} only, not "
            f"to {bound:.1e}; narrow the range"
        )
    dtype = lens.curvature.dtype
    return DepthMoments(jnp.asarray(near, dtype), jnp.asarray(far, dtype), series)


def moments_model(
    lens: Lens, trained: tuple[str, ...], scene: Scene, tolerance: float | None = None
) -> tuple[dict[str, Array], Callable[[dict[str, Array], Array], Moments]]:
    """The cheapest exact model of the moments for trained parameters. If only the sensor is
    trained, the model is a polynomial in the sensor position and 1/distance; otherwise it traces
    the rays.

    lens: the lens.
    trained: names of fields of `Lens`.
    scene: one field, at one distance or at the nearest and the farthest.
    tolerance: as in `focus_moments`.

    Returns a dict with the initial values of the trained parameters, and a function (values,
    distance) -> `Moments`.
    """
    values = {name: getattr(lens, name) for name in trained}
    if tolerance is None and not below_double(lens):
        tolerance = _MODEL
    if set(trained) <= {"sensor"}:
        if np.min(scene.distance) == np.max(scene.distance):
            focus = focus_moments(lens, scene.at(scene.field, np.min(scene.distance)), tolerance)
            at = lambda distance: focus  # noqa: E731
        else:
            at = depth_moments(lens, scene, tolerance).at

        def from_plane(values, distance):
            """Moments from the polynomials, without a trace."""
            return at(distance).at(values.get("sensor", lens.sensor))

        return values, from_plane
    rule = converged_focus_rule(lens, scene, tolerance)

    def retrace(values, distance):
        """Moments of rays that are traced with a fixed rule."""
        changed = dataclasses.replace(lens, **values)
        point = checked_scene(changed, scene.at(scene.field, distance))
        return moments(changed, point, rule, solve_reverse).at(changed.sensor)

    return values, retrace
