"""What is measured on a batch of random scenes: finite numbers, Snell's law, rays not found."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Status
from drt_jax.lens.lens import rotation_matrix
from drt_jax.lens.surface import Shape, sag_derivatives
from drt_jax.numerics import safe_sqrt
from drt_jax.pupil import Gauss

from ._scenes import WAVELENGTH, Scenes
from .snell import trace_snell

__all__ = ["KEYS", "survey"]

# What `survey` returns: arrays over scenes and rays, and two counts.
KEYS = (
    "disagree",
    "float32_error",
    "lost",
    "nan_gradients",
    "nan_values",
    "ratio",
    "residual",
    "status",
    "steps",
)
_BATCH = 104  # scenes to a call: all batches of one structure share a compiled program
_BOTH = 4  # one scene of so many of a float64 family is traced in float32 too
_SHOTS = 24  # rays of a scene that the sequential trace follows in one call
_RULE = Gauss(2, "disc")  # whose moments are differentiated
_ROUNDINGS = 1000  # how many roundings of the hits two traces may be apart
_GRID = 41  # launch points along each side of the search for a ray that was not found
_STARTS = 4  # candidates refined for each such ray
_REFINE = 25
_STOP_MISS = 1e-9  # mm


def _weights(shape: tuple) -> jnp.ndarray:
    """Fixed numbers between 1/2 and 3/2, all different."""
    return 1 + np.sin(1 + np.arange(np.prod(shape), dtype=float)).reshape(shape) / 2


def _own(lens, i, vector):
    """A vector (3,) along the axes of surface i."""
    return vector if lens.tilt is None else rotation_matrix(lens.tilt[i]).T @ vector


def _place(lens, i, point):
    """A point (3,) along the axes of surface i, from its vertex."""
    across = jnp.zeros_like(point[:2]) if lens.decentre is None else lens.decentre[i]
    return _own(lens, i, point - jnp.append(across, lens.vertices[i]))


def _residual(lens, field, distance, pupil, points):
    """How far traced points (S + 1, 3) of a ray are from a stationary path through its stop point,
    and the bound of rounding on it: `_ROUNDINGS / 5` times what changing the last digit of a
    coordinate changes.

    Along a stationary path, n e - n' e' is normal to each surface that bends light, e and e' being
    the directions before and behind it, n and n' the indices.
    """
    live, (x, y) = [*lens.live, lens.count], jnp.tan(field)
    index = lens.index(jnp.full(1, WAVELENGTH, points.dtype))[:, 0]
    path = points[jnp.array(live)]
    # From the object, scaled by 1/distance, and from point to point.
    entering = path[0] / distance + jnp.stack([x, y, jnp.ones_like(x)])
    steps = jnp.concatenate([entering[None], jnp.diff(path, axis=0)])
    length = jnp.linalg.norm(steps, axis=1)
    inverse = 1 / jnp.where(length > 0, length, jnp.finfo(points.dtype).tiny ** 0.5)
    e = steps * inverse[:, None]
    errors, slopes = [], []
    for k, i in enumerate(lens.live):
        row = Shape(lens.curvature[i], lens.conic[i], lens.coefficients[i])
        slope = jnp.stack(sag_derivatives(_place(lens, i, path[k])[:2], row, lens.forms[i])[1])
        kink = _own(lens, i, index[i] * e[k] - index[i + 1] * e[k + 1])
        errors.append(jnp.max(jnp.abs(kink[:2] + slope * kink[2])))
        slopes.append(jnp.max(jnp.abs(slope)))
    stop = lens.stop
    miss = _place(lens, stop, points[stop])[:2] - lens.semi_diameter[stop] * pupil
    size = jnp.max(jnp.abs(points))
    error = jnp.maximum(jnp.max(jnp.stack(errors)), jnp.max(jnp.abs(miss)) / (1 + size))
    rounding = jnp.finfo(points.dtype).eps * (1 + size * jnp.max(inverse[1:]))
    return error, _ROUNDINGS / 5 * rounding * (1 + jnp.max(jnp.stack(slopes)))


def _scene(lens, field, distance, pupil):
    """Rays, a scalar of them and its derivatives by everything."""
    colour = jnp.full(1, WAVELENGTH, pupil.dtype)

    def scalar(lens, field, distance):
        rays = drt_jax.trace_rays(lens, field, distance, colour, pupil)
        points = rays.points
        value = jnp.sum(jnp.asarray(_weights(points.shape), points.dtype) * points)
        value = value + jnp.sum(jnp.asarray(_weights(rays.path.shape), points.dtype) * rays.path)
        return value, rays

    slope, rays = jax.grad(scalar, argnums=(0, 1, 2), has_aux=True)(lens, field, distance)
    residual = jax.vmap(_residual, (None, None, None, 0, 0))
    return rays, slope, *residual(lens, field, distance, pupil, rays.points[0])


def _moments(lens, field, distance):
    """Moments and the derivatives of a sum of them by everything; 0 for the infinite covariance of
    a colour that passes no ray."""
    colour = jnp.full(1, WAVELENGTH, field.dtype)

    def scalar(lens, field, distance):
        mean, covariance = found = drt_jax.psf_moments(lens, field, distance, colour, rule=_RULE)
        none = (found.passed == 0)[:, None, None] & jnp.isposinf(covariance)
        covariance = jnp.where(none, 0, covariance)
        value = jnp.sum(mean) + jnp.sum(covariance) + safe_sqrt(covariance[0, 0, 0])
        return value, (mean, covariance, found.passed)

    return jax.grad(scalar, argnums=(0, 1, 2), has_aux=True)(lens, field, distance)


def _shoot(lens, points, directions):
    """Hits and success of the sequential trace."""
    trace = jax.vmap(trace_snell, (None, None, 0, 0))
    return trace(lens, jnp.asarray(WAVELENGTH, points.dtype), points, directions)


def _plain(lens, field, distance, pupil):
    rays = drt_jax.trace_rays(lens, field, distance, jnp.full(1, WAVELENGTH, pupil.dtype), pupil)
    return rays.points, rays.status


# Few scenes, many programs: what takes long is to compile them.
_QUICK = {"xla_backend_optimization_level": 1, "xla_llvm_disable_expensive_passes": True}
_compiled = {
    function.__name__[1:]: jax.jit(jax.vmap(function), compiler_options=_QUICK)
    for function in (_scene, _moments, _shoot, _plain)
}


def _run(function: Callable, *arguments: Any) -> Any:
    """`function` over any number of scenes, in batches of one size; NumPy arrays."""
    count = len(jax.tree.leaves(arguments)[0])
    parts = []
    for first in range(0, count, _BATCH):
        rows = np.minimum(np.arange(first, first + _BATCH), count - 1)
        part = function(*jax.tree.map(lambda a: a[rows], arguments))
        parts.append(jax.tree.map(lambda a: np.asarray(a)[: count - first], part))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def _infinite(tree: Any) -> int:
    return int(sum(np.sum(~np.isfinite(leaf)) for leaf in jax.tree.leaves(tree)))


def _entering(points, field, distance):
    """Unit directions (N, M, 3) of the light at `points` (N, M, 3) before the lens."""
    # From the object, scaled by 1/distance.
    slope = np.concatenate([np.tan(field), np.ones((len(field), 1))], axis=1)
    direction = points / distance[:, None, None] + slope[:, None]
    return direction / np.linalg.norm(direction, axis=-1, keepdims=True)


def _launch(scenes, points):
    """Hits (N, M, S + 1, 3) and success (N, M) of Snell rays through points on entering rays."""
    hits, good = [], []
    direction = _entering(points, scenes.field, scenes.distance)
    for first in range(0, points.shape[1], _SHOTS):
        some = slice(first, first + _SHOTS)
        pad = ((0, 0), (0, _SHOTS - len(points[0, some])), (0, 0))
        p, d = (np.pad(a[:, some], pad, mode="edge") for a in (points, direction))
        h, ok = _run(_compiled["shoot"], scenes.lens, p, d)
        kept = points[0, some].shape[0]
        hits.append(h[:, :kept])
        good.append(ok[:, :kept])
    return np.concatenate(hits, 1), np.concatenate(good, 1)


def _disagree(scenes, points, good, eps) -> np.ndarray:
    """Rays (N, RAYS) that are `good` and that the sequential trace denies or sees elsewhere.

    It starts at our first hit. Elsewhere: by more than `_ROUNDINGS` roundings of a coordinate,
    multiplied by what the lens makes of a shift of the start.
    """
    first = points[:, :, 0]
    size = 1 + np.max(np.abs(points), axis=(2, 3))
    step = 1e-7 * size
    shifted = [first + step[..., None] * unit for unit in np.eye(3)[:2]]
    hits, ok = _launch(scenes, np.concatenate([first, *shifted], axis=1))
    hits, ok = (np.split(a, 3, axis=1) for a in (hits, ok))
    moved = [np.max(np.abs(h - hits[0]), axis=(2, 3)) / step for h in hits[1:]]
    grown = 1 + np.nan_to_num(np.maximum(*moved))
    off = np.max(np.abs(hits[0] - points), axis=(2, 3))
    wide = off > _ROUNDINGS * eps * size * grown
    # A ray that touches the edge of what exists may fall to either side.
    edge = ~(ok[1] & ok[2])
    return good & (wide | (~ok[0] & ~edge)), off / (eps * size * grown)


def _crossing(scenes, aims):
    """Where Snell rays through launch points (N, M, 2) of the first vertex plane cross the stop,
    along its axes, and whether they arrive."""
    points = np.concatenate([aims, np.zeros_like(aims[..., :1])], axis=-1)
    hits, ok = _launch(scenes, points)
    stop = scenes.lens.stop
    own = jax.vmap(jax.vmap(lambda lens, p: _place(lens, stop, p), (None, 0)))
    return np.asarray(own(scenes.lens, hits[:, :, stop]))[..., :2], ok


def _closer(scenes, trial, target, best):
    """One step of Newton's method with halving from launch points `trial` (N, M, 2): the miss of
    the stop point, whether it is at most `best` and rays beside it arrive too, and the step (the
    last to be halved where that is not so)."""
    h = 1e-7 * (1 + np.abs(trial).max(axis=-1, keepdims=True))
    aims = np.concatenate([trial, *(trial + h * unit for unit in np.eye(2))], axis=1)
    here, ok = _crossing(scenes, aims)
    (at, dx, dy), (ok, okx, oky) = np.split(here, 3, 1), np.split(ok, 3, 1)
    miss = np.linalg.norm(at - target, axis=-1)
    better = ok & (miss <= best)
    whole = better & okx & oky
    jacobian = np.stack([dx - at, dy - at], -1) / h[..., None]
    jacobian = np.where(whole[..., None, None], jacobian, np.eye(2)) + 1e-14 * np.eye(2)
    singular = np.abs(np.linalg.det(jacobian)) < 1e-12
    jacobian = np.where(singular[..., None, None], np.eye(2), jacobian)
    step = np.linalg.solve(jacobian, (target - at)[..., None])[..., 0]
    return miss, better, whole, step


def _search(scenes: Scenes, wanted: np.ndarray) -> np.ndarray:
    """Whether Snell's law carries a ray to each stop point (N, RAYS) that is `wanted`.

    A grid of launch points over the first surface; from the nearest that arrive, Newton's method
    with halving. A ray counts if it meets the stop point within `_STOP_MISS` and if rays
    beside it also reach the sensor.
    """
    stop, slope = scenes.lens.stop, np.linalg.norm(np.tan(scenes.field), axis=1)
    height = scenes.lens.semi_diameter[:, stop]
    place = np.sum(scenes.lens.thickness[:, :stop], axis=1)
    reach = 3 * height + 1.5 * slope * (np.abs(place) + height)
    side = np.linspace(-1, 1, _GRID)
    grid = np.stack(np.meshgrid(side, side), -1).reshape(1, -1, 2) * reach[:, None, None]
    there, ok = _crossing(scenes, grid)
    target = height[:, None, None] * scenes.pupil
    found = np.zeros(wanted.shape, bool)
    far = np.linalg.norm(there[:, None] - target[:, :, None], axis=-1)
    far = np.where(ok[:, None], far, np.inf)
    for start in np.moveaxis(np.argsort(far, axis=-1)[..., :_STARTS], -1, 0):
        aim = np.take_along_axis(grid, start[..., None], axis=1)
        best = np.take_along_axis(far, start[..., None], axis=2)[..., 0]
        step, trial = np.zeros_like(aim), aim
        for _ in range(_REFINE):
            miss, better, whole, newton = _closer(scenes, trial, target, best)
            aim = np.where(better[..., None], trial, aim)
            best = np.where(better, miss, best)
            step = np.where(whole[..., None], newton, step / 2)
            found |= wanted & whole & (miss < _STOP_MISS)
            if np.all(found | ~wanted):
                return found
            trial = aim + step
    return found


def _half(scenes: Scenes, dtype: str) -> Scenes:
    return jax.tree.map(lambda a: a.astype(dtype), scenes)


def survey(scenes: Scenes) -> dict[str, np.ndarray | int]:
    """Everything counted on some scenes: arrays over scenes (and rays), numbers."""
    dtype = scenes.distance.dtype
    eps = float(np.finfo(dtype).eps)
    rays, slope, error, bound = _run(_compiled["scene"], *scenes)
    moments_slope, moments = _run(_compiled["moments"], *scenes[:3])
    status = rays.status[:, 0]
    exact = _half(scenes, "float64")
    points = rays.points[:, 0].astype(float)
    good = (status == Status.OK) | (status == Status.CLIPPED)
    disagree, ratio = _disagree(exact, points, good, eps)
    # Scenes rounded to float32, in both precisions.
    if dtype == np.float32:
        rough, single, reached = scenes, rays.points, rays.status
    else:
        rough = jax.tree.map(lambda a: a[::_BOTH], _half(scenes, "float32"))
        single, reached = _run(_compiled["plain"], *rough)
    double = _run(_compiled["scene"], *_half(rough, "float64"))[0]
    both = (reached == Status.OK) & (double.status == Status.OK)
    failed = ~good
    some = np.flatnonzero(failed.any(axis=1))
    lost = np.zeros(failed.shape, bool)
    if some.size:
        lost[some] = _search(jax.tree.map(lambda a: a[some], exact), failed[some])
    return {
        "status": status,
        "steps": np.max(rays.newton_steps.reshape(len(status), -1), axis=1),
        "nan_values": _infinite((rays.points, rays.path, moments)),
        "nan_gradients": _infinite((slope, moments_slope)),
        "disagree": disagree | (good & (error > bound)),
        "ratio": np.where(good, ratio, 0),
        "residual": np.where(good, error / bound, 0),
        "lost": lost,
        "float32_error": np.max(np.abs(single - double.points), axis=(-1, -2))[both],
    }
