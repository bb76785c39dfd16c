"""Ray finding: for each stop point, a root of the Fermat equations and the label.

Rays are aimed and traced. A ray that misses its stop point by more than rounding is polished on the
Fermat equations. A ray that aiming does not find is searched for with a fan. For derivatives see
`solve`.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from ..numerics import run_if
from . import fermat, linear
from .aim import (
    STARTS,
    Fan,
    aim,
    aim_outwards,
    beam_size,
    nearest_start,
    no_fan,
    paraxial_launch,
    starts_of,
    trace_fan,
)
from .bundle import in_tiles, polynomial_launch, tile_of
from .snell import shoot, split_stop
from .status import Status
from .system import System, Vector, dot, subtract, where

_MAX_STEPS = 16  # Newton steps of the polish


class Found(NamedTuple):
    """Rays found through the stop points of a bundle.

    hits: D arrays (R, W, Q), on the active surfaces and the sensor, mm; 0 for failed rays.
    arrival: D + 1 arrays (W, Q), unit vectors at the sensor, along the axes of the lens; undefined
        for failed rays.
    status: (W, Q), int32, see `Status`.
    steps: (), int32, Newton steps of the bundle, aiming included.
    """

    hits: Vector
    arrival: Vector
    status: Array
    steps: Array


class _State(NamedTuple):
    """State of the polish.

    solved: (W, Q), bool, rays that are stationary to rounding.
    still: (), int32, number of steps in a row that moved no ray.
    step: (), int32, number of steps so far.
    """

    solved: Array
    still: Array
    step: Array


class BlockNewton(optx.AbstractRootFinder):
    """Newton's method for a bundle of Fermat paths, with the propagation of `linear` as its solve.

    The arguments of the equations are (system, target, mask (W, Q) of the rays that may move). All
    rays step together. A ray whose correction is not finite keeps its hits. The search ends when
    all rays are stationary to rounding (see `fermat.stationary`). It ends with
    RESULTS.nonlinear_divergence when two steps in a row move no ray by more than `atol` + `rtol`
    times its hits; the state then holds the mask of the solved rays.

    rtol, atol: tolerances on the hits, relative and in mm.
    norm: norm of a correction.
    """

    rtol: float
    atol: float
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first step; there is no step if no ray may move."""
        return _State(~args[2], jnp.zeros((), jnp.int32), jnp.zeros((), jnp.int32))

    def step(self, fn, y, args, options, state, tags) -> tuple[Vector, _State, Any]:
        """One Newton step of every ray that is not stationary yet."""
        system, target, _ = args
        (rhs, path), aux = fn(y, args)
        solved = state.solved | fermat.stationary(path, system, target)
        change, _ = linear.solve(path, system, ~solved, rhs)
        finite = jnp.all(jnp.isfinite(dot(change, change)), axis=0)
        moves = finite & ~solved
        change = where(moves, change, 0)
        # Relative to each hit, so that a diverging ray does not hide the corrections of others.
        scale = self.rtol / self.atol
        size = self.norm(tuple(c / (1 + scale * abs(a)) for a, c in zip(y, change, strict=True)))
        y = subtract(y, change)
        still = jnp.where(size <= self.atol, state.still + 1, 0)
        return y, _State(solved, still, state.step + 1), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Array, optx.RESULTS]:
        """True once all rays are stationary or none moves any more, and the result."""
        done, still = jnp.all(state.solved), state.still > 1
        results = optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        return done | still, optx.RESULTS.where(still & ~done, *results)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Returns the values unchanged."""
        return y, aux, {}


def _polish(system: System, target: Vector, hits: Vector, active: Array) -> tuple:
    """Makes the hits of the `active` rays (W, Q) stationary, by at most 16 Newton steps.

    Returns the hits, the mask of solved rays and the number of steps.
    """

    def equations(hits, args):
        system, target, _ = args
        path = fermat.geometry(hits, system)
        return (linear.shortfall(path, system, target), path), None

    eps = float(jnp.finfo(hits[0].dtype).eps)
    solution: optx.Solution = optx.root_find(
        equations,
        BlockNewton(rtol=2 * eps, atol=2 * eps),
        hits,
        args=(system, target, active),
        has_aux=True,
        max_steps=_MAX_STEPS,
        throw=False,
    )
    all_solved = solution.result == optx.RESULTS.successful
    return solution.value, all_solved | solution.state.solved, solution.stats["num_steps"]


def find(
    system: System, target: Vector, launch: Vector | None = None, searched: Array | bool = True
) -> Found:
    """Finds the rays through stop points; not differentiable.

    Rays that aiming does not find are searched for with a fan. Rays that miss their stop points by
    more than rounding are polished.

    target: D arrays (W, Q), stop points, mm.
    launch: D arrays (W, Q), first guesses of the launch points, mm; None for the paraxial launch.
    searched: (W, Q), bool, rays that are searched for with a fan; True for all.
    """
    sizes = beam_size(system, target)
    launch = paraxial_launch(system, target, sizes[1]) if launch is None else launch
    search = _search(system, target, launch, sizes, searched)
    ok = search.status == Status.OK
    hits, crossing = split_stop(system, search.hits)
    hits = where(ok, hits, 0)
    rough = ok & ~fermat.met(crossing, target, hits, system)
    hits, solved, steps = _polish(system, target, hits, rough)
    status = jnp.where(ok & ~solved, Status.UNCONVERGED, search.status).astype(jnp.int32)
    hits = where(status == Status.OK, hits, 0)
    return Found(hits, fermat.arrival(hits, system), status, search.steps + steps)


def _of_finite(search: Callable[[System, Vector, Array], Found]) -> Callable:
    """A search without stop points that are not finite: their rays are MISSED.

    search: takes the system, the stop points, and the mask (W, Q) of those that were finite.
    """

    @jax.jit
    @functools.wraps(search)
    def finite(system: System, target: Vector) -> Found:
        known = jnp.all(jnp.isfinite(jnp.stack(target)), axis=0)
        found = search(system, where(known, target, 0), known)
        status = jnp.where(known, found.status, Status.MISSED).astype(jnp.int32)
        return found._replace(hits=where(known, found.hits, 0), status=status)

    return finite


@_of_finite
def find_aimed(system: System, target: Vector, known: Array) -> Found:
    """Finds rays by aiming alone, see `aim_outwards`.

    Every ray that does not meet its stop point to rounding is UNCONVERGED. The compiled program is
    a third of that of `find`; where rays fail it takes a tenth of the time.

    target: D arrays (W, Q), stop points, mm.
    """
    aimed = aim_outwards(system, target)
    return _exact(system, target, aimed.launch, aimed.status)._replace(steps=aimed.steps)


def _exact(system: System, target: Vector, launch: Vector, status: Array) -> Found:
    """Traces rays from known launch points; those that do not meet their stop points to rounding
    are UNCONVERGED. Arguments as in `_verdict`.
    """
    hits, status = _verdict(system, launch, status)
    hits, crossing = split_stop(system, hits)
    ok = (status == Status.OK) & fermat.met(crossing, target, hits, system)
    hits = where(ok, hits, 0)
    status = jnp.where(ok, Status.OK, Status.UNCONVERGED).astype(jnp.int32)
    return Found(hits, fermat.arrival(hits, system), status, jnp.int32(0))


class Lanes:
    """Assigns the Q lanes of each wavelength to its first K = Q // N flagged rays.

    Each of these rays gets N neighbouring lanes, in the order of the rays. Lanes that remain repeat
    the last one. A search of the width Q can thus try N first guesses for each of K missing rays at
    a time.

    flagged: (W, Q), bool, rays that need lanes.
    each: N, lanes for each ray, at most Q.
    few: K, number of rays that can have lanes.
    served: (W, Q), bool, rays that have lanes.
    """

    def __init__(self, flagged: Array, each: int):
        self.each, self.few = each, flagged.shape[1] // each
        self._rank = jnp.cumsum(flagged, axis=-1, dtype=jnp.int32) - 1
        self.served = flagged & (self._rank < self.few)

    def of_rays(self, tree: Any) -> Any:
        """Gathers the entries (W, K) of arrays (W, Q) that belong to the rays with lanes.

        If fewer than K rays are flagged, the entries of the last ray of the bundle fill the rest.
        """
        count = self.served.shape[1]
        order = jnp.where(self.served, count - jnp.arange(count, dtype=jnp.int32), 0)
        rays = count - jax.lax.top_k(order, self.few)[0]
        return jax.tree.map(lambda a: jnp.take_along_axis(a, rays, 1, mode="clip"), tree)

    def spread(self, tree: Any) -> Any:
        """Spreads arrays (W, K, N) over the lanes, (W, Q). An array (W, K, 1) is repeated in all N
        lanes of a ray.
        """
        waves, rays = self.served.shape

        def wide(a: Array) -> Array:
            a = jnp.broadcast_to(a, (waves, self.few, self.each)).reshape(waves, -1)
            return jnp.pad(a, ((0, 0), (0, rays - a.shape[1])), mode="edge")

        return jax.tree.map(wide, tree)

    def best(self, quality: Array) -> tuple[Array, Array]:
        """The best lane of each ray.

        quality: (W, Q), quality of the trial in each lane; 0 for a failed trial.

        Returns the first lane with the highest quality among the lanes of each ray, (W, Q), int32;
        and a mask (W, Q) of the rays that have lanes and in one of them a quality above 0.
        """
        own = quality[:, : self.few * self.each].reshape(len(quality), self.few, self.each)
        slot = jnp.clip(self._rank, 0, self.few - 1)
        lane = jnp.take_along_axis(jnp.argmax(own, axis=-1).astype(jnp.int32), slot, axis=-1)
        found = jnp.take_along_axis(jnp.any(own > 0, axis=-1), slot, axis=-1)
        return slot * self.each + lane, found & self.served


class _Search(NamedTuple):
    """State of a search.

    hits: D arrays, mm, see `snell.Trace`.
    status: (W, Q), int32.
    left: (W, Q), int32, number of rounds left for each missing ray; 0 for a ray that is found or
        given up.
    fan: the fan, traced in round 1.
    round, steps: (), int32, rounds and Newton steps so far.
    """

    hits: Vector
    status: Array
    left: Array
    fan: Fan
    round: Array
    steps: Array


def _search(
    system: System, target: Vector, launch: Vector, sizes: tuple, searched: Array | bool
) -> _Search:
    """Searches for rays in rounds.

    - Round 0 aims all rays from their first guesses.
    - Round 1 traces a fan and aims the `searched` rays that failed, each from the nearest ray of
      the fan.
    - Each later round packs missing rays into the lanes of the bundle (`Lanes`), N lanes for each
      ray in the order of the rays, and aims each of them from N rays of the fan, the nearest to its
      stop point first. The best trial is kept; a ray in front of a fold of the beam is better than
      one beyond it. A ray is given up after R rounds in which it had lanes; N R lanes hold all
      `STARTS` first guesses.

    All rounds share one loop with as many lanes as rays, so that aiming is compiled once. The fan
    costs nothing while no ray is missing, also under `vmap`.

    target, launch, searched: as in `find`.
    sizes: as in `aim`.
    """
    waves, rays = target[0].shape
    starts = min(STARTS, rays)
    rounds, ray = -(-STARTS // starts), np.arange(rays, dtype=np.int32)

    def from_fan(inputs):
        fan, target, launch = inputs
        fan = trace_fan(system, fan, launch, sizes[1])
        return fan, target, nearest_start(fan, target)

    def next_round(state):
        whole, missing = state.round < 2, state.left > 0
        lanes = Lanes(missing, starts)

        def from_several(inputs):
            fan, target, _ = inputs
            points, left = lanes.of_rays((target, state.left))
            ranks = (rounds - left)[..., None] * starts + ray[None, None, :starts]
            begin = starts_of(fan, points, ranks)
            return fan, *lanes.spread((tuple(a[..., None] for a in points), begin))

        inputs = run_if(state.round == 1, from_fan, (state.fan, target, launch))
        fan, own, begin = run_if(state.round > 1, from_several, inputs)
        reach = jnp.where(state.round == 0, sizes[1], sizes[1] / 8)
        upright = whole & (system.rows.rotation is None)
        new = aim(system, own, begin, (sizes[0], reach), upright)
        traced, verdict = _verdict(system, new.launch, new.status)

        quality = jnp.where(verdict == Status.OK, 2 - new.folded.astype(jnp.int32), 0)
        lane, found = lanes.best(quality)
        lane = jnp.where(whole, ray[None], lane)
        found = jnp.where(whole, (state.round == 0) | (missing & (quality > 0)), found)
        status = jnp.take_along_axis(verdict, lane, axis=-1)
        status = jnp.where(found, status, state.status)
        taken = tuple(jnp.take_along_axis(h, lane[None], axis=-1) for h in traced)
        hits = where(found, taken, state.hits)
        left = state.left - (lanes.served & ~whole).astype(jnp.int32)
        left = jnp.where(state.round == 0, jnp.where(searched, rounds, 0), left)
        left = jnp.where((found & (state.round > 0)) | (status == Status.OK), 0, left)
        return _Search(hits, status, left, fan, state.round + 1, state.steps + new.steps)

    count = len(system.forms) + (system.stop is not None)
    zero = jnp.zeros((count, waves, rays), target[0].dtype)
    status = jnp.zeros((waves, rays), jnp.int32)
    none = jnp.int32(0)
    start = _Search((zero,) * len(target), status, status, no_fan(system, waves), none, none)
    return jax.lax.while_loop(lambda s: (s.round == 0) | jnp.any(s.left > 0), next_round, start)


def _verdict(system: System, launch: Vector, status: Array) -> tuple[Vector, Array]:
    """Traces aimed rays and decides their status.

    A ray whose direction changes by more than 1e-6 radians (2e-2 in float32) when its hits are
    rounded is UNCONVERGED.

    launch: D arrays (W, Q), launch points, mm.
    status: (W, Q), status of the aiming, which is kept where it is not OK.

    Returns the hits, D arrays, mm, and the status (W, Q).
    """
    trace = shoot(system, launch)
    eps = float(jnp.finfo(launch[0].dtype).eps)
    drowned = (trace.status == Status.OK) & (trace.rounding_angle > 4 / eps**0.5)
    traced = jnp.where(drowned, jnp.int32(Status.UNCONVERGED), trace.status)
    return trace.hits, jnp.where(status == Status.OK, traced, status)


@_of_finite
def find_many(system: System, target: Vector, known: Array) -> Found:
    """Finds rays as `find` does, also in large bundles.

    A large bundle is split into tiles. Polynomials launch its rays, and only tiles in which a ray
    misses are searched.

    target: D arrays (W, Q), stop points, mm.
    """
    waves, rays = target[0].shape
    size = tile_of(rays, waves)
    if len(target) == 1 or size == rays:
        return find(system, target, searched=known)
    launch_of = polynomial_launch(system, target)

    def tile(target, known):
        launch = launch_of(target)
        found = _exact(system, target, launch, jnp.zeros(target[0].shape, jnp.int32))
        missing = jnp.any(known & (found.status != Status.OK))
        found = run_if(missing, lambda _: find(system, target, launch, known), found)
        return found._replace(steps=jnp.broadcast_to(found.steps, target[0].shape))

    found = in_tiles(tile, size, target, known)
    return found._replace(steps=jnp.max(found.steps))
