"""Rays through given points of the stop, on all surfaces of a lens."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..lens.surface import by_form, surface_sag
from ..numerics import Numbers, concrete, known_values, real_array
from . import fermat
from .known import Known, known_rays
from .system import add, placed, rotate
from .trace import aims, bundle_of, rows_behind


class Rays(NamedTuple):
    """Traced rays of W wavelengths through Q points of the stop. The points (...) of a scene are
    the first axes.

    points: (..., W, Q, S + 1, 3), mm, intersections with the surfaces and the sensor, along the
        axes of the lens, with z from the first vertex; zeros for a failed ray.
    directions: (..., W, Q, S + 1, 3), unit vectors (direction cosines) in front of each surface and
        of the sensor; zeros for a failed ray.
    path: (..., W, Q), mm, optical path to the sensor. It starts at the sphere about the object
        point through the first vertex, or at the plane wave through the first vertex for an object
        at infinity; 0 for a failed ray.
    status: (..., W, Q), int32, see `Status`.
    newton_steps: (...), int32, Newton steps of the whole bundle, aiming included.
    """

    points: Array
    directions: Array
    path: Array
    status: Array
    newton_steps: Array


def trace_rays(lens: Lens, scene: Scene, pupil: Numbers) -> Rays:
    """Traces the rays that cross the real stop at given points, aimed for every wavelength.

    The result is differentiable in every mode and to any order.

    lens: the lens; its dtype is that of the result.
    scene: object points and their wavelengths.
    pupil: (Q, 2), x and y on the stop in units of its semi-diameter.

    ValueError as in `lens.scene.checked_scene`. Inside `jit` or `vmap`, where values are not known,
    a wavelength outside the range of a glass gives the status NO_INDEX; a field of 90 degrees or
    more, or a distance within 1e-6 mm of 0, gives MISSED.
    """
    scene, points = checked_scene(lens, scene), stop_points(lens, pupil)
    count, size = len(points), _padded(len(points))
    library = np if concrete(points) else jnp
    if count == size or known_values((lens, scene, points)) is None:
        return _trace(lens, scene, points, known_rays(lens, scene, library.asarray(points).T))
    # Bundles of similar size are padded to one size, so that they share a compiled program. The
    # stop points of the padding are inf; such rays are MISSED without a search.
    filled = library.pad(points, ((0, size - count), (0, 0)), constant_values=np.inf)
    return _first(_trace(lens, scene, filled, known_rays(lens, scene, filled.T)), count)


def _padded(count: int) -> int:
    """Number of rays after padding.

    It is at least 16, then a multiple of an eighth of the next power of 2. Above 1024 rays there is
    no padding, because arithmetic then takes most of the time.
    """
    if count > 1024:
        return count
    step = max(16, 1 << (count - 1).bit_length()) // 8
    return max(16, -(-count // step) * step)


@functools.partial(jax.jit, static_argnames="count")
def _first(rays: Rays, count: int) -> Rays:
    """The first `count` rays."""
    axis = rays.status.ndim - 1
    first = lambda a: jax.lax.slice_in_dim(a, 0, count, axis=axis) if a.ndim > axis else a  # noqa: E731
    return jax.tree.map(first, rays)


def stop_points(lens: Lens, pupil: Numbers) -> Array:
    """Points (Q, 2) on the stop as an array in the dtype of the lens.

    pupil: (Q, 2), in units of the semi-diameter of the stop. ValueError for no points and for
        another shape.
    """
    points = real_array("pupil", pupil, lens.curvature.dtype)
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        hint = "; pass pupil.T" if points.ndim == 2 and points.shape[0] == 2 else ""
        raise ValueError(f"pupil: expected x and y of points, (Q, 2), got {points.shape}{hint}")
    return points


@functools.partial(jit, wanted=LARGE)
def _trace(lens: Lens, scene: Scene, pupil: Array, known: Known) -> Rays:
    """The compiled part of `trace_rays`. pupil: (Q, 2), in semi-diameters of the stop."""
    return over_points(lambda *one: _trace_point(lens, pupil, *one), scene, known)


def _trace_point(lens: Lens, pupil: Array, scene: Scene, known: Known) -> Rays:
    """`trace_rays` of one object point."""
    system, target = aims(lens, scene, (pupil[:, 0], pupil[:, 1]))
    found = known(system, target)
    bundle = bundle_of(dataclasses.replace(lens, afocal=False), scene, system, target, found)
    rows = placed(lens, range(lens.count + 1))
    heights = by_form(surface_sag, bundle.hits, rows.wide, lens.forms)
    own = rotate(rows.rotation, (*bundle.hits, heights))
    points = add(own, [o[:, None, None] for o in rows.origin(2)])
    direction = rotate(system.rows.rotation, fermat.geometry(found.hits, system).before)
    behind = np.array(rows_behind(lens))

    def stacked(vector):  # (3, S + 1, W, Q) -> (W, Q, S + 1, 3)
        return jnp.where(bundle.arrives, jnp.stack(vector), 0).transpose(2, 3, 1, 0)

    directions = stacked([d[behind] for d in direction])
    path = jnp.where(bundle.arrives, fermat.optical_path(found.hits, system), 0)
    return Rays(stacked(points), directions, path, bundle.status, found.steps)
