"""Classical sequential ray trace by Snell's law: the oracle and the baseline.

Written from the textbook formulae (Welford, Aberrations of Optical Systems, ch. 4), sharing
no formula with the Fermat solver but the sag. One ray at a time; `jax.vmap` for more.
"""

import jax
import jax.numpy as jnp
from jax import Array

from . import surface
from .lens import Lens

__all__ = ["trace_snell"]

_ASPHERE_STEPS = 12


def _intersect(p: Array, d: Array, c: Array, k: Array, a: Array) -> tuple[Array, Array, Array]:
    """Hit of the ray p + s d with the surface at the origin; its normal; whether there is one."""
    p = p - d * (p[2] / d[2])  # to the vertex plane
    quadratic = c * (1 + k * d[2] ** 2)
    linear = d[2] - c * (p[0] * d[0] + p[1] * d[1])
    constant = c * (p[0] ** 2 + p[1] ** 2)
    discriminant = linear**2 - quadratic * constant
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    q = p + d * (constant / (linear + root))
    if a.shape[0]:

        def closer(_, q):
            z, slope, _ = surface.sag_derivatives(q[:2], c, k, a)
            return q + d * ((z - q[2]) / (d[2] - slope @ d[:2]))

        q = jax.lax.fori_loop(0, _ASPHERE_STEPS, closer, q)
    _, slope, _ = surface.sag_derivatives(q[:2], c, k, a)
    normal = jnp.array([-slope[0], -slope[1], jnp.ones_like(slope[0])])
    return q, normal / jnp.linalg.norm(normal), discriminant >= 0


def trace_snell(
    lens: Lens, wavelength: Array, point: Array, direction: Array
) -> tuple[Array, Array]:
    """Trace one ray through a lens to its sensor.

    `wavelength` () in um; `point` (3,) in mm, anywhere on the ray before the lens;
    `direction` (3,), a unit vector. Returns the hits (S + 1, 3) in mm, z from the first
    vertex, and whether the ray met every surface and was refracted there, bool.
    """
    index = lens.index(jnp.atleast_1d(wavelength))[:, 0]
    vertices = lens.vertices
    ok, hits = jnp.array(True), []
    for i in range(lens.curvature.shape[0]):
        origin = jnp.zeros_like(point).at[2].set(vertices[i])
        hit, normal, met = _intersect(
            point - origin, direction, lens.curvature[i], lens.conic[i], lens.coefficients[i]
        )
        point = hit + origin
        ratio = index[i] / index[i + 1]
        cosine = normal @ direction
        square = 1 - ratio**2 * (1 - cosine**2)
        direction = ratio * direction + normal * (
            jnp.sqrt(jnp.maximum(square, 0)) - ratio * cosine
        )
        ok = ok & met & (square >= 0) & (cosine > 0)
        hits.append(point)
    hits.append(point + direction * ((lens.sensor - point[2]) / direction[2]))
    return jnp.stack(hits), ok

