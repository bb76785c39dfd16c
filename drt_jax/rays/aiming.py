"""Launch points of large bundles, as polynomials of the stop points.

Where a ray through a stop point enters the lens is a smooth function of that point. It is fitted
to a few hundred rays that are searched for; all others then start where the first or second trial
meets their stop point to rounding.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from .fermat import System
from ..pupil.rules import disc
from .sequential import launch

__all__ = ["NODES", "Aiming", "fit", "nodes", "unknown"]

# In a Double Gauss at 10 degrees, the first trial misses the stop points by 1e-13 mm with degree
# 18, by 1e-10 mm with 14. Where it is not enough, lower degrees tell the correction.
_DEGREE, _LOWER = 18, 6
_POINTS = disc(_DEGREE // 2 + 2, _DEGREE + 2)[0]
NODES = _POINTS.shape[1]


class Aiming(NamedTuple):
    """coefficients (N, N, D, W) of x^i y^j, x and y the stop point in units of radius (), mm;
    good (), whether all rays that they were fitted to were found."""

    coefficients: Array
    radius: Array
    good: Array

    def at(self, target: Array) -> tuple[Array, Array]:
        """Launch points (D, W, Q), mm, and their derivatives by the stop point (D, D, W, Q)."""
        few = self.coefficients[: _LOWER + 1, : _LOWER + 1]
        (x, by_x), (y, by_y) = (_powers(a / self.radius) for a in target)
        aim = _sum(self.coefficients, x, y)
        slopes = _sum(few, by_x, y[: _LOWER + 1]), _sum(few, x[: _LOWER + 1], by_y)
        return aim, jnp.stack(slopes, axis=1) / self.radius


def _powers(x: Array) -> tuple[Array, Array]:
    """x^i, and the derivatives of the lower ones, powers along the first axis."""
    powers = [jnp.ones_like(x), x]
    while len(powers) <= _DEGREE:
        powers.append(powers[-1] * x)
    slopes = [i * powers[max(i - 1, 0)] for i in range(_LOWER + 1)]
    return jnp.stack(powers), jnp.stack(slopes)


def _sum(coefficients: Array, x: Array, y: Array) -> Array:
    """Sum of coefficients (I, J, D, W) times x (I, W or 1, Q) times y (J, W or 1, Q)."""
    if y.shape[1] == 1:
        rows = jnp.einsum("ijdw,jq->idwq", coefficients, y[:, 0])
    else:
        rows = jnp.einsum("ijdw,jwq->idwq", coefficients, y)
    return sum(rows[i] * x[i] for i in range(len(x)))


def nodes(system: System) -> Array:
    """Stop points (2, NODES), mm, of the rays to fit to: all over the disc of the bundle."""
    radius = jnp.max(jnp.sqrt(jnp.sum(system.crossings**2, axis=0)))
    return radius * jnp.asarray(_POINTS, radius.dtype)


def unknown(system: System) -> Aiming:
    """What is known before any ray is."""
    dim, dtype = len(system.target), system.target.dtype
    shape = _DEGREE + 1, _DEGREE + 1, dim, system.index.shape[1]
    return Aiming(jnp.zeros(shape, dtype), jnp.ones((), dtype), jnp.array(False))


def fit(system: System, hits: Array, good: Array) -> Aiming:
    """Fit to the rays through `nodes`, the first of those whose `hits` (2, W, K or more) on the
    first surface are given; `good` (W, K or more) are the ones that were found."""
    pairs = np.array([(i, d - i) for d in range(_DEGREE + 1) for i in range(d + 1)])
    # First onto an orthogonal basis, by rising degree: the coefficients fall as fast as the
    # numbers of the second matrix grow, and no digit is lost.
    basis, triangle = np.linalg.qr(np.prod(_POINTS.T[:, None] ** pairs, axis=-1))
    aims = launch(system, hits[..., :NODES])
    parts = jnp.tensordot(jnp.asarray(basis.T, aims.dtype), aims, axes=(1, 2))
    terms = jnp.tensordot(jnp.asarray(np.linalg.inv(triangle), aims.dtype), parts, axes=1)
    radius = jnp.max(jnp.sqrt(jnp.sum(system.crossings**2, axis=0)))
    coefficients = unknown(system).coefficients.at[pairs[:, 0], pairs[:, 1]].set(terms)
    return Aiming(coefficients, radius, jnp.all(good))
