"""The survey of a batch of random scenes: finite numbers, Snell's law, lost rays."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Gauss, Scene, Status
from drt_jax.compilation import jit
from drt_jax.lens.elements import rotation_matrix
from drt_jax.lens.forms import Shape
from drt_jax.lens.surface import sag_derivatives
from drt_jax.numerics import safe_sqrt
from drt_jax.rays.status import reaches_sensor

from ._scenes import WAVELENGTH, Scenes
from .snell import QUICK, trace_snell, virtual

_BATCH = 104  # scenes of a call: all batches of one structure share a compiled program
_BOTH = 4  # every 4th scene of a float64 family is traced in float32 too
_RULE = Gauss(2, "none")  # rule of the differentiated moments
_ROUNDINGS = 1000  # largest difference of two traces, roundings of the hits
_GRID = 41  # launch points per side in the search for a failed ray
_STARTS = 4  # candidates refined for each such ray
_REFINE = 25
_STOP_MISS = 1e-9  # mm


def _over_scenes(function: Callable) -> Callable:
    """Maps a function of one scene over any number of scenes, in batches; NumPy arrays."""
    program = jit(lambda *scenes: jax.lax.map(lambda scene: function(*scene), scenes), QUICK)

    def run(*arguments):
        count, parts = len(jax.tree.leaves(arguments)[0]), []
        for first in range(0, count, _BATCH):
            rows = np.minimum(np.arange(first, first + _BATCH), count - 1)
            part = program(*jax.tree.map(lambda a: a[rows], arguments))
            parts.append(jax.tree.map(lambda a: np.asarray(a)[: count - first], part))
        return jax.tree.map(lambda *a: np.concatenate(a), *parts)

    return run


def _sum(a):
    """A sum with fixed, different weights between 1/2 and 3/2."""
    weights = 1 + np.sin(1 + np.arange(a.size, dtype=float)).reshape(a.shape) / 2
    return jnp.sum(jnp.asarray(weights, a.dtype) * a)


def _own(lens, i, vector):
    """A vector (3,) in the axes of surface i."""
    return vector if lens.tilt is None else rotation_matrix(lens.tilt[i]).T @ vector


def _place(lens, i, point):
    """A point (3,) in the axes of surface i, from its vertex."""
    across = jnp.zeros_like(point[:2]) if lens.decentre is None else lens.decentre[i]
    return _own(lens, i, point - jnp.append(across, lens.vertices[i]))


def _entering(point, field, distance):
    """Direction of the light at a point (3,) in front of the lens, not normalised."""
    return point / distance + jnp.append(jnp.tan(field), jnp.ones_like(distance))


def _residual(lens, field, distance, pupil, points):
    """Residual of the equations of a stationary path through the stop point, at the traced points
    (S + 1, 3) of a ray, divided by the bound for rounding: `_ROUNDINGS / 5` times the change by the
    last digit of a coordinate.

    Along a stationary path, n e - n' e' is normal to each active surface, with the directions e and
    e' and the indices n and n' in front of and behind it.
    """
    active, stop = [*lens.active, lens.count], lens.stop
    index = lens.index(jnp.full(1, WAVELENGTH, points.dtype))[:, 0]
    path = points[jnp.array(active)]
    steps = jnp.concatenate([_entering(path[0], field, distance)[None], jnp.diff(path, axis=0)])
    length = jnp.linalg.norm(steps, axis=1)
    inverse = 1 / jnp.where(length > 0, length, jnp.finfo(points.dtype).tiny ** 0.5)
    e, size = steps * inverse[:, None], jnp.max(jnp.abs(points))
    e = e.at[-1].multiply(jnp.where(virtual(lens)[-1], -1, 1))  # prolonged backwards
    miss = _place(lens, stop, points[stop])[:2] - lens.semi_diameter[stop] * pupil
    error, steepest = jnp.max(jnp.abs(miss)) / (1 + size), jnp.zeros_like(size)
    for k, i in enumerate(lens.active):
        row = Shape(lens.curvature[i], lens.conic[i], lens.coefficients[i])
        slope = jnp.stack(sag_derivatives(_place(lens, i, path[k])[:2], row, lens.forms[i])[1])
        kink = _own(lens, i, index[i] * e[k] - index[i + 1] * e[k + 1])
        error = jnp.maximum(error, jnp.max(jnp.abs(kink[:2] + slope * kink[2])))
        steepest = jnp.maximum(steepest, jnp.max(jnp.abs(slope)))
    rounding = jnp.finfo(points.dtype).eps * (1 + size * jnp.max(inverse[1:])) * (1 + steepest)
    return error / (_ROUNDINGS / 5 * rounding)


def _trace(lens, field, distance, pupil):
    scene = Scene.point(field, distance, jnp.full(1, WAVELENGTH, pupil.dtype))
    return drt_jax.trace_rays(lens, scene, pupil)


_plain = _over_scenes(_trace)


@_over_scenes
def _rays(lens, field, distance, pupil):
    """Rays, the derivatives of a sum of them by lens and scene, and their residuals."""

    def scalar(lens, field, distance):
        rays = _trace(lens, field, distance, pupil)
        return _sum(rays.points) + _sum(rays.path), rays

    slope, rays = jax.grad(scalar, argnums=(0, 1, 2), has_aux=True)(lens, field, distance)
    residual = jax.vmap(_residual, (None, None, None, 0, 0))
    return rays, slope, residual(lens, field, distance, pupil, rays.points[0])


@_over_scenes
def _moments(lens, field, distance):
    """Moments, and the derivatives of a sum of them by lens and scene. The infinite covariance of a
    wavelength without light counts as 0."""
    wavelength = jnp.full(1, WAVELENGTH, field.dtype)

    def scalar(lens, field, distance):
        found = drt_jax.psf_moments(lens, Scene.point(field, distance, wavelength), sampling=_RULE)
        none = (found.throughput == 0)[:, None, None] & jnp.isposinf(found.covariance)
        covariance = jnp.where(none, 0, found.covariance)
        value = jnp.sum(found.mean) + jnp.sum(covariance) + safe_sqrt(covariance[0, 0, 0])
        return value, (found.mean, covariance, found.throughput)

    return jax.grad(scalar, argnums=(0, 1, 2), has_aux=True)(lens, field, distance)


def _shoot(lens, field, distance, point):
    """Sequential trace of the ray through a point (3,) in front of the lens."""
    direction = _entering(point, field, distance)
    wavelength, size = jnp.asarray(WAVELENGTH, point.dtype), jnp.linalg.norm(direction)
    begun = jnp.where(distance > 0, size * distance, jnp.inf)  # inf for a virtual object
    return trace_snell(lens, wavelength, point, direction / size, begun)


@_over_scenes
def _retrace(lens, field, distance, points):
    """Compares the points (RAYS, S + 1, 3) of each ray with a sequential trace through the first
    point.

    Returns the difference relative to the size of the points and to the growth of a shift of the
    start; the difference in mm, 0 if the sequential trace fails; and whether it fails while its
    four neighbours all arrive or all fail. (At the edge of the beam, where only some neighbours
    arrive, both results may be right.)
    """

    def one(points):
        size = 1 + jnp.max(jnp.abs(points))
        shift = 1e-7 * size * jnp.eye(3, k=-1)[jnp.array([0, 1, 2, 1, 2])]  # unshifted, x, y
        shift = shift * jnp.array([[0.0], [1], [1], [-1], [-1]], shift.dtype)
        hits, ok = jax.vmap(lambda s: _shoot(lens, field, distance, points[0] + s))(shift)
        growth = jnp.max(jnp.abs(hits[1:] - hits[:1])) / (1e-7 * size)
        off = jnp.max(jnp.abs(hits[0] - points))
        denied = ~ok[0] & (jnp.all(ok[1:]) | ~jnp.any(ok[1:]))
        return off / (size * (1 + jnp.nan_to_num(growth))), jnp.where(ok[0], off, 0), denied

    return jax.vmap(one)(points)


@_over_scenes
def _search(lens, field, distance, pupil):
    """True where a sequential trace finds a ray through a stop point, (RAYS,).

    Newton's method with halving starts from the nearest rays of a grid over the first surface. A
    ray counts if it meets the stop point within `_STOP_MISS` and its neighbours reach the sensor.
    """
    stop, height = lens.stop, lens.semi_diameter[lens.stop]

    def crossing(aim):
        hits, ok = _shoot(lens, field, distance, jnp.append(aim, jnp.zeros_like(height)))
        return _place(lens, stop, hits[stop])[:2], ok

    def refined(target, aim):
        def step(_, state):
            trial, best, last, found = state
            h = 1e-7 * (1 + jnp.max(jnp.abs(trial)))
            at, ok = jax.vmap(crossing)(trial[None] + h * jnp.eye(3, 2, k=-1))  # unshifted, x, y
            miss = jnp.linalg.norm(at[0] - target)
            better = ok[0] & (miss <= best)
            newton = jnp.linalg.solve((at[1:] - at[:1]).T / h, target - at[0])
            whole = better & jnp.all(ok) & jnp.all(jnp.isfinite(newton))
            following = jnp.where(whole, newton, last / 2)
            aim = jnp.where(better, trial, trial - last)
            best, found = jnp.where(better, miss, best), found | (whole & (miss < _STOP_MISS))
            return aim + following, best, following, found

        start = aim, jnp.full_like(height, jnp.inf), jnp.zeros_like(aim), jnp.array(False)
        return jax.lax.fori_loop(0, _REFINE, step, start)[-1]

    slope = jnp.linalg.norm(jnp.tan(field))
    reach = 3 * height + 1.5 * slope * (jnp.abs(lens.vertices[stop]) + height)
    side = jnp.linspace(-1, 1, _GRID) * reach
    grid = jnp.stack(jnp.meshgrid(side, side), -1).reshape(-1, 2)
    there, ok = jax.vmap(crossing)(grid)

    def found(target):
        far = jnp.where(ok, jnp.linalg.norm(there - target[None], axis=1), jnp.inf)
        nearest = jax.lax.top_k(-far, _STARTS)[1]
        return jnp.any(jax.vmap(refined, (None, 0))(target, grid[nearest]))

    return jax.vmap(found)(height * pupil)


def _infinite(*found: Any) -> np.ndarray:
    """Count of numbers that are not finite, for each scene."""
    leaves = [~np.isfinite(leaf) for leaf in jax.tree.leaves(found)]
    return np.sum([np.sum(bad, axis=tuple(range(1, bad.ndim))) for bad in leaves], axis=0)


def survey(scenes: Scenes) -> dict[str, np.ndarray]:
    """The survey of scenes: arrays over scenes (and rays), and counts to be summed."""
    dtype = scenes.distance.dtype
    rays, slope, residual = _rays(*scenes)
    moments_slope, moments = _moments(*scenes[:3])
    status = rays.status[:, 0]
    exact = jax.tree.map(np.float64, scenes)
    good = reaches_sensor(status)
    relative, off, denied = _retrace(*exact[:3], rays.points[:, 0].astype(float))
    ratio = relative / np.finfo(dtype).eps
    # The scenes are rounded to float32, and traced in both precisions.
    rough, single = scenes, rays
    if dtype != np.float32:
        rough = jax.tree.map(lambda a: np.float32(a[::_BOTH]), scenes)
        single = _plain(*rough)
    double = _rays(*jax.tree.map(np.float64, rough))[0]
    both = (single.status == Status.OK) & (double.status == Status.OK)
    some, lost = np.flatnonzero(~good.all(axis=1)), np.zeros(good.shape, bool)
    if some.size:
        lost[some] = ~good[some] & _search(*jax.tree.map(lambda a: a[some], exact))
    return {
        "status": status,
        "steps": np.max(rays.newton_steps.reshape(len(status), -1), axis=1),
        "nan_values": _infinite(rays.points, rays.path, moments),
        "nan_gradients": _infinite(slope, moments_slope),
        "disagree_with_snell": good & (denied | (ratio > _ROUNDINGS) | (residual > 1)),
        "ratio": np.where(good, ratio, 0),
        "snell_error": np.where(good, off, 0),
        "residual": np.where(good, residual, 0),
        "traceable": lost,
        "float32_error": np.max(np.abs(single.points - double.points), axis=(-1, -2))[both],
    }
