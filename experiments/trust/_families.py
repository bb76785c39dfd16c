"""Random scenes made to break a ray tracer, in families that share their static structure."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax

from ._scenes import WAVELENGTH, Scenes, fields, lens_of, pupil_points, scenes_of, two_elements

__all__ = ["FAMILIES", "draw"]

_FREEFORM = ("biconic", "toroid", "odd_asphere", "polynomial_xy", "asphere", "asphere")
_PLASTICS = (1.535, 1.544, 1.614, 1.661)


class Family(NamedTuple):
    """variants: what `make(generator, count, variant)` is called with, scenes shared out evenly.
    share: how many scenes for one of the other families."""

    make: Callable[[np.random.Generator, int, object], Scenes]
    variants: tuple
    share: float = 1.0
    dtype: str = "float64"


def aperture(rng, count, stop):
    """f/0.7 to f/32."""
    parts, index, _ = two_elements(rng, count, stop, (0.7, 32))
    return scenes_of(rng, parts, index, stop)


def curvature(rng, count, stop):
    """Curvatures through zero, exact and as good as, and near-hemispherical ones."""
    parts, index, h = two_elements(rng, count, stop)
    tiny = rng.choice([0.0, -0.0, 1e-300, -1e-16, 1e-12, -1e-9, 1e-6], (count, 5))
    steep = rng.choice([-1, 1], (count, 5)) * rng.uniform(0.8, 1.02, (count, 5)) / h[:, None]
    pick = rng.random((count, 5))
    change = np.where(pick < 0.3, tiny, np.where(pick > 0.85, steep, parts["curvature"]))
    return scenes_of(rng, parts | {"curvature": change}, index, stop)


def conic(rng, count, stop):
    """Paraboloids, hyperboloids to k = -30, and oblate ellipsoids to k = 3."""
    parts, index, _ = two_elements(rng, count, stop, (0.8, 8))
    low = -np.exp(rng.uniform(0, np.log(30), (count, 5)))
    k = np.where(rng.random((count, 5)) < 0.2, -1.0, low)
    k = np.where(rng.random((count, 5)) < 0.2, rng.uniform(0, 3, (count, 5)), k)
    return scenes_of(rng, parts | {"conic": k}, index, stop)


def asphere(rng, count, stop):
    """Aspheric departures of up to a tenth of the semi-diameter at the rim, terms of r^2 and
    r^4 against each other."""
    parts, index, h = two_elements(rng, count, stop)
    rim = h[:, None] * rng.uniform(-0.1, 0.1, (count, 5)) * rng.random((count, 1)) ** 2
    a4 = rim / h[:, None] ** 4
    a2 = -rng.random((count, 5)) * rim / h[:, None] ** 2
    return scenes_of(rng, parts | {"coefficients": np.stack([a2, a4], -1)}, index, stop)


def index(rng, count, stop):
    """Neighbouring indices equal, or apart by 1e-12 to 1e-2; some lenses all but vanish."""
    parts, media, _ = two_elements(rng, count, stop)
    near = 1 + rng.choice([0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2], media.shape)
    close = rng.random(media.shape) < 0.5
    media = np.where(close, near * rng.choice([1.0, 1.5, 1.9], (count, 1)), media)
    return scenes_of(rng, parts, media, stop)


def edge(rng, count, stop):
    """Rays that miss, graze or are totally reflected: stops too wide for steep surfaces, and
    light that leaves glass at a slant."""
    parts, media, _ = two_elements(rng, count, stop, (0.7, 2))
    parts["semi_diameter"] = parts["semi_diameter"] * rng.uniform(1, 2.5, (count, 1))
    slanted = rng.random(count) < 0.3
    media[:, 0] = np.where(slanted, rng.uniform(1.4, 1.9, count), media[:, 0])
    return scenes_of(rng, parts, media, stop, (0, 40))


def touching(rng, count, stop):
    """Surfaces that touch: gaps of 0, of less than a coordinate's last digit, and of 1e-8 mm."""
    return _close(rng, count, stop, [0.0, 1e-17, 1e-8])


def close(rng, count, stop):
    """Surfaces that all but touch, stop and sensor included: gaps of 1e-6 to 1e-2 mm."""
    return _close(rng, count, stop, [1e-6, 1e-4, 1e-2])


def _close(rng, count, stop, gaps):
    parts, media, h = two_elements(rng, count, stop)
    gap = rng.choice(gaps, (count, 4))
    thickness = np.where(rng.random((count, 4)) < 0.4, gap, parts["thickness"])
    # Neighbours that touch must not cross: the same shape, or both planes.
    c = parts["curvature"]
    for i in range(4):
        c[:, i + 1] = np.where(thickness[:, i] <= 1e-2, c[:, i], c[:, i + 1])
    back = rng.choice([*gaps, 1.0, 30.0], count)
    flat = back < 0.1  # the sensor on the last surface
    c[:, 4] = np.where(flat, 0, c[:, 4])
    c[:, 3] = np.where(flat & (thickness[:, 3] <= 1e-2), 0, c[:, 3])
    sensor = np.sum(thickness, axis=1) + back + np.where(flat, 0, h)
    return scenes_of(rng, parts | {"thickness": thickness, "sensor": sensor}, media, stop)


def distance(rng, count, stop):
    """Objects at 10 mm, between, at 1e9 mm and at infinity."""
    parts, media, _ = two_elements(rng, count, stop, (1.4, 16))
    return scenes_of(rng, parts, media, stop, (0, 20), (10.0, 20.0, 50.0, 1e5, 1e9, 1e15, np.inf))


def focus(rng, count, stop):
    """The sensor exactly at the paraxial focus; and stigmatic ellipsoids, whose spot is 0."""
    parts, media, h = two_elements(rng, count, stop, (1, 16))
    scenes = scenes_of(rng, parts, media, stop, (0, 5))
    image = jax.vmap(lambda lens, d: drt_jax.image_distance(lens, d, jnp.array([WAVELENGTH]))[0])
    last = np.sum(parts["thickness"], axis=1)
    sensor = np.asarray(jax.jit(image)(scenes.lens, jnp.asarray(scenes.distance)))
    sensor = np.where((sensor > last) & (sensor < last + 40 * h), sensor, parts["sensor"])
    ideal = rng.random(count) < 0.3
    n, c = media[:, 1], rng.uniform(0.05, 0.6, count) / h
    media = np.where(ideal[:, None], n[:, None], media)
    media[:, 0] = 1
    n = media[:, 1]
    glass = ideal & (n > 1)
    bend, k = parts["curvature"].copy(), parts["conic"].copy()
    bend[:, 0], k[:, 0] = np.where(glass, c, bend[:, 0]), np.where(glass, -1 / n**2, 0)
    bend[:, 1:] = np.where(ideal[:, None], 0, bend[:, 1:])
    sensor = np.where(glass, n / (c * np.where(n > 1, n - 1, 1)), sensor)
    sensor = np.maximum(sensor, last + 0.1)
    parts = parts | {"curvature": bend, "conic": k, "sensor": sensor}
    field = np.where(ideal[:, None], 0, scenes.field)
    far = np.where(ideal, np.inf, scenes.distance)
    return Scenes(lens_of(parts, media, stop), field, far, scenes.pupil)


def field(rng, count, stop):
    """Fields of 20 to 45 degrees."""
    parts, media, _ = two_elements(rng, count, stop, (2, 16))
    return scenes_of(rng, parts, media, stop, (20, 45))


def tilted(rng, count, stop):
    """Surfaces and sensor tilted by up to 10 degrees and decentred by up to a tenth."""
    parts, media, h = two_elements(rng, count, stop, (2, 16))
    size = rng.random((count, 1, 1))
    parts["tilt"] = np.radians(rng.uniform(-10, 10, (count, 6, 3))) * size
    parts["decentre"] = rng.uniform(-0.1, 0.1, (count, 6, 2)) * size * h[:, None, None]
    return scenes_of(rng, parts, media, stop)


def mirror(rng, count, stop):
    """Two mirrors facing each other, concave and convex, conic."""
    h = rng.uniform(5, 50, count)
    gap = h * rng.uniform(1.5, 6, count)
    first = -rng.uniform(0.05, 0.7, count) / h
    second = -rng.uniform(-0.5, 1.2, count) / h
    semi = np.full((count, 2), np.inf)
    semi[:, stop] = h * (1 if stop == 0 else 0.4)
    parts = {
        "curvature": np.stack([first, second], 1),
        "conic": rng.uniform(-4, 0.5, (count, 2)),
        "coefficients": np.zeros((count, 2, 0)),
        "thickness": -gap[:, None],
        "semi_diameter": semi,
        "sensor": h * rng.uniform(-1, 3, count),
    }
    return scenes_of(
        rng, parts, np.ones((count, 3)), stop, (0, 3), (np.inf, 1e6, 1e4), mirrors=(True, True)
    )


def folded(rng, count, stop):
    """A periscope: two plane or weakly curved mirrors at 45 degrees, the stop behind or before."""
    h, reach = rng.uniform(2, 6, count), rng.uniform(20, 60, count)
    zero = np.zeros(count)
    c = rng.choice([0.0, 1e-3, -1e-3], (count, 2))
    z = np.stack([zero, zero + 20, zero + 20, zero + 40, zero + 70], 1)
    y = np.stack([zero, zero, reach, reach, reach], 1)
    tilt = np.zeros((count, 5, 3))
    tilt[:, 1:3, 0] = np.radians(45) + np.radians(rng.uniform(-2, 2, (count, 2)))
    tilt[:, 3] = np.radians(rng.uniform(-3, 3, (count, 3)))
    semi = np.full((count, 4), np.inf)
    semi[:, stop] = h
    parts = {
        "curvature": np.stack([zero, c[:, 0], c[:, 1], zero], 1),
        "conic": np.zeros((count, 4)),
        "coefficients": np.zeros((count, 4, 0)),
        "thickness": np.diff(z, axis=1)[:, :3],
        "semi_diameter": semi,
        "sensor": z[:, 4],
        "tilt": tilt,
        "decentre": np.stack([np.zeros((count, 5)), y], -1),
    }
    return scenes_of(
        rng, parts, np.ones((count, 5)), stop, (0, 5), mirrors=(False, True, True, False)
    )


def freeform(rng, count, stop):
    """A biconic, a toroid, odd powers, a polynomial and an asphere."""
    parts, media, h = two_elements(rng, count, stop, (1.4, 16))
    size = h[:, None]
    terms = np.zeros((count, 5, 5))
    c = parts["curvature"]
    terms[:, 0, 0] = c[:, 0] * rng.uniform(-1, 1.5, count)
    terms[:, 0, 1] = rng.uniform(-3, 0, count)
    terms[:, 1, 0] = c[:, 1] * rng.choice([0.0, 0.5, 1.0, -1.0], count)
    powers = np.array([1, 2, 3, 4, 5])
    terms[:, 2] = rng.uniform(-0.02, 0.02, (count, 5)) * size / size**powers
    terms[:, 3] = rng.uniform(-0.03, 0.03, (count, 5)) * size / size ** np.array([1, 1, 2, 2, 2])
    terms[:, 4, 1] = rng.uniform(-0.03, 0.03, count) / h**3
    return scenes_of(rng, parts | {"coefficients": terms}, media, stop, forms=_FREEFORM)


def phone(rng, count, elements):
    """Plastic aspheres to r^12, f about 4 mm, f/1.6 to f/2.4, fields to 40 degrees, the stop from
    0.6 mm before to 0.6 mm behind the first vertex."""
    surfaces, f = 2 * elements, rng.uniform(3.5, 4.5, count)
    h = f / (2 * rng.uniform(1.6, 2.4, count))
    n = rng.choice(_PLASTICS, (count, elements))
    media = np.ones((count, surfaces + 2))
    media[:, 2::2] = n
    gap = rng.choice([-0.6, -0.3, 0.0, 0.6], count)
    gap = np.where(rng.random(count) < 0.5, gap, rng.uniform(-0.6, 0.6, count))
    thickness = rng.uniform(0.35, 0.7, (count, surfaces))
    thickness[:, ::2] = rng.uniform(0.15, 0.5, (count, elements))
    thickness[:, 0] = gap
    # Where the beam of a wide field reaches the surfaces.
    place = np.cumsum(thickness, axis=1) - gap[:, None]
    height = h[:, None] + 0.45 * place
    c = rng.uniform(-0.5, 0.5, (count, surfaces)) / height
    bend = 1 / (f * (n[:, 0] - 1))  # of a first element that is all of the lens
    c[:, 0] = bend / rng.uniform(0.9, 1.2, count)
    c[:, 1] = c[:, 0] - bend / rng.uniform(0.7, 1.1, count)
    powers = np.arange(2, 14, 2)
    terms = rng.uniform(-0.02, 0.02, (count, surfaces, 6)) * height[..., None]
    terms = terms / height[..., None] ** powers
    rows = {"curvature": c, "conic": rng.uniform(-4, 0.5, c.shape), "coefficients": terms}
    parts = {name: np.insert(a, 0, 0, axis=1) for name, a in rows.items()}
    parts["semi_diameter"] = np.full((count, surfaces + 1), np.inf)
    parts["semi_diameter"][:, 0] = h
    parts["thickness"] = thickness
    parts["sensor"] = np.sum(thickness, axis=1) + rng.uniform(0.5, 1.5, count)
    glasses = "air", *(f"medium {i}" if i % 2 else "air" for i in range(surfaces + 1))
    return scenes_of(rng, parts, media, 0, (0, 40), glasses=glasses)


def offaxis(rng, count, stop):
    """Three mirrors that fold the beam, all tilted and decentred; the stop a plane that the first
    or the second pokes through or touches, or the second itself."""
    h = rng.uniform(5, 30, count)
    reach = h[:, None] * rng.uniform(3, 8, (count, 3))
    angle, place = np.zeros(count), np.zeros((count, 4, 2))
    tilt, shift = np.zeros((count, 4, 3)), rng.uniform(-0.1, 0.1, (count, 4, 2))
    for i in range(3):  # along a ray in the middle of the beam
        tilt[:, i, 0] = np.radians(rng.uniform(8, 20, count))
        angle = np.pi - angle - 2 * tilt[:, i, 0]
        along = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
        place[:, i + 1] = place[:, i] + reach[:, i, None] * along
    tilt[:, 3, 0] = np.pi - angle
    tilt += np.radians(rng.uniform(-2, 2, tilt.shape))
    decentre, z = shift * h[:, None, None], place[..., 1]
    decentre[..., 1] += place[..., 0]
    power = rng.uniform(0.05, 0.3, (count, 3)) * [-1, 1, -1]
    power[:, 1] *= rng.choice([1, 1, -1], count)
    parts = {"curvature": power / reach, "conic": rng.uniform(-3, 0.5, (count, 3))}
    mirrors, row = [True] * 3, {"first": 0, "second": 1, "itself": 1}[stop]
    if stop != "itself":
        gap = h * rng.choice([0.0, 0.0, 0.1, -0.1, 0.3, -0.3], count)
        plane = tilt[:, row] * rng.choice([0.0, 0.5, 1.0], (count, 1))
        tilt, decentre = (
            np.insert(a, row, b, 1) for a, b in ((tilt, plane), (decentre, decentre[:, row]))
        )
        z = np.insert(z, row, z[:, row] - gap, axis=1)
        parts = {name: np.insert(a, row, 0, axis=1) for name, a in parts.items()}
        mirrors.insert(row, False)
    surfaces = len(mirrors)
    parts |= {"coefficients": np.zeros((count, surfaces, 0)), "tilt": tilt, "decentre": decentre}
    parts |= {"thickness": np.diff(z, axis=1)[:, :-1], "sensor": z[:, -1] - z[:, 0]}
    parts["semi_diameter"] = np.full((count, surfaces), np.inf)
    parts["semi_diameter"][:, row] = h
    air, far = ("air",) * (surfaces + 1), (np.inf, 1e6, 1e4)
    media = np.ones((count, surfaces + 1))
    return scenes_of(rng, parts, media, row, (0, 3), far, glasses=air, mirrors=tuple(mirrors))


def camera(rng, count, name):
    """A bundled lens with parameters off by 3 %, fields to 1.2 times its own, objects from
    300 mm on, aspheric terms of some um at the rim of the stop."""
    lens = drt_jax.load_lens(name)
    surfaces = lens.count
    batch = jax.tree.map(lambda a: np.broadcast_to(a, (count, *a.shape)), lens)

    def vary(a, size=0.03):
        return jnp.asarray(a * (1 + size * rng.uniform(-1, 1, a.shape)))

    rim = float(lens.semi_diameter[lens.stop])
    conic, terms = np.zeros((count, surfaces + 1)), np.zeros((count, surfaces + 1, 2))
    terms[:, :-1, 1] = rng.uniform(-5e-3, 5e-3, (count, surfaces)) / rim**4
    conic[:, :-1] = rng.uniform(-0.2, 0.2, (count, surfaces))
    batch = dataclasses.replace(
        jax.tree.map(jnp.asarray, batch),
        curvature=vary(batch.curvature),
        thickness=vary(batch.thickness),
        conic=jnp.asarray(conic),
        coefficients=jnp.asarray(terms),
        sensor=vary(batch.sensor, 0.003),
    )
    widest = {"singlet": 5.0, "double_gauss": 14.0}.get(name, 20.0) * 1.2
    far = rng.choice([300.0, 1e3, 25e3, 1e9, np.inf], count)
    return Scenes(batch, fields(rng, count, 0, widest), far, pupil_points(rng, count))


_CAMERAS = ("double_gauss", "cooke_triplet", "singlet")
FAMILIES = {
    "aperture": Family(aperture, (0, 2, 4)),
    "curvature": Family(curvature, (0, 2, 4)),
    "conic": Family(conic, (0, 2, 4)),
    "asphere": Family(asphere, (0, 2, 4)),
    "index": Family(index, (0, 2, 4)),
    "edge": Family(edge, (0, 2, 4)),
    "close": Family(close, (0, 2, 4)),
    "touching": Family(touching, (2,), 0.2),
    "distance": Family(distance, (0, 2, 4)),
    "focus": Family(focus, (0, 2, 4)),
    "field": Family(field, (0, 2, 4)),
    "tilted": Family(tilted, (4,)),
    "mirror": Family(mirror, (1,)),
    "folded": Family(folded, (3,), 0.5),
    "freeform": Family(freeform, (2,), 0.5),
    "camera": Family(camera, _CAMERAS),
    "camera, float32": Family(camera, _CAMERAS, 1.0, "float32"),
    "aperture, float32": Family(aperture, (2,), 0.5, "float32"),
    "asphere, float32": Family(asphere, (2,), 0.5, "float32"),
    "field, float32": Family(field, (2,), 0.5, "float32"),
    "phone": Family(phone, (3, 4, 5), 0.5),
    "offaxis": Family(offaxis, ("first", "second", "itself"), 0.5),
}


def draw(name: str, count: int, seed: int, variants: tuple | None = None) -> Iterator[Scenes]:
    """The scenes of a family, one batch for each variant, always the same for a seed."""
    family = FAMILIES[name]
    number = list(FAMILIES).index(name)
    variants = family.variants if variants is None else variants
    each = -(-max(1, round(count * family.share)) // len(variants))
    for k, variant in enumerate(variants):
        rng = np.random.default_rng((seed, number, k))
        scenes = family.make(rng, each, variant)
        yield jax.tree.map(lambda a: np.asarray(a, family.dtype), scenes)
