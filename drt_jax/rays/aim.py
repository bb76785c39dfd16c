"""Aiming: the launch point of a ray that crosses the stop at a given point.

Newton's method in the launch point of one ray, mapped over a bundle, starts at the paraxial launch.
Only the rays that fail start again, from the nearest rays that were found, or from a fan of rays
over the first surface.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from ..lens.forms import Shape
from ..lens.paraxial import trace_yu
from ..lens.surface import vertex_curvature
from ..numerics import run_if, safe_divide, safe_sqrt
from .snell import shoot, shoot_to_stop, split_stop
from .status import Status
from .system import System, Vector, add, determinant, divide, dot, subtract, where

# A ray is aimed if it misses its stop point by less than `_NEAR` times the beam radius. Newton's
# method converges quadratically, so that one more step reaches the point to rounding, and the ray
# need not be polished.
_NEAR = 1e-7
# Largest number of steps of one search. It ends after `_PATIENCE` steps in a row that did not
# reduce the miss.
_STEPS, _PATIENCE = 48, 12
# Largest number of rounds in which a bundle is aimed again from the rays that were found. The
# bundled lenses at twice their apertures and fields need 3.
_ROUNDS = 8
# The fan has `_TILES` tiles per side, each with `_FAN` rays per side. The first guesses for a stop
# point are taken from its `STARTS` nearest tiles: from each tile the ray that crosses the stop
# nearest to the stop point.
_TILES, _FAN, STARTS = 15, 5, 24


class _State(NamedTuple):
    """State of the aiming of one ray.

    move: D numbers, step from the best launch point so far to the next trial, mm.
    far: (), miss at the stop of the best launch point, mm; inf before any trial ray arrives.
    bad: (), int32, number of trials in a row that did not reduce the miss.
    folded: (), bool, whether the best ray crosses the stop beyond a fold of the beam.
    """

    move: Vector
    far: Array
    bad: Array
    folded: Array


class AimNewton(optx.AbstractRootFinder):
    """Damped Newton's method for one launch point.

    The function returns the miss m (D numbers, mm) and the status of the ray as auxiliary output. A
    trial that reduces |m| is accepted; the next step is the Newton step -(dm/dy)^-1 m, shortened to
    twice the length of the step before. After a trial whose ray fails or misses by more, the step
    from the best launch point is halved. The search ends successfully when the miss is at most
    `atol`, and takes the remaining Newton step. It ends with RESULTS.nonlinear_divergence after 12
    trials in a row without success, or at once if the first ray does not arrive.

    rtol: not used.
    atol: accepted miss, mm.
    norm: norm of D numbers.

    Option "reach": length of the longest first step, mm.
    Option "upright": True if trials beyond a fold of the beam, where det(dm/dy) < 0 (the image of
        the beam on the stop is mirrored), count as failed. Where two rays pass one stop point,
        neighbouring stop points then get rays of the same branch.
    """

    rtol: float
    atol: Any  # a number or an array
    norm: Callable = optx.two_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first trial, which is the first guess."""
        far = jnp.full(y[0].shape, jnp.inf, y[0].dtype)
        none = tuple(jnp.zeros_like(a) for a in y)
        return _State(none, far, jnp.zeros((), jnp.int32), jnp.zeros((), bool))

    def step(self, fn, y, args, options, state, tags) -> tuple[Vector, _State, Any]:
        """One trial."""
        trial = add(y, state.move)

        def derivative(unit):
            return jax.jvp(lambda y: fn(y, args), (trial,), (unit,), has_aux=True)

        # The miss, its derivatives by each coordinate of the trial, and the status, in one trace.
        units = tuple(jnp.asarray(u, y[0].dtype) for u in np.eye(len(y)))
        miss, columns, status = jax.vmap(derivative, out_axes=(None, 0, None))(units)
        folded = determinant(columns) < 0
        counts = (status == Status.OK) & ~(folded & options.get("upright", False))
        far = jnp.where(counts, self.norm(miss), jnp.inf)
        better = far < state.far
        newton = tuple(-a for a in divide(columns, miss))
        bound = jnp.where(jnp.isinf(state.far), options["reach"], 2 * self.norm(state.move))
        newton = tuple(a * jnp.minimum(1, safe_divide(bound, self.norm(newton))) for a in newton)
        move = where(better, newton, tuple(a / 2 for a in state.move))
        y = where(better, trial, y)
        bad = jnp.where(better, 0, state.bad + 1).astype(jnp.int32)
        folded = jnp.where(better, folded, state.folded)
        return y, _State(move, jnp.minimum(far, state.far), bad, folded), status

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Array, optx.RESULTS]:
        """True once the ray is aimed or given up, and the result."""
        given_up = state.bad > jnp.where(jnp.isinf(state.far), 0, _PATIENCE)
        near = state.far <= self.atol
        results = optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        return near | given_up, optx.RESULTS.where(given_up & ~near, *results)

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Takes the remaining step of an aimed ray."""
        return add(y, where(state.far <= self.atol, state.move, 0)), aux, {}


class Aimed(NamedTuple):
    """Aimed rays.

    launch: D arrays (W, Q), mm.
    status: (W, Q), int32, OK for an aimed ray, otherwise the failure in front of the stop, or
        UNCONVERGED.
    folded: (W, Q), bool, whether the ray crosses the stop beyond a fold of the beam.
    steps: (), int32, trials of the whole bundle.
    """

    launch: Vector
    status: Array
    folded: Array
    steps: Array


def aim(
    system: System,
    target: Vector,
    launch: Vector,
    sizes: tuple[Array, Array],
    upright: Array | bool = False,
) -> Aimed:
    """Aims rays at stop points.

    The root finding of one ray is mapped over the rays, then over the wavelengths, each with its
    own indices and phases.

    target: D arrays (W, Q), stop points, mm.
    launch: D arrays (W, Q), first guesses of the launch points, mm.
    sizes: () and (), radius of the beam at the stop, and length of the longest first step, mm.
    upright: as in `AimNewton`.
    """
    eps = float(jnp.finfo(launch[0].dtype).eps)
    beam, reach = sizes
    solver = AimNewton(rtol=0.0, atol=max(_NEAR, 64 * eps) * beam)

    def one(own, target, launch):
        def miss(launch, target):
            crossing, status = shoot_to_stop(own, launch)
            return subtract(crossing, target), status

        solution: optx.Solution = optx.root_find(
            miss,
            solver,
            launch,
            args=target,
            options={"reach": reach, "upright": jnp.asarray(upright)},
            has_aux=True,
            max_steps=_STEPS,
            throw=False,
        )
        failed = jnp.where(solution.aux == Status.OK, Status.UNCONVERGED, solution.aux)
        found = solution.result == optx.RESULTS.successful
        status = jnp.where(found, Status.OK, failed).astype(jnp.int32)
        return solution.value, status, solution.state.folded, solution.stats["num_steps"]

    def one_colour(index, wave, target, launch):
        by = system.diffraction and dataclasses.replace(system.diffraction, wave=wave)
        own = dataclasses.replace(system, index=index, diffraction=by)
        return jax.vmap(one, (None, 0, 0))(own, target, launch)

    wave = system.diffraction and system.diffraction.wave[..., 0]
    bundle = jax.vmap(one_colour, (1, 1, 0, 0))
    launch, status, folded, steps = bundle(system.index[..., 0], wave, target, launch)
    return Aimed(launch, status, folded, jnp.max(steps).astype(jnp.int32))


def aim_outwards(system: System, target: Vector) -> Aimed:
    """Aims rays at stop points in rounds, outwards from the rays that were found.

    Round 0 starts at the paraxial launch. In each later round the rays that failed start again from
    the launch point of the nearest ray of any wavelength that was found; if none was found, from
    the nearest ray of a coarse fan. Rounds end when one finds no more rays, when no ray is missing,
    or after 8 later rounds. All rounds are one loop, so that aiming is compiled once.

    target: D arrays (W, Q), stop points, mm.
    """
    beam, reach = beam_size(system, target)
    upright = system.rows.rotation is None
    waves = target[0].shape[0]

    def again(state: tuple[Aimed, Array, Array]) -> tuple[Aimed, Array, Array]:
        """One round. The state: the bundle so far, whether another round may find more rays, and
        the number of rounds so far.
        """
        aimed, _, rounds = state
        first = rounds == 0
        ok = aimed.status == Status.OK

        def from_fan(launch: Vector) -> Vector:
            fan = trace_fan(system, no_fan(system, waves, 1), launch, reach)
            return nearest_start(fan, target)

        near = partial(nearest_found, ok=ok, target=target)
        begin = run_if(~first & jnp.any(ok), near, aimed.launch)
        begin = run_if(~first & ~jnp.any(ok), from_fan, begin)
        begin = where(first | ok, aimed.launch, begin)
        step = jnp.where(first, reach, reach / 8)
        new = aim(system, target, begin, (beam, step), upright)
        found = ~ok & (new.status == Status.OK)
        launch, status, folded = where(found | first, new[:3], aimed[:3])
        more = (first | jnp.any(found)) & jnp.any(status != Status.OK)
        both = Aimed(launch, status, folded, aimed.steps + new.steps)
        return both, more & (rounds < _ROUNDS), rounds + 1

    launch = paraxial_launch(system, target, reach)
    none = jnp.full(target[0].shape, Status.UNCONVERGED, jnp.int32)
    start = Aimed(launch, none, jnp.zeros(none.shape, bool), jnp.int32(0))
    begun = start, jnp.bool_(True), jnp.int32(0)
    return jax.lax.while_loop(lambda state: state[1], again, begun)[0]


def nearest_found(launch: Vector, ok: Array, target: Vector) -> Vector:
    """For each stop point, the launch point of the nearest ray of any wavelength that was found.

    launch: D arrays (W, Q), launch points, mm.
    ok: (W, Q), bool, rays that were found.
    target: D arrays (W, Q), stop points of the rays, mm.

    Returns D arrays (W, Q), mm; undefined if no ray was found.
    """
    every = [a.reshape(-1) for a in target]
    gaps = (a[..., None] - b[None, None] for a, b in zip(target, every, strict=True))
    far = jnp.where(ok.reshape(-1)[None, None], sum(g * g for g in gaps), jnp.inf)
    nearest = jnp.argmin(far, axis=-1)
    return tuple(a.reshape(-1)[nearest] for a in launch)


def beam_size(system: System, target: Vector) -> tuple[Array, Array]:
    """Radius of the beam at the stop, and an upper estimate of its radius on the first surface, mm.

    The estimate is 2 beam + tan(field) (depth + beam) + 0.02 depth, where depth is the axial
    distance between the first surface and the stop. Both are above 0, also for the chief ray alone
    through a stop at the first surface.
    """
    beam = jnp.sqrt(jnp.max(dot(target, target)))
    lean = jnp.sqrt(dot(system.source[:-1], system.source[:-1]))
    depth = jnp.abs(system.at_stop[0].axial - system.rows.axial[0])
    width = 2 * beam + lean * (depth + beam) + 0.02 * depth
    width = jnp.where(width > 0, width, 1)
    return jnp.where(beam > 0, beam, 0.1 * width), width


def paraxial_launch(system: System, target: Vector, width: Array) -> Vector:
    """Launch points of the rays through the paraxial entrance pupil, D arrays (W, Q), mm.

    Two paraxial rays are traced to the stop: an axial one with heights a_0 on the first surface and
    a_s at the stop, and an oblique one with heights t_0 and t_s for a field of tangent 1. The ray
    of the field of tangent u that crosses the stop at p has the height (p - u t_s) / a_s a_0 + u
    t_0 on the first surface. Tilts are neglected. No launch point is farther than 4 `width` from
    the axis, because the pupil of a telecentric lens lies at infinity.

    target: D arrays (W, Q), stop points, mm.
    width: (), radius of the beam on the first surface, mm.
    """
    dim, rows, before = system.dim, system.rows, system.before
    dtype = target[0].dtype
    stop, _ = system.at_stop
    # The surfaces in front of the stop; then a plane without power at the stop.
    shape = Shape(*(a[..., :before] for a in (rows.curvature, rows.conic, rows.coefficients.T)))
    curvature = jnp.stack(vertex_curvature(shape, system.forms[:before], dim), axis=-1)
    curvature = jnp.concatenate([curvature, jnp.zeros((1, dim), dtype)])[:, None, :, None]
    gaps = jnp.diff(jnp.append(rows.axial[:before], stop.axial))
    # Behind a mirror, distances and indices are both negative.
    index = system.index[: before + 1] * system.senses[: before + 1, None, None]
    index = jnp.moveaxis(jnp.concatenate([index, index[-1:]]), -1, 1)[:, None]
    power = curvature * jnp.diff(index, axis=0)
    by = system.diffraction
    if by is not None:
        for d, bend in enumerate(vertex_curvature(by.phase, by.forms, dim)):
            added = -by.wave[..., 0] * bend[:, None]
            power = power.at[np.array(by.rows), 0, d].add(added, mode="drop")
    one = jnp.ones((2, dim, system.index.shape[1]), dtype)
    first = rows.axial[0] if before else stop.axial
    v = system.vergence
    # Two rays: one from the axial object point, and an oblique one.
    height = one * jnp.stack([1 + first * v, first])[:, None, None]
    slope = one * jnp.stack([v, jnp.ones_like(v)])[:, None, None]
    (axial, tilted), _ = (
        jnp.moveaxis(a, 1, 0) for a in trace_yu(power, gaps, index, height, slope)
    )
    launch = []
    for d, point in enumerate(target):
        tangent = -system.source[d]
        if stop.offset is not None:
            point = point + stop.offset[d]
        amplitude = safe_divide(point - tangent * tilted[-1, d, :, None], axial[-1, d, :, None])
        launch.append(amplitude * axial[0, d, :, None] + tangent * tilted[0, d, :, None])
    # Transfer from z = `first` to the launch plane.
    depth, near = system.launch_plane - first, 1 / (v * first + 1)
    launch = [a + depth * near * (v * a - s) for a, s in zip(launch, system.source, strict=False)]
    far = safe_sqrt(dot(launch, launch))
    shrink = jnp.minimum(1, 4 * width / jnp.maximum(far, width))
    return tuple(a * shrink for a in launch)


def _fan(dim: int, rays: int) -> np.ndarray:
    """Launch points (D, tiles, rays of a tile) between -1 and 1, denser in the middle.

    dim: D, number of transverse components.
    rays: number of rays per side of a tile.
    """
    side = np.linspace(-1, 1, _TILES * rays)
    side = (side * (0.3 + 0.7 * side**2)).reshape(_TILES, rays)
    indices = np.meshgrid(*[np.arange(side.size)] * dim, indexing="ij")
    points = side.ravel()[np.stack(indices)].reshape(dim, *(_TILES, rays) * dim)
    tiles = (0, *range(1, 2 * dim, 2), *range(2, 2 * dim + 1, 2))
    return points.transpose(tiles).reshape(dim, _TILES**dim, rays**dim)


class Fan(NamedTuple):
    """A fan of rays over the first surface.

    launch: D arrays (tiles, rays of a tile), launch points, mm.
    stop: D arrays (W, tiles, rays of a tile), crossings of the stop by the rays that reach the
        sensor, mm; inf for the others.
    """

    launch: Vector
    stop: Vector


def no_fan(system: System, waves: int, rays: int = _FAN) -> Fan:
    """A fan before it is traced, with launch points scaled to -1 to 1.

    waves: number of wavelengths.
    rays: number of rays per side of a tile.
    """
    points = jnp.asarray(_fan(system.dim, rays), system.index.dtype)
    nowhere = jnp.full((waves, *points.shape[1:]), jnp.inf, points.dtype)
    return Fan(tuple(points), (nowhere,) * system.dim)


def trace_fan(system: System, fan: Fan, tried: Vector, width: Array) -> Fan:
    """Traces a fan.

    Pass `fan` and `tried` through the carry of the loop in which this is called: XLA moves work
    that does not depend on the loop out of it, and would trace the fan even when no ray is missing.

    fan: the fan of `no_fan`.
    tried: D arrays (W, Q), launch points already tried, mm; the fan reaches at least 1.6 times as
        far.
    width: (), radius of the beam on the first surface, mm; the fan reaches at least twice as far.
    """
    extent = jnp.maximum(2 * width, 1.6 * jnp.sqrt(jnp.max(dot(tried, tried))))
    launch = tuple(extent * a for a in fan.launch)
    shape = fan.stop[0].shape
    flat = tuple(jnp.broadcast_to(a.reshape(1, -1), (shape[0], a.size)) for a in launch)
    trace = shoot(system, flat)
    _, stop = split_stop(system, trace.hits)
    ok = trace.status == Status.OK
    return Fan(launch, tuple(jnp.where(ok, a, jnp.inf).reshape(shape) for a in stop))


def nearest_start(fan: Fan, target: Vector) -> Vector:
    """One first guess for each stop point, D arrays (W, Q), launch points, mm.

    Each tile offers its ray that crosses the stop nearest to the centre of the stop; of these rays,
    the one nearest to the stop point is taken.

    fan: a traced fan.
    target: D arrays (W, Q), stop points, mm.
    """
    central = jnp.argmin(dot(fan.stop, fan.stop), axis=-1)  # (W, tiles)
    stop = (jnp.take_along_axis(a, central[..., None], axis=-1)[..., 0] for a in fan.stop)
    gaps = (a[..., None] - b[:, None] for a, b in zip(target, stop, strict=True))
    tile = jnp.argmin(sum(g * g for g in gaps), axis=-1)
    return tuple(a[tile, jnp.take_along_axis(central, tile, axis=-1)] for a in fan.launch)


def starts_of(fan: Fan, target: Vector, ranks: Array) -> Vector:
    """N first guesses for each of K stop points, D arrays (W, K, N), launch points, mm.

    Each is the ray of a tile that crosses the stop nearest to the stop point. The tiles are chosen
    by their ranks, in the order of this distance.

    fan: a traced fan.
    target: D arrays (W, K), stop points, mm.
    ranks: (W, K, N), int32, ranks of tiles, 0 for the nearest.
    """
    gaps = (a[:, :, None, None] - b[:, None] for a, b in zip(target, fan.stop, strict=True))
    far = sum(g * g for g in gaps)  # (W, K, tiles, rays)
    near, which = jnp.min(far, axis=-1), jnp.argmin(far, axis=-1)
    order = jax.lax.top_k(-near, min(STARTS, near.shape[-1]))[1]
    order = jnp.take_along_axis(order, ranks, axis=-1, mode="clip")
    chosen = jnp.take_along_axis(which, order, axis=-1)
    return tuple(a[order, chosen] for a in fan.launch)
