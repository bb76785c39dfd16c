"""First guess of the hits: a real ray, aimed at the stop point as far as paraxial optics can.

The closer the guess, the fewer Newton steps; and a guess that already bends at every surface
keeps the iteration away from the rims, where a steep surface would send it astray.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .fermat import Status, System
from .numerics import safe_divide, safe_sqrt
from .paraxial import trace_yu
from .surface import Shape, sag_derivatives, vertex_curvature

__all__ = ["Guess", "first_guess"]

_ASPHERE_STEPS = 3
_FREEFORM_STEPS = 8
# Two re-aims serve an ordinary lens: a bundle whose rays then miss the stop points by less than
# `_LOOSE` of the beam's radius there is left to the solver. Else the search goes on until all are
# within `_TIGHT` or given up.
_AIM_STEPS = 2
_MAX_AIM_STEPS = 64
_LOOSE, _TIGHT = 0.03, 1e-6
# Where to begin again, in units of the paraxial aim, when that fails; then on a spiral.
_SCALES = (1.0, 0.75, 0.5, 0.25, 0.0, 1.25)
_GOLDEN = 2.399963229728653  # angle in radians that spreads points evenly
# A step shorter than this part of the width of the search leads nowhere.
_STALLED = 1e-7
# A guess that leans more than this (cosine with the axis) is not trusted.
_FLATTEST = 0.01


class Guess(NamedTuple):
    """hits (D, S + 1, W, Q), mm, and what stopped the ray that was nearest to the stop point,
    a `Status` (W, Q), int32: OK if it reached the sensor, UNCONVERGED if nothing did and yet
    the ray through the stop point was not found."""

    hits: Array
    fate: Array


class _Aim(NamedTuple):
    """aim, step (D, W, Q): the best launch point and the step to the next trial; miss (D, W, Q),
    of the best at the stop; inverse (D, D, W, Q), launch point by stop point; found (W, Q),
    whether any trial arrived; fate (W, Q), of the last trial; count ()."""

    aim: Array
    step: Array
    miss: Array
    inverse: Array
    found: Array
    fate: Array
    count: Array


def first_guess(system: System) -> Guess:
    """Hits of rays near those through the stop points of `system`.

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
    missed = jnp.int32(Status.OK)
    if stop:
        aim, missed = _search(system, aim, safe_divide(axial[:, 0, :, None], magnification))
    hits, fate = _trace(system, aim, count)
    if system.offset is not None:
        paraxial = paraxial - system.offset[..., None, None]
    return Guess(
        jnp.where(fate == Status.OK, hits, paraxial), jnp.where(missed != Status.OK, missed, fate)
    )


def _search(system: System, aim: Array, scale: Array) -> tuple[Array, Array]:
    """Launch points (D, W, Q) of rays through the stop points, and why there is none (W, Q).

    Broyden's method, which begins with the paraxial `scale` (D, W, 1) of launch by stop point;
    a step after which the ray is lost or farther off is halved; where the steps lead nowhere,
    the search begins anew elsewhere.
    """
    stop, dtype = system.stop, aim.dtype
    dim = aim.shape[0]
    beam = jnp.max(_length(system.crossings))
    lean = _length(system.source[:-1])
    depth = jnp.abs(system.vertex[stop] - system.vertex[0])
    width = 2 * beam + lean * (depth + beam) + 0.02 * depth
    beam = jnp.where(beam > 0, beam, 0.1 * width)
    # Where the stop is imaged to infinity, the paraxial aim lies beyond any lens.
    aim = aim * jnp.minimum(1, safe_divide(4 * width, _length(aim)))
    identity = jnp.eye(dim, dtype=dtype)[..., None, None]
    inverse = jnp.broadcast_to(identity * scale, (dim, *aim.shape))
    tight = jnp.maximum(_TIGHT, 256 * jnp.finfo(dtype).eps) * beam
    scales = jnp.asarray(_SCALES, dtype)

    def fresh(count):
        """The launch point to begin with at trial `count`."""
        k = count.astype(dtype)
        angle = _GOLDEN * k
        round_ = jnp.stack([jnp.sin(angle), jnp.cos(angle)])[-dim:, None, None]
        spread = width * jnp.sqrt(k / _MAX_AIM_STEPS) * round_
        some = jnp.minimum(count, len(_SCALES) - 1)
        return jnp.where(count < len(_SCALES), aim * scales[some], spread)

    def off(state):
        return jnp.where(state.found, _length(state.miss), jnp.inf)

    def again(state):
        far = off(state)
        ended = jnp.all(far <= _LOOSE * beam) & (state.count == _AIM_STEPS)
        return ~ended & jnp.any(far > tight) & (state.count < _MAX_AIM_STEPS)

    def body(state):
        trial = jnp.where(state.found, state.aim + state.step, fresh(state.count))
        hits, fate = _trace(system, trial, stop + 1)
        miss, arrived = system.crossings - hits[:, stop], fate == Status.OK
        better = arrived & (_length(miss) < off(state))
        # Broyden's update from the best ray to this one.
        moved, change = trial - state.aim, state.miss - miss
        back = jnp.sum(state.inverse * change, axis=1)
        row = jnp.sum(moved[:, None] * state.inverse, axis=0)
        scale = jnp.sum(row * change, axis=0)
        usable = arrived & state.found & (jnp.abs(scale) > 1e-3 * jnp.sum(moved**2, axis=0))
        correction = safe_divide((moved - back)[:, None] * row, jnp.where(usable, scale, 0))
        inverse = state.inverse + correction
        step = jnp.sum(inverse * jnp.where(better, miss, state.miss), axis=1)
        # Never farther than the search is wide; after a bad step, half as far at most.
        bound = jnp.where(better, width, _length(state.step) / 2)
        step = jnp.where(arrived, step, state.step / 2)
        step = step * jnp.minimum(1, safe_divide(bound, _length(step)))
        found = state.found | arrived
        far = jnp.where(better, _length(miss), off(state))
        stalled = found & (_length(step) < _STALLED * width) & (far > tight)
        return _Aim(
            jnp.where(better, trial, state.aim), step, jnp.where(better, miss, state.miss),
            inverse, found & ~stalled, fate, state.count + 1,
        )  # fmt: skip

    shape = jnp.broadcast_shapes(aim.shape, system.crossings.shape)
    aim = jnp.broadcast_to(aim, shape)
    none = jnp.zeros(shape[1:], bool)
    start = _Aim(
        aim, jnp.zeros(shape, dtype), jnp.zeros(shape, dtype), inverse, none,
        none.astype(jnp.int32), jnp.array(0),
    )  # fmt: skip
    end = jax.lax.while_loop(again, body, start)
    failed = jnp.where(end.fate == Status.OK, jnp.int32(Status.UNCONVERGED), end.fate)
    return end.aim, jnp.where(off(end) <= _LOOSE * beam, jnp.int32(Status.OK), failed)


def _length(a: Array) -> Array:
    return jnp.sqrt(jnp.sum(a * a, axis=0))


def _trace(system: System, aim: Array, count: int) -> tuple[Array, Array]:
    """Sequential trace over the first `count` surfaces: hits (D, count, W, Q), and what became
    of the ray, a `Status` (W, Q)."""
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
        point, d, fate = carry
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
        lost = ~met | (refracted[-1] * senses[1] <= _FLATTEST)
        here = jnp.where(met & (square <= 0), Status.TIR, jnp.where(lost, Status.MISSED, Status.OK))
        fate = jnp.where(fate == Status.OK, here.astype(jnp.int32), fate)
        # A failed ray goes straight on, and stays finite.
        d = jnp.where(fate == Status.OK, refracted, d)
        own = jnp.concatenate([w, z[None]])
        if rotation is not None:
            own = jnp.sum(rotation[..., None, None] * own[None], axis=1)
            d = jnp.sum(rotation[..., None, None] * d[None], axis=1)
        return (own + origin, d, fate), w

    flat = jnp.broadcast_to(direction[-1] <= _FLATTEST, aim.shape[1:])
    carry = point, direction, jnp.where(flat, jnp.int32(Status.MISSED), jnp.int32(Status.OK))
    rotation = None if system.rotation is None else jnp.moveaxis(system.rotation, -1, 0)[:count]
    xs = (
        jnp.moveaxis(origin, 1, 0)[:count], rotation,
        np.array([kinds.index(form) for form in system.forms[:count]]),
        Shape(system.curvature[:count], system.conic[:count], system.coefficients.T[:count]),
        index[:count], index[1 : count + 1], jnp.stack([senses[:-1], senses[1:]], 1)[:count],
    )  # fmt: skip
    (_, _, fate), hits = jax.lax.scan(step, carry, xs)
    return jnp.moveaxis(hits, 0, 1), fate


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
        for _ in range(steps if shape.coefficients.shape[0] else 0):
            length = closer(p, d, length, shape)
        w = p[:-1] + d[:-1] * length
        z, slope, _ = sag_derivatives(w, shape, form)
        return w, z, slope, met

    return cross
