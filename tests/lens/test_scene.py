"""Scenes: functions that make them, and points of any shape as the first axes of results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Gauss, Scene
from drt_jax.lens.scene import checked_scene

LENS = drt_jax.load_lens("singlet")
RGB = (0.6, 0.53, 0.48)


def test_the_makers():
    """One point has no axis, F fields have one, every field at every distance has two."""
    one = Scene.point((0.1, 0.2), 500.0, 0.55)
    assert one.shape == () and one.wavelengths.shape == (1,) and one.field.tolist() == [0.1, 0.2]
    assert Scene.point(0.1, (500.0, np.inf)).shape == (2,)
    line = Scene.degrees([0, 7, 14], wavelengths=RGB)
    assert line.shape == (3,) and np.isinf(line.distance)
    np.testing.assert_array_equal(line.field, np.radians([[0, 0], [0, 7], [0, 14]]))
    np.testing.assert_array_equal(Scene.degrees([[3, 4]]).field, np.radians([[3, 4]]))
    assert Scene.degrees(7).shape == () and Scene.radians([0.1, 0.2], [300.0, 400.0]).shape == (2,)
    grid = Scene.grid([0.0, 0.1, 0.2], (500.0, np.inf), RGB, wavelength_weights=(1, 2, 1))
    assert grid.shape == (2, 3) and len(grid.each()) == 6 and grid.spectrum.tolist() == [1, 2, 1]
    assert grid.each()[4].distance == np.inf and grid.each()[4].field.tolist() == [0, 0.1]
    near = Scene.heights([-8.0, 0.0], 400.0)  # below the axis: light that travels upwards
    np.testing.assert_allclose(near.field, [[0, np.arctan(8 / 400)], [0, 0]], rtol=1e-15)


def test_known_numbers_stay_known_inside_jit():
    """Inside `jit`, too, the rule follows from the fields if the lens is known."""
    spot = lambda: drt_jax.psf_moments(LENS, Scene.point(0.05, np.inf, 0.55), 1e-3)  # noqa: E731
    np.testing.assert_allclose(jax.jit(spot)().covariance, spot().covariance, rtol=1e-12)


@pytest.mark.slow
def test_points_of_any_shape_are_the_first_axes():
    """Each result is that of its point alone, outside of `jit` and inside."""
    grid = Scene.grid([0.0, 0.05, 0.1], (700.0, np.inf), RGB)
    pairs = Scene.radians([[0.02, 0.05], [0.0, 0.1]], (700.0, 900.0), RGB)

    def found(scene):
        points = np.array([[0.0, 0.0], [0.3, -0.5]])
        rays = drt_jax.trace_rays(LENS, scene, points)
        return rays[:4], drt_jax.chief_ray_angle(LENS, scene)

    for scene, every in ((grid, found(grid)), (pairs, jax.jit(found)(pairs))):
        alone = [found(one) for one in scene.each()]
        alone = jax.tree.map(lambda *a: jnp.stack(a).reshape(*scene.shape, *a[0].shape), *alone)
        for a, b in zip(jax.tree.leaves(every), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("how", [lambda call: call, jax.jit])
def test_points_of_moments_are_the_first_axes(how):
    """The same for spots."""
    scene = Scene.grid([0.0, 0.05, 0.1], (700.0, np.inf), RGB)
    spot = lambda scene: drt_jax.psf_moments(LENS, scene, Gauss(2, "none"))  # noqa: E731
    every, alone = how(spot)(scene), [spot(one) for one in scene.each()]
    for name in ("mean", "covariance", "throughput"):
        wanted = np.stack([getattr(one, name) for one in alone]).reshape(getattr(every, name).shape)
        np.testing.assert_allclose(getattr(every, name), wanted, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Scene.degrees([0, 95]), "fields: 1.65.* = 95 degrees, must be below 90"),
        (lambda: Scene.radians(np.zeros((2, 3))), r"fields: expected \(F,\) or \(F, 2\)"),
        (lambda: Scene.radians([0.0, 0.1], [1.0, 2.0, 3.0]), "distance: expected one, or one for"),
        (lambda: Scene.grid([0.0], (0.0, 1.0)), "distance: must be 1e-06 mm or more"),
        (lambda: Scene.heights([1.0], np.inf), "at infinity an object has a field, but no height"),
        (lambda: Scene.degrees(7, wavelengths="green"), "wavelengths: expected real numbers"),
        (lambda: Scene.degrees(7, wavelengths=5.0), "wavelength 5 um is outside the range"),
        (lambda: Scene.degrees(7, wavelength_weights=(1, 2)), r"wavelength_weights: expected \(1,"),
        (lambda: Scene(jnp.zeros(3), 1.0, jnp.ones(1)), r"field: expected \(..., 2\)"),
        (lambda: (0.1, np.inf, 0.55), "scene: expected a Scene, such as Scene.degrees"),
    ],
)
def test_what_is_no_scene_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        checked_scene(LENS, make())


def test_analyses_that_compare_with_the_axis_want_one_distance():
    several = Scene.radians([0.0, 0.1], (700.0, 900.0), 0.55)
    for call in (drt_jax.distortion, drt_jax.relative_illumination, drt_jax.axial_colour):
        with pytest.raises(ValueError, match="distance: expected one"):
            call(LENS, several)
    with pytest.raises(ValueError, match="converge: expected one of psf_moments, focus_moments"):
        drt_jax.converge(drt_jax.distortion, LENS, several)
