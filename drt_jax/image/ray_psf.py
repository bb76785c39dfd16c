"""The kernel of geometric optics: the light of many rays, collected by pixels.

Hits come from the polynomials of a beam on a grid of the stop, so that many rays cost little.
Each ray stands for a cell of the grid; on the sensor it is a spot about as wide as the cell becomes
there (the biweight kernel of density estimation), so that the kernel is smooth in all parameters,
also where rays cross, and no light is lost or made. What the width of the spots adds to the
variance is taken away by drawing the hits together: centroid and covariance are those of the
moments.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..numerics import einsum, safe_divide, safe_sqrt
from .beam import Beam, centroid_and_variances, means
from .cover import cover
from .spot import normalised

# Half the width of a spot: in pixels at least, and in cells of the grid.
_BLUR, _CELLS = 0.05, 0.8
# Variance of a spot of half width 1.
_VARIANCE = 1 / 7


def ray_kernel(lens: Lens, beam: Beam, centre: Array, pixel: Array, size: int, cells: int) -> Array:
    """What pixels collect of the light, (W, size, size) [y, x], adding to the part of the
    throughput that falls on the grid of pixels.

    centre: (2,) mm, of the pixels on the sensor. pixel: () mm. cells: of the grid on the stop,
    along a side.
    """
    hits, width, weights = ray_spots(lens, beam, cells)
    edges = jnp.arange(size + 1, dtype=pixel.dtype) - size / 2
    place, blur = (hits - centre[:, None, None]) / pixel, width / pixel + _BLUR
    across, down = (_shares(edges, h, w) for h, w in zip(place, blur))
    return einsum("wqy,wqx->wyx", weights[..., None] * down, across)


def ray_spots(lens: Lens, beam: Beam, cells: int) -> tuple[Array, Array, Array]:
    """The light as Q = cells^2 spots: where they are (2, W, Q) and half how wide along x and y
    (2, W, Q), mm, and their light (W, Q), what the beam's mask lets pass of it."""
    functions, waves = beam.over_stop(), beam.path.shape[0]
    # Cells of the square that holds the light; its middle and half its side, in units of the stop.
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
    # How far the cell of a ray reaches on the sensor, along x and y.
    cell = (step * (2 / cells))[:, None, :, None, None]
    reach = safe_sqrt(sum((s * c) ** 2 for s, c in zip(slopes, cell)))
    hits, width = values[:2].reshape(2, waves, -1), _CELLS * reach.reshape(2, waves, -1)
    hits = _corrected(hits, weights, width, beam)
    if beam.mask is not None:
        sides = jnp.broadcast_to(axes[1][..., None, None] / 2, stop.shape)
        weights = weights * beam.mask.light(stop, sides).reshape(waves, -1)
    return hits, width, weights


def _corrected(hits: Array, weights: Array, width: Array, beam: Beam) -> Array:
    """Hits (2, W, Q) of spots of a width (2, W, Q), moved so that their light has the centroid and
    the covariance of the beam's rays."""
    centroid, wanted = centroid_and_variances(beam.hits[:, -1], beam.weights)
    mean, found = centroid_and_variances(hits, weights)
    spots = _VARIANCE * means(width**2, weights)
    p, q, r = _root(found)
    a, b, c = _root((wanted[0] - spots[0], wanted[1], wanted[2] - spots[1]))
    x, y = hits - mean[..., None]
    xx, yy = safe_divide(a, p), safe_divide(c, r)
    yx = safe_divide(b - yy * q, p)
    moved = jnp.stack([xx[:, None] * x, yx[:, None] * x + yy[:, None] * y])
    return centroid[..., None] + moved


def _root(covariance: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Elements 11, 21 and 22 of Cholesky's factor."""
    xx, xy, yy = covariance
    a = safe_sqrt(xx)
    b = safe_divide(xy, a)
    return a, b, safe_sqrt(yy - b * b)


def _shares(edges: Array, place: Array, width: Array) -> Array:
    """The part (W, Q, size) of spots at `place` (W, Q) of half `width` (W, Q) between neighbouring
    edges (size + 1,)."""
    found = below((edges[None, None] - place[..., None]) / width[..., None])
    return found[..., 1:] - found[..., :-1]


def below(t: Array) -> Array:
    """The part of a spot of half width 1 below t: the integral of 15 / 16 (1 - t^2)^2."""
    t = jnp.clip(t, -1, 1)
    square = t * t
    return 0.5 + t * (15 / 16 + square * (-5 / 8 + square * (3 / 16)))
