"""Zernike polynomials on the unit disc; functions of the pupil fitted with them; and wavefronts as
their coefficients.

The terms are those of Noll, JOSA 66, 207 (1976): orthonormal with respect to the mean over the
disc, with the azimuth measured from the x axis. They are evaluated without computing the azimuth.
r^m cos(m a) and r^m sin(m a) are the real and imaginary parts of (x + i y)^m. The remaining radial
factor is a Jacobi polynomial in r^2, and a three-term recurrence gives it to rounding at any degree
(Boyd and Yu, J. Comput. Phys. 230, 1408 (2011)).

The path difference of `wavefront` over the stop is W = sum of c_j Z_j, fitted in least squares with
the unclipped light as the weight. Pupil coordinates are those of the stop in units of its
semi-diameter; angles are measured from the x axis. OpticStudio calls Noll's terms Standard. Source
for the order of the fringe terms: Wyant and Creath, Basic Wavefront Aberration Theory (1992).
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.forms import fringe_terms, noll_terms
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import einsum, matmul, program
from ..pupil.patterns import disc
from ..rays.known import Known, known_rays
from ..rays.status import Status, reaches_sensor
from ..rays.trace import trace_bundle
from .rounding import warn_of_paths
from .wavefront import path_differences

# Ridge of the normal equations: this many machine epsilons of their largest diagonal element.
_RIDGE = 16
# Nodes along a radius, and azimuths on half the disc, of the fit of a wavefront: no aliasing
# between terms up to the degree 24.
_ORDER, _AZIMUTHS = 13, 26
_MOST = 91


@functools.partial(program, static_argnames="degree")
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
    with jax.core.eval_context():
        grid = np.stack(np.meshgrid(nodes, nodes, indexing="ij")) * _EDGE
        values = np.asarray(zernike(jnp.asarray(grid, float), degree))
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


def zernike_standard(lens: Lens, scene: Scene, count: int = 37) -> Array:
    """Coefficients of Noll's Zernike polynomials, which are orthonormal over the disc: the squares
    of all but the first add up to the mean square wavefront error.

    lens, scene: the lens, and object points with their wavelengths.
    count: number of coefficients, 1 to 91.

    Returns (..., W, count), waves; inf where the chief ray fails, or where so many rays fail that
    the fit is not determined. Differentiable in every mode. Warns of float32 as `wavefront` does.
    """
    return _coefficients(lens, scene, tuple(range(_checked(count, _MOST))))


def zernike_fringe(lens: Lens, scene: Scene, count: int = 37) -> Array:
    """Coefficients of the fringe Zernike polynomials, which are 1 at the edge of the disc.

    lens, scene: as in `zernike_standard`.
    count: number of coefficients, 1 to 37.

    Returns (..., W, count), waves; else as `zernike_standard`.
    """
    count = _checked(count, 37)
    terms = fringe_terms()[:count]
    most = max(n for n, _ in terms)
    noll = noll_terms(most)
    scale = np.array([np.sqrt(n + 1 if m == 0 else 2 * (n + 1)) for n, m in terms])
    # Only these terms are fitted, as the standard coefficients are a fit of their own terms.
    rows = tuple(noll.index(term) for term in terms)
    found = _coefficients(lens, scene, rows)
    return found * jnp.expand_dims(scale, range(found.ndim - 1))


def _checked(count: int, most: int) -> int:
    """`count` as an int. ValueError if it is not a whole number from 1 to `most`."""
    if not isinstance(count, int | np.integer) or not 1 <= count <= most:
        raise ValueError(f"count: expected a whole number from 1 to {most}, got {count!r}")
    return int(count)


def _coefficients(lens: Lens, scene: Scene, rows: tuple[int, ...]) -> Array:
    """Coefficients (..., W, P) of terms given by their indices in Noll's order, counted from 0."""
    scene = checked_scene(lens, scene)
    warn_of_paths(lens, scene)
    points = np.concatenate([np.zeros((1, 2)), disc(_ORDER, _AZIMUTHS)[0]])  # the chief ray first
    aimed = jnp.asarray(points.T, lens.curvature.dtype)
    return _least_squares(lens, scene, aimed, rows, known_rays(lens, scene, aimed))


@functools.partial(jit, wanted=LARGE, static_argnames="rows")
def _least_squares(
    lens: Lens, scene: Scene, aimed: Array, rows: tuple[int, ...], known: Known
) -> Array:
    """The least-squares fit: the normal equations of the terms, solved for each point and
    wavelength. aimed: (2, 1 + Q), stop points of the chief ray and the others."""
    _, weights = disc(_ORDER, _AZIMUTHS)
    degree = next(n for n in range(40) if (n + 1) * (n + 2) // 2 > max(rows))
    dtype = lens.curvature.dtype
    basis = zernike(aimed[:, 1:], degree)[np.array(rows)]

    def one(point: Scene, known: Known) -> Array:
        bundle = trace_bundle(lens, point, tuple(aimed), known)
        opd, status, _ = path_differences(lens, scene.wavelengths, bundle)
        light = jnp.asarray(weights, dtype)[None] * (status[:, 1:] == Status.OK).astype(dtype)
        whole = reaches_sensor(status[:, 0])
        enough = whole & (jnp.sum(light > 0, axis=-1) > 2 * len(rows))
        light = jnp.where(enough[:, None], light, jnp.asarray(weights, dtype)[None])
        normal = einsum("wq,pq,rq->wpr", light, basis, basis)
        right = einsum("wq,pq,wq->wp", light, basis, opd[:, 1:])
        found = jnp.linalg.solve(normal, right[..., None])[..., 0]
        return jnp.where(enough[:, None], found, jnp.inf)

    return over_points(one, scene, known)
