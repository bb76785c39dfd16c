"""Sag of a surface, its first and second derivatives, and where the surface exists.

`forms` describes points, shapes and forms.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .forms import FORMS, RIM, Point, Shape, horner, root, square


def by_form(function: Callable, w: Point, shape: Shape, forms: tuple[str, ...]) -> Any:
    """Calls `function(w, shape, form)` once for each form that occurs, with all surfaces of that
    form.

    Returns the results, trees of arrays (S, ...), in the order of the surfaces.

    w: D arrays (S, ...).
    shape: arrays (S, ...) of the rank of `w`, and coefficients (K, S, ...).
    forms: form of each of the S surfaces.
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
    """Sag: height above the vertex plane, mm, in the shape of `w[0]`. w: D arrays, mm."""
    return FORMS[form].function(w, shape)[0]


def domain(w: Point, shape: Shape, form: str = "asphere") -> Array:
    """True where the surface exists, bool, in the shape of `w[0]`. w: D arrays, mm."""
    return FORMS[form].function(w, shape)[1] > RIM


@functools.partial(jax.jit, static_argnames="form")
def sag_slope(w: Point, shape: Shape, form: str = "asphere") -> tuple[Array, tuple[Array, ...]]:
    """Sag (mm) and its gradient (D arrays) by the transverse coordinates, in the shape of `w[0]`.

    The gradient is computed by automatic differentiation. For an asphere, the form of nearly all
    surfaces, it is written out with one root and one division. The function is jitted because a
    program calls it for every search, and JAX then traces it only once.

    w: D arrays, mm.
    """
    w = tuple(w)
    if form == "asphere":
        z, first, _ = profile(w, shape)
        return z, tuple(2 * a * first for a in w)
    z, pull_back = jax.vjp(lambda w: surface_sag(w, shape, form), w)
    return z, pull_back(jnp.ones_like(z))[0]


@functools.partial(jax.jit, static_argnames="form")
def sag_derivatives(
    w: Point, shape: Shape, form: str = "asphere"
) -> tuple[Array, tuple[Array, ...], tuple[tuple[Array, ...], ...]]:
    """Sag, its gradient and its Hessian by the transverse coordinates, in the shape of `w[0]`.

    w: D arrays, mm.

    Returns the sag, mm; the gradient, D arrays; and the Hessian, 1/mm, D rows of D arrays.
    """
    w = tuple(w)
    if form == "asphere":
        z, first, second = profile(w, shape)
        bend = tuple(
            tuple(4 * a * b * second + (2 * first if i == j else 0) for j, b in enumerate(w))
            for i, a in enumerate(w)
        )
        return z, tuple(2 * a * first for a in w), bend
    rows = []
    for d in range(len(w)):
        unit = tuple(jnp.full_like(a, float(k == d)) for k, a in enumerate(w))
        (z, slope), (_, row) = jax.jvp(lambda w: sag_slope(w, shape, form), (w,), (unit,))
        rows.append(row)
    return z, slope, tuple(rows)


def profile(w: Point, shape: Shape) -> tuple[Array, Array, Array]:
    """Sag of an asphere and its first and second derivatives by r^2.

    Beyond the rim, it continues with the slope at the rim.
    """
    c, bent = shape.curvature, (1 + shape.conic) * shape.curvature**2
    r2 = square(w)
    argument = 1 - bent * r2
    inverse = 1 / jnp.sqrt(jnp.maximum(argument, RIM))
    z, first = c * r2 / (1 + root(argument)), c / 2 * inverse
    second = jnp.where(argument > RIM, c * bent / 4 * inverse**3, 0)
    if shape.coefficients.shape[0]:
        z = z + r2 * horner(r2, shape.coefficients)
        once = [(j + 1) * a for j, a in enumerate(shape.coefficients)]
        first = first + horner(r2, once)
        second = second + horner(r2, [(j + 1) * a for j, a in enumerate(once[1:])])
    return z, first, second


def vertex_curvature(shape: Shape, forms: tuple[str, ...], dim: int) -> tuple[Array, ...]:
    """Vertex curvature along each of `dim` components: `dim` arrays (S,), 1/mm.

    shape: arrays (S,) and (K, S).
    """
    if set(forms) <= {"asphere"}:
        bend = shape.curvature + (2 * shape.coefficients[0] if len(shape.coefficients) else 0)
        return (bend,) * dim
    zero = jnp.zeros_like(shape.curvature)
    _, _, bend = by_form(sag_derivatives, (zero, zero), shape, forms)
    return (bend[0][0], bend[1][1])[2 - dim :]
