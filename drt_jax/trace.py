"""Lens + field + distance + wavelengths + points on the stop -> rays with a status."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

from . import surface
from .fermat import Status, System, geometry
from .glass import check_wavelengths
from .implicit import solve_rays
from .lens import Lens
from .numerics import safe_divide
from .start import first_guess

__all__ = ["Rays", "trace_bundle", "trace_rays"]

_LINE_STEPS = 4


class Rays(NamedTuple):
    """Traced rays.

    points (W, Q, S + 1, 3), mm: where they cross the surfaces and the sensor, z from the
    first vertex; zeros for a ray that failed. status (W, Q), int32, see `Status`.
    newton_steps (), int32: iterations of the whole bundle.
    """

    points: Array
    status: Array
    newton_steps: Array


def _live_surfaces(lens: Lens) -> list[int]:
    """Surfaces that bend or label rays: not those with the same medium on both sides."""
    media = lens.glasses
    count = len(media) - 1
    return [i for i in range(count) if i == lens.stop or media[i] != media[i + 1]]


def _profile(lens: Lens, rows: list[int]) -> tuple[Array, Array, Array, Array]:
    """Vertex, curvature, conic and coefficients of some surfaces and then the sensor."""

    def extend(array):
        return jnp.concatenate([array[jnp.array(rows)], jnp.zeros_like(array[:1])])

    vertex = extend(lens.vertices).at[-1].set(lens.sensor)
    return vertex, extend(lens.curvature), extend(lens.conic), extend(lens.coefficients).T


def _cross_dead_surfaces(lens: Lens, system: System, hits: Array, live: list[int]) -> Array:
    """Insert the points where the straight ray crosses the surfaces left out of the solve."""
    path = geometry(hits, system)
    z = system.vertex[:, None, None] + surface.sag(hits, *system.shape)
    rows = []
    for i in range(len(lens.glasses) - 1):
        if i in live:
            rows.append(hits[:, live.index(i)])
            continue
        after = sum(j < i for j in live)  # the live surface, or the sensor, behind it
        slope = path.direction[:-1, after] / path.direction[-1, after]
        shape = (lens.curvature[i], lens.conic[i], lens.coefficients[i])
        depth = lens.vertices[i] - z[after]
        point = hits[:, after] + slope * depth
        for _ in range(_LINE_STEPS):
            sag, gradient, _ = surface.sag_derivatives(point, *shape)
            miss = hits[:, after] + slope * (depth + sag) - point
            # The correction lies along the ray: d(slope sag)/dpoint has rank one.
            change = safe_divide(jnp.sum(gradient * miss, axis=0), 1 - jnp.sum(gradient * slope, axis=0))
            point = point + miss + slope * change
        rows.append(point)
    return jnp.stack([*rows, hits[:, -1]], axis=1)


def trace_bundle(
    lens: Lens, field: Array, distance: Array, wavelengths: Array, pupil: ArrayLike
) -> tuple[Array, Array, Array]:
    """Trace rays in the array layout of `fermat`, rays last.

    `field` (D,) angles in radians, `distance` () from the object to the first vertex in mm,
    `wavelengths` (W,) in um, `pupil` (D, Q) points on the unit disc of the stop; D = 1 for
    rays in the meridional (y, z) plane, else 2. Returns hits (D, S + 1, W, Q) in mm, status
    (W, Q) and the number of Newton steps.
    """
    live = _live_surfaces(lens)
    stop = live.index(lens.stop)
    media = jnp.array([0] + [i + 1 for i in live])
    vertex, curvature, conic, coefficients = _profile(lens, live)
    dtype = vertex.dtype
    field = jnp.asarray(field, dtype)
    system = System(
        vertex=vertex,
        curvature=curvature,
        conic=conic,
        coefficients=coefficients,
        index=lens.index(wavelengths)[media],
        # Light with a positive field angle travels upwards: the object lies below the axis.
        source=jnp.concatenate([-jnp.tan(field), -jnp.ones_like(field[:1])]),
        vergence=1 / jnp.asarray(distance, dtype),
        stop=lens.semi_diameter[lens.stop] * jnp.asarray(pupil, dtype),
    )
    guess = first_guess(jax.lax.stop_gradient(system), stop)
    hits, status, steps = solve_rays(stop, system, guess)
    if len(live) < len(lens.glasses) - 1:
        hits = _cross_dead_surfaces(lens, system, hits, live)
    radius2 = jnp.sum(hits[:, :-1] ** 2, axis=0)
    edge2 = (lens.semi_diameter.at[lens.stop].set(jnp.inf) ** 2)[:, None, None]
    clipped = jnp.any(radius2 > edge2, axis=0) & (status == Status.OK)
    return hits, jnp.where(clipped, jnp.int32(Status.CLIPPED), status), steps


def as_field(field: ArrayLike, dtype: jnp.dtype) -> Array:
    """A field, one angle (along y) or two (x, y) in radians, as (2,)."""
    field = jnp.asarray(field, dtype)
    if field.ndim == 0:
        return jnp.stack([jnp.zeros_like(field), field])
    if field.shape != (2,):
        raise ValueError(f"field: expected one angle or two, got shape {field.shape}")
    return field


def trace_rays(
    lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: ArrayLike, pupil: ArrayLike
) -> Rays:
    """Trace the rays that cross the stop at given points.

    `field`: angle in radians along y, or (x, y); positive light travels upwards. `distance`:
    mm from the object plane to the first vertex, inf allowed. `wavelengths` (W,) in um.
    `pupil` (Q, 2), x and y on the stop in units of its semi-diameter. Rays are aimed at the
    real stop, for every wavelength. Differentiable in everything but the status. ValueError
    for a known wavelength outside the range of a glass.
    """
    check_wavelengths(lens.glasses, wavelengths)
    dtype = lens.curvature.dtype
    # One type for numbers, NumPy's and JAX's arrays, so that they share a compiled program.
    return _trace_rays(
        lens, as_field(field, dtype), jnp.asarray(distance, dtype),
        jnp.atleast_1d(jnp.asarray(wavelengths, dtype)), jnp.asarray(pupil, dtype),
    )  # fmt: skip


@jax.jit
def _trace_rays(
    lens: Lens, field: Array, distance: Array, wavelengths: Array, pupil: Array
) -> Rays:
    hits, status, steps = trace_bundle(lens, field, distance, wavelengths, pupil.T)
    shape = _profile(lens, list(range(len(lens.glasses) - 1)))
    z = shape[0][:, None, None] + surface.sag(
        hits, shape[1][:, None, None], shape[2][:, None, None], shape[3][..., None, None]
    )
    z = jnp.where((status == Status.OK) | (status == Status.CLIPPED), z, 0)
    points = jnp.concatenate([hits, z[None]])
    return Rays(jnp.moveaxis(points, (0, 1), (3, 2)), status, steps)
