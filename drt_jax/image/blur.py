"""Blur that varies over the picture: a sum of a few kernels with weights that vary from pixel to
pixel.

The kernel of a pixel is sum_r shares_r kernel_r. The R kernels are the same for all pixels of a
tile; the shares are the pixel's own. So a tile costs one FFT, and one inverse FFT for each kernel.
"""

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import einsum

# Sides of the squares that are transformed: sizes with fast FFTs.
SIDES = (16, 32, 48, 64, 96, 128, 192, 256, 384, 512)


def blur_row(
    light: Array, kernels: Array, shares: Array, across: Array, tile: tuple[int, int]
) -> Array:
    """Blurs a row of n tiles.

    light: (C, height + K - 1, n width + K - 1), the tiles with a margin of context.
    kernels: (n, C, R, K, K) for each tile, or (1, ...) for all tiles; a pixel collects kernel[k] of
        the light k pixels before it, as in a convolution.
    shares: (C, R, height, M) or (1, ...), weight of each kernel in each row of pixels, at M nodes
        along the row.
    across: (n width, M), matrix that interpolates the shares from the nodes to pixels.
    tile: height and width of a tile, pixels.

    Returns (C, height, n width).
    """
    size, channels = kernels.shape[-1], len(light)
    (height, width), count = tile, len(across) // tile[1]
    ends = height + size - 1, width + size - 1
    sides = tuple(next((s for s in SIDES if s >= end), end) for end in ends)
    tiles = jnp.stack([light[:, :, j * width : j * width + ends[1]] for j in range(count)])
    spectra = jnp.fft.rfft2(tiles, sides)  # (n, C, ...)

    def added(total: Array, pair: tuple[Array, Array]) -> tuple[Array, None]:
        """Adds the light blurred with one kernel, times its shares."""
        kernel, share = pair
        blurred = jnp.fft.irfft2(spectra * jnp.fft.rfft2(kernel, sides), sides)
        inside = blurred[..., size - 1 : ends[0], size - 1 : ends[1]]
        each = einsum("cym,xm->cyx", share, across)
        return total + each * jnp.moveaxis(inside, 0, 2).reshape(total.shape), None

    start = jnp.zeros((channels, height, count * width), light.dtype)
    return jax.lax.scan(added, start, (jnp.moveaxis(kernels, 2, 0), jnp.moveaxis(shares, 1, 0)))[0]
