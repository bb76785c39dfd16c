"""The search for the rays through given points of the stop, from a first guess to a verdict.

A real ray is aimed at each stop point and then polished by Newton's method on the Fermat system,
which the caller brings. Rays that this does not find, and only those, are sought a second time
among a fan of rays over the first surface.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .aiming import Aiming
from .fermat import Status, System
from ..numerics import safe_divide
from ..lens.paraxial import trace_yu
from .sequential import launch, shoot
from ..lens.surface import Shape, vertex_curvature

__all__ = ["find_rays"]

# Two re-aims serve an ordinary lens: a bundle whose rays then miss the stop points by less than
# `_LOOSE` of the beam's radius or of the gaps beside the stop is left to Newton's method. Else the
# search goes on until all are within `_TIGHT` of the radius, or given up.
_AIM_STEPS = 2
_LOOSE, _TIGHT = 0.03, 1e-6
# The second search has no loose end: a ray within `_EXACT` is as good as traced. Its fan has
# `_TILES` tiles a side of `_FAN` rays a side. It begins where the fan comes nearest, in the
# `_STARTS` best tiles: a folded beam reaches one stop point from several sides.
_EXACT = 1e-10
_TILES, _FAN, _STARTS = 15, 5, 24
# An attempt ends after so many trials in a row that came no nearer, or so many in all.
_PATIENCE, _ATTEMPT = 20, 96
# What comes next: the first search, the fan, the second search.
_FIRST, _SPREAD, _SECOND = range(3)


class _Aim(NamedTuple):
    """aim, step (D, W, Q): the best launch point and the step to the next trial; miss (D, W, Q),
    of the best at the stop, length far (W, Q), inf before one arrived; inverse (D, D, W, Q),
    launch by stop point; hits (D, S + 1, W, Q) and fate (W, Q), of the best; attempt (W, Q), -1 for
    one that goes on from the first search; age and bad (W, Q): the trials of this attempt and
    those in a row that came no nearer; lost (W, Q), the fate of the last ray that did not arrive;
    trials (), of the search; nearest (K, W, Q), the rays of the fan that attempts begin with;
    stage (); status (W, Q) and steps (), so far."""

    aim: Array
    step: Array
    miss: Array
    far: Array
    inverse: Array
    hits: Array
    fate: Array
    attempt: Array
    age: Array
    bad: Array
    lost: Array
    trials: Array
    nearest: Array
    stage: Array
    status: Array
    steps: Array


def find_rays(
    system: System, polish: Callable, aiming: Aiming | None = None, thorough: bool = True
) -> tuple[Array, Array, Array]:
    """Hits (D, S + 1, W, Q), mm, their `Status` (W, Q), int32, and Newton steps () of the rays
    through the stop points of `system`.

    `polish(hits, active)` improves the hits of the `active` (W, Q) rays and returns all, which of
    the active ones are solved (W, Q), and its steps (). Status of a ray that is not solved: what stopped
    the rays nearest to the stop point; UNCONVERGED if a ray that came near reached the sensor, or
    if nothing stopped them and yet none came near. Where the stop is the first surface, there is
    nothing to search for. `aiming`: where to launch the rays, if that is known well. Not
    `thorough`: no second search.
    """
    if system.stop == 0:
        hits, fate, _ = shoot(system, launch(system, system.crossings))
        hits = jnp.where(fate == Status.OK, hits, 0)
        hits, solved, steps = polish(hits, fate == Status.OK)
        return hits, _verdict(fate, solved), steps

    aim, scale = _paraxial_aim(system)
    dtype, dim = aim.dtype, aim.shape[0]
    beam, width = _sizes(system)
    # Where the stop is imaged to infinity, the paraxial aim lies beyond any lens.
    aim = aim * jnp.minimum(1, 4 * width / jnp.maximum(_length(aim), width))
    shape = jnp.broadcast_shapes(aim.shape, system.crossings.shape)
    aim, none = jnp.broadcast_to(aim, shape), jnp.zeros(shape, dtype)
    fan = jnp.maximum(2 * width, 1.6 * jnp.max(_length(aim))) * _fan(dim, dtype)
    # Where the stop all but touches a neighbour, a small miss is a large angle there.
    gap = jnp.min(jnp.abs(jnp.diff(system.vertex[system.stop - 1 : system.stop + 2])))
    rounding = 256 * jnp.finfo(dtype).eps * beam
    tight = jnp.maximum(jnp.minimum(_TIGHT * beam, _LOOSE * gap), rounding)
    loose = jnp.maximum(_LOOSE * jnp.minimum(beam, gap), tight)
    exact = jnp.maximum(jnp.minimum(_EXACT * beam, tight), rounding)

    def search(state):
        second = (state.stage == _SECOND) & thorough
        last = jnp.where(second, _STARTS, 1)
        goal = jnp.where(second, exact, tight if aiming is None else rounding / 4)

        def going(state):
            near = ~second & (state.trials == _AIM_STEPS) & jnp.all(state.far <= loose)
            open_ = (state.far > goal) & (state.attempt < last)
            return ~near & jnp.any(open_) & (state.trials < _ATTEMPT * last)

        def trial(state):
            state = _trial(system, state, second, fan, width)
            probing = second & (state.attempt >= 0) & (state.age <= dim)
            ended = ~probing & ((state.bad > _PATIENCE) | (state.age > _ATTEMPT))
            ended = ended | (second & (state.age == 1) & jnp.isinf(state.far))
            ended = ended & (state.far > goal) & (state.attempt < last)
            near = second & (state.far <= tight)  # no nearer for rounding: good enough
            attempt = jnp.where(near, last, state.attempt + 1).astype(jnp.int32)
            return state._replace(
                attempt=jnp.where(ended, attempt, state.attempt),
                far=jnp.where(ended & ~near, jnp.inf, state.far),
                age=jnp.where(ended, 0, state.age),
                bad=jnp.where(ended, 0, state.bad),
            )

        return jax.lax.while_loop(going, trial, state)

    def turn(state):
        # A loop of one turn, rather than a branch, so that under `vmap` too it costs nothing.
        if thorough:
            state = jax.lax.while_loop(
                lambda s: s.stage == _SPREAD, lambda s: _spread(system, s, fan, loose), state
            )
        state = search(state)
        done = state.status == Status.OK
        lost = jnp.where(state.lost == Status.OK, Status.UNCONVERGED, state.lost)
        fate = jnp.where(state.far <= loose, state.fate, lost)
        hits, solved, steps = polish(state.hits, ~done & (fate == Status.OK))
        status = _verdict(fate, done | solved)
        # If the fan does not help, the first search knows best what stops the ray.
        kept = (state.stage == _SECOND) & (status != Status.OK)
        kept = kept & (state.status != Status.UNCONVERGED)
        return state._replace(
            hits=hits,
            status=jnp.where(kept, state.status, status),
            steps=state.steps + steps,
            stage=state.stage + 1,
        )

    def unsolved(state):
        failed = jnp.any(state.status != Status.OK)
        return (state.stage == _FIRST) | ((state.stage == _SPREAD) & failed)

    inverse = jnp.eye(dim, dtype=dtype)[..., None, None] * jnp.where(scale == 0, 1, scale)
    inverse = jnp.broadcast_to(inverse, (dim, *shape))
    if aiming is not None:
        aimed = aiming.at(system.crossings)
        aim, inverse = (jnp.where(aiming.good, *pair) for pair in zip(aimed, (aim, inverse)))
    zero, nothing = jnp.zeros(shape[1:], jnp.int32), jnp.int32(0)
    start = _Aim(
        aim,
        none,
        none,
        jnp.full(shape[1:], jnp.inf, dtype),
        inverse,
        jnp.zeros((dim, len(system.forms), *shape[1:]), dtype),
        zero,
        zero,
        zero,
        zero,
        zero,
        nothing,
        jnp.zeros((_starts(dim), *shape[1:]), jnp.int32),
        jnp.int32(_FIRST),
        zero + Status.UNCONVERGED,
        nothing,
    )
    end = jax.lax.while_loop(unsolved, turn, start) if thorough else turn(start)
    return end.hits, end.status, end.steps


def _verdict(fate: Array, solved: Array) -> Array:
    failed = jnp.where(fate == Status.OK, Status.UNCONVERGED, fate)
    return jnp.where(solved, Status.OK, failed).astype(jnp.int32)


def _length(a: Array) -> Array:
    return jnp.sqrt(jnp.sum(a * a, axis=0))


def _paraxial_aim(system: System) -> tuple[Array, Array]:
    """Launch points (D, W, Q) of rays through the paraxial entrance pupil, mm, and (D, W, 1) by
    how much they move with the stop point."""
    stop, dim = system.stop, system.target.shape[0]
    plain = Shape(system.curvature, system.conic, system.coefficients)
    bent = vertex_curvature(plain, system.forms, dim).T[..., None]
    # In a mirrored space, distances and indices are both negative.
    index = jnp.concatenate([system.index, system.index[-1:]])
    senses = system.senses[:, 0]
    signed = index * jnp.concatenate([senses, senses[-1:]])
    one = jnp.ones((dim, system.index.shape[1]), index.dtype)
    reach = system.vertex[0]  # the first surface of the system need not be the first vertex
    v, gaps = system.vergence, jnp.diff(system.vertex)
    # Two rays (S + 1, D, W): from the object's point on the axis, and slanted.
    axial, _ = trace_yu(bent, gaps, signed, one * (1 + reach * v), one * v)
    tilted, _ = trace_yu(bent, gaps, signed, one * reach, one)
    tangent = -system.source[:-1, None, None]
    target = system.crossings
    if system.offset is not None:
        target = target + system.offset[:, stop, None, None]
    magnification = axial[stop, ..., None]
    amplitude = safe_divide(target - tangent * tilted[stop, ..., None], magnification)
    aim = amplitude * axial[0, ..., None] + tangent * tilted[0, ..., None]
    return aim, safe_divide(axial[0, ..., None], magnification)


def _sizes(system: System) -> tuple[Array, Array]:
    """Radius of the beam at the stop, and how wide it may be on the first surface, mm."""
    beam = jnp.max(_length(system.crossings))
    lean = _length(system.source[:-1])
    depth = jnp.abs(system.vertex[system.stop] - system.vertex[0])
    width = 2 * beam + lean * (depth + beam) + 0.02 * depth
    return jnp.where(beam > 0, beam, 0.1 * width), width


def _trial(system: System, state: _Aim, second: Array, fan: Array, width: Array) -> _Aim:
    """One trial of every ray, and by Broyden's method the step to the next.

    After a step with which the ray is lost or farther off, the next is half as long; an attempt
    that begins with a ray of the fan learns the derivatives by a small step along each component.
    """
    dim, dtype = state.aim.shape[0], state.aim.dtype
    fresh = second & (state.attempt >= 0)
    first = fresh & (state.age == 0)
    which = jnp.clip(state.attempt, 0, state.nearest.shape[0] - 1)[None]
    begin = fan[:, jnp.take_along_axis(state.nearest, which, axis=0)[0]]
    trial = jnp.where(first, begin, state.aim + state.step)
    hits, fate, passed = shoot(system, trial)
    miss = system.crossings - hits[:, system.stop]
    arrived = jnp.where(second, fate == Status.OK, passed > system.stop)
    far = jnp.where(arrived, _length(miss), jnp.inf)
    better = far < state.far
    # Broyden's update from the best ray to this one.
    moved, change = trial - state.aim, state.miss - miss
    back = jnp.sum(state.inverse * change, axis=1)
    row = jnp.sum(moved[:, None] * state.inverse, axis=0)
    scale = jnp.sum(row * change, axis=0)
    usable = arrived & ~first & (jnp.abs(scale) > 1e-3 * jnp.sum(moved**2, axis=0))
    update = safe_divide((moved - back)[:, None] * row, jnp.where(usable, scale, 0))
    inverse = state.inverse + update
    new, old = (trial, miss, hits, fate), (state.aim, state.miss, state.hits, state.fate)
    aim, miss, hits, best = (jnp.where(better, *pair) for pair in zip(new, old))
    # After a bad step half as far at most, after a good one twice as far.
    step = jnp.where(arrived, jnp.sum(inverse * miss, axis=1), state.step / 2)
    bound = jnp.where(better, 2, 0.5).astype(dtype) * _length(state.step)
    opening = first | (state.age == jnp.where(fresh, dim, 0))
    bound = jnp.where(opening, jnp.where(fresh, width / 8, width), bound)
    step = step * jnp.minimum(1, safe_divide(bound, _length(step)))
    for d, unit in enumerate(jnp.eye(dim, dtype=dtype)[..., None, None]):
        step = jnp.where(fresh & (state.age == d), 1e-4 * width * unit, step)
    return state._replace(
        aim=aim,
        step=step,
        miss=miss,
        far=jnp.minimum(far, state.far),
        inverse=inverse,
        hits=hits,
        fate=best,
        age=state.age + 1,
        bad=jnp.where(better, 0, state.bad + 1),
        lost=jnp.where(arrived, state.lost, fate),
        trials=state.trials + 1,
    )


def _starts(dim: int) -> int:
    return min(_STARTS, _TILES**dim)


def _fan(dim: int, dtype: jnp.dtype) -> Array:
    """Launch points (D, tiles * rays of a tile) between -1 and 1, denser in the middle."""
    side = np.linspace(-1, 1, _TILES * _FAN)
    side = (side * (0.3 + 0.7 * side**2)).reshape(_TILES, _FAN)
    places = np.meshgrid(*[np.arange(side.size)] * dim, indexing="ij")
    points = side.ravel()[np.stack(places)].reshape(dim, *(_TILES, _FAN) * dim)
    tiles = (0, *range(1, 2 * dim, 2), *range(2, 2 * dim + 1, 2))
    return jnp.asarray(points.transpose(tiles).reshape(dim, -1), dtype)


def _spread(system: System, state: _Aim, fan: Array, loose: Array) -> _Aim:
    """Where attempts for rays not solved yet begin; those that came near first go on from there."""
    dim, waves = fan.shape[0], state.far.shape[0]
    # XLA would work out what does not depend on the state before the loop, needed or not.
    fan = jnp.where(state.stage == _SPREAD, fan, 0)
    hits, fate, _ = shoot(system, jnp.broadcast_to(fan[:, None], (dim, waves, fan.shape[1])))
    there = jnp.where(fate == Status.OK, hits[:, system.stop], jnp.inf)
    tiles = there.reshape(dim, waves, _TILES**dim, _FAN**dim)

    def nearest(tile):  # (D, W, rays)
        far = _length(system.crossings[..., None] - tile[:, :, None])
        best = jnp.argmin(far, axis=-1)
        return jnp.min(far, axis=-1), best.astype(jnp.int32)

    far, best = jax.lax.map(nearest, jnp.moveaxis(tiles, 2, 0))
    far, best = jnp.moveaxis(far, 0, -1), jnp.moveaxis(best, 0, -1)
    order = jax.lax.top_k(-far, _starts(dim))[1]
    chosen = jnp.take_along_axis(best, order, axis=-1) + order * _FAN**dim
    solved = state.status == Status.OK
    near = (state.far <= loose) & ~solved
    return state._replace(
        nearest=jnp.moveaxis(chosen, -1, 0).astype(jnp.int32),
        far=jnp.where(solved, 0, jnp.inf).astype(state.far.dtype),
        step=jnp.where(near, 0, state.step),
        attempt=jnp.where(near, jnp.int32(-1), 0),
        age=jnp.zeros_like(state.age),
        bad=jnp.zeros_like(state.bad),
        trials=jnp.int32(0),
        stage=jnp.int32(_SECOND),
    )
