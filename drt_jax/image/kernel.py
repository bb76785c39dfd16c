"""Gaussian kernels on the pixel grid from centroid and covariance (paper Eq. 5). From this
module on, lengths can be in pixels."""

import dataclasses
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.scipy.special import erf

from ..inputs import require, require_one_of, warn
from ..numerics import Numbers, concrete, real_array, safe_sqrt
from .spot import normalised

Form = Literal["integrated", "sampled"]

# A Gaussian with a sigma below this (pixels) is treated as a point.
_POINT = 1e-4
_ANGLES, _ANGLE_WEIGHTS = np.polynomial.legendre.leggauss(24)
_MAX_CORRELATION = 1 - 1e-6
# A pixel larger than this (mm) was more likely given in um.
_LARGE_PIXEL = 1.0
# Limits whose squares are finite in float32. Beyond them a kernel is 0 or constant.
# _FAR: centroids, pixels; and the side of a pixel, mm, as well as its inverse.
# _WIDE: variances, pixels^2.
# _DARK: distance from the centre of a Gaussian, sigma.
_FAR, _WIDE, _DARK = 1e9, 1e15, 60.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pixels:
    """`size` x `size` square pixels on the sensor.

    side: (), side of a pixel, mm.
    size: static, number of pixels along a side.
    centre: (2,), mm, their middle on the sensor; None for the mean of the centroids of all
        wavelengths.
    """

    side: Array
    size: int = dataclasses.field(metadata={"static": True})
    centre: Any = None


class SeparableKernel(NamedTuple):
    """A kernel that is an outer product: kernel[c, y, x] = column[c, y] row[c, x].

    column, row: (C, K) each.
    """

    column: Array
    row: Array

    def dense(self) -> Array:
        """The kernel as one array (C, K, K)."""
        return self.column[:, :, None] * self.row[:, None, :]


def gaussian_psf(
    mean: Numbers, covariance: Numbers, pixel: Numbers, size: int = 21, form: Form = "integrated"
) -> Array:
    """Gaussian kernels of C channels.

    mean: (C, 2), x and y from the centre of the grid, mm.
    covariance: (C, 2, 2), mm^2.
    pixel: (), side of a pixel, mm. Warns above 1 mm, which may be meant in um.
    size: number of pixels along a side of the grid.
    form: "integrated" over the area of each pixel, and normalised to the sum 1; or "sampled" as in
        Eq. 5, the density at the pixel centres, which is not normalised: the sum is below 1 for a
        wide blur and may be anything for a narrow one.

    Returns an array [channel, y, x], (C, size, size), in the dtype of `mean`. Values and
    derivatives stay finite as the blur shrinks to a point or grows beyond the grid. ValueError for
    other shapes, for known values that are not finite, and for a pixel not above 0. Inside a trace,
    a channel with such values (an infinite covariance if no ray arrives) is 0, with derivatives 0.
    """
    centroid, spread, void = _in_pixels(*_checked(mean, covariance, pixel, size, form))
    if form == "sampled":
        kernel = _sampled(centroid, spread, size)
    else:
        kernel = normalised(_integrated(centroid, spread, size), (-2, -1))
    return jnp.where(void[:, None, None], 0, kernel)


def separable_psf(
    mean: Numbers, covariance: Numbers, pixel: Numbers, size: int = 21, form: Form = "integrated"
) -> SeparableKernel:
    """`gaussian_psf` for diagonal covariances, as a row and a column for each channel, see
    `Moments.separable`.

    mean, covariance, pixel, size, form: as in `gaussian_psf`.

    ValueError as there, and for a known xy other than 0.
    """
    checked = _checked(mean, covariance, pixel, size, form)
    if concrete(covariance) and np.any(np.asarray(checked[1])[:, [0, 1], [1, 0]]):
        raise ValueError("covariance: xy must be 0 for a separable kernel; use gaussian_psf")
    centroid, spread, void = _in_pixels(*checked)
    lines = _profiles(centroid, jnp.diagonal(spread, 0, 1, 2), size, form)
    if form == "integrated":
        lines = normalised(lines)
    lines = jnp.where(void[:, None, None], 0, lines)
    return SeparableKernel(column=lines[:, 1], row=lines[:, 0])


def gaussian_shares(mean: Array, covariance: Array, pixel: Array, size: int) -> Array:
    """`gaussian_psf` without checks and without normalisation: the sum of a kernel is the
    fraction of its light that falls on the grid."""
    mean, covariance, void = _in_pixels(mean, covariance, pixel)
    return jnp.where(void[:, None, None], 0, _integrated(mean, covariance, size))


def _checked(
    mean: Numbers, covariance: Numbers, pixel: Numbers, size: int, form: Form
) -> tuple[Array, Array, Array]:
    """Checks the arguments of `gaussian_psf`; returns centroids, covariances and pixel as arrays
    of one dtype."""
    require_one_of("form", form, get_args(Form))
    floating = jnp.issubdtype(getattr(mean, "dtype", int), jnp.floating)
    dtype = jnp.result_type(mean) if floating else jnp.result_type(float)
    given: dict[str, Numbers] = {"mean": mean, "covariance": covariance}
    arrays = [real_array(name, value, dtype) for name, value in given.items()]
    channels = arrays[0].shape[:1]
    shapes = (*channels, 2), (*channels, 2, 2)
    texts = "(C, 2)", "(C, 2, 2) with the C of mean"
    for name, array, shape, text in zip(given, arrays, shapes, texts, strict=True):
        if array.shape != shape or array.size == 0:
            raise ValueError(f"{name}: expected {text}, got shape {array.shape}")
        if concrete(given[name]) and not np.all(np.isfinite(np.asarray(given[name], float))):
            hint = "; no ray of that wavelength arrives" if name == "covariance" else ""
            raise ValueError(f"{name}: must be finite{hint}")
    return arrays[0], arrays[1], check_pixels(pixel, size, dtype).side


def check_pixels(pixel: Numbers, size: int, dtype: Any) -> Pixels:
    """The `Pixels` of a side, (), mm, and a number along a side.

    Warns of a pixel above 1 mm. ValueError for invalid values, as far as they are known.
    """
    if not isinstance(size, int | np.integer) or size < 1:
        raise ValueError(f"size: expected a whole number of pixels, at least 1, got {size!r}")
    side = real_array("pixel", pixel, dtype)
    require(not side.shape, f"pixel: expected one number, got shape {side.shape}")
    if concrete(pixel):
        known = np.asarray(pixel, float).item()
        require(np.isfinite(known), "pixel: must be finite")
        require(known > 0, f"pixel: must be above 0 mm, got {known:g}")
        if known > _LARGE_PIXEL:
            um = f"if it is {known:g} um, give {1e-3 * known:g}"
            warn(f"pixel: {known:g} mm is a large one; {um}")
    return Pixels(side, int(size))


def _in_pixels(mean: Array, covariance: Array, side: Array) -> tuple[Array, Array, Array]:
    """Centroids (C, 2) and covariances (C, 2, 2) in pixels, within the limits of this module; and
    True (C,) for a kernel that is 0, because its numbers or the pixel are not usable."""
    usable = (side > 1 / _FAR) & (side < _FAR)
    side = jnp.where(usable, side, 1)
    known = jnp.isfinite(mean), jnp.isfinite(covariance)
    void = ~(jnp.all(known[0], axis=1) & jnp.all(known[1], axis=(1, 2)) & usable)
    far, wide = _FAR * side, _WIDE * side**2
    mean = jnp.clip(jnp.where(known[0], mean, 0), -far, far) / side
    covariance = jnp.clip(jnp.where(known[1], covariance, 0), -wide, wide) / side**2
    return mean, covariance, void


def _grid(count: int, mean: Array) -> Array:
    """Distances (C, 2, count) of grid points, 1 pixel apart, from the centroids (C, 2)."""
    places = jnp.arange(count, dtype=mean.dtype) - (count - 1) / 2
    return places[None, None] - mean[..., None]


def _standardise(offset: Array, variance: Array) -> tuple[Array, Array, Array]:
    """offset / sigma, sigma, and a mask that is True where the Gaussian is not treated as a point;
    elsewhere sigma is 1.

    offset: (C, 2, N), pixels from the centroid.
    variance: (C, 2), pixels^2.
    """
    sigma = safe_sqrt(variance)[..., None]
    wide = sigma > _POINT
    sigma = jnp.where(wide, sigma, 1)
    return offset / sigma, sigma, wide


def _profiles(mean: Array, variance: Array, size: int, form: Form) -> Array:
    """A Gaussian along x and along y, (C, 2, size): its integrals over the pixels or, sampled, its
    densities at their centres, which are 0 for a point.

    mean, variance: (C, 2), pixels and pixels^2.
    """
    if form == "sampled":
        z, sigma, wide = _standardise(_grid(size, mean), variance)
        return jnp.where(wide, jnp.exp(-z * z / 2) / (sigma * (2 * jnp.pi) ** 0.5), 0)
    edges = _grid(size + 1, mean)
    z, _, wide = _standardise(edges, variance)
    step = jnp.heaviside(edges, 0.5)  # of a point
    return jnp.diff(jnp.where(wide, (1 + erf(z * 0.5**0.5)) / 2, step), axis=-1)


def _integrated(mean: Array, covariance: Array, size: int) -> Array:
    """Integrals (C, size, size) of a Gaussian over the pixels.

    For a correlation r the bivariate normal distribution is the product of its marginals plus the
    integral over a, from 0 to arcsin r, of exp(-(x^2 - 2 x y sin a + y^2) / (2 cos^2 a)) / (2 pi),
    here by 24 Gauss nodes. Differences over the corners of a pixel give its integral. Source:
    Plackett (1954); Drezner and Wesolowsky (1990).
    """
    variance = jnp.diagonal(covariance, 0, 1, 2)
    lines = _profiles(mean, variance, size, "integrated")
    # The part that the correlation adds, see above.
    z, _, wide = _standardise(_grid(size + 1, mean), variance)
    both = jnp.all(wide[..., 0], axis=-1)
    scale = jnp.where(both, variance[:, 0] * variance[:, 1], 1)
    ratio = jnp.where(both, covariance[:, 0, 1], 0) / jnp.sqrt(scale)
    ratio = jnp.clip(ratio, -_MAX_CORRELATION, _MAX_CORRELATION)
    limit = jnp.arcsin(ratio)[:, None, None]
    rule = (_ANGLES, _ANGLE_WEIGHTS)
    nodes, weights = (jnp.asarray(a, ratio.dtype).reshape(-1, 1, 1, 1) for a in rule)
    angle = limit[None] * ((1 + nodes) / 2)
    z = jnp.clip(z, -_DARK, _DARK)
    x, y = z[None, :, 0, None, :], z[None, :, 1, :, None]
    exponent = (x * x - 2 * x * y * jnp.sin(angle) + y * y) / (2 * jnp.cos(angle) ** 2)
    correction = jnp.sum(weights * jnp.exp(-exponent), axis=0) * limit / (4 * jnp.pi)
    kernel = lines[:, 1, :, None] * lines[:, 0, None, :]
    return kernel + jnp.diff(jnp.diff(correction, axis=-1), axis=-2)


def _sampled(mean: Array, covariance: Array, size: int) -> Array:
    """Densities (C, size, size) of a Gaussian at the pixel centres; 0 for a point."""
    xx, yy, xy = covariance[:, 0, 0], covariance[:, 1, 1], covariance[:, 0, 1]
    determinant = xx * yy - xy * xy
    wide = (determinant > _POINT**2 * (xx + yy)) & (xx > 0) & (yy > 0)
    xx, yy, determinant = (jnp.where(wide, a, 1)[:, None, None] for a in (xx, yy, determinant))
    xy, wide = jnp.where(wide, xy, 0)[:, None, None], wide[:, None, None]
    offset = _grid(size, mean)
    x, y = offset[:, 0, None, :], offset[:, 1, :, None]
    exponent = (yy * x * x - 2 * xy * x * y + xx * y * y) / (2 * determinant)
    exponent = jnp.maximum(exponent, 0)
    return jnp.where(wide, jnp.exp(-exponent) / (2 * jnp.pi * jnp.sqrt(determinant)), 0)
