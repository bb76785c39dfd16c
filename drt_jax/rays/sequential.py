"""Sequential trace by Snell's law in the array layout of `fermat`: what the search aims with.

It is never differentiated, and its rays are labelled by where they cross the vertex plane of the
first surface. `snell` is the tracer to compare with: plain, a ray at a time, and independent.

Vectors are tuples of components, each an array of one number a ray: XLA joins such sums into few
long loops, where sums over an axis become a library call each.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .fermat import Status, System, turned
from ..numerics import safe_divide, safe_sqrt
from ..lens.surface import RIM, Shape, domain, sag, sag_derivatives

__all__ = ["launch", "shoot"]

# Newton steps along a ray to a surface that is no conic; the last must be shorter than `_SETTLED`
# of the ray's length or of 1 mm.
_STEPS, _SETTLED = 20, 1e-7
# A ray that leans more than this (cosine with the axis) is not followed.
_FLATTEST = 1e-4


def launch(system: System, w: Array) -> Array:
    """Where the rays that meet the first surface at w (D, W or 1, Q) cross its vertex plane,
    (D, W, Q), mm."""
    shape = Shape(*(a[..., 0, :, :] for a in system.shape))
    rotation = None if system.rotation is None else system.rotation[..., 0]
    own = turned(rotation, (*w, sag(w, shape, system.forms[0])))
    across = jnp.zeros(w.shape[0], w.dtype) if system.offset is None else system.offset[:, 0]
    point = *(a + o for a, o in zip(own, across)), own[-1] + system.vertex[0]
    direction = tuple(system.vergence * a - s for a, s in zip(point, system.source))
    depth = safe_divide(own[-1], direction[-1])
    aim = jnp.stack([a - d * depth for a, d in zip(point[:-1], direction)])
    return jnp.broadcast_to(aim, (w.shape[0], system.index.shape[1], w.shape[2]))


def _dot(a: tuple, b: tuple) -> Array:
    return sum(x * y for x, y in zip(a, b))


def shoot(system: System, aim: Array) -> tuple[Array, Array, Array]:
    """Rays launched at `aim` (D, W, Q): hits (D, S + 1, W, Q), what became of them, a `Status`
    (W, Q), and how many surfaces they passed (W, Q), the sensor being the last; the hits after
    these are void."""
    count = len(system.forms)
    point = (*aim, jnp.broadcast_to(system.vertex[0], aim.shape[1:]))
    direction = tuple(system.vergence * p - s for p, s in zip(point, system.source))
    shrink = 1 / jnp.sqrt(_dot(direction, direction))
    direction = tuple(d * shrink for d in direction)
    index = jnp.concatenate([system.index, system.index[-1:]])
    senses = jnp.append(system.senses, system.senses[-1])
    offset = jnp.zeros((aim.shape[0], count), aim.dtype)
    offset = offset if system.offset is None else system.offset
    rotation = None if system.rotation is None else jnp.moveaxis(system.rotation, -1, 0)
    kinds = sorted(set(system.forms))
    settled = max(_SETTLED, 16 * float(jnp.finfo(aim.dtype).eps))
    crossings = [partial(_crossing, kind, settled) for kind in kinds]
    rows = (
        np.arange(count) == 0,
        jnp.concatenate([offset, system.vertex[None]]).T,
        rotation,
        jnp.array([kinds.index(form) for form in system.forms]),
        Shape(system.curvature, system.conic, system.coefficients.T),
        (index[:-1] / index[1:])[..., None],
        senses[:-1],
        senses[1:],
    )

    def step(carry, row):
        point, d, fate, passed = carry
        first, origin, rotation, kind, shape, ratio, sense, leaving = row
        p = tuple(a - o for a, o in zip(point, origin))
        p, d = turned(rotation, p, back=True), turned(rotation, d, back=True)
        cross = crossings[0] if len(kinds) == 1 else partial(jax.lax.switch, kind, crossings)
        own, normal, along, met, length = cross(p, d, shape, fate == Status.OK)
        shrink = 1 / jnp.sqrt(_dot(normal, normal))
        cosine = along * shrink
        square = 1 - ratio**2 * (1 - cosine**2)
        # Light goes forwards, and meets a surface from the front.
        met = met & (d[-1] * sense > _FLATTEST) & ((length > 0) | first) & (along * sense > 0)
        here = jnp.where(met, jnp.where(square > 0, Status.OK, Status.TIR), Status.MISSED)
        fate = jnp.where(fate == Status.OK, here.astype(jnp.int32), fate)
        passed = passed + (fate == Status.OK).astype(jnp.int32)
        bent = (leaving * safe_sqrt(square) - ratio * cosine) * shrink
        d = tuple(ratio * a + bent * n for a, n in zip(d, normal))
        hit = jnp.stack(own[:-1])
        own, d = turned(rotation, own), turned(rotation, d)
        return (tuple(a + o for a, o in zip(own, origin)), d, fate, passed), hit

    fate = jnp.zeros(aim.shape[1:], jnp.int32)
    carry, hits = jax.lax.scan(step, (point, direction, fate, jnp.zeros_like(fate)), rows)
    return jnp.moveaxis(hits, 0, 1), *carry[2:]


def _crossing(form: str, settled: float, p: tuple, d: tuple, shape: Shape, going: Array) -> tuple:
    """Where rays p + s d meet a surface of a form: the point, a normal of any length along z, its
    product with d, whether they meet, and s. Those `going` (W, Q) must settle within `settled`."""
    length = -safe_divide(p[-1], d[-1])  # to the vertex plane
    met = jnp.ones(length.shape, bool)
    if form == "asphere":
        # c (x^2 + y^2 + (1 + k) z^2) = 2 z at p + s d: square s^2 - 2 linear s + constant = 0
        c, k = shape.curvature, shape.conic
        flat = *d[:-1], (1 + k) * d[-1]
        square, linear = c * _dot(flat, d), d[-1] - c * _dot(flat, p)
        constant = c * (_dot(p[:-1], p[:-1]) + (1 + k) * p[-1] ** 2) - 2 * p[-1]
        discriminant = linear**2 - square * constant
        root = safe_sqrt(discriminant)
        root = jnp.where(d[-1] < 0, -root, root)
        # Of the two ways to write a root, the one that does not subtract what is alike.
        alike = linear * root < 0
        above = jnp.where(alike, linear - root, constant)
        below = jnp.where(alike, square, linear + root)
        length, met = safe_divide(above, below), discriminant > 0
        if not shape.coefficients.shape[0]:
            own = tuple(a + b * length for a, b in zip(p, d))
            normal = *(-c * a for a in own[:-1]), 1 - (1 + k) * c * own[-1]
            return own, normal, root, met & (normal[-1] > RIM**0.5), length

    def reached(length):
        return jnp.stack([a + b * length for a, b in zip(p[:-1], d)])

    def closer(state):
        count, length, _ = state
        z, slope, _ = sag_derivatives(reached(length), shape, form)
        miss = z - p[-1] - d[-1] * length
        change = safe_divide(miss, d[-1] - _dot(slope, d))
        return count + 1, length + change, jnp.abs(change) <= settled * (1 + jnp.abs(length))

    _, length, met = jax.lax.while_loop(
        lambda state: (state[0] < _STEPS) & jnp.any(going & ~state[2]),
        closer,
        (0, length, jnp.zeros(length.shape, bool)),
    )
    w = reached(length)
    z, slope, _ = sag_derivatives(w, shape, form)
    normal = *(-a for a in slope), jnp.ones_like(z)
    return (*w, z), normal, _dot(normal, d), met & domain(w, shape, form), length
