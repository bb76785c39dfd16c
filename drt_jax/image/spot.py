"""A spot: the centroid of rays on the sensor, and the deviations of the rays from it.

Rays on a part of the pupil also represent their mirror images.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import safe_divide
from ..pupil.rules import Symmetry
from ..rays.system import Vector

# For each component: True if its mean is 0 by symmetry.
_MIRRORED = {"rotational": (True,), "bilateral": (True, False), "none": (False, False)}
# Pairs of components whose products do not have the mean 0 by symmetry.
_PAIRS = {"rotational": ((0, 0),), "bilateral": ((0, 0), (1, 1))}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Moments:
    """Centroid, covariance and throughput of the spots of W wavelengths. Several object points are
    the first axes of all arrays.

    mean: (W, 2), centroid on the sensor, mm.
    covariance: (W, 2, 2), mm^2; inf on the diagonal if no light of the wavelength arrives.
    throughput: (W,), fraction of the light through the stop that reaches the sensor.
    separable: static; True if symmetry makes xy 0, so that `separable_psf` applies.
    """

    mean: Array
    covariance: Array
    throughput: Array
    separable: bool = dataclasses.field(default=False, metadata={"static": True})


def normalised(weight: Array, axes: tuple[int, ...] = (-1,)) -> Array:
    """Weights divided by their sum over `axes`; 0 where the sum is 0."""
    total = jnp.sum(weight, axis=axes, keepdims=True)
    return safe_divide(weight, jnp.broadcast_to(total, weight.shape))


def deviations(
    values: Vector, weight: Array, symmetry: Symmetry, axes: tuple[int, ...] = (-1,)
) -> tuple[Vector, Vector]:
    """Deviations of hits or slopes from their means, and the means.

    values: D arrays (..., Q), D = 1 for rays on one radius (the meridian).
    weight: (..., Q), normalised over `axes`.
    symmetry: symmetry of the pupil rule of the rays.
    axes: axes of the means.

    Returns D arrays (..., Q) of deviations, and D arrays of means with length 1 along `axes`.
    """

    def mean(value: Array, mirrored: bool) -> Array:
        found = jnp.sum(weight * value, axis=axes, keepdims=True)
        return jnp.zeros_like(found) if mirrored else found

    means = tuple(map(mean, values, _MIRRORED[symmetry]))
    return tuple(v - m for v, m in zip(values, means, strict=True)), means


def mean_products(a: Vector, b: Vector, weight: Array, symmetry: Symmetry) -> Array:
    """Means of products of deviations over the whole pupil; with b = a, the covariance.

    a, b: deviations, D arrays (..., Q), as `deviations` returns them.
    weight, symmetry: as in `deviations`.

    Returns (..., C): xx, yy and, without symmetry, xy.
    """
    pairs = _PAIRS.get(symmetry, ((0, 0), (1, 1), (0, 1)))
    found = [jnp.sum(weight * (a[i] * b[j] + b[i] * a[j]), axis=-1) / 2 for i, j in pairs]
    if symmetry == "rotational":  # over the full circle <xx> = <yy> = <rho^2> / 2
        found = [found[0] / 2] * 2
    return jnp.stack(found, axis=-1)
