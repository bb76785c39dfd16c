"""All rays of an object point as polynomials over the pupil, fitted to a few traced rays.

The hits on the surfaces and on the sensor, the directions and the optical paths of rays are smooth
functions of the stop point, and also of the direction at the sensor. A few dozen rays determine the
polynomials. Spots, kernels and transfer functions at any density follow from them without tracing
more rays.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import batched, einsum, safe_divide, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.patterns import disc, half_disc, meridian
from ..pupil.rules import Gauss, Mask, Pattern, PupilRule, Symmetry, fits
from ..rays.known import SEARCH, Known
from ..rays.system import Vector, dot
from ..rays.trace import Bundle, trace_bundle
from .wavefront import reference_curvature
from .zernike import Polynomials, fitted

# Largest spot radius, in units of the distance to the exit pupil, for which `on_sphere` uses the
# sphere of the exit pupil.
_MAX_SPOT = 0.3
# Number of directions in which `near` bounds the light of a clipped beam.
_BOUNDS = 16


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Beam:
    """Rays of W wavelengths that represent all light of an object point; Q rays over the part of
    the pupil that the light fills.

    points: (2, W, Q), crossings of the stop in units of its semi-diameter.
    weights: (W, Q), the light that each ray represents; their sum is the throughput.
    hits: (2, S + 1, W, Q), mm, on all surfaces and the sensor.
    direction: (3, W, Q), unit vectors at the sensor, along its axes.
    path: (W, Q), mm, optical path of the plane wave of each ray to the origin of the sensor: the
        path from the object to the foot of the perpendicular from the origin to the ray.
    index: (W,), refractive index in front of the sensor.
    motion: (3,), displacement of the sensor's vertex per mm of `Lens.sensor`, along the axes of the
        sensor.
    curvature: (W,), 1/mm, 1 / distance along the light from the exit pupil to the sensor.
    known: (W, Q), bool, True for rays that exist.
    degree: degree of the polynomials.
    azimuths: largest azimuthal order m of their terms cos(m a); one less than the number of
        azimuths of rays on half a disc.
    clipped: True if more than the rim of the stop bounds the light.
    mask: mask in the stop, or None. Only kernels take it into account; `weights` are those without
        it.
    """

    points: Array
    weights: Array
    hits: Array
    direction: Array
    path: Array
    index: Array
    motion: Array
    curvature: Array
    known: Array
    degree: int = dataclasses.field(metadata={"static": True})
    azimuths: int = dataclasses.field(metadata={"static": True})
    clipped: bool = dataclasses.field(metadata={"static": True})
    mask: Mask | None = None

    @property
    def throughput(self) -> Array:
        """Fraction (W,) of the light through the stop that reaches the sensor."""
        return jnp.sum(self.weights, axis=-1)

    def refocused(self, step: Array) -> "Beam":
        """The beam with the sensor moved by `step` mm, (), along the light. No ray is traced:
        the straight rays are extended to the new plane, and paths refer to its new origin."""
        # The origin of the sensor moves by `move`; rays are extended to the new plane.
        move = step * self.motion[:, None, None]
        ahead = safe_divide(jnp.broadcast_to(move[2], self.path.shape), self.direction[2])
        hits = self.hits.at[:, -1].add(ahead[None] * self.direction[:2] - move[:2])
        path = self.path + self.index[:, None] * dot(tuple(self.direction), tuple(move))
        farther = step * jnp.sign(self._along_motion())
        curvature = safe_divide(self.curvature, 1 + farther * self.curvature)
        return dataclasses.replace(self, hits=hits, path=path, curvature=curvature)

    def map(self, function: Callable[["Beam"], Any], focus: Array | None = None) -> Any:
        """A function of one beam, of each of the beams (...) that these arrays hold.

        focus: mm by which the sensor is moved back, (); or (Z,), an axis of results behind theirs.
        """

        axes = self.path.ndim - 2
        if focus is None:
            return batched(function, axes)(self)
        moved = lambda beam, step: function(beam.refocused(step))  # noqa: E731
        at = jax.vmap(moved, (None, 0)) if focus.ndim else moved
        return batched(lambda beam: at(beam, focus), axes)(self)

    def on_sphere(self) -> tuple[Array, Array]:
        """Rays as plane waves whose directions point from the exit pupil to the spot.

        Returns cosines (2, W, Q), the direction cosines from the point where each ray crosses a
        sphere through the exit pupil, centred on the centroid of the spot, to that centroid; and
        the path (W, Q), mm, of the plane wave of this direction to the origin of the sensor, in
        place of `path`, which is that of the ray's own direction.

        On the sensor, Huygens' waves from the sphere interfere like plane waves of these
        directions, except for a phase of (blur x aperture)^2 / (2 radius). With the ray's own
        direction (a sphere of infinite radius) a plane wave would need many Fresnel zones to be a
        good approximation.

        With the formulas of `wavefront`: for a ray of direction d with the hit C + e, which crosses
        the sphere at the distance 1 / kappa + t in front of it, the direction to C is
        c = (1 + kappa t) d - kappa e, and the path is `path` + n (d.(C + e) - c.C - t). Where the
        spot is not small compared with the radius, kappa = 0: the ray's own direction.
        """
        light = self._light()
        middle = means(self.hits[:, -1], light)[..., None]
        e, line = self.hits[:, -1] - middle, self.direction[:2]
        e = jnp.where(self.known[None], e, 0)
        kappa = self.curvature * jnp.abs(self._along_motion())
        square = jnp.sum(e**2, axis=0)
        near = kappa**2 * jnp.max(square, axis=-1) < _MAX_SPOT**2
        kappa = jnp.where(near, kappa, 0)[:, None]
        along = jnp.sum(e * line, axis=0)
        x = along**2 - square
        before = along + kappa * x / (1 + safe_sqrt(1 + kappa**2 * x))
        cosines = (1 + kappa * before)[None] * line - kappa[None] * e
        offset = jnp.sum(self.hits[:, -1] * line - middle * cosines, axis=0) - before
        return cosines, self.path + self.index[:, None] * jnp.where(self.known, offset, 0)

    def over_stop(self) -> Polynomials:
        """Polynomials in the stop point: hits on the sensor (2) and, for a clipped pupil, hits
        on all surfaces (2 S + 2), mm."""
        return self._fitted(self.points, self._with_edges([self.hits[:, -1]]))

    def over_directions(self) -> Polynomials:
        """Polynomials in the direction cosines of `on_sphere`: path (1), mm; stop point (2); and,
        for a clipped pupil, hits on all surfaces (2 S + 2), mm.

        The tilt n C.c towards the centroid C of the spot is thousands of waves, of which float32
        would lose too many digits. It is taken off before the fit and its exact coefficients are
        added afterwards: the first three terms of Noll are 1, 2 x and 2 y.
        """
        cosines, path = self.on_sphere()
        # The tilt n C.c, see above.
        along = jax.lax.stop_gradient(self.index[None] * means(self.hits[:, -1], self._light()))
        path = path + dot(tuple(along[..., None]), tuple(cosines))
        found = self._fitted(cosines, self._with_edges([path[None], self.points]))
        tilt = jnp.stack([dot(along, found.centre), *(along * found.scale / 2)], axis=-1)
        coefficients = found.coefficients.at[:, 0, :3].add(-tilt)
        return dataclasses.replace(found, coefficients=coefficients)

    def solid_angle(self) -> Array:
        """Area (W,) of the cone of light on the sensor, in direction cosines: pi times the
        weighted mean of |d(direction) / d(stop point)|. Irradiance is this area times the
        radiance that fills the stop."""
        directions = self._fitted(self.points, self.direction[:2])
        one, zero = jnp.ones_like(self.points[0]), jnp.zeros_like(self.points[0])

        def slope(x: Array, y: Array) -> Array:
            return jax.jvp(directions.at, (self.points,), (jnp.stack([x, y]),))[1]

        (a, b), (c, d) = slope(one, zero), slope(zero, one)
        return jnp.pi * jnp.sum(self.weights * jnp.abs(a * d - b * c), axis=-1)

    def extent(self) -> tuple[Array, Array]:
        """Square of the stop that contains the light: its lower and upper corner, (2, W) each,
        in units of the semi-diameter."""
        if not self.clipped:
            one = jnp.ones((2, self.path.shape[0]), self.path.dtype)
            return -one, one
        return _extent(self.points, self.known, self._margin())

    def directions_extent(self) -> tuple[Array, Array]:
        """Rectangle of direction cosines of `on_sphere` that contains the light: its lower and
        upper corner, (2, W) each."""
        return _extent(self.on_sphere()[0], self.known, self._margin())

    def near(self, places: Array, middle: Array, step: Array, cells: int) -> Array:
        """Mask (W, N, N) [y, x] of the cells of a grid that may contain light, because they are
        near traced rays. Far from all rays the polynomials extrapolate, and apertures can seem to
        let such points pass.

        places: (2, W, Q), positions of the rays in the plane of the grid.
        middle, step: (2, W), centre and step of the grid.
        cells: N.

        The light is bounded by the convex polygon of its extents in `_BOUNDS` directions.
        """
        side = jnp.asarray(np.arange(cells) - (cells - 1) / 2, step.dtype)
        axes = middle[..., None] + step[..., None] * side[None, None]

        def within(found: Array, unit: Array) -> tuple[Array, None]:
            """Leaves the cells that also lie within the extent along one direction."""
            x, y = unit
            low, high = _extent(x * places[0] + y * places[1], self.known, self._margin())
            along = x * axes[0][:, None, :] + y * axes[1][:, :, None]
            cell = (abs(x) * step[0] + abs(y) * step[1]) / 2
            ends = (low - cell)[:, None, None], (high + cell)[:, None, None]
            return found & (along >= ends[0]) & (along <= ends[1]), None

        angle = np.pi / _BOUNDS * np.arange(_BOUNDS)
        units = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=-1), step.dtype)
        found = jnp.ones((axes.shape[1], cells, cells), bool)
        return jax.lax.scan(within, found, units)[0]

    def _margin(self) -> float:
        """Factor by which the light may extend farther than the outermost rays, because Gauss
        nodes lie inside of the rim, and because the rim bulges between two azimuths."""
        order = self.degree // 2 + 1
        outermost = np.polynomial.legendre.leggauss(order + self.clipped)[0][-1]
        radius = (1 + outermost) / 2 if self.clipped else np.sqrt((1 + outermost) / 2)
        return float(1.005 / (radius * np.cos(np.pi / (2 * self.azimuths + 2))))

    def _with_edges(self, values: list[Array]) -> Array:
        """`values` and, for a clipped beam, the hits on all surfaces, stacked to (D, W, Q)."""
        edges = [self.hits.reshape(-1, *self.path.shape)] if self.clipped else []
        return jnp.concatenate([*values, *edges])

    def _along_motion(self) -> Array:
        """Cosine (W,) between the mean direction of the light and the direction in which the
        sensor moves."""
        return jnp.sum(means(self.direction, self._light()) * self.motion[:, None], axis=0)

    def _light(self) -> Array:
        """Weights (W, Q) >= 0 of fits and centroids: the absolute values of `weights`, which are
        negative for rays inside of obscurations; 1 for a wavelength without light."""
        weights = jnp.where(self.known, jnp.abs(self.weights), 0)
        return jnp.where(self.throughput[:, None] > 0, weights, 1)

    def _fitted(self, points: Array, values: Array) -> Polynomials:
        """Polynomials of the beam's degree fitted to values (D, W, Q) at points (2, W, Q)."""
        # Fit the deviations from the mean, so that float32 rounds only these, and add the mean to
        # the constant term.
        mean = jax.lax.stop_gradient(means(values, self._light()))
        found = fitted(points, values - mean[..., None], self._light(), self.degree, self.azimuths)
        coefficients = found.coefficients.at[..., 0].add(mean.T)
        return dataclasses.replace(found, coefficients=coefficients)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BeamRule:
    """How a beam is traced, see `beam_rule`.

    rule: pupil rule of the rays.
    degree: static, degree of the polynomials.
    mask: mask in the stop, or None.
    azimuths: static, as in `Beam`; None for `degree`.
    """

    rule: PupilRule
    degree: int = dataclasses.field(metadata={"static": True})
    mask: Mask | None = None
    azimuths: int | None = dataclasses.field(default=None, metadata={"static": True})


def beam_rule(degree: int, symmetry: Symmetry, clipped: PupilRule | None = None) -> BeamRule:
    """The fewest rays that determine polynomials of a degree: a rule that integrates products of
    two of them exactly.

    degree: degree of the polynomials.
    symmetry: of the pupil, see `symmetry_of`.
    clipped: a rule of the kind `Clipped` if the pupil is clipped; the beam then has a rule of this
        kind. Another rule or None: the whole stop.
    """
    order = degree // 2 + 1
    if isinstance(clipped, Clipped):
        rule = dataclasses.replace(clipped, order=order + 1, size=order + 1)
        return BeamRule(rule, degree)
    if symmetry == "rotational":
        return BeamRule(Pattern(*meridian(order), symmetry), degree)
    pattern = half_disc if symmetry == "bilateral" else disc
    return BeamRule(Pattern(*pattern(order, degree + 1), symmetry), degree)


def trace_beam(lens: Lens, scene: Scene, rule: BeamRule, known: Known = SEARCH) -> Beam:
    """Traces the beam of an object point.

    lens, scene: the lens, and the object point with its wavelengths.
    rule: rays and degree, see `beam_rule`.
    known: its rays, if they are known.
    """
    points, weights = rule.rule.points(lens, scene, known.plan)
    bundle = trace_bundle(lens, scene, points, known)
    weights = jnp.where(fits(rule.rule.symmetry, scene.field), weights, 0)
    weights = weights * rule.rule.transmission(lens, bundle)
    return beam_of(lens, scene, rule, points, weights, bundle)


def beam_of(
    lens: Lens, scene: Scene, rule: BeamRule, points: Vector, weights: Array, bundle: Bundle
) -> Beam:
    """The beam of traced rays.

    lens, scene: what was traced.
    rule: degree of the polynomials, and the symmetry and kind of the rays.
    points: their points on the stop.
    weights: (W, Q), weights of the pupil rule times the transmission of the rays.
    bundle: the traced rays.

    Rays of a part of the pupil are repeated, rotated or mirrored, so that they cover all of it.
    """
    known, shape, arrival = bundle.arrives, bundle.status.shape, bundle.arrival
    index = lens.index(scene.wavelengths)[-1]
    path = bundle.path - index[:, None] * dot(arrival[:-1], bundle.sensor)
    # A constant in the path does not matter; the mean is removed so that float32 keeps the rest.
    path = jnp.where(known, path, 0)
    total = jnp.sum(known, axis=-1, keepdims=True).astype(path.dtype)
    mean = safe_divide(jnp.sum(path, axis=-1, keepdims=True), total)
    path = jnp.where(known, path - jax.lax.stop_gradient(mean), 0)
    images, motion = _images(rule.rule.symmetry, rule.degree), lens.sensor_motion

    def spread(vector: Sequence[Array]) -> Array:
        """Vectors of rays, D arrays (..., Q), and their images: (2, ..., I Q)."""
        found = einsum("ikd,d...q->k...iq", jnp.asarray(images, path.dtype), jnp.stack(vector))
        return found.reshape(*found.shape[:-2], -1)

    def repeated(values: Array) -> Array:
        """A scalar of all rays and their images."""
        return jnp.tile(jnp.broadcast_to(values, shape), (1, len(images)))

    known, weights = repeated(known), repeated(weights) / len(images)
    direction = jnp.concatenate([spread(arrival[:-1]), repeated(arrival[-1])[None]])
    # Placeholders for each wavelength of which no light arrives: rays of weight 0 on a spiral over
    # the unit disc, so that fits and all that follows from them stay finite.
    arrives = jnp.sum(weights, axis=-1, keepdims=True) > 0
    place = np.arange(known.shape[-1]) + 0.5
    spiral = np.sqrt(place / len(place)) * np.exp(2.4j * place)
    inside = jnp.asarray(np.stack([spiral.real, spiral.imag])[:, None], path.dtype)
    return Beam(
        points=jnp.where(arrives, spread([jnp.broadcast_to(p, shape) for p in points]), inside),
        weights=jnp.where(arrives, weights, 0),
        hits=spread(bundle.hits),
        direction=jnp.where(arrives, direction, jnp.concatenate([inside, inside[:1]])),
        path=repeated(path),
        index=index,
        motion=jnp.array([0, 0, 1], index.dtype) if motion is None else motion,
        curvature=reference_curvature(lens, scene.wavelengths),
        known=known | ~arrives,
        degree=rule.degree,
        azimuths=rule.degree if rule.azimuths is None else rule.azimuths,
        clipped=not isinstance(rule.rule, Gauss | Pattern),
        mask=rule.mask,
    )


def _extent(places: Array, known: Array, margin: float) -> tuple[Array, Array]:
    """Smallest and largest coordinate (..., W) of the light whose rays are at `places` (..., W,
    Q), with the factor `margin` about their middle."""
    low = jnp.min(jnp.where(known, places, jnp.inf), axis=-1)
    high = jnp.max(jnp.where(known, places, -jnp.inf), axis=-1)
    middle, half = (low + high) / 2, margin * (high - low) / 2
    return middle - half, middle + half


def _images(symmetry: Symmetry, degree: int) -> np.ndarray:
    """Linear maps (I, 2, D), rotations or reflections, that take vectors of rays on a part of the
    pupil, D components, to all of it."""
    if symmetry == "rotational":
        turns = 2 * np.pi * np.arange(2 * degree + 1) / (2 * degree + 1)
        return np.stack([np.cos(turns), np.sin(turns)], axis=-1)[..., None]
    signs = (1, -1) if symmetry == "bilateral" else (1,)
    return np.array([[[sign, 0], [0, 1]] for sign in signs])


def means(values: Array, weights: Array) -> Array:
    """Weighted means (D, W) of values (D, W, Q) with weights (W, Q)."""
    total = einsum("wq,dwq->dw", weights, values)
    return safe_divide(total, jnp.broadcast_to(jnp.sum(weights, -1), total.shape))


def centroid_and_variances(hits: Array, weights: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    """Centroid (2, W) of hits (2, W, Q), and their variances xx, xy and yy, (W,) each; weights
    (W, Q)."""
    mean = means(hits, weights)
    x, y = hits - mean[..., None]
    xx, xy, yy = means(jnp.stack([x * x, x * y, y * y]), weights)
    return mean, (xx, xy, yy)
