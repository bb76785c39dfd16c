"""The Fermat system of a bundle of rays: optical path, its gradient, and the label of a ray.

A ray is labelled by its object point and by where it crosses the stop. Unknown are its hits on
the L active surfaces, those that bend light, and on the sensor; the equations are dOP/dw_i = 0 on
the active surfaces (paper Eqs. 2 and 3) and one more, the label: the straight line through the
hits that enclose the stop, prolonged either way, crosses the stop at the wanted point. A stop
that bends light itself is one of the surfaces, and the label is its hit.

Arrays are laid out (row, wavelength, ray), rays last, so that every operation is one long
elementwise loop. There are R = L + 1 rows, the sensor is the last.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import Shape
from ..lens.surface import by_form, domain, sag_derivatives, surface_sag
from ..numerics import safe_divide, safe_sqrt
from .meet import cross
from .system import Diffraction, System, Vector, dot, rotate


class Path(NamedTuple):
    """A path drawn out: what its gradient, its differentials and its status are made of.

    hits: D arrays (R, W, Q), mm.
    height: (R, W, Q), the sag in mm.
    before, after: D + 1 arrays (R, W, Q), unit vectors in front of each row and behind it, along
        that row's axes; behind the sensor light goes on as before.
    slope: D arrays (R, W, Q), derivatives of the sag.
    bend: D rows of D arrays (R, W, Q), second derivatives of the optical path by a hit while the
        directions are held, 1/mm.
    length: (R, W, Q), of the segments in front of the rows, mm; 0 for the first.
    shrink: (W, Q), 1 / |vergence P_1 - source|, see `geometry`.
    """

    hits: Vector
    height: Array
    before: Vector
    after: Vector
    slope: Vector
    bend: tuple[Vector, ...]
    length: Array
    shrink: Array


def _segments(hits: Vector, heights: Array, system: System) -> tuple[Vector, Vector]:
    """First points, D + 1 arrays (W, Q), and the steps from each to the next, (L, W, Q). Steps
    are sums of small differences: no digit is lost far from the origin."""
    own = rotate(system.rows.rotation, (*hits, heights))
    origin = [a[..., None, None] for a in system.rows.origin(len(hits))]
    step = tuple((o[1:] - o[:-1]) + (p[1:] - p[:-1]) for o, p in zip(origin, own, strict=True))
    return tuple(o[0] + p[0] for o, p in zip(origin, own, strict=True)), step


def geometry(hits: Vector, system: System) -> Path:
    """Directions, lengths and sag derivatives of the paths through `hits`, D arrays (R, W, Q).

    The first segment comes from P_0 = source / vergence. It is scaled by the vergence,
    q = vergence P_1 - source, which has the same direction and stays finite and smooth when
    the object goes to infinity.
    """
    rotation = system.rows.rotation
    z, slope, bend = by_form(sag_derivatives, hits, system.rows.wide, system.forms)
    point, step = _segments(hits, z, system)
    first = (system.vergence * p - s for p, s in zip(point, system.source, strict=True))
    front = (jnp.concatenate([f[None], s]) for f, s in zip(first, step, strict=True))
    chain = tuple(jnp.concatenate([s, s[-1:]]) for s in front)
    length = _length(chain)
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


def added(hits: Vector, by: Diffraction) -> tuple[np.ndarray, tuple]:
    """The diffractive rows, and what their phase adds to the optical path (N, W, Q) in mm, with its
    derivatives by the hits, D arrays, and D rows of D arrays."""
    rows, wide = np.array(by.rows), Shape(*(a[..., None, None] for a in by.phase))
    waves = by_form(sag_derivatives, tuple(h[rows] for h in hits), wide, by.forms)
    return rows, jax.tree.map(lambda a: by.wave * a, waves)


def residual(path: Path, system: System) -> Vector:
    """F = dOP/dw, D arrays (R, W, Q), dimensionless (paper Eq. 3); 0 on the sensor for any path."""
    index, behind = (jnp.broadcast_to(n, path.length.shape) for n in (system.index, system.behind))
    *across, along = (index * b - behind * a for b, a in zip(path.before, path.after, strict=True))
    force = tuple(c + s * along for c, s in zip(across, path.slope, strict=True))
    if system.diffraction is None:
        return force
    rows, (_, kick, _) = added(path.hits, system.diffraction)
    return tuple(f.at[rows].add(k) for f, k in zip(force, kick, strict=True))


def up_to(hits: Vector, system: System, row: int) -> tuple[Vector, System]:
    """Hits and system of one row and the one before it, if there is one: all that a ray there
    depends on."""
    some = slice(max(row - 1, 0), row + 1)
    rows = jax.tree.map(lambda a: a[some], system.rows)
    part = dataclasses.replace(
        system,
        rows=rows,
        index=system.index[some],
        diffraction=None,
        forms=system.forms[some],
        before=min(system.before, 1),
    )
    return tuple(h[some] for h in hits), part


def ray_at(path: Path, system: System, row: int) -> tuple[Vector, Vector]:
    """Points of one row and unit vectors in front of it, D + 1 arrays (W, Q) each, along the axes
    of the lens."""
    rotation = None if system.rows.rotation is None else system.rows.rotation[row]
    origin = (a[row] for a in system.rows.origin(system.dim))
    own = rotate(rotation, (*(h[row] for h in path.hits), path.height[row]))
    point = tuple(o + p for o, p in zip(origin, own, strict=True))
    return point, rotate(rotation, tuple(b[row] for b in path.before))


def label(path: Path, system: System) -> Vector:
    """Where paths cross the stop: D arrays (W, Q), mm along its axes."""
    if system.stop is None:
        return tuple(h[system.before] for h in path.hits)
    return cross(*system.at_stop, *ray_at(path, system, system.before))[0]


def arrival(hits: Vector, system: System) -> Vector:
    """Unit vectors, D + 1 arrays (W, Q), along the axes of the lens, of the rays on the sensor."""
    hits, part = up_to(hits, system, len(system.forms) - 1)
    return ray_at(geometry(hits, part), part, -1)[1]


def met(crossing: Vector, target: Vector, hits: Vector, system: System) -> Array:
    """Whether rays that cross the stop at `crossing` go through `target` to rounding, D arrays
    (W, Q) in mm: (W, Q), bool. hits: on the rows, to which rounding is relative."""
    eps = float(jnp.finfo(hits[0].dtype).eps)
    miss = tuple(a - b for a, b in zip(crossing, target, strict=True))
    scale = jnp.max(_width(hits, system), axis=0) + jnp.sqrt(dot(target, target))
    return dot(miss, miss) <= (64 * eps * scale) ** 2


def _width(hits: Vector, system: System) -> Array:
    """How large the coordinates of hits are, (R, W, Q) in mm: what their rounding scales with."""
    width = jnp.sqrt(dot(hits, hits))
    offset = system.rows.offset
    return width if offset is None else width + jnp.max(jnp.abs(offset), axis=1)[:, None, None]


def _length(vector: Vector) -> Array:
    return safe_sqrt(dot(vector, vector))


def _inverse(length: Array) -> Array:
    return safe_divide(jnp.ones_like(length), length)


def optical_path(hits: Vector, system: System) -> Array:
    """Optical path (W, Q) in mm from the object to the sensor (paper Eq. 2).

    Counted from the sphere round the object that passes through the first vertex (a plane
    for an object at infinity), so that it stays finite for any distance.
    """
    heights = by_form(surface_sag, hits, system.rows.wide, system.forms)
    q, step = _segments(hits, heights, system)
    p = tuple(system.source)
    near = tuple(system.vergence * a - b for a, b in zip(q, p, strict=True))
    # (|q - p/v| - |p/v|) without the cancellation, and without dividing by v
    far = _length(near) + _length(p)
    first = (system.vergence * dot(q, q) - 2 * dot(q, p)) / far
    lengths = jnp.concatenate([first[None], _length(step)])
    path = jnp.sum(system.index * lengths, axis=0)
    if system.diffraction is None:
        return path
    return path + jnp.sum(added(hits, system.diffraction)[1][0], axis=0)


def stationary(path: Path, system: System, target: Vector) -> Array:
    """Whether these paths are rays, (W, Q), bool: forward, on surfaces that exist, through their
    stop points `target`, D arrays (W, Q) in mm, and F = 0.

    F counts as 0 where every component is within 64 times what rounding the hits to the last
    digit changes: for a camera in float64 some 1e-14 radians. Where that is more than 1e-6
    radians (2e-2 in float32), the hits determine no direction, and the path is not accepted.
    """
    eps = float(jnp.finfo(path.length.dtype).eps)
    senses = system.senses[:, None, None]
    behind = np.where(np.append(system.mirrors, False)[:, None, None], -senses, senses)
    size = _width(path.hits, system)
    widest = jnp.maximum(size, jnp.concatenate([size[:1], size[:-1]]))
    near = _inverse(path.length).at[0].set(jnp.abs(system.vergence) * path.shrink)
    angle = system.index * (1 + near * widest)  # by which rounding turns a segment
    both = angle + jnp.concatenate([angle[1:], angle[-1:]])
    gradient = residual(path, system)
    bound = 64 * eps * both * jnp.sqrt(1 + dot(path.slope, path.slope))
    good = (dot(gradient, gradient) <= bound**2) & (both <= 4 / eps**0.5)
    good = good & by_form(domain, path.hits, system.rows.wide, system.forms)
    good = good & (_forward(path.before, path.slope) * senses > 0)
    good = good & (_forward(path.after, path.slope) * behind > 0)
    return jnp.all(good, axis=0) & met(label(path, system), target, path.hits, system)


def _forward(direction: Vector, slope: Vector) -> Array:
    """The product of a direction with the normal (-slope, 1) of a surface."""
    return direction[-1] - dot(slope, direction[:-1])
