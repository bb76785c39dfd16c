"""3x3 convolution for the network; on a CPU by Winograd's minimal filtering."""

import math

import jax
import jax.numpy as jnp
from jax import Array, lax

# F(4x4, 3x3): 4x4 outputs from 6x6 inputs take 36 instead of 144 products for each pair of
# channels, y = A^T [(G w G^T) * (B^T x B)] A. Source: Lavin and Gray, CVPR 2016. The points 0,
# +-sqrt(1/2), +-sqrt(2) and infinity halve the rounding error of the usual 0, +-1, +-2.
_S, _T = math.sqrt(0.5), math.sqrt(2.0)
_INPUT = (
    (1, 0, -2.5, 0, 1, 0),
    (0, -2 * _S, -2, _S, 1, 0),
    (0, 2 * _S, -2, -_S, 1, 0),
    (0, -_S, -0.5, _T, 1, 0),
    (0, _S, -0.5, -_T, 1, 0),
    (0, 1, 0, -2.5, 0, 1),
)
_KERNEL = (
    (1, 0, 0),
    (-2 / 3, -2 / 3 * _S, -1 / 3),
    (-2 / 3, 2 / 3 * _S, -1 / 3),
    (1 / 6, _T / 6, 1 / 3),
    (1 / 6, -_T / 6, 1 / 3),
    (0, 0, 1),
)
_OUTPUT = tuple((*(p**k for p in (0.0, _S, -_S, _T, -_T)), float(k == 3)) for k in range(4))
# With fewer channels than `_CHANNELS` the transforms cost more than they save. For images of fewer
# pixels than `_PIXELS` the gain is not worth ten seconds of compilation.
_CHANNELS, _PIXELS = 32, 1024
# Pixels of the images that are convolved at once, so that their transforms stay in the cache.
AT_ONCE = 4096


def convolve_3x3(images: Array, kernel: Array) -> Array:
    """Convolution of stride 1, (B, H, W, out), with zeros beyond the edges.

    images: (B, H, W, in).
    kernel: (3, 3, in, out), of the same floating dtype.

    In float32 the error is about 1e-6 of the largest value, as for any convolution.
    """
    (count, height, width), (few, many) = images.shape[:3], sorted(kernel.shape[2:])
    is_large, are_many = height * width >= _PIXELS, few >= _CHANNELS
    is_end = few <= 4 and many >= _CHANNELS  # colours in or out
    if jax.default_backend() != "cpu" or (is_large and not are_many and not is_end):
        return _direct(images, kernel)
    method = _winograd if is_large and are_many else _gathered
    if is_end and kernel.shape[3] == few:
        method = _as_planes
    if count * height * width <= AT_ONCE:
        return method(images, kernel)
    # The gradient computes the transforms again, which costs less than storing them.
    return lax.map(jax.checkpoint(lambda image: method(image[None], kernel)[0]), images)


def _direct(images: Array, kernel: Array) -> Array:
    """XLA's own convolution."""
    return lax.conv_general_dilated(
        images, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def _shifted(images: Array) -> list[Array]:
    """The nine shifted copies of images (N, H, W, ...)."""
    height, width = images.shape[1:3]
    padded = jnp.pad(images, [(int(k in (1, 2)),) * 2 for k in range(images.ndim)])
    return [padded[:, i : i + height, j : j + width] for i in range(3) for j in range(3)]


def _gathered(images: Array, kernel: Array) -> Array:
    """For small images, and for few channels in: one matrix product of the nine shifted images,
    side by side, with the kernel.

    It is as fast as XLA's convolution, whose gradient is 20 times slower inside of a loop.
    """
    return jnp.concatenate(_shifted(images), -1) @ kernel.reshape(-1, kernel.shape[3])


def _as_planes(images: Array, kernel: Array) -> Array:
    """For few channels out: nine products as planes of pixels, whose sum runs along rows."""
    products = jnp.einsum("nhwc,ijcd->ijdnhw", images, kernel)
    planes = products.reshape(9, -1, *images.shape[1:3])
    first, *others = (_shifted(plane)[t] for t, plane in enumerate(planes))
    return jnp.moveaxis(sum(others, first).reshape(products.shape[2:]), 0, -1)


@jax.jit  # traced once for all layers of a size
def _winograd(images: Array, kernel: Array) -> Array:
    """Winograd's filtering F(4x4, 3x3), by 36 separate matrix products.

    One product over a batch of 36 would not run in parallel in XLA.
    """
    # (3, 3, in, out) -> 36 matrices (in, out).
    kernels = [k for row in _combined(_KERNEL, list(kernel)) for k in _combined(_KERNEL, list(row))]
    (count, *sides), out = images.shape[:3], kernel.shape[3]
    height, width = (-(-side // 4) for side in sides)  # tiles
    edges = ((0, 0), *((1, 3 + -side % 4) for side in sides), (0, 0))
    rows = _combined(_INPUT, _taps(jnp.pad(images, edges), 1))
    tiles = [tile for row in rows for tile in _combined(_INPUT, _taps(row, 2))]
    products = [
        (tile.reshape(count * height * width, -1) @ k).reshape(count, height, width, out)
        for tile, k in zip(tiles, kernels)
    ]
    columns = [jnp.stack(_combined(_OUTPUT, products[j::6]), 2) for j in range(6)]
    whole = jnp.stack(_combined(_OUTPUT, columns), 4).reshape(count, 4 * height, 4 * width, out)
    return whole[:, : sides[0], : sides[1]]


def _combined(matrix: tuple, parts: list[Array]) -> list[Array]:
    """Product of a matrix and a vector of arrays, written out, so that XLA makes one loop of each
    sum.
    """
    return [sum(c * p for c, p in zip(row, parts) if c) for row in matrix]


def _taps(padded: Array, axis: int) -> list[Array]:
    """The six inputs of every tile along an axis: entries 4 t, ..., 4 t + 5.

    They are made by a split, whose gradient is a concatenation. The gradient of strided slices
    would be six scattered sums.
    """
    count, shape = padded.shape[axis] // 4 - 1, padded.shape
    blocks = padded.reshape(*shape[:axis], count + 1, 4, *shape[axis + 1 :])
    phases = [part.squeeze(axis + 1) for part in lax.split(blocks, (1,) * 4, axis + 1)]
    first = [lax.slice_in_dim(p, 0, count, axis=axis) for p in phases]
    return first + [lax.slice_in_dim(p, 1, count + 1, axis=axis) for p in phases[:2]]
