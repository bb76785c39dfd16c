"""The best linear filter behind a lens, and its error in closed form.

Let x be a scene with the power spectrum S(f), (C, C) at each frequency f. The kernel of an object
point p has the transfer functions H_p(f), diagonal over the channels, and the noise n the variance
N; the image is y = H_p x + n. The one filter with the least mean square error over all points is
(Wiener 1949, here over channels and points)

    W = S M^* R^-1,  R = mean_p(H_p S H_p^*) + N,  M = mean_p(H_p),  error = diag(S - W M S).

The error has derivatives by the kernels, needs no images and no network, and is a merit of a lens
like its spots, see `design.filter_error`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import Numbers, einsum


class Wiener(NamedTuple):
    """The best linear filter and its error.

    taps: (T, T, C, C), [y, x, in, out], for `apply_filter`.
    error: (N, N // 2 + 1, C), the share of each frequency in the mean square error of a channel,
        for values from 0 to 1. The sum over the frequencies is that error.
    """

    taps: Array
    error: Array


def power_of(patches: np.ndarray, side: int = 64) -> np.ndarray:
    """Power spectrum (side, side // 2 + 1, C, C) of images about their common mean: the mean over
    their middles, with a Hann window. Its mean over all frequencies is the mean square.

    patches: uint8 (B, P, P, C). ValueError for a P below `side`.
    """
    start = (patches.shape[1] - side) // 2
    require(start >= 0, f"patches: {patches.shape[1]} pixels a side, fewer than side: {side}")
    real = patches[:, start : start + side, start : start + side] / 255
    line = np.hanning(side + 2)[1:-1]
    window = np.outer(line, line)[:, :, None]
    spectra = np.fft.rfft2((real - np.mean(real, (0, 1, 2))) * window, axes=(1, 2))
    # A scene and its mirror image are equally likely, so the cross spectrum of two channels is
    # real.
    power = np.einsum("byxi,byxj->yxij", spectra, np.conj(spectra)).real
    return power / (len(patches) * np.sum(window**2))


def wiener(kernels: Array, noise: Numbers, power: Numbers, size: int = 33) -> Wiener:
    """The best linear filter of a camera. Differentiable.

    kernels: (P, C, K, K), of P object points of equal weight, with K odd and one centre for all
        channels, as from `psf`.
    noise: standard deviation of the noise, (P, C), or what broadcasts to it, see `noise_of`.
    power: (N, N // 2 + 1, C, C), see `power_of`; N is at least K and at least `size`.
    size: number of taps T along a side, odd.

    ValueError for sizes that are even, and for a spectrum of too few frequencies.
    """
    power, noise = (jnp.asarray(a, kernels.dtype) for a in (power, noise))
    count, side = power.shape[0], kernels.shape[-1]
    sizes = f"kernels of {side} pixels and {size} taps"
    require(size % 2 == side % 2 == 1, f"{sizes}: give odd numbers")
    require(count >= max(side, size), f"power: {count} frequencies a side are too few for {sizes}")
    padded = jnp.pad(kernels, ((0, 0), (0, 0), *((0, count - side),) * 2))
    response = jnp.fft.rfft2(jnp.roll(padded, (-(side // 2),) * 2, (2, 3)))
    response = jnp.moveaxis(response, 1, -1)  # (P, N, N // 2 + 1, C)
    variance = jnp.mean(jnp.broadcast_to(jnp.square(noise), kernels.shape[:2]), axis=0)
    pairs = einsum("pyxi,pyxj->yxij", response, jnp.conj(response)) / len(response)
    spectrum = power.astype(response.dtype)
    received = spectrum * pairs + jnp.diag(variance).astype(response.dtype)[None, None]
    mixed = spectrum * jnp.mean(response, axis=0)[..., None, :]  # M S, transposed
    adjoint = jnp.linalg.solve(received, jnp.swapaxes(mixed, -1, -2))  # R is Hermitian
    filters = jnp.conj(jnp.swapaxes(adjoint, -1, -2))
    explained = einsum("yxij,yxij->yxi", filters, mixed).real
    left = jnp.diagonal(power, 0, 2, 3) - explained
    # The spectrum of a real image is Hermitian, so half of the plane is enough.
    twice = np.where(np.isin(np.arange(count // 2 + 1), (0, count / 2)), 1.0, 2.0) / count**2
    error = left * jnp.asarray(twice, left.dtype)[None, :, None]
    taps = jnp.fft.irfft2(filters, (count, count), axes=(0, 1))
    taps = jnp.roll(taps, (size // 2,) * 2, (0, 1))[:size, :size]
    return Wiener(jnp.swapaxes(taps, 2, 3), error)


def apply_filter(taps: Array, images: Array) -> Array:
    """'Valid' convolution of images with a filter that mixes channels, by FFT.

    taps: (T, T, C, C), [y, x, in, out].
    images: (B, H, W, C), of the same dtype.

    Returns (B, H - T + 1, W - T + 1, C): the pixels whose whole neighbourhood lies in the image.
    """
    shape, size = images.shape[1:3], taps.shape[0]
    spectra = jnp.fft.rfft2(images, axes=(1, 2))
    response = jnp.fft.rfft2(taps, shape, axes=(0, 1))
    mixed = jnp.fft.irfft2(einsum("byxi,yxio->byxo", spectra, response), shape, axes=(1, 2))
    return mixed[:, size - 1 :, size - 1 :]
