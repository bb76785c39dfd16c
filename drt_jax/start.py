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
from .surface import Shape, sag, sag_derivatives, vertex_curvature

__all__ = ["Guess", "first_guess"]

_ASPHERE_STEPS = 3
_FREEFORM_STEPS = 8
# Two re-aims serve an ordinary lens: a bundle whose rays then miss the stop points by less than
# `_LOOSE` of the beam's radius or of the gaps beside the stop is left to the solver. Else the search goes on until all are
# within `_TIGHT` or given up.
_AIM_STEPS = 2
_LOOSE, _TIGHT = 0.03, 1e-6
# The search after that sends a fan of rays, in `_TILES` tiles a side of `_FAN` rays a side, and
# begins where it comes nearest, in the `_STARTS` best tiles: a folded beam reaches one stop point
# from several sides. An attempt ends after so many trials in a row that came no nearer, or so
# many in all.
_TILES, _FAN, _STARTS = 7, 9, 6
_PATIENCE, _ATTEMPT = 8, 48
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
    of the best at the stop, length far (W, Q), inf before one arrived; inverse (D, D, W, Q),
    launch by stop point; attempt, age and bad (W, Q): the attempts made, the trials of this one
    and those in a row that came no nearer; fate (W, Q), of the last ray lost; count (), of
    trials; starts (K, D, W, Q), where attempts begin; round (), 1 after the fan; last (),
    the attempts allowed; hits (D, S + 1, W, Q) and known (W, Q), those of the best launch points
    and what becomes of these rays; again (), whether there was a first round."""

    aim: Array
    step: Array
    miss: Array
    far: Array
    inverse: Array
    attempt: Array
    age: Array
    bad: Array
    fate: Array
    count: Array
    starts: Array
    round: Array
    last: Array
    hits: Array
    known: Array
    again: Array


def first_guess(system: System) -> Guess:
    """Hits of rays near those through the stop points of `system`.

    Rays are traced forward by Snell's law, aimed through the paraxial entrance pupil, and
    re-aimed by what they miss the stop point (see `_search`); where no ray is found, paraxial
    hits stand in. Where the stop is the first surface there is nothing to search for.
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

    # Rays are labelled by where they would cross the vertex plane of the first surface.
    if stop == 0:
        hits, fate = _trace(system, _launch(system), count)
    else:
        scale = safe_divide(axial[:, 0, :, None], magnification)
        hits, fate = _search(system, paraxial[:, 0], scale)
    if system.offset is not None:
        paraxial = paraxial - system.offset[..., None, None]
    return Guess(jnp.where(fate == Status.OK, hits, paraxial), fate)


def _launch(system: System) -> Array:
    """Where rays through the points of a stop that comes first cross its vertex plane."""
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


def _search(system: System, aim: Array, scale: Array) -> tuple[Array, Array]:
    """Hits (D, S + 1, W, Q) of rays nearly through the stop points, and why there is none (W, Q).

    Broyden's method. It begins with the paraxial `aim` and `scale` (D, W, 1) of launch by stop
    point; a step after which the ray is lost or farther off is halved. Rays that this does not
    find, or that it finds and the surfaces behind the stop lose, begin anew where a ray of a fan
    comes near and reaches the sensor, with a small step along each component to learn the
    derivatives.
    """
    stop, dtype, dim = system.stop, aim.dtype, aim.shape[0]
    starts, count = min(_STARTS, _TILES**dim), len(system.forms)
    beam = jnp.max(_length(system.crossings))
    lean = _length(system.source[:-1])
    depth = jnp.abs(system.vertex[stop] - system.vertex[0])
    width = 2 * beam + lean * (depth + beam) + 0.02 * depth
    beam = jnp.where(beam > 0, beam, 0.1 * width)
    # Where the stop is imaged to infinity, the paraxial aim lies beyond any lens.
    aim = aim * jnp.minimum(1, 4 * width / jnp.maximum(_length(aim), width))
    span = jnp.maximum(2 * width, 1.6 * jnp.max(_length(aim)))  # of the fan
    # Where the stop all but touches a neighbour, a small miss is a large angle there.
    gap = jnp.min(jnp.abs(jnp.diff(system.vertex[stop - 1 : stop + 2])))
    loose = _LOOSE * jnp.minimum(beam, gap)
    tight = jnp.minimum(_TIGHT * beam, _LOOSE * gap)
    tight = jnp.maximum(tight, 256 * jnp.finfo(dtype).eps * beam)
    loose = jnp.maximum(loose, tight)
    probe = 1e-4 * width * jnp.eye(dim, dtype=dtype)[..., None, None]
    shape = jnp.broadcast_shapes(aim.shape, system.crossings.shape)
    aim, none = jnp.broadcast_to(aim, shape), jnp.zeros(shape, dtype)
    zero = jnp.zeros(shape[1:], jnp.int32)

    def again(state):
        first = (state.round == 0) & jnp.all(state.far <= loose)
        return (
            ~(first & (state.count == _AIM_STEPS))
            & jnp.any((state.far > tight) & (state.attempt < state.last))
            & (state.count < _ATTEMPT * starts)
        )

    def body(state):
        first, fresh = state.age == 0, state.starts[0]
        for k in range(1, starts):
            fresh = jnp.where(state.attempt == k, state.starts[k], fresh)
        trial = jnp.where(first, fresh, state.aim + state.step)
        hits, fate = _trace(system, trial, jnp.where(state.round == 0, stop + 1, count))
        miss, arrived = system.crossings - hits[:, stop], fate == Status.OK
        far = jnp.where(arrived, _length(miss), jnp.inf)
        better = far < state.far
        # Broyden's update from the best ray to this one.
        moved, change = trial - state.aim, state.miss - miss
        back = jnp.sum(state.inverse * change, axis=1)
        row = jnp.sum(moved[:, None] * state.inverse, axis=0)
        scale = jnp.sum(row * change, axis=0)
        usable = arrived & ~first & (jnp.abs(scale) > 1e-3 * jnp.sum(moved**2, axis=0))
        inverse = state.inverse + safe_divide(
            (moved - back)[:, None] * row, jnp.where(usable, scale, 0)
        )
        best, miss = (jnp.where(better, a, b) for a, b in ((trial, state.aim), (miss, state.miss)))
        far = jnp.minimum(far, state.far)
        # After a bad step half as far at most, after a good one twice as far.
        step = jnp.sum(inverse * miss, axis=1)
        bad = jnp.where(better, 0, state.bad + 1)
        probing = (state.round > 0) & (state.age < dim)
        step = jnp.where(arrived, step, state.step / 2)
        bound = jnp.where(better, 2, 0.5).astype(dtype) * _length(state.step)
        early = jnp.where(state.round > 0, width / 8, width)
        bound = jnp.where(first | (state.age == jnp.where(state.round > 0, dim, 0)), early, bound)
        step = step * jnp.minimum(1, safe_divide(bound, _length(step)))
        for d in range(dim):
            step = jnp.where(probing & (state.age == d), probe[d], step)
        age = state.age + 1
        ended = (first & ~arrived) | (~probing & (bad > _PATIENCE)) | (age > _ATTEMPT)
        ended = ended & (far > tight) & (state.attempt < state.last)
        return state._replace(
            aim=best, step=step, miss=miss, far=jnp.where(ended, jnp.inf, far), inverse=inverse,
            attempt=state.attempt + ended.astype(jnp.int32), age=jnp.where(ended, 0, age),
            bad=jnp.where(ended, 0, bad), fate=jnp.where(arrived, state.fate, fate),
            count=state.count + 1,
        )  # fmt: skip

    def fan(state):
        """The launch points nearest to what is not found yet."""
        side = np.linspace(-1, 1, _TILES * _FAN)
        side = (side * (0.3 + 0.7 * side**2)).reshape(_TILES, _FAN)
        points = np.stack(np.meshgrid(*[np.arange(side.size)] * dim, indexing="ij"))
        points = side.ravel()[points].reshape(dim, *(_TILES, _FAN) * dim)
        tiles = (0, *range(1, 2 * dim, 2), *range(2, 2 * dim + 1, 2))
        points = jnp.asarray(points.transpose(tiles).reshape(dim, 1, -1), dtype) * span
        # XLA would work out what does not depend on the state before the loop, needed or not.
        points = jnp.where(state.round == 0, points, 0)
        points = jnp.broadcast_to(points, (dim, shape[1], points.shape[-1]))
        hits, fate = _trace(system, points, count)
        miss = _length(system.crossings[..., None] - hits[:, stop, :, None])
        far = jnp.where((fate == Status.OK)[:, None], miss, jnp.inf)
        far = far.reshape(*shape[1:], _TILES**dim, _FAN**dim)
        nearest = jnp.argmin(far, axis=-1).astype(jnp.int32)
        best = jax.lax.top_k(-jnp.min(far, axis=-1), starts)[1]
        nearest = jnp.take_along_axis(nearest, best, axis=-1) + best * _FAN**dim
        chosen = jnp.take_along_axis(points[:, :, None], nearest[None], axis=-1)
        done = state.known == Status.OK
        return state._replace(
            starts=jnp.moveaxis(chosen, -1, 0), far=jnp.where(done, state.far, jnp.inf),
            attempt=jnp.where(done, state.attempt, 0), age=jnp.where(done, state.age, 0),
            bad=zero, count=jnp.int32(0), round=state.round + 1, last=jnp.int32(starts),
        )  # fmt: skip

    def stage(state):
        # A loop of one turn, rather than a branch, so that under `vmap` too it costs nothing.
        state = jax.lax.while_loop(lambda s: s.again & (s.round == 0), fan, state)
        state = jax.lax.while_loop(again, body, state)
        hits, fate = _trace(system, state.aim, count)
        last = jnp.where(state.fate == Status.OK, jnp.int32(Status.UNCONVERGED), state.fate)
        fate = jnp.where(state.far <= loose, fate, last)
        # If the fan does not help, the first attempt knows best what stops the ray.
        kept = state.again & (fate != Status.OK) & (state.known != Status.UNCONVERGED)
        return state._replace(
            hits=hits, known=jnp.where(kept, state.known, fate), again=jnp.bool_(True)
        )

    def unsolved(state):
        return ~state.again | ((state.round == 0) & jnp.any(state.known != Status.OK))

    inverse = jnp.eye(dim, dtype=dtype)[..., None, None] * jnp.where(scale == 0, 1, scale)
    start = _Aim(
        aim, none, none, jnp.full(shape[1:], jnp.inf, dtype),
        jnp.broadcast_to(inverse, (dim, *shape)), zero, zero, zero, zero, jnp.int32(0),
        jnp.broadcast_to(aim, (starts, *shape)), jnp.int32(0), jnp.int32(1),
        jnp.zeros((dim, count, *shape[1:]), dtype), zero, jnp.bool_(False),
    )  # fmt: skip
    end = jax.lax.while_loop(unsolved, stage, start)
    return end.hits, end.known


def _length(a: Array) -> Array:
    return jnp.sqrt(jnp.sum(a * a, axis=0))


def _trace(system: System, aim: Array, count: int | Array) -> tuple[Array, Array]:
    """Sequential trace over the first `count` surfaces: hits (D, S + 1, W, Q), 0 on the others,
    and what became of the ray, a `Status` (W, Q)."""
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
    crossings = [_crossing(kind) for kind in kinds]

    def step(i, carry):
        point, d, fate, hits = carry
        origin, rotation, kind, shape, before, after, senses = jax.tree.map(lambda a: a[i], rows)
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
        return own + origin, d, fate, hits.at[:, i].set(w)

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
    _, _, fate, hits = jax.lax.fori_loop(0, count, step, (point, direction, fate, hits))
    return hits, fate


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
