"""Functions that stay finite, with finite derivatives, where the plain ones do not.

Each is written with a double `where`: the dangerous operation only ever sees a harmless
argument, so neither its value nor its derivative can turn into NaN. Nothing is added to a
denominator, so ordinary values are not biased.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

T = TypeVar("T")
# Products of matrices. Otherwise GPUs round the factors of float32 to 10 bits: 5e-4 of an index.
EXACT = jax.lax.Precision.HIGHEST
einsum = functools.partial(jnp.einsum, precision=EXACT)
matmul = functools.partial(jnp.matmul, precision=EXACT)
tensordot = functools.partial(jnp.tensordot, precision=EXACT)
if TYPE_CHECKING:
    Numbers = ArrayLike | Sequence[ArrayLike] | Sequence[Sequence[ArrayLike]]
else:

    class Numbers:
        """What public functions take for numbers: an array, or numbers in lists and tuples, which
        JAX's own alias leaves out. A class, so that `help` prints its name and not the union."""


def safe_sqrt(x: Array) -> Array:
    """Square root of `x`; 0, with derivative 0, where `x` <= 0. Any shape, floating dtype."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_divide(numerator: Array, denominator: Array) -> Array:
    """`numerator / denominator`; 0, with derivative 0, where the denominator is 0.

    The arguments broadcast and share one floating dtype.
    """
    good = denominator != 0
    return jnp.where(good, numerator / jnp.where(good, denominator, 1), 0)


def run_if(condition: Array, function: Callable, value: Any) -> Any:
    """`function(value)`, of the same structure, if the condition holds, else the value. A loop:
    under `vmap` too it costs nothing where the condition holds nowhere. Not for reverse mode."""
    once = lambda state: (function(state[0]), jnp.array(False))  # noqa: E731
    return jax.lax.while_loop(lambda state: state[1], once, (value, condition))[0]


def concrete(tree: Any) -> bool:
    """Whether all numbers of `tree` are known: none is for `jit` or `vmap` to fill in, and none is
    being differentiated."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def still(tree: Any) -> Any:
    """`tree` without derivatives: what `jit`, `vmap` or a derivative fills in is a constant."""
    held = lambda a: jax.lax.stop_gradient(a) if isinstance(a, jax.core.Tracer) else a  # noqa: E731
    return jax.tree.map(held, tree)


def known_values(tree: Any) -> Any:
    """`tree` with its numbers, also while it is being differentiated; None for what `jit` or `vmap`
    is to fill in.

    What follows from a scene, such as how many rays it needs, is not differentiated itself but
    must be decided in an eager `jax.grad`, too: there `stop_gradient` leaves the values.
    """
    values = still(tree)
    return values if concrete(values) else None


def brief(one: Any) -> str:
    """A dataclass in one line, its arrays by dtype and shape: for `__repr__`."""

    def shown(value: Any) -> str:
        return f"{value.dtype}{[*value.shape]}" if getattr(value, "shape", ()) else repr(value)

    parts = (f"{f.name}={shown(getattr(one, f.name))}" for f in dataclasses.fields(one))
    return f"{type(one).__name__}({', '.join(parts)})"


def leaves(*names: str) -> Callable[[type[T]], type[T]]:
    """A decorator: a frozen dataclass becomes a pytree of these fields, the others static. What
    JAX rebuilds from its leaves is not checked again by `__post_init__`."""

    def register(cls: type[T]) -> type[T]:
        static = [f.name for f in dataclasses.fields(cast(Any, cls)) if f.name not in names]

        def flatten(one: Any) -> tuple[list, tuple]:
            return [getattr(one, n) for n in names], tuple(getattr(one, n) for n in static)

        def unflatten(values: tuple, children: Sequence) -> Any:
            one = object.__new__(cls)
            vars(one).update(zip((*names, *static), (*children, *values), strict=True))
            return one

        jax.tree_util.register_pytree_node(cls, flatten, unflatten)
        return cls

    return register


@functools.cache
def _real(kind: Any) -> bool:
    return jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)


def real_array(what: str, value: Numbers, dtype: Any) -> Array:
    """`value`, a number, a list of them or an array, as an array of a floating dtype.

    ValueError, which begins with `what`, for text, truth values, complex numbers, none at all, and
    lists that are no array.
    """
    leaves = jax.tree.leaves(value)
    kinds: list[Any] = [getattr(leaf, "dtype", None) or type(leaf) for leaf in leaves]
    if not kinds or not all(map(_real, kinds)):
        raise ValueError(f"{what}: expected real numbers, got {value!r:.100}")
    try:
        with np.errstate(over="ignore"):  # a distance of 1e300 mm is inf in float32
            return jnp.asarray(value, dtype)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{what}: {error}") from error
