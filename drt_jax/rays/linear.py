"""The linear system of all derivatives: how a path answers to small forces on its equations.

The Jacobian of the Fermat equations and the label, dE/dw, is banded: each equation knows three
neighbouring hits. It is solved by marching along the ray. Given the change dw_1 of the first hit,
the equation of each surface yields the change of direction behind it, and that the next hit;
the label then picks dw_1 among D + 1 such marches. So O(surfaces) a ray, nothing is divided by the
length of a segment, and every derivative mode, transposition among them, is JAX's own: a march
is linear in its forces.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from .fermat import Path, ray_at
from .snell import cross
from .system import System, Vector, dot, turn


class _Row(NamedTuple):
    """What a march needs of one live surface and the segment to the next row; see `Path`. ahead:
    unit vector of the segment, slope_ahead: of the sag, along the axes of the next row."""

    before: Vector
    after: Vector
    slope: Vector
    bend: tuple[Vector, ...]
    index_before: Array
    index_behind: Array
    rotation: Array | None
    length: Array
    ahead: Vector
    slope_ahead: Vector
    rotation_ahead: Array | None


def _rows(path: Path, system: System) -> _Row:
    front = jax.tree.map(lambda a: a[:-1], (path.before, path.slope, path.bend))
    rotation = system.rows.rotation
    return _Row(
        front[0],
        path.after,
        front[1],
        front[2],
        system.index[:-1],
        system.index[1:],
        None if rotation is None else rotation[:-1],
        path.length[1:],
        tuple(b[1:] for b in path.before),
        tuple(s[1:] for s in path.slope),
        None if rotation is None else rotation[1:],
    )


def _step(
    row: _Row, good: Array, moved: Vector, swung: Vector, force: Vector
) -> tuple[Vector, Vector]:
    """From one row to the next: changes of the hit, D arrays, and of the direction in front of it,
    D + 1 arrays, along the axes of the row. force: D arrays, the change of its equation."""
    jump = row.index_before * row.before[-1] - row.index_behind * row.after[-1]
    pull = tuple(
        row.index_before * (v + s * swung[-1]) + jump * dot(bend, moved) - f
        for v, s, bend, f in zip(swung, row.slope, row.bend, force, strict=False)
    )
    # The change of direction behind: its product with the tangents is known, with itself 0.
    normal = jnp.where(good, row.after[-1] - dot(row.slope, row.after[:-1]), 1)
    along = -dot(row.after[:-1], pull) / (row.index_behind * normal)
    behind = (
        *(p / row.index_behind - s * along for p, s in zip(pull, row.slope, strict=True)),
        along,
    )
    here = *moved, dot(row.slope, moved)
    behind, here = (
        turn(row.rotation_ahead, turn(row.rotation, a), back=True) for a in (behind, here)
    )
    carried = tuple(p + row.length * v for p, v in zip(here, behind, strict=True))
    # Along the ray onto the tangent plane of the next surface.
    normal = jnp.where(good, row.ahead[-1] - dot(row.slope_ahead, row.ahead[:-1]), 1)
    slide = (carried[-1] - dot(row.slope_ahead, carried[:-1])) / normal
    return tuple(c - slide * e for c, e in zip(carried[:-1], row.ahead, strict=False)), behind


def _begin(path: Path, first: Vector) -> tuple[Vector, Vector]:
    """Changes at the first row: of the hit, and of the direction in front of it."""
    normal = tuple(b[0] for b in path.before)
    moved = *first, dot(tuple(s[0] for s in path.slope), first)
    along = dot(normal, moved)
    return first, tuple(path.spread * (m - n * along) for m, n in zip(moved, normal, strict=True))


def solve(
    hits: Vector, path: Path, system: System, good: Array, forces: Vector, shift: Vector
) -> Vector:
    """dw, D arrays (R, W, Q), with dF dw = `forces`, D arrays (L, W, Q), and dC dw = `shift`, D
    arrays (W, Q) in mm, at the path through `hits`; C is the label. Linear in both.

    good: (W, Q), the rays of interest: what comes out for the others is finite if they are.
    """
    dim, zero = len(hits), jnp.zeros_like(hits[0][0])
    none = (zero,) * dim
    units = tuple(
        jnp.stack([jnp.full_like(zero, float(d == k)) for k in range(dim)]) for d in range(dim)
    )
    start = jax.vmap(lambda first: _begin(path, first))(units), _begin(path, none)

    def step(state, given):
        row, force = given
        free = jax.vmap(lambda moved, swung: _step(row, good, moved, swung, none))(*state[0])
        forced = _step(row, good, state[1][0], state[1][1], force)
        return (free, forced), (free, forced)

    # `dim` marches from unit changes of the first hit, and one that the forces make.
    _, (free, forced) = jax.lax.scan(step, start, (_rows(path, system), forces))
    marched = (free, forced)
    free, forced = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, marched)
    crossing = _crossing(hits, path, system)
    columns = jax.vmap(crossing, 1)(free)
    wanted = tuple(s - c for s, c in zip(shift, crossing(forced), strict=True))
    weights = _divide([[c[k] for k in range(dim)] for c in columns], wanted, good)
    return tuple(
        f + sum(weights[k][None] * u[:, k] for k in range(dim))
        for f, u in zip(forced[0], free[0], strict=True)
    )


def _crossing(hits: Vector, path: Path, system: System) -> Callable:
    """The change of the label, D arrays (W, Q), as a function of those of hits and directions."""
    row = system.before
    if system.stop is None:
        return lambda marched: tuple(m[row] for m in marched[0])
    rotation = None if system.rows.rotation is None else system.rows.rotation[row]
    line = ray_at(hits, path, system, row)
    _, push = jax.linearize(lambda *line: cross(*system.at_stop, *line)[0], *line)

    def change(marched):
        moved, swung = (tuple(a[row] for a in part) for part in marched)
        point = *moved, dot(tuple(s[row] for s in path.slope), moved)
        return push(turn(rotation, point), turn(rotation, swung))

    return change


def _divide(matrix: list[list[Array]], b: Vector, good: Array) -> Vector:
    """x with matrix x = b, for 1 x 1 or 2 x 2."""
    if len(b) == 1:
        return (b[0] / jnp.where(good, matrix[0][0], 1),)
    (p, q), (r, s) = matrix
    determinant = jnp.where(good, p * s - q * r, 1)
    return (s * b[0] - q * b[1]) / determinant, (p * b[1] - r * b[0]) / determinant
