"""Centroid and covariance of the rays on the sensor, as functions of the sensor position.

The paper traces 256 random rays for each sensor position. Here the rays of a pupil rule are traced
once. Rays in front of the sensor are straight, so a hit is linear in the sensor position, and
centroid and covariance are exact polynomials of degree 1 and 2 in it.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import Numbers
from ..pupil.rules import PupilRule
from ..rays.solve import Solver, solve
from ..rays.system import Vector
from ..rays.trace import Bundle, trace_bundle
from .spot import Moments, deviations, mean_products, normalised


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FocusMoments:
    """Moments of W wavelengths as polynomials in the sensor position. With d = sensor - reference:
    centroid = mean + d slope, covariance = spread[0] + d spread[1] + d^2 spread[2]. Of several
    object points, they are the first axes of all arrays.

    reference: (), mm.
    mean: (W, 2), mm.
    slope: (W, 2).
    spread: (3, W, C) in mm^2, mm and 1; C = 3 for xx, yy and xy, or C = 2 without xy where symmetry
        makes it 0.
    throughput: (W,), fraction of the light through the stop that reaches the sensor.
    """

    reference: Array
    mean: Array
    slope: Array
    spread: Array
    throughput: Array

    def at(self, sensor: Numbers) -> Moments:
        """The `Moments` at a sensor position, (), mm."""
        return _at(self, jnp.asarray(sensor, self.reference.dtype))


@jax.jit
def _at(moments: FocusMoments, sensor: Array) -> Moments:
    # A jitted function, so that this is one program and not one for each operation.
    if moments.reference.ndim:
        return jax.vmap(_at, (0, None))(moments, sensor)
    d = sensor - moments.reference
    spread = moments.spread[0] + d * (moments.spread[1] + d * moments.spread[2])
    arrives = (moments.throughput > 0)[:, None]
    xx, yy = jnp.where(arrives, spread[:, :2], jnp.inf).T
    separable = spread.shape[-1] == 2
    xy = jnp.zeros_like(xx) if separable else spread[:, 2]
    covariance = jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)
    return Moments(moments.mean + d * moments.slope, covariance, moments.throughput, separable)


def moments(lens: Lens, scene: Scene, rule: PupilRule, solver: Solver = solve) -> FocusMoments:
    """Moments of the rays of a rule as functions of the sensor position. Paper section 4.3.

    lens, scene: the lens, and the object point with its wavelengths.
    rule: pupil rule.
    solver: of the rays.

    Returns `FocusMoments` with the reference at `lens.sensor`. Weights are normalised over the
    light that arrives. Differentiable in the modes of the solver; the status of rays is a constant.
    ValueError as in `check_sensor`.
    """
    check_sensor(lens)
    points, weights = rule.points(lens, scene)
    return weigh(lens, rule, weights, trace_bundle(lens, scene, points, solver))


def check_sensor(lens: Lens) -> None:
    """ValueError for an element that rotates surfaces about the sensor: it moves with the
    sensor, so the moments are not polynomials in the sensor position."""
    if lens.elements is None:
        return
    for g, ((first, _), about) in enumerate(zip(lens.elements.spans, lens.elements.about)):
        if about == lens.count and first < lens.count:
            raise ValueError(
                f"elements[{g}]: rotates surfaces about the sensor, so that they move with it: "
                "rotate them about another surface with the same pivot, or use psf_moments"
            )


def check_focus(lens: Lens) -> None:
    """ValueError as in `check_sensor`, and for an afocal lens, which no sensor position focuses."""
    check_sensor(lens)
    if lens.afocal:
        raise ValueError(
            "afocal: no sensor position focuses this lens: vary a thickness, or take `focus` "
            "of transfer and encircled_energy, in 1e-3 dioptre"
        )


def weigh(lens: Lens, rule: PupilRule, weights: Array, bundle: Bundle) -> FocusMoments:
    """Moments of traced rays.

    lens: the lens.
    rule: pupil rule of the rays, which gives their transmission.
    weights: (1 or W, Q), weights of the rule.
    bundle: the traced rays.
    """
    weight = weights * rule.transmission(lens, bundle)
    throughput = jnp.sum(weight, axis=-1)
    weight = normalised(weight)
    # Derivatives of the hits by the sensor position.
    slope, motion = bundle.slopes, lens.sensor_motion
    if motion is not None:
        slope = tuple(s * motion[2] - motion[k] for k, s in enumerate(slope))
    (x, mean), (u, tilt) = (deviations(v, weight, rule.symmetry) for v in (bundle.sensor, slope))
    pairs = (1, x, x), (2, x, u), (1, u, u)
    spread = [k * mean_products(a, b, weight, rule.symmetry) for k, a, b in pairs]
    return FocusMoments(lens.sensor, _plane(mean), _plane(tilt), jnp.stack(spread), throughput)


def _plane(mean: Vector) -> Array:
    """Means, D arrays (W, 1), as an array (W, 2); x is 0 for D = 1."""
    return jnp.concatenate([jnp.zeros_like(mean[0])] * (2 - len(mean)) + [*mean], axis=-1)
