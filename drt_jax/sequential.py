"""Sequential trace by Snell's law in the array layout of `fermat`: what the search aims with.

It is never differentiated, and its rays are labelled by where they cross the vertex plane of the
first surface. `snell` is the tracer to compare with: plain, a ray at a time, and independent.
"""

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from .fermat import Status, System
from .numerics import safe_divide, safe_sqrt
from .surface import Shape, domain, sag, sag_derivatives

__all__ = ["launch", "shoot"]

# Newton steps along a ray to a surface that is no conic; the last must be shorter than `_SETTLED`
# of the ray's length or of 1 mm.
_STEPS, _SETTLED = 20, 1e-7
# A ray that leans more than this (cosine with the axis) is not followed.
_FLATTEST = 1e-4


def launch(system: System) -> Array:
    """Where rays through the points of a first surface that is the stop cross its vertex plane,
    (D, W, Q), mm."""
    w = system.crossings
    shape = Shape(*(a[..., 0, :, :] for a in system.shape))
    own = jnp.concatenate([w, sag(w, shape, system.forms[0])[None]])
    if system.rotation is not None:
        own = jnp.sum(system.rotation[..., 0, None, None] * own[None], axis=1)
    across = jnp.zeros_like(own[:-1, :1, :1]) if system.offset is None else (
        system.offset[:, 0, None, None])  # fmt: skip
    point = own + jnp.concatenate([across, 0 * own[-1:, :1, :1] + system.vertex[0]])
    direction = system.vergence * point - system.source[:, None, None]
    aim = point[:-1] - safe_divide(direction[:-1] * own[-1], direction[-1])
    return jnp.broadcast_to(aim, (w.shape[0], system.index.shape[1], w.shape[2]))


def shoot(system: System, aim: Array) -> tuple[Array, Array, Array]:
    """Rays launched at `aim` (D, W, Q): hits (D, S + 1, W, Q), what became of them, a `Status`
    (W, Q), and how many surfaces they passed (W, Q), the sensor being the last; the hits after
    these are void."""
    height = jnp.broadcast_to(system.vertex[0], aim.shape[1:])
    point = jnp.concatenate([aim, height[None]])
    direction = system.vergence * point - system.source[:, None, None]
    direction = direction / jnp.sqrt(jnp.sum(direction**2, axis=0))
    index = jnp.concatenate([system.index, system.index[-1:]])[..., None]
    senses = jnp.append(system.senses, system.senses[-1])
    offset = jnp.zeros((aim.shape[0], len(system.forms)), aim.dtype)
    offset = offset if system.offset is None else system.offset
    origin = jnp.concatenate([offset, system.vertex[None]])[..., None, None]
    kinds = sorted(set(system.forms))
    settled = max(_SETTLED, 16 * float(jnp.finfo(aim.dtype).eps))
    crossings = [_crossing(kind, settled) for kind in kinds]

    def step(i, carry):
        point, d, fate, passed, hits = carry
        origin, rotation, kind, shape, before, after, senses = jax.tree.map(lambda a: a[i], rows)
        p = point - origin
        if rotation is not None:
            p = jnp.sum(rotation[..., None, None] * p[:, None], axis=0)
            d = jnp.sum(rotation[..., None, None] * d[:, None], axis=0)
        cross = crossings[0] if len(crossings) == 1 else partial(jax.lax.switch, kind, crossings)
        w, z, slope, met, length = cross(p, d, shape, fate == Status.OK)
        normal = jnp.concatenate([-slope, jnp.ones_like(slope[:1])])
        normal = normal / jnp.sqrt(jnp.sum(normal**2, axis=0))
        ratio = before / after
        cosine = jnp.sum(normal * d, axis=0)
        square = 1 - ratio**2 * (1 - cosine**2)
        refracted = ratio * d + normal * (senses[1] * safe_sqrt(square) - ratio * cosine)
        # Light goes forwards, and meets a surface from the front.
        met = met & ((length > 0) | (i == 0)) & (cosine * senses[0] > 0)
        lost = ~met | (refracted[-1] * senses[1] <= _FLATTEST)
        here = jnp.where(met & (square <= 0), Status.TIR, jnp.where(lost, Status.MISSED, Status.OK))
        fate = jnp.where(fate == Status.OK, here.astype(jnp.int32), fate)
        passed = passed + (fate == Status.OK).astype(jnp.int32)
        # A failed ray goes straight on, and stays finite.
        d = jnp.where(fate == Status.OK, refracted, d)
        own = jnp.concatenate([w, z[None]])
        if rotation is not None:
            own = jnp.sum(rotation[..., None, None] * own[None], axis=1)
            d = jnp.sum(rotation[..., None, None] * d[None], axis=1)
        return own + origin, d, fate, passed, hits.at[:, i].set(w)

    flat = jnp.broadcast_to(direction[-1] <= _FLATTEST, aim.shape[1:])
    fate = jnp.where(flat, jnp.int32(Status.MISSED), jnp.int32(Status.OK))
    hits = jnp.zeros((aim.shape[0], len(system.forms), *aim.shape[1:]), aim.dtype)
    rotation = None if system.rotation is None else jnp.moveaxis(system.rotation, -1, 0)
    rows = (
        jnp.moveaxis(origin, 1, 0), rotation,
        jnp.array([kinds.index(form) for form in system.forms]),
        Shape(system.curvature, system.conic, system.coefficients.T),
        index[:-1], index[1:], jnp.stack([senses[:-1], senses[1:]], 1),
    )  # fmt: skip
    carry = point, direction, fate, jnp.zeros_like(fate), hits
    _, _, fate, passed, hits = jax.lax.fori_loop(0, len(system.forms), step, carry)
    return hits, fate, passed


def _crossing(form: str, settled: float):
    """Where rays p + s d meet a surface of a form: w, sag, slope, whether they do, and s."""

    def closer(state, p, d, shape):
        count, length, _ = state
        z, slope, _ = sag_derivatives(p[:-1] + d[:-1] * length, shape, form)
        miss = z - p[-1] - d[-1] * length
        change = safe_divide(miss, d[-1] - jnp.sum(slope * d[:-1], axis=0))
        return count + 1, length + change, jnp.abs(change) <= settled * (1 + jnp.abs(length))

    def cross(p, d, shape, going):
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
        if shape.coefficients.shape[0]:
            _, length, met = jax.lax.while_loop(
                lambda state: (state[0] < _STEPS) & jnp.any(going & ~state[2]),
                lambda state: closer(state, p, d, shape),
                (0, length, jnp.zeros(length.shape, bool)),
            )
        w = p[:-1] + d[:-1] * length
        z, slope, _ = sag_derivatives(w, shape, form)
        return w, z, slope, met & domain(w, shape, form), length

    return cross
