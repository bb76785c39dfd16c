"""Parts of which random scenes are made: lenses, fields, pupil points."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax.lens.glass import Dispersion

__all__ = ["WAVELENGTH", "Scenes", "fields", "lens_of", "pupil_points", "scenes_of", "two_elements"]

RAYS = 8  # of each scene: the chief ray, three on the rim, the rest at random
WAVELENGTH = 0.55
_FAR = (np.inf, 1e3, 200.0)


class Scenes(NamedTuple):
    """N scenes of one static structure: a lens whose leaves have a leading axis N, fields (N, 2)
    in radians, distances (N,) in mm, pupil points (N, RAYS, 2) in the unit disc."""

    lens: drt_jax.Lens
    field: np.ndarray
    distance: np.ndarray
    pupil: np.ndarray


def lens_of(parts: dict, index: np.ndarray, stop: int, **static) -> drt_jax.Lens:
    """A batch of lenses from arrays (N, ...) of S surfaces, to which the sensor is added, and
    constant indices (N, S + 1); `static`: fields of the lens, media all different by default."""
    count, media = index.shape
    schott = np.zeros((count, media, 6))
    schott[..., 0] = index**2
    zero = np.zeros((count, media, 3))
    last = {"curvature": 0.0, "conic": 0.0, "coefficients": 0.0, "semi_diameter": np.inf}
    for name, value in last.items():
        row = np.full_like(parts[name][:, :1], value)
        parts = parts | {name: np.concatenate([parts[name], row], axis=1)}
    arrays = {name: jnp.asarray(value, float) for name, value in parts.items()}
    return drt_jax.Lens(
        dispersion=Dispersion(jnp.asarray(zero), jnp.asarray(zero), jnp.asarray(schott)),
        stop=stop,
        **{"glasses": tuple(f"medium {i}" for i in range(media))} | static,
        **arrays,
    )


def pupil_points(rng: np.random.Generator, count: int) -> np.ndarray:
    radius, angle = np.sqrt(rng.random((count, RAYS))), 2 * np.pi * rng.random((count, RAYS))
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    points[:, :4] = [[0, 0], [0, 1], [0, -1], [1, 0]]
    return points


def fields(rng: np.random.Generator, count: int, low: float, high: float) -> np.ndarray:
    """Angles of `low` to `high` degrees in any direction; a third along y, as users ask for."""
    size, turn = rng.uniform(low, high, count), 2 * np.pi * rng.random(count)
    turn = np.where(rng.random(count) < 1 / 3, np.pi / 2, turn)
    slope = np.tan(np.radians(size))
    return np.arctan(np.stack([slope * np.cos(turn), slope * np.sin(turn)], axis=-1))


def two_elements(
    rng: np.random.Generator, count: int, stop: int, f_number: tuple = (1.4, 16)
) -> tuple:
    """Two elements, or three cemented ones, of about the f-number, the stop at surface `stop`:
    a plane in air or a refracting surface. Returns the parts of a lens, and indices."""
    h = np.exp(rng.uniform(np.log(1), np.log(20), count))
    number = np.exp(rng.uniform(*np.log(f_number), count))
    n = rng.uniform(1.4, 1.95, (count, 3))
    one = np.ones(count)
    plane = {
        0: [one, one, n[:, 0], one, n[:, 1], one],
        2: [one, n[:, 0], one, one, n[:, 1], one],
        4: [one, n[:, 0], one, n[:, 1], one, one],
    }[stop]
    cemented = [one, n[:, 0], n[:, 1], one, n[:, 2], one]
    alone = rng.random(count) < 0.5
    index = np.where(alone[:, None], np.stack(plane, 1), np.stack(cemented, 1))
    curvature = rng.uniform(-1, 1, (count, 5))
    curvature[:, stop] = np.where(alone, 0, curvature[:, stop])
    # One linear step towards the wanted power, positive or negative.
    power = np.sum(curvature * np.diff(index, axis=1), axis=1)
    factor = rng.choice([1, 1, 1, -1], count) / (2 * h * number * power)
    curvature = curvature * factor[:, None]
    steepest = np.max(np.abs(curvature), axis=1) * h
    curvature = curvature * np.minimum(1, 0.9 / steepest)[:, None]
    thickness = h[:, None] * rng.uniform(0.1, 0.9, (count, 4)) + 0.5
    semi = np.full((count, 5), np.inf)
    semi[:, stop] = h
    parts = {
        "curvature": curvature,
        "conic": np.zeros((count, 5)),
        "coefficients": np.zeros((count, 5, 2)),
        "thickness": thickness,
        "semi_diameter": semi,
        "sensor": np.sum(thickness, axis=1) + h * rng.uniform(1, 8, count),
    }
    return parts, index, h


def scenes_of(rng, parts, index, stop, angles=(0.0, 15.0), distances=_FAR, **static) -> Scenes:
    count = len(index)
    field = fields(rng, count, *angles)
    field[rng.random(count) < 0.1] = 0
    distance = rng.choice(distances, count)
    return Scenes(lens_of(parts, index, stop, **static), field, distance, pupil_points(rng, count))
