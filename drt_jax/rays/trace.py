"""From a lens, a scene and points on the stop to rays with a status, in three steps.

`aims` makes the traced system and the stop points in mm, a `Solver` finds the rays, and `bundle_of`
adds the surfaces that are not active and decides the status.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from ..lens.clearance import clearance
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import safe_divide, safe_sqrt
from . import fermat
from .find import Found
from .meet import cross
from .solve import Solver, solve
from .status import Status, reaches_sensor
from .system import System, Vector, dot, placed, rotate, system_of, where

# Focal length F of the ideal lens behind an afocal system, mm, so that 1 mm is 1 mrad.
FOCAL = 1e3


class Bundle(NamedTuple):
    """Rays as arrays with rays on the last axis. Those of several object points (...) are the first
    axes of all arrays.

    hits: D arrays (S + 1, W, Q), mm along the axes of each surface and of the sensor; 0 for a
        failed ray.
    status: (W, Q), int32, see `Status`.
    arrival: D + 1 arrays (W, Q), unit vectors at the sensor, along its axes; 0 for a failed ray.
    path: (W, Q), optical path from the object, mm, less the path through the mean hits of the rays
        of the same wavelength. The mean hits count as constants in derivatives, see
        `fermat.optical_path`.

    In an afocal lens the hits on the sensor, the arrival and the path are those of `at_infinity`.
    """

    hits: Vector
    status: Array
    arrival: Vector
    path: Array

    @property
    def arrives(self) -> Array:
        """Mask (W, Q) of the rays that meet the sensor, clipped or not."""
        return reaches_sensor(self.status)

    @property
    def sensor(self) -> Vector:
        """Hits on the sensor, D arrays (W, Q), mm; 0 for a failed ray."""
        return tuple(h[..., -1, :, :] for h in self.hits)

    @property
    def slopes(self) -> Vector:
        """Slopes of the rays at the sensor, D arrays (W, Q); 0 for a failed ray."""
        return tuple(safe_divide(a, self.arrival[-1]) for a in self.arrival[:-1])


def rows_behind(lens: Lens) -> list[int]:
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
    pieces, begin, behind = [], 0, rows_behind(lens)
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
    return Bundle(hits, status, where(exists, arrival, 0), path)


def at_infinity(
    hits: Vector, arrival: Vector, path: Array, exists: Array, index: Array
) -> tuple[Vector, Vector, Array]:
    """Replaces sensor hits by angles, for light that leaves an afocal lens collimated.

    An afocal lens is traced as if an ideal lens of focal length F = 1 m stood behind it. The sensor
    of the prescription lies in the front focal plane of the ideal lens, and a second sensor lies in
    its rear focal plane, where 1 mm means 1 mrad. The ideal lens maps angles to heights
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
