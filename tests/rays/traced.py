"""One compiled program for rays and their derivatives, the comparison with the oracle, and lenses
whose stop is listed first."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax import Scene, Status, load_lens, trace_rays

from .. import oracle
from ..known import bendable, freed

WAVELENGTHS = (0.55,)
ROWS = (*oracle.LENS, *oracle.MOVES, *oracle.MEDIA)


def hexapolar(rings):
    """Points (Q, 2) of the centre and of `rings` rings of 6, 12, 18, ... points of the disc."""
    points = [np.zeros((1, 2))]
    for ring in range(1, rings + 1):
        angle = np.arange(6 * ring) / (6 * ring) * 2 * np.pi
        points.append(ring / rings * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    return np.concatenate(points)


def rays_and_derivatives(lens, field, distance, pupil, chosen):
    """Rays of one wavelength through `pupil`, and the derivatives by (lens, field) of the outputs
    with the numbers `chosen`: a lens and a field with leading axes (chosen; x, y and path).
    Derivatives are by all numbers of the lens: none is held."""
    return _both(freed(lens), field, distance, pupil, chosen)


@functools.partial(jax.jit, static_argnames="chosen")
def _both(lens, field, distance, pupil, chosen):
    def outputs(lens, field):
        rays = trace_rays(bendable(lens), Scene.point(field, distance, WAVELENGTHS), pupil)
        picked = jnp.array(chosen)
        at = rays.points[0, picked, -1, :2]
        return jnp.concatenate([at, rays.path[0, picked, None]], axis=1).ravel(), rays

    _, pull_back, rays = jax.vjp(outputs, lens, field, has_aux=True)
    slopes = jax.vmap(pull_back)(jnp.eye(3 * len(chosen), dtype=lens.curvature.dtype))
    return rays, slopes


class Truth(NamedTuple):
    """Rays by the oracle: points (..., W, Q, S + 1, 3) along the axes of the lens; heights,
    distances from the axes of the surfaces (..., W, Q, S + 1); path (..., W, Q); exists."""

    points: np.ndarray
    heights: np.ndarray
    path: np.ndarray
    exists: np.ndarray


def truth(scene, pupil):
    """The rays through points (Q, 2) of the stop."""
    x, y, _, settled = oracle.reach(scene, pupil.T)
    rays = oracle.trace(scene, x, y)
    heights = np.stack([np.hypot(*np.real(own[:2])) for own in rays.own], axis=-1)
    exists = rays.good & settled
    return Truth(np.real(oracle.xyz(rays)), heights, np.real(rays.path), exists)


def oracle_slopes(scene, pupil, rows):
    """{row: derivatives of x, y and path as in `rays_and_derivatives`} by complex steps."""
    start = oracle._aimed(scene, pupil.T)
    slopes = {}
    for row in rows:
        value = scene.values[row]
        step = 1j * oracle.STEP * np.eye(value.size).reshape(value.size, *value.shape)
        moved = np.where(np.isinf(value), value, value + step)
        batch = {k: v[None] for k, v in scene.values.items()} | {row: moved}
        batch = scene.replace(**batch)
        rays = oracle.trace(batch, *oracle.aim(batch, pupil.T, start))
        shape = rays.path.shape
        ours = np.stack([np.broadcast_to(a, shape) for a in (*rays.hits[-1][:2], rays.path)], -1)
        ours = np.imag(ours[:, 0]).reshape(shape[0], -1).T / oracle.STEP  # one colour
        slopes[row] = ours.reshape(-1, *value.shape)
    return slopes


def of_row(slopes, row):
    """The derivatives by one row of the parameters."""
    lens, field = slopes
    if row in oracle.SCENE:
        return np.asarray(field)
    return np.asarray(getattr(lens.dispersion if row in oracle.MEDIA else lens, row))


def assert_same_slopes(ours, wanted, rtol, where=""):
    """Asserts that derivatives of x, y and path by each array agree within `rtol` of the largest
    one, over rays, of this output by this array; derivatives that are 0 by geometry are only
    rounding error."""
    for row, reference in wanted.items():
        got = of_row(ours, row)
        assert got.shape == reference.shape and np.all(np.isfinite(got)), (where, row)
        if not reference.size:
            continue
        error, size = (
            np.max(np.abs(a).reshape(-1, 3, a[0].size), axis=(0, 2))
            for a in (got - reference, reference)
        )
        assert np.all(error <= rtol * size + 1e-13), (where, row, error, size)


def assert_same_rays(rays, wanted, atol, where=""):
    """Asserts that every ray of a `Truth` is found, with points and path within `atol` mm, and no
    other ray."""
    status, exists = np.asarray(rays.status), wanted.exists
    lost, made_up = exists & (status != Status.OK), ~exists & (status == Status.OK)
    assert not np.any(lost), f"{where}: {np.sum(lost)} of {np.sum(exists)} lost: {status[lost]}"
    assert not np.any(made_up), f"{where}: {np.sum(made_up)} rays that the oracle does not find"
    points, path = np.asarray(rays.points)[exists], np.asarray(rays.path)[exists]
    error = np.max(np.abs(points - wanted.points[exists]), initial=0)
    assert error <= atol, f"{where}: points {error} mm off"
    error = np.max(np.abs(path - wanted.path[exists]), initial=0)
    assert error <= atol, f"{where}: path {error} mm off"


def behind_stop(surfaces, gap, semi_diameter, **top):
    """The lens of `surfaces` with a stop plane `gap` mm in front of its first vertex, listed
    first."""
    plane = {"curvature": 0, "thickness": gap, "semi_diameter": semi_diameter, "stop": True}
    return load_lens({"surfaces": [plane | top.get("object", {}), *surfaces], **top})


def directions(points):
    """Unit vectors (..., S, 3) between the successive points (..., S + 1, 3) of rays."""
    step = np.diff(points, axis=-2)
    return step / np.linalg.norm(step, axis=-1, keepdims=True)


def on_y(*heights):
    return np.stack([np.zeros(len(heights)), heights], axis=1)
