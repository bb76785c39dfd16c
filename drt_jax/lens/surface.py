"""The shape of a surface: sag, its slopes and second derivatives, and where it exists.

A point on a surface is its transverse coordinates w (paper Eq. 1): one (height in the
meridional plane, y) or two (x, y), as a tuple of arrays or an array with the component axis
first; the functions of one form are elementwise in the rest.

A form is one record in `FORMS`: a function (w, shape) -> (sag, argument), the surface existing
where `argument` > 0, and its symmetry. Slopes, curvatures at the vertex and the derivative rules
follow from the function by automatic differentiation.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

# A square root is used up to the rim where the normal of a sphere leans within 0.57 degrees
# (cos = 0.01) of 90 degrees. Beyond, it continues smoothly and stays positive, so that an
# iteration which strays outside stays finite and can come back; a ray that ends there has
# missed the surface.
RIM = 1e-4
# Nearer to the axis than this (mm^2) an odd power of r is flat: its derivative at 0 is none.
_AXIS = 1e-16

# Transverse coordinates: D arrays, x and y or y alone.
Point = Sequence[Array] | Array


class Shape(NamedTuple):
    """Parameters of surfaces as arrays: curvature c (...) in 1/mm, conic k (...) and
    coefficients (K, ...), whose meaning belongs to the form."""

    curvature: Array
    conic: Array
    coefficients: Array


def _square(w: Point) -> Array:
    return sum((a * a for a in w[1:]), w[0] * w[0])


def _root(argument: Array) -> Array:
    inside = argument > RIM
    beyond = RIM**0.5 / (1 + (1 - jnp.where(inside, RIM, argument) / RIM) / 2)
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, argument, 1)), beyond)


def _conic(r2: Array, c: Array, k: Array) -> tuple[Array, Array]:
    argument = 1 - (1 + k) * c**2 * r2
    return c * r2 / (1 + _root(argument)), argument


def _horner(x: Array, coefficients: Array | list[Array]) -> Array:
    """sum_j a_j x^j; 0 without coefficients."""
    count = len(coefficients)
    total = coefficients[count - 1] if count else jnp.zeros_like(x)
    for j in reversed(range(count - 1)):
        total = coefficients[j] + x * total
    return total


def asphere(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Plane, sphere, conic and even asphere.

    z = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + a_0 r^2 + a_1 r^4 + ...; paper Eq. 1 is k = 0
    without coefficients.
    """
    r2 = _square(w)
    z, argument = _conic(r2, shape.curvature, shape.conic)
    if shape.coefficients.shape[0]:
        z = z + r2 * _horner(r2, shape.coefficients)
    return z, argument


def odd_asphere(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and every power of r: ... + a_0 r + a_1 r^2 + a_2 r^3 + ..."""
    r2 = _square(w)
    z, argument = _conic(r2, shape.curvature, shape.conic)
    off = r2 > _AXIS
    r = jnp.where(off, jnp.sqrt(jnp.where(off, r2, 1)), 0)
    odd, even = _horner(r2, shape.coefficients[::2]), _horner(r2, shape.coefficients[1::2])
    return z + r * odd + r2 * even, argument


def biconic(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Another conic in each direction: c and k hold for y, a_0 and a_1 are c and k for x.

    z = (cx x^2 + cy y^2) / (1 + sqrt(1 - (1 + kx) cx^2 x^2 - (1 + ky) cy^2 y^2)), and then
    a_2 r^2 + a_3 r^4 + ... Source: the biconic of Zemax and of batoid.
    """
    x2, y2 = w[0] * w[0], w[1] * w[1]
    cy, ky, (cx, kx) = shape.curvature, shape.conic, shape.coefficients[:2]
    argument = 1 - (1 + kx) * cx**2 * x2 - (1 + ky) * cy**2 * y2
    z = (cx * x2 + cy * y2) / (1 + _root(argument))
    r2 = x2 + y2
    return z + r2 * _horner(r2, shape.coefficients[2:]), argument


def toroid(w: Point, shape: Shape) -> tuple[Array, Array]:
    """A curve g(y) turned about an axis along y at the distance 1 / a_0 from the vertex.

    g is the conic of c and k plus a_1 y^2 + a_2 y^4 + ...; a_0 is the curvature in x.
    z = Rx - sign(Rx) sqrt((Rx - g)^2 - x^2) with Rx = 1 / a_0, written so that a_0 may be 0.
    """
    x2, y2 = w[0] * w[0], w[1] * w[1]
    g, argument = _conic(y2, shape.curvature, shape.conic)
    g = g + y2 * _horner(y2, shape.coefficients[1:])
    cx = shape.coefficients[0]
    turned = (1 - cx * g) ** 2 - cx**2 * x2
    z = (2 * g - cx * g * g + cx * x2) / (1 + _root(turned))
    return z, jnp.minimum(argument, turned)


def powers_xy(count: int) -> list[tuple[int, int]]:
    """The powers (i, j) of x^i y^j that `count` coefficients stand for: x, y, x^2, x y, y^2, ..."""
    pairs = [(degree - j, j) for degree in range(1, count + 1) for j in range(degree + 1)]
    return pairs[:count]


def polynomial_xy(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and a polynomial: ... + a_0 x + a_1 y + a_2 x^2 + a_3 x y + a_4 y^2 + a_5 x^3 + ..."""
    z, argument = _conic(_square(w), shape.curvature, shape.conic)
    pairs = powers_xy(len(shape.coefficients))
    degree = max((i + j for i, j in pairs), default=0)
    zero = jnp.zeros_like(shape.curvature)
    given = {pair: shape.coefficients[k] for k, pair in enumerate(pairs)}
    # A polynomial in y for each power of x.
    rows = [[given.get((i, j), zero) for j in range(degree - i + 1)] for i in range(degree + 1)]
    return z + _horner(w[0], [_horner(w[1], row) for row in rows]), argument


def linear(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and a slope: ... + a_0 y. As a phase, a grating with lines along x."""
    z, argument = _conic(_square(w), shape.curvature, shape.conic)
    return z + shape.coefficients[0] * w[-1], argument


class Form(NamedTuple):
    """A kind of surface.

    function: (w, shape) -> (sag in mm, argument), as described at the top of this file.
    symmetry: "rotation" about the z axis, "plane" (x -> -x leaves it alone) or "none".
    powers: what files call the coefficients, in their order.
    named: files have keys of their own for the first coefficients.
    round: whether the conic is one of r, so that the surface ends at a rim.
    """

    function: Callable[[Point, Shape], tuple[Array, Array]]
    symmetry: Literal["rotation", "plane", "none"]
    powers: tuple[int | str, ...]
    named: tuple[str, ...] = ()
    round: bool = True


_EVEN = tuple(range(2, 400, 2))
_XY = tuple(f"x{i}y{j}" for i, j in powers_xy(230))
FORMS: dict[str, Form] = {
    "asphere": Form(asphere, "rotation", _EVEN),
    "odd_asphere": Form(odd_asphere, "rotation", tuple(range(1, 200))),
    "biconic": Form(biconic, "plane", _EVEN, ("curvature_x", "conic_x"), round=False),
    "toroid": Form(toroid, "plane", _EVEN, ("curvature_x",), round=False),
    "polynomial_xy": Form(polynomial_xy, "none", _XY),
    "linear": Form(linear, "plane", ("y",)),
}


def by_form(function: Callable, w: Point, shape: Shape, forms: tuple[str, ...]) -> Any:
    """`function(w, shape, form)` for arrays over surfaces, `forms[i]` being that of surface i.

    `w` D arrays (S, ...), shape arrays (S, ...) and (K, S, ...), all of the same rank but for
    the first axis of coefficients. The results of the forms that occur, trees of arrays (S, ...),
    are put in order along the surface axis.
    """
    kinds = sorted(set(forms))
    if len(kinds) <= 1:
        return function(w, shape, *(kinds or ["asphere"]))
    rows = {kind: np.flatnonzero([form == kind for form in forms]) for kind in kinds}
    parts = []
    for kind, r in rows.items():
        own = Shape(shape.curvature[r], shape.conic[r], shape.coefficients[:, r])
        parts.append(function(tuple(a[r] for a in w), own, kind))
    order = np.argsort(np.concatenate(list(rows.values())))
    return jax.tree.map(lambda *values: jnp.concatenate(values)[order], *parts)


def surface_sag(w: Point, shape: Shape, form: str = "asphere") -> Array:
    """Height above the vertex plane, mm, shape of `w[0]`; `w`: D arrays in mm."""
    return FORMS[form].function(w, shape)[0]


def domain(w: Point, shape: Shape, form: str = "asphere") -> Array:
    """True where the surface exists at `w` (D arrays, mm); the shape of `w[0]`, bool."""
    return FORMS[form].function(w, shape)[1] > RIM


def sag_derivatives(
    w: Point, shape: Shape, form: str = "asphere"
) -> tuple[Array, tuple[Array, ...], tuple[tuple[Array, ...], ...]]:
    """Sag, its gradient and its Hessian by the transverse coordinates.

    `w`: D arrays in mm. Returns an array, D of them and D rows of D, all shaped as `w[0]`. By
    automatic differentiation of the form, so that a new one is one formula; but that of nearly
    all surfaces, an asphere, has them written out with one root and one division.
    """
    w = tuple(w)
    if form == "asphere":
        return _asphere_derivatives(w, shape)

    def slopes(w):
        z, pull_back = jax.vjp(lambda w: surface_sag(w, shape, form), w)
        return pull_back(jnp.ones_like(z))[0], z

    rows = []
    for d in range(len(w)):
        unit = tuple(jnp.full_like(a, float(k == d)) for k, a in enumerate(w))
        slope, row, z = jax.jvp(slopes, (w,), (unit,), has_aux=True)
        rows.append(row)
    return z, slope, tuple(rows)


def _asphere_derivatives(w: tuple[Array, ...], shape: Shape) -> Any:
    c, bent = shape.curvature, (1 + shape.conic) * shape.curvature**2
    r2 = _square(w)
    argument = 1 - bent * r2
    inverse = 1 / jnp.sqrt(jnp.maximum(argument, RIM))
    # z and its derivatives by r^2; beyond the rim, it goes on with the slope of the rim.
    z, first = c * r2 / (1 + _root(argument)), c / 2 * inverse
    second = jnp.where(argument > RIM, c * bent / 4 * inverse**3, 0)
    if shape.coefficients.shape[0]:
        z = z + r2 * _horner(r2, shape.coefficients)
        once = [(j + 1) * a for j, a in enumerate(shape.coefficients)]
        first = first + _horner(r2, once)
        second = second + _horner(r2, [(j + 1) * a for j, a in enumerate(once[1:])])
    bend = tuple(
        tuple(4 * a * b * second + (2 * first if i == j else 0) for j, b in enumerate(w))
        for i, a in enumerate(w)
    )
    return z, tuple(2 * a * first for a in w), bend


def vertex_curvature(shape: Shape, forms: tuple[str, ...], dim: int) -> tuple[Array, ...]:
    """Curvature of S surfaces at their vertices along each of `dim` components: `dim` arrays (S,),
    1/mm; `shape` with arrays (S,) and (K, S)."""
    if set(forms) <= {"asphere"}:
        bend = shape.curvature + (2 * shape.coefficients[0] if len(shape.coefficients) else 0)
        return (bend,) * dim
    zero = jnp.zeros_like(shape.curvature)
    _, _, bend = by_form(sag_derivatives, (zero, zero), shape, forms)
    return (bend[0][0], bend[1][1])[2 - dim :]
