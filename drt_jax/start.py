"""First guess of the hits: a real ray, aimed at the stop point as far as paraxial optics can.

The closer the guess, the fewer Newton steps; and a guess that already bends at every surface
keeps the iteration away from the rims, where a steep surface would send it astray.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .fermat import System
from .numerics import safe_divide, safe_sqrt
from .paraxial import trace_yu
from .surface import Shape, sag_derivatives, vertex_curvature

__all__ = ["first_guess"]

_ASPHERE_STEPS = 3
_FREEFORM_STEPS = 8
_AIM_STEPS = 2
# A guess that leans more than this (cosine with the axis) is not trusted.
_FLATTEST = 0.05


def first_guess(system: System) -> Array:
    """Hits (D, S + 1, W, Q) in mm of rays near those through the stop points of `system`.

    Rays are traced forward by Snell's law, aimed through the paraxial entrance pupil, and
    re-aimed by what they miss the stop point; where such a ray fails, paraxial hits stand in.
    """
    stop, count = system.stop, len(system.forms)
    dim = system.target.shape[0]
    plain = Shape(system.curvature, system.conic, system.coefficients)
    bent = vertex_curvature(plain, system.forms, dim).T[..., None]
    # In a mirrored space, distances and indices are both negative.
    index = jnp.concatenate([system.index, system.index[-1:]])
    senses = system.senses[:, 0]
    signs = jnp.concatenate([senses, senses[-1:]])
    one = jnp.ones((dim, system.index.shape[1]), index.dtype)
    reach = system.vertex[0]  # the first surface of the system need not be the first vertex
    v = system.vergence
    gaps = jnp.diff(system.vertex)
    # Leaves (S + 1, D, W)
    axial, _ = trace_yu(bent, gaps, index * signs, one * (1 + reach * v), one * v)
    tilted, _ = trace_yu(bent, gaps, index * signs, one * reach, one)
    axial, tilted = jnp.swapaxes(axial, 0, 1), jnp.swapaxes(tilted, 0, 1)
    tangent = -system.source[:-1, None, None]
    magnification = axial[:, stop, :, None]
    target = system.crossings
    if system.offset is not None:
        target = target + system.offset[:, stop, None, None]
    amplitude = safe_divide(target - tangent * tilted[:, stop, :, None], magnification)
    paraxial = amplitude[:, None] * axial[..., None] + tangent[:, None] * tilted[..., None]

    # Aim at a point on the vertex plane of the first surface.
    aim = paraxial[:, 0]
    for _ in range(_AIM_STEPS if stop else 0):
        hits, valid = _trace(system, aim, stop + 1)
        miss = jnp.where(valid, system.crossings - hits[:, stop], 0)
        aim = aim + safe_divide(miss * axial[:, 0, :, None], magnification)
    hits, valid = _trace(system, aim, count)
    if system.offset is not None:
        paraxial = paraxial - system.offset[..., None, None]
    return jnp.where(valid, hits, paraxial)


def _trace(system: System, aim: Array, count: int) -> tuple[Array, Array]:
    """Sequential trace over the first `count` surfaces: hits (D, count, W, Q), and whether the
    ray met all of them (W, Q)."""
    height = jnp.broadcast_to(system.vertex[0], aim.shape[1:])
    point = jnp.concatenate([aim, height[None]])
    direction = system.vergence * point - system.source[:, None, None]
    direction = direction / jnp.sqrt(jnp.sum(direction**2, axis=0))
    index = jnp.concatenate([system.index, system.index[-1:]])[..., None]
    senses = jnp.append(system.senses, system.senses[-1])
    offset = jnp.zeros((aim.shape[0], len(system.forms)), aim.dtype)
    offset = offset if system.offset is None else system.offset
    origin = jnp.concatenate([offset, system.vertex[None]])[..., None, None]
    kinds = sorted(set(system.forms[:count]))
    crossings = [_crossing(kind) for kind in kinds]

    def step(carry, xs):
        point, d, valid = carry
        origin, rotation, kind, shape, before, after, senses = xs
        p = point - origin
        if rotation is not None:
            p = jnp.sum(rotation[..., None, None] * p[:, None], axis=0)
            d = jnp.sum(rotation[..., None, None] * d[:, None], axis=0)
        if len(crossings) == 1:
            w, z, slope, met = crossings[0](p, d, shape)
        else:
            w, z, slope, met = jax.lax.switch(kind, crossings, p, d, shape)
        normal = jnp.concatenate([-slope, jnp.ones_like(slope[:1])])
        normal = normal / jnp.sqrt(jnp.sum(normal**2, axis=0))
        ratio = before / after
        cosine = jnp.sum(normal * d, axis=0)
        square = 1 - ratio**2 * (1 - cosine**2)
        refracted = ratio * d + normal * (senses[1] * safe_sqrt(square) - ratio * cosine)
        valid = valid & met & (square > 0) & (refracted[-1] * senses[1] > _FLATTEST)
        d = jnp.where(valid, refracted, d)  # a failed ray goes straight on, and stays finite
        own = jnp.concatenate([w, z[None]])
        if rotation is not None:
            own = jnp.sum(rotation[..., None, None] * own[None], axis=1)
            d = jnp.sum(rotation[..., None, None] * d[None], axis=1)
        return (own + origin, d, valid), w

    carry = point, direction, jnp.broadcast_to(direction[-1] > _FLATTEST, aim.shape[1:])
    rotation = None if system.rotation is None else jnp.moveaxis(system.rotation, -1, 0)[:count]
    xs = (
        jnp.moveaxis(origin, 1, 0)[:count], rotation,
        np.array([kinds.index(form) for form in system.forms[:count]]),
        Shape(system.curvature[:count], system.conic[:count], system.coefficients.T[:count]),
        index[:count], index[1 : count + 1], jnp.stack([senses[:-1], senses[1:]], 1)[:count],
    )  # fmt: skip
    (_, _, valid), hits = jax.lax.scan(step, carry, xs)
    return jnp.moveaxis(hits, 0, 1), valid


def _crossing(form: str):
    """Where rays p + s d meet a surface of a form: w, sag, slope, and whether they do."""

    def closer(p, d, length, shape):
        z, slope, _ = sag_derivatives(p[:-1] + d[:-1] * length, shape, form)
        miss = z - p[-1] - d[-1] * length
        return length + safe_divide(miss, d[-1] - jnp.sum(slope * d[:-1], axis=0))

    def cross(p, d, shape):
        length = -safe_divide(p[-1], d[-1])  # to the vertex plane
        met = jnp.ones(length.shape, bool)
        if form == "asphere":
            c, k = shape.curvature, shape.conic
            q = p[:-1] + d[:-1] * length
            linear = d[-1] - c * jnp.sum(q * d[:-1], axis=0)
            constant = c * jnp.sum(q * q, axis=0)
            discriminant = linear**2 - c * (1 + k * d[-1] ** 2) * constant
            root = safe_sqrt(discriminant)
            length = length + safe_divide(constant, linear + jnp.where(d[-1] < 0, -root, root))
            met = discriminant > 0
        steps = _FREEFORM_STEPS if form != "asphere" else _ASPHERE_STEPS
        if shape.coefficients.shape[0]:  # a loop: written out, it would be slow to compile
            length = jax.lax.fori_loop(
                0, steps, lambda _, length: closer(p, d, length, shape), length
            )
        w = p[:-1] + d[:-1] * length
        z, slope, _ = sag_derivatives(w, shape, form)
        return w, z, slope, met

    return cross
