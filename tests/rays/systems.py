"""Small systems of every kind, and trial paths through them."""

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax import Scene, load_lens
from drt_jax.lens.scene import checked_scene
from drt_jax.lens.surface import sag_derivatives
from drt_jax.rays.system import system_of

COLOURS = (0.6, 0.48)
DISTANCE = 300.0
LIVE = [
    {"radius": 45, "conic": -0.4, "coefficients": {4: 1e-6}, "thickness": 4, "glass": "N-BK7"},
    {"radius": -90, "conic": 0.5, "coefficients": {4: -2e-6}, "thickness": 8},
    {"radius": -40, "coefficients": {4: 1e-6}, "thickness": 3, "glass": "SF10"},
    {"radius": -150, "conic": 1.0, "coefficients": {4: 1e-7}, "thickness": 5},
]
MIRROR = {"radius": -400, "conic": -1, "coefficients": {4: 1e-8}, "mirror": True, "thickness": -5}
STOP = {"radius": -70, "conic": 0.3, "semi_diameter": 4.0, "stop": True}
# Position of the stop: in the list of the surfaces, bending no light, or one that does.
PLACES = {"in front": 0, "between": 2, "behind": None, "active": 2}


def lens_with(stop, tilted=False):
    """Two lenses and a curved stop; `tilted` adds a mirror, tilts and decentres everything."""
    rows = [dict(row) for row in (*LIVE, *([MIRROR] if tilted else []))]
    place = len(rows) if PLACES[stop] is None else PLACES[stop]
    if stop == "active":
        rows[place] |= {"semi_diameter": 4.0, "stop": True}
    else:
        rows.insert(place, STOP | {"thickness": 3.0})
    rows[-1]["thickness"] = -20.0 if tilted else 25.0  # to the sensor
    if not tilted:
        return load_lens({"surfaces": rows})
    generator = np.random.default_rng(0)
    for row in rows:
        row["tilt"] = generator.uniform(-2, 2, 3).tolist()
        row["decentre"] = generator.uniform(-0.2, 0.2, 2).tolist()
    moved = {"sensor_tilt": [3.0, -2.0, 5.0], "sensor_decentre": [0.2, -0.4]}
    return load_lens({"surfaces": rows} | moved)


def freeform():
    """Surfaces of three forms, all tilted and decentred; the stop is one of them."""
    rows = [
        {"form": "toroid", "radius": 75, "radius_x": 85, "coefficients": {4: 2e-6}, "index": 1.5},
        {"form": "polynomial_xy", "radius": -70, "coefficients": {"x1y1": 1e-4, "x0y3": 1e-5}},
        {"radius": -110, "conic": 0.1, "coefficients": {4: -1e-6}, "index": 1.7},
        {"form": "toroid", "radius": -90, "radius_x": -120},
    ]
    rows[1] |= {"semi_diameter": 4.0, "stop": True}
    generator = np.random.default_rng(1)
    for row in rows:
        row |= {"thickness": 5.0, "tilt": generator.uniform(-2, 2, 3).tolist()}
        row["decentre"] = generator.uniform(-0.2, 0.2, 2).tolist()
    return load_lens({"surfaces": rows})


_system_of = jax.jit(system_of, static_argnums=2)


def system_with(stop, dim=2, tilted=False, distance=DISTANCE):
    """The system of such a lens; the object is off the axis, also for D = 1."""
    return scene_system(lens_with(stop, tilted), distance, dim)


def scene_system(lens, distance=DISTANCE, dim=2):
    """The system of a lens and an object off the axis."""
    return _system_of(lens, checked_scene(lens, Scene.point([0.03, -0.05], distance, COLOURS)), dim)


def meridional(lens, colours):
    """The system of a lens for meridional rays, with an axial object at infinity."""
    return _system_of(lens, checked_scene(lens, Scene.point(0.0, jnp.inf, colours)), 1)


def rough_path(system, rays=3, seed=3):
    """Hits, D arrays (R, W, Q) in mm, of paths that are not rays."""
    generator = np.random.default_rng(seed)
    shape = (len(system.forms), system.index.shape[1], rays)
    taper = np.linspace(1.2, 0.3, shape[0])[:, None, None]
    hits = generator.uniform(-3, 3, (system.dim, 1, 1, rays)) * taper
    return tuple(jnp.asarray(hits + generator.normal(0, 0.05, (system.dim, *shape))))


def wide(vector):
    """(..., 2) from one or two components; a single one is y."""
    x = [np.zeros_like(vector[0])] if len(vector) == 1 else []
    return np.stack([*x, *map(np.asarray, vector)], axis=-1)


def on_surface(surface, form, w):
    """Points (..., 3), along the axes of the lens, of a `Placed` surface at `w` (..., 2)."""
    z = np.asarray(sag_derivatives((w[..., 0], w[..., 1]), surface.shape, form)[0])
    own = np.concatenate([w, z[..., None]], axis=-1)
    turned = own if surface.rotation is None else own @ np.asarray(surface.rotation).T
    offset = np.zeros(2) if surface.offset is None else np.asarray(surface.offset)
    return turned + np.append(offset, surface.vertex)


def corners(system, hits):
    """The hits (R, W, Q, 3) along the axes of the lens, and the object point (3,), with NumPy; for
    an object at infinity its direction."""
    rows = [jax.tree.map(lambda a, i=i: a[i], system.rows) for i in range(len(system.forms))]
    w = wide(hits)
    points = [on_surface(row, system.forms[i], w[i]) for i, row in enumerate(rows)]
    source = np.append(np.zeros(2 - system.dim), system.source)
    return np.stack(points), source / (float(system.vergence) or 1.0)
