"""PSF kernels of a beam on the pixels, by one of three models: Gaussian, rays or waves.

For rays, the polynomials of the beam give the hits for a fine grid of stop points, so many rays
cost little. Each ray represents a cell of the grid. On the sensor it is a spot about as wide as the
image of that cell: the biweight kernel 15 / 16 (1 - t^2)^2 of density estimation. So the PSF is a
smooth function of all parameters, also where rays cross (at caustics), and the light is conserved.
The width of the spots would add to the variance; the hits are contracted to compensate, so that
centroid and covariance are those of the moments.
"""

import dataclasses
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..numerics import einsum, safe_divide, safe_sqrt
from ..pupil.rules import Mask, PupilRule
from .beam import Beam, BeamRule, beam_rule, centroid_and_variances, means
from .cover import cover
from .kernel import Pixels, gaussian_shares
from .spot import normalised
from .wave_psf import wave_kernel

Kind = Literal["gaussian", "rays", "waves"]
# Number of cells along a side of the pupil, and degree of polynomials, where none is given.
CELLS, DEGREE = 128, 14
_FINE = 8  # cells along each side of a pixel of a mask
# Half the width of the spot of a ray: _BLUR pixels plus _REACH times the size of the image of a
# cell.
_BLUR, _REACH = 0.05, 0.8
# Variance of a biweight spot of half width 1.
_VARIANCE = 1 / 7


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Psf:
    """Light of an object point on the pixels, for W wavelengths. Several points are the first axes
    of all arrays.

    kernel: (W, size, size), [wavelength, y, x], with the sum 1 - outside.
    outside: (W,), fraction of the light on the sensor that falls outside of the kernel.
    centre: (2,), mm, centre of the kernel on the sensor.
    throughput: (W,), fraction of the light through the stop that reaches the sensor.
    solid_angle: (W,), area of the cone of light on the sensor in direction cosines. Irradiance is
        radiance times this area. Its ratio to the area on the axis is the relative illumination.
    """

    kernel: Array
    outside: Array
    centre: Array
    throughput: Array
    solid_angle: Array


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Sampling:
    """How kernels, contrast and energy are computed: of which kind, by which rays, on which grid.
    `converge` makes one for a tolerance.

    kind: "gaussian" (the moments of the rays), "rays" (all their light) or "waves" (with
        diffraction).
    rule: rays and polynomials of the beam.
    cells: number of cells along a side of the pupil grid; 0 for "gaussian".
    errors: with "auto", the difference between the kernel of each kind and that of "waves" at the
        worst wavelength, which is compared with the tolerance.
    """

    kind: Kind = dataclasses.field(metadata={"static": True})
    rule: BeamRule
    cells: int = dataclasses.field(metadata={"static": True})
    errors: dict[str, float] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls, kind: Kind, rule: PupilRule, cells: int = CELLS, degree: int = DEGREE
    ) -> "Sampling":
        """A sampling by hand.

        kind: "gaussian", "rays" or "waves".
        rule: pupil rule, whose symmetry and kind (`Gauss` or `Clipped`) the rays have.
        cells: number of cells along a side of the pupil grid. With too few, the contrast of a large
            blur is too low, never too high.
        degree: of the polynomials of the pupil.
        """
        return cls(kind, beam_rule(degree, rule.symmetry, rule), cells)

    def masked(self, mask: Mask, cells: int = 0) -> "Sampling":
        """The sampling with a mask in the stop. Also in `jax.jit`; differentiable in the mask.

        mask: the mask.
        cells: number of cells along a side of the grid; 0 for the larger of its own number
            and 8 for each pixel of the mask. docs/images.md gives the accuracy.

        No more rays are traced than without the mask, and kernels are centred as without it.
        ValueError for a mask of a wrong shape, for the kind "gaussian", which only has the moments
        of the whole stop, and for a mask with a path for the kind "rays".
        """
        mask.check()
        if self.kind == "gaussian" or (self.kind == "rays" and mask.path is not None):
            what = "a mask" if mask.path is None else "a mask with a path"
            raise ValueError(f'{what} in the kind "{self.kind}": make one of "waves"')
        cells = cells or max(self.cells, _FINE * max(jnp.shape(mask.amplitude)[-2:]))
        rule = dataclasses.replace(self.rule, mask=mask)
        return dataclasses.replace(self, rule=rule, cells=cells)


def psf_of_beam(
    lens: Lens, beam: Beam, wavelengths: Array, pixels: Pixels, kind: Kind, cells: int
) -> Psf:
    """The `Psf` of a beam.

    lens, beam: the lens and its beam.
    wavelengths: (W,), um.
    pixels: those of the kernel.
    kind, cells: as in `Sampling`.
    """
    mean, (xx, xy, yy) = centroid_and_variances(beam.hits[:, -1], beam.weights)
    if pixels.centre is None:
        pixels = dataclasses.replace(pixels, centre=jnp.mean(mean, axis=-1))
    centre, light = pixels.centre, beam.throughput
    if beam.mask is not None:
        light = jnp.sum(ray_spots(lens, beam, cells)[2], axis=-1)
    total = light[:, None, None]
    if kind == "gaussian":
        covariance = jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)
        shift = (mean - centre[:, None]).T
        kernel = gaussian_shares(shift, covariance, pixels.side, pixels.size)
        kernel = jnp.where(total > 0, kernel, 0)
    else:
        if kind == "rays":
            kernel = _ray_kernel(lens, beam, pixels, cells)
        else:
            kernel = wave_kernel(lens, beam, wavelengths, pixels, cells)
        kernel = jnp.where(total > 0, kernel / jnp.where(total > 0, total, 1), 0)
    outside = jnp.where(light > 0, 1 - jnp.sum(kernel, axis=(1, 2)), 0)
    solid_angle = beam.solid_angle() * safe_divide(light, beam.throughput)
    return Psf(kernel, outside, centre, light, solid_angle)


def _ray_kernel(lens: Lens, beam: Beam, pixels: Pixels, cells: int) -> Array:
    """Geometric PSF kernel of a beam on the pixels.

    lens, beam: the lens and its beam.
    pixels: with their centre.
    cells: number of cells along a side of the grid on the stop.

    Returns (W, size, size) [y, x]. The sum is the part of the throughput that falls on the kernel.
    """
    hits, width, weights = ray_spots(lens, beam, cells)
    pixel, size = pixels.side, pixels.size
    edges = jnp.arange(size + 1, dtype=pixel.dtype) - size / 2
    place, blur = (hits - pixels.centre[:, None, None]) / pixel, width / pixel + _BLUR
    across, down = (_shares(edges, h, w) for h, w in zip(place, blur))
    return einsum("wqy,wqx->wyx", weights[..., None] * down, across)


def ray_spots(lens: Lens, beam: Beam, cells: int) -> tuple[Array, Array, Array]:
    """The light of a beam as Q = cells^2 spots, one for each cell of a grid on the stop.

    lens, beam: the lens and its beam.
    cells: number of cells along a side of the grid.

    Returns centres (2, W, Q) and half widths along x and y (2, W, Q), mm, and the light (W, Q) of
    each spot, which is multiplied by the transmission of the beam's mask.
    """
    functions, waves = beam.over_stop(), beam.path.shape[0]
    # Centre and half side of the square that contains the light, in semi-diameters of the stop.
    low, high = beam.extent()
    middle, half = (low + high) / 2, (high - low) / 2
    side = (np.arange(cells) - (cells - 1) / 2) * (2 / cells)
    start, step = (middle - functions.centre) / functions.scale, half / functions.scale
    values, *slopes = functions.on_grid(start, step, side, slice(2))
    grid = jnp.asarray(np.stack(np.meshgrid(side, side))[:, None], half.dtype)
    stop = middle[..., None, None] + half[..., None, None] * grid
    axes = middle, half * (2 / cells)
    light = cover(lens, beam, stop, values[2:], beam.points, axes)[0].reshape(waves, -1)
    weights = normalised(light) * beam.throughput[:, None]
    # Size of the image of a cell on the sensor, along x and y: sqrt((dx/du du)^2 + (dx/dv dv)^2).
    cell = (step * (2 / cells))[:, None, :, None, None]
    reach = safe_sqrt(sum((s * c) ** 2 for s, c in zip(slopes, cell)))
    hits, width = values[:2].reshape(2, waves, -1), _REACH * reach.reshape(2, waves, -1)
    hits = _corrected(hits, weights, width, beam)
    if beam.mask is not None:
        sides = jnp.broadcast_to(axes[1][..., None, None] / 2, stop.shape)
        weights = weights * beam.mask.light(stop, sides).reshape(waves, -1)
    return hits, width, weights


def _corrected(hits: Array, weights: Array, width: Array, beam: Beam) -> Array:
    """Centres of spots, moved so that their light has the centroid and the covariance of the beam's
    rays.

    hits, width: (2, W, Q), mm, centres and half widths.
    weights: (W, Q).

    A spot of half width w adds the variance w^2 / 7. With the Cholesky factors L of the covariance
    of the centres, and M of the covariance of the beam's rays less the mean of w^2 / 7, the map h
    -> centroid + M L^-1 (h - mean) gives the centres the covariance M M^T.
    """
    centroid, target = centroid_and_variances(beam.hits[:, -1], beam.weights)
    mean, found = centroid_and_variances(hits, weights)
    spots = _VARIANCE * means(width**2, weights)
    p, q, r = _cholesky(found)
    a, b, c = _cholesky((target[0] - spots[0], target[1], target[2] - spots[1]))
    x, y = hits - mean[..., None]
    xx, yy = safe_divide(a, p), safe_divide(c, r)
    yx = safe_divide(b - yy * q, p)
    moved = jnp.stack([xx[:, None] * x, yx[:, None] * x + yy[:, None] * y])
    return centroid[..., None] + moved


def _cholesky(covariance: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Elements 11, 21 and 22 of the Cholesky factor of a covariance with the elements xx, xy and
    yy."""
    xx, xy, yy = covariance
    a = safe_sqrt(xx)
    b = safe_divide(xy, a)
    return a, b, safe_sqrt(yy - b * b)


def _shares(edges: Array, place: Array, width: Array) -> Array:
    """Fractions (W, Q, size) of spots along one axis that fall between neighbouring pixel edges.

    edges: (size + 1,), pixels.
    place, width: (W, Q), centres and half widths of the spots, pixels.
    """
    found = spot_below((edges[None, None] - place[..., None]) / width[..., None])
    return found[..., 1:] - found[..., :-1]


def spot_below(t: Array) -> Array:
    """Fraction of a spot of half width 1 below t: the integral of 15 / 16 (1 - t^2)^2 from -1 to
    t."""
    t = jnp.clip(t, -1, 1)
    square = t * t
    return 0.5 + t * (15 / 16 + square * (-5 / 8 + square * (3 / 16)))
