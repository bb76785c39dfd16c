"""Families of random scenes that are difficult for a ray tracer, each with one static structure."""

import dataclasses
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax

from ._offaxis import Walk, conic_mirror, local_mirror, relay
from ._scenes import (
    Scenes,
    batch_of,
    fields,
    placed,
    pupil_points,
    scenes_of,
    two_elements,
)
from ._situations import (
    FILES,
    Conjugate,
    at_focus,
    behind_vertex,
    far_away,
    files,
    immersed,
    inside_focus,
    paraxial,
)

_FREEFORM = ("biconic", "toroid", "odd_asphere", "polynomial_xy", "asphere", "asphere")
_PLASTICS = (1.535, 1.544, 1.614, 1.661)

Make = Callable[[np.random.Generator, int, Any], Scenes]


class Family(NamedTuple):
    """Random scenes of one kind.

    what: description.
    make: function (generator, count, variant) -> scenes.
    variants: variants, each with the same number of scenes.
    share: number of scenes relative to a family of full size.
    needs: folder that the scenes need; without it there are none.
    """

    what: str
    make: Make
    variants: tuple = (0, 2, 4)
    share: float = 1.0
    dtype: str = "float64"
    needs: pathlib.Path | None = None


def elements(change: Callable | None = None, f_number: tuple = (1.4, 16), **scenes: Any) -> Make:
    """Scenes of `two_elements`, changed in place by change(generator, parts, h, media). scenes:
    arguments of `scenes_of`. A variant is the index of the stop."""

    def make(rng, count, stop):
        parts, h, media = two_elements(rng, count, stop, f_number)
        if change:
            change(rng, parts, h, media)
        return scenes_of(rng, parts, h, stop, media, **scenes)

    return make


def curvature(rng, parts, h, media):
    """Surfaces with a curvature of zero or nearly zero, and nearly hemispherical ones."""
    shape = parts["curvature"].shape
    tiny = rng.choice([0.0, -0.0, 1e-300, -1e-16, 1e-12, -1e-9, 1e-6], shape)
    steep = rng.choice([-1, 1], shape) * rng.uniform(0.8, 1.02, shape) / h[:, None]
    pick = rng.random(shape)
    parts["curvature"] = np.select([pick < 0.3, pick > 0.85], [tiny, steep], parts["curvature"])


def conic(rng, parts, h, media):
    """Paraboloids, hyperboloids, oblate ellipsoids."""
    shape = parts["conic"].shape
    low = -np.exp(rng.uniform(0, np.log(30), shape))
    k = np.where(rng.random(shape) < 0.2, -1.0, low)
    parts["conic"] = np.where(rng.random(shape) < 0.2, rng.uniform(0, 3, shape), k)


def asphere(rng, parts, h, media):
    """Aspheres whose terms of r^2 and r^4 compensate each other."""
    shape, h = parts["conic"].shape, h[:, None]
    rim = h * rng.uniform(-0.1, 0.1, shape) * rng.random(h.shape) ** 2
    a4, a2 = rim / h**4, -rng.random(shape) * rim / h**2
    parts["coefficients"] = np.stack([a2, a4], -1)


def index(rng, parts, h, media):
    """Equal or nearly equal neighbouring indices, so that some lenses have almost no power."""
    near = 1 + rng.choice([0.0, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2], media.shape)
    close = rng.random(media.shape) < 0.5
    media[:] = np.where(close, near * rng.choice([1.0, 1.5, 1.9], (len(h), 1)), media)


def edge(rng, parts, h, media):
    """Stops too wide for steep surfaces, and oblique rays that leave glass."""
    h *= rng.uniform(1, 2.5, h.shape)
    slanted = rng.random(h.shape) < 0.3
    media[:, 0] = np.where(slanted, rng.uniform(1.4, 1.9, h.shape), media[:, 0])


def gaps(*sizes: float) -> Callable:
    """Gaps of given sizes between surfaces and in front of the sensor."""

    def change(rng, parts, h, media):
        gap = rng.choice(sizes, (len(h), 4))
        thickness = np.where(rng.random(gap.shape) < 0.4, gap, parts["thickness"])
        # Neighbours that touch must not cross: the same shape, or both planes.
        c = parts["curvature"]
        for i in range(4):
            c[:, i + 1] = np.where(thickness[:, i] <= 1e-2, c[:, i], c[:, i + 1])
        back = rng.choice([*sizes, 1.0, 30.0], len(h))
        flat = back < 0.1  # the sensor touches the last surface
        c[:, 4] = np.where(flat, 0, c[:, 4])
        c[:, 3] = np.where(flat & (thickness[:, 3] <= 1e-2), 0, c[:, 3])
        sensor = np.sum(thickness, axis=1) + back + np.where(flat, 0, h)
        parts |= {"thickness": thickness, "sensor": sensor}

    return change


def tilted(rng, parts, h, media):
    """Tilted and decentred surfaces and sensor."""
    size = rng.random((len(h), 1, 1))
    parts["tilt"] = np.radians(rng.uniform(-10, 10, (len(h), 6, 3))) * size
    parts["decentre"] = rng.uniform(-0.1, 0.1, (len(h), 6, 2)) * size * h[:, None, None]


def freeform(rng, parts, h, media):
    """A biconic, a toroid, odd powers, a polynomial and an asphere."""
    c, size, count = parts["curvature"], h[:, None], len(h)
    terms, powers = np.zeros((count, 5, 5)), np.array([1, 2, 3, 4, 5])
    terms[:, 0, 0] = c[:, 0] * rng.uniform(-1, 1.5, count)
    terms[:, 0, 1] = rng.uniform(-3, 0, count)
    terms[:, 1, 0] = c[:, 1] * rng.choice([0.0, 0.5, 1.0, -1.0], count)
    terms[:, 2] = rng.uniform(-0.02, 0.02, (count, 5)) * size / size**powers
    terms[:, 3] = rng.uniform(-0.03, 0.03, (count, 5)) * size / size ** np.array([1, 1, 2, 2, 2])
    terms[:, 4, 1] = rng.uniform(-0.03, 0.03, count) / h**3
    parts["coefficients"] = terms


def focus(rng, count, stop):
    """Sensors exactly at the paraxial focus; and stigmatic ellipsoids with a spot of 0."""
    parts, h, media = two_elements(rng, count, stop, (1, 16))
    scenes = scenes_of(rng, parts, h, stop, media, (0, 5))
    last = np.sum(parts["thickness"], axis=1)
    sensor = np.asarray(paraxial(scenes.lens, scenes.distance)[1])
    sensor = np.where((sensor > last) & (sensor < last + 40 * h), sensor, parts["sensor"])
    ideal = rng.random(count) < 0.3
    n, c = media[:, 1], rng.uniform(0.05, 0.6, count) / h
    media = np.where(ideal[:, None], n[:, None], media)
    media[:, 0] = 1
    glass = ideal & (n > 1)
    bend, k = parts["curvature"], parts["conic"]
    bend[:, 0], k[:, 0] = np.where(glass, c, bend[:, 0]), np.where(glass, -1 / n**2, 0)
    bend[:, 1:] = np.where(ideal[:, None], 0, bend[:, 1:])
    sensor = np.where(glass, n / (c * np.where(n > 1, n - 1, 1)), sensor)
    parts["sensor"] = np.maximum(sensor, last + 0.1)
    field = np.where(ideal[:, None], 0, scenes.field)
    far = np.where(ideal, np.inf, scenes.distance)
    return Scenes(batch_of(parts, h, stop, media), field, far, scenes.pupil)


def mirror(rng, count, stop):
    """Two concave or convex mirrors that face each other."""
    h = rng.uniform(5, 50, count)
    gap = h * rng.uniform(1.5, 6, count)
    first, second = -rng.uniform(0.05, 0.7, count) / h, -rng.uniform(-0.5, 1.2, count) / h
    parts = {"curvature": np.stack([first, second], 1), "conic": rng.uniform(-4, 0.5, (count, 2))}
    parts |= {"thickness": -gap[:, None], "sensor": h * rng.uniform(-1, 3, count)}
    far = (np.inf, 1e6, 1e4)
    return scenes_of(rng, parts, 0.4 * h, stop, None, (0, 3), far, mirrors=(True, True))


def folded(rng, count, stop):
    """Periscopes of plane or weakly curved mirrors, with the stop behind them."""
    h, reach = rng.uniform(2, 6, count), rng.uniform(20, 60, count)
    c = rng.choice([0.0, 1e-3, -1e-3], (count, 2))
    vertices, tilt = np.zeros((count, 5, 3)), np.zeros((count, 5, 3))
    vertices[..., 2] = [0.0, 20.0, 20.0, 40.0, 70.0]
    vertices[:, 2:, 1] = reach[:, None]
    tilt[:, 1:3, 0] = np.radians(45) + np.radians(rng.uniform(-2, 2, (count, 2)))
    tilt[:, 3] = np.radians(rng.uniform(-3, 3, (count, 3)))
    parts = {"curvature": np.pad(c, ((0, 0), (1, 1))), **placed(vertices, tilt)}
    return scenes_of(rng, parts, h, stop, None, (0, 5), mirrors=(False, True, True, False))


def phone(rng, count, elements):
    """Phone lenses of `elements` plastic elements, f about 4 mm, with a dummy stop."""
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
    # Height of the beam of a wide field on the surfaces.
    place = np.cumsum(thickness, axis=1) - gap[:, None]
    height = h[:, None] + 0.45 * place
    c = rng.uniform(-0.5, 0.5, (count, surfaces)) / height
    bend = 1 / (f * (n[:, 0] - 1))  # of a first element with the power of the lens
    c[:, 0] = bend / rng.uniform(0.9, 1.2, count)
    c[:, 1] = c[:, 0] - bend / rng.uniform(0.7, 1.1, count)
    powers = np.arange(2, 14, 2)
    terms = rng.uniform(-0.02, 0.02, (count, surfaces, 6)) * height[..., None]
    terms = terms / height[..., None] ** powers
    rows = {"curvature": c, "conic": rng.uniform(-4, 0.5, c.shape), "coefficients": terms}
    parts = {name: np.insert(a, 0, 0, axis=1) for name, a in rows.items()}
    parts["thickness"] = thickness
    parts["sensor"] = np.sum(thickness, axis=1) + rng.uniform(0.5, 1.5, count)
    glasses = "air", *(f"medium {i}" if i % 2 else "air" for i in range(surfaces + 1))
    return scenes_of(rng, parts, h, 0, media, (0, 40), glasses=glasses)


def offaxis(rng, count, stop):
    """Three mirrors that fold the beam, tilted and decentred; the stop is a dummy plane at the
    first or the second, or the second itself."""
    h = rng.uniform(5, 30, count)
    reach = h[:, None] * rng.uniform(3, 8, (count, 3))
    angle, vertices = np.zeros(count), np.zeros((count, 4, 3))
    tilt, shift = np.zeros((count, 4, 3)), rng.uniform(-0.1, 0.1, (count, 4, 2))
    for i in range(3):  # along a ray in the middle of the beam
        tilt[:, i, 0] = np.radians(rng.uniform(8, 20, count))
        angle = np.pi - angle - 2 * tilt[:, i, 0]
        along = np.stack([0 * angle, np.sin(angle), np.cos(angle)], axis=-1)
        vertices[:, i + 1] = vertices[:, i] + reach[:, i, None] * along
    tilt[:, 3, 0] = np.pi - angle
    tilt += np.radians(rng.uniform(-2, 2, tilt.shape))
    vertices[..., :2] += shift * h[:, None, None]
    power = rng.uniform(0.05, 0.3, (count, 3)) * [-1, 1, -1]
    power[:, 1] *= rng.choice([1, 1, -1], count)
    parts = {"curvature": power / reach, "conic": rng.uniform(-3, 0.5, (count, 3))}
    mirrors, row = [True] * 3, {"first": 0, "second": 1, "itself": 1}[stop]
    if stop != "itself":
        gap = h * rng.choice([0.0, 0.0, 0.1, -0.1, 0.3, -0.3], count)
        plane = tilt[:, row] * rng.choice([0.0, 0.5, 1.0], (count, 1))
        tilt = np.insert(tilt, row, plane, axis=1)
        vertices = np.insert(vertices, row, vertices[:, row], axis=1)
        vertices[:, row, 2] -= gap
        parts = {name: np.insert(a, row, 0, axis=1) for name, a in parts.items()}
        mirrors.insert(row, False)
    parts |= placed(vertices, tilt)
    static = {"glasses": ("air",) * (len(mirrors) + 1), "mirrors": tuple(mirrors)}
    return scenes_of(rng, parts, h, row, None, (0, 3), (np.inf, 1e6, 1e4), **static)


def camera(rng, count, name):
    """A bundled lens with its numbers changed by 3 %, and additional aspheric terms of some um at
    the rim of the stop."""
    lens = drt_jax.load_lens(name)
    surfaces = lens.count
    batch = jax.tree.map(lambda a: np.broadcast_to(a, (count, *a.shape)), lens)

    def vary(a, size=0.03):
        return a * (1 + size * rng.uniform(-1, 1, a.shape))

    rim = float(lens.semi_diameter[lens.stop])
    conic, terms = np.array(batch.conic), np.array(batch.coefficients)
    terms = np.pad(terms, ((0, 0), (0, 0), (0, max(0, 2 - terms.shape[-1]))))
    terms[:, :-1, 1] += rng.uniform(-5e-3, 5e-3, (count, surfaces)) / rim**4
    conic[:, :-1] += rng.uniform(-0.2, 0.2, (count, surfaces))
    parts = {"curvature": vary(batch.curvature), "thickness": vary(batch.thickness)}
    parts |= {"conic": conic, "coefficients": terms, "sensor": vary(batch.sensor, 0.003)}
    batch = jax.tree.map(jnp.asarray, dataclasses.replace(batch, **parts))
    widest = _WIDEST.get(name, 20.0) * 1.2
    far = rng.choice([300.0, 1e3, 25e3, 1e9, np.inf], count)
    return Scenes(batch, fields(rng, count, 0, widest), far, pupil_points(rng, count))


# Mirrors of a walk, and whether the stop is a plane between the first two.
_WALKS = (1, False), (2, False), (2, True)
_SPHERES = Walk(local_mirror, (0.2, 10), width=0.01)
_TOROIDS = _SPHERES._replace(form="toroid")
_SLENDER = Walk(conic_mirror, (2, 10), width=0.01, least=0.015)
_TURNED = "paraboloids that turn light by 30 to 150 degrees, from a focus to parallel and back"
_RIGHT = "off-axis paraboloids that turn light by 80 to 100 degrees, alone and in pairs"
_IMMERSED = "object, image or both in a medium of index 1.3 to 1.9"
_INSIDE = "object inside the focal length: light diverges; sensor behind or at the virtual image"
_COLLIMATED = "object at the front focus, real or virtual: light leaves collimated"
_VIRTUAL = "the sensor at a virtual image in front of the last surface"
_CONVERGING = "virtual objects: light converges to a point 1 to 20 radii of the stop behind vertex"
_FILES = "lens files of another program, refracting, off by 3 %, padded to one structure"
_CAMERAS = ("double_gauss", "cooke_triplet", "singlet")
_RIMS = ("camera_50mm", "phone", "telephoto_300mm")
_WIDEST = {"singlet": 5.0, "double_gauss": 14.0, "phone": 32.0, "telephoto_300mm": 4.0}  # degrees
_WIDE = elements(f_number=(2, 16), angles=(20, 45))
_EVERYWHERE = (10.0, 20.0, 50.0, 1e5, 1e9, 1e15, np.inf)
_FREE = "biconic, toroid, odd powers, XY polynomial"
_NEAR = "gaps of 1e-6 to 1e-2 mm, stop and sensor included"
_MIRRORS = "three tilted, decentred mirrors, the stop at one: a plane through it, or itself"
_PHONE = "3 to 5 aspheres to r^12, f/1.6 to f/2.4, to 40 degrees, stop -0.6 to 0.6 mm behind vertex"
FAMILIES = {
    "aperture": Family("f/0.7 to f/32", elements(f_number=(0.7, 32))),
    "curvature": Family("zero, nearly zero, to hemispherical", elements(curvature)),
    "conic": Family("constants of -30 to 3", elements(conic, (0.8, 8))),
    "asphere": Family("departure to a tenth of the semi-diameter", elements(asphere)),
    "index": Family("neighbours equal, or apart by 1e-12 to 1e-2", elements(index)),
    "edge": Family("misses, grazing, total reflection", elements(edge, (0.7, 2), angles=(0, 40))),
    "close": Family(_NEAR, elements(gaps(1e-6, 1e-4, 1e-2))),
    "touching": Family("gaps of 0, 1e-17 and 1e-8 mm", elements(gaps(0.0, 1e-17, 1e-8)), (2,), 0.2),
    "distance": Family("10 mm to infinity", elements(angles=(0, 20), distances=_EVERYWHERE)),
    "focus": Family("sensor at the paraxial focus; stigmatic ellipsoids", focus),
    "field": Family("20 to 45 degrees", _WIDE),
    "tilted": Family("by 10 degrees, decentred by a tenth", elements(tilted, (2, 16)), (4,)),
    "mirror": Family("two conic mirrors facing each other", mirror, (1,)),
    "folded": Family("a periscope", folded, (3,), 0.5),
    "freeform": Family(_FREE, elements(freeform, forms=_FREEFORM), (2,), 0.5),
    "camera": Family("three bundled lenses off by 3 %", camera, _CAMERAS),
    "camera, float32": Family("the same", camera, _CAMERAS, 1.0, "float32"),
    "aperture, float32": Family("as aperture", elements(f_number=(0.7, 32)), (2,), 0.5, "float32"),
    "asphere, float32": Family("as asphere", elements(asphere), (2,), 0.5, "float32"),
    "field, float32": Family("as field", _WIDE, (2,), 0.5, "float32"),
    "phone": Family(_PHONE, phone, (3, 4, 5), 0.5),
    "offaxis": Family(_MIRRORS, offaxis, ("first", "second", "itself"), 0.5),
    "rims": Family("camera, phone and tele lenses off by 3 %, their rims failing", camera, _RIMS),
    "turned": Family(_TURNED, Walk(conic_mirror, parallel=True), _WALKS),
    "foci": Family("ellipsoids and hyperboloids that do so", Walk(conic_mirror), _WALKS),
    "relay": Family("Offner and Dyson relays", relay, ("offner", "dyson"), 0.5),
    "grazing": Family("spheres met at 85 to 89.9 degrees", _SPHERES, _WALKS[:2], 0.5),
    "toroids": Family("toroids met at 85 to 89.9 degrees", _TOROIDS, _WALKS[:2], 0.5),
    "slender": Family("conics about the beam, met at 85 to 89 degrees", _SLENDER, _WALKS[:2], 0.5),
    "right angle": Family(_RIGHT, Walk(conic_mirror, (80, 100), parallel=True), _WALKS),
    "immersed": Family(_IMMERSED, elements(immersed), share=0.5),
    "inside focus": Family(_INSIDE, Conjugate(inside_focus, 0.5), share=0.5),
    "collimated": Family(_COLLIMATED, Conjugate(at_focus), share=0.5),
    "virtual image": Family(_VIRTUAL, Conjugate(far_away, 1.0), share=0.5),
    "virtual object": Family(_CONVERGING, Conjugate(behind_vertex, 0.5), share=0.5),
    "files": Family(_FILES, files, ("refracting",), 1.0, needs=FILES),
}


def draw(name: str, count: int, seed: int, variants: tuple | None = None) -> Iterator[Scenes]:
    """Scenes of a family, one batch for each variant, the same for the same seed."""
    family = FAMILIES[name]
    number = list(FAMILIES).index(name)
    variants = variants or family.variants
    each = -(-max(1, round(count * family.share)) // len(variants))
    for k, variant in enumerate(variants):
        rng = np.random.default_rng((seed, number, k))
        scenes = family.make(rng, each, variant)
        yield jax.tree.map(lambda a: np.asarray(a, family.dtype), scenes)
