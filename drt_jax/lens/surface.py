"""The shape of a surface: sag, its slopes and second derivatives, and where it exists.

A point on a surface is its transverse coordinates w (paper Eq. 1): one (height in the
meridional plane, y) or two (x, y). The component axis comes first, so that `w[0]`, `w[1]` are
arrays over surfaces and rays; the functions of one form are elementwise in the rest.

A form is one function (w, shape) -> (sag, argument), the surface existing where `argument` > 0,
and one line in `FORMS`. Slopes, curvatures at the vertex and the derivative rules follow from
it by automatic differentiation.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

__all__ = [
    "FORMS",
    "RIM",
    "ROTATIONAL",
    "Shape",
    "domain",
    "powers_xy",
    "sag",
    "sag_derivatives",
    "vertex_curvature",
]

# A square root is used up to the rim where the normal of a sphere leans within 0.57 degrees
# (cos = 0.01) of 90 degrees. Beyond, it continues smoothly and stays positive, so that an
# iteration which strays outside stays finite and can come back; a ray that ends there has
# missed the surface.
RIM = 1e-4
# Nearer to the axis than this (mm^2) an odd power of r is flat: its derivative at 0 is none.
_AXIS = 1e-16


class Shape(NamedTuple):
    """Parameters of surfaces as arrays: curvature c (...) in 1/mm, conic k (...) and
    coefficients (K, ...), whose meaning belongs to the form."""

    curvature: Array
    conic: Array
    coefficients: Array


def _root(argument: Array) -> Array:
    inside = argument > RIM
    beyond = RIM**0.5 / (1 + (1 - jnp.where(inside, RIM, argument) / RIM) / 2)
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, argument, 1)), beyond)


def _conic(r2: Array, c: Array, k: Array) -> tuple[Array, Array]:
    argument = 1 - (1 + k) * c**2 * r2
    return c * r2 / (1 + _root(argument)), argument


def _horner(x: Array, coefficients: Array | list[Array]) -> Array:
    """sum_j a_j x^j; 0 without coefficients."""
    total = jnp.zeros_like(x)
    for j in reversed(range(len(coefficients))):
        total = coefficients[j] + x * total if j < len(coefficients) - 1 else coefficients[j]
    return total


def asphere(w: Array, shape: Shape) -> tuple[Array, Array]:
    """Plane, sphere, conic and even asphere.

    z = c r^2 / (1 + sqrt(1 - (1 + k) c^2 r^2)) + a_0 r^2 + a_1 r^4 + ...; paper Eq. 1 is k = 0
    without coefficients.
    """
    r2 = sum(a * a for a in w)
    z, argument = _conic(r2, shape.curvature, shape.conic)
    if shape.coefficients.shape[0]:
        z = z + r2 * _horner(r2, shape.coefficients)
    return z, argument


def odd_asphere(w: Array, shape: Shape) -> tuple[Array, Array]:
    """Conic and every power of r: ... + a_0 r + a_1 r^2 + a_2 r^3 + ..."""
    r2 = sum(a * a for a in w)
    z, argument = _conic(r2, shape.curvature, shape.conic)
    off = r2 > _AXIS
    r = jnp.where(off, jnp.sqrt(jnp.where(off, r2, 1)), 0)
    odd, even = _horner(r2, shape.coefficients[::2]), _horner(r2, shape.coefficients[1::2])
    return z + r * odd + r2 * even, argument


def biconic(w: Array, shape: Shape) -> tuple[Array, Array]:
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


def toroid(w: Array, shape: Shape) -> tuple[Array, Array]:
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


def polynomial_xy(w: Array, shape: Shape) -> tuple[Array, Array]:
    """Conic and a polynomial: ... + a_0 x + a_1 y + a_2 x^2 + a_3 x y + a_4 y^2 + a_5 x^3 + ..."""
    z, argument = _conic(jnp.sum(w * w, axis=0), shape.curvature, shape.conic)
    pairs = powers_xy(len(shape.coefficients))
    degree = max((i + j for i, j in pairs), default=0)
    rows = []  # a polynomial in y for each power of x
    for i in range(degree + 1):
        row = [jnp.zeros_like(shape.curvature)] * (degree - i + 1)
        for k, (p, q) in enumerate(pairs):
            if p == i:
                row[q] = shape.coefficients[k]
        rows.append(_horner(w[1], row))
    return z + _horner(w[0], rows), argument


FORMS: dict[str, Callable[[Array, Shape], tuple[Array, Array]]] = {
    "asphere": asphere,
    "odd_asphere": odd_asphere,
    "biconic": biconic,
    "toroid": toroid,
    "polynomial_xy": polynomial_xy,
}
# Forms that may be traced in the meridional plane alone, and those that x -> -x leaves alone.
ROTATIONAL = frozenset({"asphere", "odd_asphere"})
MIRRORED = ROTATIONAL | {"biconic", "toroid"}


def by_form(function: Callable, w: Array, shape: Shape, forms: tuple[str, ...]) -> object:
    """`function(w, shape, form)` for arrays over surfaces, `forms[i]` being that of surface i.

    `w` (D, S, ...), shape arrays (S, ...) and (K, S, ...), all of the same rank but for their
    first axis. The results of the forms that occur are put in order along the surface axis.
    """
    kinds = sorted(set(forms))
    if len(kinds) == 1:
        return function(w, shape, kinds[0])
    rows = {kind: np.flatnonzero([form == kind for form in forms]) for kind in kinds}
    parts = [
        function(w[:, r], Shape(shape.curvature[r], shape.conic[r], shape.coefficients[:, r]), kind)
        for kind, r in rows.items()
    ]
    axis = 1 - w.ndim  # of the surfaces, counted from the end
    order = np.argsort(np.concatenate(list(rows.values())))
    return jax.tree.map(
        lambda *values: jnp.take(jnp.concatenate(values, axis=axis), order, axis=axis), *parts
    )


def sag(w: Array, shape: Shape, form: str = "asphere") -> Array:
    """Height above the vertex plane, mm, shape of `w[0]`; `w` (D, ...) in mm."""
    return FORMS[form](w, shape)[0]


def domain(w: Array, shape: Shape, form: str = "asphere") -> Array:
    """True where the surface exists at `w` ((D, ...), mm); the shape of `w[0]`, bool."""
    return FORMS[form](w, shape)[1] > RIM


def sag_derivatives(w: Array, shape: Shape, form: str = "asphere") -> tuple[Array, Array, Array]:
    """Sag, its gradient and its Hessian by the transverse coordinates.

    `w` (D, ...) in mm. Returns arrays of shapes (...), (D, ...) and (D, D, ...). Derived from
    `sag` by automatic differentiation, so that a new surface form is one formula; but the form
    of nearly all surfaces, an asphere, has them written out with one root and one division.
    """
    if form == "asphere":
        return _asphere_derivatives(w, shape)

    def slopes(w):
        z, pull_back = jax.vjp(lambda w: sag(w, shape, form), w)
        return pull_back(jnp.ones_like(z))[0], z

    columns = []
    for d in range(w.shape[0]):
        unit = jnp.zeros_like(w).at[d].set(1)
        gradient, column, z = jax.jvp(slopes, (w,), (unit,), has_aux=True)
        columns.append(column)
    return z, gradient, jnp.stack(columns)


def _asphere_derivatives(w: Array, shape: Shape) -> tuple[Array, Array, Array]:
    c, bent = shape.curvature, (1 + shape.conic) * shape.curvature**2
    r2 = sum(a * a for a in w)
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
    pairs = [[4 * a * b * second for b in w] for a in w]
    for d, row in enumerate(pairs):
        row[d] = row[d] + 2 * first
    return z, 2 * w * first, jnp.stack([jnp.stack(row) for row in pairs])


def vertex_curvature(shape: Shape, forms: tuple[str, ...], dim: int) -> Array:
    """Curvature of S surfaces at their vertices along each component, (dim, S), 1/mm."""
    if set(forms) == {"asphere"}:
        bend = shape.curvature + (2 * shape.coefficients[0] if len(shape.coefficients) else 0)
        return jnp.broadcast_to(bend, (dim, *bend.shape))
    at_vertex = jnp.zeros((2, len(forms)), shape.curvature.dtype)
    _, _, bend = by_form(sag_derivatives, at_vertex, shape, forms)
    return jnp.stack([bend[0, 0], bend[1, 1]])[2 - dim :]
