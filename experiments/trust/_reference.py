"""Converged moments of a spot and their gradients from the sequential trace alone.

No Fermat solver and no aiming: the integral over the stop uses the coordinates q in which a ray
crosses a plane in front of the lens, with the Jacobian |dp/dq| of its stop point p by Snell's law.
The region of integration is the part of that plane from which rays pass the stop and the clear
apertures. Its edge is found by bisection along half-lines from a point inside. Where the limiting
aperture changes, the edge has a corner, at which a panel of Gauss nodes ends. Derivatives are by
automatic differentiation of the trace, and include the motion of the edge.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drt_jax import Lens, results
from drt_jax.compilation import jit

from .snell import QUICK, trace_snell

# Distance of the plane of q in front of the first vertex, mm.
LEAD = 5.0
_PANELS, _CORNERS, _AZIMUTHS, _RADII = 6, 5, 12, 24
_BISECTIONS = 50
# Points along a diameter; half-lines of the search for corners.
_SCAN, _SEARCH = 1152, 121


class Moments(NamedTuple):
    """Moments of W wavelengths.

    sigma: (W,), RMS spot radius, mm.
    centroid: (W,), y of the centroid, mm.
    gradient: (W, 2, P), derivatives of both by curvatures, thicknesses and the sensor.
    error: (W,), change of both with other nodes, relative to sigma.
    gradient_error: (W,), change of sigma's gradient with other nodes, relative to its norm.
    clipped: (W,), bool, whether an aperture other than the stop's limits the beam.
    """

    sigma: np.ndarray
    centroid: np.ndarray
    gradient: np.ndarray
    error: np.ndarray
    gradient_error: np.ndarray
    clipped: np.ndarray


def flatten(lens: Lens) -> Array:
    """Curvatures, thicknesses and sensor of a lens or gradient in one array (P,)."""
    return jnp.concatenate([lens.curvature[:-1], lens.thickness, lens.sensor[None]])


def changed(lens: Lens, values: Array) -> Lens:
    """The lens with values (P,) in the order of `flatten`."""
    curvature, thickness, sensor = jnp.split(values, [lens.count, len(values) - 1])
    curvature = lens.curvature.at[:-1].set(curvature)
    return dataclasses.replace(lens, curvature=curvature, thickness=thickness, sensor=sensor[0])


def trace(lens: Lens, scene: Array, q: Array) -> tuple[Array, Array]:
    """Hits (S + 1, 2) of the ray through q (2,), mm, and whether it arrives. scene: field,
    1/distance, wavelength."""
    field, vergence, wavelength = scene
    point = jnp.append(q, -LEAD)
    toward = vergence * point + jnp.stack([0 * field, jnp.tan(field), 0 * field + 1])
    hits, ok = trace_snell(lens, wavelength, point, toward / jnp.linalg.norm(toward))
    return hits[:, :2], ok


def outside_of(lens: Lens, scene: Array, q: Array) -> Array:
    """r^2 / limit - 1 at the stop and the apertures, (S,); above 0 outside."""
    hits, ok = trace(lens, scene, q)
    limit2 = lens.semi_diameter[:-1] ** 2
    return jnp.where(ok, jnp.sum(hits[:-1] ** 2, axis=1) / limit2 - 1, 1)


def _bisected(low: Array, high: Array, before: Callable[[Array], Array]) -> tuple[Array, Array]:
    """The interval narrowed to where `before` changes from True to False."""

    def narrow(_, interval):
        low, high = interval
        middle = (low + high) / 2
        first = before(middle)
        return jnp.where(first, middle, low), jnp.where(first, high, middle)

    return jax.lax.fori_loop(0, _BISECTIONS, narrow, (low, high))


class Region(NamedTuple):
    """A region of the plane of q, symmetric about the y axis, in polar coordinates about (0,
    height).

    excess: function of q, (2,), by aperture: above 0 outside, as `outside_of`.
    height: (), y of the origin, mm.
    reach: (), radius beyond the region, mm.
    """

    excess: Callable[[Array], Array]
    height: Array
    reach: Array

    def point(self, azimuth: Array, radius: Array) -> Array:
        """q, mm."""
        up = radius * jnp.sin(azimuth) + self.height
        return jnp.stack([radius * jnp.cos(azimuth), up])

    def edge(self, azimuth: Array) -> tuple[Array, Array]:
        """Radius at which a half-line leaves the region, mm, and the aperture that limits it."""

        def within(radius):
            return self.excess(self.point(azimuth, radius))

        start = jnp.zeros_like(self.reach)
        low, high = _bisected(start, self.reach, lambda radius: jnp.all(within(radius) <= 0))
        return low, jnp.argmax(within(high))

    def _corners(self) -> tuple[Array, Array]:
        """Azimuths at which the limiting aperture changes, (_CORNERS,), pi / 2 for none, and their
        number, which may be larger."""
        azimuth = jnp.linspace(-jnp.pi / 2, jnp.pi / 2, _SEARCH)
        aperture = jax.vmap(self.edge)(azimuth)[1]
        changes = aperture[:-1] != aperture[1:]
        (some,) = jnp.nonzero(changes, size=_CORNERS, fill_value=_SEARCH - 2)

        def corner(low, high, first):
            return _bisected(low, high, lambda middle: self.edge(middle)[1] == first)[0]

        found = jax.vmap(corner)(azimuth[some], azimuth[some + 1], aperture[some])
        return jnp.where(changes[some], found, jnp.pi / 2), jnp.sum(changes)

    def half_lines(self, nodes: int = _AZIMUTHS) -> tuple[Array, Array, Array]:
        """Azimuths and widths of Gauss nodes over the half with x > 0, and the number of corners.
        Panels of `nodes` nodes end at the corners; if there are fewer than `_CORNERS`, some panels
        are empty."""
        corners, count = self._corners()
        even = jnp.linspace(-jnp.pi / 2, jnp.pi / 2, _PANELS + 1)
        edges = jnp.sort(jnp.concatenate([even, corners]))
        x, w = np.polynomial.legendre.leggauss(nodes)
        half = jnp.diff(edges)[:, None] / 2
        azimuth = (edges[:-1, None] + half * (1 + x)[None]).ravel()
        return azimuth, (half * w[None]).ravel(), count


def heights_within(excess: Callable[[Array], Array], reach: Array) -> tuple[Array, Array, Array]:
    """The least and largest y at which the y axis is in a region, and whether it is anywhere."""
    heights = jnp.linspace(-reach, reach, _SCAN)
    diameter = jnp.stack([jnp.zeros_like(heights), heights], axis=1)
    inside = jnp.all(jax.vmap(excess)(diameter) <= 0, axis=1)
    low, high = jnp.where(inside, heights, reach), jnp.where(inside, heights, -reach)
    return jnp.min(low), jnp.max(high), jnp.any(inside)


def _line(region: Region, azimuth: Array, varied: Lens, scene: Array) -> tuple[Array, Array]:
    """Hits (R, 2) on the sensor, mm, and areas (R,) of the nodes of a half-line. One Newton step
    gives the edge its derivatives by `varied`, the lens with respect to which derivatives are
    taken."""
    radius, aperture = region.edge(azimuth)
    along = partial(region.point, azimuth)
    slope = jax.jvp(lambda r: region.excess(along(r)), (radius,), (jnp.ones_like(radius),))[1]
    edge = radius - outside_of(varied, scene, along(radius))[aperture] / slope[aperture]

    def node(t, weight):
        def stop_and_sensor(q):
            hits = trace(varied, scene, q)[0]
            return hits[varied.stop], hits[-1]

        jacobian, spot = jax.jacfwd(stop_and_sensor, has_aux=True)(along(edge * t))
        return spot, jnp.abs(jnp.linalg.det(jacobian)) * edge**2 * t * weight

    t, weight = np.polynomial.legendre.leggauss(_RADII)
    return jax.vmap(node)(jnp.asarray(1 + t) / 2, jnp.asarray(weight))


@partial(jit, wanted=QUICK, static_argnames="slopes")
def _integral(
    lens: Lens, scene: Array, reach: Array, part: float, slopes: bool
) -> tuple[Array, Array, Array, Array]:
    """sigma and the height of the centroid, their derivatives (2, P), the number of corners, -1 if
    no ray passes, and whether an aperture other than the stop's limits the beam. part: position of
    the origin along the height of the region, 0 to 1. slopes: as in `reference`."""
    excess = partial(outside_of, lens, scene)
    low, high, any_light = heights_within(excess, reach)
    region = Region(excess, low + part * (high - low), reach)
    azimuth, width, corners = region.half_lines()

    def values(parameters):
        varied = changed(lens, parameters)
        spot, area = jax.vmap(lambda angle: _line(region, angle, varied, scene))(azimuth)
        area = area * width[:, None]
        area = area / jnp.sum(area)
        # The other half is the mirror image in x. A sum of small numbers has less rounding error.
        height = jax.lax.stop_gradient(spot[0, 0, 1])
        mean = height + jnp.sum(area * (spot[..., 1] - height))
        square = spot[..., 0] ** 2 + (spot[..., 1] - mean) ** 2
        found = jnp.stack([jnp.sqrt(jnp.sum(area * square)), mean])
        return found, found

    given = flatten(lens)
    if slopes:
        rows, found = jax.jacfwd(values, has_aux=True)(given)
    else:
        rows, found = jnp.full((2, given.size), jnp.nan), values(given)[0]
    clipped = jnp.any(jax.vmap(region.edge)(azimuth[::_AZIMUTHS])[1] != lens.stop)
    return found, rows, jnp.where(any_light, corners, -1), clipped


def beyond(lens: Lens, field: float) -> float:
    """`reach` of a `Region`, mm."""
    semi = np.asarray(lens.semi_diameter)
    # An oblique beam crosses the plane far from its hits on the first surface.
    return (3 * float(np.max(semi[np.isfinite(semi)])) + 2 * LEAD) * (1 + math.tan(abs(field)))


def reference(
    lens: Lens, field: float, distance: float, wavelengths: Sequence[float], slopes: bool = True
) -> Moments:
    """Moments of a centred lens in float64. ValueError if no ray passes.

    field: angle along y, radians.
    distance: distance of the object, mm.
    wavelengths: wavelengths, um.
    slopes: False to leave out the derivatives, which are then NaN.
    """
    reach, rows = beyond(lens, field), []
    for wavelength in wavelengths:
        scene = jnp.array([field, 1 / distance, wavelength])
        found = [_integral(lens, scene, reach, part, slopes) for part in (0.5, 0.57)]
        (value, rates, corners, clipped), (again, others, *_) = found
        if corners < 0:
            raise ValueError(f"no ray at {wavelength:g} um reaches the sensor")
        if corners > _CORNERS:
            raise ValueError(f"the pupil has {corners} corners; expected at most {_CORNERS}")
        error = jnp.max(jnp.abs(again - value)) / value[0]
        change = jnp.linalg.norm(others[0] - rates[0]) / jnp.linalg.norm(rates[0])
        rows.append((*value, rates, error, change, clipped))
    return Moments(*(np.array(column) for column in zip(*rows)))


def sigmas(moments: results.Moments) -> Array:
    """RMS spot radii sigma (W,) of moments of the library, mm."""
    return jnp.sqrt(jnp.trace(moments.covariance, axis1=1, axis2=2))


def relative_error(truth: Moments, sigma: Any) -> float:
    """Largest relative error of spot radii sigma (W,)."""
    return float(np.max(np.abs(np.asarray(sigma, float) / truth.sigma - 1)))


def gradient_error(
    exact: np.ndarray, slopes: np.ndarray, surfaces: int, known: np.ndarray | bool = True
) -> float:
    """Norm of the error of a gradient (..., P) divided by the norm of the exact gradient.

    It is the larger of the values for the curvatures of `surfaces` surfaces and for the distances;
    NaN if the exact gradient is 0. known: (..., P), bool, derivatives that are compared.
    """
    wrong, truth = np.where(known, slopes - exact, 0), np.where(known, exact, 0)
    groups = slice(0, surfaces), slice(surfaces, None)
    norms = [(np.linalg.norm(wrong[..., g]), np.linalg.norm(truth[..., g])) for g in groups]
    return float(max((error / size for error, size in norms if size), default=math.nan))
