"""Rays as roots of the Fermat system, with derivatives by the implicit function theorem.

The search is not differentiated. At a root of E(w, p) = 0, where E are the Fermat equations and the
label, w the hits and p the parameters, dw/dp = -(dE/dw)^-1 dE/dp (paper Eq. 4). `attach` gives
known hits these derivatives in every mode. `solve_reverse` is a `jax.custom_vjp` for reverse mode
alone, which stores only the hits.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero

from ..lens.surface import by_form, sag_slope
from . import fermat, linear
from .bundle import derivative_tile, in_tiles
from .fermat import Path
from .find import Found, find_aimed, find_many
from .meet import cross
from .status import Status
from .system import System, Vector, add, rotate, where


@jax.custom_jvp
def attach(
    system: System, target: Vector, hits: Vector, arrival: Vector, ok: Array
) -> tuple[Vector, Vector]:
    """Returns hits and arrivals unchanged, with derivatives by the system and the stop points.

    Differentiable in every mode and to any order.

    target: D arrays (W, Q), stop points, mm.
    hits, arrival: as in `Found`.
    ok: (W, Q), bool, rays that have derivatives; the derivatives of others are 0.
    """
    return hits, arrival


def _attach_jvp(primals: Any, tangents: Any) -> tuple:
    """The JVP of `attach`: tangents of hits and arrivals by `linear.solve`."""
    system, target, *known, ok = primals
    # Call the function itself, so that the hits have derivatives for higher orders.
    hits, arrival = attach(system, target, *known, ok)
    # Leaves without a tangent become None, so that they cost nothing.
    moving, shifts = jax.tree.map(
        lambda t: None if isinstance(t, SymbolicZero) else t, tuple(tangents[:2])
    )

    def tangent(hits, shifts, ok):
        path = fermat.geometry(hits, system)
        rhs = _right_side(path, system, moving)
        label = (a if t is None else a + t for a, t in zip(rhs.label, shifts, strict=True))
        rhs = where(ok, rhs._replace(label=tuple(label)), 0)
        return where(ok, linear.solve(path, system, ok, rhs), 0)

    tile = derivative_tile(len(ok), len(system.forms))
    return (hits, arrival), in_tiles(tangent, tile, hits, shifts, ok)


attach.defjvp(_attach_jvp, symbolic_zeros=True)


def _right_side(path: Path, system: System, moving: System) -> linear.RightSide:
    """Right-hand side of the linear system for tangents of leaves of the system (paper Eq. 4).

    It is the directional derivative, along the tangents dp, of the equations at fixed hits: F and
    the label at fixed directions of the ray, the positions of the surfaces at fixed transverse
    coordinates, and the unnormalised direction q = vergence P_1 - source of the first segment,
    from which `linear.turn` makes that of the unit vector. F and the label enter with the sign of
    -(dE/dp) dp. One `jax.jvp` over the leaves with a tangent gives all of them; other leaves are
    constants.

    moving: the tangents of all leaves of the system; None for a leaf without a tangent.
    """
    either = functools.partial(jax.tree.map, is_leaf=lambda leaf: leaf is None)
    varied = either(lambda t, a: None if t is None else a, moving, system)
    directions = [rotate(system.rows.rotation, a) for a in (path.before, path.after)]
    first, line = (fermat.ray_at(path, system, row) for row in (0, system.before))

    def with_fixed_path(varied):
        """The equations for fixed hits, and for directions fixed along the axes of the lens."""
        own = either(lambda new, a: a if new is None else new, varied, system)
        rows = own.rows
        height, slope = by_form(sag_slope, path.hits, rows.on(path.length), own.forms)
        before, after = (rotate(rows.rotation, a, back=True) for a in directions)
        residual = fermat.residual(path._replace(before=before, after=after, slope=slope), own)
        point = rotate(rows.rotation, (*path.hits, height))
        point = add(point, [a[:, None, None] for a in rows.origin(own.dim)])
        toward = own.from_object(first[0])
        crossing = tuple(h[own.before] for h in path.hits)
        if own.stop is not None:
            crossing, _ = cross(own.stop, own.stop_form, *line)
        return residual, point, toward, crossing

    residual, point, toward, label = jax.jvp(with_fixed_path, (varied,), (moving,))[1]
    residual, label = (tuple(-a for a in part) for part in (residual, label))
    return linear.RightSide(residual, point, linear.turn(first[1], toward, path.shrink), label)


def solve(system: System, target: Vector) -> Found:
    """Finds the rays through stop points, differentiable in every mode and to any order.

    Failed rays have zero derivatives.

    target: D arrays (W, Q), stop points, mm.
    """
    return reattach(find_many(*jax.lax.stop_gradient((system, target))), system, target)


def solve_aimed(system: System, target: Vector) -> Found:
    """Finds rays as `solve` does, but by aiming alone, see `find_aimed`."""
    return reattach(find_aimed(*jax.lax.stop_gradient((system, target))), system, target)


def reattach(found: Found, system: System, target: Vector) -> Found:
    """Gives found rays the derivatives of `attach`.

    found: rays through the stop points `target`.
    target: D arrays (W, Q), stop points, mm.
    """
    hits, arrival = attach(system, target, found.hits, found.arrival, found.status == Status.OK)
    return found._replace(hits=hits, arrival=arrival)


# A function that finds the rays of a system through stop points.
Solver = Callable[[System, Vector], Found]


@jax.custom_vjp
def solve_reverse(system: System, target: Vector) -> Found:
    """Finds rays as `solve` does, for reverse mode alone. It is faster and stores only the hits."""
    return find_many(system, target)


def _forward(system: System, target: Vector) -> tuple[Found, tuple]:
    """Forward pass of `solve_reverse`: the rays, and what the backward pass needs."""
    found = find_many(system, target)
    return found, (system, target, found.hits, found.status == Status.OK)


def _backward(saved: tuple, cotangent: Found) -> tuple[System, Vector]:
    """Backward pass of `solve_reverse`: the transpose of the JVP of `attach`."""
    system, target, hits, ok = saved
    void = jax.tree.map(jnp.zeros_like, cotangent.arrival)  # its value is not used

    def attached(system, target):
        return attach(system, target, hits, void, ok)

    return jax.vjp(attached, system, target)[1]((cotangent.hits, cotangent.arrival))


solve_reverse.defvjp(_forward, _backward)
