"""Rays as roots of the Fermat system, with derivatives by the implicit function theorem.

The only module that imports optimistix. The iteration is never differentiated: at a root,
F(w, p) = 0 gives dw/dp = -(dF/dw)^-1 dF/dp (paper Eq. 4), and the reverse rule below is one
transposed solve and one vector-Jacobian product.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jax import Array

from . import fermat
from .fermat import Status, System

__all__ = ["BlockNewton", "solve_rays"]

_MAX_STEPS = 32


class _State(NamedTuple):
    change: Array  # largest correction of the last step, mm
    step: Array


class BlockNewton(optx.AbstractRootFinder):
    """Newton's method for a bundle of Fermat paths, with the banded solve of `fermat`.

    All rays step together; a ray whose correction is not finite stays where it is, so that
    it cannot spoil the others. Ends when no ray moved more than `atol` mm: convergence is
    quadratic, so that the hits are then right to rounding.
    """

    stop: int = eqx.field(static=True)
    rtol: float = 0.0
    atol: float = 1e-9
    norm: Callable = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> _State:
        """The state before the first step."""
        return _State(jnp.array(jnp.inf, y.dtype), jnp.array(0))

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, _State, Any]:
        """One Newton step of every ray."""
        f, aux = fn(y, args)
        blocks = fermat.hessian(fermat.geometry(y, args), args)
        correction = fermat.solve(blocks, f, self.stop)
        usable = jnp.all(jnp.isfinite(correction), axis=(0, 1))
        correction = jnp.where(usable, correction, 0)
        change = jnp.max(jnp.abs(correction), initial=0)
        return y - correction, _State(change, state.step + 1), aux

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Array, optx.RESULTS]:
        """Whether all rays have settled."""
        return state.change <= self.atol, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        """Nothing to add."""
        return y, aux, {}


@partial(jax.custom_vjp, nondiff_argnums=(0,))
def solve_rays(stop: int, system: System, start: Array) -> tuple[Array, Array, Array]:
    """Trace a bundle: the stationary paths through the given stop points.

    `start` (D, S + 1, W, Q), mm: first guess of all hits. Returns the hits, same shape,
    their `Status` (W, Q), int32, and the number of Newton steps. Differentiable in `system`
    in reverse mode, also repeatedly; failed rays have zero derivatives, and hits of 0.
    """
    start = start.at[:, stop].set(jnp.broadcast_to(system.stop[:, None], start[:, stop].shape))
    solution = optx.root_find(
        fermat.residual,
        BlockNewton(stop=stop, atol=float(jnp.finfo(start.dtype).eps) ** 0.5 * 0.1),
        jax.lax.stop_gradient(start),
        args=jax.lax.stop_gradient(system),
        max_steps=_MAX_STEPS,
        throw=False,
    )
    hits = solution.value
    code = fermat.status(hits, system)
    hits = jnp.where(code == Status.OK, hits, 0)
    return hits, code, solution.stats["num_steps"]


def _forward(stop, system, start):
    # Through `solve_rays` itself, so that the residuals carry derivatives of their own.
    result = solve_rays(stop, system, start)
    return result, (system, *result[:2])


def _backward(stop, residuals, cotangents):
    system, hits, code = residuals
    ok = code == Status.OK
    bar = jnp.where(ok, cotangents[0], 0)
    path = fermat.geometry(hits, system)
    blocks = fermat.hessian(path, system)
    # A failed ray has no Jacobian: the identity takes its place.
    identity = jnp.eye(hits.shape[0], dtype=hits.dtype)[..., None, None, None]
    blocks = fermat.Blocks(*(jnp.where(ok, block, identity) for block in blocks))
    adjoint = jnp.where(ok, fermat.solve_transposed(blocks, bar, stop), 0)
    _, pull_back = jax.vjp(
        lambda system: fermat.residual(
            hits.at[:, stop].set(jnp.where(ok, system.stop[:, None], 0)), system
        ),
        system,
    )
    system_bar = pull_back(-adjoint)[0]
    direct = jnp.sum(bar[:, stop], axis=1)
    system_bar = system_bar._replace(stop=system_bar.stop + direct)
    return system_bar, jnp.zeros_like(hits)


solve_rays.defvjp(_forward, _backward)
