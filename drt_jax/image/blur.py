"""Blur that varies over the picture: a few kernels, whose shares vary from pixel to pixel.

The kernel of a pixel is a sum of R kernels, the same for all pixels of a tile, times shares of its
own. Each kernel takes one transform back of a tile's light.
"""

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import einsum

# Sides of the squares that are transformed: fast ones.
SIDES = (16, 32, 48, 64, 96, 128, 192, 256, 384, 512)


def blur_row(
    light: Array, kernels: Array, shares: Array, across: Array, tile: tuple[int, int]
) -> Array:
    """A row of n tiles of height and width `tile`, blurred: (C, height, n width).

    light: (C, height + K - 1, n width + K - 1), with what lies around.
    kernels: (n, C, R, K, K) of each tile, or (1, ...) of all; a pixel collects kernel[k] of the
        light k pixels before it, as in a convolution.
    shares: (C, R, height, M) or (1, ...), what of each kernel a row of pixels takes at M places
        along it; across: (n width, M), the matrix that interpolates between them.
    """
    size, channels = kernels.shape[-1], len(light)
    (height, width), count = tile, len(across) // tile[1]
    ends = height + size - 1, width + size - 1
    sides = tuple(next((s for s in SIDES if s >= end), end) for end in ends)
    tiles = jnp.stack([light[:, :, j * width : j * width + ends[1]] for j in range(count)])
    spectra = jnp.fft.rfft2(tiles, sides)  # (n, C, ...)

    def added(total: Array, given: tuple[Array, Array]) -> tuple[Array, None]:
        kernel, share = given
        blurred = jnp.fft.irfft2(spectra * jnp.fft.rfft2(kernel, sides), sides)
        inside = blurred[..., size - 1 : ends[0], size - 1 : ends[1]]
        each = einsum("cym,xm->cyx", share, across)
        return total + each * jnp.moveaxis(inside, 0, 2).reshape(total.shape), None

    start = jnp.zeros((channels, height, count * width), light.dtype)
    return jax.lax.scan(added, start, (jnp.moveaxis(kernels, 2, 0), jnp.moveaxis(shares, 1, 0)))[0]
