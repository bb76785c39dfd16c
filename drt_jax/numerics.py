"""Functions that stay finite, with finite derivatives, where the ordinary ones do not.

Each is written with a double `where`: the first replaces arguments for which the operation is not
finite, the second replaces its result there. So neither value nor derivative can become NaN.
Nothing is added to a denominator, so that ordinary values are not biased.
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
# Matrix products in full precision. By default GPUs round float32 factors to 10 bits, an error of
# 5e-4 of a refractive index.
EXACT = jax.lax.Precision.HIGHEST
einsum = functools.partial(jnp.einsum, precision=EXACT)
matmul = functools.partial(jnp.matmul, precision=EXACT)
tensordot = functools.partial(jnp.tensordot, precision=EXACT)
# Compiles a function when it is called outside of `jit`, instead of each of its operations alone;
# inside it becomes a part of that program.
program = functools.partial(jax.jit, inline=True)
if TYPE_CHECKING:
    Numbers = ArrayLike | Sequence[ArrayLike] | Sequence[Sequence[ArrayLike]]
else:

    class Numbers:
        """Numbers as arguments of public functions: an array, or numbers in lists and tuples.

        JAX's own alias does not include lists and tuples. This is a class, so that `help` prints
        its name and not the union.
        """


def array(values: object) -> Array:
    """Numbers as an array of the default floating dtype, made without any compilation."""
    return jax.device_put(np.asarray(values, jnp.result_type(float)))


def safe_sqrt(x: Array) -> Array:
    """Square root of `x`; 0, with derivative 0, where `x` <= 0.

    x: any shape, floating dtype.
    """
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1)), 0)


def safe_divide(numerator: Array, denominator: Array) -> Array:
    """`numerator / denominator`; 0, with derivative 0, where the denominator is 0.

    numerator, denominator: arrays that broadcast, of one floating dtype.
    """
    good = denominator != 0
    return jnp.where(good, numerator / jnp.where(good, denominator, 1), 0)


def run_if(condition: Array, function: Callable, value: Any) -> Any:
    """`function(value)` if the condition holds, else the value.

    It is a loop of at most one round, so that under `vmap` too it costs nothing if the condition
    holds nowhere. Not for reverse mode.

    condition: (), bool.
    function: returns a pytree of the structure of its argument.
    value: a pytree.
    """
    once = lambda state: (function(state[0]), jnp.array(False))  # noqa: E731
    return jax.lax.while_loop(lambda state: state[1], once, (value, condition))[0]


def batched(function: Callable, axes: int) -> Callable:
    """A function over a number of leading axes of all its arguments: `jax.vmap` so many times."""
    for _ in range(axes):
        function = jax.vmap(function)
    return function


def selected(part: Any, keep: Sequence[int]) -> Any:
    """A selection of the rows of a record, such as the elements of a lens; None for an empty one.

    part: a dataclass whose arrays and static tuples have as many rows.
    keep: numbers of the rows, in their new order.
    """
    names = [field.name for field in dataclasses.fields(part) if field.metadata]
    static = {name: tuple(getattr(part, name)[k] for k in keep) for name in names}
    arrays = jax.tree.map(lambda a: a[np.array(keep, int)], part)
    return dataclasses.replace(arrays, **static) if keep else None


def concrete(tree: Any) -> bool:
    """Whether no leaf of `tree` is a tracer of `jit`, `vmap` or a derivative: all numbers are
    known.
    """
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def still(tree: Any) -> Any:
    """`tree` with `stop_gradient` on every tracer, so that it counts as a constant in
    derivatives.
    """
    held = lambda a: jax.lax.stop_gradient(a) if isinstance(a, jax.core.Tracer) else a  # noqa: E731
    return jax.tree.map(held, tree)


def known_values(tree: Any) -> Any:
    """`tree` with its numbers, also while it is being differentiated; None for tracers of `jit` or
    `vmap`.

    Choices that depend on a scene, such as the number of rays, are not differentiated, but they
    must also be made in an eager `jax.grad`: there `stop_gradient` returns the values.
    """
    values = still(tree)
    return values if concrete(values) else None


def eager_values(tree: Any) -> Any:
    """`known_values` outside of `jax.jit`; inside of it None, also for known numbers."""
    values = known_values((tree, jnp.zeros(())))  # inside of `jit` a new array is a tracer, too
    return values and values[0]


def brief(one: Any) -> str:
    """A dataclass in one line for `__repr__`, with its arrays by dtype and shape."""

    def shown(value: Any) -> str:
        return f"{value.dtype}{[*value.shape]}" if getattr(value, "shape", ()) else repr(value)

    parts = (f"{f.name}={shown(getattr(one, f.name))}" for f in dataclasses.fields(one))
    return f"{type(one).__name__}({', '.join(parts)})"


def leaves(*names: str) -> Callable[[type[T]], type[T]]:
    """A decorator that makes a frozen dataclass a pytree of the named fields.

    Other fields are static. What JAX rebuilds from leaves is not checked again by `__post_init__`.
    """

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
    """Whether a dtype or type is floating or integer."""
    return jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)


def real_array(what: str, value: Numbers, dtype: Any) -> Array:
    """`value`, a number, a list of numbers or an array, as an array of a floating dtype.

    ValueError, which begins with `what`, for text, truth values, complex numbers, an empty list,
    and lists that do not form an array.
    """
    return _real_array(what, value, dtype, jnp.asarray)


def known_array(what: str, value: Numbers) -> Any:
    """As `real_array`, in the dtype of `value` or of Python's floats; a NumPy array if the numbers
    are known, so that they stay known inside `jit`."""
    kind = getattr(value, "dtype", float)
    kind = jax.dtypes.canonicalize_dtype(kind if jnp.issubdtype(kind, jnp.floating) else float)
    return _real_array(what, value, kind, np.asarray if concrete(value) else jnp.asarray)


def _real_array(what: str, value: Numbers, dtype: Any, asarray: Callable) -> Any:
    """`real_array`, by the function `asarray`."""
    leaves = jax.tree.leaves(value)
    kinds: list[Any] = [getattr(leaf, "dtype", None) or type(leaf) for leaf in leaves]
    if not kinds or not all(map(_real, kinds)):
        raise ValueError(f"{what}: expected real numbers, got {value!r:.100}")
    try:
        with np.errstate(over="ignore"):  # a distance of 1e300 mm is inf in float32
            return asarray(value, dtype)
    except (ValueError, OverflowError) as error:
        raise ValueError(f"{what}: {error}") from error
