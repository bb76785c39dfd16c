"""Moments: published numbers, symmetric against general paths, polynomials against tracing."""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import focus_moments, load_lens, psf_moments, pupil_order, trace_rays
from drt_jax.image import moments
from drt_jax.pupil import rules as pupil

from .conftest import RGB, assert_close

# Double Gauss, object at 25 m, mean of R, G, B, in um, found before this package was written.
SIGMA = {
    130: 257.8,
    132: 105.6,
    132.5: 67.6,
    133: 29.8,
    133.3: 7.9,
    133.5: 9.6,
    134: 46.8,
    134.5: 84.8,
    135: 122.8,
}


@pytest.mark.parametrize("sensor", SIGMA)
def test_blur_of_the_double_gauss(sensor):
    lens = dataclasses.replace(load_lens("double_gauss"), sensor=jnp.asarray(float(sensor)))
    mean, covariance = psf_moments(lens, 0.0, 25000.0, RGB)
    assert mean.shape == (3, 2) and covariance.shape == (3, 2, 2)
    np.testing.assert_allclose(1e3 * np.sqrt(covariance[:, 0, 0]).mean(), SIGMA[sensor], atol=0.051)


@pytest.mark.parametrize(
    "name", [pytest.param("double_gauss_addon", marks=pytest.mark.slow), "cooke_triplet"]
)
def test_meridional_half_and_whole_pupil_agree(name):
    lens = load_lens(name)
    wide = 12  # enough azimuths for the general rule to converge to rounding

    def plane(field, rule, symmetry):
        return moments._plane_moments(lens, field, 9000.0, RGB, rule, symmetry)[0]

    meridian = plane(0.0, pupil.meridian(wide), "meridian")
    for field in (0.0, 0.1):
        half = plane(field, pupil.half_disc(wide, wide + 1), "half")
        disc = plane(field, pupil.disc(wide, wide + 1), "disc")
        np.testing.assert_allclose(disc.spread[..., :2], half.spread, rtol=1e-10, atol=1e-16)
        np.testing.assert_allclose(disc.spread[..., 2], 0, atol=1e-12)
        np.testing.assert_allclose(disc.mean, half.mean, rtol=1e-10, atol=1e-12)
        if field == 0:
            np.testing.assert_allclose(half.spread, meridian.spread, rtol=1e-10, atol=1e-16)


@pytest.mark.slow
def test_gradients_of_meridional_half_and_whole_pupil_agree():
    """By the lens and the distance, within 1e-10 of the largest element of each array."""
    lens, wide = load_lens("cooke_triplet"), 12
    rules = {
        "meridian": pupil.meridian(wide),
        "half": pupil.half_disc(wide, wide + 1),
        "disc": pupil.disc(wide, wide + 1),
    }
    weights = np.random.default_rng(0).normal(size=(3, 2, 2))

    def scalar(lens, field, distance, symmetry):
        scene = lens, field, distance, RGB[:2]
        traced = moments._plane_moments(*scene, rules[symmetry], symmetry)[0]
        # On axis the centroid is 0, and the gradient of what rounding leaves of it is no number.
        return jnp.sum(weights * traced.spread[..., :2]) + field * jnp.sum(traced.mean[:, 1])

    gradient = jax.jit(jax.grad(scalar, argnums=(0, 2)), static_argnums=3)
    for field in (0.0, 0.1):
        half, disc = (gradient(lens, field, 9000.0, kind) for kind in ("half", "disc"))
        assert_close(disc, half, 1e-10, 1e-18)
        if field == 0:
            assert_close(half, gradient(lens, field, 9000.0, "meridian"), 1e-10, 1e-18)


@pytest.mark.parametrize("field", [0.0, pytest.param(0.1, marks=pytest.mark.slow)])
def test_a_centred_lens_given_zero_tilts_and_decentres_is_the_same(field):
    """Moments and their gradients by everything that both have, 1e-10."""
    lens = load_lens("cooke_triplet")
    count = len(lens.forms)
    given = dataclasses.replace(
        lens, decentre=jnp.zeros((count + 1, 2)), tilt=jnp.zeros((count + 1, 3))
    )

    def blur(lens, distance):
        mean, covariance = psf_moments(lens, field, distance, RGB[:2], order=4)
        turn = 0.3 * covariance[:, 0, 0] + covariance[:, 1, 1]
        return jnp.sum(turn) + field * jnp.sum(mean), (mean, covariance)

    blur = jax.jit(jax.value_and_grad(blur, argnums=(0, 1), has_aux=True))
    (_, plain), gradient = blur(lens, 9000.0)
    (_, general), other = blur(given, 9000.0)
    np.testing.assert_allclose(general[0], plain[0], rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(general[1], plain[1], rtol=1e-10, atol=1e-16)
    assert np.all(np.isfinite(other[0].tilt)) and np.all(np.isfinite(other[0].decentre))
    other = dataclasses.replace(other[0], tilt=None, decentre=None), other[1]
    assert_close(other, gradient, 1e-10, 1e-18)


def test_field_in_any_direction_turns_the_moments():
    lens = load_lens("cooke_triplet")
    angle, h = 0.6, np.tan(0.15)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    field = np.arctan(turn @ [0.0, h])
    mean, covariance = psf_moments(lens, np.arctan([0.0, h]), jnp.inf, RGB, 1e-11)
    turned_mean, turned = psf_moments(lens, field, jnp.inf, RGB, 1e-11)
    np.testing.assert_allclose(turned_mean, mean @ turn.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(turned, turn @ covariance @ turn.T, rtol=1e-8, atol=1e-14)


def test_moments_are_those_of_many_random_rays():
    """The paper's way, with 40,000 rays instead of 256: agrees within 4 standard errors."""
    lens = load_lens("cooke_triplet")
    points, _ = pupil.random_disc(40_000, seed=0)
    hits = np.asarray(trace_rays(lens, 0.2, 5000.0, [0.53], points.T).points[0, :, -1, :2])
    mean, covariance = psf_moments(lens, 0.2, 5000.0, [0.53])
    centred = hits - hits.mean(axis=0)
    np.testing.assert_array_less(
        np.abs(hits.mean(axis=0) - mean[0]), 4 * hits.std(axis=0) / np.sqrt(len(hits))
    )
    products = centred[:, :, None] * centred[:, None, :]
    error = 4 * products.std(axis=0) / np.sqrt(len(hits))
    np.testing.assert_array_less(np.abs(products.mean(axis=0) - covariance[0]), error)


@pytest.mark.parametrize("field", [0.0, 0.1])
def test_sensor_polynomial_is_the_traced_moment(field):
    lens = load_lens("double_gauss")
    focus = focus_moments(lens, field, 25000.0, RGB, 1e-9)
    for sensor in (130.0, 133.0, 133.35, 135.0):
        moved = dataclasses.replace(lens, sensor=jnp.array(sensor))
        mean, covariance = psf_moments(moved, field, 25000.0, RGB, 1e-9)
        m, variances = focus.at(sensor)
        assert variances.shape == (3, 2)  # principal axes by symmetry
        np.testing.assert_allclose(m, mean, atol=1e-10)
        diagonal = jnp.diagonal(covariance, 0, 1, 2)
        np.testing.assert_allclose(variances, diagonal, rtol=2e-9, atol=1e-13)


@pytest.mark.slow
def test_gradient_of_the_sensor_polynomial_is_the_traced_one():
    """By the whole lens, the distance and the sensor position, 1e-10; 2.5 mm from the sensor
    about which the polynomial was made."""
    lens = load_lens("double_gauss")
    scene = lens, 25000.0, jnp.array(131.0)

    def polynomial(lens, distance, sensor):
        mean, variances = focus_moments(lens, 0.1, distance, RGB[:2], order=4).at(sensor)
        return jnp.sum(mean) + jnp.sum(variances)

    def traced(lens, distance, sensor):
        moved = dataclasses.replace(lens, sensor=sensor)
        mean, covariance = psf_moments(moved, 0.1, distance, RGB[:2], order=4)
        return jnp.sum(mean) + jnp.sum(jnp.trace(covariance, axis1=1, axis2=2))

    ours = jax.jit(jax.grad(polynomial, argnums=(0, 1, 2)))(*scene)
    wanted = jax.jit(jax.grad(traced, argnums=(0, 1, 2)))(*scene)
    # The position of the sensor is its own argument: the lens's sensor only sets the origin.
    assert abs(ours[0].sensor) < 1e-10 * abs(ours[2]) and wanted[0].sensor == 0
    ours = dataclasses.replace(ours[0], sensor=wanted[0].sensor), *ours[1:]
    assert_close(ours, wanted, 1e-10, 1e-18)


@pytest.mark.slow
def test_gradient_of_the_depth_interpolation_is_the_traced_one():
    """By the distance and the sensor position, 1e-10 of the largest over the range."""
    lens = load_lens("double_gauss_addon")
    depths = drt_jax.depth_moments(lens, 0.05, 5e3, 5e4, RGB[:2], 1e-13)

    def interpolated(distance, sensor):
        mean, variances = depths.at(1 / distance).at(sensor)
        return mean[:, 1] * 1e-2, variances

    def traced(distance, sensor):
        moved = dataclasses.replace(lens, sensor=sensor)
        mean, covariance = psf_moments(moved, 0.05, 1 / distance, RGB[:2], order=16)
        return mean[:, 1] * 1e-2, jnp.diagonal(covariance, 0, 1, 2)

    ours, wanted = (
        jax.jit(jax.vmap(jax.jacrev(f, argnums=(0, 1)), (0, None))) for f in (interpolated, traced)
    )
    scene = 1 / jnp.array([5.1e3, 7e3, 1.7e4, 4.9e4]), lens.sensor
    assert_close(ours(*scene), wanted(*scene), 1e-10, 1e-18)


@pytest.mark.parametrize("field", [0.0, 0.05])
def test_depth_interpolation_is_the_traced_moment(field):
    lens = load_lens("double_gauss_addon")
    depths = drt_jax.depth_moments(lens, field, 5e3, 5e4, RGB, 1e-11)
    for distance in (5e3, 6.1e3, 1.7e4, 3.3e4, 5e4):
        wanted = focus_moments(lens, field, distance, RGB, 1e-11)
        ours = depths.at(distance)
        size = np.max(np.asarray(wanted.spread), axis=(1, 2), keepdims=True)
        np.testing.assert_allclose(ours.spread / size, wanted.spread / size, atol=1e-10)
        np.testing.assert_allclose(ours.mean, wanted.mean, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["double_gauss", "cooke_triplet"])
@pytest.mark.parametrize("degrees", [0.0, 5.0, 10.0])
def test_order_keeps_the_promised_tolerance(name, degrees):
    lens = load_lens(name)
    field = np.radians(degrees)
    exact = psf_moments(lens, field, 25000.0, RGB, order=20)[1]
    size = np.sqrt(np.trace(exact, axis1=1, axis2=2))
    before = 0
    for tolerance in (1e-3, 1e-6, 1e-9):
        order = pupil_order(lens, field, 25000.0, RGB, tolerance)
        got = psf_moments(lens, field, 25000.0, RGB, order=order)[1]
        error = np.max(np.abs(np.sqrt(np.trace(got, axis1=1, axis2=2)) / size - 1))
        assert error <= tolerance and order > before
        before = order


def test_tolerance_holds_at_any_sensor_position():
    """Rays traced with the sensor 3 mm out of focus, where the spot is 30 times larger."""
    lens = dataclasses.replace(load_lens("double_gauss"), sensor=jnp.array(130.0))
    exact = focus_moments(lens, 0.0, 25000.0, RGB, order=20)
    for tolerance in (1e-3, 1e-6, 1e-9):
        ours = focus_moments(lens, 0.0, 25000.0, RGB, tolerance)
        for sensor in (130.0, 133.3, 133.37, 133.45):
            got, wanted = (np.sqrt(m.at(sensor)[1][:, 0]) for m in (ours, exact))
            np.testing.assert_allclose(got, wanted, rtol=tolerance)


def test_slow_convergence_is_said():
    """Where the faces of the lens cross, rays miss: no aperture ends the beam there."""
    lens = dataclasses.replace(
        load_lens("singlet"), semi_diameter=jnp.array([25.0, jnp.inf, jnp.inf])
    )
    with pytest.warns(UserWarning, match="converged to .* only.* does the edge of the beam fail"):
        psf_moments(lens, 0.0, 25000.0, RGB, 1e-9)


def test_inside_jit_the_order_follows_a_rule_that_is_on_the_safe_side():
    lens = load_lens("double_gauss")
    for field in (0.0, 0.17):
        got = jax.jit(lambda lens: psf_moments(lens, field, 25000.0, RGB, 1e-6)[1])(lens)
        exact = psf_moments(lens, field, 25000.0, RGB, 1e-11)[1]
        np.testing.assert_allclose(got, exact, rtol=2e-6, atol=1e-13)


def test_gradient_with_respect_to_the_whole_lens():
    lens = load_lens("double_gauss")

    def blur(lens):
        return jnp.sum(psf_moments(lens, 0.1, 25000.0, RGB, order=5)[1])

    gradient = jax.jit(jax.grad(blur))(lens)
    value = jax.jit(blur)
    for leaf, k in (("curvature", 2), ("thickness", 5), ("conic", 6), ("semi_diameter", 5)):
        h = 1e-5 * (abs(float(getattr(lens, leaf)[k])) + 1e-2)
        shift = lambda s: dataclasses.replace(  # noqa: E731
            lens, **{leaf: getattr(lens, leaf).at[k].add(s)}
        )
        difference = (value(shift(h)) - value(shift(-h))) / (2 * h)
        np.testing.assert_allclose(getattr(gradient, leaf)[k], difference, rtol=3e-6, atol=1e-12)


def test_cheapest_model_agrees_with_retracing():
    lens = load_lens("double_gauss_addon")
    near, far = 1e4, 5e4
    values, cheap = drt_jax.moments_model(lens, ("sensor",), 0.0, (near, far), RGB, 1e-10)
    everything, retrace = drt_jax.moments_model(
        lens, ("sensor", "curvature"), 0.0, (near, far), RGB, 1e-10
    )
    assert set(values) == {"sensor"} and set(everything) == {"sensor", "curvature"}
    for distance in (1e4, 2.2e4, 5e4):
        for a, b in zip(cheap(values, distance), retrace(everything, distance)):
            np.testing.assert_allclose(a, b, rtol=1e-8, atol=1e-14)
    # In the cheap one no ray is traced: no loop, no square root of a root-finder.
    assert "while" not in str(jax.make_jaxpr(cheap)(values, 2e4))
    assert "while" in str(jax.make_jaxpr(retrace)(everything, 2e4))


def test_bad_requests():
    lens = load_lens("singlet")
    with pytest.raises(ValueError, match="tolerance: expected a number between 0 and 1"):
        psf_moments(lens, 0.0, jnp.inf, RGB, tolerance=2.0)
    with pytest.raises(ValueError, match="expected 0 < near < far"):
        drt_jax.depth_moments(lens, 0.0, 5e4, 1e4, RGB)
    blocked = dataclasses.replace(lens, semi_diameter=jnp.array([5.0, 12.5, 1e-3]))
    blocked = dataclasses.replace(blocked, sensor=lens.sensor)
    for order in (None, 4):
        with pytest.raises(ValueError, match="no ray at 0.6 um reaches the sensor"):
            psf_moments(blocked, 0.1, jnp.inf, RGB, order=order)
    with pytest.raises(ValueError, match="order: expected 1 to 40, got 41"):
        psf_moments(lens, 0.0, jnp.inf, RGB, order=41)


def test_a_lens_fixed_inside_jit_is_a_known_scene():
    """Orders are found, and nothing of a closed-over lens is traced into the program."""
    lens = load_lens("singlet")
    for order in (None, 3):
        scaled = jax.jit(lambda s, n=order: s * psf_moments(lens, 0.0, 25e3, RGB, order=n)[1])
        assert "while" not in str(jax.make_jaxpr(scaled)(1.0))
        np.testing.assert_allclose(
            scaled(2.0), 2 * psf_moments(lens, 0.0, 25e3, RGB, order=order)[1]
        )


@pytest.mark.parametrize("field, name", [(0.0, "double_gauss"), (0.15, "cooke_triplet")])
def test_an_eager_gradient_is_that_of_a_program(field, name):
    """Eagerly, the rays that the order was found with are differentiated, not traced again."""
    lens = load_lens(name)

    def size(sensor, curvature, order=None):
        moved = dataclasses.replace(lens, sensor=sensor, curvature=curvature)
        return psf_moments(moved, field, 5e3, RGB, order=order)[1][1, 1, 1] ** 0.5

    order = pupil_order(lens, field, 5e3, RGB)
    scene = lens.sensor, lens.curvature
    whole = jax.jit(jax.value_and_grad(partial(size, order=order), (0, 1)))(*scene)
    for a, b in zip(
        jax.tree.leaves(jax.value_and_grad(size, (0, 1))(*scene)), jax.tree.leaves(whole)
    ):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * float(jnp.max(jnp.abs(b))))
