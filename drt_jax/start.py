"""First guess of the hits: a real ray, aimed at the stop point as far as paraxial optics can.

The closer the guess, the fewer Newton steps; and a guess that already bends at every surface
keeps the iteration away from the rims, where a steep surface would send it astray.
"""

import jax
import jax.numpy as jnp
from jax import Array

from . import surface
from .fermat import System
from .numerics import safe_divide, safe_sqrt
from .paraxial import trace_yu

__all__ = ["first_guess"]

_ASPHERE_STEPS = 3
_AIM_STEPS = 2
# A guess that leans more than this (cosine with the axis) is not trusted.
_FLATTEST = 0.05


def first_guess(system: System, stop: int) -> Array:
    """Hits (D, S + 1, W, Q) in mm of rays near those through the stop points of `system`.

    Rays are traced forward by Snell's law, aimed through the paraxial entrance pupil, and
    re-aimed by what they miss the stop point; where such a ray fails, paraxial hits stand in.
    """
    bent = system.curvature
    if system.coefficients.shape[0]:
        bent = bent + 2 * system.coefficients[0]
    index = jnp.concatenate([system.index, system.index[-1:]])
    gaps = jnp.diff(system.vertex)
    one = jnp.ones_like(index[0])
    reach = system.vertex[0]  # the first surface of the system need not be the first vertex
    v = system.vergence
    axial, _ = trace_yu(bent, gaps, index, one * (1 + reach * v), one * v)
    tilted, _ = trace_yu(bent, gaps, index, one * reach, one)
    tangent = -system.source[:-1, None, None]
    target = system.stop[:, None]
    magnification = axial[stop][:, None]
    amplitude = safe_divide(target - tangent * tilted[stop][:, None], magnification)
    paraxial = amplitude[:, None] * axial[..., None] + tangent[:, None] * tilted[..., None]

    # Aim at a point on the vertex plane of the first surface.
    aim = paraxial[:, 0]
    for _ in range(_AIM_STEPS):
        hits, valid = _trace(system, aim, stop + 1)
        miss = jnp.where(valid, target - hits[:, stop], 0)
        aim = aim + safe_divide(miss * axial[0][:, None], magnification)
    hits, valid = _trace(system, aim, bent.shape[0])
    return jnp.where(valid, hits, paraxial)


def _trace(system: System, aim: Array, count: int) -> tuple[Array, Array]:
    """Sequential trace over the first `count` surfaces: hits (D, count, W, Q), and whether the
    ray met all of them (W, Q)."""
    height = jnp.broadcast_to(system.vertex[0], aim.shape[1:])
    point = jnp.concatenate([aim, height[None]])
    direction = system.vergence * point - system.source[:, None, None]
    direction = direction / jnp.sqrt(jnp.sum(direction**2, axis=0))
    index = jnp.concatenate([system.index, system.index[-1:]])[..., None]

    def step(carry, xs):
        point, d, valid = carry
        vertex, c, k, a, before, after = xs
        q = point[:-1] + d[:-1] * ((vertex - point[-1]) / d[-1])
        linear = d[-1] - c * jnp.sum(q * d[:-1], axis=0)
        constant = c * jnp.sum(q * q, axis=0)
        discriminant = linear**2 - c * (1 + k * d[-1] ** 2) * constant
        length = safe_divide(constant, linear + safe_sqrt(discriminant))
        for _ in range(_ASPHERE_STEPS if a.shape[0] else 0):
            z, slope, _ = surface.sag_derivatives(q + d[:-1] * length, c, k, a)
            length = length + safe_divide(
                z - d[-1] * length, d[-1] - jnp.sum(slope * d[:-1], axis=0)
            )
        w = q + d[:-1] * length
        z, slope, _ = surface.sag_derivatives(w, c, k, a)
        normal = jnp.concatenate([-slope, jnp.ones_like(slope[:1])])
        normal = normal / jnp.sqrt(jnp.sum(normal**2, axis=0))
        ratio = before / after
        cosine = jnp.sum(normal * d, axis=0)
        square = 1 - ratio**2 * (1 - cosine**2)
        refracted = ratio * d + normal * (safe_sqrt(square) - ratio * cosine)
        valid = valid & (discriminant > 0) & (square > 0) & (refracted[-1] > _FLATTEST)
        d = jnp.where(valid, refracted, d)  # a failed ray goes straight on, and stays finite
        point = jnp.concatenate([w, (vertex + z)[None]])
        return (point, d, valid), w

    carry = point, direction, jnp.broadcast_to(direction[-1] > _FLATTEST, aim.shape[1:])
    xs = (
        system.vertex[:count], system.curvature[:count], system.conic[:count],
        system.coefficients.T[:count], index[:count], index[1 : count + 1],
    )  # fmt: skip
    (_, _, valid), hits = jax.lax.scan(step, carry, xs)
    return jnp.moveaxis(hits, 0, 1), valid
