"""Converged moments of a spot and their gradients from the sequential trace alone.

Nothing of the Fermat solver is used, and no ray is aimed: the integral over the stop is written
in the coordinates q where a ray crosses a plane before the lens, with the Jacobian |dp/dq| of
the point p where Snell's law brings it on the stop. The region of integration is what the stop
and the clear apertures leave of that plane. Its edge is found by bisection along half-lines
from a point inside; where two apertures meet, it has a corner and a panel of Gauss nodes ends.
The edge moves with the lens: one Newton step on the aperture that forms it carries its derivative.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drt_jax import Lens, trace_snell

# The plane of q lies this far before the first vertex (mm).
_LEAD = 5.0
_PANELS, _AZIMUTHS, _RADII = 6, 16, 20
_BISECTIONS = 60
# Azimuths at which the edge is searched for corners.
_SEARCH = 181


class Moments(NamedTuple):
    """Of one colour, each with its derivatives by (curvatures, thicknesses and the sensor).

    sigma: RMS spot radius, mm; centroid: its y, mm; gradient (2, P) of both; error: the change
    when every node moves, relative to sigma (values) and to the norms (gradient of sigma).
    """

    sigma: float
    centroid: float
    gradient: np.ndarray
    error: float
    gradient_error: float


def flatten(lens: Lens) -> Array:
    """Curvatures, thicknesses and the sensor of a lens (or of a gradient) in one array (P,)."""
    lengths = jnp.append(lens.thickness, lens.sensor)
    return jnp.concatenate([lens.curvature, lengths])


def _trace(lens: Lens, scene: Array, q: Array) -> tuple[Array, Array]:
    """Hits of the ray through q (2,), mm; `scene` (3,): field, 1/distance, wavelength."""
    field, vergence, wavelength = scene
    point = jnp.array([q[0], q[1], -_LEAD])
    toward = jnp.array(
        [vergence * q[0], vergence * q[1] + jnp.tan(field), 1 - vergence * _LEAD]
    )
    return trace_snell(lens, wavelength, point, toward / jnp.linalg.norm(toward))


def _excess(lens: Lens, scene: Array, q: Array) -> Array:
    """(S,): r^2 over its limit, less 1, at the stop and the clear apertures; > 0 is outside."""
    hits, ok = _trace(lens, scene, q)
    radius2 = jnp.sum(hits[:-1, :2] ** 2, axis=1)
    return jnp.where(ok, radius2 / lens.semi_diameter**2 - 1, 1.0)


@jax.jit
def _inside(lens: Lens, scene: Array, heights: Array) -> Array:
    q = jnp.stack([jnp.zeros_like(heights), heights], axis=1)
    return jnp.all(jax.vmap(lambda q: _excess(lens, scene, q))(q) <= 0, axis=1)


@jax.jit
def _edge(lens: Lens, scene: Array, centre: Array, reach: Array, azimuth: Array):
    """Radius (N,) of the region along each azimuth from the centre; the aperture that ends it."""

    def along(angle):
        unit = jnp.array([jnp.cos(angle), jnp.sin(angle)])

        def halve(_, ends):
            low, high = ends
            middle = (low + high) / 2
            inside = jnp.all(_excess(lens, scene, centre + middle * unit) <= 0)
            return jnp.where(inside, middle, low), jnp.where(inside, high, middle)

        low, _ = jax.lax.fori_loop(0, _BISECTIONS, halve, (jnp.zeros_like(reach), reach))
        return low, jnp.argmax(_excess(lens, scene, centre + low * unit))

    return jax.vmap(along)(azimuth)


def _values(lens: Lens, scene: Array, centre: Array, nodes: tuple[Array, ...]) -> Array:
    """(2,): sigma and the height of the centroid, mm."""
    azimuth, width, radius, aperture, t, weight = nodes

    def along(angle, width, radius, aperture):
        unit = jnp.array([jnp.cos(angle), jnp.sin(angle)])

        def limit(r):
            return _excess(lens, scene, centre + r * unit)[aperture]

        level, slope = jax.jvp(limit, (radius,), (jnp.ones_like(radius),))
        edge = radius - level / jax.lax.stop_gradient(slope)

        def ray(t, weight):
            q = centre + t * edge * unit

            def hits(q):
                points = _trace(lens, scene, q)[0]
                return points[lens.stop, :2], points[-1, :2]

            (_, spot), (a, _) = jax.jvp(hits, (q,), (jnp.array([1.0, 0.0]),))
            _, (b, _) = jax.jvp(hits, (q,), (jnp.array([0.0, 1.0]),))
            area = jnp.abs(a[0] * b[1] - a[1] * b[0]) * edge**2 * t
            return spot, width * weight * area

        return jax.vmap(ray)(t, weight)

    spot, area = jax.vmap(along)(azimuth, width, radius, aperture)
    area = area / jnp.sum(area)
    mean = jnp.sum(area * spot[..., 1])  # x -> -x: the other half is the mirror image
    variance = jnp.sum(area * (spot[..., 0] ** 2 + (spot[..., 1] - mean) ** 2))
    return jnp.stack([jnp.sqrt(variance), mean])


@jax.jit
def _measure(lens: Lens, scene: Array, centre: Array, nodes: tuple[Array, ...]):
    value, back = jax.vjp(lambda lens: _values(lens, scene, centre, nodes), lens)
    rows = [flatten(back(row)[0]) for row in jnp.eye(2)]
    return value, jnp.stack(rows)


def _panels(edge, azimuth: np.ndarray) -> np.ndarray:
    """Ends of the panels from -pi/2 to pi/2: the corners of the region and points between."""
    _, aperture = edge(azimuth)
    jumps = np.flatnonzero(np.diff(aperture))
    if jumps.size > _PANELS - 1:
        raise ValueError(f"the pupil has {jumps.size} corners; expected at most {_PANELS - 1}")
    low, high, first = azimuth[jumps], azimuth[jumps + 1], aperture[jumps]
    for _ in range(_BISECTIONS if jumps.size else 0):
        middle = (low + high) / 2
        padded = np.resize(middle, azimuth.size)
        before = edge(padded)[1][: middle.size] == first
        low, high = np.where(before, middle, low), np.where(before, high, middle)
    ends = np.concatenate([azimuth[:1], low, azimuth[-1:]])
    while ends.size < _PANELS + 1:
        k = np.argmax(np.diff(ends))
        ends = np.insert(ends, k + 1, (ends[k] + ends[k + 1]) / 2)
    return ends


def _converged(lens: Lens, scene: Array, height: float, reach: float):
    centre = jnp.array([0.0, height])
    edge = partial(_edge, lens, scene, centre, jnp.asarray(reach))

    def known(azimuth):
        return tuple(np.asarray(a) for a in edge(jnp.asarray(azimuth)))

    ends = _panels(known, np.linspace(-np.pi / 2, np.pi / 2, _SEARCH))
    x, w = np.polynomial.legendre.leggauss(_AZIMUTHS)
    half = np.diff(ends)[:, None] / 2
    azimuth = (ends[:-1, None] + half * (1 + x)).ravel()
    radius, aperture = known(np.resize(azimuth, max(azimuth.size, _SEARCH)))
    radius, aperture = radius[: azimuth.size], aperture[: azimuth.size]
    t, weight = np.polynomial.legendre.leggauss(_RADII)
    nodes = azimuth, (half * w).ravel(), radius, aperture, (1 + t) / 2, weight / 2
    value, gradient = _measure(lens, scene, centre, tuple(jnp.asarray(a) for a in nodes))
    return np.asarray(value), np.asarray(gradient)


def reference(
    lens: Lens, field: float, distance: float, wavelengths: Sequence[float]
) -> list[Moments]:
    """Moments of each colour; `field` in radians along y, `distance` in mm, um.

    The lens is centred and in float64. Two sets of nodes, about two points inside the pupil, are
    compared: their difference is the error stated. ValueError if no ray passes.
    """
    results = []
    semi = np.asarray(lens.semi_diameter)
    reach = 3 * float(np.max(semi[np.isfinite(semi)])) + 2 * _LEAD
    for wavelength in wavelengths:
        scene = jnp.array([field, 1 / distance, wavelength])
        heights = np.linspace(-reach, reach, 4001)
        inside = heights[np.asarray(_inside(lens, scene, jnp.asarray(heights)))]
        if not inside.size:
            raise ValueError(f"no ray at {wavelength:g} um reaches the sensor")
        low, high = inside[0], inside[-1]
        (value, gradient), (other, turned) = (
            _converged(lens, scene, low + part * (high - low), reach) for part in (0.5, 0.57)
        )
        results.append(
            Moments(
                float(value[0]),
                float(value[1]),
                gradient,
                float(np.max(np.abs(value - other)) / value[0]),
                float(np.linalg.norm(gradient[0] - turned[0]) / np.linalg.norm(gradient[0])),
            )
        )
    return results
