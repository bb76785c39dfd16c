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

from . import pupil
from .fermat import Status
from .glass import check_wavelengths
from .lens import Lens, rotation_matrix
from .numerics import safe_divide
from .trace import as_field, trace_bundle

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
        d = jnp.asarray(sensor, self.reference.dtype) - self.reference
        spread = self.spread[0] + d * (self.spread[1] + d * self.spread[2])
        mean = self.mean + d * self.slope
        return mean, spread if spread.shape[-1] == 2 else _matrix(spread)


def _matrix(spread: Array) -> Array:
    """(W, 2, 2) from the components (xx, yy) or (xx, yy, xy) in the last axis."""
    xx, yy = spread[..., 0], spread[..., 1]
    xy = spread[..., 2] if spread.shape[-1] == 3 else jnp.zeros_like(xx)
    return jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)


def _concrete(*values: object) -> bool:
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def _symmetry(lens: Lens, field: ArrayLike) -> str:
    """How much of the pupil must be traced, from what is known of the field while tracing.

    In a lens with an axis, a field known to be 0 needs one radius. A single angle lies along
    y, so half a pupil does. A field whose value is not known and that may lie anywhere, or a
    lens without symmetry, needs the whole.
    """
    kind = lens.symmetry
    if kind == "none":
        return "disc"
    if jnp.ndim(field) == 0:
        still = _concrete(field) and float(field) == 0
        return "meridian" if still and kind == "rotation" else "half"
    if not _concrete(field) or np.asarray(field)[0] != 0:
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
    order: int | None = None,
    forward: bool = False,
) -> FocusMoments:
    """Moments of the rays as functions of the sensor position, about `lens.sensor`.

    Arguments as in `psf_moments`; the tolerance holds at any sensor position (inside `jax.jit`,
    see `pupil_order`). Differentiable in all lens parameters; rays that fail or are clipped
    have weight 0, and the rest is normalised. Paper section 4.3.
    """
    return _moments(lens, field, distance, wavelengths, tolerance, order, moving=True, forward=forward)


def _moments(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    tolerance: float,
    order: int | None,
    moving: bool,
    forward: bool,
) -> FocusMoments:
    check_wavelengths(lens.glasses, wavelengths)
    if not (order is None or 1 <= order <= _MAX_ORDER):
        raise ValueError(f"order: expected 1 to {_MAX_ORDER}, got {order}")
    symmetry = _symmetry(lens, field)
    known = _concrete(lens, field, distance, wavelengths)
    if order is None and known:
        return _converge(lens, field, distance, wavelengths, tolerance, moving)[1]
    if order is None:
        order = _blind_order(symmetry, tolerance)
    rule = _rule(symmetry, order)
    moments = _plane_moments(
        lens, field, distance, wavelengths, *(_pad(*rule) if known else rule), symmetry, forward
    )
    if known:
        _check_passed(moments, wavelengths)
    return moments


def _plane_moments(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    points: ArrayLike,
    weights: ArrayLike,
    symmetry: str,
    forward: bool = False,
) -> FocusMoments:
    dtype = lens.curvature.dtype
    angles = jnp.zeros(1, dtype) if symmetry == "meridian" else as_field(field, dtype)
    # One type for numbers, NumPy's and JAX's arrays, so that they share a compiled program.
    wavelengths = jnp.atleast_1d(jnp.asarray(wavelengths, dtype))
    distance, points, weights = (jnp.asarray(a, dtype) for a in (distance, points, weights))
    return _weigh(lens, angles, distance, wavelengths, points, weights, symmetry, forward)


@partial(jax.jit, static_argnums=(6, 7))
def _weigh(
    lens: Lens,
    angles: Array,
    distance: Array,
    wavelengths: Array,
    points: Array,
    weights: Array,
    symmetry: str,
    forward: bool,
) -> FocusMoments:
    dtype = lens.curvature.dtype
    bundle = trace_bundle(lens, angles, distance, wavelengths, points, forward)
    # How the hits move with the sensor, which goes along the axis of the lens.
    slope = safe_divide(bundle.arrival[:-1], bundle.arrival[-1])
    if lens.tilt is not None:
        axis = rotation_matrix(lens.tilt[-1])[2]
        slope = slope * axis[2] - axis[:2, None, None]
    hits, good = bundle.hits, bundle.status == Status.OK
    weight = jnp.where(good, jnp.asarray(weights, dtype), 0)
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
        return FocusMoments(lens.sensor, zero, zero, spread, passed)
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
    return FocusMoments(lens.sensor, mean.T, tilt.T, spread, passed)


def psf_moments(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    tolerance: float = 1e-6,
    order: int | None = None,
    forward: bool = False,
) -> tuple[Array, Array]:
    """Centroid (W, 2) in mm and covariance (W, 2, 2) in mm^2 of the rays on the sensor.

    `field`: angle along y, or (x, y), in radians. `distance`: mm from the object plane
    to the first vertex, inf allowed. `wavelengths` (W,) in um. `tolerance`: relative
    error of the RMS spot size; the number of rays follows from it (see `pupil_order`)
    unless `order` (1 to 40) is given. ValueError if no ray of a colour arrives; under
    `jax.jit`, where that cannot be known, both are 0 then (`focus_moments(...).passed`
    tells). Rays fill the stop uniformly. Known zero field: meridional rays only; field
    along y: half the pupil. Paper section 4.3.
    """
    moments = _moments(lens, field, distance, wavelengths, tolerance, order, moving=False, forward=forward)
    mean, covariance = moments.at(lens.sensor)
    return mean, covariance if covariance.ndim == 3 else _matrix(covariance)


def _blind_order(symmetry: str, tolerance: float) -> int:
    """Order for a scene whose numbers are not known, inside a trace.

    The error falls by two to three digits with each node on axis and by one off axis for
    the bundled lenses out to 10 degrees; two nodes are in hand.
    """
    _check_tolerance(tolerance)
    digits = -np.log10(tolerance)
    return min(int(np.ceil(digits / 2 if symmetry == "meridian" else digits)) + 2, _MAX_ORDER)


def pupil_order(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    tolerance: float = 1e-6,
    moving: bool = False,
) -> int:
    """Gauss order of the pupil that keeps the RMS spot size within `tolerance` (relative).

    At the lens's sensor position or, if `moving`, at any: there the spot may be far smaller.

    Orders n and n + 1 are compared on the scene itself: their difference in the
    covariance, relative to its trace, is twice the error of n in the spot size, and may
    be at most `tolerance`, which leaves a factor of two for the error of n + 1. Inside
    `jax.jit`, where the scene is not known, a rule with two nodes in hand takes its
    place: to have the measured order there, call this function outside and pass the
    result on.
    """
    check_wavelengths(lens.glasses, wavelengths)
    if _concrete(lens, field, distance, wavelengths):
        return _converge(lens, field, distance, wavelengths, tolerance, moving)[0]
    return _blind_order(_symmetry(lens, field), tolerance)


def _check_tolerance(tolerance: float) -> None:
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}")


def _converge(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    tolerance: float,
    moving: bool,
) -> tuple[int, FocusMoments]:
    """The order that meets the tolerance, and the moments of the next one that proved it.

    Warns if no order up to the largest does.
    """
    _check_tolerance(tolerance)
    symmetry = _symmetry(lens, field)
    bound = max(tolerance, 100 * float(jnp.finfo(lens.curvature.dtype).eps))
    previous = None
    for order in range(2, _MAX_ORDER + 2):
        points, weights = _pad(*_rule(symmetry, order))
        moments = _plane_moments(lens, field, distance, wavelengths, points, weights, symmetry)
        _check_passed(moments, wavelengths)
        spread = np.asarray(moments.spread, float)
        if previous is not None:
            change = max(
                _change(spread, previous, d) for d in (0, *(_best_focus(spread) if moving else ()))
            )
            if change <= bound:
                break
        previous = spread
    else:
        warnings.warn(
            f"the spot size has converged to {change:.1e} only, not to {bound:.1e}, with "
            f"{weights.size} rays a colour; does a clear aperture clip the beam?",
            stacklevel=4,
        )
    return order - 1, moments


def _best_focus(spread: np.ndarray) -> np.ndarray:
    """Where the spot of each colour is smallest (W,), mm behind the reference."""
    _, linear, square = np.sum(spread[..., :2], axis=-1)
    return -linear / np.where(square > 0, 2 * square, 1)


def _change(spread: np.ndarray, previous: np.ndarray, d: float) -> float:
    """Largest change of the covariance relative to its trace, the sensor at `d` mm."""
    now, before = (s[0] + d * (s[1] + d * s[2]) for s in (spread, previous))
    size = np.sum(now[:, :2], axis=-1, keepdims=True)
    return float(np.max(np.abs(now - before) / np.maximum(size, _SMALLEST**2)))


def _pad(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Fill up with weightless rays, so that all orders share one or two compiled programs."""
    sizes = (_MAX_ORDER + 1,) if len(points) == 1 else (182, 364, 1722, 3444)
    missing = next(size for size in sizes if size >= weights.size) - weights.size
    return np.pad(points, ((0, 0), (0, missing))), np.pad(weights, (0, missing))


def _check_passed(moments: FocusMoments, wavelengths: ArrayLike) -> None:
    for passed, wavelength in zip(np.asarray(moments.passed), np.atleast_1d(wavelengths)):
        if not passed > 0:
            raise ValueError(
                f"no ray at {float(wavelength):g} um reaches the sensor: every one misses a "
                "surface, is totally reflected or is clipped; see trace_rays(...).status"
            )
