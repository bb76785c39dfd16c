"""Methods that `accuracy` compares: the library's quadrature, and the patterns of other programs."""

import functools
import math
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Lens, Status
from drt_jax.pupil import rules as pupil
from drt_jax.pupil.clipped import ClippedPupil, find_boundary

from . import _common
from ._reference import flatten

# A call is repeated until so many seconds have passed, at least 3 and at most 15 times.
_TIMING = 0.1

# What a method yields: (2,) sigma of the mean colour and height of the mean centroid, to be
# differentiated, and the sigmas (W,) and centroids (W, 2) of the colours, all in mm.
Measured = tuple[jax.Array, tuple[jax.Array, jax.Array]]


def measured(mean: jax.Array, covariance: jax.Array) -> Measured:
    """`Measured` from the moments of psf_moments, mm and mm^2."""
    sigma = jnp.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    return jnp.stack([jnp.mean(sigma), jnp.mean(mean[:, 1])]), (sigma, mean)


def _pull(measure: Callable[[Lens], Measured], lens: Lens, row: jax.Array) -> tuple:
    """Colours, and the derivatives (P,) of row . (sigma, centroid) by reverse mode."""
    _, back, colours = jax.vjp(measure, lens, has_aux=True)
    return colours, flatten(back(row)[0])


@functools.cache
def quadrature(order: int | None, axial: bool, wavelengths: tuple[float, ...]):
    """(value, gradient) functions of psf_moments: of a lens, field, distance, rule (and row).

    A field known to be on axis is a constant, as in `psf_moments`. rule: None, or without an
    `order` the one that is fitted to the scene's clipped pupil.
    """

    def measure(field, distance, rule, lens):
        field = 0.0 if axial else field
        moments = drt_jax.psf_moments(
            lens, field, distance, wavelengths, order=rule if order is None else order
        )
        return measured(*moments)

    def value(lens, field, distance, rule):
        return measure(field, distance, rule, lens)[1]

    def gradient(lens, field, distance, rule, row):
        return _pull(functools.partial(measure, field, distance, rule), lens, row)

    return jax.jit(value), jax.jit(gradient)


def fitted_rule(
    order: int,
    axial: bool,
    wavelengths: tuple[float, ...],
    lens: Lens,
    field: jax.Array,
    distance: jax.Array,
) -> ClippedPupil:
    """The rule of an order on what the clear apertures of a vignetted scene leave."""
    angles = jnp.zeros(1, field.dtype) if axial else jnp.stack([0 * field, field])
    colours = jnp.asarray(wavelengths, field.dtype)
    boundary = find_boundary(lens, angles, distance, colours, "meridian" if axial else "half")
    _common.require(boundary is not None, "scenes: the apertures of a scene let no light pass")
    return boundary.rule(order)


@functools.cache
def sampled(wavelengths: tuple[float, ...]):
    """(value, gradient): sums over given points (Q, 2) on the stop and their weights (Q,)."""

    def measure(field, distance, points, weights, lens):
        rays = drt_jax.trace_rays(lens, field, distance, wavelengths, points)
        weights = jnp.where(rays.status == Status.OK, weights, 0)
        weights = (weights / jnp.sum(weights, axis=1, keepdims=True))[..., None]
        spot = rays.points[:, :, -1, :2]
        mean = jnp.sum(weights * spot, axis=1)
        spot = spot - mean[:, None]
        return measured(mean, jnp.einsum("wqi,wqj->wij", weights * spot, spot))

    def value(lens, field, distance, points, weights):
        return measure(field, distance, points, weights, lens)[1]

    def gradient(lens, field, distance, points, weights, row):
        return _pull(functools.partial(measure, field, distance, points, weights), lens, row)

    return jax.jit(value), jax.jit(gradient)


def patterns(rays: int, seeds: int) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Points and weights of each method with at most `rays` points; of `random`, several."""
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


def seconds(call: Callable[[], Any]) -> float:
    """Median wall time of a call whose program is compiled."""
    times: list[float] = []
    while len(times) < 3 or (sum(times) < _TIMING and len(times) < 15):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def pupil_points(order: int | ClippedPupil, axial: bool) -> int:
    """Rays of a quadrature of that order: on one radius, or n + 1 azimuths of half a disc; of a
    fitted rule, those that carry weight."""
    if isinstance(order, ClippedPupil):
        return int(np.count_nonzero(order.weight[0]))
    return order if axial else order * (order + 1)
