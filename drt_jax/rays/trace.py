"""From a lens, a scene and points on the stop to rays with a status, in three steps.

`aims` makes the traced system and the stop points in mm, a `Solver` finds the rays, and `bundle_of`
adds the surfaces that are not active and decides the status.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.clearance import clearance
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..lens.surface import by_form, surface_sag
from ..numerics import Numbers, concrete, known_values, real_array, safe_divide, safe_sqrt
from . import fermat
from .find import Found
from .meet import cross
from .solve import Solver, solve
from .status import Status, reaches_sensor
from .system import System, Vector, add, dot, placed, rotate, system_of, where

# Focal length F of the ideal lens behind an afocal system, mm, so that 1 mm is 1 mrad.
FOCAL = 1e3


class Bundle(NamedTuple):
    """Rays as arrays with rays on the last axis.

    hits: D arrays (S + 1, W, Q), mm along the axes of each surface and of the sensor.
    status: (W, Q), int32, see `Status`.
    arrival: D + 1 arrays (W, Q), unit vectors at the sensor, along its axes.
    path: (W, Q), optical path from the object, mm, less the path through the mean hits of the rays
        of the same wavelength. The mean hits count as constants in derivatives, see
        `fermat.optical_path`.
    steps: (), int32, Newton steps.

    In an afocal lens the hits on the sensor, the arrival and the path are those of `at_infinity`.
    """

    hits: Vector
    status: Array
    arrival: Vector
    path: Array
    steps: Array


class Rays(NamedTuple):
    """Traced rays of W wavelengths through Q points of the stop. The points (...) of a scene are
    the first axes.

    points: (..., W, Q, S + 1, 3), mm, intersections with the surfaces and the sensor, along the
        axes of the lens, with z from the first vertex; zeros for a failed ray.
    directions: (..., W, Q, S + 1, 3), unit vectors (direction cosines) in front of each surface and
        of the sensor; zeros for a failed ray.
    path: (..., W, Q), mm, optical path to the sensor. It starts at the sphere about the object
        point through the first vertex, or at the plane wave through the first vertex for an object
        at infinity; 0 for a failed ray.
    status: (..., W, Q), int32, see `Status`.
    newton_steps: (...), int32, Newton steps of the whole bundle, aiming included.
    """

    points: Array
    directions: Array
    path: Array
    status: Array
    newton_steps: Array


def _rows_behind(lens: Lens) -> list[int]:
    """For each surface and the sensor, the index of its row, or of the next row behind it."""
    return [sum(j < i for j in lens.active) for i in range(lens.count + 1)]


def on_all_surfaces(
    lens: Lens, system: System, hits: Vector, stop: Vector, exists: Array
) -> tuple[Vector, Array]:
    """Adds the hits on the surfaces that are not active.

    The stop point is the hit on an inactive stop. On any other inactive surface the hit is the
    intersection with the straight line of the ray there, extended both ways.

    hits: D arrays (R, W, Q), on the rows of the system, mm.
    stop: D arrays (W, Q), crossings of the stop, mm.
    exists: (W, Q), bool, rays that exist.

    Returns the hits on all surfaces, D arrays (S + 1, W, Q), 0 for failed rays; and the mask (W, Q)
    of the rays that exist and meet all those surfaces.
    """
    pieces, begin, behind = [], 0, _rows_behind(lens)
    for i in sorted({*range(lens.count)} - {*lens.active}):
        row, crossing = behind[i], stop
        if i != lens.stop:
            nearby, part = fermat.up_to(hits, system, row)
            line = fermat.ray_at(fermat.geometry(nearby, part), part, -1)
            crossing, met = cross(placed(lens, i), lens.forms[i], *line)
            exists = exists & met
        pieces += [tuple(h[begin:row] for h in hits), tuple(c[None] for c in crossing)]
        begin = row
    pieces.append(tuple(h[begin:] for h in hits))
    joined = tuple(jnp.concatenate(part) for part in zip(*pieces, strict=True))
    return where(exists, joined, 0), exists


def aims(lens: Lens, scene: Scene, points: Vector) -> tuple[System, Vector]:
    """The traced system of a bundle, and the stop points that its rays must cross.

    points: D arrays (Q,) or (W, Q), in the plane of the stop in units of its semi-diameter. D = 1
        for rays in the meridional (y, z) plane of a lens with rotational symmetry and an axial
        object, else D = 2. A point that is not finite becomes inf, without a derivative.

    Returns the `System` and the stop points, D arrays (W, Q), mm.
    """
    radius, waves = lens.semi_diameter[lens.stop], scene.wavelengths.shape[0]

    def scaled(point):
        known = jnp.isfinite(point)
        target = jnp.where(known, radius * jnp.where(known, point, 0), jnp.inf)
        return jnp.broadcast_to(target, (waves, point.shape[-1]))

    return system_of(lens, scene, len(points)), tuple(map(scaled, points))


def bundle_of(lens: Lens, scene: Scene, system: System, target: Vector, found: Found) -> Bundle:
    """Completes rays to a bundle: hits on all surfaces, clipping and the final status.

    system, target: as `aims` returns them.
    found: the rays that a `Solver` found.

    The status is MISSED where the scene is impossible, NO_INDEX for a wavelength outside the range
    of a glass, MISSED for a ray that misses an inactive surface, and CLIPPED for a ray outside of a
    clear aperture or inside of an obscuration.
    """
    status = jnp.where(scene.possible, found.status, jnp.int32(Status.MISSED))
    known = lens.dispersion.knows(scene.wavelengths)[:, None]
    status = jnp.where(known, status, jnp.int32(Status.NO_INDEX))
    hits, exists = on_all_surfaces(lens, system, found.hits, target, status == Status.OK)
    status = jnp.where((status == Status.OK) & ~exists, jnp.int32(Status.MISSED), status)
    clipped = exists & jnp.any(clearance(lens, hits) < 0, axis=0)
    status = jnp.where(clipped, jnp.int32(Status.CLIPPED), status)
    rotation = None if system.rows.rotation is None else system.rows.rotation[-1]
    arrival = rotate(rotation, found.arrival, back=True)
    path = path_of(found, system)
    if lens.afocal:
        hits, arrival, path = at_infinity(hits, arrival, path, exists, system.index[-1])
    return Bundle(hits, status, arrival, path, found.steps)


def at_infinity(
    hits: Vector, arrival: Vector, path: Array, exists: Array, index: Array
) -> tuple[Vector, Vector, Array]:
    """Replaces sensor hits by angles, for light that leaves an afocal lens collimated.

    An afocal lens is traced as if an ideal lens of focal length F = 1 m stood behind it. The sensor
    of the prescription lies in the front focal plane of the ideal lens, and a second sensor lies in
    its rear focal plane, where 1 mm stands for 1 mrad. The ideal lens maps angles to heights
    without distortion. All analyses then work unchanged if heights are read as angles in mrad.
    Moving the second sensor by 1 mm is a vergence of 1e-3 dioptre.

    Consider a ray with transverse direction cosines l, |l| = sin a, that meets the front focal
    plane at x with the optical path L. In the rear focal plane

        hit                   F t            with t = a l / |l|
        transverse direction  -J x / F       with J = dl/dt (J is the unit matrix on the axis)
        optical path          L - n x.l      the path of the plane wave in front, so that the
                                             wavefront is measured against a plane

    J has the eigenvalue cos a along l and sin a / a across it. The map from (x, l) to (t, J x)
    preserves areas in phase space and the eikonal: d(L - n x.l) = -n x.dl = -n (J x).dt.

    hits: D arrays (S + 1, W, Q), mm, as in `Bundle`; the last row is the sensor.
    arrival: D + 1 arrays (W, Q), unit vectors at the sensor, as in `Bundle`.
    path: (W, Q), mm, optical path to the sensor.
    exists: (W, Q), bool, rays that exist.
    index: (W, 1), refractive index in front of the sensor.

    Returns the hits (S + 1, W, Q), of which those on the sensor are angles in mrad; the arrivals
    (W, Q), whose transverse part is that of a unit vector and whose z is set to 1; and the path (W,
    Q), mm.
    """
    line = where(exists, arrival[:-1], 0)
    along = jnp.where(exists, jnp.abs(arrival[-1]), 1)
    sine = safe_sqrt(dot(line, line))
    angle = jnp.arctan2(sine, along)
    sinc = jnp.where(sine > 0, safe_divide(sine, angle), 1)
    point = tuple(h[-1] for h in hits)
    x_dot_l = dot(line, point)
    radial = safe_divide(along - sinc, sine**2) * x_dot_l
    slopes = tuple(-(sinc * x + radial * a) / FOCAL for x, a in zip(point, line))
    angles = tuple(FOCAL * safe_divide(a, sinc) for a in line)
    joined = tuple(jnp.concatenate([h[:-1], a[None]]) for h, a in zip(hits, angles))
    return joined, (*slopes, jnp.ones_like(along)), path - index * x_dot_l


def path_of(found: Found, system: System) -> Array:
    """`Bundle.path` of the rays that a `Solver` found: the optical path less that of the mean
    hits.
    """
    good = found.status == Status.OK
    count = jnp.maximum(jnp.sum(good, axis=-1, keepdims=True), 1)
    hits = (jnp.sum(jnp.where(good, h, 0), axis=-1, keepdims=True) for h in found.hits)
    middle = tuple(jax.lax.stop_gradient(h / count[None].astype(h.dtype)) for h in hits)
    return fermat.optical_path(found.hits, system, middle)


def trace_bundle(lens: Lens, scene: Scene, points: Vector, solver: Solver = solve) -> Bundle:
    """Traces rays: `aims`, then a solver, then `bundle_of`.

    points: stop points as in `aims`.
    solver: `solve` for all derivative modes, or `solve_reverse` for reverse mode alone.
    """
    system, target = aims(lens, scene, points)
    return bundle_of(lens, scene, system, target, solver(system, target))


def trace_rays(lens: Lens, scene: Scene, pupil: Numbers) -> Rays:
    """Traces the rays that cross the real stop at given points, aimed for every wavelength.

    The result is differentiable in every mode and to any order.

    lens: the lens; its dtype is that of the result.
    scene: object points and their wavelengths.
    pupil: (Q, 2), x and y on the stop in units of its semi-diameter.

    ValueError as in `lens.scene.checked_scene`. Inside `jit` or `vmap`, where values are not known,
    a wavelength outside the range of a glass gives the status NO_INDEX; a field of 90 degrees or
    more, or a distance within 1e-6 mm of 0, gives MISSED.
    """
    scene, points = checked_scene(lens, scene), stop_points(lens, pupil)
    count, size = len(points), _padded(len(points))
    if count == size or known_values((lens, scene, points)) is None:
        return _trace(lens, scene, points)
    # Bundles of similar size are padded to one size, so that they share a compiled program. The
    # stop points of the padding are inf; such rays are MISSED without a search.
    library = np if concrete(points) else jnp
    filled = library.pad(points, ((0, size - count), (0, 0)), constant_values=np.inf)
    return _first(_trace(lens, scene, filled), count)


def _padded(count: int) -> int:
    """Number of rays after padding.

    It is at least 16, then a multiple of an eighth of the next power of 2. Above 1024 rays there is
    no padding, because arithmetic then takes most of the time.
    """
    if count > 1024:
        return count
    step = max(16, 1 << (count - 1).bit_length()) // 8
    return max(16, -(-count // step) * step)


@functools.partial(jax.jit, static_argnames="count")
def _first(rays: Rays, count: int) -> Rays:
    """The first `count` rays."""
    axis = rays.status.ndim - 1
    first = lambda a: jax.lax.slice_in_dim(a, 0, count, axis=axis) if a.ndim > axis else a  # noqa: E731
    return jax.tree.map(first, rays)


def stop_points(lens: Lens, pupil: Numbers) -> Array:
    """Points (Q, 2) on the stop as an array in the dtype of the lens.

    pupil: (Q, 2), in units of the semi-diameter of the stop. ValueError for no points and for
        another shape.
    """
    points = real_array("pupil", pupil, lens.curvature.dtype)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        hint = "; pass pupil.T" if points.ndim == 2 and points.shape[0] == 2 else ""
        raise ValueError(f"pupil: expected x and y of points, (Q, 2), got {points.shape}{hint}")
    return points


@functools.partial(jit, wanted=LARGE)
def _trace(lens: Lens, scene: Scene, pupil: Array) -> Rays:
    """The compiled part of `trace_rays`. pupil: (Q, 2), in semi-diameters of the stop."""
    return over_points(lambda point: _trace_point(lens, point, pupil), scene)


def _trace_point(lens: Lens, scene: Scene, pupil: Array) -> Rays:
    """`trace_rays` of one object point."""
    system, target = aims(lens, scene, (pupil[:, 0], pupil[:, 1]))
    found = solve(system, target)
    bundle = bundle_of(dataclasses.replace(lens, afocal=False), scene, system, target, found)
    exists = reaches_sensor(bundle.status)
    rows = placed(lens, range(lens.count + 1))
    heights = by_form(surface_sag, bundle.hits, rows.wide, lens.forms)
    own = rotate(rows.rotation, (*bundle.hits, heights))
    points = add(own, [o[:, None, None] for o in rows.origin(2)])
    direction = rotate(system.rows.rotation, fermat.geometry(found.hits, system).before)
    behind = np.array(_rows_behind(lens))

    def stacked(vector):  # (3, S + 1, W, Q) -> (W, Q, S + 1, 3)
        return jnp.where(exists, jnp.stack(vector), 0).transpose(2, 3, 1, 0)

    directions = stacked([d[behind] for d in direction])
    path = jnp.where(exists, fermat.optical_path(found.hits, system), 0)
    return Rays(stacked(points), directions, path, bundle.status, bundle.steps)
