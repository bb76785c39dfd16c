"""Zernike polynomials on the unit disc, and functions of the pupil fitted with them.

The terms are those of Noll, JOSA 66, 207 (1976): orthonormal with respect to the mean over the
disc, with the azimuth measured from the x axis. They are evaluated without computing the azimuth.
r^m cos(m a) and r^m sin(m a) are the real and imaginary parts of (x + i y)^m. The remaining radial
factor is a Jacobi polynomial in r^2, and a three-term recurrence gives it to rounding at any degree
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

# Ridge of the normal equations: this many machine epsilons of their largest diagonal element.
_RIDGE = 16


def zernike(points: Array, degree: int) -> Array:
    """Zernike polynomials up to a degree, in Noll's order.

    points: (2, ...), x and y. The terms are polynomials, so points outside of the unit disc are
        allowed.
    degree: largest degree n.

    Returns values (P, ...), P = (degree + 1) (degree + 2) / 2.
    """
    terms = np.array(noll_terms(degree))
    n, m = terms[:, 0], np.abs(terms[:, 1])
    # (r^m cos m a, r^m sin m a) from those of m - 1, by a complex product with x + i y.
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
    """Radial factors: the radial polynomial of degree m + 2 k is r^m P_k^(0, m)(t), t = 2 r^2 - 1.

    Returns P_k^(0, m)(t), (degree // 2 + 1, degree + 1, ...), with k and m as the first axes, by
    the three-term recurrence in k for all m together.
    """
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


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Polynomials:
    """D functions of a point p in a plane, for each of W wavelengths, as Zernike polynomials of
    u = (p - centre) / scale.

    centre, scale: (2, W).
    coefficients: (W, D, P), in Noll's order.
    degree: static, largest degree.
    """

    centre: Array
    scale: Array
    coefficients: Array
    degree: int = dataclasses.field(metadata={"static": True})

    def at(self, points: Array) -> Array:
        """Values (D, W, Q) of the functions at points (2, W or 1, Q)."""
        basis = zernike((points - self.centre[..., None]) / self.scale[..., None], self.degree)
        return einsum("wdp,pwq->dwq", self.coefficients, basis)

    def on_grid(
        self, start: Array, step: Array, side: np.ndarray, slopes: slice
    ) -> tuple[Array, Array, Array]:
        """Values and derivatives of the functions on a rectangular grid.

        start, step: (2, W). The grid is u = start + step side in both components.
        side: (N,), grid positions, static.
        slopes: which of the D functions are differentiated.

        Returns values (D, W, N, N) [y, x], and the derivatives of the functions `slopes` by u_x and
        by u_y, of the same form. A function is a sum of products T_i(x) T_j(y) of Chebyshev
        polynomials, so the grid costs two matrix products.
        """
        dtype = self.coefficients.dtype
        square = jnp.asarray(_in_chebyshev(self.degree), dtype)
        terms = einsum("wdp,pij->wdij", self.coefficients, square)
        u = start[..., None] + step[..., None] * jnp.asarray(side, dtype)[None, None]
        (x, dx), (y, dy) = (chebyshev(part / _EDGE, self.degree) for part in u)

        def product(terms: Array, a: Array, b: Array) -> Array:
            return jnp.moveaxis(einsum("wdij,iwx,jwy->wdyx", terms, a, b), 0, 1)

        sloped = terms[:, slopes] / _EDGE
        return product(terms, x, y), product(sloped, dx, y), product(sloped, x, dy)


def chebyshev(t: Array, degree: int) -> tuple[Array, Array]:
    """Chebyshev polynomials T_k(t), k = 0 to `degree`, and their derivatives, (degree + 1, ...)
    each."""
    values, slopes = [jnp.ones_like(t), t], [jnp.zeros_like(t), jnp.ones_like(t)]
    for _ in range(degree - 1):
        slopes.append(2 * (values[-1] + t * slopes[-1]) - slopes[-2])
        values.append(2 * t * values[-1] - values[-2])
    return jnp.stack(values[: degree + 1]), jnp.stack(slopes[: degree + 1])


# `_in_chebyshev` represents polynomials on the square |x|, |y| <= _EDGE.
_EDGE = 1.25


@functools.cache
def _in_chebyshev(degree: int) -> np.ndarray:
    """Coefficients (P, degree + 1, degree + 1) of each Zernike term as a sum of products
    T_i(x / _EDGE) T_j(y / _EDGE)."""
    nodes = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    rows = np.polynomial.chebyshev.chebvander(nodes, degree).T * 2 / (degree + 1)
    rows[0] /= 2
    with jax.ensure_compile_time_eval():
        grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij")) * _EDGE
        values = np.asarray(zernike(jnp.asarray(grid), degree))
    return np.einsum("pab,ia,jb->pij", values, rows, rows)


def fitted(points: Array, values: Array, weights: Array, degree: int, azimuths: int) -> Polynomials:
    """Weighted least-squares fit of polynomials to values at points.

    points: (2, W or 1, Q).
    values: (D, W, Q).
    weights: (W, Q), none below 0.
    degree: largest degree of the polynomials.
    azimuths: largest azimuthal order |m| of the terms that are used.

    The disc of the polynomials is that of a uniformly filled ellipse with the same centroid and
    variances along x and y as the weighted points. This makes the terms nearly orthogonal; another
    disc would only change the rounding.
    """
    points = jnp.broadcast_to(points, (2, *values.shape[1:]))
    weights = weights / jnp.sum(weights, axis=-1, keepdims=True)
    centre = jnp.sum(weights[None] * points, axis=-1)
    # A uniformly filled disc has the variance radius^2 / 4 along each axis.
    spread = jnp.sum(weights[None] * (points - centre[..., None]) ** 2, axis=-1)
    centre, scale = jax.lax.stop_gradient((centre, 2 * jnp.sqrt(spread)))
    basis = zernike((points - centre[..., None]) / scale[..., None], degree)
    kept = np.array([k for k, (_, m) in enumerate(noll_terms(degree)) if abs(m) <= azimuths])
    terms, basis = len(basis), basis[kept]
    weighted = basis * weights[None]
    normal = einsum("pwq,rwq->wpr", weighted, basis)
    least = _RIDGE * float(jnp.finfo(values.dtype).eps)
    diagonal = jnp.max(jnp.diagonal(normal, 0, 1, 2), axis=-1)[:, None, None]
    normal = normal + least * diagonal * jnp.eye(len(basis), dtype=values.dtype)[None]

    def solution(rest: Array) -> Array:
        """Coefficients (W, D, P) of the fit to values (D, W, Q)."""
        right = einsum("pwq,dwq->wpd", weighted, rest)
        return jnp.swapaxes(jax.vmap(_solved)(normal, right), 1, 2)

    found = solution(values)
    if least > 1e-12:  # float32: one step of iterative refinement
        found = found + solution(values - einsum("wdp,pwq->dwq", found, basis))
    coefficients = jnp.zeros((*found.shape[:2], terms), found.dtype).at[..., kept].set(found)
    return Polynomials(centre, scale, coefficients, degree)


def _solved(matrix: Array, right: Array) -> Array:
    """Solution x (P, D) of matrix (P, P) x = right (P, D), for a positive definite matrix, with
    derivatives."""
    known = jax.lax.stop_gradient(matrix)
    return jax.lax.custom_linear_solve(
        lambda x: matmul(matrix, x), right, lambda _, b: _by_cholesky(known, b), symmetric=True
    )


# The batched LAPACK call waits for XLA's threads from inside of one of them. Two such calls at
# once, as under `jax.vmap`, deadlock on a machine with two threads; so the batch runs sequentially.
@jax.custom_batching.sequential_vmap
def _by_cholesky(matrix: Array, right: Array) -> Array:
    return jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right)
