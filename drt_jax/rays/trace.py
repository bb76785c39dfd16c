"""Lens + scene + points on the stop -> rays with a status.

Three steps: `aims` says what is sought, a `Solver` finds it, `bundle_of` completes it.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.clearance import clearance
from ..lens.lens import Lens
from ..lens.scene import Scene, scene_of
from ..lens.surface import by_form, surface_sag
from ..numerics import Numbers, concrete, known_values, real_array
from . import fermat
from .find import Found
from .meet import cross
from .solve import Solver, solve
from .status import Status
from .system import System, Vector, placed, rotate, system_of


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
    return [sum(j < i for j in lens.active) for i in range(lens.count + 1)]


def on_all_surfaces(
    lens: Lens, system: System, hits: Vector, stop: Vector, good: Array
) -> tuple[Vector, Array]:
    """Hits on all surfaces from those on the rows of the system and on the stop, 0 for failed rays;
    and which of the `good` rays (W, Q), straight and prolonged either way, meet all surfaces that
    bend no light."""
    pieces, begin, behind = [], 0, _rows_behind(lens)
    for i in sorted({*range(lens.count)} - {*lens.active}):
        row, crossing = behind[i], stop
        if i != lens.stop:
            some, part = fermat.up_to(hits, system, row)
            line = fermat.ray_at(fermat.geometry(some, part), part, -1)
            crossing, met = cross(placed(lens, i), lens.forms[i], *line)
            good = good & met
        pieces += [tuple(h[begin:row] for h in hits), tuple(c[None] for c in crossing)]
        begin = row
    pieces.append(tuple(h[begin:] for h in hits))
    joined = (jnp.concatenate(part) for part in zip(*pieces, strict=True))
    return tuple(jnp.where(good, a, 0) for a in joined), good


def aims(lens: Lens, scene: Scene, points: Vector) -> tuple[System, Vector]:
    """The system of a bundle, and the stop points that its rays cross, D arrays (W, Q) in mm.

    points: D arrays (Q,) or (W, Q) on the unit disc of the stop, or any part of its plane; D = 1
        for rays in the meridional (y, z) plane of a lens with rotational symmetry and an object
        on its axis, else 2. One that is not finite stays so, and has no derivative.
    """
    radius, waves = lens.semi_diameter[lens.stop], scene.wavelengths.shape[0]
    finite = [(jnp.isfinite(p), jnp.where(jnp.isfinite(p), p, 0)) for p in points]
    target = (jnp.where(known, radius * p, jnp.inf) for known, p in finite)
    target = (jnp.broadcast_to(p, (waves, p.shape[-1])) for p in target)
    return system_of(lens, scene, len(points)), tuple(target)


def bundle_of(lens: Lens, scene: Scene, system: System, target: Vector, found: Found) -> Bundle:
    """The bundle of the rays found through stop points; `system` and `target` as of `aims`."""
    status = jnp.where(scene.possible, found.status, jnp.int32(Status.MISSED))
    known = lens.dispersion.knows(scene.wavelengths)[:, None]
    status = jnp.where(known, status, jnp.int32(Status.NO_INDEX))
    hits, good = on_all_surfaces(lens, system, found.hits, target, status == Status.OK)
    status = jnp.where((status == Status.OK) & ~good, jnp.int32(Status.MISSED), status)
    clipped = good & jnp.any(clearance(lens, hits) < 0, axis=0)
    status = jnp.where(clipped, jnp.int32(Status.CLIPPED), status)
    rotation = None if system.rows.rotation is None else system.rows.rotation[-1]
    arrival = rotate(rotation, found.arrival, back=True)
    return Bundle(hits, status, arrival, fermat.optical_path(found.hits, system), found.steps)


def trace_bundle(lens: Lens, scene: Scene, points: Vector, solver: Solver = solve) -> Bundle:
    """Trace rays in the array layout of `fermat`, rays last; points as of `aims`.

    solver: `solve`, for all modes of derivatives, or `solve_reverse`.
    """
    system, target = aims(lens, scene, points)
    return bundle_of(lens, scene, system, target, solver(system, target))


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
    scene, points = scene_of(lens, field, distance, wavelengths), stop_points(lens, pupil)
    count, size = len(points), _padded(len(points))
    if count == size or known_values((lens, scene, points)) is None:
        return _trace(lens, scene, points)
    # Bundles of nearly as many rays share a program: those that are not finite cost little.
    library = np if concrete(points) else jnp
    filled = library.pad(points, ((0, size - count), (0, 0)), constant_values=np.inf)
    return _first(_trace(lens, scene, filled), count)


def _padded(count: int) -> int:
    """How many rays are traced for so many: 16 for fewer, then a multiple of an eighth of the next
    power of 2; above 1024 no more than asked for, as time is arithmetic there."""
    if count > 1024:
        return count
    step = max(16, 1 << (count - 1).bit_length()) // 8
    return max(16, -(-count // step) * step)


@functools.partial(jax.jit, static_argnames="count")
def _first(rays: Rays, count: int) -> Rays:
    """The first rays of some."""
    return jax.tree.map(lambda a: a[:, :count] if a.ndim else a, rays)


def stop_points(lens: Lens, pupil: Numbers) -> Array:
    """Points (Q, 2) of the stop as an array in the dtype of the lens. ValueError for none, and for
    another shape."""
    points = real_array("pupil", pupil, lens.curvature.dtype)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        hint = "; turn it, pupil.T" if points.ndim == 2 and points.shape[0] == 2 else ""
        raise ValueError(f"pupil: expected x and y of points, (Q, 2), got {points.shape}{hint}")
    return points


@functools.partial(jit, wanted=LARGE)
def _trace(lens: Lens, scene: Scene, pupil: Array) -> Rays:
    system, target = aims(lens, scene, (pupil[:, 0], pupil[:, 1]))
    found = solve(system, target)
    bundle = bundle_of(lens, scene, system, target, found)
    good = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
    rows = placed(lens, range(lens.count + 1))
    heights = by_form(surface_sag, bundle.hits, rows.wide, lens.forms)
    own = rotate(rows.rotation, (*bundle.hits, heights))
    points = (p + o[:, None, None] for p, o in zip(own, rows.origin(2), strict=True))
    direction = rotate(system.rows.rotation, fermat.geometry(found.hits, system).before)
    behind = np.array(_rows_behind(lens))

    def stacked(vector):  # (3, S + 1, W, Q) -> (W, Q, S + 1, 3)
        return jnp.where(good, jnp.stack(tuple(vector)), 0).transpose(2, 3, 1, 0)

    directions = stacked(d[behind] for d in direction)
    path = jnp.where(good, bundle.path, 0)
    return Rays(stacked(points), directions, path, bundle.status, bundle.steps)
