"""Adam (Kingma and Ba 2015) as a pair (init, update), with a learning rate for each group of
parameters.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array


class AdamState(NamedTuple):
    """State of the optimiser.

    steps: (), int32, number of updates so far.
    first, second: first and second moments of the gradient, in the shape of the parameters.
    """

    steps: Array
    first: Any
    second: Any


def adam(
    rates: Any, b1: float = 0.9, b2: float = 0.999, eps: float = 1e-8
) -> tuple[Callable[[Any], AdamState], Callable[[Any, AdamState], tuple[Any, AdamState]]]:
    """The optimiser Adam as a pair of functions (init, update).

    rates: one learning rate, or one for each top-level key of the parameters, such as {"optics":
        1e-2, "network": 1e-3}; a rate may be such a mapping itself, or a function of the number of
        the step, from 0, such as `design.cosine`. `update` raises KeyError for a key without a
        rate.
    b1, b2: decay rates of the first and second moment.
    eps: added to the root of the second moment.

    init(parameters) -> state; update(gradients, state) -> (updates, state). The updates are to be
    added to the parameters. Every leaf keeps its dtype.
    """

    def init(parameters: Any) -> AdamState:
        zeros = jax.tree.map(jnp.zeros_like, parameters)
        return AdamState(jnp.zeros((), jnp.int32), zeros, jax.tree.map(jnp.zeros_like, parameters))

    def update(gradients: Any, state: AdamState) -> tuple[Any, AdamState]:
        steps = state.steps + 1
        first = jax.tree.map(lambda m, g: b1 * m + (1 - b1) * g, state.first, gradients)
        second = jax.tree.map(lambda v, g: b2 * v + (1 - b2) * g * g, state.second, gradients)

        def scaled(rate: Any, first: Any, second: Any) -> Any:
            if isinstance(rate, Mapping):
                return {name: scaled(rate[name], first[name], second[name]) for name in first}

            rate = rate(state.steps) if callable(rate) else rate

            def leaf(m: Array, v: Array) -> Array:
                # 1 - b^steps, without cancellation, by which float32 would lose five digits.
                bias = [-jnp.expm1(steps.astype(m.dtype) * math.log(b)) for b in (b1, b2)]
                return -rate * (m / bias[0]) / (jnp.sqrt(v / bias[1]) + eps)

            return jax.tree.map(leaf, first, second)

        return scaled(rates, first, second), AdamState(steps, first, second)

    return init, update


def apply_updates(parameters: Any, updates: Any) -> Any:
    """Parameters plus updates, leaf by leaf, each in the dtype of the parameter."""
    return jax.tree.map(lambda p, u: p + u.astype(p.dtype), parameters, updates)


def copied(parameters: Any) -> Any:
    """A copy of parameters.

    It is needed because the first step donates (overwrites) the buffers. The dtypes are explicit,
    because weakly typed parameters would cause the step to be compiled again.
    """
    return jax.tree.map(lambda p: jnp.array(p, jnp.asarray(p).dtype), parameters)
