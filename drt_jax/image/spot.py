"""A spot: where the light of many rays is, and how far from there each ray is.

Where rays of a part of the pupil stand for all of it, what they leave out is their mirror image.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import safe_divide
from ..pupil.rules import Symmetry
from ..rays.system import Vector

# Whether each component averages to 0, as the rest of the pupil has the opposite one.
_MIRRORED = {"rotational": (True,), "bilateral": (True, False), "none": (False, False)}
# Pairs of components whose products do not average to 0.
_PAIRS = {"rotational": ((0, 0),), "bilateral": ((0, 0), (1, 1))}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Moments:
    """The spot of W wavelengths.

    mean: (W, 2), x and y of the centroid on the sensor, mm.
    covariance: (W, 2, 2), mm^2; inf on the diagonal for a wavelength of which no light arrives.
    throughput: (W,), the fraction of the light through the stop that reaches the sensor.
    separable: static; True if symmetry makes the xy element 0, so that the Gaussian kernel is
        separable, see `separable_psf`.
    """

    mean: Array
    covariance: Array
    throughput: Array
    separable: bool = dataclasses.field(default=False, metadata={"static": True})


def normalised(weight: Array, axes: tuple[int, ...] = (-1,)) -> Array:
    """Weights that add up to 1 over axes, or are all 0 there."""
    total = jnp.sum(weight, axis=axes, keepdims=True)
    return safe_divide(weight, jnp.broadcast_to(total, weight.shape))


def deviations(
    values: Vector, weight: Array, symmetry: Symmetry, axes: tuple[int, ...] = (-1,)
) -> tuple[Vector, Vector]:
    """Hits, or slopes, less their means over axes, D arrays (..., Q), and the means, of which these
    axes have length 1.

    values: D arrays (..., Q), D = 1 on the meridian.
    weight: (..., Q), of the light, as of `normalised`.
    symmetry: of the pupil rule whose rays these are.
    """

    def mean(value: Array, mirrored: bool) -> Array:
        found = jnp.sum(weight * value, axis=axes, keepdims=True)
        return jnp.zeros_like(found) if mirrored else found

    means = tuple(map(mean, values, _MIRRORED[symmetry]))
    return tuple(v - m for v, m in zip(values, means, strict=True)), means


def mean_products(a: Vector, b: Vector, weight: Array, symmetry: Symmetry) -> Array:
    """Means over all of the pupil of the symmetric products of deviations, (..., C): xx, yy and,
    without symmetry, xy; with `a` for `b` the covariance. Arguments as of `deviations`."""
    pairs = _PAIRS.get(symmetry, ((0, 0), (1, 1), (0, 1)))
    found = [jnp.sum(weight * (a[i] * b[j] + b[i] * a[j]), axis=-1) / 2 for i, j in pairs]
    if symmetry == "rotational":  # over the full circle <xx> = <yy> = <rho^2> / 2
        found = [found[0] / 2] * 2
    return jnp.stack(found, axis=-1)
