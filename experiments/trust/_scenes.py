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


def lens_of(
    parts: dict, h: np.ndarray, stop: int, media: np.ndarray | None = None, **static
) -> drt_jax.Lens:
    """A batch of lenses.

    parts: arrays (N, ...) of S surfaces, to which the sensor is added; conic and coefficients may
        be missing.
    h: (N,), semi-diameter of the stop in mm; other surfaces have none.
    media: (N, S + 1), constant indices, by default 1; static: other fields of the lens.
    """
    count, surfaces = parts["curvature"].shape
    zero, semi = np.zeros((count, surfaces)), np.full((count, surfaces), np.inf)
    semi[:, stop] = h
    rows = {"conic": zero, "coefficients": np.zeros((count, surfaces, 0)), "semi_diameter": semi}
    parts = rows | parts
    for name in ("curvature", *rows):
        last = np.full_like(parts[name][:, :1], np.inf if name == "semi_diameter" else 0)
        parts[name] = np.concatenate([parts[name], last], axis=1)
    schott = np.zeros((count, surfaces + 1, 6))
    schott[..., 0] = 1 if media is None else media**2
    none = jnp.zeros((count, surfaces + 1, 3))
    names = {"glasses": tuple(f"medium {i}" for i in range(surfaces + 1))}
    arrays = {name: jnp.asarray(value, float) for name, value in parts.items()}
    constants = Dispersion(none, none, jnp.asarray(schott))
    return drt_jax.Lens(dispersion=constants, stop=stop, **names | static, **arrays)


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
    a plane in air or a refracting surface. Returns parts of `lens_of`, h and media."""
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
    parts = {
        "curvature": curvature,
        "conic": np.zeros((count, 5)),
        "coefficients": np.zeros((count, 5, 2)),
        "thickness": thickness,
        "sensor": np.sum(thickness, axis=1) + h * rng.uniform(1, 8, count),
    }
    return parts, h, index


def scenes_of(rng, parts, h, stop, media=None, angles=(0, 15), distances=_FAR, **static) -> Scenes:
    """Scenes of `lens_of`, fields from and to so many degrees, a tenth of them 0, and distances
    from a list in mm."""
    count = len(h)
    field = fields(rng, count, *angles)
    field[rng.random(count) < 0.1] = 0
    lens = lens_of(parts, h, stop, media, **static)
    return Scenes(lens, field, rng.choice(distances, count), pupil_points(rng, count))
