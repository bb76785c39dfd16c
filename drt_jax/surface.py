"""The shape of a surface: sag, its slopes and second derivatives, and where it exists.

A point on a surface is its transverse coordinates w (paper Eq. 1): one (height in the
meridional plane) or two (x, y). The component axis comes first, so that `w[0]`, `w[1]` are
arrays over surfaces and rays; every function here is elementwise in the rest.
"""

import jax
import jax.numpy as jnp
from jax import Array

__all__ = ["domain", "sag", "sag_derivatives"]

# A conic is used up to the rim where its normal leans within 0.57 degrees (cos = 0.01) of
# 90 degrees. Beyond, the square root continues smoothly so that an iteration which strays
# outside stays finite and can come back; a ray that ends there has missed the surface.
_RIM = 1e-4


def _root_argument(w: Array, curvature: Array, conic: Array) -> Array:
    return 1 - (1 + conic) * curvature**2 * jnp.sum(w * w, axis=0)


def domain(w: Array, curvature: Array, conic: Array) -> Array:
    """True where the conic exists at `w` ((D, ...), mm); the shape of `w[0]`, bool."""
    return _root_argument(w, curvature, conic) > _RIM


def sag(w: Array, curvature: Array, conic: Array, coefficients: Array) -> Array:
    """Height of an even asphere above its vertex plane, mm, shape of `w[0]`.

    z = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + sum_j a_j r^(2 j + 2)

    `w` (D, ...) in mm, `curvature` c in 1/mm and `conic` k broadcast to `w[0]`;
    `coefficients` (K, ...), a_j in mm^-(2j+1), K may be 0. Paper Eq. 1 is k = 0, K = 0.
    """
    r2 = jnp.sum(w * w, axis=0)
    argument = _root_argument(w, curvature, conic)
    inside = argument > _RIM
    root = jnp.where(
        inside,
        jnp.sqrt(jnp.where(inside, argument, 1)),
        _RIM**0.5 * jnp.exp((jnp.where(inside, _RIM, argument) / _RIM - 1) / 2),
    )
    z = curvature * r2 / (1 + root)
    if coefficients.shape[0]:
        series = coefficients[-1]
        for a in coefficients[-2::-1]:
            series = a + r2 * series
        z = z + r2 * series
    return z


def sag_derivatives(w: Array, *shape: Array) -> tuple[Array, Array, Array]:
    """Sag, its gradient and its Hessian by the transverse coordinates.

    `w` (D, ...) and `shape` as in `sag`. Returns arrays of shapes (...), (D, ...) and
    (D, D, ...). Derived from `sag` by automatic differentiation, so that a new surface
    form is one formula.
    """

    def slopes(w):
        z, pull_back = jax.vjp(lambda w: sag(w, *shape), w)
        return pull_back(jnp.ones_like(z))[0], z

    columns = []
    for d in range(w.shape[0]):
        unit = jnp.zeros_like(w).at[d].set(1)
        gradient, column, z = jax.jvp(slopes, (w,), (unit,), has_aux=True)
        columns.append(column)
    return z, gradient, jnp.stack(columns)
