"""Intersection of straight lines with surfaces: the only intersection routine.

Source: Welford, Aberrations of Optical Systems (1986), ch. 4.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import RIM, Shape
from ..lens.surface import domain, sag_slope
from ..numerics import safe_divide, safe_sqrt
from .system import Placed, Vector, dot

# Newton steps along a ray to a surface that is not a conic; converged if the last step is shorter
# than `_SETTLED` times 1 mm plus the length of the ray.
_STEPS, _SETTLED = 20, 1e-7


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def reach(
    form: str, p: Vector, d: Vector, shape: Shape, going: Array, side: Array, least: Array | None
) -> tuple[Array, Array]:
    """Length s at which the line p + s d crosses a surface with its vertex at the origin, and a
    mask of those that cross it. Differentiable in p, d and shape by the implicit function theorem.

    A line crosses a conic twice: once towards +z of the surface, which is where its normal
    (-slope, 1) has a positive product with d, and once towards -z. `side` says which of them is
    meant, so that neighbouring rays get neighbouring points however the surface is tilted. If
    that one does not lie on the sheet of the vertex at s > `least`, and the other one does, it is
    the other one. The crossing of a surface that is no conic is looked for from that of its conic;
    the caller checks its side and whether it lies ahead.

    form: name of the form of the surface.
    p: D + 1 components, a point in the axes of the surface, mm.
    d: D + 1 components, a direction of any length; s is in units of that length.
    shape: shape of the surface.
    going: bool, rays whose iteration must converge; the others may come out wrong.
    side: 1 for the crossing towards +z, -1 for that towards -z.
    least: smallest s, in units of the length of d; None for the crossing of `side` wherever it is.
    """
    # c (x^2 + y^2 + (1 + k) z^2) = 2 z at p + s d: square s^2 - 2 linear s + constant = 0
    c, k = shape.curvature, shape.conic
    square, linear, constant = quadratic(p, d, shape)
    discriminant = linear**2 - square * constant

    def crossing(root: Array) -> tuple[Array, Array]:
        # Of the two forms of the root, use the one without cancellation.
        alike = linear * root < 0
        above = jnp.where(alike, linear - root, constant)
        below = jnp.where(alike, square, linear + root)
        length = safe_divide(above, below)
        return length, 1 - (1 + k) * c * (p[-1] + length * d[-1]) > RIM**0.5

    root, met = side * safe_sqrt(discriminant), discriminant > 0
    length, on_sheet = crossing(root)
    if least is not None:
        other, also = crossing(-root)

        def good(length: Array, on_sheet: Array, side: Array) -> Array:
            # A plane has one crossing only: the formula gives another from the wrong side.
            return on_sheet & (length > least) & ((linear - square * length) * side > 0)

        turned = good(other, also, -side) & ~good(length, on_sheet, side)
        length, on_sheet = jnp.where(turned, other, length), jnp.where(turned, also, on_sheet)
    if _plain(form, shape):
        return length, met & on_sheet
    # Newton's method starts at the conic; for a ray that misses it, at the vertex plane.
    plane = -safe_divide(p[-1], d[-1])
    start = jnp.where(met & on_sheet, length, plane)
    size = jnp.sqrt(dot(d, d))
    settled = max(_SETTLED, 16 * float(jnp.finfo(length.dtype).eps))

    def closer(state):
        count, length, _ = state
        change = -safe_divide(*_gap(form, p, d, shape, length))
        small = jnp.abs(change) * size <= settled * (1 + jnp.abs(length) * size)
        return count + 1, length + change, small

    begin = 0, start, jnp.zeros(start.shape, bool)
    _, length, met = jax.lax.while_loop(
        lambda state: (state[0] < _STEPS) & jnp.any(going & ~state[2]), closer, begin
    )
    length = jnp.where(met, length, plane)  # a length that has not converged may be anything
    return length, met & domain(_along(p, d, length)[:-1], shape, form)


def quadratic(p: Vector, d: Vector, shape: Shape) -> Vector:
    """Coefficients (square, linear, constant) of square s^2 - 2 linear s + constant = 0, whose root
    s is the length at which p + s d meets a conic."""
    c, k = shape.curvature, shape.conic
    flat = *d[:-1], (1 + k) * d[-1]
    square, linear = c * dot(flat, d), d[-1] - c * dot(flat, p)
    return square, linear, c * (dot(p[:-1], p[:-1]) + (1 + k) * p[-1] ** 2) - 2 * p[-1]


def _along(p: Vector, d: Vector, length: Array) -> Vector:
    return tuple(a + length * b for a, b in zip(p, d, strict=True))


def _plain(form: str, shape: Shape) -> bool:
    """True for a conic without aspheric terms, a quadric."""
    return form == "asphere" and not shape.coefficients.shape[0]


def _gap(form: str, p: Vector, d: Vector, shape: Shape, length: Array) -> tuple[Array, Array]:
    """Value at p + s d of a function that is 0 on the surface, and its derivative by s."""
    *across, z = _along(p, d, length)
    if _plain(form, shape):
        quadric = tuple(shape.curvature * a for a in (*across, (1 + shape.conic) * z))
        return dot(quadric, (*across, z)) / 2 - z, dot(quadric, d) - d[-1]
    height, slope = sag_slope(across, shape, form)
    return height - z, dot(slope, d[:-1]) - d[-1]


@reach.defjvp
def _reach_jvp(form: str, primals: Any, tangents: Any) -> tuple:
    length, met = reach(form, *primals)
    gap = partial(_gap, form, length=length)
    _, change, rate = jax.jvp(gap, primals[:3], tangents[:3], has_aux=True)
    tangent = -safe_divide(change, rate)
    return (length, met), (tangent, np.zeros(met.shape, jax.dtypes.float0))


def meet(
    form: str,
    p: Vector,
    d: Vector,
    shape: Shape,
    going: Array,
    side: Array,
    least: Array | None,
) -> tuple:
    """Intersection of rays with a surface; arguments as in `reach`.

    Returns the point (mm), a normal of any length with z above 0, the mask of those that meet the
    surface, and the length s.
    """
    length, met = reach(form, p, d, shape, going, side, least)
    own = _along(p, d, length)
    if _plain(form, shape):
        c = shape.curvature
        normal = *(-c * a for a in own[:-1]), 1 - (1 + shape.conic) * c * own[-1]
    else:
        _, slope = sag_slope(own[:-1], shape, form)
        normal = *(-a for a in slope), jnp.ones_like(own[-1])
    return own, normal, met, length


def near_side(d: Vector) -> Array:
    """The `side` of `reach` from which a straight line crosses a surface near its vertex."""
    return jnp.where(d[-1] < 0, -1, 1).astype(d[-1].dtype)


def cross(surface: Placed, form: str, point: Vector, direction: Vector) -> tuple[Vector, Array]:
    """Intersection of straight lines, extended both ways, with one surface: D arrays, mm along its
    axes, and a mask of those that intersect it.

    surface: the surface in its position.
    form: name of its form.
    point, direction: D + 1 arrays each, along the axes of the lens; point in mm.
    """
    p, d = surface.local(point, direction)
    all_of_them = jnp.ones(p[0].shape, bool)
    length, met = reach(form, p, d, surface.shape, all_of_them, near_side(d), None)
    return _along(p, d, length)[:-1], met
