"""Centroid and covariance of the rays on the sensor, and what need not be traced again.

The paper computes both from 256 random rays for each sensor position. Here the pupil
integral is a Gauss rule whose order follows from the tolerance, on the part of the pupil
that symmetry leaves; and where only the sensor moves the rays behind the lens are traced once,
because the moments are then exact polynomials in the sensor position.
"""

import dataclasses
import warnings
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from ..pupil import rules as pupil
from ..rays.fermat import Status
from ..lens.glass import check_wavelengths
from ..rays.implicit import Found
from ..lens.lens import Lens, rotation_matrix
from ..numerics import concrete, known_values, safe_divide, safe_sqrt
from ..rays.trace import trace_bundle, typed_scene
from ..pupil.clipped import ClippedPupil, find_boundary, fitted_nodes

__all__ = ["FocusMoments", "focus_moments", "psf_moments", "pupil_order"]

_MAX_ORDER = 40
# A spot below 1 nm is a point: relative to it, rounding would never converge.
_SMALLEST = 1e-6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class FocusMoments:
    """Moments of W colours as polynomials in the sensor position: no ray is traced again.

    With d = sensor - reference (mm): centroid = mean + d slope, covariance = spread[0] +
    d spread[1] + d^2 spread[2]. mean, slope (W, 2); spread (3, W, C) with C = 2 for the
    variances (xx, yy) when symmetry makes the axes principal, else C = 3 (xx, yy, xy);
    passed (W,), the fraction of the light that reaches the sensor.
    """

    reference: Array
    mean: Array
    slope: Array
    spread: Array
    passed: Array

    def at(self, sensor: ArrayLike) -> tuple[Array, Array]:
        """Centroid (W, 2) in mm and covariance in mm^2 with the sensor at `sensor` mm.

        The covariance is (W, 2), its diagonal, when the axes are principal by symmetry;
        else (W, 2, 2).
        """
        return _at(self, jnp.asarray(sensor, self.reference.dtype))


@jax.jit
def _at(moments: FocusMoments, sensor: Array) -> tuple[Array, Array]:
    # One program rather than one for each operation.
    d = sensor - moments.reference
    spread = moments.spread[0] + d * (moments.spread[1] + d * moments.spread[2])
    mean = moments.mean + d * moments.slope
    return mean, spread if spread.shape[-1] == 2 else _matrix(spread)


@jax.jit
def _matrix(spread: Array) -> Array:
    """(W, 2, 2) from the components (xx, yy) or (xx, yy, xy) in the last axis."""
    xx, yy = spread[..., 0], spread[..., 1]
    xy = spread[..., 2] if spread.shape[-1] == 3 else jnp.zeros_like(xx)
    return jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)


def _symmetry(lens: Lens, field: ArrayLike) -> str:
    """How much of the pupil must be traced, from what is known of the field while tracing.

    In a lens with an axis, a field known to be 0 needs one radius. A single angle lies along
    y, so half a pupil does. A field whose value is not known and that may lie anywhere, or a
    lens without symmetry, needs the whole.
    """
    kind = lens.symmetry
    if kind == "none":
        return "disc"
    if np.ndim(field) == 0:
        still = concrete(field) and float(field) == 0
        return "meridian" if still and kind == "rotation" else "half"
    if not concrete(field) or np.asarray(field)[0] != 0:
        return "disc"
    return "meridian" if np.asarray(field)[1] == 0 and kind == "rotation" else "half"


def _rule(symmetry: str, order: int) -> tuple[np.ndarray, np.ndarray]:
    if symmetry == "meridian":
        return pupil.meridian(order)
    # An aberration of degree p in the pupil reaches azimuthal order p: as many azimuths on
    # the half disc as there are radial nodes integrate its square to the same degree.
    return (pupil.half_disc if symmetry == "half" else pupil.disc)(order, order + 1)


def focus_moments(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    tolerance: float = 1e-6,
    order: int | ClippedPupil | None = None,
    soft_edge: float | None = None,
    forward: bool = False,
) -> FocusMoments:
    """Moments of the rays as functions of the sensor position, about `lens.sensor`.

    Arguments as in `psf_moments`; the tolerance holds at any sensor position (inside `jax.jit`,
    see `pupil_order`). Differentiable in all lens parameters; rays that fail or are clipped
    have weight 0, and the rest is normalised. Paper section 4.3.
    """
    scene = lens, field, distance, wavelengths
    return _moments(scene, tolerance, order, soft_edge, forward, moving=True)


def psf_moments(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    tolerance: float = 1e-6,
    order: int | ClippedPupil | None = None,
    soft_edge: float | None = None,
    forward: bool = False,
) -> tuple[Array, Array]:
    """Centroid (W, 2) in mm and covariance (W, 2, 2) in mm^2 of the rays on the sensor.

    `field`: angle along y, or (x, y), in radians. `distance`: mm from the object plane
    to the first vertex, inf allowed. `wavelengths` (W,) in um. `tolerance`: relative
    error of the RMS spot size; the number of rays follows from it, unless `order` (1 to 40,
    or what `pupil_order` returns) is given. `soft_edge`: a width in mm over which clear apertures
    fade instead of cutting off. `forward`: be differentiable in forward mode (`jax.jvp`,
    `jax.jacfwd`) instead of reverse mode; without it JAX refuses, naming a custom_vjp function.

    Rays fill the stop uniformly; where clear apertures clip it, the nodes are fitted to what is
    left. ValueError if no ray of a colour arrives; under `jax.jit`, where that cannot be known,
    both are 0 then (`focus_moments(...).passed` tells). Known zero field: meridional rays only;
    field along y: half the pupil. Paper section 4.3.
    """
    scene = lens, field, distance, wavelengths
    moments = _moments(scene, tolerance, order, soft_edge, forward, moving=False)
    mean, covariance = moments.at(lens.sensor)
    return mean, covariance if covariance.ndim == 3 else _matrix(covariance)


def pupil_order(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    tolerance: float = 1e-6,
    moving: bool = False,
) -> int | ClippedPupil:
    """What to pass as `order` to keep the RMS spot size within `tolerance` (relative).

    At the lens's sensor position or, if `moving`, at any: there the spot may be far smaller.

    The Gauss order n of a rule on the stop, or a rule fitted to what clear apertures leave of
    it. Orders n and n + 1 are compared on the scene itself: their difference in the
    covariance, relative to its trace, is twice the error of n in the spot size, and may
    be at most `tolerance`, which leaves a factor of two for the error of n + 1. Inside
    `jax.jit`, where the scene is not known, a rule with two nodes in hand takes its place,
    whose clipped rays drop out one by one: to have the measured order there, call this function
    outside and pass the result on. A fitted rule follows the lens to first order.
    """
    check_wavelengths(lens.glasses, wavelengths)
    symmetry = _symmetry(lens, field)
    known = known_values((lens, field, distance, wavelengths))
    if known is None:
        return _blind_order(symmetry, tolerance)
    with jax.core.eval_context():
        return _converge(known, symmetry, tolerance, moving)[0]


def _blind_order(symmetry: str, tolerance: float) -> int:
    """Order for a scene whose numbers are not known, inside a trace.

    The error falls by two to three digits with each node, on axis and off, for the bundled
    lenses out to 14 degrees (`experiments.accuracy`); two nodes are in hand, off axis three.
    """
    _check_tolerance(tolerance)
    digits = -np.log10(tolerance)
    return min(int(np.ceil(digits / 2)) + (2 if symmetry == "meridian" else 3), _MAX_ORDER)


def _check_tolerance(tolerance: float) -> None:
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}")


def _moments(
    scene: tuple,
    tolerance: float,
    order: int | ClippedPupil | None,
    soft_edge: float | None,
    forward: bool,
    moving: bool,
) -> FocusMoments:
    lens, field, _, wavelengths = scene
    check_wavelengths(lens.glasses, wavelengths)
    if isinstance(order, int) and not 1 <= order <= _MAX_ORDER:
        raise ValueError(f"order: expected 1 to {_MAX_ORDER}, got {order}")
    if soft_edge is not None and not soft_edge > 0:
        raise ValueError(f"soft_edge: expected a width above 0 mm, got {soft_edge!r}")
    symmetry = _symmetry(lens, field)
    options = symmetry, soft_edge, forward
    known = known_values((scene, order if isinstance(order, ClippedPupil) else None))
    if known is None:
        if order is None:
            order = _blind_order(symmetry, tolerance)
        rule = order if isinstance(order, ClippedPupil) else _rule(symmetry, order)
        return _plane_moments(*scene, rule, *options)[0]
    known, fitted = known
    # Outside of any trace, also where this is called inside one: what follows is all known.
    with jax.core.eval_context():
        if order is None:
            order, moments, found = _converge(known, symmetry, tolerance, moving, soft_edge)
        elif isinstance(order, int):
            order, moments, found = _of_order(known, symmetry, order, soft_edge)
        else:
            moments, _, found = _known_moments(known, fitted, symmetry, soft_edge)
        _check_passed(moments, known[3])
    if concrete((scene, order)):
        return moments
    # The rays are known; what is left is to weigh and to differentiate them.
    rule = order if isinstance(order, ClippedPupil) else _padded_rule(symmetry, order)
    return _plane_moments(*scene, rule, *options, found)[0]


def _known_moments(
    scene: tuple,
    rule: tuple[ArrayLike, ArrayLike] | ClippedPupil,
    symmetry: str,
    soft_edge: float | None,
    failing: bool = False,
) -> tuple[FocusMoments, Array, Found]:
    """`_plane_moments` of a known scene: few need a program that can search for rays twice, tried
    first if rays are known to be `failing`."""
    if not failing:
        weighed = _plane_moments(*scene, rule, symmetry, soft_edge, thorough=False)
        if not _failing(weighed[2]):
            return weighed
    return _plane_moments(*scene, rule, symmetry, soft_edge)


def _failing(found: Found) -> bool:
    return bool(np.any(np.asarray(found.status) != Status.OK))


def _of_order(
    scene: tuple, symmetry: str, order: int, soft_edge: float | None
) -> tuple[int | ClippedPupil, FocusMoments, Found]:
    """The rule of an order, fitted to the pupil if it is clipped, its moments and rays."""
    rule = _padded_rule(symmetry, order)
    moments, clipped, found = _known_moments(scene, rule, symmetry, soft_edge)
    if soft_edge is None and clipped:
        boundary = find_boundary(*_typed(*scene, symmetry), symmetry)
        if boundary is not None:
            rule = boundary.rule(order)
            moments, _, found = _known_moments(scene, rule, symmetry, None)
            return rule, moments, found
    return order, moments, found


def _converge(
    scene: tuple, symmetry: str, tolerance: float, moving: bool, soft_edge: float | None = None
) -> tuple[int | ClippedPupil, FocusMoments, Found]:
    """The order that meets the tolerance in a known scene, the moments of the next one that
    proved it, and the rays of the first; where the pupil is clipped, all of the fitted rule that
    proved it. Warns if none does."""
    _check_tolerance(tolerance)
    eps = float(jnp.finfo(scene[0].curvature.dtype).eps)
    previous, boundary, found, order = None, None, None, 2
    while True:
        rule = boundary.rule(order) if boundary else _padded_rule(symmetry, order)
        before, failing = found, found is not None and _failing(found)
        moments, clipped, found = _known_moments(scene, rule, symmetry, soft_edge, failing)
        if clipped and boundary is None and soft_edge is None:
            boundary = find_boundary(*_typed(*scene, symmetry), symmetry)
            if boundary is not None:
                previous, order = None, 4
                continue
        _check_passed(moments, scene[3])
        spread = np.asarray(moments.spread, float)
        if previous is not None:
            places = (0, *(_best_focus(spread) if moving else ()))
            change = max(_change(spread, previous, d) for d in places)
            # Hits are rounded to some last digits of the length of the lens.
            size = np.sqrt(np.min(np.sum(spread[0, :, :2], axis=-1)))
            rounding = 4 * eps * abs(float(scene[0].sensor)) / max(size, _SMALLEST)
            bound = max(tolerance, 100 * eps, rounding)
            if change <= bound:
                break
        if order > _MAX_ORDER:
            warnings.warn(
                f"the spot size has converged to {change:.1e} only, not to {bound:.1e}, with the "
                f"order {order}; does the edge of the beam fail, or a soft edge fade too fast?",
                stacklevel=4,
            )
            break
        previous, order = spread, order + (2 if boundary else 1)
    return (rule, moments, found) if boundary else (order - 1, moments, before)


def _typed(
    lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: ArrayLike, symmetry: str
) -> tuple[Lens, Array, Array, Array]:
    """The scene as `trace_bundle` takes it: a field of one angle for meridional rays."""
    scene = typed_scene(lens, field, distance, wavelengths)
    return (lens, jnp.zeros_like(scene[1][:1]), *scene[2:]) if symmetry == "meridian" else scene


def _padded_rule(symmetry: str, order: int) -> tuple[np.ndarray, np.ndarray]:
    """A rule filled up with weightless rays, so that all orders share a few compiled programs.

    They run along the rim of the stop, where clear apertures clip first.
    """
    points, weights = _rule(symmetry, order)
    sizes = (_MAX_ORDER + 2,) if symmetry == "meridian" else (208, 416, 1768, 3536)
    missing = next(size for size in sizes if size >= weights.size + len(points)) - weights.size
    turn = np.pi if symmetry == "half" else 2 * np.pi
    angle = -np.pi / 2 + turn * np.arange(missing) / max(missing - 1, 1)
    rim = np.stack([np.cos(angle), np.sin(angle)]) if len(points) == 2 else np.ones((1, missing))
    return np.concatenate([points, rim], axis=1), np.pad(weights, (0, missing))


def _plane_moments(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    rule: tuple[ArrayLike, ArrayLike] | ClippedPupil,
    symmetry: str,
    soft_edge: float | None = None,
    forward: bool = False,
    found: Found | None = None,
    thorough: bool = True,
) -> tuple[FocusMoments, Array, Found]:
    scene = _typed(lens, field, distance, wavelengths, symmetry)
    if not isinstance(rule, ClippedPupil):
        rule = tuple(jnp.asarray(part, lens.curvature.dtype) for part in rule)
    if soft_edge is not None:
        soft_edge = jnp.asarray(soft_edge, lens.curvature.dtype)
    return _weigh(*scene, rule, soft_edge, found, symmetry, forward, thorough)


@partial(jax.jit, static_argnums=(7, 8, 9))
def _weigh(
    lens: Lens,
    angles: Array,
    distance: Array,
    wavelengths: Array,
    rule: tuple[Array, Array] | ClippedPupil,
    soft_edge: Array | None,
    found: Found | None,
    symmetry: str,
    forward: bool,
    thorough: bool,
) -> tuple[FocusMoments, Array, Found]:
    """The moments, whether an aperture clips any ray of the rule, and its rays; these may be known
    already, see `solve_rays`."""
    dtype = lens.curvature.dtype
    scene = lens, angles, distance, wavelengths
    if isinstance(rule, ClippedPupil):
        rule = fitted_nodes(*scene, rule, forward)
    points, weights = rule
    bundle = trace_bundle(*scene, points, forward, found, thorough)
    found = jax.lax.stop_gradient(bundle.found)
    # How the hits move with the sensor, which goes along the axis of the lens.
    slope = safe_divide(bundle.arrival[:-1], bundle.arrival[-1])
    if lens.tilt is not None:
        axis = rotation_matrix(lens.tilt[-1])[2]
        slope = slope * axis[2] - axis[:2, None, None]
    hits, clipped = bundle.hits, bundle.status == Status.CLIPPED
    good = bundle.status == Status.OK
    if isinstance(rule, ClippedPupil) or soft_edge is not None:
        good = good | clipped
    weight = jnp.where(good, weights, 0)
    if soft_edge is not None:
        weight = weight * _fade(lens, hits, soft_edge)
    passed = jnp.sum(weight, axis=-1)
    weight = safe_divide(weight, passed[:, None])

    def average(values):
        return jnp.sum(weight * values, axis=-1)

    x, u = jnp.where(good, hits[:, -1], 0), jnp.where(good, slope, 0)
    if symmetry == "meridian":
        # y = rho(r) on one radius; over the full circle <xx> = <yy> = <rho^2> / 2.
        zero = jnp.zeros((wavelengths.shape[0], 2), dtype)
        spread = jnp.stack([average(x[0] * x[0]), 2 * average(x[0] * u[0]), average(u[0] * u[0])])
        spread = jnp.broadcast_to(spread[..., None] / 2, (*spread.shape, 2))
        moments = FocusMoments(lens.sensor, zero, zero, spread, passed)
        return moments, jnp.any(clipped), found
    mean, tilt = average(x), average(u)
    if symmetry == "half":
        # The other half is the mirror image: x averages to 0, and so does x y.
        mean, tilt = mean.at[0].set(0), tilt.at[0].set(0)
    x, u = x - mean[..., None], u - tilt[..., None]
    pairs = ((0, 0), (1, 1)) if symmetry == "half" else ((0, 0), (1, 1), (0, 1))
    spread = jnp.stack(
        [
            jnp.stack([average(x[i] * x[j]) for i, j in pairs], -1),
            jnp.stack([average(x[i] * u[j] + u[i] * x[j]) for i, j in pairs], -1),
            jnp.stack([average(u[i] * u[j]) for i, j in pairs], -1),
        ]
    )
    moments = FocusMoments(lens.sensor, mean.T, tilt.T, spread, passed)
    return moments, jnp.any(clipped), found


def _fade(lens: Lens, hits: Array, width: Array) -> Array:
    """Transmission (W, Q) of soft apertures: each a logistic step of the given width in r."""
    radius = safe_sqrt(jnp.sum(hits[:, :-1] ** 2, axis=0))
    edge = lens.semi_diameter[:, None, None]
    bounded = jnp.isfinite(edge).at[lens.stop].set(False)
    within = jnp.where(bounded, (jnp.where(bounded, edge, 0) - radius) / width, jnp.inf)
    return jnp.prod(jax.nn.sigmoid(within), axis=0)


def _best_focus(spread: np.ndarray) -> np.ndarray:
    """Where the spot of each colour is smallest (W,), mm behind the reference."""
    _, linear, square = np.sum(spread[..., :2], axis=-1)
    return -linear / np.where(square > 0, 2 * square, 1)


def _change(spread: np.ndarray, previous: np.ndarray, d: float) -> float:
    """Largest change of the covariance relative to its trace, the sensor at `d` mm."""
    now, before = (s[0] + d * (s[1] + d * s[2]) for s in (spread, previous))
    size = np.sum(now[:, :2], axis=-1, keepdims=True)
    return float(np.max(np.abs(now - before) / np.maximum(size, _SMALLEST**2)))


def _check_passed(moments: FocusMoments, wavelengths: ArrayLike) -> None:
    for passed, wavelength in zip(np.asarray(moments.passed), np.atleast_1d(wavelengths)):
        if not passed > 0:
            raise ValueError(
                f"no ray at {float(wavelength):g} um reaches the sensor: every one misses a "
                "surface, is totally reflected or is clipped; see trace_rays(...).status"
            )
