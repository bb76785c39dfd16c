"""The sensor layer: image = kernel * scene + noise (paper Eq. 6), with * a convolution."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from ..inputs import require
from ..numerics import EXACT, Numbers, einsum, safe_sqrt
from .kernel import SeparableKernel

Convolve = Callable[[Array, SeparableKernel | Array], Array]
# Smallest amount of light for which the gain of the sensor compensates; below it the image is dark.
# Mean of photographs.
_DARKEST, _MEAN = 0.02, 0.4


def _banded(kernel: Array, outputs: int) -> Array:
    """Banded matrix (C, N, N + K - 1) of a convolution: row i has the flipped kernel from column i
    on.

    kernel: (C, K).
    outputs: N.
    """
    channels, taps = kernel.shape
    width = outputs + taps - 1
    row = jnp.pad(kernel[:, ::-1], ((0, 0), (0, outputs)))  # width + 1: each row shifts by one
    tiled = jnp.tile(row, (1, outputs))[:, : outputs * width]
    return tiled.reshape(channels, outputs, width)


def _by_taps(scenes: Array, kernel: SeparableKernel) -> Array:
    """Separable convolution as a sum over taps, image by image, so that the planes stay in the
    cache and XLA does not compute the taps again."""

    def filtered(taps, planes, axis):
        count = planes.shape[axis] - taps.shape[1] + 1
        return sum(
            tap[:, None, None] * jax.lax.slice_in_dim(planes, i, i + count, axis=axis)
            for i, tap in enumerate(taps[:, ::-1].T)
        )

    half = jax.lax.map(lambda p: filtered(kernel.column, p, 1), jnp.moveaxis(scenes, -1, 1))
    return jnp.moveaxis(jax.lax.map(lambda p: filtered(kernel.row, p, 2), half), 1, -1)


def _by_bands(scenes: Array, kernel: SeparableKernel) -> Array:
    """Separable convolution as two products with banded matrices, each one product for all
    images, in forward and reverse mode."""
    taps = kernel.row.shape[-1]
    down = _banded(kernel.column, scenes.shape[1] - taps + 1)
    across = _banded(kernel.row, scenes.shape[2] - taps + 1)
    half = einsum("cyh,bhwc->cbyw", down, scenes)
    return einsum("cxw,cbyw->byxc", across, half)


def _check(scenes: Array, kernel: SeparableKernel | Array) -> None:
    """ValueError unless the scenes are floating-point numbers and the kernel fits into them."""
    shape, dtype = jnp.shape(scenes), jnp.result_type(scenes)
    if not jnp.issubdtype(dtype, jnp.floating):
        remedy = "scenes.astype(jnp.float32) / 255" if dtype == jnp.uint8 else "floating numbers"
        raise ValueError(f"scenes: values from 0 to 1 are expected, not {dtype}: give {remedy}")
    parts = kernel if isinstance(kernel, SeparableKernel) else (kernel,)
    sizes = {size for part in parts for size in jnp.shape(part)[1:]}
    channels = {jnp.shape(part)[:1] for part in parts}
    if len(shape) != 4 or channels != {shape[3:]}:
        raise ValueError(
            f"scenes: expected (B, H, W, C) with the C of the kernel, got {shape} and "
            f"{[jnp.shape(part) for part in parts]}"
        )
    what = f"scenes: {shape[1]} x {shape[2]} pixels are smaller than the kernel of {max(sizes)}"
    require(min(shape[1:3]) >= max(sizes), what)


def convolve(scenes: Array, kernel: SeparableKernel | Array) -> Array:
    """'Valid' convolution of each channel with its own kernel.

    scenes: (B, H + K - 1, W + K - 1, C), with true context on all sides.
    kernel: (C, K, K) [channel, y, x]; or a `SeparableKernel`, which is applied as two products with
        banded matrices.

    Returns (B, H, W, C). ValueError for scenes that are not floating-point numbers, and for shapes
    that do not fit.
    """
    _check(scenes, kernel)
    if isinstance(kernel, SeparableKernel):
        return _by_bands(scenes, kernel)
    return jax.lax.conv_general_dilated(
        scenes,
        jnp.moveaxis(kernel[:, ::-1, ::-1], 0, -1)[:, :, None],
        window_strides=(1, 1),
        padding="VALID",
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
        feature_group_count=scenes.shape[-1],
        precision=EXACT,
    )


def convolve_each(scenes: Array, kernels: Array) -> Array:
    """'Valid' convolution of each channel of each image with its own kernel, by FFT.

    scenes: (B, H + K - 1, W + K - 1, C), with true context on all sides.
    kernels: (B, C, K, K) [image, channel, y, x], from `psf` or `KernelGrid.at`; cast to the dtype
        of the scenes.

    Returns (B, H, W, C). ValueError for shapes that do not fit.
    """
    _check(scenes, jnp.zeros((scenes.shape[-1], *kernels.shape[-2:]), scenes.dtype))
    if kernels.shape[:2] != (scenes.shape[0], scenes.shape[3]):
        raise ValueError(f"kernels: expected (B, C, K, K) of {scenes.shape}, got {kernels.shape}")
    shape, size = scenes.shape[1:3], kernels.shape[-1]
    spectra = jnp.fft.rfft2(jnp.moveaxis(scenes, -1, 1))
    response = jnp.fft.rfft2(kernels.astype(scenes.dtype), shape)
    images = jnp.fft.irfft2(spectra * response, shape)
    return jnp.moveaxis(images[..., size - 1 :, size - 1 :], 1, -1)


def convolve_taps(scenes: Array, kernel: SeparableKernel | Array) -> Array:
    """`convolve`, but tap by tap for a separable kernel on a CPU: faster for values and in forward
    mode, ten times slower in reverse mode.

    scenes, kernel: as in `convolve`.
    """
    _check(scenes, kernel)
    if not isinstance(kernel, SeparableKernel):
        return convolve(scenes, kernel)
    return jax.lax.platform_dependent(scenes, kernel, cpu=_by_taps, default=_by_bands)


def sensor_layer(
    scenes: Array,
    kernel: SeparableKernel | Array,
    noise: Numbers,
    key: Array,
    convolve: Convolve = convolve,
) -> Array:
    """Sensor images: the convolved scenes plus white Gaussian noise.

    scenes: (B, H + K - 1, W + K - 1, C), values from 0 to 1.
    kernel: as in `convolve`; cast to the dtype of the scenes.
    noise: (), standard deviation.
    key: a PRNG key.
    convolve: `convolve` or `convolve_taps`.

    Returns (B, H, W, C). ValueError as in `convolve`.
    """
    _check(scenes, kernel)
    images = convolve(scenes, jax.tree.map(lambda array: array.astype(scenes.dtype), kernel))
    white = jax.random.normal(key, images.shape, images.dtype)
    return images + jnp.asarray(noise, images.dtype) * white


def noise_of(noise: Numbers, light: Array, value: Numbers = _MEAN) -> Array:
    """Standard deviation of the noise of an image whose gain compensates vignetting.

    noise: standard deviation of the read noise, (); or of read and shot noise, (2,), that of the
        shot noise at the value 1, both where the light is 1.
    light: relative light on the sensor; below 0.02 the gain is that of 0.02.
    value: pixel values without noise, from 0 to 1, which broadcast with `light`; by default the
        mean of photographs.
    """
    gain = 1 / jnp.maximum(light, _DARKEST)
    read, *shot = jnp.atleast_1d(jnp.asarray(noise, gain.dtype))
    if not shot:
        return gain * read
    return safe_sqrt((gain * read) ** 2 + gain * shot[0] ** 2 * jnp.maximum(jnp.asarray(value), 0))
