"""Situations of docs/trials.md as families of random scenes: immersion, virtual objects and images,
collimated light, and lenses from files of other programs."""

import contextlib
import warnings
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax

from ._common import ROOT
from ._scenes import WAVELENGTH, Scenes, batch_of, fields, pupil_points, scenes_of, two_elements

# Folder of lens files next to a checkout; it is not part of it.
FILES = ROOT.parent / "shared" / "data" / "lens_files"
_SHAPE = "curvature", "conic", "coefficients"


def immersed(rng, parts, h, media):
    """Water, oil or glass in front of the lens, behind it, or on both sides; see `elements`."""
    where = rng.integers(3, size=len(h))
    for side, place in ((0, 1), (-1, 0)):
        media[:, side] = np.where(where == place, 1, rng.uniform(1.3, 1.9, len(h)))


@jax.jit
@jax.vmap
def paraxial(lens, distance):
    """Distance from the front focus to the first vertex, and z of the paraxial image, mm."""
    found = drt_jax.first_order(lens, distance, jnp.array([WAVELENGTH]))
    return -found.front_focal_distance[0], found.image_distance[0]


class Conjugate(NamedTuple):
    """A function `make` of `Family` for lenses of `two_elements` with chosen object distances.

    place: function (generator, distance of the front focus in front of the first vertex,
        semi-diameters of the stop), (N,), mm -> distances of the object, mm; NaN for a lens that
        is not used.
    virtual: share of the sensors that are placed at a virtual image, if there is one; with 1,
        lenses without one are not used. Other sensors are anywhere behind the lens.
    """

    place: Callable
    virtual: float = 0.0

    def __call__(self, rng, count, stop):
        n = 12 * count
        parts, h, media = two_elements(rng, n, stop, (2, 16))
        scenes = scenes_of(rng, parts, h, stop, media, (0, 5))
        front = np.asarray(paraxial(scenes.lens, np.full(n, np.inf))[0])
        distance = self.place(rng, front, h)
        fits = ~np.isnan(distance)
        image = np.asarray(paraxial(scenes.lens, np.where(fits, distance, np.inf))[1])
        last = np.sum(parts["thickness"], axis=1)
        seen = (image < last - 0.1 * h) & (image > last - 100 * h)
        seen &= rng.random(n) < self.virtual
        fits &= seen | (self.virtual < 1)
        parts["sensor"] = np.where(seen, image, parts["sensor"])
        chosen = np.flatnonzero(fits)[:count]
        some = {name: a[chosen] for name, a in parts.items()}
        lens = batch_of(some, h[chosen], stop, media[chosen])
        return Scenes(lens, scenes.field[chosen], distance[chosen], scenes.pupil[chosen])


def far_away(rng, front, h):
    """An object at infinity, or at some lengths of the lens."""
    return rng.choice([np.inf, 1e3, 200.0], len(h))


def inside_focus(rng, front, h):
    """An object between the lens and its front focus: light diverges behind the lens."""
    return np.where(front > h, front * rng.uniform(0.2, 0.98, len(h)), np.nan)


def at_focus(rng, front, h):
    """An object at the front focus, virtual for a negative lens: light leaves collimated."""
    return np.where(abs(front) > h, front, np.nan)


def behind_vertex(rng, front, h):
    """A virtual object: light converges to a point inside or behind the lens."""
    return -h * rng.uniform(1, 20, len(h))


class _Row(NamedTuple):
    """A lens of a file: arrays of `batch_of`; index and semi-diameter of the stop; largest field,
    degrees; distance of the object, mm."""

    parts: dict
    media: np.ndarray
    stop: int
    h: float
    field: float
    distance: float


def _read(path):
    """A lens file; None if it is refused, or has mirrors, gratings or tilts."""
    with warnings.catch_warnings(), contextlib.suppress(ValueError):
        warnings.simplefilter("ignore")
        system = drt_jax.load_system(path)
        lens, field = system.lens, np.asarray(system.scene.field)
        if any(lens.mirrors) or lens.elements or lens.phase or lens.tilt is not None:
            return None
        # Planes that bend no light are treated as surfaces here, which may not touch.
        kept = sorted({*lens.active, lens.stop})
        z = np.append(np.asarray(lens.vertices)[kept], lens.sensor)
        if np.min(np.diff(z)) < 1e-3:
            return None
        parts = {name: np.asarray(getattr(lens, name))[kept] for name in _SHAPE}
        parts["thickness"] = np.diff(z)
        index = np.asarray(lens.index([system.wavelengths[system.primary]]))[:, 0]
        media = index[[*kept, lens.count]]
        h, widest = float(lens.semi_diameter[lens.stop]), float(np.max(np.abs(field)))
        far = float(np.min(system.scene.distance))
        return _Row(parts, media, kept.index(lens.stop), h, np.degrees(widest), far)
    return None


def _padded(row, stop, surfaces, terms):
    """Arrays of a `_Row`, padded to `surfaces` surfaces with planes that bend no light. The stop
    then has the index `stop`.

    The planes are where no surface reaches: more than two radii of the stop in front of the lens,
    and in the last tenth of the distance to the sensor.
    """
    front, old = stop - row.stop, len(row.media) - 1
    back = surfaces - old - front
    rows = {}
    for name in _SHAPE:
        a = row.parts[name]
        wide = [(0, terms - a.shape[1])] if a.ndim == 2 else []
        rows[name] = np.pad(a, [(front, back), *wide])
    gap = row.parts["thickness"]
    ahead = row.h * np.where(np.arange(front) == front - 1, 2, 0.1)
    behind = np.full(back, 0.1 * gap[-1] / max(back, 1))
    first = gap[-1] - np.sum(behind)
    rows["thickness"] = np.concatenate([ahead, gap[:-1], [first], behind])
    return rows, np.pad(row.media, (front, back), mode="edge")


def files(rng, count, _):
    """Lenses of the files of `FILES`, without mirrors, gratings and rims; their curvatures and gaps
    are changed by 3 %. Planes that bend no light pad them to one structure, so that all share one
    compiled program."""
    found = [row for path in sorted(FILES.glob("*.zmx")) if (row := _read(path))]
    stop = max(row.stop for row in found)
    surfaces = stop + max(len(row.media) - 1 - row.stop for row in found)
    terms = max(row.parts["coefficients"].shape[1] for row in found)
    pick = np.arange(count) % len(found)
    padded = [_padded(row, stop, surfaces, terms) for row in found]
    parts = {name: np.stack([padded[k][0][name] for k in pick]) for name in padded[0][0]}
    for name in ("curvature", "thickness"):
        parts[name] *= 1 + 0.03 * rng.uniform(-1, 1, parts[name].shape)
    parts["sensor"] = np.sum(parts["thickness"], axis=1)
    parts["thickness"] = parts["thickness"][:, :-1]
    h, widest, far = map(np.array, zip(*(found[k][3:] for k in pick)))
    lens = batch_of(parts, h, stop, np.stack([padded[k][1] for k in pick]))
    field = fields(rng, count, 0, np.minimum(1.2 * widest, 60))
    return Scenes(lens, field, far, pupil_points(rng, count))
