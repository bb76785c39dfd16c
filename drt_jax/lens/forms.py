"""The forms of surfaces: each is one function and one record in `FORMS`.

A point w on a surface has one transverse coordinate, y in the meridional plane, or two, x and y
(paper Eq. 1). It is a tuple of arrays, or an array with the component axis first. A form is a
function (w, shape) -> (sag, argument), which works elementwise on all other axes; the surface
exists where `argument` is above 0. Slopes, vertex curvatures and derivatives follow by automatic
differentiation, see `surface`.
"""

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import tensordot

# Smallest argument of the square root. There the normal of a sphere makes an angle with the axis
# that is 0.57 degrees below 90 degrees (cos = 0.01). Beyond, the root continues smoothly and stays
# positive, so that an iteration that goes outside stays finite and can return. A ray that ends
# there misses the surface.
RIM = 1e-4
# Below this r^2 (mm^2) r counts as 0, because r has no derivative there.
_AXIS = 1e-16

# Transverse coordinates: D arrays, x and y or y alone.
Point = Sequence[Array] | Array


class Shape(NamedTuple):
    """Parameters of surfaces.

    curvature: (...), c, 1/mm.
    conic: (...), k.
    coefficients: (K, ...), a_0, a_1, ... of the form.
    """

    curvature: Array
    conic: Array
    coefficients: Array


def square(w: Point) -> Array:
    """r^2 of points, mm^2, in the shape of `w[0]`."""
    return sum((a * a for a in w[1:]), w[0] * w[0])


def root(argument: Array) -> Array:
    """Square root for arguments above `RIM`, continued smoothly and positively below. Any shape."""
    inside = argument > RIM
    beyond = RIM**0.5 / (1 + (1 - jnp.where(inside, RIM, argument) / RIM) / 2)
    return jnp.where(inside, jnp.sqrt(jnp.where(inside, argument, 1)), beyond)


def _conic(r2: Array, c: Array, k: Array) -> tuple[Array, Array]:
    """Sag of a conic, and the argument of its square root."""
    argument = 1 - (1 + k) * c**2 * r2
    return c * r2 / (1 + root(argument)), argument


def horner(x: Array, coefficients: Array | list[Array]) -> Array:
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
    r2 = square(w)
    z, argument = _conic(r2, shape.curvature, shape.conic)
    if shape.coefficients.shape[0]:
        z = z + r2 * horner(r2, shape.coefficients)
    return z, argument


def odd_asphere(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and every power of r: ... + a_0 r + a_1 r^2 + a_2 r^3 + ..."""
    r2 = square(w)
    z, argument = _conic(r2, shape.curvature, shape.conic)
    off_axis = r2 > _AXIS
    r = jnp.where(off_axis, jnp.sqrt(jnp.where(off_axis, r2, 1)), 0)
    odd, even = horner(r2, shape.coefficients[::2]), horner(r2, shape.coefficients[1::2])
    return z + r * odd + r2 * even, argument


def biconic(w: Point, shape: Shape) -> tuple[Array, Array]:
    """A conic of different parameters along x and y.

    c and k hold for y, a_0 and a_1 are c and k for x. z = (cx x^2 + cy y^2) / (1 + sqrt(1 - (1 +
    kx) cx^2 x^2 - (1 + ky) cy^2 y^2)) + a_2 r^2 + a_3 r^4 + ... Source: the biconic of Zemax and of
    batoid.
    """
    x2, y2 = w[0] * w[0], w[1] * w[1]
    cy, ky, (cx, kx) = shape.curvature, shape.conic, shape.coefficients[:2]
    argument = 1 - (1 + kx) * cx**2 * x2 - (1 + ky) * cy**2 * y2
    z = (cx * x2 + cy * y2) / (1 + root(argument))
    r2 = x2 + y2
    return z + r2 * horner(r2, shape.coefficients[2:]), argument


def toroid(w: Point, shape: Shape) -> tuple[Array, Array]:
    """A curve g(y) rotated about an axis along y, at the distance 1 / a_0 from the vertex.

    g is the conic of c and k plus a_1 y^2 + a_2 y^4 + ...; a_0 is the curvature along x. z = Rx -
    sign(Rx) sqrt((Rx - g)^2 - x^2) with Rx = 1 / a_0, written in a form in which a_0 may be 0.
    """
    x2, y2 = w[0] * w[0], w[1] * w[1]
    g, argument = _conic(y2, shape.curvature, shape.conic)
    g = g + y2 * horner(y2, shape.coefficients[1:])
    cx = shape.coefficients[0]
    argument_x = (1 - cx * g) ** 2 - cx**2 * x2
    z = (2 * g - cx * g * g + cx * x2) / (1 + root(argument_x))
    return z, jnp.minimum(argument, argument_x)


def powers_xy(count: int) -> list[tuple[int, int]]:
    """Powers (i, j) of x^i y^j of the first `count` coefficients: x, y, x^2, x y, y^2, ..."""
    pairs = ((degree - j, j) for degree in itertools.count(1) for j in range(degree + 1))
    return [*itertools.islice(pairs, count)]


def _polynomial(w: Point, terms: dict[tuple[int, int], Array]) -> Array:
    """sum_ij a_ij x^i y^j by Horner's scheme. terms: a_ij by (i, j)."""
    degree = max((i + j for i, j in terms), default=0)
    zero = jnp.zeros_like(w[0])
    # A polynomial in y for each power of x.
    rows = [[terms.get((i, j), zero) for j in range(degree - i + 1)] for i in range(degree + 1)]
    return horner(w[0], [horner(w[1], row) for row in rows])


def polynomial_xy(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and a polynomial: ... + a_0 x + a_1 y + a_2 x^2 + a_3 x y + a_4 y^2 + a_5 x^3 + ..."""
    z, argument = _conic(square(w), shape.curvature, shape.conic)
    pairs = powers_xy(len(shape.coefficients))
    return z + _polynomial(w, dict(zip(pairs, shape.coefficients, strict=True))), argument


def linear(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and a linear term: ... + a_0 y. As a phase, it is a grating with lines along x."""
    z, argument = _conic(square(w), shape.curvature, shape.conic)
    return z + w[-1] * sum(shape.coefficients[:1], jnp.zeros_like(z)), argument


@functools.cache
def noll_terms(degree: int) -> tuple[tuple[int, int], ...]:
    """(n, m) of the Zernike terms up to a degree in Noll's order; m is negative for sines."""
    terms: list[tuple[int, int]] = []
    for n in range(degree + 1):
        for m in range(n % 2, n + 1, 2):
            # An even number stands for a cosine, and the first of a pair is number len + 1.
            pair = [0] if m == 0 else [m, -m] if len(terms) % 2 else [-m, m]
            terms += [(n, k) for k in pair]
    return tuple(terms)


def fringe_terms() -> list[tuple[int, int]]:
    """(n, m) of the 37 fringe terms; m is negative for sines."""
    found: list[tuple[int, int]] = []
    for half in range(6):
        for m in range(half, -1, -1):
            n = 2 * half - m
            found += [(n, 0)] if m == 0 else [(n, m), (n, -m)]
    return [*found, (12, 0)]


def noll_of_fringe(fringe: int) -> tuple[int, float]:
    """Noll's number of a fringe term, and the ratio of the fringe term to Noll's.

    A fringe term is 1 at the rim where Noll's term has the value of this ratio.

    fringe: number of the fringe term, 1 to 37.
    """
    n, m = fringe_terms()[fringe - 1]
    return noll_terms(n).index((n, m)) + 1, math.sqrt((n + 1) * (2 if m else 1))


@functools.cache
def _noll(count: int) -> tuple[list[tuple[int, int]], np.ndarray]:
    """Powers (i, j), and the coefficient of x^i y^j in each of the first `count` Zernike
    polynomials.

    Noll's order and norm (J. Opt. Soc. Am. 66, 207 (1976)): the mean square over the disc is 1,
    even numbers go with cos(m theta), odd ones with sin.
    """
    degree = next(n for n in range(count) if (n + 1) * (n + 2) >= 2 * count)
    pairs = [(0, 0), *powers_xy(sum(range(2, degree + 2)))]
    table = np.zeros((len(pairs), count))
    for k, (n, sign) in enumerate(noll_terms(degree)[:count]):
        m, sine = abs(sign), sign < 0
        norm = math.sqrt((n + 1) * (2 if m else 1))
        for s in range((n - m) // 2 + 1):
            radial = (-1) ** s * math.comb(n - s, s) * math.comb(n - 2 * s, (n - m) // 2 - s)
            rest = (n - m) // 2 - s  # r^(n - 2 s) is (x^2 + y^2)^rest r^m
            for p, q in itertools.product(range(rest + 1), range(m + 1)):
                if q % 2 == sine:  # the terms of the real part of (x + i y)^m, or of the imaginary
                    place = pairs.index((m - q + 2 * (rest - p), q + 2 * p))
                    size = math.comb(rest, p) * math.comb(m, q) * (-1) ** (q // 2)
                    table[place, k] += norm * radial * size
    return pairs, table


def zernike(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and Zernike polynomials: ... + sum_j a_j Z_j(x / R, y / R) with R = a_0 in mm.

    Z_j has Noll's order and norm, with theta measured from the x axis. The sum is evaluated as a
    polynomial in x and y, which keeps 11 of 16 digits of a_j with 91 terms, the largest number in
    files.
    """
    z, argument = _conic(square(w), shape.curvature, shape.conic)
    if len(shape.coefficients) > 1:
        pairs, table = _noll(len(shape.coefficients) - 1)
        terms = tensordot(jnp.asarray(table, z.dtype), shape.coefficients[1:], 1)
        inverse = _inverse(shape.coefficients[0])
        z = z + _polynomial([a * inverse for a in w], dict(zip(pairs, terms, strict=True)))
    return z, argument


@functools.cache
def _forbes(count: int) -> np.ndarray:
    """Coefficients (count, count) of the auxiliary polynomials P_j in Q_m, column m, see `qbfs`."""
    f, g, h = [2.0, math.sqrt(19) / 2], [-0.5], []
    basis = np.eye(count)
    for m in range(count):
        if m > 1:
            h.append(-m * (m - 1) / (2 * f[m - 2]))
            g.append(-(1 + g[m - 2] * h[m - 2]) / f[m - 1])
            f.append(math.sqrt(m * (m + 1) + 3 - g[m - 1] ** 2 - h[m - 2] ** 2))
            basis[m] -= h[m - 2] * basis[m - 2]
        if m > 0:
            basis[m] -= g[m - 1] * basis[m - 1]
        basis[m] /= f[m]
    return basis.T


def qbfs(w: Point, shape: Shape) -> tuple[Array, Array]:
    """Conic and Forbes' polynomials Q_m along its normal, whose slopes are orthonormal on a sphere.

    z = ... + x (1 - x) s sum_m a_(m + 1) Q_m(x), with x = (r / a_0)^2, a_0 in mm, and s = sqrt(1 -
    k c^2 r^2) / sqrt(1 - (1 + k) c^2 r^2), which is 1 / cosine of the slope of the conic. The sum
    is evaluated by Clenshaw's recurrence in P_0 = 2, P_1 = 6 - 8 x, P_(m + 1) = (2 - 4 x) P_m -
    P_(m - 1), which has no large terms. Source: Forbes, Opt. Express 15, 5218 (2007) and 18, 19700
    (2010), as in Zemax.
    """
    r2 = square(w)
    z, argument = _conic(r2, shape.curvature, shape.conic)
    if len(shape.coefficients) < 2:
        return z, argument
    inverse = _inverse(shape.coefficients[0])
    x = r2 * inverse * inverse
    basis = _forbes(len(shape.coefficients) - 1)
    last, total = jnp.zeros_like(x), jnp.zeros_like(x)
    for b in tensordot(jnp.asarray(basis, z.dtype), shape.coefficients[1:], 1)[::-1]:
        last, total = total, b + (2 - 4 * x) * total - last
    steep = root(argument + shape.curvature**2 * r2) / root(argument)
    return z + x * (1 - x) * steep * 2 * (total + last), argument


def _inverse(radius: Array) -> Array:
    """1 / radius; 0 for the radius 0 of padded rows."""
    return jnp.where(radius == 0, 0, 1 / jnp.where(radius == 0, 1, radius))


class Form(NamedTuple):
    """A kind of surface.

    function: (w, shape) -> (sag in mm, argument), see the top of this file.
    symmetry: "rotational" about the z axis, "bilateral" for x -> -x, or "none".
    powers: names of the coefficients in files, in order.
    named: separate keys in files for the first coefficients.
    round: True if the conic is a function of r, so that the surface ends at a circular rim.
    """

    function: Callable[[Point, Shape], tuple[Array, Array]]
    symmetry: Literal["rotational", "bilateral", "none"]
    powers: tuple[int | str, ...]
    named: tuple[str, ...] = ()
    round: bool = True


_EVEN = tuple(range(2, 400, 2))
_XY = tuple(f"x{i}y{j}" for i, j in powers_xy(230))
FORMS: dict[str, Form] = {
    "asphere": Form(asphere, "rotational", _EVEN),
    "odd_asphere": Form(odd_asphere, "rotational", tuple(range(1, 200))),
    "biconic": Form(biconic, "bilateral", _EVEN, ("curvature_x", "conic_x"), round=False),
    "toroid": Form(toroid, "bilateral", _EVEN, ("curvature_x",), round=False),
    "polynomial_xy": Form(polynomial_xy, "none", _XY),
    "linear": Form(linear, "bilateral", ("y",)),
    "zernike": Form(zernike, "none", tuple(range(1, 92)), ("norm_radius",)),
    "qbfs": Form(qbfs, "rotational", tuple(range(100)), ("norm_radius",)),
}
