"""The stop is a label: lenses whose stop lies at, behind or inside of active surfaces.

The reference is the sequential trace of `oracle`, which has its own aiming at the label.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Status, load_lens

from .. import oracle
from . import mirrors, phones
from .traced import (
    ROWS,
    WAVELENGTHS,
    Truth,
    assert_same_rays,
    assert_same_slopes,
    hexapolar,
    of_row,
    oracle_slopes,
    rays_and_derivatives,
    truth,
)

WHOLE = hexapolar(10)  # 331 rays
CHOSEN = (0, 60, 300)
FEW = hexapolar(4)  # 61 rays
PICKED = (0, 2, 30, 50)
# Relative to the largest derivative of an output by an array of parameters.
SLOPES = 1e-9


def scene_of(lens, field):
    return oracle.Scene.of(lens, field, np.inf, WAVELENGTHS)


def ours(lens, field, pupil=WHOLE, chosen=CHOSEN):
    return rays_and_derivatives(lens, jnp.asarray(field), jnp.inf, pupil, chosen)


def scenes(name, **where):
    """A lens of `phones` and its fields along y, in radians."""
    lens = phones.load(name, **where)
    return [(lens, np.array([0, np.radians(field)])) for field in phones.FIELDS]


def misaligned(lens, seed=0):
    """The lens with all surfaces, among them the stop, and the sensor moved at random by some 5 um
    and 2 mrad."""
    generator = np.random.default_rng(seed)
    moves = {"decentre": 5e-3, "tilt": 2e-3}
    moves = {k: s * generator.normal(size=getattr(lens, k).shape) for k, s in moves.items()}
    return dataclasses.replace(lens, **{k: jnp.asarray(v) for k, v in moves.items()})


@pytest.mark.slow
def test_every_ray_of_the_phone_lenses():
    """12 lenses, 5 fields, 331 rays over the whole stop: the rays that the oracle finds are found
    and no others, points and paths within 1e-11 mm, 2.5e-12 of the focal length."""
    every = [(name, *scene) for name in phones.LENSES for scene in scenes(name)]
    wanted = truth(oracle.Scene.stack([scene_of(*scene) for _, *scene in every]), WHOLE)
    assert np.mean(wanted.exists) > 0.99
    for (name, lens, field), *each in zip(every, *wanted):
        assert_same_rays(ours(lens, field)[0], Truth(*each), 1e-11, f"{name}, {field[1]} rad")


@pytest.mark.slow
@pytest.mark.parametrize("name", phones.LENSES)
def test_derivatives_of_the_phone_lenses(name):
    """Sensor points and paths of rays at 30 degrees by every parameter, among them position, size,
    tilt and decentre of the stop, compared with the complex step."""
    lens, field = misaligned(phones.load(name)), np.radians([4.0, 30.0])
    rays, slopes = ours(lens, field)
    assert np.all(rays.status[0, np.array(CHOSEN)] == Status.OK)
    wanted = oracle_slopes(scene_of(lens, field), WHOLE[np.array(CHOSEN)], (*ROWS, "field"))
    assert_same_slopes(slopes, wanted, SLOPES, name)
    for row, column in (("thickness", 0), ("semi_diameter", 0), ("tilt", 0), ("decentre", 0)):
        assert np.any(wanted[row][:, column] != 0)  # they are not compared as zeros


def slid(name, place, positions):
    """A lens with its stop at `positions` (P,) mm behind the vertex after it; all other surfaces
    stay."""
    lenses = [phones.load(name, position=p, place=place) for p in positions]
    return lenses, [scene_of(lens, np.radians([0.0, 20.0])) for lens in lenses]


def along_the_slide(slopes, lens):
    """Derivative of the outputs by the position of the stop while all other surfaces stay. A stop
    that is listed first is the origin from which the position of the sensor and the path are
    measured."""
    thickness, sensor = of_row(slopes, "thickness"), of_row(slopes, "sensor")
    if lens.stop == 0:
        return -thickness[:, 0] - sensor
    return thickness[:, lens.stop - 1] - thickness[:, lens.stop]


@pytest.mark.parametrize(
    "name, place, part",
    [
        ("3 elements, f/2.0, stop at +0.1 mm", 0, 1.0),
        ("5 elements, f/1.6, stop at +0.3 mm", 0, 0.9),
        pytest.param("3 elements, f/2.4, stop at -0.6 mm", 2, 1.0, marks=pytest.mark.slow),
        pytest.param("5 elements, f/1.8, stop at -0.2 mm", 2, 1.0, marks=pytest.mark.slow),
    ],
)
def test_the_stop_slides_through_a_surface(name, place, part):
    """From 0.6 mm in front of to 0.6 mm behind the vertex of the first surface, or of the second
    element: no ray is lost, and the hits and their derivatives are smooth."""
    positions = np.linspace(-0.6, 0.6, 25)
    pupil, picked = part * WHOLE, np.array(CHOSEN)
    lenses, every = slid(name, place, positions)
    wanted = truth(oracle.Scene.stack(every), pupil)
    assert np.all(wanted.exists)
    heights, slopes = [], []
    for lens, scene, *each in zip(lenses, every, *wanted):
        rays, slope = ours(lens, scene.values["field"], pupil)
        assert_same_rays(rays, Truth(*each), 1e-11, f"{name}, {lens.thickness}")
        heights.append(np.asarray(rays.points[0, picked, -1, :2]).ravel())
        by_place = along_the_slide(slope, lens).reshape(len(CHOSEN), 3)
        slopes.append(by_place[:, :2].ravel())
    heights, slopes, step = np.array(heights), np.array(slopes), positions[1] - positions[0]
    # The change over a step is h times the mean derivative at its ends, up to h^3 / 12 f'''.
    jump = heights[1:] - heights[:-1] - step / 2 * (slopes[1:] + slopes[:-1])
    assert np.max(np.abs(jump)) <= 0.1 * step**3
    for array in (heights, slopes):
        assert np.max(np.abs(np.diff(array, 2, axis=0))) <= 2 * step**2


def mirror_cases():
    """Systems with a stop listed between the first and the second mirror; the others are slow."""
    for (system, stop), (place, *_) in mirrors.STOPS.items():
        yield pytest.param(system, stop, marks=[] if place == 1 else pytest.mark.slow)


@pytest.mark.slow
@pytest.mark.parametrize("system, stop", [*mirror_cases()])
def test_three_mirrors(system, stop):
    """Rays and derivatives of off-axis systems, a degree off the axis of the light."""
    lens = mirrors.load(system, mirrors.STOPS[system, stop])
    for field in (np.zeros(2), np.array([0.004, -0.003])):
        scene = scene_of(lens, field)
        rays, slopes = ours(lens, field, FEW, PICKED)
        wanted = truth(scene, FEW)
        assert np.all(wanted.exists)
        # 200 mm long: 5e-13 of it.
        assert_same_rays(rays, wanted, 1e-10, f"{system}, {stop}")
        if system != "zigzag" and not np.any(field):  # confocal conics
            spread = np.ptp(rays.points[0, :, -1], axis=0)
            assert np.max(spread) < 1e-11
            assert np.ptp(rays.path) < 1e-10
        by_complex_step = oracle_slopes(scene, FEW[np.array(PICKED)], (*ROWS, "field"))
        assert_same_slopes(slopes, by_complex_step, SLOPES, f"{system}, {stop}")


SINGLET = [
    {"radius": 30, "thickness": 5, "glass": "N-BK7"},
    {"radius": -80, "coefficients": {4: 1e-5}},
]
BEHIND = {
    "between lens and sensor": (20.0, 0.0),
    "cutting into the lens": (-1.0, 5.0),
    "in front of the lens": (-8.0, -4.0),
    "far beyond the sensor": (150.0, 3.0),
}


@pytest.mark.slow
@pytest.mark.parametrize("where", BEHIND)
def test_stop_listed_behind_everything(where):
    """The label is on the line from the last surface to the sensor, extended both ways; here a
    curved and tilted one. Object at 150 mm."""
    gap, tilt = BEHIND[where]
    stop = {"radius": -40, "conic": 0.3, "semi_diameter": 2.0, "stop": True, "tilt": [tilt, 2, 0]}
    surfaces = [SINGLET[0], SINGLET[1] | {"thickness": gap}, stop]
    lens = load_lens({"surfaces": surfaces, "sensor": 50.0})
    field = np.array([0.02, 0.05])
    scene = oracle.Scene.of(lens, field, 150.0, WAVELENGTHS)
    rays, slopes = rays_and_derivatives(lens, jnp.asarray(field), 150.0, FEW, PICKED)
    wanted = truth(scene, FEW)
    assert np.all(wanted.exists)
    assert_same_rays(rays, wanted, 1e-11, where)
    by_complex_step = oracle_slopes(scene, FEW[np.array(PICKED)], (*ROWS, "field"))
    assert_same_slopes(slopes, by_complex_step, SLOPES, where)
