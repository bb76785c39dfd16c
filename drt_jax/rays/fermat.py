"""The Fermat equations of a bundle of rays: optical path, its gradient, and the label of a ray.

A ray is labelled by its object point and its crossing of the stop. The unknowns are its hits w_i on
the L active surfaces (refracting, reflecting or diffracting) and on the sensor. The equations are
dOP/dw_i = 0 on the active surfaces (paper Eqs. 2 and 3) and the label: the straight line through
the hits in front of and behind the stop, extended both ways, crosses the stop at the given point.
If the stop is an active surface, the label is its hit.

Arrays have the axes (row, wavelength, ray), so that every operation is one long elementwise loop.
There are R = L + 1 rows; the sensor is the last.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import Shape
from ..lens.surface import by_form, domain, sag_derivatives, sag_slope, surface_sag
from ..numerics import safe_divide, safe_sqrt
from .meet import cross
from .system import Diffraction, System, Vector, add, along, dot, rotate, subtract


class Path(NamedTuple):
    """Geometry of trial paths.

    hits: D arrays (R, W, Q), mm.
    height: (R, W, Q), sag, mm.
    before, after: D + 1 arrays (R, W, Q), unit vectors in front of and behind each row, along the
        axes of that row; behind the sensor as in front of it.
    slope: D arrays (R, W, Q), derivatives of the sag.
    bend: D rows of D arrays (R, W, Q), second derivatives of the optical path by a hit for fixed
        directions, 1/mm.
    length: (R, W, Q), length of the segment in front of each row, mm; 0 for the first, and below 0
        for a sensor in front of the last surface.
    shrink: (W, Q), 1 / |vergence P_1 - source|, of the first segment.
    """

    hits: Vector
    height: Array
    before: Vector
    after: Vector
    slope: Vector
    bend: tuple[Vector, ...]
    length: Array
    shrink: Array


def _chain(hits: Vector, heights: Array, system: System) -> tuple[Vector, Vector]:
    """First points, D + 1 arrays (W, Q), and segments, D + 1 arrays (R, W, Q), mm.

    The first segment is the vector from the object multiplied by the vergence, see
    `System.from_object`. The vertices and the points relative to their vertices are subtracted
    separately, so that no digit is lost far from the origin.

    hits: D arrays (R, W, Q), mm.
    heights: (R, W, Q), sags there, mm.
    """
    own = rotate(system.rows.rotation, (*hits, heights))
    origin = [a[..., None, None] for a in system.rows.origin(len(hits))]
    step = [(o[1:] - o[:-1]) + (p[1:] - p[:-1]) for o, p in zip(origin, own, strict=True)]
    first = tuple(o[0] + p[0] for o, p in zip(origin, own, strict=True))
    chain = zip(system.from_object(first), step, strict=True)
    return first, tuple(jnp.concatenate([f[None], s]) for f, s in chain)


@jax.jit
def geometry(hits: Vector, system: System) -> Path:
    """Directions, lengths and derivatives of the sag of the paths through given hits.

    hits: D arrays (R, W, Q), mm.
    """
    rotation = system.rows.rotation
    z, slope, bend = by_form(sag_derivatives, hits, system.rows.wide, system.forms)
    chain = tuple(jnp.concatenate([s, s[-1:]]) for s in _chain(hits, z, system)[1])
    length = _length(chain)
    if len(system.forms) > 1:
        to, off = (tuple(c[k] for c in chain) for k in (-3, -2))
        way = _way(to, off, tuple(s[-2] for s in slope), system)
        length = jnp.concatenate([length[:-2], way[None] * length[-2:]])
    shrink = _inverse(length)
    direction = tuple(s * shrink for s in chain)
    before = rotate(rotation, tuple(d[:-1] for d in direction), back=True)
    after = rotate(rotation, tuple(d[1:] for d in direction), back=True)
    jump = system.index * before[-1] - system.behind * after[-1]
    bend = tuple(tuple(jump * b for b in row) for row in bend)
    if system.diffraction is not None:
        rows, (_, _, more) = added(hits, system.diffraction)
        bend = jax.tree.map(lambda a, b: a.at[rows].add(b), bend, more)
    return Path(hits, z, before, after, slope, bend, length[:-1].at[0].set(0), shrink[0])


def _way(before: Vector, after: Vector, slope: Vector, system: System) -> Array:
    """1 where the sensor lies ahead of the last surface; -1 where it lies in front of it and the
    light only seems to come from there.

    Light leaves a mirror to the side from which it came, and any other surface to the other side.

    before, after: D + 1 arrays, vectors to the last surface, and from there to the sensor.
    slope: D arrays, slopes of the last surface.
    """
    rotation = None if system.rows.rotation is None else system.rows.rotation[-2]
    sides = (_forward(rotate(rotation, a, back=True), slope) for a in (before, after))
    ahead = (next(sides) * next(sides) < 0) == system.mirrors[-1]
    return jnp.where(ahead, 1, -1).astype(after[0].dtype)


def added(hits: Vector, by: Diffraction) -> tuple[np.ndarray, tuple]:
    """Optical path that the diffractive rows add, with its derivatives by the hits.

    Returns the indices (N,) of these rows; and the path (N, W, Q), mm, its first derivatives, D
    arrays, and its second derivatives, D rows of D arrays.
    """
    rows, wide = np.array(by.rows), Shape(*(a[..., None, None] for a in by.phase))
    waves = by_form(sag_derivatives, tuple(h[rows] for h in hits), wide, by.forms)
    return rows, jax.tree.map(lambda a: by.wave * a, waves)


def residual(path: Path, system: System) -> Vector:
    """Residual of the Fermat equations, F = dOP/dw, D arrays (R, W, Q), dimensionless (paper Eq.
    3).

    With unit vectors b in front of a surface, a behind it (transverse part t, component z) and the
    slope s of its sag, F = n (b_t + s b_z) - n' (a_t + s a_z), plus the gradient of the optical
    path that a phase adds. On the sensor F is 0 for any path.
    """
    index, behind = (jnp.broadcast_to(n, path.length.shape) for n in (system.index, system.behind))
    *across, depth = (index * b - behind * a for b, a in zip(path.before, path.after, strict=True))
    gradient = along(across, depth, path.slope)
    if system.diffraction is None:
        return gradient
    rows, (_, kick, _) = added(path.hits, system.diffraction)
    return tuple(f.at[rows].add(k) for f, k in zip(gradient, kick, strict=True))


def up_to(hits: Vector, system: System, row: int) -> tuple[Vector, System]:
    """Hits and system of one row and of at most two rows in front of it, which determine the ray in
    front of that row.
    """
    near = slice(max(row - 2, 0), row + 1)
    rows = jax.tree.map(lambda a: a[near], system.rows)
    part = dataclasses.replace(
        system,
        rows=rows,
        index=system.index[near],
        diffraction=None,
        forms=system.forms[near],
        mirrors=system.mirrors[near.start : row],
        before=min(system.before, 1),
    )
    return tuple(h[near] for h in hits), part


def ray_at(path: Path, system: System, row: int) -> tuple[Vector, Vector]:
    """Points on one row (mm) and unit vectors in front of it, D + 1 arrays (W, Q) each, along the
    axes of the lens.
    """
    rotation = None if system.rows.rotation is None else system.rows.rotation[row]
    origin = (a[row] for a in system.rows.origin(system.dim))
    own = rotate(rotation, (*(h[row] for h in path.hits), path.height[row]))
    return add(origin, own), rotate(rotation, tuple(b[row] for b in path.before))


def label(path: Path, system: System) -> Vector:
    """Crossings of the stop, D arrays (W, Q), mm along its axes."""
    if system.stop is None:
        return tuple(h[system.before] for h in path.hits)
    return cross(*system.at_stop, *ray_at(path, system, system.before))[0]


def arrival(hits: Vector, system: System) -> Vector:
    """Directions of rays at the sensor: unit vectors, D + 1 arrays (W, Q), along the axes of the
    lens.
    """
    hits, part = up_to(hits, system, len(system.forms) - 1)
    return ray_at(geometry(hits, part), part, -1)[1]


def met(crossing: Vector, target: Vector, hits: Vector, system: System) -> Array:
    """Mask (W, Q) of the rays that cross their stop points within 64 rounding errors.

    crossing, target: D arrays (W, Q), crossings of the stop and stop points, mm.
    hits: D arrays (R, W, Q), mm. The rounding error is relative to the largest of them.
    """
    eps = float(jnp.finfo(hits[0].dtype).eps)
    miss = subtract(crossing, target)
    scale = jnp.max(_width(hits, system), axis=0) + jnp.sqrt(dot(target, target))
    return dot(miss, miss) <= (64 * eps * scale) ** 2


def _width(hits: Vector, system: System) -> Array:
    """Magnitude of the coordinates of hits, (R, W, Q), mm. Their rounding errors are proportional
    to it.
    """
    width = jnp.sqrt(dot(hits, hits))
    offset = system.rows.offset
    return width if offset is None else width + jnp.max(jnp.abs(offset), axis=1)[:, None, None]


def _length(vector: Vector) -> Array:
    """Length of a vector; 0, with derivative 0, for the zero vector."""
    return safe_sqrt(dot(vector, vector))


def _inverse(length: Array) -> Array:
    """1 / length; 0 where the length is 0."""
    return safe_divide(jnp.ones_like(length), length)


def optical_path(hits: Vector, system: System, middle: Vector | None = None) -> Array:
    """Optical path (W, Q), mm, from the object to the sensor (paper Eq. 2).

    It starts at the sphere about the object through the first vertex (a plane for an object at
    infinity), so that it is finite for any distance. Differences of lengths are computed as |a| -
    |b| = (a - b).(a + b) / (|a| + |b|), without cancellation.

    hits: D arrays (R, W, Q), mm.
    middle: D arrays (R, W, 1), mm, of a reference path that is subtracted segment by segment before
        the lengths are summed. In float32 the rounding error is then proportional to the
        differences between paths and not to their length. None for no reference path.
    """
    heights = by_form(surface_sag, hits, system.rows.wide, system.forms)
    first, chain = _chain(hits, heights, system)
    if middle is None:  # subtract only the vector from the object to the first vertex
        other = tuple(jnp.zeros_like(a).at[0].set(-p) for a, p in zip(chain, system.source))
        moved = tuple(c.at[0].set(q) for c, q in zip(chain, first, strict=True))
    else:
        middle_heights = by_form(surface_sag, middle, system.rows.wide, system.forms)
        _, other = _chain(middle, middle_heights, system)
        own = subtract((*hits, heights), (*middle, middle_heights))
        point = rotate(system.rows.rotation, own)
        moved = tuple(jnp.concatenate([p[:1], p[1:] - p[:-1]]) for p in point)
    # `moved` is a - b. In the first segment a - b is divided by the vergence, which may be 0.
    lengths = safe_divide(dot(moved, add(chain, other)), _length(chain) + _length(other))
    if len(system.forms) > 1:
        shape = Shape(*(a[..., -2, :, :] for a in system.rows.wide))
        slope = sag_slope(tuple(h[-2] for h in hits), shape, system.forms[-2])[1]
        to, off = (tuple(c[k] for c in chain) for k in (-2, -1))
        way = _way(to, off, slope, system)
        lengths = jnp.concatenate([lengths[:-1], way[None] * lengths[-1:]])
    path = jnp.sum(system.index * lengths, axis=0)
    if system.diffraction is None:
        return path
    waves = added(hits, system.diffraction)[1][0]
    if middle is not None:
        waves = waves - added(middle, system.diffraction)[1][0]
    return path + jnp.sum(waves, axis=0)


def stationary(path: Path, system: System, target: Vector) -> Array:
    """Mask (W, Q) of the trial paths that are rays.

    A path is a ray if F = 0 on every surface, all segments run forwards, every hit lies inside of
    the domain of its sag, and it passes through its stop point. F counts as 0 if its size is at
    most 64 times the change by rounding of the hits, about 1e-14 radians for a camera in float64. A
    path is not accepted if rounding turns it by more than 1e-6 radians (2e-2 in float32).

    target: D arrays (W, Q), stop points, mm.
    """
    eps = float(jnp.finfo(path.length.dtype).eps)
    size = _width(path.hits, system)
    widest = jnp.maximum(size, jnp.concatenate([size[:1], size[:-1]]))
    near = _inverse(abs(path.length)).at[0].set(jnp.abs(system.vergence) * path.shrink)
    angle = system.index * (1 + near * widest)  # change of direction by rounding
    both = angle + jnp.concatenate([angle[1:], angle[-1:]])
    gradient = residual(path, system)
    bound = 64 * eps * both * jnp.sqrt(1 + dot(path.slope, path.slope))
    ok = (dot(gradient, gradient) <= bound**2) & (both <= 4 / eps**0.5)
    ok = ok & by_form(domain, path.hits, system.rows.wide, system.forms)
    arrives, leaves = (_forward(d, path.slope) for d in (path.before, path.after))
    turns = np.append(system.mirrors, False)[:, None, None]
    ok = ok & jnp.where(turns, arrives * leaves < 0, arrives * leaves > 0)
    if system.rows.rotation is None:
        ok = ok & (arrives * system.senses[:, None, None] > 0)
    ok = ok.at[-1].set(ok[-1] & (path.length[-1] * system.sensor_way >= 0))
    return jnp.all(ok, axis=0) & met(label(path, system), target, path.hits, system)


def _forward(direction: Vector, slope: Vector) -> Array:
    """Dot product of a direction and the normal (-slope, 1) of a surface."""
    return direction[-1] - dot(slope, direction[:-1])
