"""Random scenes of one static structure: lenses, fields, distances and stop points."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax.lens.glass import Dispersion
from drt_jax.lens.lens import Labels

RAYS = 8  # rays of each scene: the chief ray, three at the rim, random ones
WAVELENGTH = 0.55
_FAR = (np.inf, 1e3, 200.0)


class Scenes(NamedTuple):
    """N scenes of one static structure.

    lens: lens whose leaves have a first axis N.
    field: (N, 2), radians.
    distance: (N,), mm.
    pupil: (N, RAYS, 2), points in the unit disc.
    """

    lens: drt_jax.Lens
    field: np.ndarray
    distance: np.ndarray
    pupil: np.ndarray


def batch_of(parts, h, stop, media=None, **static):
    """A batch of lenses.

    parts: arrays (N, ...) of S surfaces, without the sensor; conic and coefficients may be missing.
    h: (N,), semi-diameter of the stop, mm; other surfaces have none.
    stop: index of the stop.
    media: (N, S + 1), constant indices; None for 1.
    static: other fields of the lens.
    """
    count, surfaces = parts["curvature"].shape
    zero, none = np.zeros((count, surfaces)), np.zeros((count, surfaces, 0))
    parts = {"conic": zero, "coefficients": none} | parts
    for name in ("curvature", "conic", "coefficients"):
        parts[name] = np.insert(parts[name], surfaces, 0, axis=1)
    parts["semi_diameter"] = np.full((count, surfaces + 1), np.inf)
    parts["semi_diameter"][:, stop] = h
    schott = np.zeros((count, surfaces + 1, 6))
    schott[..., 0] = 1 if media is None else media**2
    none = jnp.zeros((count, surfaces + 1, 3))
    ranges = jnp.broadcast_to(jnp.array([0.1, 10.0]), (count, surfaces + 1, 2))
    glasses = static.pop("glasses", tuple(f"medium {i}" for i in range(surfaces + 1)))
    arrays = {name: jnp.asarray(value, float) for name, value in parts.items()}
    constants = Dispersion(none, none, jnp.asarray(schott), ranges)
    return drt_jax.Lens(
        dispersion=constants, stop=stop, labels=Labels("", glasses), **static, **arrays
    )


def placed(vertices, tilt):
    """The `parts` of `batch_of` for the positions of surfaces and sensor: vertices (N, S + 1, 3),
    mm, and tilts (N, S + 1, 3), radians."""
    z = vertices[..., 2]
    parts = {"thickness": np.diff(z)[:, :-1], "sensor": z[:, -1] - z[:, 0]}
    return parts | {"tilt": tilt, "decentre": vertices[..., :2]}


def pupil_points(rng, count):
    radius, angle = np.sqrt(rng.random((count, RAYS))), 2 * np.pi * rng.random((count, RAYS))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    points[:, :4] = [[0, 0], [0, 1], [0, -1], [1, 0]]
    return points


def fields(rng, count, low, high):
    """Angles of `low` to `high` degrees in any direction, a third of them along y."""
    size, turn = rng.uniform(low, high, count), 2 * np.pi * rng.random(count)
    turn = np.where(rng.random(count) < 1 / 3, np.pi / 2, turn)
    slope = np.tan(np.radians(size))
    return np.arctan(np.stack([slope * np.cos(turn), slope * np.sin(turn)], axis=-1))


def two_elements(rng, count, stop, f_number=(1.4, 16)):
    """Two elements, or three cemented ones, of about the f-number; the stop is a plane in air or a
    refracting surface. Returns `parts`, `h` and `media` of `batch_of`."""
    h = np.exp(rng.uniform(np.log(1), np.log(20), count))
    number = np.exp(rng.uniform(*np.log(f_number), count))
    n = rng.uniform(1.4, 1.95, (count, 3))
    one = np.ones(count)
    apart = np.stack([one, n[:, 0], one, n[:, 1], one], 1)
    apart = np.insert(apart, stop, 1, axis=1)  # a plane in air
    cemented = np.stack([one, n[:, 0], n[:, 1], one, n[:, 2], one], 1)
    alone = rng.random(count) < 0.5
    index = np.where(alone[:, None], apart, cemented)
    curvature = rng.uniform(-1, 1, (count, 5))
    curvature[:, stop] = np.where(alone, 0, curvature[:, stop])
    # One linear step towards the target power, positive or negative.
    power = np.sum(curvature * np.diff(index, axis=1), axis=1)
    factor = rng.choice([1, 1, 1, -1], count) / (2 * h * number * power)
    curvature = curvature * factor[:, None]
    steepest = np.max(np.abs(curvature), axis=1) * h
    curvature = curvature * np.minimum(1, 0.9 / steepest)[:, None]
    thickness = h[:, None] * rng.uniform(0.1, 0.9, (count, 4)) + 0.5
    sensor = np.sum(thickness, axis=1) + h * rng.uniform(1, 8, count)
    parts = {"curvature": curvature, "thickness": thickness, "sensor": sensor}
    parts |= {"conic": np.zeros((count, 5)), "coefficients": np.zeros((count, 5, 2))}
    return parts, h, index


def scenes_of(rng, parts, h, stop, media=None, angles=(0, 15), distances=_FAR, **static):
    """Scenes with lenses of `batch_of`.

    angles: smallest and largest field, degrees; a tenth of the fields is 0.
    distances: distances from which one is drawn for each scene, mm.
    """
    count = len(h)
    field = fields(rng, count, *angles)
    field[rng.random(count) < 0.1] = 0
    lens = batch_of(parts, h, stop, media, **static)
    return Scenes(lens, field, rng.choice(distances, count), pupil_points(rng, count))
