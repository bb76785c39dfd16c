"""Optical path difference of the rays against a sphere round the image point.

For a wavelength, the chief ray (through the centre of the stop) meets the sensor at C. The
reference sphere has its centre at C and its radius R along the chief ray to the plane of the
paraxial exit pupil, positive against the light. Written in kappa = 1 / R, so that a telecentric
exit pupil (kappa = 0) is a point like any other: a ray with the unit direction d that meets
the sensor at P = C + e met the sphere at the distance R + t before P, where

    t = e.d + kappa X / (1 + sqrt(1 + kappa^2 X)),    X = (e.d)^2 - e^2.

Source: Welford, Aberrations of Optical Systems (1986), ch. 7.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.paraxial import chief_ray_at_image
from ..lens.scene import Scene, scene_of
from ..numerics import Numbers, concrete, real_array, safe_divide, safe_sqrt
from ..rays.status import Status
from ..rays.system import dot
from ..rays.trace import Bundle, stop_points, trace_bundle

_MM = 1e-3  # per um


class Wavefront(NamedTuple):
    """Optical path differences of rays.

    opd: (W, Q) in waves, path of the chief ray less path of the ray, both to the reference
        sphere: positive where the wavefront is ahead of the sphere; 0 for a ray that failed or is
        clipped.
    status: (W, Q), int32, see `Status`; where the chief ray of a wavelength failed, no ray has an
        opd, and its status is its own or, if that is OK or CLIPPED, the chief ray's.
    image: (W, 2) in mm, where the chief rays meet the sensor, along its axes; 0 if they failed.
    """

    opd: Array
    status: Array
    image: Array


def reference_curvature(lens: Lens, wavelengths: Array) -> Array:
    """1 / distance (W,) from the paraxial exit pupil to the sensor, along the light, 1/mm.

    Positive for a pupil that the light has passed before the sensor, 0 for a telecentric lens.
    Tilts and decentres are left out. `wavelengths` (W,) in um.
    """
    height, slope = chief_ray_at_image(lens, wavelengths)
    at_sensor = height + slope * (lens.sensor - lens.vertices[-2])
    return safe_divide(slope * jnp.asarray(lens.senses[-1], slope.dtype), at_sensor)


def wavefront(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    pupil: Numbers,
    curvature: Numbers | None = None,
) -> Wavefront:
    """Optical path difference of the rays that cross the stop at given points.

    field, distance, wavelengths (W,), pupil (Q, 2): as in `trace_rays`.
    curvature: () or (W,) in 1/mm, kappa of the reference sphere along the axis, in place of
        `reference_curvature`; needed for a lens folded by tilted mirrors, whose exit pupil the
        paraxial trace cannot know.

    Differentiable like `trace_rays`; the reference sphere moves with the lens. ValueError as of
    `trace_rays`, and for a known curvature that is not finite; inside a trace no ray has an opd
    then, and those that are whole are UNCONVERGED.
    """
    scene = scene_of(lens, field, distance, wavelengths)
    points = stop_points(lens, pupil)
    kappa = None
    if curvature is not None:
        kappa = real_array("curvature", curvature, lens.curvature.dtype)
        if kappa.shape not in ((), scene.wavelengths.shape):
            raise ValueError(
                f"curvature: expected one or one a wavelength, got shape {kappa.shape}"
            )
        if concrete(curvature) and not np.all(np.isfinite(np.asarray(curvature, float))):
            raise ValueError("curvature: must be finite; 0 for a telecentric exit pupil")
    return _wavefront(lens, scene, points, kappa)


@functools.partial(jit, wanted=LARGE)
def _wavefront(lens: Lens, scene: Scene, pupil: Array, curvature: Array | None) -> Wavefront:
    points = jnp.concatenate([jnp.zeros_like(pupil[:1]), pupil])  # the chief ray first
    bundle = trace_bundle(lens, scene, (points[:, 0], points[:, 1]))
    opd, status, image = path_differences(lens, scene.wavelengths, bundle, curvature)
    return Wavefront(opd[:, 1:], status[:, 1:], image)


def path_differences(
    lens: Lens, wavelengths: Array, bundle: Bundle, curvature: Array | None = None
) -> tuple[Array, Array, Array]:
    """Path differences (W, Q) in waves, status (W, Q) and image points (W, D) of traced rays, the
    chief ray first; see `Wavefront` and `wavefront`."""
    waves = jnp.clip(wavelengths, *lens.dispersion.range)
    whole = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
    chief_ok = whole[:, :1]

    if curvature is None:
        curvature = reference_curvature(lens, waves)
    finite = jnp.isfinite(curvature)
    curvature = jnp.where(finite, curvature, 0)
    sphere = chief_ok & jnp.broadcast_to(finite, waves.shape)[:, None]
    good = sphere & (bundle.status == Status.OK)
    # cosine between the chief ray and the axis, along which the sensor moves
    axis = lens.sensor_motion
    axis = jnp.array([0, 0, 1], bundle.path.dtype) if axis is None else axis
    arrival = tuple(a[:, 0] for a in bundle.arrival)
    cosine = jnp.abs(dot(axis[-len(arrival) :], arrival))
    kappa = (curvature * cosine)[:, None]

    hit = tuple(h[-1] for h in bundle.hits)
    image = tuple(jnp.where(chief_ok, h[:, :1], 0) for h in hit)
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
    """Root mean square (W,) of the opd about its mean, in waves; 0 if no ray has one.

    `weights` (Q,) of the points, as from `pupil.disc`; failed and clipped rays count for
    nothing. The tilt that the chief ray leaves is kept. ValueError for weights of another shape.
    """
    share = real_array("weights", weights, wave.opd.dtype)
    if share.shape != wave.opd.shape[1:]:
        raise ValueError(f"weights: expected {wave.opd.shape[1:]}, got shape {share.shape}")
    good = wave.status == Status.OK
    weight = jnp.where(good, share, 0)
    weight = safe_divide(weight, jnp.sum(weight, axis=1, keepdims=True))
    mean = jnp.sum(weight * wave.opd, axis=1, keepdims=True)
    return safe_sqrt(jnp.sum(weight * (wave.opd - mean) ** 2, axis=1))
