"""A picture through a lens: uniform light, points, borders of tiles, derivatives, invalid input."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import drt_jax
from drt_jax import Scene, learn
from drt_jax.image import interpolate, render as rendering, sensor_maps

PIXEL, SIDE = 0.15, 48
WAVES = (0.6, 0.48)


@functools.cache
def lens_of(name="cooke_triplet"):
    return drt_jax.load_lens(name)


@functools.cache
def method_of(name="cooke_triplet", distance=np.inf, **others):
    return drt_jax.converge(
        drt_jax.render,
        lens_of(name),
        (SIDE, SIDE),
        distance,
        PIXEL,
        WAVES,
        13,
        4,
        kind="gaussian",
        **others,
    )


def picture(seed=0):
    return np.random.default_rng(seed).random((SIDE, SIDE, 2))


@functools.cache
def grid():
    return drt_jax.kernel_grid(lens_of(), WAVES, method_of().grid)


def test_a_row_of_tiles_is_blurred_by_each_pixels_own_kernel():
    random = np.random.default_rng(1)
    light, kernels = random.random((2, 14, 22)), random.random((1, 2, 3, 7, 7))
    lines, across = random.random((2, 3, 8, 4)), random.random((16, 4))
    shares = lines @ across.T
    given = map(jnp.asarray, (light, kernels, lines, across))
    found = np.asarray(sensor_maps.blur_row(*given, (8, 8)))
    assert found.shape == (2, 8, 16)
    for y, x in ((0, 0), (3, 7), (7, 8), (5, 13)):
        kernel = np.einsum("crij,cr->cij", kernels[0], shares[:, :, y, x])
        wanted = np.sum(kernel[:, ::-1, ::-1] * light[:, y : y + 7, x : x + 7], axis=(1, 2))
        np.testing.assert_allclose(found[:, y, x], wanted, rtol=1e-12)


@pytest.mark.slow
def test_a_few_kernels_give_back_those_that_they_span():
    """Two kernels span all; a third position, equal to the first, adds nothing and gives no NaN."""
    random = np.random.default_rng(2)
    two, share = random.random((2, 5, 5)), random.random((4, 6, 2))
    seen = jnp.asarray(np.einsum("yxr,rij->yxij", share, two))
    places = jnp.array([3, 17, 3], jnp.int32)

    def whole(seen):
        kernels, shares = sensor_maps._parts(seen, places)
        return jnp.einsum("ryx,rij->yxij", shares, kernels)

    np.testing.assert_allclose(whole(seen), seen, atol=1e-12)
    weights = jnp.asarray(random.random(seen.shape))
    slope = jax.grad(lambda a: jnp.sum(weights * whole(a)))(seen)
    aside = jnp.asarray(np.einsum("yxr,rij->yxij", random.random((4, 6, 2)), two))
    np.testing.assert_allclose(jnp.sum(slope * aside), jnp.sum(weights * aside), rtol=1e-9)


@pytest.mark.slow
def test_a_pixel_collects_the_kernel_of_each_point_around_it():
    """Compared with a sum over points, each with its own kernel and light, one by one in NumPy."""
    lens, method, margin = lens_of(), method_of(), 6
    scene, focal = picture(4), float(method.focal)
    image = np.asarray(drt_jax.render(lens, scene, np.inf, PIXEL, WAVES, method))
    tangents = np.linspace(0, 0.2, 21)
    fields = jnp.asarray(np.arctan(np.stack([0 * tangents, tangents], -1)))
    wave = jnp.array(WAVES[:1])
    direct = jax.jit(
        lambda fields: jax.lax.map(
            lambda f: drt_jax.psf(
                lens, Scene.point(f, np.inf, wave), PIXEL, 13, sampling=method.grid.sampling
            ),
            fields,
        )
    )
    radii = np.asarray(direct(fields).centre)[:, 1]
    axis = float(direct(fields[:1]).solid_angle[0, 0])
    for row, column in ((9, 14), (30, 41)):
        y, x = np.mgrid[-margin : margin + 1, -margin : margin + 1].reshape(2, -1)
        places = np.stack([column - x, row - y], -1) - (SIDE - 1) / 2  # pixels from the axis
        radius = np.hypot(*places.T) * PIXEL
        pinhole = CubicSpline(radii, tangents)(radius)[:, None] * places
        pinhole = pinhole / np.hypot(*places.T)[:, None]
        found = direct(jnp.asarray(np.arctan(pinhole)))
        weight = (
            np.asarray(found.solid_angle)[:, 0]
            * np.asarray(found.kernel)[np.arange(169), 0, y + margin, x + margin]
        )
        # At the pixel's own source, the middle of the 169.
        light = float(found.solid_angle[84, 0]) / axis * (1 - float(found.outside[84, 0]))
        at = pinhole * focal / PIXEL + (SIDE - 1) / 2
        seen = map_coordinates_by_keys(scene[..., 0], at[:, 1], at[:, 0])
        wanted = light * np.sum(weight * seen) / np.sum(weight)
        assert abs(image[row, column, 0] - wanted) < 1e-3


def map_coordinates_by_keys(plane, y, x):
    """Cubic convolution with a = -1/2, written as piecewise polynomials of the distance."""

    def near(d):
        d = np.abs(d)
        inner, outer = 1 - 2.5 * d**2 + 1.5 * d**3, 2 - 4 * d + 2.5 * d**2 - 0.5 * d**3
        return np.where(d <= 1, inner, np.where(d < 2, outer, 0))

    rows, columns = np.arange(plane.shape[0]), np.arange(plane.shape[1])
    weights = near(y[:, None] - rows), near(x[:, None] - columns)
    return np.einsum("qy,yx,qx->q", weights[0], plane, weights[1])


def test_interpolation_is_exact_for_polynomials_and_goes_on_at_the_edge():
    places = jnp.linspace(-0.5, 9.4, 31)
    nodes = np.arange(10.0)
    matrix = np.asarray(interpolate.basis(places, 10, 4))
    np.testing.assert_allclose(matrix @ nodes**3, np.asarray(places) ** 3, atol=1e-10)
    picture = jnp.asarray(np.add.outer(3 * nodes, nodes**2))[..., None]
    y, x = jnp.array([[4.3, 20.0]]), jnp.array([[5.6, -9.0]])
    found = np.asarray(interpolate.cubic(picture, y, x))[0]
    np.testing.assert_allclose(found, [3 * 4.3 + 5.6**2, 27.0], atol=1e-10)


@pytest.mark.slow
def test_an_even_picture_stays_even_but_for_the_illumination():
    lens, method = lens_of(), method_of()
    maps = sensor_maps.sensor_maps(lens, method, WAVES)
    ones = np.ones((SIDE, SIDE, 2))
    blurred = rendering._whole(maps, method, ones, iter, lit=False)
    kept = 1 - np.asarray(grid().outside)
    assert kept.min() - 1e-9 <= blurred.min() and blurred.max() <= 1 + 1e-9
    assert np.ptp(blurred) <= 2 * np.ptp(kept) + 1e-9
    light = np.asarray(drt_jax.render(lens, ones, np.inf, PIXEL, WAVES, method)) / blurred
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
        found = drt_jax.psf_moments(lens, Scene.point(field, np.inf, WAVES))
        weight = np.asarray(image).sum(axis=(0, 1))
        for k, along in enumerate((x, y)):
            centroid = (np.asarray(image) * along[..., None]).sum(axis=(0, 1)) / weight
            wanted = np.asarray(found.mean)[:, k] / PIXEL + middle
            np.testing.assert_allclose(centroid, wanted, atol=0.01)


@pytest.mark.slow
def test_no_seam_lies_between_tiles():
    """Tiles of another size give the same picture, and tiles that blend the kernels of their
    corners nearly so."""
    lens, method = lens_of(), method_of()
    image = drt_jax.render(lens, picture(), np.inf, PIXEL, WAVES, method)
    other = dataclasses.replace(method, tile=(7, 5))
    again = drt_jax.render(lens, picture(), np.inf, PIXEL, WAVES, other)
    assert np.max(np.abs(np.asarray(image) - np.asarray(again))) < 1e-12
    corners = dataclasses.replace(method, places=jnp.zeros(0, jnp.int32), tile=(6, 4))
    blended = drt_jax.render(lens, picture(), np.inf, PIXEL, WAVES, corners)
    assert 0 < np.max(np.abs(np.asarray(image) - np.asarray(blended))) < 1e-3
    for changed in ((np.inf, 2 * PIXEL), (1e3, PIXEL)):
        with pytest.raises(ValueError, match=r"(pixel|distance): the method is for .* make one"):
            drt_jax.render(lens, picture(), *changed, WAVES, method)


@pytest.mark.slow
def test_the_same_inside_jit_and_differentiable_by_the_lens():
    lens, method = lens_of(), method_of()
    scene, truth = picture(2), picture(3)

    @jax.jit
    @jax.value_and_grad
    def both(values):
        moved = dataclasses.replace(lens, curvature=lens.curvature * values[0], sensor=values[1])
        image = drt_jax.render(moved, scene, np.inf, PIXEL, WAVES, method)
        return jnp.mean((image - truth) ** 2)

    at = jnp.stack([jnp.ones(()), lens.sensor + 1.0])
    outside = drt_jax.render(
        dataclasses.replace(lens, sensor=at[1]), scene, np.inf, PIXEL, WAVES, method
    )
    value, slope = both(at)
    np.testing.assert_allclose(value, np.mean((outside - truth) ** 2), rtol=1e-10)
    for k, step in enumerate((1e-5, 1e-3)):
        aside = jnp.zeros(2).at[k].set(step)
        wanted = (both(at + aside)[0] - both(at - aside)[0]) / (2 * step)
        np.testing.assert_allclose(slope[k], wanted, rtol=1e-4)


@pytest.mark.slow
def test_kernels_of_patches_come_from_the_grid():
    made = grid()
    half = np.array(made.half[::-1])
    tangents = np.array([[0.0, 0.0], [1.0, 2.0], [-2.0, 1.0]]) * float(made.step)
    found = np.asarray(made.at(Scene.radians(np.arctan(tangents), np.inf)))
    for kernel, tangent in zip(found, tangents):
        x, y = np.round(tangent / float(made.step)).astype(int) + half
        np.testing.assert_allclose(kernel, np.asarray(made.kernels)[0, y, x], atol=1e-12)
    scenes = jnp.asarray(np.random.default_rng(0).random((3, 32, 30, 2)))
    images = learn.convolve_each(scenes, jnp.asarray(found))
    assert images.shape == (3, 20, 18, 2)
    for scene, kernel, image in zip(scenes, found, images):
        wanted = learn.convolve(scene[None], jnp.asarray(kernel))[0]
        np.testing.assert_allclose(image, wanted, rtol=1e-9, atol=1e-12)


def test_hidden_parts_go_on_as_what_is_seen_beside_them():
    values, known = np.zeros((5, 7, 1)), np.zeros((5, 7, 1))
    known[:, :3], values[:, :3] = 1, 0.25
    np.testing.assert_allclose(rendering.spread(jnp.asarray(values), jnp.asarray(known)), 0.25)
    nothing = jnp.zeros((5, 7, 1))
    np.testing.assert_array_equal(rendering.spread(nothing, nothing), 0)


@pytest.mark.slow
def test_a_near_plane_covers_what_lies_behind_it_by_its_blurred_cover():
    """Planes of radiance 1 and 0.25: the cover is blurred with the kernels of the near plane."""
    lens, near, far = lens_of(), 800.0, 5000.0
    mask = (np.arange(SIDE)[:, None] < 20) & (np.arange(SIDE) > 8)
    depth = np.where(mask, near, far)
    given = lens, (SIDE, SIDE), depth, PIXEL, WAVES, 13, 4, 2
    own = method_of().grid.sampling
    method = drt_jax.converge(drt_jax.render, *given, tolerance=1e-2, sampling=own)
    maps = sensor_maps.sensor_maps(lens, method, WAVES)
    scene = np.where(mask, 1.0, 0.25)[..., None] * np.ones(2)
    image = np.asarray(rendering.composed(maps, method, scene, jnp.asarray(depth)))
    ones = np.ones((SIDE, SIDE, 2))
    even = np.asarray(rendering.composed(maps, method, ones, jnp.asarray(depth)))
    front = rendering._whole(maps, method, mask[..., None] * ones, iter, 0)
    cover = rendering._whole(maps, method, mask[..., None] * ones, iter, 0, lit=False)
    back = rendering._whole(maps, method, 0.25 * ones, iter, 1)
    assert 0.1 < cover[20, 24, 0] < 0.9
    np.testing.assert_allclose(image, front + (1 - cover) * back, atol=2e-3)
    np.testing.assert_allclose(even, front + (1 - cover) * back / 0.25, atol=2e-3)


def test_noise_has_the_variance_of_its_electrons():
    image = jnp.full((200, 200), 0.25)
    found = np.asarray(drt_jax.sensor_noise(image, jax.random.key(0), 10_000, 5.0))
    np.testing.assert_allclose(found.mean(), 0.25, atol=2e-4)
    np.testing.assert_allclose(found.var(), (2500 + 25) / 1e8, rtol=0.03)
    slope = jax.grad(lambda a: jnp.sum(drt_jax.sensor_noise(a, jax.random.key(0), 1e4, 0.0)))
    assert np.isfinite(slope(jnp.zeros(3))).all()


@pytest.mark.slow
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


def test_few_kernels_keep_sum_and_centroid():
    """Skew kernels of a 5 x 7 grid from four of them; with projection alone, the error of centroids
    is 0.009 pixels."""
    k = np.arange(11) - 5.0
    x, y = np.meshgrid(k, k)
    shift = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 7), np.linspace(-0.1, 0.3, 5)), -1)
    far = [y - shift[..., 1, None, None], x - shift[..., 0, None, None]]
    seen = np.exp(-(far[0] ** 2) / 3 - far[1] ** 2 / 5) * (1 + 0.1 * shift[..., :1, None] * x)
    seen /= seen.sum(axis=(-2, -1), keepdims=True)
    kernels, shares = sensor_maps._parts(jnp.asarray(seen), jnp.array([0, 6, 17, 30]))
    found = np.einsum("rij,ryx->yxij", kernels, shares)
    np.testing.assert_allclose(found.sum((-2, -1)), 1, rtol=0, atol=1e-12)
    for place in (x, y):
        moved = [np.sum(a * place, axis=(-2, -1)) for a in (found, seen)]
        assert np.max(np.abs(moved[0] - moved[1])) < 2e-4
