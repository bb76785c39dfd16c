"""PSF kernel of geometric optics: the light of many rays, collected by pixels.

The polynomials of a beam give the hits for a fine grid of stop points, so many rays cost little.
Each ray represents a cell of the grid. On the sensor it is a spot about as wide as the image of
that cell: the biweight kernel 15 / 16 (1 - t^2)^2 of density estimation. So the PSF is a smooth
function of all parameters, also where rays cross (at caustics), and the light is conserved. The
width of the spots would add to the variance; the hits are contracted to compensate, so that
centroid and covariance are those of the moments.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..numerics import einsum, safe_divide, safe_sqrt
from .beam import Beam, centroid_and_variances, means
from .cover import cover
from .spot import normalised

# Half the width of a spot: _BLUR pixels plus _CELLS times the size of the image of a cell.
_BLUR, _CELLS = 0.05, 0.8
# Variance of a biweight spot of half width 1.
_VARIANCE = 1 / 7


def ray_kernel(lens: Lens, beam: Beam, centre: Array, pixel: Array, size: int, cells: int) -> Array:
    """Geometric PSF kernel of a beam on the pixels.

    lens, beam: the lens and its beam.
    centre: (2,), mm, centre of the kernel on the sensor.
    pixel: (), side of a pixel, mm.
    size: number of pixels along a side of the kernel.
    cells: number of cells along a side of the grid on the stop.

    Returns (W, size, size) [y, x]. The sum is the part of the throughput that falls on the kernel.
    """
    hits, width, weights = ray_spots(lens, beam, cells)
    edges = jnp.arange(size + 1, dtype=pixel.dtype) - size / 2
    place, blur = (hits - centre[:, None, None]) / pixel, width / pixel + _BLUR
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
    hits, width = values[:2].reshape(2, waves, -1), _CELLS * reach.reshape(2, waves, -1)
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
