"""Converged moments of a spot and their gradients from the sequential trace alone.

Nothing of the Fermat solver is used, and no ray is aimed: the integral over the stop is written
in the coordinates q where a ray crosses a plane before the lens, with the Jacobian |dp/dq| of
the point p where Snell's law brings it on the stop. The region of integration is what the stop
and the clear apertures leave of that plane. Its edge is found by bisection along half-lines
from a point inside; where two apertures meet, it has a corner and a panel of Gauss nodes ends.
Derivatives are those of the plain trace by automatic differentiation, the edge following the lens.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
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
_PANELS, _CORNERS, _AZIMUTHS, _RADII = 6, 5, 12, 24
_BISECTIONS = 50
# Points along a diameter, half-lines along which the edge is searched for corners.
_SCAN, _SEARCH = 1152, 121


class Moments(NamedTuple):
    """Of one colour, with derivatives by (curvatures, thicknesses and the sensor).

    sigma: RMS spot radius, mm. centroid: its y, mm. gradient: (2, P) of both. error: change of
    both values, relative to sigma, when every node moves. gradient_error: that of sigma's gradient,
    relative to its norm.
    """

    sigma: float
    centroid: float
    gradient: np.ndarray
    error: float
    gradient_error: float


def flatten(lens: Lens) -> Array:
    """Curvatures, thicknesses and the sensor of a lens (or of a gradient) in one array (P,)."""
    return jnp.concatenate([lens.curvature[:-1], lens.thickness, lens.sensor[None]])


def changed(lens: Lens, values: Array) -> Lens:
    """The lens with `values` (P,) as in `flatten`."""
    curvature, thickness, sensor = jnp.split(values, [lens.count, len(values) - 1])
    curvature = lens.curvature.at[:-1].set(curvature)
    return dataclasses.replace(lens, curvature=curvature, thickness=thickness, sensor=sensor[0])


def _trace(lens: Lens, scene: Array, q: Array) -> tuple[Array, Array]:
    """Hits (S + 1, 2) of the ray through q (2,), mm; `scene`: field, 1/distance, wavelength."""
    field, vergence, wavelength = scene
    point = jnp.append(q, -_LEAD)
    toward = vergence * point + jnp.stack([0 * field, jnp.tan(field), 0 * field + 1])
    hits, ok = trace_snell(lens, wavelength, point, toward / jnp.linalg.norm(toward))
    return hits[:, :2], ok


def _excess(lens: Lens, scene: Array, q: Array) -> Array:
    """(S,): r^2 over its limit, less 1, at the stop and the apertures; > 0 is outside."""
    hits, ok = _trace(lens, scene, q)
    limit2 = lens.semi_diameter[:-1] ** 2
    return jnp.where(ok, jnp.sum(hits[:-1] ** 2, axis=1) / limit2 - 1, 1)


def _bisected(low: Array, high: Array, before: Callable[[Array], Array]) -> tuple[Array, Array]:
    """The ends of an interval narrowed to where `before` turns from true to false."""

    def narrow(_, ends):
        middle = (ends[0] + ends[1]) / 2
        first = before(middle)
        return jnp.where(first, middle, ends[0]), jnp.where(first, ends[1], middle)

    return jax.lax.fori_loop(0, _BISECTIONS, narrow, (low, high))


class _Pupil(NamedTuple):
    """What a scene leaves of the plane of q, in polar coordinates about (0, height)."""

    lens: Lens
    scene: Array
    height: Array
    reach: Array

    def point(self, azimuth: Array, radius: Array) -> Array:
        """q, mm."""
        up = radius * jnp.sin(azimuth) + self.height
        return jnp.stack([radius * jnp.cos(azimuth), up])

    def excess(self, azimuth: Array, radius: Array) -> Array:
        """`_excess` at a point."""
        return _excess(self.lens, self.scene, self.point(azimuth, radius))

    def edge(self, azimuth: Array) -> tuple[Array, Array]:
        """Where a half-line leaves the region, mm, and the surface whose aperture ends it."""
        start = jnp.zeros_like(self.reach)
        within = partial(self.excess, azimuth)
        low, high = _bisected(start, self.reach, lambda radius: jnp.all(within(radius) <= 0))
        return low, jnp.argmax(within(high))

    def corners(self) -> tuple[Array, Array]:
        """Where the aperture that ends the region changes in each of `_SEARCH` - 1 intervals of
        azimuth, and whether it does."""
        azimuth = jnp.linspace(-jnp.pi / 2, jnp.pi / 2, _SEARCH)
        aperture = jax.vmap(self.edge)(azimuth)[1]

        def corner(low, high, first):
            return _bisected(low, high, lambda middle: self.edge(middle)[1] == first)[0]

        found = jax.vmap(corner)(azimuth[:-1], azimuth[1:], aperture[:-1])
        return found, aperture[:-1] != aperture[1:]

    def line(self, azimuth: Array, moved: Lens) -> tuple[Array, Array]:
        """Spots (R, 2), mm, and areas (R,) of the nodes of a half-line. The edge follows `moved`,
        a lens next to this one, by one Newton step."""
        radius, aperture = self.edge(azimuth)
        slope = jax.jvp(partial(self.excess, azimuth), (radius,), (jnp.ones_like(radius),))[1]
        there = self._replace(lens=moved)
        edge = radius - there.excess(azimuth, radius)[aperture] / slope[aperture]

        def node(t, weight):
            def ends(q):
                hits = _trace(moved, self.scene, q)[0]
                return hits[moved.stop], hits[-1]

            jacobian, spot = jax.jacfwd(ends, has_aux=True)(self.point(azimuth, edge * t))
            return spot, jnp.abs(jnp.linalg.det(jacobian)) * edge**2 * t * weight

        t, weight = np.polynomial.legendre.leggauss(_RADII)
        return jax.vmap(node)(jnp.asarray(1 + t) / 2, jnp.asarray(weight))


@jax.jit
def _integral(lens: Lens, scene: Array, reach: Array, part: float) -> tuple[Array, Array, Array]:
    """sigma and the height of the centroid, their derivatives (2, P), and the number of corners,
    or -1 if no ray passes; `part`: where between the ends of the region its middle is put."""
    heights = jnp.linspace(-reach, reach, _SCAN)
    diameter = jnp.stack([jnp.zeros_like(heights), heights], axis=1)
    inside = jnp.all(jax.vmap(partial(_excess, lens, scene))(diameter) <= 0, axis=1)
    low = jnp.min(jnp.where(inside, heights, reach))
    high = jnp.max(jnp.where(inside, heights, -reach))
    pupil = _Pupil(lens, scene, low + part * (high - low), reach)
    # Panels end at the corners; where there are fewer, some are empty.
    corners, changes = pupil.corners()
    corners = jnp.sort(jnp.where(changes, corners, jnp.pi / 2))[:_CORNERS]
    even = jnp.linspace(-jnp.pi / 2, jnp.pi / 2, _PANELS + 1)
    ends = jnp.sort(jnp.concatenate([even, corners]))
    x, w = np.polynomial.legendre.leggauss(_AZIMUTHS)
    half = jnp.diff(ends)[:, None] / 2
    azimuth = (ends[:-1, None] + half * (1 + x)[None]).ravel()
    width = (half * w[None]).ravel()

    def values(parameters):
        moved = changed(lens, parameters)
        spot, area = jax.vmap(lambda angle: pupil.line(angle, moved))(azimuth)
        area = area * width[:, None]
        area = area / jnp.sum(area)
        # x -> -x: the other half is the mirror image. A sum of small numbers, for its rounding.
        height = jax.lax.stop_gradient(spot[0, 0, 1])
        mean = height + jnp.sum(area * (spot[..., 1] - height))
        square = spot[..., 0] ** 2 + (spot[..., 1] - mean) ** 2
        found = jnp.stack([jnp.sqrt(jnp.sum(area * square)), mean])
        return found, found

    slopes, found = jax.jacfwd(values, has_aux=True)(flatten(lens))
    return found, slopes, jnp.where(jnp.any(inside), jnp.sum(changes), -1)


def reference(
    lens: Lens, field: float, distance: float, wavelengths: Sequence[float]
) -> list[Moments]:
    """Moments of each colour of a centred lens in float64. ValueError if no ray passes.

    field: radians along y. distance: mm. wavelengths: um.
    """
    semi = np.asarray(lens.semi_diameter)
    # A steep beam crosses the plane far from where it meets the first surface.
    reach = (3 * float(np.max(semi[np.isfinite(semi)])) + 2 * _LEAD) * (1 + math.tan(abs(field)))
    results = []
    for wavelength in wavelengths:
        scene = jnp.array([field, 1 / distance, wavelength])
        found = [_integral(lens, scene, reach, part) for part in (0.5, 0.57)]
        (value, slopes, corners), (again, others, _) = found
        if corners < 0:
            raise ValueError(f"no ray at {wavelength:g} um reaches the sensor")
        if corners > _CORNERS:
            raise ValueError(f"the pupil has {corners} corners; expected at most {_CORNERS}")
        error = float(jnp.max(jnp.abs(again - value)) / value[0])
        change = float(jnp.linalg.norm(others[0] - slopes[0]) / jnp.linalg.norm(slopes[0]))
        results.append(Moments(*map(float, value), np.asarray(slopes), error, change))
    return results


def gradient_error(
    exact: np.ndarray, slopes: np.ndarray, surfaces: int, known: np.ndarray | bool = True
) -> float:
    """Norm of the error of known slopes (..., P) over that of the truth, the worse of those by
    curvatures of so many surfaces and by distances; NaN if the truth is 0."""
    wrong, truth = np.where(known, slopes - exact, 0), np.where(known, exact, 0)
    groups = slice(0, surfaces), slice(surfaces, None)
    norms = [(np.linalg.norm(wrong[..., g]), np.linalg.norm(truth[..., g])) for g in groups]
    return float(max((error / size for error, size in norms if size), default=math.nan))
