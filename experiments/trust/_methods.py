"""What `accuracy` compares: the library's quadrature, and the patterns of other programs."""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Lens, PupilRule, pupil

from ._reference import flatten

__all__ = ["measured", "padded", "patterns", "programs", "rays_of"]

# What a method yields: (2,) sigma of the mean colour and height of the mean centroid, to be
# differentiated, and the sigmas (W,) and centroids (W, 2) of the colours, all in mm.
Measured = tuple[jax.Array, tuple[jax.Array, jax.Array]]


def measured(mean: jax.Array, covariance: jax.Array) -> Measured:
    """`Measured` from the moments of psf_moments, mm and mm^2."""
    sigma = jnp.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    return jnp.stack([jnp.mean(sigma), jnp.mean(mean[:, 1])]), (sigma, mean)


@functools.cache
def programs(
    rule: PupilRule | None, axial: bool, wavelengths: tuple[float, ...]
) -> tuple[Callable, Callable]:
    """(value, gradient), compiled functions of a lens, field and distance, and, without a rule, of
    the points and weights of a pattern; the gradient also of row (2,), last.

    value -> sigmas and centroids of the colours; gradient -> these, and the derivatives (P,) of
    row . (sigma, centroid) by reverse mode. A field on axis is a known constant.
    """

    def measure(field, distance, pattern, lens):
        chosen = rule or pupil.Pattern(*pattern)
        angle = 0.0 if axial else field
        moments = drt_jax.psf_moments(lens, angle, distance, wavelengths, rule=chosen)
        return measured(*moments)

    def value(lens, field, distance, *pattern):
        return measure(field, distance, pattern, lens)[1]

    def gradient(lens, field, distance, *rest):
        *pattern, row = rest
        part = functools.partial(measure, field, distance, pattern)
        _, back, colours = jax.vjp(part, lens, has_aux=True)
        return colours, flatten(back(row)[0])

    return jax.jit(value), jax.jit(gradient)


def patterns(rays: int, seeds: int) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Points (2, Q) and weights of each method with at most `rays` points; of `random`, several."""
    sides = range(2 * math.isqrt(rays), 0, -1)
    side = next(n for n in sides if pupil.square_grid(n)[1].size <= rays)
    rings = int((math.sqrt(12 * rays - 3) - 3) / 6)
    return {
        "random": [pupil.random_disc(rays, seed) for seed in range(seeds)],
        "square grid": [pupil.square_grid(side)],
        "hexapolar": [pupil.hexapolar(rings)],
        "Sobol": [pupil.sobol_disc(rays)],
    }


def padded(points: np.ndarray, weights: np.ndarray, rays: int, dtype: Any) -> tuple:
    """The pattern as arrays (rays, 2) and (rays,), filled up with weightless rays."""
    missing = rays - weights.size
    return (
        jnp.asarray(np.pad(points, ((0, 0), (0, missing))).T, dtype),
        jnp.asarray(np.pad(weights, (0, missing)), dtype),
    )


def rays_of(
    rule: PupilRule, lens: Lens, field: Any, distance: Any, wavelengths: tuple[float, ...]
) -> int:
    """How many rays of the first colour carry weight."""
    weights = drt_jax.pupil_points(lens, field, distance, wavelengths, rule)[1]
    return int(np.count_nonzero(np.asarray(weights)[0]))
