"""From a field to its image point and back."""

import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene

LENS = drt_jax.load_lens("cooke_triplet")


def image(field):
    return drt_jax.image_point(LENS, Scene.point(field, 1e4, [0.55]))[0]


def field(point):
    return drt_jax.field_of_image(LENS, point, 1e4, 0.55)


@pytest.mark.slow
def test_the_field_of_an_image_point_is_the_field_it_came_from():
    angles = jnp.array([0.05, 0.25])
    point, turned = image(angles), jax.jacfwd(image)(angles)
    np.testing.assert_allclose(field(point), angles, rtol=0, atol=1e-13)
    # radians per mm: the inverse of mm per radian
    np.testing.assert_allclose(jax.jacfwd(field)(point) @ turned, np.eye(2), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_the_chief_ray_is_that_through_the_centre_of_the_stop():
    rays = drt_jax.trace_rays(LENS, Scene.point((0.05, 0.25), 1e4, [0.55]), [[0.0, 0.0]])
    np.testing.assert_allclose(image((0.05, 0.25)), rays.points[0, 0, -1, :2], rtol=0, atol=1e-12)


@pytest.mark.slow
def test_no_field_reaches_a_point_far_outside():
    assert not np.any(np.isfinite(field(jnp.array([0.0, 1e4]))))


def test_clear_errors():
    with pytest.raises(ValueError, match="expected x and y"):
        drt_jax.field_of_image(LENS, 3.0, 1e4, 0.55)
    with pytest.raises(ValueError, match="outside the range"):
        drt_jax.image_point(LENS, Scene.point(0.0, 1e4, [0.1]))


@pytest.mark.slow
def test_a_field_is_found_where_rounding_stops_newton():
    """At 21.6 mm of this zoom no step was below the tolerance, and the field was inf."""
    path = pathlib.Path(__file__).resolve().parents[2] / "configs/design/lenses/us5568323.zmx"
    lens = drt_jax.load_lens(path, configuration=2)
    for height in np.linspace(21.5, 21.7, 9):
        angles = drt_jax.field_of_image(lens, (0.0, height), np.inf, 0.5876)
        found = drt_jax.image_point(lens, Scene.point(angles, np.inf, 0.5876))[0]
        np.testing.assert_allclose(found, [0, height], rtol=0, atol=1e-9)
