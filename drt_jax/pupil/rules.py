"""Quadrature rules on the pupil: points on the stop with weights.

A rule is a value: a frozen pytree whose kind, order and symmetry are static. It chooses points on
the stop, their weights, and the transmission of each ray. The weights sum to 1 for a stop that is
filled with light; weights times transmission sum to the throughput. A `Mask` in the plane of the
stop, made of pixels, is a coded aperture, an apodiser or a phase plate.
"""

import abc
import dataclasses
import itertools
from functools import partial
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require_one_of
from ..lens.clearance import clearance
from ..lens.forms import FORMS
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import Numbers, brief, concrete, real_array, safe_divide
from ..rays.known import Known, known_rays
from ..rays.status import Status
from ..rays.system import Vector
from ..rays.trace import Bundle
from . import patterns

# Part of the pupil that is traced: one radius, the half x > 0, or the whole disc.
Symmetry = Literal["rotational", "bilateral", "none"]
MAX_ORDER = 42
# Number of leading components (x, then y) of a field that must be 0 for a symmetry to hold.
_ACROSS = {"rotational": 2, "bilateral": 1, "none": 0}
# Largest angle from a plane of symmetry for which a field counts as in it, radians.
_MAX_ANGLE = 1e-3
_UM = 1e3  # per mm
_ROUND = 64  # machine epsilons by which a ray aimed at the rim may miss a mask


def symmetry_of(lens: Lens, field: Numbers) -> Symmetry:
    """Symmetry of the pupil for given fields.

    lens: the lens.
    field: angle along y, one (x, y), or several (F, 2), radians.

    Returns "rotational" for fields on the axis of a rotationally symmetric lens, "bilateral" for
    fields along y if the lens is symmetric under x -> -x, else "none". ValueError inside `jit` or
    `vmap`, if the result depends on values that are tracers.
    """
    group, extra = lens.elements, lens.apertures
    shift, turned = (None, None) if group is None else (group.shift, group.tilt)
    moves = (lens.decentre, lens.tilt, shift, turned, extra and extra.centre)
    if not concrete((field, moves)):
        raise ValueError(
            "symmetry_of: needs known numbers; call it, or make the rule, outside of jax.jit and "
            "jax.vmap"
        )
    forms = (*lens.forms, *(() if lens.phase is None else lens.phase.forms))
    kinds = {FORMS[form].symmetry for form in forms}
    if extra is not None and {*extra.kinds} != {"circle"}:
        kinds.add("none" if "polygon" in extra.kinds else "bilateral")
    # True if nothing is shifted along x or rotated about y or z, out of the plane x = 0.
    sideways = zip(moves, ([0], [1, 2], [0], [1, 2], [0]), strict=True)
    still = not any(np.any(np.asarray(a)[:, k]) for a, k in sideways if a is not None)
    angles = np.asarray(field)
    if "none" in kinds or not still or (angles.ndim and np.any(angles[..., 0])):
        return "none"
    axial = kinds == {"rotational"} and all(a is None for a in moves) and not np.any(angles)
    return "rotational" if axial else "bilateral"


def fits(symmetry: Symmetry, field: Numbers) -> Array:
    """Whether the symmetry of a rule holds for fields, so that the rays on a part of the pupil
    represent the whole pupil.

    symmetry: symmetry of the rule.
    field: (..., 2), radians.

    Returns bool (...). Angles up to `_MAX_ANGLE` from the plane of symmetry are accepted, so that
    finite differences can be taken there.
    """
    return ~jnp.any(jnp.abs(jnp.asarray(field)[..., : _ACROSS[symmetry]]) > _MAX_ANGLE, axis=-1)


def require_fit(symmetry: Symmetry, field: Numbers) -> None:
    """ValueError if the symmetry of a rule does not hold for fields (..., 2), as far as these
    are known (no tracers)."""
    # NumPy, because inside of a trace the result of a JAX operation on known numbers is a tracer.
    if concrete(field) and np.any(np.abs(np.asarray(field)[..., : _ACROSS[symmetry]]) > _MAX_ANGLE):
        where = {"rotational": "the axis", "bilateral": "fields along y"}[symmetry]
        raise ValueError(
            f"the rule is made for {where} and traces a part of the pupil only; the field has "
            "another symmetry: make the rule or model for all fields that it is used for"
        )


class PupilRule(abc.ABC):
    """Base class of the rules: `points` on the stop with weights, and the `transmission` of each
    ray.

    symmetry: part of the pupil that is traced, see `symmetry_of`.
    """

    symmetry: Symmetry

    def plan(self, lens: Lens, scene: Scene) -> Any:
        """What is searched for before the points are known; None if nothing is. It is a constant
        in derivatives."""
        return None

    @abc.abstractmethod
    def points(self, lens: Lens, scene: Scene, plan: Any = None) -> tuple[Vector, Array]:
        """Points on the stop in units of its semi-diameter, and their weights.

        plan: result of `plan` for the same lens and scene; None to search now.

        Returns D arrays (Q,) or (W, Q), D = 1 for "rotational" and 2 otherwise, and weights (1, Q)
        or (W, Q).
        """

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """Transmitted fraction (W, Q) of each ray; 0 for rays that fail or are clipped."""
        return (bundle.status == Status.OK).astype(bundle.path.dtype)


def gauss_points(order: int, symmetry: Symmetry) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of a Gauss rule on the part of the pupil that is traced.

    order: number of nodes in r^2.
    symmetry: see `symmetry_of`.

    Returns points (Q, D) and weights (Q,). An aberration of degree p in the pupil has azimuthal
    orders up to p. With order + 1 azimuths on the half disc, the azimuths and the radii integrate
    the square of an aberration exactly to the same degree.
    """
    if symmetry == "rotational":
        return patterns.meridian(order)
    return (patterns.half_disc if symmetry == "bilateral" else patterns.disc)(order, order + 1)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Gauss(PupilRule):
    """Gauss rule on the stop. Rays that fail or are clipped are left out one by one.

    order: number of nodes n in r^2, 1 to 42; n rays for "rotational", n (n + 1) for "bilateral",
        twice as many for "none".
    symmetry: see `symmetry_of`.
    """

    order: int = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})

    def __post_init__(self) -> None:
        check_rule(self.order, self.symmetry)

    def points(self, lens: Lens, scene: Scene, plan: Any = None) -> tuple[Vector, Array]:
        """Points and weights of the order, which are constants."""
        points, weights = gauss_points(self.order, self.symmetry)
        dtype = lens.curvature.dtype
        return tuple(jnp.asarray(p, dtype) for p in points.T), jnp.asarray(weights, dtype)[None]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Soft(PupilRule):
    """Gauss rule with soft aperture edges: the transmission of each edge is a logistic function of
    the clearance.

    order, symmetry: as in `Gauss`.
    width: (), width of the logistic function, mm: transmission = 1 / (1 + exp(-clearance / width)).
    """

    order: int = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    width: Numbers

    def __post_init__(self) -> None:
        check_rule(self.order, self.symmetry)
        if isinstance(self.width, int | float) and not self.width > 0:
            raise ValueError(f"width: expected a number above 0 mm, got {self.width!r}")

    def points(self, lens: Lens, scene: Scene, plan: Any = None) -> tuple[Vector, Array]:
        """Points and weights of the order, which are constants."""
        return Gauss(self.order, self.symmetry).points(lens, scene)

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """Product (W, Q) of the transmissions of all apertures and obscurations except the rim
        of the stop; 0 for rays that fail."""
        inside = clearance(lens, bundle.hits)
        bounded = jnp.isfinite(inside)  # its derivative by the width would be NaN
        inside = jnp.where(bounded, inside, 0) / jnp.asarray(self.width, inside.dtype)
        steps = jax.nn.sigmoid(jnp.where(bounded, inside, jnp.inf))
        return jnp.where(bundle.arrives, jnp.prod(steps, axis=0), 0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pattern(PupilRule):
    """Rule with given points on the stop, such as those of `pupil.hexapolar`. Clipped rays are left
    out.

    positions: (Q, 2), x and y in units of the semi-diameter of the stop; (Q, 1) for "rotational".
    weights: (Q,), which sum to 1 for a stop that is filled with light.
    symmetry: see `symmetry_of`.
    """

    positions: Numbers
    weights: Numbers
    symmetry: Symmetry = dataclasses.field(metadata={"static": True}, default="none")
    __repr__ = brief

    def points(self, lens: Lens, scene: Scene, plan: Any = None) -> tuple[Vector, Array]:
        """The given points and weights in the dtype of the lens. ValueError for wrong shapes."""
        dtype = lens.curvature.dtype
        positions = real_array("positions", self.positions, dtype)
        weights = real_array("weights", self.weights, dtype)
        columns = 1 if self.symmetry == "rotational" else 2
        if weights.ndim != 1 or not weights.size or positions.shape != (weights.size, columns):
            raise ValueError(
                f"Pattern: expected positions (Q, {columns}) and weights (Q,), got "
                f"{positions.shape} and {weights.shape}"
            )
        return tuple(positions.T), weights[None]


def check_rule(order: int, symmetry: Symmetry) -> None:
    """ValueError for an order outside of 1 to 42 and for an unknown symmetry."""
    whole = isinstance(order, int | np.integer) and not isinstance(order, bool)
    if not whole or not 1 <= order <= MAX_ORDER:
        raise ValueError(f"order: expected a whole number from 1 to {MAX_ORDER}, got {order!r}")
    require_one_of("symmetry", symmetry, get_args(Symmetry))


def planned(lens: Lens, scene: Scene, rule: PupilRule) -> tuple[Vector, Array, Any]:
    """Points, weights and plan of a rule for one object point; known numbers."""
    plan = rule.plan(lens, scene)
    return *_points(lens, scene, rule, plan), plan


@partial(jit, wanted=LARGE)
def _points(lens: Lens, scene: Scene, rule: PupilRule, plan: Any) -> tuple[Vector, Array]:
    """Points and weights of a rule, compiled."""
    return rule.points(lens, scene, plan)


def rule_rays(lens: Lens, scene: Scene, rule: PupilRule) -> Known:
    """Rays of a rule for all points of a scene, see `known_rays`."""

    def aim(lens: Lens, point: Scene, rule: PupilRule) -> tuple[Vector, Any]:
        points, _, plan = planned(lens, point, rule)
        return points, plan

    return known_rays(lens, scene, rule, aim)


def pupil_points(lens: Lens, scene: Scene, rule: PupilRule) -> tuple[Array, Array]:
    """Points where the rays of a rule cross the stop, and their weights.

    lens, scene: as in `trace_rays`.
    rule: the pupil rule.

    Returns points (..., W, Q, 2), in units of the semi-diameter of the stop, and weights
    (..., W, Q). Both
    are differentiable in the lens. The points of a "rotational" rule lie on the y axis and
    represent all azimuths.
    """

    def one(point: Scene) -> tuple[Array, Array]:
        points, weights = rule.points(lens, point)
        shape = (point.wavelengths.shape[0], weights.shape[-1])
        x, y = (points[0] * 0, points[0]) if len(points) == 1 else points
        stacked = jnp.stack([jnp.broadcast_to(a, shape) for a in (x, y)], axis=-1)
        return stacked, jnp.broadcast_to(weights, shape)

    return over_points(one, checked_scene(lens, scene))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Mask:
    """A mask in the stop: N x M pixels [y, x] on the square that circumscribes the stop.

    Row 0 has the lowest y and column 0 the lowest x. Transmission and path are constant over a
    pixel.

    amplitude: (N, M), or (W, N, M) with one table for each wavelength; amplitude transmission. The
        transmitted fraction of the light is its square.
    path: same shape as `amplitude`, optical path that a pixel adds, mm; None for none. It changes
        the phase of waves only; the directions of rays do not change.
    """

    amplitude: Array
    path: Array | None = None
    __repr__ = brief

    def check(self) -> None:
        """ValueError if the shapes of `amplitude` and `path` are not those of the class
        docstring."""
        shape = jnp.shape(self.amplitude)
        other = shape if self.path is None else jnp.shape(self.path)
        if len(shape) not in (2, 3) or other != shape:
            what = "expected an amplitude (N, M) or (W, N, M) and a path of that shape or None"
            raise ValueError(f"mask: {what}, got {shape} and {other}")

    def light(self, at: Array, half: Array) -> Array:
        """Mean of amplitude^2 over boxes, (W, ...); arguments as in `means`."""
        return self.means(jnp.asarray(self.amplitude, at.dtype) ** 2, at, half)

    def waves(self, wavelengths: Array, at: Array, half: Array) -> Array:
        """Mean of amplitude exp(2 pi i path / wavelength) over boxes, complex (W, ...).

        wavelengths: (W,), um.
        at, half: boxes, as in `means`.
        """
        given = self.amplitude, 0 * self.amplitude if self.path is None else self.path
        amplitude, path = (jnp.asarray(a, wavelengths.dtype) for a in given)
        shape = jnp.broadcast_shapes(path.shape, (len(wavelengths), 1, 1))
        phase = 2 * jnp.pi * _UM / wavelengths[:, None, None] * jnp.broadcast_to(path, shape)
        size = jnp.broadcast_to(amplitude, shape)
        return self.means(jax.lax.complex(size * jnp.cos(phase), size * jnp.sin(phase)), at, half)

    @staticmethod
    def means(pixels: Array, at: Array, half: Array) -> Array:
        """Means of a table of pixels over boxes, (W, ...).

        pixels: (N, M) or (W, N, M).
        at: (2, W, ...), x and y of the centres of the boxes, in units of the semi-diameter of the
            stop.
        half: (2, W, ...), half the sides of the boxes, same unit.

        A box with sides along x and y that is no larger than a pixel overlaps at most two pixels
        along each axis, so the mean is exact: a sum of four pixels with the product of the
        overlapped fractions as weights. A box of size 0 takes the pixel at its centre. Outside of
        the mask the table is 0.
        """
        padded = jnp.pad(pixels, [(0, 0)] * (pixels.ndim - 2) + [(1, 1)] * 2)
        padded = jnp.broadcast_to(padded, (at.shape[1], *padded.shape[-2:]))
        ends = []  # along x and y: the two pixels that a box overlaps, and the fractions
        for point, reach, count in zip(at, half, pixels.shape[:-3:-1]):
            low, wide = (point - reach + 1) * (count / 2), reach * count
            # A ray aimed at the rim takes the outermost pixel, even if rounding puts it just
            # outside of the mask.
            near = jnp.abs(jnp.abs(point) - 1) <= _ROUND * float(jnp.finfo(point.dtype).eps)
            low = jnp.where(near & (reach == 0), jnp.clip(low, 0, count - 1), low)
            first = jnp.floor(low)
            second = jnp.clip(safe_divide(low + wide - first - 1, wide), 0, 1)
            place = jnp.clip(first, -1, count).astype(jnp.int32) + 1
            ends.append([(place, 1 - second), (jnp.minimum(place + 1, count + 1), second)])
        take = jax.vmap(lambda table, y, x: table[y, x])
        found = jnp.zeros(at.shape[1:], padded.dtype)
        for (x, part), (y, other) in itertools.product(*ends):
            found += (part * other).astype(padded.dtype) * take(padded, y, x)
        return found


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Masked(PupilRule):
    """A pupil rule whose rays are weighted with the transmission of a mask.

    rule: pupil rule of the symmetry "none".
    mask: mask without a path, because a path does not change rays.

    Each ray takes the transmission of the pixel that it crosses. With Q rays, a sum over the pixels
    has a relative error of about the fraction of rays whose neighbour crosses another pixel: take
    many rays, for instance a `Pattern` of `pupil.square_grid`. `Sampling.masked` needs no more rays
    than a model without a mask. ValueError, when rays are traced, for another symmetry and for a
    mask with a path.
    """

    rule: PupilRule
    mask: Mask

    @property
    def symmetry(self):  # type: ignore[override]
        """Symmetry of `rule`."""
        return self.rule.symmetry

    def plan(self, lens: Lens, scene: Scene) -> Any:
        """The plan of `rule`."""
        return self.rule.plan(lens, scene)

    def points(self, lens: Lens, scene: Scene, plan: Any = None) -> tuple[Vector, Array]:
        """Points and weights of `rule`. ValueError as described for the class."""
        self.mask.check()
        if self.symmetry != "none" or self.mask.path is not None:
            what = 'give a rule of the symmetry "none" and no path: a path acts on waves alone'
            raise ValueError(f"Masked: {what}, in psf")
        return self.rule.points(lens, scene, plan)

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """Transmission (W, Q) of `rule` times that of the mask."""
        at = jnp.stack([hit[lens.stop] for hit in bundle.hits]) / lens.semi_diameter[lens.stop]
        return self.rule.transmission(lens, bundle) * self.mask.light(at, jnp.zeros_like(at))
