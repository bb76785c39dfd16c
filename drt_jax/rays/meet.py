"""Intersection of straight lines with surfaces. There is no other intersection routine.

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
from .system import Placed, Vector, along, dot

# Newton's method along a ray to a surface that is not a conic takes at most `_STEPS` steps. It has
# converged if the last step is at most `_SETTLED` times (1 mm + length of the ray).
_STEPS, _SETTLED = 20, 1e-7


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def reach(
    form: str, p: Vector, d: Vector, shape: Shape, going: Array, side: Array, least: Array | None
) -> tuple[Array, Array]:
    """Length s at which the line p + s d crosses a surface with its vertex at the origin.

    For a conic, c (x^2 + y^2 + (1 + k) z^2) = 2 z gives a s^2 - 2 b s + e = 0 (see `quadratic`)
    with the two roots s = (b - r) / a = e / (b + r), r = +-sqrt(b^2 - a e). The product of the
    direction with the normal (-slope, 1), scaled, is b - a s = r. So the sign of r tells towards
    which side of the surface the line crosses it: r > 0 towards +z, r < 0 towards -z. `side` is
    this sign. Neighbouring rays therefore get neighbouring points however the surface is tilted. If
    the crossing of `side` is not on the sheet of the vertex with s > `least`, and the other
    crossing is, the other one is returned.

    For other surfaces Newton's method along the line starts at the crossing of the conic. The
    caller checks the side of the result and whether it lies ahead.

    Differentiable in p, d and shape by the implicit function theorem: with the function g(s, p, d,
    shape) that is 0 on the surface, ds = -dg / (dg/ds).

    form: name of the form of the surface.
    p: D + 1 components, a point in the axes of the surface, mm.
    d: D + 1 components, a direction of any length; s is in units of that length.
    shape: shape of the surface.
    going: bool, rays whose iteration must converge; results for the others may be wrong.
    side: 1 for the crossing towards +z, -1 for that towards -z.
    least: smallest s that is accepted, in units of the length of d; None to return the crossing of
        `side` wherever it is.

    Returns s, and a mask of the lines that cross the surface.
    """
    # c (x^2 + y^2 + (1 + k) z^2) = 2 z at p + s d: square s^2 - 2 linear s + constant = 0
    c, k = shape.curvature, shape.conic
    square, linear, constant = quadratic(p, d, shape)
    discriminant = linear**2 - square * constant

    def crossing(root: Array) -> tuple[Array, Array]:
        # s = (linear - root) / square = constant / (linear + root): use the form without
        # cancellation.
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
            # A plane has only one crossing, but the formula gives a second one from the wrong side.
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
    length = jnp.where(met, length, plane)  # an unconverged length has an arbitrary value
    return length, met & domain(along(p, length, d)[:-1], shape, form)


def quadratic(p: Vector, d: Vector, shape: Shape) -> Vector:
    """Coefficients of the quadratic equation for the length s at which p + s d meets a conic.

    The equation is square s^2 - 2 linear s + constant = 0. Returns (square, linear, constant).
    """
    c, k = shape.curvature, shape.conic
    flat = *d[:-1], (1 + k) * d[-1]
    square, linear = c * dot(flat, d), d[-1] - c * dot(flat, p)
    return square, linear, c * (dot(p[:-1], p[:-1]) + (1 + k) * p[-1] ** 2) - 2 * p[-1]


def _plain(form: str, shape: Shape) -> bool:
    """True for a conic without aspheric terms, a quadric."""
    return form == "asphere" and not shape.coefficients.shape[0]


def _gap(form: str, p: Vector, d: Vector, shape: Shape, length: Array) -> tuple[Array, Array]:
    """A function g(s) that is 0 where p + s d meets the surface, and its derivative by s.

    For a plain conic g = c (x^2 + y^2 + (1 + k) z^2) / 2 - z, otherwise g = sag(x, y) - z.
    """
    *across, z = along(p, length, d)
    if _plain(form, shape):
        quadric = tuple(shape.curvature * a for a in (*across, (1 + shape.conic) * z))
        return dot(quadric, (*across, z)) / 2 - z, dot(quadric, d) - d[-1]
    height, slope = sag_slope(across, shape, form)
    return height - z, dot(slope, d[:-1]) - d[-1]


@reach.defjvp
def _reach_jvp(form: str, primals: Any, tangents: Any) -> tuple:
    """Implicit function theorem: ds = -dg / (dg/ds), with g of `_gap` at fixed s."""
    length, met = reach(form, *primals)
    gap = partial(_gap, form, length=length)
    _, change, rate = jax.jvp(gap, primals[:3], tangents[:3], has_aux=True)
    tangent = -safe_divide(change, rate)
    return (length, met), (tangent, np.zeros(met.shape, jax.dtypes.float0))


def meet(form: str, p: Vector, d: Vector, shape: Shape, *how: Any) -> tuple:
    """Intersection of rays with a surface, with the normal there.

    form, p, d, shape: as in `reach`.
    how: its other arguments, `going`, `side` and `least`.

    Returns the point, D + 1 components, mm; a normal of any length with z above 0; the mask of the
    rays that meet the surface; and the length s.
    """
    length, met = reach(form, p, d, shape, *how)
    own = along(p, length, d)
    if _plain(form, shape):
        c = shape.curvature
        normal = *(-c * a for a in own[:-1]), 1 - (1 + shape.conic) * c * own[-1]
    else:
        _, slope = sag_slope(own[:-1], shape, form)
        normal = *(-a for a in slope), jnp.ones_like(own[-1])
    return own, normal, met, length


def near_side(d: Vector) -> Array:
    """The `side` of `reach` on which a straight line crosses a surface near its vertex."""
    return jnp.where(d[-1] < 0, -1, 1).astype(d[-1].dtype)


def cross(surface: Placed, form: str, point: Vector, direction: Vector) -> tuple[Vector, Array]:
    """Intersection of straight lines, extended both ways, with one surface.

    surface: the surface in its position.
    form: name of its form.
    point, direction: D + 1 arrays each, along the axes of the lens; point in mm.

    Returns the intersections, D arrays, mm along the axes of the surface, and a mask of the lines
    that intersect it.
    """
    p, d = surface.local(point, direction)
    every_ray = jnp.ones(p[0].shape, bool)
    length, met = reach(form, p, d, surface.shape, every_ray, near_side(d), None)
    return along(p, length, d)[:-1], met
