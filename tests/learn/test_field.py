"""Lens and network trained together over the field: points, sensor, gradients, both optimisers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design, learn
from drt_jax.image.beam import beam_rule
from drt_jax.learn.field import FieldImager, ObjectPoints, draw_points, make_field_step

WAVES, PIXEL, SIZE, FIELD = (0.6, 0.53, 0.48), 16e-3, 9, np.radians(10)
SEEN = ObjectPoints(jnp.radians(jnp.array([[1.0, 2.0], [-3.0, 7.0]])), jnp.array([jnp.inf, 3e4]))
# Accurate to some per cent here, without a search.
MODEL = drt_jax.Sampling("rays", beam_rule(6, "none"), 32)
KINDS = ["curvature", "conic", "coefficients", "thickness", "sensor", "index"]


def scenes(count=4, side=20):
    return np.random.default_rng(0).integers(0, 256, (count, side, side, 3), np.uint8)


@pytest.fixture(scope="module")
def camera():
    """A triplet of model glass with all kinds of numbers, and a small network."""
    lens = drt_jax.load_lens(
        {
            "name": "triplet of aspheres",
            "surfaces": [
                {"radius": 22, "thickness": 3.3, "nd": 1.62, "vd": 60, "semi_diameter": 8,
                 "conic": -0.1, "coefficients": {4: 1e-7, 6: 1e-10}},
                {"radius": -435, "thickness": 6, "semi_diameter": 8},
                {"radius": -22, "thickness": 1, "nd": 1.62, "vd": 36, "semi_diameter": 5,
                 "stop": True},
                {"radius": 20, "thickness": 4.75, "semi_diameter": 5},
                {"radius": 79, "thickness": 3, "nd": 1.62, "vd": 60, "semi_diameter": 7},
                {"radius": -18.4, "semi_diameter": 7},
            ],
            "sensor": 60.2,
        }
    )  # fmt: skip
    where = drt_jax.first_order(lens, jnp.inf, WAVES[1]).back_focal_distance[0] + jnp.sum(
        lens.thickness
    )
    lens = dataclasses.replace(lens, sensor=where - 0.1)
    vary = [design.Vary(kind, (0,)) for kind in KINDS if kind != "sensor"] + ["sensor"]
    variables = design.Variables.from_lens(lens, vary)

    def points(optics, seen):
        lens = variables.lens_of(optics["lens"])
        scene = Scene.radians(seen.fields, seen.distances, WAVES)
        found = drt_jax.psf(lens, scene, PIXEL, SIZE, sampling=MODEL)
        return found.kernel, found.solid_angle / 0.048

    init, restore = learn.red_net(1, 4)
    return variables, FieldImager(points, restore), init(jax.random.key(0))


def test_points_cover_the_field_and_the_depths():
    draw = jax.vmap(lambda key: draw_points(key, 4, FIELD, (1e3, np.inf)))
    seen = draw(jax.random.split(jax.random.key(1), 500))
    part = np.sum(np.tan(seen.fields) ** 2, axis=-1) / np.tan(FIELD) ** 2
    # One point in each ring of equal area; in total uniform in area, azimuth and 1 / distance.
    np.testing.assert_array_equal(np.floor(4 * part), np.broadcast_to(np.arange(4), part.shape))
    assert np.mean(part) == pytest.approx(0.5, abs=0.01)
    assert np.max(abs(np.mean(np.tan(seen.fields), axis=(0, 1)))) < 0.05 * np.tan(FIELD)
    near = 1e3 / np.asarray(seen.distances)
    assert 0 <= near.min() < 0.01 and 0.99 < near.max() <= 1
    assert np.mean(near) == pytest.approx(0.5, abs=0.01)
    assert abs(np.corrcoef(part.ravel(), near.ravel())[0, 1]) < 0.1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:size.* hold 99 %")
def test_the_kernels_of_many_points_are_those_of_each(camera):
    variables, imager, _ = camera
    kernels, light = imager.points({"lens": variables.start}, SEEN)
    lens = variables.lens_of(variables.start)
    for k in range(2):
        one = drt_jax.psf(
            lens, Scene.point(SEEN.fields[k], SEEN.distances[k], WAVES), PIXEL, SIZE, sampling=MODEL
        )
        np.testing.assert_allclose(kernels[k], one.kernel, atol=1e-12)
        np.testing.assert_allclose(0.048 * light[k], one.solid_angle, rtol=1e-12)
    with pytest.raises(ValueError, match=r"distance: expected one, or one for each of the fields"):
        several = Scene.radians(SEEN.fields, (1.0, 2.0, 3.0), WAVES)
        drt_jax.psf(lens, several, PIXEL, SIZE, sampling=MODEL)


def test_noise_rises_where_the_light_falls(camera):
    kernels = jnp.zeros((2, 3, SIZE, SIZE)).at[:, :, SIZE // 2, SIZE // 2].set(1.0)
    light = jnp.array([[1.0] * 3, [0.25] * 3])
    imager = FieldImager(lambda optics, seen: (kernels, light))
    given = scenes(2, 72), SEEN, 0.01, jax.random.key(2)
    truth, image, restored = imager({"optics": {}}, *given)
    np.testing.assert_array_equal(image, restored)
    spread = np.std(image - truth, axis=(1, 2, 3))
    np.testing.assert_allclose(spread, [0.01, 0.04], rtol=0.05)
    with pytest.raises(ValueError, match="3 patches cannot be shared among 2 points"):
        imager({"optics": {}}, scenes(3), *given[1:])


def loss_of(imager, weights):
    given = scenes(), SEEN, 0.01, jax.random.key(3)

    def loss(vector):
        truth, _, restored = imager({"optics": {"lens": vector}, "network": weights}, *given)
        return jnp.mean((restored - truth) ** 2)

    return loss


@pytest.mark.slow
def test_the_loss_has_the_derivative_of_finite_differences_by_every_kind_of_number(camera):
    # Through network, sensor, kernels and rays; the sensor layer rounds to float32.
    variables, imager, weights = camera
    loss = jax.jit(loss_of(imager, weights))
    start, gradient = variables.start, jax.grad(loss)(variables.start)
    for k, (name, slope) in enumerate(zip(variables.names, gradient, strict=True)):
        step = 3e-4 / abs(float(slope))  # all change the loss by as much
        move = step * np.eye(start.size)[k]
        values = [float(loss(start + n * move)) for n in (-2, -1, 1, 2)]
        expected = (8 * (values[2] - values[1]) - (values[3] - values[0])) / (12 * step)
        assert float(slope) == pytest.approx(expected, rel=5e-3), name


@pytest.mark.slow
def test_all_optimisers_descend_within_what_holds_the_lens(camera):
    variables, imager, weights = camera
    start = variables.start.at[-1].add(6.0)  # 0.3 mm out of focus

    def hold(before, after):
        return {"lens": jnp.clip(after["lens"], start - 5, start + 5)}

    focus = 0.3 * jnp.asarray([name == "sensor" for name in variables.names], start.dtype)
    scene = Scene.radians(SEEN.fields, np.inf, WAVES)
    spots = design.Problem.from_variables(variables, ["spot"], scene, 4)
    rays = design.RaySteps(spots, spots, design.cosine(5e-3, 25))
    first = []
    falling = {"lens": lambda k: design.cosine(1.0, 50, 1)(k.astype(focus.dtype)) * focus}
    for rate in ({"lens": focus}, falling, rays):
        rates = {"optics": rate, "network": 1e-3}
        init, step = make_field_step(imager, rates, lambda key: SEEN, 0, hold)
        state, losses = init({"optics": {"lens": start}, "network": weights}), []
        for k in range(25):
            state, metrics = step(state, scenes(), np.float32(0.0), np.int32(k))
            losses.append(float(metrics["loss"]))
        moved = np.asarray(state[0]["optics"]["lens"] - start)
        first.append(losses[0])
        assert losses[-1] < 0.8 * losses[0], rate
        assert np.max(np.abs(moved)) <= 5 or rate is rays  # which keeps limits of its own
        if isinstance(rate, dict):
            assert moved[-1] < -0.5
            assert not moved[:-1].any()
    assert first == pytest.approx([first[0]] * 3, rel=1e-5)
