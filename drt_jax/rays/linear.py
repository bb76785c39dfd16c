"""The linear system of all derivatives: the change of a path for a change of the equations.

The Jacobian dE/dw of the equations E (Fermat equations and label) by the hits w is banded: each
equation contains three neighbouring hits. The system is solved by propagation along the ray. Given
the change dw_1 of the first hit, the Fermat equation of each surface yields the change of direction
behind it, and that yields the change of the next hit. The changes are linear in dw_1, so that D + 1
propagations (one for each unit change of dw_1, and one for the right-hand side with dw_1 = 0) give
the change of the label as a linear function of dw_1. The required change of the label then
determines dw_1.

The cost is O(surfaces) for each ray, and nothing is divided by the length of a segment. The
propagation is linear in the right-hand side, so that JAX can transpose it; forward, reverse and
higher derivatives all follow from it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .fermat import Path, label, ray_at, residual
from .meet import cross
from .system import System, Vector, add, along, divide, dot, rotate, subtract, where


class RightSide(NamedTuple):
    """Right-hand side of the linear system.

    residual: D arrays (R, W, Q), right-hand sides of the Fermat equations of each row; 0 for the
        sensor, which has no equation.
    point: D + 1 arrays (R, W, Q), displacement of the surfaces at fixed transverse coordinates, mm
        along the axes of the lens.
    direction: D + 1 arrays (W, Q), change of the direction in front of the first row at a fixed
        point.
    label: D arrays (W, Q), required change of the crossing of the stop, mm.
    """

    residual: Vector
    point: Vector
    direction: Vector
    label: Vector


def shortfall(path: Path, system: System, target: Vector) -> RightSide:
    """Residual of the equations for trial paths: the right-hand side of a Newton step.

    One Newton step subtracts `solve` of it from the hits.

    target: D arrays (W, Q), stop points, mm.
    """
    miss = subtract(label(path, system), target)
    still = tuple(jnp.zeros_like(a) for a in path.before)
    return RightSide(residual(path, system), still, tuple(a[0] for a in still), miss)


class _Row(NamedTuple):
    """One row for the propagation, with fields of a `Path` and a `System`.

    labels: True for the row whose hit, or the ray in front of which, determines the label.
    """

    before: Vector
    after: Vector
    slope: Vector
    bend: tuple[Vector, ...]
    length: Array
    index_before: Array
    index_behind: Array
    rotation: Array | None
    labels: Array


class _Change(NamedTuple):
    """Changes of a ray during the propagation.

    point: D + 1 arrays, change of a point on the ray, mm along the axes of the lens.
    direction: D + 1 arrays, change of the direction there.
    label: change of the hit, or of the ray, that determines the label; 0 before its row is reached.
    """

    point: Vector
    direction: Vector
    label: Vector


def _step(
    row: _Row, active_stop: bool, ok: Array, change: _Change, residual: Vector, shift: Vector
) -> tuple[_Change, Vector]:
    """Propagates a change to a row and through it.

    To the row: the point of the ray at the row changes by dP + L de, from which the displacement of
    the surface is subtracted; the result is projected along the ray onto the tangent plane of the
    surface, which gives the change dw of the hit. Through the row: with the directions e in front
    and e' behind (transverse part t, component z), the slope s and the second derivatives B of the
    optical path, the equation dF = f reads

        n' (de'_t + s de'_z) = n (de_t + s de_z) + B dw - f      (`pull` in the code)

    and e'.de' = 0, because e' stays a unit vector. Together they determine de'.

    row: the row.
    active_stop: True if the stop is an active surface.
    ok: (W, Q), as in `solve`.
    change: the change in front of the row.
    residual, shift: D and D + 1 arrays (W, Q), `residual` and `point` of the right-hand side.

    Returns the change behind the row, and that of its hit, D arrays (W, Q), mm.
    """
    carried = subtract(along(change.point, row.length, change.direction), shift)
    *across, depth = rotate(row.rotation, carried, back=True)
    *direction, axial = rotate(row.rotation, change.direction, back=True)
    # Project along the ray onto the tangent plane of the surface.
    normal = jnp.where(ok, row.before[-1] - dot(row.slope, row.before[:-1]), 1)
    slide = (depth - dot(row.slope, across)) / normal
    hit = tuple(c - slide * e for c, e in zip(across, row.before, strict=False))
    here = rotate(row.rotation, (*hit, dot(row.slope, hit)))
    point = add(here, shift)
    pull = tuple(
        row.index_before * (v + s * axial) + dot(bend, hit) - f
        for v, s, bend, f in zip(direction, row.slope, row.bend, residual, strict=True)
    )
    # Solve for the change of direction behind the row: its products with the tangents of the
    # surface are `pull` / n', and its product with the direction itself is 0.
    normal = jnp.where(ok, row.after[-1] - dot(row.slope, row.after[:-1]), 1)
    axial = -dot(row.after[:-1], pull) / (row.index_behind * normal)
    behind = tuple(p / row.index_behind - s * axial for p, s in zip(pull, row.slope, strict=True))
    marked = hit if active_stop else (*point, *change.direction)
    marked = where(row.labels, marked, change.label)
    return _Change(point, rotate(row.rotation, (*behind, axial)), marked), hit


def solve(path: Path, system: System, ok: Array, rhs: RightSide) -> tuple[Vector, Vector]:
    """Solves the linear system.

    One `lax.scan` over the rows propagates D changes `free`, one for each unit change of the first
    hit, and the change `forced` by the right-hand side alone. The D x D system of the label gives
    the weights of the free changes in their sum with the forced one.

    ok: (W, Q), bool, rays of interest. The result for other rays is arbitrary, but finite if their
        paths are.
    rhs: the right-hand side. The result is linear in it.

    Returns the changes of the hits, D arrays (R, W, Q), mm, and of the direction at the sensor, D +
    1 arrays (W, Q), along the axes of the lens.
    """
    dim, zero, active_stop = len(rhs.label), jnp.zeros_like(rhs.label[0]), system.stop is None
    at = np.arange(len(system.forms)) == system.before
    path_rows = _Row(*path[2:7], system.index, system.behind, system.rows.rotation, at)
    still, none = (zero,) * (dim + 1), (zero,) * dim
    unknown = none if active_stop else (*still, *still)
    # `free`: changes for each unit change of the first hit; `forced`: changes by the right-hand
    # side with the first hit fixed.
    units = [[jnp.full_like(zero, float(d == k)) for k in range(dim)] for d in range(dim)]
    first = jax.vmap(lambda hit: _first(path, system, hit))(tuple(map(jnp.stack, units)))
    free = _Change(*first, jax.tree.map(lambda a: jnp.stack([a] * dim), unknown))

    def step(changes, inputs):
        row, *rhs_here = inputs
        alone = lambda change: _step(row, active_stop, ok, change, none, still)  # noqa: E731
        free = jax.vmap(alone)(changes[0])
        forced = _step(row, active_stop, ok, changes[1], *rhs_here)
        return (free[0], forced[0]), (free[1], forced[1])

    start = free, _Change(still, rhs.direction, unknown)
    through, hits = jax.lax.scan(step, start, (path_rows, rhs.residual, rhs.point))
    crossing = _crossing(path, system)
    columns = jax.vmap(crossing)(through[0].label)
    miss = subtract(rhs.label, crossing(through[1].label))
    # Rays that are not of interest get the unit matrix, so that no derivative is NaN.
    rows = [
        [jnp.where(ok, c, float(i == k)) for k, c in enumerate(row)]
        for i, row in enumerate(columns)
    ]
    weights = divide(rows, miss)

    def joined(free, forced):
        columns = (free[..., k, :, :] for k in range(dim))
        products = (jnp.broadcast_to(w, forced.shape) * c for w, c in zip(weights, columns))
        return sum(products, forced)

    direction = jax.tree.map(joined, *(change.direction for change in through))
    return jax.tree.map(joined, *hits), direction


def _first(path: Path, system: System, hit: Vector) -> tuple[Vector, Vector]:
    """Changes of the first point and of the direction in front of it for a change of the first hit.

    The direction is that of q = vergence P_1 - source, and dq = vergence dP.
    """
    rotation = None if system.rows.rotation is None else system.rows.rotation[0]
    point = rotate(rotation, (*hit, dot(tuple(s[0] for s in path.slope), hit)))
    return point, turn(ray_at(path, system, 0)[1], point, system.vergence * path.shrink)


def turn(unit: Vector, change: Vector, shrink: Array) -> Vector:
    """Change of a unit vector e = q / |q| for a change dq of q: (dq - e (e.dq)) / |q|.

    unit: e.
    change: dq.
    shrink: 1 / |q|.
    """
    size = dot(unit, change)
    return tuple(shrink * (c - e * size) for c, e in zip(change, unit, strict=True))


def _crossing(path: Path, system: System) -> Callable[[Vector], Vector]:
    """A function from the change of the hit, or of the ray, that determines the label to the change
    of the label, D arrays (W, Q), mm.
    """
    if system.stop is None:
        return lambda hit: hit
    line = ray_at(path, system, system.before)
    _, change = jax.linearize(lambda *line: cross(*system.at_stop, *line)[0], *line)
    return lambda label: change(label[: len(line[0])], label[len(line[0]) :])
