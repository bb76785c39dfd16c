"""A scaled and a reversed lens."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene
from drt_jax.lens.edit import _terms
from drt_jax.lens.forms import FORMS, Shape
from drt_jax.lens.scene import field_of_height
from drt_jax.lens.surface import surface_sag

WAVE = 0.5875618
# Coefficients of each form: those with a name, then a few terms.
SOME = {name: [0.3, -0.2, 0.1, 0.05, -0.02, 0.01] for name in FORMS}
SOME |= {"biconic": [0.04, -0.5, 2e-3], "toroid": [0.04, 2e-3], "linear": [0.2]}
SOME |= {name: [4.0, 0.03, -0.02, 0.01, 0.02] for name in ("zernike", "qbfs")}


@pytest.mark.parametrize("form", FORMS)
def test_a_sag_grows_with_the_lens_and_turns_with_it(form):
    coefficients = np.array(SOME[form])
    powers, signs = _terms(form, len(coefficients))
    x, y, factor = jnp.array([0.3, -0.5, 0.7]), jnp.array([0.6, 0.2, -0.4]), 1.7

    def height(curvature, values, size=1.0):
        shape = Shape(jnp.asarray(curvature), jnp.asarray(-0.4), jnp.asarray(values))
        return np.asarray(surface_sag((size * x, size * y), shape, form))

    own = height(0.06, coefficients)
    larger = height(0.06 / factor, coefficients * factor**powers, factor)
    np.testing.assert_allclose(larger, factor * own, rtol=1e-12)
    np.testing.assert_allclose(height(-0.06, coefficients * signs), -own, rtol=1e-12)


DOUBLET = {
    "surfaces": [
        {"radius": 60.0, "thickness": 6.0, "glass": "N-BK7", "semi_diameter": 12.0,
         "conic": -0.3, "coefficients": {4: 1e-6}, "tilt": [0.4, 0.2, 0.0]},
        {"radius": -45.0, "thickness": 2.5, "glass": "N-SF5", "semi_diameter": 12.0},
        {"radius": -130.0, "thickness": 4.0, "semi_diameter": 12.0, "decentre": [0.1, -0.2],
         "phase": {"coefficients": {2: -0.2}},
         "aperture": {"rectangle": [9, 8], "centre": [0.2, 0.1]}},
        {"radius": float("inf"), "thickness": 90.0, "semi_diameter": 6.0, "stop": True},
    ]
}  # fmt: skip
LENS = drt_jax.load_lens(DOUBLET)


@pytest.mark.slow
def test_light_takes_the_same_path_backwards():
    """From the point where each ray met the sensor, through its point on the stop."""
    other, last = drt_jax.flipped(LENS), LENS.vertices[-2]
    points = np.array([[0.3, 0.8], [-0.7, 0.2], [0.0, 0.0]])
    rays = drt_jax.trace_rays(LENS, Scene.point((0.02, 0.05), np.inf, WAVE), points)
    assert not np.any(rays.status)
    # z from the present first vertex.
    hits = (np.asarray(rays.points)[0] - [0, 0, last]) * [1, 1, -1]
    distance = LENS.sensor - last
    for point, path in zip(points, hits):
        field = field_of_height(path[-1, :2], distance)
        found = drt_jax.trace_rays(other, Scene.point(field, distance, WAVE), point[None])
        assert not np.any(found.status)
        own = np.asarray(found.points)[0, 0, : LENS.count]
        np.testing.assert_allclose(own, path[-2::-1], atol=1e-10)


@pytest.mark.slow
def test_twice_flipped_is_the_lens():
    again = drt_jax.flipped(drt_jax.flipped(LENS))
    assert jax.tree.structure(again) == jax.tree.structure(LENS)
    for one, two in zip(jax.tree.leaves(again), jax.tree.leaves(LENS)):
        np.testing.assert_array_equal(one, two)
    assert again.glasses == LENS.glasses and again.stop == LENS.stop
    plain = drt_jax.load_lens("double_gauss")
    front = -drt_jax.first_order(plain, jnp.inf, WAVE).front_focal_distance
    np.testing.assert_allclose(
        drt_jax.first_order(drt_jax.flipped(plain), jnp.inf, WAVE).back_focal_distance,
        front,
        rtol=1e-12,
    )


@pytest.mark.slow
def test_rays_of_a_larger_lens_keep_their_angles():
    """All hits and the focal length are multiplied by the factor; also the derivative of the focal
    length by the factor."""
    points, factor = np.array([[0.3, 0.8], [-0.7, 0.2]]), 2.5
    scene = (0.02, 0.05), 700.0
    one = drt_jax.trace_rays(LENS, Scene.point(*scene, WAVE), points)
    two = drt_jax.trace_rays(
        drt_jax.scaled(LENS, factor), Scene.point(scene[0], factor * scene[1], WAVE), points
    )
    assert not np.any(one.status) and not np.any(two.status)
    np.testing.assert_allclose(two.points, factor * one.points, atol=1e-10)
    np.testing.assert_allclose(two.directions, one.directions, atol=1e-12)
    length = lambda f: drt_jax.focal_length(drt_jax.scaled(LENS, f), WAVE)[0]  # noqa: E731
    np.testing.assert_allclose(jax.grad(length)(factor), length(1.0), rtol=1e-12)


def test_inside_jit_and_with_forms_of_other_numbers_of_terms():
    """An odd asphere with one term, an asphere and Zernike polynomials; the sensor stays tilted."""
    surfaces = [
        {"form": "linear", "radius": 60.0, "coefficients": {"y": 0.02}, "glass": "N-BK7"},
        {"radius": -45.0, "coefficients": {4: 1e-6, 6: 1e-9, 8: 1e-12}},
        {"form": "zernike", "radius": 80.0, "norm_radius": 9.0, "coefficients": {4: 1e-3}},
    ]
    surfaces = [surface | {"thickness": 5.0, "semi_diameter": 6.0} for surface in surfaces]
    surfaces[1]["stop"] = True
    del surfaces[2]["thickness"]
    given = {"surfaces": surfaces, "sensor": 80.0, "sensor_tilt": [1.0, 2.0, 0.0]}
    lens = drt_jax.load_lens(given)
    for edit in (drt_jax.flipped, lambda lens: drt_jax.scaled(lens, 1.7)):
        plain, inside = edit(lens), jax.jit(edit)(lens)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-14), plain, inside)
    np.testing.assert_array_equal(drt_jax.flipped(lens).tilt[-1], lens.tilt[-1])
    larger = jax.jit(drt_jax.scaled)(lens, 1.7)
    x, y = jnp.array([0.3, 2.0]), jnp.array([-1.0, 1.5])
    for surface in range(3):
        own, other = drt_jax.lens.lens.sag(lens, surface, x, y), 2 - surface
        found = drt_jax.lens.lens.sag(larger, surface, 1.7 * x, 1.7 * y)
        np.testing.assert_allclose(found, 1.7 * own, rtol=1e-12)
        turned = drt_jax.lens.lens.sag(drt_jax.flipped(lens), other, x, y)
        np.testing.assert_allclose(turned, -own, rtol=1e-12)


def test_what_cannot_be_done_is_refused_in_a_line():
    for factor in (0.0, -1.0, np.nan, [1.0, 2.0]):
        with pytest.raises(ValueError, match=r"^factor: expected one number above 0"):
            drt_jax.scaled(LENS, factor)
    with pytest.raises(ValueError, match="^lens: with mirrors"):
        drt_jax.flipped(drt_jax.load_lens("hubble"))
