"""Gaussian optics: the y-u trace, focal length, image position. Source: any optics text."""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from .lens import Lens
from .numerics import safe_divide
from .surface import vertex_curvature

__all__ = ["back_focal_distance", "focal_length", "image_distance", "trace_yu"]


def trace_yu(
    curvature: Array, gaps: Array, index: Array, height: Array, slope: Array
) -> tuple[Array, Array]:
    """Paraxial trace of one ray.

    `curvature` (S,) at the vertex, `gaps` (S - 1,), `index` (S + 1, ...), `height` and
    `slope` (...) at the first vertex, before it. Returns the heights on the S surfaces and
    the slopes behind them, both (S, ...).
    """
    heights, slopes = [], []
    for i in range(curvature.shape[0]):
        if i:
            height = height + gaps[i - 1] * slope
        slope = (index[i] * slope - height * curvature[i] * (index[i + 1] - index[i])) / index[
            i + 1
        ]
        heights.append(height)
        slopes.append(slope)
    return jnp.stack(heights), jnp.stack(slopes)


def _trace(lens: Lens, wavelengths: Array, slope: ArrayLike) -> tuple[Array, Array]:
    """Heights and slopes of the ray of height 1 and the given slope at the first vertex."""
    index = lens.index(wavelengths)
    index = index * jnp.asarray(lens.senses[:, None], index.dtype)
    curvature = vertex_curvature(lens.shape, lens.forms, 1)[0]
    one = jnp.ones_like(index[0])
    return trace_yu(curvature, lens.thickness, index, one, one * slope)


def _parallel_ray(lens: Lens, wavelengths: Array) -> tuple[Array, Array]:
    height, slope = _trace(lens, wavelengths, 0.0)
    return height[-1], slope[-1]


def focal_length(lens: Lens, wavelengths: Array) -> Array:
    """Effective focal length (W,), mm; 0 for an afocal lens. `wavelengths` (W,) in um."""
    _, slope = _parallel_ray(lens, wavelengths)
    return safe_divide(-jnp.ones_like(slope), slope)


def back_focal_distance(lens: Lens, wavelengths: Array) -> Array:
    """Last vertex to the image of an infinitely far object (W,), mm. `wavelengths` in um."""
    height, slope = _parallel_ray(lens, wavelengths)
    return safe_divide(-height, slope)


def image_distance(lens: Lens, distance: float | Array, wavelengths: Array) -> Array:
    """First vertex to the paraxial image of an axial object at `distance` mm (W,), mm."""
    distance = jnp.asarray(distance, lens.curvature.dtype)
    height, slope = _trace(lens, wavelengths, 1 / distance)
    return lens.vertices[-1] + safe_divide(-height[-1], slope[-1])
