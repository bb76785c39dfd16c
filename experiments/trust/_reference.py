"""Converged moments of a spot and their gradients from the sequential trace alone.

Nothing of the Fermat solver is used, and no ray is aimed: the integral over the stop is written
in the coordinates q where a ray crosses a plane before the lens, with the Jacobian |dp/dq| of
the point p where Snell's law brings it on the stop. The region of integration is what the stop
and the clear apertures leave of that plane. Its edge is found by bisection along half-lines
from a point inside; where two apertures meet, it has a corner and a panel of Gauss nodes ends.
Derivatives are central differences of that integral, its edge following the lens.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drt_jax import Lens

from .snell import trace_snell

# The plane of q lies this far before the first vertex (mm).
_LEAD = 5.0
_PANELS, _AZIMUTHS, _RADII = 6, 12, 16
_BISECTIONS = 50
# Half-lines along which the edge is searched for corners; rays of one compiled call.
_SEARCH, _CALL = 121, _PANELS * _AZIMUTHS * _RADII
# Steps of the differences. The variance is nearly quadratic in both, so that the third
# derivative, all that central differences leave, is small; Richardson's rule removes that too.
_STEP_CURVATURE, _STEP_LENGTH = 2e-7, 2e-4


class Moments(NamedTuple):
    """Of one colour, with derivatives by (curvatures, thicknesses and the sensor).

    sigma: RMS spot radius, mm.
    centroid: its y, mm.
    gradient: (2, P) of both.
    error: change of both values, relative to sigma, when every node moves.
    gradient_error: change of sigma's gradient, relative to its norm, when the step of the
        differences doubles.
    """

    sigma: float
    centroid: float
    gradient: np.ndarray
    error: float
    gradient_error: float


def flatten(lens: Lens) -> Array:
    """Curvatures, thicknesses and the sensor of a lens (or of a gradient) in one array (P,)."""
    return jnp.concatenate([lens.curvature[:-1], lens.thickness, lens.sensor[None]])


def _moved(lens: Lens, values: Array) -> Lens:
    """The lens with `values` (P,) as in `flatten`."""
    curvature = lens.curvature.at[:-1].set(values[: lens.count])
    return dataclasses.replace(
        lens, curvature=curvature, thickness=values[lens.count : -1], sensor=values[-1]
    )


def _trace(lens: Lens, scene: Array, q: Array) -> tuple[Array, Array]:
    """Hits (S + 1, 2) of the ray through q (2,), mm; `scene`: field, 1/distance, wavelength."""
    field, vergence, wavelength = scene
    point = jnp.array([q[0], q[1], -_LEAD])
    across = vergence * q[1] + jnp.tan(field)
    toward = jnp.array([vergence * q[0], across, 1 - vergence * _LEAD])
    hits, ok = trace_snell(lens, wavelength, point, toward / jnp.linalg.norm(toward))
    return hits[:, :2], ok


@jax.jit
def _hits(lens: Lens, scene: Array, q: Array) -> tuple[Array, Array]:
    return jax.vmap(partial(_trace, lens, scene))(q)


@jax.jit
def _spots(lens: Lens, scene: Array, q: Array) -> tuple[Array, Array]:
    """Hits on the sensor (N, 2), mm, and |dp/dq| on the stop (N,)."""

    def one(q):
        def ends(q):
            hits = _trace(lens, scene, q)[0]
            return hits[lens.stop], hits[-1]

        jacobian, spot = jax.jacfwd(ends, has_aux=True)(q)
        determinant = jacobian[0, 0] * jacobian[1, 1] - jacobian[0, 1] * jacobian[1, 0]
        return spot, jnp.abs(determinant)

    return jax.vmap(one)(q)


@dataclasses.dataclass(frozen=True)
class _Pupil:
    """What a scene leaves of the plane of q, in polar coordinates about (0, height)."""

    lens: Lens
    scene: Array
    height: float
    reach: float

    def points(self, azimuth: np.ndarray, radius: np.ndarray) -> np.ndarray:
        across = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        return radius[..., None] * across + np.array([0.0, self.height])

    def excess(self, q: np.ndarray, lens: Lens | None = None) -> np.ndarray:
        """(N, S): r^2 over its limit, less 1, at the stop and the apertures; > 0 is outside."""
        padded = np.zeros((_CALL, 2))
        padded[: len(q)] = q
        hits, ok = _hits(lens or self.lens, self.scene, padded)
        radius2 = np.sum(np.asarray(hits)[: len(q), :-1] ** 2, axis=-1)
        limit2 = np.asarray(self.lens.semi_diameter)[:-1] ** 2
        return np.where(np.asarray(ok)[: len(q), None], radius2 / limit2 - 1, 1.0)

    def edge(self, azimuth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where each half-line leaves the region, mm, and the surface whose aperture ends it."""
        low, high = np.zeros_like(azimuth), np.full_like(azimuth, self.reach)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            inside = np.all(self.excess(self.points(azimuth, middle)) <= 0, axis=1)
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        return low, np.argmax(self.excess(self.points(azimuth, high)), axis=1)

    def panels(self) -> np.ndarray:
        """Ends of the panels from -pi/2 to pi/2: the corners, and points between them."""
        azimuth = np.linspace(-np.pi / 2, np.pi / 2, _SEARCH)
        aperture = self.edge(azimuth)[1]
        jumps = np.flatnonzero(np.diff(aperture))
        if jumps.size > _PANELS - 1:
            raise ValueError(f"the pupil has {jumps.size} corners; expected at most {_PANELS - 1}")
        low, high = azimuth[jumps], azimuth[jumps + 1]
        for _ in range(_BISECTIONS if jumps.size else 0):
            middle = (low + high) / 2
            before = self.edge(middle)[1] == aperture[jumps]
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        ends = np.concatenate([azimuth[:1], low, azimuth[-1:]])
        while ends.size < _PANELS + 1:
            k = np.argmax(np.diff(ends))
            ends = np.insert(ends, k + 1, (ends[k] + ends[k + 1]) / 2)
        return ends


def _integral(pupil: _Pupil):
    """A function of a lens near that of `pupil`: variance (mm^2) and height of the centroid."""
    ends = pupil.panels()
    x, w = np.polynomial.legendre.leggauss(_AZIMUTHS)
    half = np.diff(ends)[:, None] / 2
    azimuth, width = (ends[:-1, None] + half * (1 + x)).ravel(), (half * w).ravel()
    radius, aperture = pupil.edge(azimuth)
    rows = np.arange(azimuth.size)
    h = 1e-4  # mm: the slope only speeds up the step to the moved edge
    outer, inner = (
        pupil.excess(pupil.points(azimuth, radius + s))[rows, aperture] for s in (h, -h)
    )
    slope = (outer - inner) / (2 * h)
    t, weight = np.polynomial.legendre.leggauss(_RADII)
    t, weight = (1 + t) / 2, weight / 2

    def values(lens: Lens) -> np.ndarray:
        edge = radius
        for _ in range(4):
            edge = edge - pupil.excess(pupil.points(azimuth, edge), lens)[rows, aperture] / slope
        q = pupil.points(azimuth[:, None], edge[:, None] * t)
        spot, area = (np.asarray(a) for a in _spots(lens, pupil.scene, q.reshape(-1, 2)))
        area = area * (width[:, None] * edge[:, None] ** 2 * t * weight).ravel()
        area = area / np.sum(area)
        mean = np.sum(area * spot[:, 1])  # x -> -x: the other half is the mirror image
        return np.array([np.sum(area * (spot[:, 0] ** 2 + (spot[:, 1] - mean) ** 2)), mean])

    return values


def _gradient(values, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """(2, P) derivatives of variance and centroid, and their change with the step."""
    start = np.asarray(flatten(lens))
    columns, changes = [], []
    for k in range(start.size):
        step = _STEP_CURVATURE if k < lens.count else _STEP_LENGTH
        unit = step * np.eye(start.size)[k]
        near, far, farther = (
            (
                values(_moved(lens, jnp.asarray(start + n * unit)))
                - values(_moved(lens, jnp.asarray(start - n * unit)))
            )
            / (2 * n * step)
            for n in (1, 2, 4)
        )
        columns.append((4 * near - far) / 3)
        changes.append(columns[-1] - (4 * far - farther) / 3)
    return np.stack(columns, axis=1), np.stack(changes, axis=1)


def reference(
    lens: Lens, field: float, distance: float, wavelengths: Sequence[float], gradient: bool = True
) -> list[Moments]:
    """Moments of each colour; `field` in radians along y, `distance` in mm, wavelengths in um.

    The lens is centred and in float64; without `gradient` it is 0. ValueError if no ray passes.
    """
    semi = np.asarray(lens.semi_diameter)
    reach = 3 * float(np.max(semi[np.isfinite(semi)])) + 2 * _LEAD
    results = []
    for wavelength in wavelengths:
        scene = jnp.array([field, 1 / distance, wavelength])
        scan = _Pupil(lens, scene, 0.0, reach)
        heights = np.linspace(-reach, reach, _CALL)
        q = np.stack([np.zeros_like(heights), heights], axis=1)
        inside = heights[np.all(scan.excess(q) <= 0, axis=1)]
        if not inside.size:
            raise ValueError(f"no ray at {wavelength:g} um reaches the sensor")
        middle, other = (
            _integral(dataclasses.replace(scan, height=inside[0] + part * (inside[-1] - inside[0])))
            for part in (0.5, 0.57)
        )
        value, again = middle(lens), other(lens)
        sigma = np.sqrt(value[0])
        slopes = changes = np.zeros((2, flatten(lens).size))
        if gradient:
            slopes, changes = _gradient(middle, lens)
            slopes[0], changes[0] = slopes[0] / (2 * sigma), changes[0] / (2 * sigma)
        error = max(abs(np.sqrt(again[0]) - sigma), abs(again[1] - value[1])) / sigma
        norm = max(float(np.linalg.norm(slopes[0])), np.finfo(float).tiny)
        results.append(
            Moments(
                float(sigma),
                float(value[1]),
                slopes,
                float(error),
                float(np.linalg.norm(changes[0])) / norm,
            )
        )
    return results
