"""Blur that varies over the picture: tiles with their corners' kernels, blended.

The kernel of a pixel is the bilinear blend of those at the corners of its tile. A tile takes one
transform of its light and one back for each corner; tiles share the kernels of their corners, so
that the blend is continuous and no seam is left.
"""

import jax.numpy as jnp
from jax import Array


def blur_row(light: Array, kernels: Array, tile: tuple[int, int]) -> Array:
    """A row of n tiles of height and width `tile`, blurred: (height, n width, C).

    light: (height + K - 1, n width + K - 1, C), with what lies around.
    kernels: (2, n + 1, C, K, K), at the upper and the lower corners of the tiles; a pixel collects
        kernel[k] of the light k pixels before it, as in a convolution.
    """
    size, count, channels = kernels.shape[-1], kernels.shape[1] - 1, light.shape[-1]
    height, width = tile
    sides = height + size - 1, width + size - 1
    planes = jnp.moveaxis(light, -1, 0)
    tiles = jnp.stack([planes[:, :, j * width : j * width + sides[1]] for j in range(count)])
    spectra = jnp.fft.rfft2(tiles)  # (n, C, ...)
    responses = jnp.fft.rfft2(kernels, sides)
    ramps = [jnp.arange(n, dtype=light.dtype) / n for n in tile]
    downs, acrosses = ((1 - ramp, ramp) for ramp in ramps)
    total = jnp.zeros((count, channels, height, width), light.dtype)
    for down in range(2):
        for across in range(2):
            response = responses[down, across : across + count]
            blurred = jnp.fft.irfft2(spectra * response, sides)
            share = downs[down][:, None] * acrosses[across][None, :]
            total = total + share[None, None] * blurred[..., size - 1 :, size - 1 :]
    return jnp.moveaxis(total, 0, 2).reshape(channels, height, count * width).transpose(1, 2, 0)
