"""A straight ray crosses surfaces that bend no light, and every crossing is checked."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Gauss, Scene, Status, load_lens, psf_moments, trace_rays

from .. import oracle
from .traced import WAVELENGTHS, assert_same_rays, hexapolar, truth

POINTS = hexapolar(3)
STOP = {"radius": "inf", "thickness": 3, "semi_diameter": 4, "stop": True}
PLATE = [
    {"radius": -500, "thickness": 4, "glass": "N-BK7"},
    {"radius": -300, "thickness": 20},
]


def before_the_stop(radius, semi_diameter):
    """A plate behind a stop, and a dummy sphere 12 mm in front of the stop."""
    dummy = {"radius": radius, "thickness": 12, "semi_diameter": semi_diameter}
    return load_lens({"surfaces": [dummy, STOP, *PLATE]})


def crossing(radius, points, directions):
    """Where lines (Q, 3), (Q, 3) cross the half of the sphere about (0, 0, `radius`) that contains
    the origin, from the side on which its vertex plane lies in front; and whether they do."""
    offset = points - [0, 0, radius]
    along = np.sum(offset * directions, axis=1)
    square = along**2 - np.sum(offset**2, axis=1) + radius**2
    root = np.sqrt(np.maximum(square, 0))
    s = -along - np.sign(radius) * np.sign(directions[:, 2]) * root
    hit = points + s[:, None] * directions
    # The package ends a sphere where its normal is tilted by acos(0.01).
    return hit, (square > 0) & (1 - hit[:, 2] / radius > 0.01)


@pytest.mark.slow
@pytest.mark.parametrize("field", [0.0, 0.3, 0.6, 0.8])
@pytest.mark.parametrize("radius, semi_diameter", [(10.0, 9.9), (10.0, 8.5), (-10.0, 9.9)])
def test_steep_dummy_before_the_stop(radius, semi_diameter, field):
    """The reference is the intersection of a line with a sphere: OK inside the aperture, CLIPPED
    outside, MISSED if the line misses the sphere; points on the ray to 1e-10 mm."""
    lens = before_the_stop(radius, semi_diameter)
    rays = trace_rays(lens, Scene.point(field, np.inf, WAVELENGTHS), POINTS)
    stop = np.concatenate([4 * POINTS, np.full((len(POINTS), 1), 12.0)], axis=1)
    hit, meets = crossing(radius, stop, np.tile([0, np.sin(field), np.cos(field)], (len(stop), 1)))
    inside = np.hypot(*hit[:, :2].T) <= semi_diameter
    wanted = np.where(meets, np.where(inside, Status.OK, Status.CLIPPED), Status.MISSED)
    np.testing.assert_array_equal(rays.status[0], wanted)
    points = np.asarray(rays.points[0])
    np.testing.assert_allclose(points[meets, 0], hit[meets], rtol=0, atol=1e-10)
    np.testing.assert_allclose(points[meets, 1], stop[meets], rtol=0, atol=1e-11)
    assert np.all(points[~meets] == 0)


@pytest.mark.slow
def test_the_rays_behind_do_not_know_of_a_dummy():
    """Points, path and directions agree with those without the dummy to 1e-12."""
    with_it = trace_rays(before_the_stop(10.0, 9.9), Scene.point(0.6, np.inf, WAVELENGTHS), POINTS)
    lens = load_lens({"surfaces": [STOP, *PLATE]})
    without = trace_rays(lens, Scene.point(0.6, np.inf, WAVELENGTHS), POINTS)
    points = np.asarray(without.points) + np.array([0, 0, 12.0])
    np.testing.assert_allclose(with_it.points[:, :, 1:], points, rtol=0, atol=1e-12)
    np.testing.assert_allclose(with_it.directions[:, :, 1:], without.directions, atol=1e-12)
    # The path is measured from the plane wave through the first vertex.
    path = with_it.path - 12 * np.cos(0.6)
    np.testing.assert_allclose(path, without.path, rtol=0, atol=1e-12)


# Behind, between and in front of active surfaces; aspheric, tilted, decentred; crossed by others.
SCATTERED = [
    {"radius": 9, "conic": -0.4, "thickness": 1, "semi_diameter": 7, "decentre": [0.4, -0.3]},
    {"radius": 40, "thickness": 1, "glass": "N-BK7"},
    {"radius": -8, "coefficients": {4: 1e-3}, "thickness": 3, "glass": "N-BK7", "tilt": [4, 9, 1]},
    {"radius": -60, "thickness": 2},
    {"radius": 12, "thickness": -1.5, "tilt": [-9, 3, 2], "semi_diameter": 4, "stop": True},
    {"radius": -7, "conic": 0.3, "thickness": 2.5, "semi_diameter": 5},
    {"radius": -30, "coefficients": {4: 1e-5}, "thickness": 3, "glass": "SF10"},
    {"radius": 80, "thickness": 3},
    {"radius": -6, "thickness": 20, "decentre": [0.0, 1.0]},
]


@pytest.mark.slow
@pytest.mark.parametrize("field", [[0.0, 0.0], [0.1, 0.3], [-0.2, -0.45]])
def test_scattered_dummies_and_a_curved_stop(field):
    """Every crossing agrees with the oracle to 1e-10 mm; a ray that misses one is MISSED."""
    lens = load_lens({"surfaces": SCATTERED})
    scene = oracle.Scene.of(lens, field, 200.0, WAVELENGTHS)
    rays = trace_rays(lens, Scene.point(field, 200.0, WAVELENGTHS), POINTS)
    wanted = truth(scene, POINTS)
    edge = np.append(lens.semi_diameter[:-1], np.inf)
    edge[lens.stop] = np.inf
    clipped = wanted.exists & np.any(wanted.heights > edge, axis=-1)
    np.testing.assert_array_equal(rays.status == Status.CLIPPED, clipped)
    missed = ~wanted.exists
    assert np.all(np.isin(rays.status[missed], (Status.MISSED, Status.TIR)))
    assert_same_rays(rays, wanted._replace(exists=wanted.exists & ~clipped), 1e-10)


SHAPE = ("curvature", "conic", "coefficients")


@jax.jit
@jax.grad
def by_the_lens(lens):
    return jnp.sum(
        psf_moments(lens, Scene.point(0.1, 200.0, 0.55), sampling=Gauss(3, "bilateral")).covariance
    )


@pytest.mark.slow
def test_sensor_and_plane_stop_do_not_bend():
    """They have no derivatives by curvature, conic and coefficients, unless they are named."""
    lens = load_lens({"surfaces": [STOP, PLATE[0], PLATE[1] | {"coefficients": {4: 1e-6}}]})
    gradient = by_the_lens(lens)
    assert not any(np.any(getattr(gradient, name)[np.array([0, 3])]) for name in SHAPE)
    assert all(np.all(getattr(gradient, name)[1:3] != 0) for name in SHAPE)
    asked = by_the_lens(dataclasses.replace(lens, curved=(0, 3)))
    assert np.all(asked.curvature != 0)
    for name in ("thickness", "sensor", "semi_diameter"):
        np.testing.assert_allclose(getattr(asked, name), getattr(gradient, name), rtol=1e-13)


@pytest.mark.slow
def test_what_a_file_bends_may_be_bent():
    """A curved stop that bends no light has these derivatives."""
    lens = load_lens({"surfaces": [STOP | {"radius": 40.0}, *PLATE]})
    assert lens.curved == (0,)
    gradient = by_the_lens(lens)
    assert gradient.curvature[0] != 0 and gradient.curvature[-1] == 0


def test_rows_that_may_be_bent_exist():
    with pytest.raises(ValueError, match=r"lens.curved: expected rows 0 to 4, got \(5,\)"):
        dataclasses.replace(before_the_stop(10.0, 9.9), curved=(5,)).check()
