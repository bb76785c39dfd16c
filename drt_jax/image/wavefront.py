"""Optical path difference of the rays against a reference sphere about the image point.

For each wavelength, the chief ray (through the centre of the stop) meets the sensor at C, the
centre of the reference sphere. Its radius R is measured along the chief ray, against the light,
from C to the plane of the paraxial exit pupil. The formulas use kappa = 1 / R, which is 0 for a
telecentric exit pupil. A ray with unit direction d that meets the sensor at P = C + e meets the
sphere at the distance R + t in front of P, where

    t = e.d + kappa X / (1 + sqrt(1 + kappa^2 X)),    X = (e.d)^2 - e^2.

Source: Welford, Aberrations of Optical Systems (1986), ch. 7.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require
from ..lens.lens import Lens
from ..lens.paraxial import chief_ray, paraxial_system
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import Numbers, concrete, real_array, safe_divide, safe_sqrt
from ..rays.known import Known, known_rays
from ..rays.rays import stop_points
from ..rays.status import Status
from ..rays.system import dot
from ..rays.trace import FOCAL, Bundle, trace_bundle
from .rounding import warn_of_paths
from .spot import deviations, normalised

_MM = 1e-3  # per um


class Wavefront(NamedTuple):
    """Optical path differences of rays.

    opd: (..., W, Q), waves, path of the chief ray less path of the ray, both to the reference
        sphere: positive where the wavefront is ahead of the sphere; 0 for a ray that fails or is
            clipped.
    status: (..., W, Q), int32, see `Status`. If the chief ray of a wavelength fails, no ray has an
        opd, and OK and CLIPPED are replaced by the status of the chief ray.
    image: (..., W, 2), mm, point of the chief ray on the sensor, along its axes; 0 if the ray
        fails.
    """

    opd: Array
    status: Array
    image: Array


def reference_curvature(lens: Lens, wavelengths: Array) -> Array:
    """Curvature of the reference sphere: 1 / distance from the paraxial exit pupil to the sensor
    along the light, 1/mm.

    wavelengths: (W,), um.

    Returns (W,): positive for a pupil in front of the sensor, 0 for a telecentric lens. Tilts and
        decentres are neglected. For an afocal lens it is that behind the ideal lens of
        `rays.trace.at_infinity`.
    """
    height, slope = chief_ray(paraxial_system(lens, wavelengths), front=False)
    at_sensor = height + slope * (lens.sensor - lens.vertices[-2])
    slope = slope * jnp.asarray(lens.senses[-1], slope.dtype)
    if lens.afocal:
        return safe_divide(-at_sensor, slope) / FOCAL**2
    return safe_divide(slope, at_sensor)


def wavefront(
    lens: Lens, scene: Scene, pupil: Numbers, curvature: Numbers | None = None
) -> Wavefront:
    """Optical path difference of the rays that cross the stop at given points.

    lens, scene: as in `trace_rays`.
    pupil: (Q, 2), points on the stop, as in `trace_rays`.
    curvature: () or (W,), kappa of the reference sphere along the axis, 1/mm, instead of
        `reference_curvature`. Needed for a lens folded by tilted mirrors, which the paraxial trace
        cannot follow.

    Returns a `Wavefront`. Differentiable like `trace_rays`; the reference sphere moves with the
    lens. In float32 warns, outside of a trace, where rounding makes path differences wrong by more
    than 1e-3 waves, as in a telescope of metres. ValueError as in `trace_rays`, and for a known
    curvature that is not finite; inside a trace rays that pass are then UNCONVERGED and have no
    opd.
    """
    scene = checked_scene(lens, scene)
    points = stop_points(lens, pupil)
    kappa = None
    if curvature is not None:
        kappa = real_array("curvature", curvature, lens.curvature.dtype)
        fits = kappa.shape in ((), scene.wavelengths.shape)
        require(fits, f"curvature: expected one or one a wavelength, got shape {kappa.shape}")
        finite = not concrete(curvature) or np.all(np.isfinite(np.asarray(curvature, float)))
        require(finite, "curvature: must be finite; 0 for a telecentric exit pupil")
    warn_of_paths(lens, scene)
    points = jnp.concatenate([jnp.zeros_like(points[:1]), points])  # the chief ray first
    return _wavefront(lens, scene, points, kappa, known_rays(lens, scene, points.T))


@functools.partial(jit, wanted=LARGE)
def _wavefront(
    lens: Lens, scene: Scene, points: Array, curvature: Array | None, known: Known
) -> Wavefront:
    """`wavefront` of checked arguments and the chief ray, and the points after it."""

    def one(point: Scene, known: Known) -> Wavefront:
        bundle = trace_bundle(lens, point, (points[:, 0], points[:, 1]), known)
        opd, status, image = path_differences(lens, scene.wavelengths, bundle, curvature)
        return Wavefront(opd[:, 1:], status[:, 1:], image)

    return over_points(one, scene, known)


def path_differences(
    lens: Lens, wavelengths: Array, bundle: Bundle, curvature: Array | None = None
) -> tuple[Array, Array, Array]:
    """Path differences of traced rays, the chief ray first.

    lens: the lens.
    wavelengths: (W,), um.
    bundle: the traced rays.
    curvature: as in `wavefront`.

    Returns path differences (W, Q), waves, status (W, Q) and image points (W, D), mm.
    """
    waves = jnp.clip(wavelengths, *lens.dispersion.range)
    whole, hit = bundle.arrives, bundle.sensor
    chief_ok = whole[:, :1]

    if curvature is None:
        curvature = reference_curvature(lens, waves)
    finite = jnp.isfinite(curvature)
    curvature = jnp.where(finite, curvature, 0)
    sphere = chief_ok & jnp.broadcast_to(finite, waves.shape)[:, None]
    good = sphere & (bundle.status == Status.OK)
    # Cosine between the chief ray and the direction in which the sensor moves.
    axis = lens.sensor_motion
    axis = jnp.array([0, 0, 1], bundle.path.dtype) if axis is None else axis
    arrival = tuple(a[:, 0] for a in bundle.arrival)
    cosine = jnp.abs(dot(axis[-len(arrival) :], arrival))
    kappa = (curvature * cosine)[:, None]

    image = tuple(h[:, :1] for h in hit)
    e = tuple(jnp.where(good, h - i, 0) for h, i in zip(hit, image, strict=True))
    along = dot(e, bundle.arrival[:-1])
    x = along**2 - dot(e, e)
    to_sphere = along + kappa * x / (1 + safe_sqrt(1 + kappa**2 * x))
    index = lens.index(waves)[-1][:, None]
    path = bundle.path[:, :1] - bundle.path + index * to_sphere
    opd = jnp.where(good, path, 0) / (_MM * waves[:, None])
    without = jnp.where(chief_ok, jnp.int32(Status.UNCONVERGED), bundle.status[:, :1])
    status = jnp.where(sphere | ~whole, bundle.status, without)
    return opd, status, jnp.concatenate(image, axis=-1)


def rms_wavefront(wave: Wavefront, weights: Numbers) -> Array:
    """Root mean square (..., W) of the opd about its mean, waves; 0 if no ray has an opd. The tilt
    about the chief ray is not removed.

    wave: result of `wavefront`.
    weights: (Q,), of the points, as from `pupil.disc`. Rays that fail or are clipped have weight 0.
        ValueError for another shape.
    """
    weight = real_array("weights", weights, wave.opd.dtype)
    if weight.shape != wave.opd.shape[-1:]:
        raise ValueError(f"weights: expected {wave.opd.shape[-1:]}, got shape {weight.shape}")
    weight = normalised(jnp.where(wave.status == Status.OK, weight, 0))
    (apart,), _ = deviations((wave.opd,), weight, "none")
    return safe_sqrt(jnp.sum(weight * apart**2, axis=-1))
