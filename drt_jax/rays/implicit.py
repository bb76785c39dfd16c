"""Rays as roots of the Fermat system, with derivatives by the implicit function theorem.

The only module that imports optimistix. The iteration is never differentiated: at a root,
F(w, p) = 0 gives dw/dp = -(dF/dw)^-1 dF/dp (paper Eq. 4). Reverse mode is a custom_vjp, one
transposed solve and one vector-Jacobian product; JAX refuses forward mode through that, so the
same rule is offered as a custom_jvp beside it.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from . import fermat
from .aiming import NODES, Aiming, fit, nodes, unknown
from .fermat import Status, System
from .search import find_rays

__all__ = ["BlockNewton", "Found", "solve_rays", "solve_rays_forward"]

_MAX_STEPS = 32
# More rays than `_MANY` are aimed by polynomials and solved in tiles, of all wavelengths together
# `_TILE` rays if they suffice to fit to: what belongs to a surface stays in the cache of a core.
_MANY, _TILE = 1024, 1024


class _State(NamedTuple):
    change: Array  # largest correction of the last step, mm
    step: Array


class BlockNewton(optx.AbstractRootFinder):
    """Newton's method for a bundle of Fermat paths, with the banded solve of `fermat`.

    Its arguments are the system and which rays are to move (W, Q). These step together; one whose
    correction is not finite stays where it is, so that it cannot spoil the others. Ends when no
    ray moved more than `atol` mm: convergence is quadratic, so that the hits are then right to
    rounding. An error e becomes e^2 / gap: where surfaces are less than 1 mm apart, moves count
    for more, by the root of the gap.
    """

    stop: int = eqx.field(static=True)
    rtol: float = 0.0
    atol: float = 1e-9
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first step; there is none if no ray is to move."""
        change = jnp.where(jnp.any(args[1]), jnp.inf, 0).astype(y.dtype)
        return _State(change, jnp.array(0))

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, _State, Any]:
        """One Newton step of every ray."""
        f, aux = fn(y, args)
        system, active = args
        path = fermat.geometry(y, system)
        correction = fermat.solve(fermat.hessian(path, system), f, self.stop)
        usable = active & jnp.all(jnp.isfinite(correction), axis=(0, 1))
        correction = jnp.where(usable, correction, 0)
        weight = jnp.sqrt(jnp.maximum(jnp.max(path.inverse_length, axis=0), 1))
        change = jnp.max(jnp.abs(correction) * weight, initial=0)
        return y - correction, _State(change, state.step + 1), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Array, optx.RESULTS]:
        """Whether all rays have settled."""
        return state.change <= self.atol, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Nothing to add."""
        return y, aux, {}


class Found(NamedTuple):
    """Solved rays: hits (D, S + 1, W, Q), mm, 0 for failed ones; their `Status` (W, Q), int32; the
    number of Newton steps ()."""

    hits: Array
    status: Array
    steps: Array


def _solve(system: System, thorough: bool, aiming: Aiming | None = None) -> Found:
    """`_find` for one tile of rays."""

    def polish(hits, active):
        crossings = jnp.broadcast_to(system.crossings, hits[:, 0].shape)
        hits = hits.at[:, system.stop].set(crossings)

        def turn(state):
            hits, solved, steps, turns = state
            solution = optx.root_find(
                lambda hits, args: fermat.residual(hits, args[0]),
                BlockNewton(stop=system.stop, atol=10 * float(jnp.finfo(hits.dtype).eps) ** 0.5),
                hits,
                args=(system, active & ~solved & (turns > 0)),
                max_steps=_MAX_STEPS,
                throw=False,
            )
            hits = solution.value
            solved = active & fermat.stationary(hits, system)
            return hits, solved, steps + solution.stats["num_steps"], turns + 1

        # Rays that were aimed well are stationary before any step; a few others need one more.
        first = int(aiming is None)
        start = hits, jnp.zeros_like(active), jnp.int32(0), jnp.int32(first)
        hits, solved, steps, _ = jax.lax.while_loop(
            lambda state: (state[-1] <= 2) & ((state[-1] <= first) | jnp.any(active & ~state[1])),
            turn,
            start,
        )
        return hits, solved, steps

    hits, status, steps = find_rays(system, polish, aiming, thorough)
    return Found(jnp.where(status == Status.OK, hits, 0), status, steps)


def _tiles(system: System) -> tuple[int, int]:
    """How many tiles of how many rays; one for a bundle that is no larger."""
    count, dim = system.target.shape[-1], len(system.target)
    size = max(NODES, _TILE // system.index.shape[1])
    return (1, count) if dim == 1 or count <= max(size, _MANY) else (-(-count // size), size)


def _padded(array: Array, tiles: int, size: int) -> Array:
    """`array` (..., Q), its last ray repeated to fill the tiles."""
    missing = tiles * size - array.shape[-1]
    return jnp.pad(array, [(0, 0)] * (array.ndim - 1) + [(0, missing)], mode="edge")


def _tile(array: Array, start: Array, size: int) -> Array:
    return jax.lax.dynamic_slice_in_dim(array, start, size, axis=-1)


def _put(array: Array, part: Array, start: Array) -> Array:
    return jax.lax.dynamic_update_slice_in_dim(array, part, start, axis=-1)


def _find(system: System, thorough: bool) -> Found:
    """All rays of a bundle, without derivatives, in tiles."""
    tiles, size = _tiles(system)
    if tiles == 1:
        return _solve(system, thorough)
    count, waves = system.target.shape[-1], system.index.shape[1]
    target, few = _padded(system.target, tiles, size), _padded(nodes(system), 1, size)
    few = few if target.ndim == 2 else few[:, None]

    def solve(k, carry):
        hits, status, steps, aiming = carry
        # The first tile are the rays that the aiming is fitted to.
        start = (k - 1) * size
        own = jnp.where(k == 0, few, _tile(target, start, size))
        found = _solve(dataclasses.replace(system, target=own), thorough, aiming)
        good = found.status == Status.OK
        aiming = jax.lax.cond(k == 0, lambda: fit(system, found.hits[:, 0], good), lambda: aiming)
        hits, status = _put(hits, found.hits, start), _put(status, found.status, start)
        return hits, status, jnp.where(k == 0, 0, jnp.maximum(steps, found.steps)), aiming

    shape = waves, tiles * size
    hits = jnp.zeros((len(target), len(system.forms), *shape), target.dtype)
    carry = hits, jnp.zeros(shape, jnp.int32), jnp.int32(0), unknown(system)
    hits, status, steps, _ = jax.lax.fori_loop(0, tiles + 1, solve, carry)
    return Found(hits[..., :count], status[..., :count], steps)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def solve_rays_forward(system: System, found: Found | None = None, thorough: bool = True) -> Found:
    """`solve_rays` for forward mode: `jax.jvp`, `jacfwd`, and higher derivatives.

    The same rule: dw = -(dF/dw)^-1 dF/dp dp, one banded solve for each tangent.
    """
    return _find(system, thorough) if found is None else found


def _linearised(system: System, hits: Array, code: Array) -> tuple[fermat.Blocks, Callable]:
    """dF/dw, and F as a function of the system alone, at the hits.

    A failed ray has no Jacobian: the identity takes its place.
    """
    ok = code == Status.OK
    blocks = fermat.hessian(fermat.geometry(hits, system), system)
    identity = jnp.eye(hits.shape[0], dtype=hits.dtype)[..., None, None, None]
    blocks = fermat.Blocks(*(jnp.where(ok, block, identity) for block in blocks))

    def residual(system):
        crossings = jnp.where(ok, system.crossings, 0)
        return fermat.residual(hits.at[:, system.stop].set(crossings), system)

    return blocks, residual


@solve_rays_forward.defjvp
def _tangents(thorough, primals, tangents):
    system, found = primals
    # Through the function itself, so that the hits carry derivatives of their own.
    found = solve_rays_forward(system, found, thorough)
    hits, code, _ = found
    ok = code == Status.OK
    blocks, residual = _linearised(system, hits, code)
    _, change = jax.jvp(residual, (system,), (tangents[0],))
    moved = -fermat.solve(blocks, jnp.where(ok, change, 0), system.stop)
    moved = moved.at[:, system.stop].add(jnp.broadcast_to(tangents[0].crossings, moved[:, 0].shape))
    moved = jnp.where(ok, moved, 0)
    none = (np.zeros(a.shape, jax.dtypes.float0) for a in found[1:])
    return found, Found(moved, *none)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def solve_rays(system: System, found: Found | None = None, thorough: bool = True) -> Found:
    """Trace a bundle: the stationary paths through the given stop points.

    Differentiable in `system` in reverse mode, also repeatedly, and then in forward mode; failed
    rays have zero derivatives. `found`: the result, where it is known already and the derivatives
    alone are of interest. Else, if not `thorough`, rays that the first search does not find have
    failed.
    """
    return solve_rays_forward(system, found, thorough)


def _forward(system, found, thorough):
    found = solve_rays_forward(system, found, thorough)
    return found, (system, *found[:2])


def _adjoint(system: System, hits: Array, code: Array, bar: Array) -> System:
    """The cotangent of the system from that of the hits."""
    ok = code == Status.OK
    bar = jnp.where(ok, bar, 0)
    blocks, residual = _linearised(system, hits, code)
    adjoint = jnp.where(ok, fermat.solve_transposed(blocks, bar, system.stop), 0)
    _, pull_back = jax.vjp(residual, system)
    system_bar = pull_back(-adjoint)[0]
    direct = bar[:, system.stop]  # of the stop points themselves, which are hits too
    if system.target.ndim == 2:
        direct = jnp.sum(direct, axis=1)
    return dataclasses.replace(system_bar, target=system_bar.target + direct)


def _backward(thorough, residuals, cotangents):
    system, *rays = *residuals, cotangents[0]
    tiles, size = _tiles(system)
    if tiles == 1:
        return _adjoint(system, *rays), None
    count = system.target.shape[-1]
    # The rays that fill the last tile have failed, and no derivative.
    filling = jnp.arange(tiles * size) < count
    rays = [_padded(a, tiles, size) for a in (system.target, *rays)]
    rays[2] = jnp.where(filling, rays[2], Status.UNCONVERGED)

    def add(k, total):
        target, hits, code, bar = (_tile(a, k * size, size) for a in rays)
        part = _adjoint(dataclasses.replace(system, target=target), hits, code, bar)
        target = _put(total.target, part.target, k * size)
        total = jax.tree.map(jnp.add, dataclasses.replace(total, target=part.target), part)
        return dataclasses.replace(total, target=target)

    zero = jax.tree.map(jnp.zeros_like, dataclasses.replace(system, target=rays[0]))
    total = jax.lax.fori_loop(0, tiles, add, zero)
    return dataclasses.replace(total, target=total.target[..., :count]), None


solve_rays.defvjp(_forward, _backward)
