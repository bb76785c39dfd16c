"""Mirrors far off their axes, grazing mirrors and relays, as families of random scenes."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ._scenes import Scenes, batch_of, fields, placed, pupil_points


def _unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def conic_mirror(d, e, near, far):
    """Conic mirrors that turn a ray from the unit vector d to e, (N, 3), and image a source on the
    ray to a point on the ray. `near` and `far` are the vergences 1 / distance of both from the hit,
    1/mm, (N,): 0 for parallel light, below 0 for a virtual source or image.

    Returns curvatures, conic constants and curvatures across the plane of incidence (of toroids),
    (N,); the axes, and the vertices relative to the hit, mm, (N, 3); and the cosines of the angles
    between the normals at the hit and the axes, (N,). Normals and axes point forwards along the
    light. Both foci lie on the axis, which has the direction near e + far d.
    """
    turn, along = 1 - np.sum(d * e, -1), near[:, None] * e + far[:, None] * d
    c, k = -(near + far) / turn, -np.sum(along**2, -1) / (near + far) ** 2
    axis, normal = np.sign(far - near)[:, None] * _unit(along), _unit(d - e)
    cosine = np.sum(axis * normal, -1)
    size = 1 / np.sqrt(1 + k * (1 - cosine**2))  # of the normal (-c x, -c y, 1 - (1 + k) c z)
    across = (normal - cosine[:, None] * axis) * (size / c)[:, None]
    height = c * np.sum(across**2, -1) / (1 + size * cosine)
    return c, k, 0 * c, axis, across - height[:, None] * axis, cosine


def local_mirror(d, e, near, far):
    """As `conic_mirror`, but spheres, or toroids, with their vertices at the hit. By Coddington's
    equations, 2 / R is power * cosine in the plane of incidence and power / cosine across it."""
    normal = _unit(d - e)
    cosine, c = np.sum(d * normal, -1), -(near + far) / 2
    return c * cosine, 0 * c, c / cosine, normal, 0 * d, 0 * c + 1


def _across(rng, d):
    """Random unit vectors perpendicular to unit vectors d, (N, 3)."""
    v = rng.normal(size=d.shape)
    return _unit(v - d * np.sum(v * d, -1, keepdims=True))


@dataclasses.dataclass
class _Rows:
    """Surfaces and the sensor of N scenes, one after the other.

    form: form of mirrors with curvatures across.
    media: as in `batch_of`.
    """

    form: str | None = None
    media: np.ndarray | None = None
    rows: list = dataclasses.field(default_factory=list)

    def add(self, point, axis, c=0.0, k=0.0, across=0.0, mirror=False):
        """Adds a row with its vertex at `point`, mm, and its axis along the unit vector `axis`,
        (N, 3); a plane by default."""
        flat = np.zeros(len(point))
        tilt = np.arctan2(-axis[:, 1], axis[:, 2]), np.arcsin(np.clip(axis[:, 0], -1, 1)), flat
        self.rows.append((mirror, flat + c, flat + k, flat + across, point, np.stack(tilt, -1)))

    def scenes(self, rng, fits, stop, radius, distance, widest=1.0):
        """Scenes of the rows at the indices `fits`. widest: largest field of each, degrees."""
        mirrors, *arrays = zip(*self.rows)
        c, k, across, point, tilt = (np.stack(a, 1)[fits] for a in arrays)
        parts = {"curvature": c[:, :-1], "conic": k[:, :-1], **placed(point, tilt)}
        static = {"mirrors": mirrors[:-1]}
        if self.media is None:
            static["glasses"] = ("air",) * len(mirrors)
        if self.form:
            parts["coefficients"] = across[:, :-1, None]
            static["forms"] = tuple(self.form if mirror else "asphere" for mirror in mirrors)
        field = fields(rng, len(fits), 0, 1) * (rng.random((len(fits), 1)) < 0.7)
        field = field * np.broadcast_to(widest, len(radius))[fits, None]
        lens = batch_of(parts, radius[fits], stop, self.media, **static)
        return Scenes(lens, field, distance[fits], pupil_points(rng, len(fits)))


class Walk(NamedTuple):
    """A function `make` of `Family` for mirrors along a chief ray. Variants are (number of mirrors,
    True if the stop is a plane between the first two mirrors, False for one in front of all).

    mirror: `conic_mirror` or `local_mirror`.
    turns: smallest and largest angle by which a mirror turns the beam, degrees.
    parallel: True for mirrors from a focus to parallel light and back, False for foci anywhere.
    width: largest semi-diameter of the beam, divided by the distance between the mirrors.
    least: smallest cosine of the angle between the normal at the chief ray and the axis of the
        mirror.
    form: "toroid" for toroids, which turn the beam in the plane of y and z.
    """

    mirror: Callable
    turns: tuple[float, float] = (30, 150)
    parallel: bool = False
    width: float = 0.1
    least: float = 0.15
    form: str | None = None

    def _turned(self, rng, d):
        """Random directions behind mirrors for light of the direction d, (N, 3)."""
        angle = np.radians(rng.uniform(*self.turns, (len(d), 1)))
        flat = np.stack([0 * d[:, 0], d[:, 2], -d[:, 1]], -1) * rng.choice([-1, 1], angle.shape)
        return np.cos(angle) * d + np.sin(angle) * (flat if self.form else _across(rng, d))

    def __call__(self, rng, count, variant):
        """`count` scenes that fit, of 200 times as many random ones.

        From mirror to mirror it follows the chief ray (`point`, direction `d`), the vergence `near`
        of the source for the next mirror, and the size of the beam there.
        """
        mirrors, between = variant
        n, rows = 200 * count, _Rows(self.form)
        reach = rng.uniform(20, 80, n)
        radius = h = reach * self.width * rng.uniform(0.05, 1, n)
        distance = reach * rng.uniform(0.2, 2, n)
        distance = np.where(rng.random(n) < (0.5 if self.parallel else 0.2), np.inf, distance)
        point, d, sense = np.zeros((n, 3)), np.tile([0.0, 0.0, 1.0], (n, 1)), 1
        size, near = h * (1 + reach / distance), 1 / (distance + reach)
        fits, widest = np.full(n, True), np.ones(n)
        rows.add(point, d)
        for i in range(mirrors):
            point, e = point + reach[:, None] * d, self._turned(rng, d)
            image = rng.choice([-1, 1, 1], n) / (reach * rng.uniform(0.3, 3, n))
            if self.parallel:
                image = np.where(near == 0, abs(image), 0)
            c, k, across, axis, vertex, cosine = self.mirror(d, e, near, image)
            fits &= (cosine > self.least) & (np.linalg.norm(vertex, axis=-1) < 30 * reach)
            # No ray of the beam, at any field, may come from behind a grazing mirror.
            angle = np.linalg.norm(d - e, axis=-1) / 2
            fits &= size * np.maximum(abs(near), abs(image)) < angle / 2
            widest = np.minimum(widest, np.degrees(angle) / 4)
            rows.add(point + vertex, sense * axis, sense * c, k, sense * across, True)
            d, sense, reach = e, -sense, reach * rng.uniform(0.7, 1.5, n)
            if between and not i:
                part = reach * rng.uniform(0.2, 0.8, n)
                radius = h * abs(1 - part * image)
                rows.add(point + part[:, None] * d, sense * d)
            if i + 1 < mirrors:
                growth = abs(1 - reach * image)
                fits &= (growth > 0.1) & (growth < 2) & (radius > 0.1 * h)
                size, near = size * growth, image / np.where(fits, reach * image - 1, 1)
        focus = (image > 0) & (rng.random(n) < 0.7)
        reach = np.where(focus, 1 / np.where(focus, image, 1), reach)
        lean = np.tan(np.radians(rng.uniform(0, 30, (n, 1))))
        rows.add(point + reach[:, None] * d, sense * _unit(d + lean * _across(rng, d)))
        chosen, stop = np.flatnonzero(fits)[:count], 2 if between else 0
        return rows.scenes(rng, chosen, stop, radius, distance, widest)


def relay(rng, count, name):
    """Offner and Dyson relays at unit magnification, with numbers changed by a few per mille.

    Offner: a concave mirror, the stop on a convex mirror of half its radius, and the first mirror
    again. Dyson: a block of glass with one sphere in front of a concave mirror, which is the stop.
    The object lies at some distance from the common centre of all spheres. All surfaces are
    decentred, so that it is in the middle of the field.
    """
    large, one = rng.uniform(50, 300, count), np.ones(count)
    turn, aside = rng.uniform(0, 2 * np.pi, count), large * rng.uniform(0.02, 0.15, count)
    n = rng.uniform(1.4, 1.9, count)
    small, radius = large * (1 - 1 / n), large * rng.uniform(0.02, 0.15, count)
    media = np.stack([one, n, one, one, n, one], 1)
    if name == "offner":
        aside, small, radius, media = 2.5 * aside, large / 2, radius / 2, None
        gap = small
        steps = [(gap, 0), (large, -1), (small, -1), (large, -1), (0 * gap, 0)]
    else:
        gap = rng.uniform(0.01, 0.05, count) * large
        steps = [(0 * gap, 0), (small, 1), (large, -1), (small, 1), (0 * gap, 0), (-gap, 0)]
    centre = -gap if name == "offner" else 0 * gap
    rows = _Rows(media=media)
    for place, kind in steps:  # 0 for a plane, 1 for a refracting sphere, -1 for a mirror
        shift = 1e-3 * large[:, None] * rng.normal(size=(count, 3))
        point = np.stack([aside * np.cos(turn), aside * np.sin(turn), centre + place], -1)
        axis = _unit([0, 0, 1] + 3e-3 * rng.normal(size=point.shape))
        rows.add(point + shift, axis, -1 / place if kind else 0.0, mirror=kind < 0)
    return rows.scenes(rng, np.arange(count), 2, radius, gap)
