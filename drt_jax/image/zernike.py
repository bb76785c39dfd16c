"""Zernike polynomials on the unit disc, and functions of the pupil fitted with them.

The terms are those of Noll, JOSA 66, 207 (1976): orthonormal over the disc with the mean as the
product, azimuth from the x axis. They are evaluated without the azimuth: r^m cos(m a) and
r^m sin(m a) are the real and imaginary parts of (x + i y)^m, and what is left of the radial part is
a Jacobi polynomial in r^2, which a recurrence of three terms gives to rounding at any degree
(Boyd and Yu, J. Comput. Phys. 230, 1408 (2011)).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import noll_terms
from ..numerics import einsum, matmul

# Normal equations are solved to this many last digits of their largest element.
_RIDGE = 16


def zernike(points: Array, degree: int) -> Array:
    """The terms up to a degree (P, ...) at points (2, ...) of the unit disc, in Noll's order; they
    go on beyond the disc as the polynomials that they are. P = (degree + 1) (degree + 2) / 2."""
    terms = np.array(noll_terms(degree))
    n, m = terms[:, 0], np.abs(terms[:, 1])
    # (r^m cos m a, r^m sin m a) from m - 1 to m, all at once: products of complex numbers.
    x, y = points
    trig = [(jnp.ones_like(x), jnp.zeros_like(x))]
    for _ in range(degree):
        c, s = trig[-1]
        trig.append((x * c - y * s, x * s + y * c))
    azimuthal = jnp.stack([a for pair in trig for a in pair])
    radial = _jacobi(2 * (x * x + y * y) - 1, degree)
    scale = np.sqrt(np.where(m == 0, 1, 2) * (n + 1)).reshape(-1, *[1] * x.ndim)
    rows = radial.reshape(-1, *x.shape)[(n - m) // 2 * (degree + 1) + m]
    return jnp.asarray(scale, x.dtype) * rows * azimuthal[2 * m + (terms[:, 1] < 0)]


def _jacobi(t: Array, degree: int) -> Array:
    """P_k^(0, m)(t), (degree // 2 + 1, degree + 1, ...) by k and m: the radial polynomial of degree
    m + 2 k over r^m, by the recurrence of three terms in k, for all m together."""
    m = np.arange(degree + 1.0).reshape(-1, *[1] * t.ndim)
    number = functools.partial(jnp.asarray, dtype=t.dtype)
    t = t[None]
    terms = [jnp.broadcast_to(jnp.ones_like(t), (degree + 1, *t.shape[1:]))]
    terms.append((number(m + 2) * t - number(m)) / 2)
    for k in range(2, degree // 2 + 1):
        s = 2 * k + m
        lead = 2 * k * (k + m) * (s - 2)
        slope, shift = (s - 1) * s * (s - 2) / lead, -(s - 1) * m * m / lead
        back = 2 * (k - 1) * (k + m - 1) * s / lead
        terms.append((number(slope) * t + number(shift)) * terms[-1] - number(back) * terms[-2])
    return jnp.stack(terms[: degree // 2 + 1])


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("centre", "scale", "coefficients"),
    meta_fields=("degree",),
)
@dataclasses.dataclass(frozen=True)
class Polynomials:
    """D functions of two variables p for each of W wavelengths: Zernike polynomials of
    u = (p - centre) / scale.

    centre, scale: (2, W). coefficients: (W, D, P), in Noll's order. degree: static.
    """

    centre: Array
    scale: Array
    coefficients: Array
    degree: int

    def at(self, points: Array) -> Array:
        """The functions (D, W, Q) at points (2, W or 1, Q)."""
        basis = zernike((points - self.centre[..., None]) / self.scale[..., None], self.degree)
        return einsum("wdp,pwq->dwq", self.coefficients, basis)

    def on_grid(
        self, start: Array, step: Array, side: np.ndarray, slopes: slice
    ) -> tuple[Array, Array, Array]:
        """The functions (D, W, N, N), [y, x], and the derivatives of `slopes` of them by u in x and
        in y, where u is start + step side for both components: start, step (2, W), side (N,)."""
        dtype = self.coefficients.dtype
        square = jnp.asarray(_tochebyshev(self.degree), dtype)
        terms = einsum("wdp,pij->wdij", self.coefficients, square)
        u = start[..., None] + step[..., None] * jnp.asarray(side, dtype)[None, None]
        (x, dx), (y, dy) = (chebyshev(part / _EDGE, self.degree) for part in u)

        def product(terms: Array, a: Array, b: Array) -> Array:
            return jnp.moveaxis(einsum("wdij,iwx,jwy->wdyx", terms, a, b), 0, 1)

        some = terms[:, slopes] / _EDGE
        return product(terms, x, y), product(some, dx, y), product(some, x, dy)


def chebyshev(t: Array, degree: int) -> tuple[Array, Array]:
    """T_k(t) and their derivatives, (degree + 1, ...)."""
    values, slopes = [jnp.ones_like(t), t], [jnp.zeros_like(t), jnp.ones_like(t)]
    for _ in range(degree - 1):
        slopes.append(2 * (values[-1] + t * slopes[-1]) - slopes[-2])
        values.append(2 * t * values[-1] - values[-2])
    return jnp.stack(values[: degree + 1]), jnp.stack(slopes[: degree + 1])


# Products of Chebyshev polynomials stand for Zernike polynomials on a square of twice this side.
_EDGE = 1.25


@functools.cache
def _tochebyshev(degree: int) -> np.ndarray:
    """(P, degree + 1, degree + 1): each term as a sum of products T_i(x / _EDGE) T_j(y / _EDGE)."""
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    rows = np.polynomial.chebyshev.chebvander(nodes, degree).T * 2 / (degree + 1)
    rows[0] /= 2
    with jax.ensure_compile_time_eval():
        grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij")) * _EDGE
        values = np.asarray(zernike(jnp.asarray(grid), degree))
    return np.einsum("pab,ia,jb->pij", values, rows, rows)


def fitted(points: Array, values: Array, weights: Array, degree: int, azimuths: int) -> Polynomials:
    """The polynomials that come nearest to values (D, W, Q) at points (2, W or 1, Q), in the least
    squares with weights (W, Q), none below 0. azimuths: the largest m of their terms.

    Their disc is that of an even body with the weights' centre and variances along x and y, so that
    the terms are nearly orthogonal; which disc it is changes nothing but rounding.
    """
    points = jnp.broadcast_to(points, (2, *values.shape[1:]))
    weights = weights / jnp.sum(weights, axis=-1, keepdims=True)
    centre = jnp.sum(weights[None] * points, axis=-1)
    # An even disc has variances of a quarter of its radius squared.
    spread = jnp.sum(weights[None] * (points - centre[..., None]) ** 2, axis=-1)
    centre, scale = jax.lax.stop_gradient((centre, 2 * jnp.sqrt(spread)))
    basis = zernike((points - centre[..., None]) / scale[..., None], degree)
    some = np.array([k for k, (_, m) in enumerate(noll_terms(degree)) if abs(m) <= azimuths])
    terms, basis = len(basis), basis[some]
    weighted = basis * weights[None]
    normal = einsum("pwq,rwq->wpr", weighted, basis)
    least = _RIDGE * float(jnp.finfo(values.dtype).eps)
    diagonal = jnp.max(jnp.diagonal(normal, 0, 1, 2), axis=-1)[:, None, None]
    normal = normal + least * diagonal * jnp.eye(len(basis), dtype=values.dtype)[None]

    def solution(rest: Array) -> Array:
        right = einsum("pwq,dwq->wpd", weighted, rest)
        return jnp.swapaxes(jax.vmap(_solved)(normal, right), 1, 2)

    found = solution(values)
    if least > 1e-12:  # float32: once more for what the first solution leaves
        found = found + solution(values - einsum("wdp,pwq->dwq", found, basis))
    every = jnp.zeros((*found.shape[:2], terms), found.dtype).at[..., some].set(found)
    return Polynomials(centre, scale, every, degree)


def _solved(matrix: Array, right: Array) -> Array:
    """The solution (P, D) of matrix (P, P) x = right, for a positive definite matrix."""
    known = jax.lax.stop_gradient(matrix)
    return jax.lax.custom_linear_solve(
        lambda x: matmul(matrix, x), right, lambda _, b: _by_cholesky(known, b), symmetric=True
    )


# LAPACK's loop over several matrices waits for XLA's threads inside of one of them. Two such loops
# at once, as under `jax.vmap`, wait for each other for ever where there are two threads.
@jax.custom_batching.sequential_vmap
def _by_cholesky(matrix: Array, right: Array) -> Array:
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right)
