"""A picture through a lens: even light, points, borders of tiles, derivatives, bad input."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax.image import blur, interpolate, render as rendering, sensor_maps

PIXEL, SIDE = 0.15, 48
WAVES = (0.6, 0.48)


@functools.cache
def lens_of(name="cooke_triplet"):
    return drt_jax.load_lens(name)


@functools.cache
def method_of(name="cooke_triplet", distance=np.inf, **others):
    return drt_jax.render_method(
        lens_of(name), (SIDE, SIDE), distance, PIXEL, WAVES, 13, 4, 20, model="gaussian", **others
    )


def picture(seed=0):
    return np.random.default_rng(seed).random((SIDE, SIDE, 2))


@functools.cache
def grid():
    return drt_jax.kernel_grid(lens_of(), method_of().grid, WAVES)


def test_a_row_of_tiles_blends_the_kernels_of_its_corners():
    random = np.random.default_rng(1)
    light, kernels = random.random((14, 22, 2)), random.random((2, 3, 2, 7, 7))
    found = np.asarray(blur.blur_row(jnp.asarray(light), jnp.asarray(kernels), (8, 8)))
    assert found.shape == (8, 16, 2)
    for y, x in ((0, 0), (3, 7), (7, 8), (5, 13)):
        j, v, u = x // 8, y / 8, (x % 8) / 8
        kernel = (1 - v) * ((1 - u) * kernels[0, j] + u * kernels[0, j + 1])
        kernel = kernel + v * ((1 - u) * kernels[1, j] + u * kernels[1, j + 1])
        part = np.moveaxis(light[y : y + 7, x : x + 7], -1, 0)
        wanted = np.sum(kernel[:, ::-1, ::-1] * part, axis=(1, 2))
        np.testing.assert_allclose(found[y, x], wanted, rtol=1e-12)


def test_interpolation_is_exact_for_polynomials_and_goes_on_at_the_edge():
    places = jnp.linspace(-0.5, 9.4, 31)
    nodes = np.arange(10.0)
    matrix = np.asarray(interpolate.basis(places, 10, 4))
    np.testing.assert_allclose(matrix @ nodes**3, np.asarray(places) ** 3, atol=1e-10)
    plane = jnp.asarray(np.add.outer(3 * nodes, nodes**2))[None]
    y, x = jnp.array([[4.3, 20.0]]), jnp.array([[5.6, -9.0]])
    found = np.asarray(interpolate.cubic(plane, y, x))[0]
    np.testing.assert_allclose(found, [3 * 4.3 + 5.6**2, 27.0], atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cooke_triplet", "double_gauss"])
def test_an_even_picture_stays_even_but_for_the_illumination(name):
    method = method_of(name)
    maps = sensor_maps.sensor_maps(lens_of(name), method, WAVES)
    ones = np.ones((SIDE, SIDE, 2))
    blurred = rendering._whole(maps, method, ones, iter, lit=False)
    kept = 1 - np.asarray(drt_jax.kernel_grid(lens_of(name), method.grid, WAVES).outside)
    assert kept.min() - 1e-12 <= blurred.min() and blurred.max() <= 1 + 1e-12
    assert np.ptp(blurred) <= 2 * np.ptp(kept) + 1e-12
    light = np.asarray(drt_jax.render(lens_of(name), ones, np.inf, PIXEL, WAVES, method)) / blurred
    assert light.max() <= 1.01 and light.min() > 0.3


@pytest.mark.slow
def test_points_land_where_their_centroids_are():
    lens, method = lens_of(), method_of()
    focal = float(method.focal)
    middle = (SIDE - 1) / 2
    y, x = np.mgrid[:SIDE, :SIDE]
    for place in ((10, 12), (24, 38), (40, 40)):
        spot = np.exp(-((y - place[0]) ** 2 + (x - place[1]) ** 2) / (2 * 0.1**2))
        image = drt_jax.render(lens, spot, np.inf, PIXEL, WAVES, method)
        field = np.arctan((np.array(place[::-1]) - middle) * PIXEL / focal)
        found = drt_jax.psf_moments(lens, field, np.inf, WAVES)
        weight = np.asarray(image).sum(axis=(0, 1))
        for k, along in enumerate((x, y)):
            centroid = (np.asarray(image) * along[..., None]).sum(axis=(0, 1)) / weight
            wanted = np.asarray(found.mean)[:, k] / PIXEL + middle
            np.testing.assert_allclose(centroid, wanted, atol=0.01)


def test_no_seam_lies_between_tiles():
    """Tiles of another size give the same picture."""
    lens, method = lens_of(), method_of()
    image = drt_jax.render(lens, picture(), np.inf, PIXEL, WAVES, method)
    other = dataclasses.replace(method, tile=(7, 5))
    again = drt_jax.render(lens, picture(), np.inf, PIXEL, WAVES, other)
    assert np.max(np.abs(np.asarray(image) - np.asarray(again))) < 1e-3


@pytest.mark.slow
def test_the_same_inside_jit_and_differentiable_by_the_lens():
    lens, method = lens_of(), method_of()
    scene, truth = picture(2), picture(3)

    @jax.jit
    def loss(values):
        moved = dataclasses.replace(lens, curvature=lens.curvature * values[0], sensor=values[1])
        image = drt_jax.render(moved, scene, np.inf, PIXEL, WAVES, method)
        return jnp.mean((image - truth) ** 2)

    at = jnp.stack([jnp.ones(()), lens.sensor + 1.0])
    outside = drt_jax.render(
        dataclasses.replace(lens, sensor=at[1]), scene, np.inf, PIXEL, WAVES, method
    )
    np.testing.assert_allclose(loss(at), np.mean((outside - truth) ** 2), rtol=1e-10)
    slope = jax.jit(jax.grad(loss))(at)
    for k, step in enumerate((1e-5, 1e-3)):
        aside = jnp.zeros(2).at[k].set(step)
        wanted = (loss(at + aside) - loss(at - aside)) / (2 * step)
        np.testing.assert_allclose(slope[k], wanted, rtol=1e-4)


def test_kernels_of_patches_come_from_the_grid():
    made = grid()
    half = np.array(made.half[::-1])
    tangents = np.array([[0.0, 0.0], [1.0, 2.0], [-2.0, 1.0]]) * float(made.step)
    found = np.asarray(drt_jax.kernels_at(made, np.arctan(tangents), np.inf))
    for kernel, tangent in zip(found, tangents):
        x, y = np.round(tangent / float(made.step)).astype(int) + half
        np.testing.assert_allclose(kernel, np.asarray(made.kernels)[0, y, x], atol=1e-12)
    scenes = jnp.asarray(np.random.default_rng(0).random((3, 32, 30, 2)))
    images = drt_jax.convolve_each(scenes, jnp.asarray(found))
    assert images.shape == (3, 20, 18, 2)
    for scene, kernel, image in zip(scenes, found, images):
        wanted = drt_jax.convolve(scene[None], jnp.asarray(kernel))[0]
        np.testing.assert_allclose(image, wanted, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_layers_of_an_even_picture_stay_even_and_cover_what_lies_behind():
    lens = lens_of()
    depth = np.where(np.arange(SIDE)[:, None] + 0 * np.arange(SIDE) < 20, 800.0, 5000.0)
    method = drt_jax.render_method(
        lens, (SIDE, SIDE), depth, PIXEL, WAVES, 13, 4, 20, 2, model=method_of().grid.model
    )
    ones = np.ones((SIDE, SIDE, 2))
    image = np.asarray(drt_jax.render(lens, ones, depth, PIXEL, WAVES, method))
    assert np.isfinite(image).all() and 0.9 < image[20, 24].min() <= image[20, 24].max() < 1.02
    assert np.max(np.abs(np.diff(image[14:26, 24], axis=0))) < 0.02


def test_noise_has_the_variance_of_its_electrons():
    image = jnp.full((200, 200), 0.25)
    found = np.asarray(drt_jax.sensor_noise(image, jax.random.key(0), 10_000, 5.0))
    np.testing.assert_allclose(found.mean(), 0.25, atol=2e-4)
    np.testing.assert_allclose(found.var(), (2500 + 25) / 1e8, rtol=0.03)
    slope = jax.grad(lambda a: jnp.sum(drt_jax.sensor_noise(a, jax.random.key(0), 1e4, 0.0)))
    assert np.isfinite(slope(jnp.zeros(3))).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixel": 0.0}, "pixel: must be above 0 mm"),
        ({"image": np.ones((8, 8, 3))}, r"image: expected \(H, W, 2\)"),
        ({"image": np.ones((8, 8, 2), np.uint8)}, "linear floating numbers"),
        ({"image": np.full((8, 8), np.nan)}, "must be finite"),
        ({"distance": np.ones((3, 8))}, "depth map of 8 x 8 pixels"),
        ({"distance": 0.0}, "above 0 mm"),
    ],
)
def test_bad_input_gets_one_line(changes, message):
    given = {"image": np.ones((8, 8)), "distance": np.inf, "pixel": 0.01} | changes
    with pytest.raises(ValueError, match=message) as error:
        drt_jax.render(lens_of(), given["image"], given["distance"], given["pixel"], WAVES)
    assert "\n" not in str(error.value)
