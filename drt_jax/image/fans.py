"""Ray fans: transverse ray errors and path differences along two diameters of the stop, and axial
colour.

Rays are labelled by their stop point, so no exit pupil has to be found: a fan runs over points of
the stop.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require
from ..lens.lens import Lens
from ..lens.paraxial import first_order
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import Numbers, program, real_array, safe_divide
from ..rays.known import Known, known_rays
from ..rays.status import Status, reaches_sensor
from ..rays.system import Vector
from ..rays.trace import trace_bundle
from .rounding import warn_of_focus, warn_of_paths
from .wavefront import path_differences


class RayFans(NamedTuple):
    """Rays through N points on each of two diameters of the stop, for W wavelengths.

    pupil: (N,), from -1 to 1, in units of the stop's semi-diameter.
    tangential, sagittal: (..., W, N, 2), mm, x and y on the sensor of the rays through points on
        the y axis and on the x axis of the stop, less those of the reference chief ray.
    tangential_path, sagittal_path: (..., W, N), waves, path of the chief ray of the same wavelength
        less that of the ray, to the reference sphere of `wavefront`.

    All but `pupil` are inf for a ray that fails or is clipped, and where a chief ray fails.
    """

    pupil: Array
    tangential: Array
    sagittal: Array
    tangential_path: Array
    sagittal_path: Array


class AxialColour(NamedTuple):
    """Foci on the axis, mm along z from the sensor; inf for none.

    paraxial: (W,), paraxial foci.
    real: (W, N), where rays through N heights on the stop cross the chief ray of the field 0:
        spherical aberration for each wavelength.
    """

    paraxial: Array
    real: Array


def ray_fans(lens: Lens, scene: Scene, count: int = 41, reference: int | None = None) -> RayFans:
    """Transverse ray errors and path differences along the y and the x axis of the stop.

    lens, scene: the lens, and object points with their wavelengths.
    count: N, number of evenly spaced points from rim to rim; odd to contain the centre.
    reference: index of the wavelength whose chief ray transverse errors are measured from; None:
        the middle one, W // 2. Paths are measured from the chief ray of each wavelength.

    Returns `RayFans`, as OpticStudio plots ey against Py and ex against Px with rays aimed at the
    real stop; for its plots without aiming, pass `with_paraxial_pupil(lens)`. Differentiable like
    `trace_rays`. Warns of float32 as `wavefront` does. ValueError as of `lens.scene.checked_scene`.
    """
    if not isinstance(count, int | np.integer) or count < 2:
        raise ValueError(f"count: expected at least 2, a whole number, got {count!r}")
    heights = jnp.linspace(-1, 1, int(count), dtype=lens.curvature.dtype)
    scene = checked_scene(lens, scene)
    warn_of_paths(lens, scene)
    return _fans(heights, *_traced(lens, scene, heights), scene.reference(reference))


@functools.partial(program, static_argnames="middle")
def _fans(
    heights: Array, hit: Array, slope: Array, opd: Array, good: Array, middle: int
) -> RayFans:
    """`RayFans` of what `_traced` returns, for the index of the reference wavelength."""
    moved = hit[..., 1:, :] - hit[..., middle, None, :1, :]
    arrives = good[..., 1:] & good[..., middle, None, :1] & good[..., :1]
    moved = jnp.where(arrives[..., None], moved, jnp.inf)
    path = jnp.where(arrives, opd[..., 1:], jnp.inf)
    halves = (slice(None, len(heights)), slice(len(heights), None))
    parts = [moved[..., half, :] for half in halves] + [path[..., half] for half in halves]
    return RayFans(heights, *parts)


def axial_colour(lens: Lens, scene: Scene, heights: Numbers = (0.7, 1.0)) -> AxialColour:
    """Where light of each wavelength is in focus on the axis, see `AxialColour`.

    lens: the lens.
    scene: one distance, and wavelengths; its fields do not count.
    heights: (N,), on the y axis of the stop, in units of its semi-diameter; none may be 0.

    The paraxial foci ignore tilts and decentres. Warns of float32 as `field_curvature` does.
    ValueError as of `lens.scene.checked_scene`.
    """
    points = real_array("heights", heights, lens.curvature.dtype)
    require(points.ndim == 1, f"heights: expected (N,), got shape {points.shape}")
    scene = checked_scene(lens, scene)
    require(not scene.distance.ndim, f"distance: expected one, got shape {scene.distance.shape}")
    axis = scene.at(jnp.zeros(2, lens.curvature.dtype))
    warn_of_focus(lens, axis)
    hit, slope, _, good = _traced(lens, axis, points)
    height, bend = (a[:, 1 : len(points) + 1, 1] - a[:, :1, 1] for a in (hit, slope))
    arrives = good[:, 1 : len(points) + 1] & good[:, :1] & (bend != 0)
    real = jnp.where(arrives, safe_divide(-height, bend), jnp.inf)
    found = first_order(lens, axis.distance, axis.wavelengths).image_distance
    return AxialColour(found - lens.sensor, real)


def _traced(lens: Lens, scene: Scene, heights: Array) -> tuple[Array, Array, Array, Array]:
    """The chief ray, and the rays through heights (N,) on the y axis and then on the x axis of the
    stop.

    Returns hits (..., W, 1 + 2 N, 2), mm, slopes of the same shape, path differences
    (..., W, 1 + 2 N), waves, and whether each ray arrives, bool.
    """
    points = _cross(heights)
    return _of_points(lens, scene, points, known_rays(lens, scene, points))


@program
def _cross(heights: Array) -> Vector:
    """The centre of the stop, then heights on its y axis, then on its x axis."""
    none, first = jnp.zeros_like(heights), jnp.zeros_like(heights[:1])
    return jnp.concatenate([first, none, heights]), jnp.concatenate([first, heights, none])


@functools.partial(jit, wanted=LARGE)
def _of_points(
    lens: Lens, scene: Scene, points: Vector, known: Known
) -> tuple[Array, Array, Array, Array]:
    """`_traced` of stop points, D arrays (Q,)."""

    def one(point: Scene, known: Known) -> tuple[Array, Array, Array, Array]:
        bundle = trace_bundle(lens, point, points, known)
        opd, status, _ = path_differences(lens, scene.wavelengths, bundle)
        whole = reaches_sensor(status)
        # A clipped chief ray still serves as the reference of the others.
        good = (status == Status.OK) | (whole & (np.arange(status.shape[-1]) == 0)[None])
        hit, slope = (jnp.stack(a, axis=-1) for a in (bundle.sensor, bundle.slopes))
        return hit, slope, opd, good

    return over_points(one, scene, known)
