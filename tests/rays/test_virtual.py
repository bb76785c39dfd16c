"""Virtual images and objects, rays prolonged backwards, against the aplanatic points of a sphere.

A sphere of radius R between n and n' images the point at R (n + n') / n from its vertex to that at
R (n + n') / n' without any aberration, and n / n' is the ratio of the sines (Welford 1986, ch. 5).
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, Status, load_lens, trace_rays

from .traced import behind_stop, on_y

R, N = 10.0, 1.5
GAP = 5.0
VIRTUAL = "prolonged backwards to a virtual image"


def seen_from_air(sensor):
    """A point in glass, seen through a concave sphere, whose image lies behind the point."""
    rows = [{"radius": -R, "index": 1.0, "thickness": sensor}]
    return behind_stop(rows, GAP, 1.0, object={"index": N})


@pytest.fixture(scope="module")
def virtual():
    with pytest.warns(UserWarning, match=VIRTUAL):
        return seen_from_air(-R * (1 + N))


HEIGHTS = np.array([-4.0, 0.0, 1.0, 5.0])
DISTANCE = R * (1 + 1 / N) - GAP


@pytest.mark.slow
def test_an_aplanatic_virtual_image(virtual):
    """All rays seem to come from one point, run forwards and have equal paths."""
    rays = trace_rays(virtual, Scene.point(0.0, DISTANCE, [0.55]), on_y(*HEIGHTS))
    np.testing.assert_array_equal(rays.status, Status.OK)
    np.testing.assert_allclose(rays.points[0, :, -1, :2], 0, atol=1e-12)
    np.testing.assert_allclose(np.ptp(np.asarray(rays.path)), 0, atol=1e-12)
    slope = np.sin(np.arctan(HEIGHTS / DISTANCE)) / N
    np.testing.assert_allclose(rays.directions[0, :, -1, 1], slope, atol=1e-12)
    behind = trace_rays(seen_from_air(20.0), Scene.point(0.0, DISTANCE, [0.55]), on_y(*HEIGHTS))
    np.testing.assert_allclose(rays.directions[0, :, -1], behind.directions[0, :, -1], atol=1e-14)
    further = np.linalg.norm(behind.points[0, :, -1] - rays.points[0, :, -1], axis=-1)
    np.testing.assert_allclose(behind.path[0] - rays.path[0], further, atol=1e-12)


@pytest.mark.slow
def test_an_aplanatic_virtual_object():
    """Light in air that converges to a point 25 mm behind a glass sphere meets inside the
    sphere."""
    rows = [{"radius": R, "index": N, "thickness": R * (1 + 1 / N)}]
    lens = behind_stop(rows, GAP, 1.0)
    distance = -(R * (1 + N) + GAP)
    rays = trace_rays(lens, Scene.point(0.0, distance, [0.55]), on_y(*HEIGHTS))
    np.testing.assert_array_equal(rays.status, Status.OK)
    np.testing.assert_allclose(rays.points[0, :, -1, :2], 0, atol=1e-12)
    np.testing.assert_allclose(np.ptp(np.asarray(rays.path)), 0, atol=1e-12)
    found = drt_jax.first_order(lens, distance, [0.55]).image_distance
    np.testing.assert_allclose(found, GAP + R * (1 + 1 / N), rtol=1e-12)
    magnified = drt_jax.first_order(lens, distance, [0.55]).magnification
    np.testing.assert_allclose(magnified, 1 / N**2, rtol=1e-12)


@pytest.mark.slow
def test_derivatives_of_virtual_images(virtual):
    """Forward and reverse, by the curvature and the position of the sensor, compared with
    differences."""

    def spot(curvature, sensor):
        lens = dataclasses.replace(
            virtual, curvature=virtual.curvature.at[1].set(curvature), sensor=sensor
        )
        found = drt_jax.psf_moments(
            lens, Scene.point(0.01, DISTANCE, [0.55]), sampling=drt_jax.Gauss(4, "bilateral")
        )
        return jnp.stack([found.mean[0, 1], found.covariance[0, 1, 1]])

    at, step = (jnp.array(-0.09), virtual.sensor), 1e-6
    spot = jax.jit(spot)
    wanted = [
        (spot(at[0] + step, at[1]) - spot(at[0] - step, at[1])) / (2 * step),
        (spot(at[0], at[1] + step) - spot(at[0], at[1] - step)) / (2 * step),
    ]
    for mode in (jax.jacfwd, jax.jacrev):
        found = jnp.stack(jax.jit(mode(spot, (0, 1)))(*at))
        np.testing.assert_allclose(found, jnp.stack(wanted), rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_a_negative_lens_focuses_where_paraxial_optics_says():
    rows = [
        {"radius": "inf", "thickness": 2.0, "index": 1.5, "stop": True, "semi_diameter": 0.01},
        {"radius": 25.0},
    ]
    with pytest.warns(UserWarning, match=VIRTUAL):
        lens = load_lens({"surfaces": rows, "sensor": "focus"})
    np.testing.assert_allclose(lens.sensor, 2.0 - 50.0, rtol=1e-12)
    rays = trace_rays(lens, Scene.point(0.0, np.inf, [0.55]), on_y(-1.0, 0.5, 1.0))
    np.testing.assert_array_equal(rays.status, Status.OK)
    np.testing.assert_allclose(rays.points[0, :, -1, :2], 0, atol=1e-8)


def test_no_object_at_the_first_vertex(virtual):
    with pytest.raises(ValueError, match=r"distance: must be 1e-06 mm or more.*got 1e-07"):
        trace_rays(virtual, Scene.point(0.0, 1e-7, [0.55]), on_y(0.0))


@pytest.mark.slow
def test_minus_infinity_is_infinity():
    """Light of an object at infinity is parallel, for either sign of the distance."""

    @jax.jit
    def found(lens, distance):
        rays = drt_jax.trace_rays(
            lens, Scene.point(0.05, distance, [0.55]), [[0.0, 0.0], [0.3, 0.7]]
        )
        first = drt_jax.first_order(lens, distance, [0.55])
        return rays.points, rays.path, rays.status, first

    lens = load_lens("singlet")
    one, two = (jax.tree.leaves(found(lens, far)) for far in (np.inf, -np.inf))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
