"""Lens + scene + points on the stop -> rays with a status."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.clearance import clearance
from ..lens.lens import Lens
from ..lens.scene import Scene, scene_of
from ..lens.surface import by_form, surface_sag
from ..numerics import Numbers, real_array
from . import fermat
from .meet import cross
from .solve import Solver, solve
from .status import Status
from .system import System, Vector, placed, system_of, turn


class Bundle(NamedTuple):
    """Rays in the array layout of `fermat`, rays last.

    hits: D arrays (S + 1, W, Q) in mm, along the axes of each surface and the sensor.
    status: (W, Q), int32, see `Status`.
    arrival: D + 1 arrays (W, Q), unit vectors at the sensor, along its axes.
    path: (W, Q), optical path in mm from the object, see `fermat.optical_path`.
    steps: (), int32, steps of Newton's method.
    """

    hits: Vector
    status: Array
    arrival: Vector
    path: Array
    steps: Array


class Rays(NamedTuple):
    """Traced rays.

    points: (W, Q, S + 1, 3) in mm, where they cross the surfaces and the sensor, along the axes
        of the lens, z from the first vertex; zeros for a ray that failed.
    directions: (W, Q, S + 1, 3), unit vectors (direction cosines) in front of each surface and
        the sensor.
    path: (W, Q) in mm, the optical path from the object to the sensor, counted from the sphere
        round the object (the plane wave) through the first vertex; 0 for a ray that failed.
    status: (W, Q), int32, see `Status`.
    newton_steps: (), int32, steps of the whole bundle, aiming included.
    """

    points: Array
    directions: Array
    path: Array
    status: Array
    newton_steps: Array


def _rows_behind(lens: Lens) -> list[int]:
    """The row of the system that each surface and the sensor is, or that lies behind it."""
    return [sum(j < i for j in lens.live) for i in range(lens.count + 1)]


def on_all_surfaces(
    lens: Lens, system: System, hits: Vector, stop: Vector, status: Array
) -> tuple[Vector, Array]:
    """Hits on all surfaces from those on the rows of the system and on the stop, and status:
    where the straight ray, prolonged either way, does not meet a surface that bends no light, it
    is MISSED."""
    pieces, begin, behind = [], 0, _rows_behind(lens)
    for i in sorted({*range(lens.count)} - {*lens.live}):
        row, crossing = behind[i], stop
        if i != lens.stop:
            some, part = fermat.up_to(hits, system, row)
            line = fermat.ray_at(fermat.geometry(some, part), part, -1)
            crossing, met = cross(placed(lens, i), lens.forms[i], *line)
            missed = (status == Status.OK) & ~met
            status = jnp.where(missed, Status.MISSED, status).astype(jnp.int32)
        pieces += [tuple(h[begin:row] for h in hits), tuple(c[None] for c in crossing)]
        begin = row
    pieces.append(tuple(h[begin:] for h in hits))
    whole = status == Status.OK
    joined = (jnp.concatenate(part) for part in zip(*pieces, strict=True))
    return tuple(jnp.where(whole, a, 0) for a in joined), status


def trace_bundle(lens: Lens, scene: Scene, points: Vector, solver: Solver = solve) -> Bundle:
    """Trace rays in the array layout of `fermat`, rays last.

    points: D arrays (Q,) or (W, Q) on the unit disc of the stop, or any part of its plane; D = 1
        for rays in the meridional (y, z) plane of a lens with rotational symmetry and an object
        on its axis, else 2.
    solver: `solve`, for all modes of derivatives, or `solve_reverse`.
    """
    return _traced(lens, scene, points, solver)[0]


def _traced(
    lens: Lens, scene: Scene, points: Vector, solver: Solver
) -> tuple[Bundle, System, Vector]:
    """The bundle, and its system with the hits on the rows of that."""
    system = system_of(lens, scene, len(points))
    waves = scene.wavelengths.shape[0]
    radius = lens.semi_diameter[lens.stop]
    # A point that is not finite stays so, and has no derivative.
    finite = [(jnp.isfinite(p), jnp.where(jnp.isfinite(p), p, 0)) for p in points]
    scaled = (jnp.where(known, radius * p, jnp.inf) for known, p in finite)
    target = tuple(jnp.broadcast_to(p, (waves, p.shape[-1])) for p in scaled)
    found = solver(system, target)
    known = lens.dispersion.knows(scene.wavelengths)[:, None]
    status = jnp.where(scene.possible, found.status, jnp.int32(Status.MISSED))
    status = jnp.where(known, status, jnp.int32(Status.NO_INDEX))
    rotation = None if system.rows.rotation is None else system.rows.rotation[-1]
    arrival = turn(rotation, found.arrival, back=True)
    path = fermat.optical_path(found.hits, system)
    hits, status = on_all_surfaces(lens, system, found.hits, target, status)
    stopped = jnp.any(clearance(lens, hits) < 0, axis=0) & (status == Status.OK)
    status = jnp.where(stopped, Status.CLIPPED, status).astype(jnp.int32)
    return Bundle(hits, status, arrival, path, found.steps), system, found.hits


def trace_rays(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    pupil: Numbers,
) -> Rays:
    """Trace the rays that cross the stop at given points.

    field: angle in radians along y, or (x, y), light along (tan x, tan y, 1); positive light
        travels upwards (for a height in mm, see `field_of_height`).
    distance: mm from the object plane to the first vertex, inf allowed.
    wavelengths: (W,) in um.
    pupil: (Q, 2), x and y on the stop in units of its semi-diameter.

    Rays are aimed at the real stop, for every wavelength. Differentiable in everything but the
    status, in every mode and to any order. ValueError as `scene_of`; inside a trace, where values
    are not known, rays of a wavelength outside the range of a glass have the status NO_INDEX, those
    of a field of 90 degrees and more or of a distance not above 0 are MISSED.
    """
    scene = scene_of(lens, field, distance, wavelengths)
    return _trace_rays(lens, scene, stop_points(lens, pupil))


def stop_points(lens: Lens, pupil: Numbers) -> Array:
    """Points (Q, 2) of the stop as an array in the dtype of the lens. ValueError for none, and for
    another shape."""
    points = real_array("pupil", pupil, lens.curvature.dtype)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        hint = "; turn it, pupil.T" if points.ndim == 2 and points.shape[0] == 2 else ""
        raise ValueError(f"pupil: expected x and y of points, (Q, 2), got {points.shape}{hint}")
    return points


@jax.jit
def _trace_rays(lens: Lens, scene: Scene, pupil: Array) -> Rays:
    bundle, system, hits = _traced(lens, scene, (pupil[:, 0], pupil[:, 1]), solve)
    good = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
    rows = placed(lens, range(lens.count + 1))
    heights = by_form(surface_sag, bundle.hits, rows.wide, lens.forms)
    own = turn(rows.rotation, (*bundle.hits, heights))
    points = (p + o[:, None, None] for p, o in zip(own, rows.origin(2), strict=True))
    direction = turn(system.rows.rotation, fermat.geometry(hits, system).before)
    behind = np.array(_rows_behind(lens))

    def stacked(vector):  # (3, S + 1, W, Q) -> (W, Q, S + 1, 3)
        return jnp.where(good, jnp.stack(tuple(vector)), 0).transpose(2, 3, 1, 0)

    directions = stacked(d[behind] for d in direction)
    path = jnp.where(good, bundle.path, 0)
    return Rays(stacked(points), directions, path, bundle.status, bundle.steps)
