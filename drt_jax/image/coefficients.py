"""Wavefronts as Zernike coefficients: Noll's standard ones, and the fringe ones.

The path difference of `wavefront` over the stop is W = sum of c_j Z_j, fitted in least squares with
the unclipped light as the weight. Pupil coordinates are those of the stop in units of its
semi-diameter; angles are measured from the x axis.

Sources: Noll, J. Opt. Soc. Am. 66, 207 (1976), which OpticStudio calls Standard; for the order of
the fringe terms, Wyant and Creath, Basic Wavefront Aberration Theory (1992).
"""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.forms import fringe_terms, noll_terms
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import einsum
from ..pupil.patterns import disc
from ..rays.status import Status, reaches_sensor
from ..rays.trace import trace_bundle
from .rounding import warn_of_paths
from .wavefront import path_differences
from .zernike import zernike

# Nodes along a radius, and azimuths on half the disc: no aliasing between terms up to the degree
# 24.
_ORDER, _AZIMUTHS = 13, 26
_MOST = 91


def zernike_standard(lens: Lens, scene: Scene, count: int = 37) -> Array:
    """Coefficients of Noll's Zernike polynomials, which are orthonormal over the disc: the squares
    of all but the first add up to the mean square wavefront error.

    lens, scene: the lens, and object points with their wavelengths.
    count: number of coefficients, 1 to 91.

    Returns (..., W, count), waves; inf where the chief ray fails, or where so many rays fail that
    the fit is not determined. Differentiable in every mode. Warns of float32 as `wavefront` does.
    """
    return _coefficients(lens, scene, tuple(range(_checked(count, _MOST))))


def zernike_fringe(lens: Lens, scene: Scene, count: int = 37) -> Array:
    """Coefficients of the fringe Zernike polynomials, which are 1 at the edge of the disc.

    lens, scene: as in `zernike_standard`.
    count: number of coefficients, 1 to 37.

    Returns (..., W, count), waves; else as `zernike_standard`.
    """
    count = _checked(count, 37)
    terms = fringe_terms()[:count]
    most = max(n for n, _ in terms)
    noll = noll_terms(most)
    scale = np.array([np.sqrt(n + 1 if m == 0 else 2 * (n + 1)) for n, m in terms])
    # Only these terms are fitted, as the standard coefficients are a fit of their own terms.
    rows = tuple(noll.index(term) for term in terms)
    found = _coefficients(lens, scene, rows)
    return found * jnp.expand_dims(scale, range(found.ndim - 1))


def _checked(count: int, most: int) -> int:
    """`count` as an int. ValueError if it is not a whole number from 1 to `most`."""
    if not isinstance(count, int | np.integer) or not 1 <= count <= most:
        raise ValueError(f"count: expected a whole number from 1 to {most}, got {count!r}")
    return int(count)


def _coefficients(lens: Lens, scene: Scene, rows: tuple[int, ...]) -> Array:
    """Coefficients (..., W, P) of terms given by their indices in Noll's order, counted from 0."""
    scene = checked_scene(lens, scene)
    warn_of_paths(lens, scene, 4)
    return _least_squares(lens, scene, rows)


@functools.partial(jit, wanted=LARGE, static_argnames="rows")
def _least_squares(lens: Lens, scene: Scene, rows: tuple[int, ...]) -> Array:
    """The least-squares fit: the normal equations of the terms, solved for each point and
    wavelength."""
    points, weights = disc(_ORDER, _AZIMUTHS)
    degree = next(n for n in range(40) if (n + 1) * (n + 2) // 2 > max(rows))
    dtype = lens.curvature.dtype
    aimed = jnp.asarray(np.concatenate([np.zeros((1, 2)), points]).T, dtype)
    basis = zernike(aimed[:, 1:], degree)[np.array(rows)]

    def one(point: Scene) -> Array:
        bundle = trace_bundle(lens, point, tuple(aimed))
        opd, status, _ = path_differences(lens, scene.wavelengths, bundle)
        light = jnp.asarray(weights, dtype)[None] * (status[:, 1:] == Status.OK).astype(dtype)
        whole = reaches_sensor(status[:, 0])
        enough = whole & (jnp.sum(light > 0, axis=-1) > 2 * len(rows))
        light = jnp.where(enough[:, None], light, jnp.asarray(weights, dtype)[None])
        normal = einsum("wq,pq,rq->wpr", light, basis, basis)
        right = einsum("wq,pq,wq->wp", light, basis, opd[:, 1:])
        found = jnp.linalg.solve(normal, right[..., None])[..., 0]
        return jnp.where(enough[:, None], found, jnp.inf)

    return over_points(one, scene)
