"""What is measured on a batch of random scenes: finite numbers, Snell's law, rays not found."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Status
from drt_jax.rays import fermat
from drt_jax.lens.lens import rotation_matrix
from drt_jax.rays.trace import system_of

from ._scenes import WAVELENGTH, Scenes

__all__ = ["COUNTS", "KEYS", "survey"]

COUNTS = ("missed", "tir", "clipped", "unconverged")
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
_ORDER = 2  # of the pupil rule whose moments are differentiated
_ROUNDINGS = 1000  # how many roundings of the hits two traces may be apart
_GRID = 41  # launch points along each side of the search for a ray that was not found
_STARTS = 4  # candidates refined for each such ray
_REFINE = 25
_STOP_MISS = 1e-9  # mm


def _weights(shape: tuple) -> jnp.ndarray:
    """Fixed numbers between 1/2 and 3/2, all different."""
    return 1 + np.sin(1 + np.arange(np.prod(shape), dtype=float)).reshape(shape) / 2


def _system(lens, field, distance, pupil):
    rows, colour = list(range(len(lens.forms))), jnp.full(1, WAVELENGTH, pupil.dtype)
    return system_of(lens, rows, field, distance, colour, pupil.T)


def _residual(lens, field, distance, pupil, points):
    """Largest |F| (RAYS,) of traced points, and the bound of rounding on it: `_ROUNDINGS / 5`
    times what changing the last digit of a coordinate changes."""
    system = _system(lens, field, distance, pupil)
    own = jnp.moveaxis(points, (1, 2), (1, 0)).at[2].add(-system.vertex[:, None])
    if system.offset is not None:
        own = own.at[:2].add(-system.offset[..., None])
        own = fermat.turn(system.rotation, own, back=True)
    hits = own[:2, :, None]
    error = jnp.max(jnp.abs(fermat.residual(hits, system)), axis=(0, 1, 2))
    path = fermat.geometry(hits, system)
    inverse = jnp.max(jnp.abs(path.inverse_length), axis=(0, 1))
    size = jnp.max(jnp.abs(points), axis=(1, 2))
    slope = jnp.max(jnp.abs(path.slope), axis=(0, 1, 2))
    bound = _ROUNDINGS / 5 * jnp.finfo(points.dtype).eps * (1 + size * inverse) * (1 + slope)
    return error, bound


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
    error, bound = _residual(lens, field, distance, pupil, rays.points[0])
    return rays, slope, error, bound


def _moments(lens, field, distance):
    """Moments and the derivatives of a sum of them by everything."""
    colour = jnp.full(1, WAVELENGTH, field.dtype)

    def scalar(lens, field, distance):
        mean, covariance = drt_jax.psf_moments(lens, field, distance, colour, order=_ORDER)
        root = drt_jax.numerics.safe_sqrt(covariance[0, 0, 0])
        return jnp.sum(mean) + jnp.sum(covariance) + root, (mean, covariance)

    return jax.grad(scalar, argnums=(0, 1, 2), has_aux=True)(lens, field, distance)


def _shoot(lens, points, directions):
    """Hits and success of the sequential trace, which alone would also follow light backwards
    to a surface that lies behind the one before it."""
    hits, ok = jax.vmap(drt_jax.trace_snell, (None, None, 0, 0))(
        lens, jnp.asarray(WAVELENGTH, points.dtype), points, directions
    )
    step = jnp.diff(hits, axis=1)
    if lens.tilt is not None:
        step = jnp.einsum("sij,msi->msj", jax.vmap(rotation_matrix)(lens.tilt[1:]), step)
    return hits, ok & jnp.all(step[..., 2] * jnp.asarray(lens.senses[1:], step.dtype) >= 0, axis=1)


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
    tangent = np.tan(field)[:, None]
    far = np.isinf(distance)[:, None, None]
    reach = np.where(np.isinf(distance), 1, distance)[:, None]
    source = np.concatenate([-tangent * reach[..., None], -reach[..., None]], axis=-1)
    straight = np.concatenate([tangent, np.ones_like(tangent[..., :1])], axis=-1)
    direction = np.where(far, straight, points - source)
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


def _search(scenes: Scenes, wanted: np.ndarray) -> np.ndarray:
    """Whether Snell's law carries a ray to each stop point (N, RAYS) that is `wanted`.

    A grid of launch points over the first surface; from the nearest that arrive, Newton's method
    with halving. A ray counts if it meets the stop point within `_STOP_MISS` and if rays
    beside it also reach the sensor.
    """
    lens = scenes.lens
    stop, count = lens.stop, len(scenes.distance)
    height = lens.semi_diameter[:, stop]
    place = np.concatenate([np.zeros((count, 1)), np.cumsum(lens.thickness, axis=1)], axis=1)
    origin = np.stack([np.zeros(count), np.zeros(count), place[:, stop]], 1)
    back = np.broadcast_to(np.eye(3), (count, 3, 3))
    if lens.decentre is not None:
        origin[:, :2] = lens.decentre[:, stop]
        back = np.asarray(jax.vmap(rotation_matrix)(jnp.asarray(lens.tilt[:, stop])))

    def crossing(aims):
        points = np.concatenate([aims, np.zeros_like(aims[..., :1])], axis=-1)
        hits, ok = _launch(scenes, points)
        own = np.einsum("nij,nmi->nmj", back, hits[:, :, stop] - origin[:, None])
        return own[..., :2], ok

    slope = np.linalg.norm(np.tan(scenes.field), axis=1)
    reach = 3 * height + 1.5 * slope * (np.abs(place[:, stop]) + height)
    side = np.linspace(-1, 1, _GRID)
    grid = np.stack(np.meshgrid(side, side), -1).reshape(1, -1, 2) * reach[:, None, None]
    there, ok = crossing(grid)
    target = height[:, None, None] * scenes.pupil
    found = np.zeros(wanted.shape, bool)
    far = np.linalg.norm(there[:, None] - target[:, :, None], axis=-1)
    far = np.where(ok[:, None], far, np.inf)
    for start in np.moveaxis(np.argsort(far, axis=-1)[..., :_STARTS], -1, 0):
        aim = np.take_along_axis(grid, start[..., None], axis=1)
        best = np.take_along_axis(far, start[..., None], axis=2)[..., 0]
        step, trial = np.zeros_like(aim), aim
        for _ in range(_REFINE):
            h = 1e-7 * (1 + np.abs(trial).max(axis=-1, keepdims=True))
            units = np.eye(2)
            here, ok = crossing(np.concatenate([trial, *(trial + h * u for u in units)], axis=1))
            (at, dx, dy), (ok, okx, oky) = np.split(here, 3, 1), np.split(ok, 3, 1)
            miss = np.linalg.norm(at - target, axis=-1)
            better = ok & (miss <= best)
            aim = np.where(better[..., None], trial, aim)
            best = np.where(better, miss, best)
            jacobian = np.stack([dx - at, dy - at], -1) / h[..., None]
            jacobian = np.where((okx & oky & better)[..., None, None], jacobian, np.eye(2))
            jacobian = jacobian + 1e-14 * np.eye(2)
            singular = np.abs(np.linalg.det(jacobian)) < 1e-12
            jacobian = np.where(singular[..., None, None], np.eye(2), jacobian)
            newton = np.linalg.solve(jacobian, (target - at)[..., None])[..., 0]
            step = np.where((better & okx & oky)[..., None], newton, step / 2)
            found |= wanted & better & okx & oky & (miss < _STOP_MISS)
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
        "steps": rays.newton_steps,
        "nan_values": _infinite((rays.points, rays.path, moments)),
        "nan_gradients": _infinite((slope, moments_slope)),
        "disagree": disagree | (good & (error > bound)),
        "ratio": np.where(good, ratio, 0),
        "residual": np.where(good, error / bound, 0),
        "lost": lost,
        "float32_error": np.max(np.abs(single - double.points), axis=(-1, -2))[both],
    }
