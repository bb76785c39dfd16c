"""The last part of a camera: images that a network restores, or their mean absolute error."""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.custom_derivatives import SymbolicZero

from ..devices import Shared
from .convolution import AT_ONCE

Restore = Callable[[Any, Array], Array]
# A function of a network, its weights, the images of the sensor and the true images.
Last = Callable[[Restore | None, Any, Array, Array], Array]
# Primitives for which no loop over parts of the batch is used: XLA's convolutions, whose gradients
# take 20 times as long in a loop (jax#12868), and work shared by devices, which would synchronise
# in each iteration.
_SLOW = "conv_general_dilated", "shard_map"


def restored(restore: Restore | None, weights: Any, images: Array, truth: Array) -> Array:
    """The images that the network restores, (B, H, W, C); without a network the sensor images.

    restore, weights, images, truth: as of `mean_error`.
    """
    return images if restore is None else restore(weights, images)


def mean_error(restore: Restore | None, weights: Any, images: Array, truth: Array) -> Array:
    """Mean absolute error of the restored images, ().

    On a CPU a loop computes error and gradient of a few images at a time, of some 4096 pixels
    together, so that their features stay in the cache; the features of a whole batch would have to
    be allocated in each step. Differentiable in every mode and to any order.

    restore: (weights, images) -> images, each from its own image alone; it may be a function that
        devices share, see `devices.shared`. None for a camera without a network.
    weights: parameters of the network.
    images: of the sensor, (B, H, W, C).
    truth: true images, of the shape of those restored.
    """
    if restore is None:
        return jnp.mean(jnp.abs(images - truth))
    return jnp.sum(_total_error(restore)(weights, images, truth)) / truth.size


def _total_error(restore: Restore) -> Callable[[Any, Array, Array], Array]:
    """(weights, images, truth) -> sum of the absolute errors, (1,); one of each device.

    A custom JVP computes the error and all its derivatives together, for one group of images after
    the other in a `lax.scan`, and then multiplies the derivatives with the tangents. So only the
    features of one group are in memory, also in reverse mode.
    """
    if isinstance(restore, Shared):
        return dataclasses.replace(restore, function=_total_error(restore.function))

    def plain(weights: Any, images: Array, truth: Array) -> Array:
        return jnp.sum(jnp.abs(restore(weights, images) - truth))

    slopes = jax.value_and_grad(plain, (0, 1, 2))

    def by_groups(weights: Any, *pair: Array) -> tuple[Array, tuple]:
        count, height, width = pair[0].shape[:3]
        program = str(jax.make_jaxpr(plain)(weights, *pair))
        if jax.default_backend() != "cpu" or any(name in program for name in _SLOW):
            return slopes(weights, *pair)
        most = max(1, AT_ONCE // (height * width))
        size = max(k for k in range(1, most + 1) if count % k == 0)

        def add(known: Any, group: list[Array]) -> tuple[Any, tuple]:
            value, (slope, *others) = slopes(weights, *group)
            return jax.tree.map(jnp.add, known, slope), (value, *others)

        groups = [a.reshape(-1, size, *a.shape[1:]) for a in pair]
        slope, (values, *others) = lax.scan(add, jax.tree.map(jnp.zeros_like, weights), groups)
        return jnp.sum(values), (slope, *(b.reshape(a.shape) for a, b in zip(pair, others)))

    def total_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
        value, found = by_groups(*primals)
        pairs = zip(jax.tree.leaves(found), jax.tree.leaves(tangents), strict=True)
        # Derivatives by an argument without a tangent are not used, so XLA does not compute them.
        moved = (jnp.sum(s * t) for s, t in pairs if not isinstance(t, SymbolicZero))
        return value[None], sum(moved, jnp.zeros_like(value)).astype(value.dtype)[None]

    total = jax.custom_jvp(lambda *given: plain(*given)[None])
    total.defjvp(total_jvp, symbolic_zeros=True)
    return total
