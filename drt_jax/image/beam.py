"""All rays of an object point as polynomials of the pupil, fitted to a few traced ones.

Where rays meet the surfaces and the sensor, their directions and their optical paths are smooth
functions of the point of the stop, and of the direction at the sensor. Some dozens of rays give the
polynomials; spots, kernels and transfer functions of any density follow from these without another
ray.
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import einsum, safe_divide, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.mask import Mask
from ..pupil.patterns import disc, half_disc, meridian
from ..pupil.rules import Pattern, PupilRule, Symmetry, fits
from ..rays.solve import Solver, solve
from ..rays.status import Status
from ..rays.system import dot
from ..rays.trace import Bundle, trace_bundle
from .wavefront import reference_curvature
from .zernike import Polynomials, fitted

# The largest spot, in parts of the distance to the exit pupil, for which that counts.
_NEAR = 0.3
# Directions along which the light of a clipped beam has ends.
_SIDES = 16


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=(
        *("points", "weights", "hits", "direction", "path", "index", "motion", "curvature"),
        *("known", "mask"),
    ),
    meta_fields=("degree", "azimuths", "clipped"),
)
@dataclasses.dataclass(frozen=True)
class Beam:
    """Rays of W wavelengths that stand for all light of an object point; Q of them all over the
    part of the pupil that the light fills.

    points: (2, W, Q), where they cross the stop, in units of its semi-diameter.
    weights: (W, Q), the light that they stand for, adding up to the throughput.
    hits: (2, S + 1, W, Q) mm, on all surfaces and the sensor.
    direction: (3, W, Q), unit vectors at the sensor, along its axes.
    path: (W, Q) mm, optical path from the object to the foot of the perpendicular from the middle
        of the sensor to the ray: the phase of its plane wave there.
    index: (W,), refractive index before the sensor.
    motion: (3,), how the sensor's vertex moves in mm a mm of `Lens.sensor`, along its axes.
    curvature: (W,), 1 / distance along the light from the exit pupil to the sensor, 1/mm.
    known: (W, Q), whether the ray exists.
    degree: of the polynomials. azimuths: the largest m of their terms cos(m a), one less than the
        azimuths of rays on half a disc. clipped: whether more than the rim of the stop bounds the
        light.
    mask: in the stop; only kernels know it: `weights` are of the light without it.
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
    degree: int
    azimuths: int
    clipped: bool
    mask: Mask | None = None

    @property
    def throughput(self) -> Array:
        """The part of the light through the stop that reaches the sensor, (W,)."""
        return jnp.sum(self.weights, axis=-1)

    def refocused(self, step: Array) -> "Beam":
        """The same light with the sensor `step` mm, (), farther along its way: no ray is traced."""
        # The middle of the sensor moves by `move`; rays go on to the plane where it then lies.
        move = step * self.motion[:, None, None]
        ahead = safe_divide(jnp.broadcast_to(move[2], self.path.shape), self.direction[2])
        hits = self.hits
        for k in range(2):
            hits = hits.at[k, -1].add(ahead * self.direction[k] - move[k])
        path = self.path + self.index[:, None] * dot(tuple(self.direction), tuple(move))
        farther = step * jnp.sign(self._along_motion())
        curvature = safe_divide(self.curvature, 1 + farther * self.curvature)
        return dataclasses.replace(self, hits=hits, path=path, curvature=curvature)

    def on_sphere(self) -> tuple[Array, Array]:
        """Where rays cross a sphere through the exit pupil about the middle of the spot: direction
        cosines (2, W, Q) from there to the middle, and the path (W, Q) of a plane wave of this
        direction, as `path` has that of the ray's own, mm.

        Huygens' waves from the sphere interfere on the sensor as plane waves of these directions
        do, but for a phase of (blur x aperture)^2 / (2 radius). Rays as plane waves, a sphere of
        infinite radius, would be the limit of many Fresnel zones. Formulas as in `wavefront`. Where
        the spot is no longer small beside the radius, that limit is taken.
        """
        light = self._light()
        middle = means(self.hits[:, -1], light)[..., None]
        e, line = self.hits[:, -1] - middle, self.direction[:2]
        e = jnp.where(self.known[None], e, 0)
        kappa = self.curvature * jnp.abs(self._along_motion())
        square = jnp.sum(e**2, axis=0)
        near = kappa**2 * jnp.max(square, axis=-1) < _NEAR**2
        kappa = jnp.where(near, kappa, 0)[:, None]
        along = jnp.sum(e * line, axis=0)
        x = along**2 - square
        before = along + kappa * x / (1 + safe_sqrt(1 + kappa**2 * x))
        cosines = (1 + kappa * before)[None] * line - kappa[None] * e
        offset = jnp.sum(self.hits[:, -1] * line - middle * cosines, axis=0) - before
        return cosines, self.path + self.index[:, None] * jnp.where(self.known, offset, 0)

    def over_stop(self) -> Polynomials:
        """Hits on the sensor (2) and, of a clipped pupil, on all surfaces (2 S + 2), mm, as
        functions of the stop point."""
        return self._fitted(self.points, self._with_edges([self.hits[:, -1]]))

    def over_directions(self) -> Polynomials:
        """Path (1), mm, stop point (2) and, of a clipped pupil, hits on all surfaces (2 S + 2), mm,
        as functions of the direction cosines of `on_sphere`."""
        cosines, path = self.on_sphere()
        # Less the tilt towards the middle of the light, thousands of waves, of which float32 would
        # round too much. It is put back exactly: terms 1 to 3 of Noll are 1, 2 x and 2 y.
        along = jax.lax.stop_gradient(self.index[None] * means(self.hits[:, -1], self._light()))
        path = path + dot(tuple(along[..., None]), tuple(cosines))
        found = self._fitted(cosines, self._with_edges([path[None], self.points]))
        tilt = jnp.stack([dot(along, found.centre), *(along * found.scale / 2)], axis=-1)
        coefficients = found.coefficients.at[:, 0, :3].add(-tilt)
        return dataclasses.replace(found, coefficients=coefficients)

    def solid_angle(self) -> Array:
        """Area of the cone of light on the sensor, (W,), in direction cosines: irradiance is this
        times the radiance that fills the stop."""
        directions = self._fitted(self.points, self.direction[:2])
        one, zero = jnp.ones_like(self.points[0]), jnp.zeros_like(self.points[0])

        def slope(x: Array, y: Array) -> Array:
            return jax.jvp(directions.at, (self.points,), (jnp.stack([x, y]),))[1]

        (a, b), (c, d) = slope(one, zero), slope(zero, one)
        return jnp.pi * jnp.sum(self.weights * jnp.abs(a * d - b * c), axis=-1)

    def extent(self) -> tuple[Array, Array]:
        """The square of the stop that the light lies in: two corners, (2, W)."""
        if not self.clipped:
            one = jnp.ones((2, self.path.shape[0]), self.path.dtype)
            return -one, one
        return _extent(self.points, self.known, self._margin())

    def directions_extent(self) -> tuple[Array, Array]:
        """The rectangle of direction cosines, see `on_sphere`, that the light lies in: two corners,
        (2, W)."""
        return _extent(self.on_sphere()[0], self.known, self._margin())

    def near(self, places: Array, middle: Array, step: Array, cells: int) -> Array:
        """Whether cells of a grid (W, N, N) [y, x] reach to where light may come, next to the rays.
        Far from all rays polynomials run away, and some come back to where apertures seem to pass
        them.

        places: (2, W, Q) of the rays. middle, step: (2, W), of the grid.
        """
        side = jnp.asarray(np.arange(cells) - (cells - 1) / 2, step.dtype)
        axes = middle[..., None] + step[..., None] * side[None, None]
        found = jnp.ones((axes.shape[1], cells, cells), bool)
        for angle in np.pi / _SIDES * np.arange(_SIDES):
            x, y = np.cos(angle).item(), np.sin(angle).item()
            low, high = _extent(x * places[0] + y * places[1], self.known, self._margin())
            along = x * axes[0][:, None, :] + y * axes[1][:, :, None]
            cell = (abs(x) * step[0] + abs(y) * step[1]) / 2
            ends = (low - cell)[:, None, None], (high + cell)[:, None, None]
            found &= (along >= ends[0]) & (along <= ends[1])
        return found

    def _margin(self) -> float:
        """By what part the light may reach farther than the outermost rays: they lie inside of the
        rim, and between two of their azimuths."""
        order = self.degree // 2 + 1
        outermost = np.polynomial.legendre.leggauss(order + self.clipped)[0][-1]
        radius = (1 + outermost) / 2 if self.clipped else np.sqrt((1 + outermost) / 2)
        return float(1.005 / (radius * np.cos(np.pi / (2 * self.azimuths + 2))))

    def _with_edges(self, values: list[Array]) -> Array:
        """The values, and hits on all surfaces of a beam that their edges clip, (D, W, Q)."""
        edges = [self.hits.reshape(-1, *self.path.shape)] if self.clipped else []
        return jnp.concatenate([*values, *edges])

    def _along_motion(self) -> Array:
        """Cosine (W,) between the middle of the light and the way that the sensor moves."""
        return jnp.sum(means(self.direction, self._light()) * self.motion[:, None], axis=0)

    def _light(self) -> Array:
        """Weights (W, Q) above 0: where light is taken away, rays stand for it as well."""
        weights = jnp.where(self.known, jnp.abs(self.weights), 0)
        return jnp.where(self.throughput[:, None] > 0, weights, 1)

    def _fitted(self, points: Array, values: Array) -> Polynomials:
        # A constant of its own, so that float32 rounds the rest of the values alone.
        mean = jax.lax.stop_gradient(means(values, self._light()))
        found = fitted(points, values - mean[..., None], self._light(), self.degree, self.azimuths)
        coefficients = found.coefficients.at[..., 0].add(mean.T)
        return dataclasses.replace(found, coefficients=coefficients)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class BeamRule:
    """Which rays make a beam, and the degree of its polynomials, see `beam_rule`; the mask in its
    stop, if there is one."""

    rule: PupilRule
    degree: int = dataclasses.field(metadata={"static": True})
    mask: Mask | None = None


def beam_rule(degree: int, symmetry: Symmetry, clipped: PupilRule | None = None) -> BeamRule:
    """The fewest rays that give polynomials of a degree: a rule that integrates products of two of
    them. clipped: the rule of a clipped pupil, if it is, whose kind is kept."""
    order = degree // 2 + 1
    if isinstance(clipped, Clipped):
        rule = dataclasses.replace(clipped, order=order + 1, size=order + 1)
        return BeamRule(rule, degree)
    if symmetry == "rotational":
        return BeamRule(Pattern(*meridian(order), symmetry), degree)
    pattern = half_disc if symmetry == "bilateral" else disc
    return BeamRule(Pattern(*pattern(order, degree + 1), symmetry), degree)


def trace_beam(lens: Lens, scene: Scene, rule: BeamRule, solver: Solver = solve) -> Beam:
    """The beam of an object point. Differentiable in the modes of the solver."""
    points, weights = rule.rule.points(lens, scene)
    bundle = trace_bundle(lens, scene, points, solver)
    symmetry: Symmetry = rule.rule.symmetry
    weights = jnp.where(fits(symmetry, scene.field), weights, 0)
    weights = weights * rule.rule.transmission(lens, bundle)
    clipped = isinstance(rule.rule, Clipped)
    beam = beam_of(lens, scene, points, weights, bundle, symmetry, rule.degree, clipped)
    return dataclasses.replace(beam, mask=rule.mask)


def beam_of(
    lens: Lens,
    scene: Scene,
    points: tuple[Array, ...],
    weights: Array,
    bundle: Bundle,
    symmetry: Symmetry,
    degree: int,
    clipped: bool,
    azimuths: int | None = None,
) -> Beam:
    """The beam of traced rays; `points` and `symmetry` are those of their rule, `weights` (W, Q)
    theirs times what they transmit. azimuths: None for `degree`."""
    known = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
    index = lens.index(scene.wavelengths)[-1]
    hits = [jnp.where(known, h, 0) for h in bundle.hits]
    arrival = [jnp.where(known, a, 0) for a in bundle.arrival]
    sensor = tuple(h[-1] for h in hits)
    path = bundle.path - index[:, None] * dot(tuple(arrival[:-1]), sensor)
    # A constant is no phase.
    path = jnp.where(known, path, 0)
    total = jnp.sum(known, axis=-1, keepdims=True).astype(path.dtype)
    mean = safe_divide(jnp.sum(path, axis=-1, keepdims=True), total)
    path = jnp.where(known, path - jax.lax.stop_gradient(mean), 0)
    turns, mirrors = _images(symmetry, degree)
    images, motion = len(turns) * len(mirrors), lens.sensor_motion

    def spread(vector: Sequence[Array]) -> Array:
        return _spread(turns, mirrors, vector)

    def repeated(values: Array) -> Array:
        return jnp.tile(jnp.broadcast_to(values, known.shape), (1, images))

    beam = Beam(
        points=spread([jnp.broadcast_to(p, known.shape) for p in points]),
        weights=repeated(weights) / images,
        hits=spread(hits),
        direction=jnp.concatenate([spread(arrival[:-1]), repeated(arrival[-1])[None]]),
        path=repeated(path),
        index=index,
        motion=jnp.array([0, 0, 1], index.dtype) if motion is None else motion,
        curvature=reference_curvature(lens, scene.wavelengths),
        known=repeated(known),
        degree=degree,
        azimuths=degree if azimuths is None else azimuths,
        clipped=clipped,
    )
    return _filled(beam)


def _filled(beam: Beam) -> Beam:
    """The beam; for a wavelength of which no light arrives, rays without light that fill a pupil,
    so that all that follows from them is finite."""
    count = beam.path.shape[-1]
    place = np.arange(count) + 0.5
    spiral = np.sqrt(place / count) * np.exp(2.4j * place)
    disc = jnp.asarray(np.stack([spiral.real, spiral.imag])[:, None], beam.path.dtype)
    lit = beam.throughput[:, None] > 0
    return dataclasses.replace(
        beam,
        points=jnp.where(lit, beam.points, disc),
        weights=jnp.where(lit, beam.weights, 0),
        direction=jnp.where(lit, beam.direction, jnp.concatenate([disc, disc[:1]])),
        known=beam.known | ~lit,
    )


def _extent(places: Array, known: Array, margin: float) -> tuple[Array, Array]:
    """Ends (..., W) of what holds all light whose rays are at places (..., W, Q)."""
    low = jnp.min(jnp.where(known, places, jnp.inf), axis=-1)
    high = jnp.max(jnp.where(known, places, -jnp.inf), axis=-1)
    middle, half = (low + high) / 2, margin * (high - low) / 2
    return middle - half, middle + half


def _images(symmetry: Symmetry, degree: int) -> tuple[np.ndarray, tuple[int, ...]]:
    """Azimuths by which, and signs of x with which, rays of a part of the pupil fill all of it."""
    if symmetry == "rotational":
        azimuths = 2 * degree + 1
        return 2 * np.pi * np.arange(azimuths) / azimuths, (1,)
    return np.zeros(1), ((1, -1) if symmetry == "bilateral" else (1,))


def _spread(turns: np.ndarray, mirrors: tuple[int, ...], vector: Sequence[Array]) -> Array:
    """Vectors of rays, D arrays (..., Q), turned and mirrored: (2, ..., images Q)."""
    if len(vector) == 1:
        # Python numbers: NumPy's would make float32 double.
        sides = zip(np.cos(turns).tolist(), np.sin(turns).tolist())
        parts = [(x * vector[0], y * vector[0]) for x, y in sides]
    else:
        parts = [(sign * vector[0], vector[1]) for sign in mirrors]
    return jnp.stack([jnp.concatenate(side, axis=-1) for side in zip(*parts)])


def means(values: Array, weights: Array) -> Array:
    """Means (D, W) of values (D, W, Q) with weights (W, Q)."""
    total = einsum("wq,dwq->dw", weights, values)
    return safe_divide(total, jnp.broadcast_to(jnp.sum(weights, -1), total.shape))


def centroid_and_variances(hits: Array, weights: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    """Centroid (2, W) of hits (2, W, Q) and their variances xx, xy, yy, (W,) each."""
    mean = means(hits, weights)
    x, y = hits - mean[..., None]
    xx, xy, yy = means(jnp.stack([x * x, x * y, y * y]), weights)
    return mean, (xx, xy, yy)
