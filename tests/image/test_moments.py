"""Moments: published numbers, symmetric paths compared with general ones, polynomials compared with
tracing."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import (
    Gauss,
    Scene,
    focus_moments,
    load_lens,
    psf_moments,
    pupil,
    trace_rays,
)
from drt_jax.image.converged import converged_focus_rule, converged_rule
from drt_jax.image.moments import moments
from drt_jax.lens.scene import checked_scene
from drt_jax.pupil import symmetry_of

from ..conftest import RGB, assert_close
from ..known import freed, known, search

FAR = 25000.0
# All fast tests use one lens: its programs, for one radius, half a pupil and the whole pupil, serve
# all calls with a tolerance.
LENS = freed(load_lens("double_gauss"))
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


def at(sensor, lens=LENS):
    return dataclasses.replace(lens, sensor=jnp.asarray(sensor, float))


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SIGMA)
def test_blur_of_the_double_gauss(sensor):
    found = psf_moments(at(sensor), Scene.point(0.0, FAR, RGB))
    assert found.mean.shape == (3, 2) and found.covariance.shape == (3, 2, 2)
    np.testing.assert_allclose(found.throughput, 1, rtol=1e-14)
    np.testing.assert_allclose(
        1e3 * np.sqrt(found.covariance[:, 0, 0]).mean(), SIGMA[sensor], atol=0.051
    )


def test_meridional_half_and_whole_pupil_agree():
    """On the axis, and so close to it that nothing changes."""
    lens = at(133.0)
    meridian = psf_moments(lens, Scene.point(0.0, FAR, RGB), 1e-11)
    for field in (1e-14, (1e-14, 0.0)):
        other = psf_moments(lens, Scene.point(field, FAR, RGB), 1e-11)
        np.testing.assert_allclose(other.mean, 0, atol=1e-10)
        np.testing.assert_allclose(other.covariance, meridian.covariance, rtol=1e-9, atol=1e-13)


def test_field_in_any_direction_turns_the_moments():
    angle, h = 0.6, np.tan(0.15)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    field = np.arctan(turn @ [0.0, h])
    moments = psf_moments(LENS, Scene.point(np.arctan(h), FAR, RGB), 1e-10)
    mean, covariance = moments.mean, moments.covariance
    moments = psf_moments(LENS, Scene.point(field, FAR, RGB), 1e-10)
    turned_mean, turned = moments.mean, moments.covariance
    np.testing.assert_allclose(turned_mean, mean @ turn.T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(turned, turn @ covariance @ turn.T, rtol=1e-8, atol=1e-13)


@pytest.mark.slow
def test_gradients_of_meridional_half_and_whole_pupil_agree():
    """By the lens and the distance, within 1e-10 of the largest element of each array."""
    lens, wide = load_lens("cooke_triplet"), 12
    weights = np.random.default_rng(0).normal(size=(3, 2, 2))

    @functools.partial(jax.jit, static_argnums=2)
    @jax.grad
    def gradient(moved, field, symmetry):
        lens, distance = moved
        scene = checked_scene(lens, Scene.point(field, distance, RGB[:2]))
        traced = moments(lens, scene, Gauss(wide, symmetry))
        # On axis the centroid is 0, and the gradient of its rounding error is meaningless.
        return jnp.sum(weights * traced.spread[..., :2]) + field * jnp.sum(traced.mean[:, 1])

    for field in (0.0, 0.1):
        moved = lens, jnp.asarray(9000.0)
        half, disc = (gradient(moved, field, kind) for kind in ("bilateral", "none"))
        assert_close(disc, half, 1e-10, 1e-18)
        if field == 0:
            assert_close(half, gradient(moved, field, "rotational"), 1e-10, 1e-18)


@jax.jit
def slopes(lens, distance, found):
    """Moments of rays that are known, and their gradient by the lens and the distance."""

    def blur(lens, distance):
        scene = checked_scene(lens, Scene.point(0.1, distance, RGB[:2]))
        spot = moments(lens, scene, Gauss(4, "bilateral"), known(found)).at(lens.sensor)
        xx, yy = spot.covariance[:, 0, 0], spot.covariance[:, 1, 1]
        return jnp.sum(xx + 0.3 * yy) + 0.1 * jnp.sum(spot.mean), (spot.mean, spot.covariance)

    return jax.value_and_grad(blur, (0, 1), has_aux=True)(lens, distance)


@pytest.mark.slow
def test_a_centred_lens_given_zero_tilts_and_decentres_is_the_same():
    """Moments and their gradients by all numbers that both have, to 1e-10."""
    rows = LENS.count + 1
    given = dataclasses.replace(LENS, decentre=jnp.zeros((rows, 2)), tilt=jnp.zeros((rows, 3)))
    distance = jnp.asarray(9000.0)
    points = Gauss(4, "bilateral").points(LENS, None)[0]
    found = search(LENS, checked_scene(LENS, Scene.point(0.1, distance, RGB[:2])), points)
    (_, plain), gradient = slopes(LENS, distance, found)
    (_, general), (by_lens, by_distance) = slopes(given, distance, found)
    assert_close(general, plain, 1e-10, 1e-13)
    assert np.all(np.isfinite(by_lens.tilt)) and np.all(np.isfinite(by_lens.decentre))
    by_lens = dataclasses.replace(by_lens, tilt=None, decentre=None)
    assert_close((by_lens, by_distance), gradient, 1e-10, 1e-18)


@pytest.mark.slow
def test_moments_are_those_of_many_random_rays():
    """As in the paper, with 40,000 rays instead of 256: they agree within 4 standard errors."""
    lens = load_lens("cooke_triplet")
    points, _ = pupil.random_disc(40_000, seed=0)
    hits = np.asarray(
        trace_rays(lens, Scene.point(0.2, 5000.0, [0.53]), points).points[0, :, -1, :2]
    )
    moments = psf_moments(lens, Scene.point(0.2, 5000.0, [0.53]))
    mean, covariance = moments.mean, moments.covariance
    centred = hits - hits.mean(axis=0)
    np.testing.assert_array_less(
        np.abs(hits.mean(axis=0) - mean[0]), 4 * hits.std(axis=0) / np.sqrt(len(hits))
    )
    products = centred[:, :, None] * centred[:, None, :]
    error = 4 * products.std(axis=0) / np.sqrt(len(hits))
    np.testing.assert_array_less(np.abs(products.mean(axis=0) - covariance[0]), error)


@pytest.mark.parametrize("field", [0.0, 0.1])
def test_sensor_polynomial_is_the_traced_moment(field):
    focus = focus_moments(LENS, Scene.point(field, FAR, RGB), 1e-9)
    for sensor in (130.0, 133.0, 133.35, 135.0):
        moments = psf_moments(at(sensor), Scene.point(field, FAR, RGB), 1e-9)
        found = focus.at(sensor)
        assert found.separable and found.covariance.shape == (3, 2, 2)  # diagonal by symmetry
        np.testing.assert_allclose(found.mean, moments.mean, atol=1e-10)
        np.testing.assert_allclose(found.covariance, moments.covariance, rtol=2e-9, atol=1e-13)


@pytest.mark.slow
def test_gradient_of_the_sensor_polynomial_is_the_traced_one():
    """By the whole lens, the distance and the sensor position, to 1e-10; 2.5 mm from the sensor
    position about which the polynomial was made."""
    scene, rule = (LENS, FAR, jnp.array(131.0)), Gauss(4, "bilateral")

    def polynomial(lens, distance, sensor):
        found = focus_moments(lens, Scene.point(0.1, distance, RGB[:2]), sampling=rule).at(sensor)
        return jnp.sum(found.mean) + jnp.sum(jnp.trace(found.covariance, axis1=1, axis2=2))

    def traced(lens, distance, sensor):
        moved = dataclasses.replace(lens, sensor=sensor)
        moments = psf_moments(moved, Scene.point(0.1, distance, RGB[:2]), sampling=rule)
        mean, covariance = moments.mean, moments.covariance
        return jnp.sum(mean) + jnp.sum(jnp.trace(covariance, axis1=1, axis2=2))

    ours = jax.jit(jax.grad(polynomial, argnums=(0, 1, 2)))(*scene)
    wanted = jax.jit(jax.grad(traced, argnums=(0, 1, 2)))(*scene)
    # The position of the sensor is an argument: the lens's sensor only sets the origin.
    assert abs(ours[0].sensor) < 1e-10 * abs(ours[2]) and wanted[0].sensor == 0
    # The polynomial is that of a flat sensor; a curved sensor counts at its own position.
    last = {k: getattr(wanted[0], k)[-1] for k in ("curvature", "conic", "coefficients")}
    bent = {k: getattr(ours[0], k).at[-1].set(v) for k, v in last.items()}
    ours = dataclasses.replace(ours[0], sensor=wanted[0].sensor, **bent), *ours[1:]
    assert_close(ours, wanted, 1e-10, 1e-18)


@pytest.mark.parametrize("degrees", [0.0, 10.0])
def test_a_rule_keeps_the_promised_tolerance(degrees):
    field = np.radians(degrees)
    exact = psf_moments(LENS, Scene.point(field, FAR, RGB), 1e-12).covariance
    size = np.sqrt(np.trace(exact, axis1=1, axis2=2))
    before = 0
    for tolerance in (1e-3, 1e-6, 1e-9):
        order = converged_rule(LENS, Scene.point(field, FAR, RGB), tolerance).order
        got = psf_moments(LENS, Scene.point(field, FAR, RGB), tolerance).covariance
        error = np.max(np.abs(np.sqrt(np.trace(got, axis1=1, axis2=2)) / size - 1))
        assert error <= tolerance and order > before
        before = order


@pytest.mark.slow
def test_one_rule_serves_many_fields_and_distances():
    """It keeps the tolerance of each, and has the order that the most difficult needs and the
    symmetry of all."""
    fields, distances = [[0.0, 0.0], [0.0, np.radians(10)]], (FAR, 5000.0)
    rule = converged_rule(LENS, Scene.grid(fields, distances, RGB), 1e-6)
    assert rule.symmetry == "bilateral" and symmetry_of(LENS, [*fields, [0.1, 0.0]]) == "none"
    alone = [converged_rule(LENS, Scene.grid(fields[1], far, RGB), 1e-6) for far in distances]
    assert rule == max(alone, key=lambda one: one.order)
    for field in fields:
        for far in distances:
            exact = psf_moments(LENS, Scene.point(field, far, RGB), 1e-11).covariance
            got = psf_moments(LENS, Scene.point(field, far, RGB), sampling=rule).covariance
            size, found = (np.sqrt(np.trace(a, axis1=1, axis2=2)) for a in (exact, got))
            np.testing.assert_allclose(found, size, rtol=1e-6)
    with pytest.raises(ValueError, match=r"field: expected one angle or two, got shape \(3,\)"):
        converged_rule(LENS, Scene.point([0.0, 0.1, 0.2], FAR, RGB))


def test_tolerance_holds_at_any_sensor_position():
    """Rays traced with the sensor 3 mm out of focus, where the spot is 30 times larger."""
    lens = at(130.0)
    exact = focus_moments(lens, Scene.point(0.0, FAR, RGB), 1e-12)
    for tolerance in (1e-3, 1e-6, 1e-9):
        ours = focus_moments(lens, Scene.point(0.0, FAR, RGB), tolerance)
        for sensor in (130.0, 133.3, 133.37, 133.45):
            got, wanted = (np.sqrt(m.at(sensor).covariance[:, 0, 0]) for m in (ours, exact))
            np.testing.assert_allclose(got, wanted, rtol=tolerance)
    focus, there = (
        f(lens, Scene.point(0.0, FAR, RGB)) for f in (converged_focus_rule, converged_rule)
    )
    assert focus.order > there.order


@pytest.mark.slow
def test_slow_convergence_is_said():
    """The beam ends at total internal reflection, not at an aperture."""
    faces = [
        {"radius": "inf", "thickness": 8.0, "glass": "N-BK7", "semi_diameter": 10.0, "stop": True},
        {"radius": -12.0},
    ]
    ball = load_lens({"surfaces": faces, "sensor": 30.0})
    with pytest.warns(UserWarning, match="converged to .* only.* does the edge of the beam fail"):
        found = psf_moments(ball, Scene.point(0.0, np.inf, 0.55), 1e-9)
    edge = 12 / ball.index(np.array([0.55]))[1]  # at the critical angle of incidence
    np.testing.assert_allclose(found.throughput, (edge / 10) ** 2, rtol=0.05)


def test_inside_a_trace_the_rule_must_be_given():
    for transform in (jax.jit, jax.vmap, lambda f: jax.jit(jax.grad(f))):
        with pytest.raises(ValueError, match="sampling=drt_jax.converge"):
            transform(
                lambda s: jnp.sum(psf_moments(at_traced(s), Scene.point(0.0, FAR, RGB)).covariance)
            )(jnp.array([133.0]) if transform is jax.vmap else 133.0)
    with pytest.raises(ValueError, match="symmetry_of: needs known numbers"):
        jax.jit(lambda field: symmetry_of(LENS, field))(0.1)


@pytest.mark.parametrize("symmetry, field", [("rotational", 0.05), ("bilateral", (0.05, 0.05))])
def test_a_rule_of_a_part_of_the_pupil_is_not_used_where_it_does_not_stand_for_all(symmetry, field):
    """A ValueError if the field is known; otherwise a throughput of 0."""
    rule = drt_jax.Gauss(2, symmetry)
    with pytest.raises(ValueError, match="the rule is made for"):
        psf_moments(LENS, Scene.point(field, FAR, RGB), sampling=rule)
    found = jax.jit(lambda f: psf_moments(LENS, Scene.point(f, FAR, RGB), sampling=rule))(
        jnp.array(field)
    )
    assert np.all(found.throughput == 0) and not np.any(np.isnan(found.covariance))


def at_traced(sensor):
    return dataclasses.replace(LENS, sensor=sensor)


def size(lens, sampling):
    """Spot size of the green wavelength in um, and throughput; by the call of the README."""
    found = psf_moments(lens, Scene.point(0.0, FAR, RGB), sampling)
    return 1e3 * jnp.sqrt(found.covariance[1, 0, 0]), found


whole = jax.jit(jax.value_and_grad(size, has_aux=True))


def test_an_eager_gradient_is_that_of_a_program_and_of_differences():
    lens, rule = at(133.0), converged_rule(at(133.0), Scene.point(0.0, FAR, RGB), 1e-9)
    (value, _), inside = whole(lens, rule)
    (other, _), eager = jax.value_and_grad(lambda lens: size(lens, 1e-9), has_aux=True)(lens)
    np.testing.assert_allclose(value, other, rtol=1e-9)
    assert_close(eager, inside, 1e-7, 1e-9)  # another rule, from the tolerance
    for leaf, k in (("curvature", 2), ("thickness", 5), ("conic", 6), ("semi_diameter", 5)):
        h = 1e-5 * (abs(float(getattr(lens, leaf)[k])) + 1e-2)
        shift = lambda s: dataclasses.replace(  # noqa: E731
            lens, **{leaf: getattr(lens, leaf).at[k].add(s)}
        )
        difference = (whole(shift(h), rule)[0][0] - whole(shift(-h), rule)[0][0]) / (2 * h)
        np.testing.assert_allclose(getattr(inside, leaf)[k], difference, rtol=3e-6, atol=1e-9)


@pytest.mark.slow
def test_no_failing_lens_looks_good():
    """Outside of a trace an error; inside, throughput = 0, an infinite covariance, and derivatives
    of 0."""
    rule = converged_rule(at(133.0), Scene.point(0.0, FAR, RGB), 1e-9)
    blocked = dataclasses.replace(LENS, semi_diameter=LENS.semi_diameter.at[0].set(1e-3))
    with pytest.raises(ValueError, match="no ray at 0.6 um reaches the sensor"):
        psf_moments(blocked, Scene.point(0.0, FAR, RGB), sampling=rule)
    (value, found), gradient = whole(blocked, rule)
    assert np.isinf(value) and np.all(found.throughput == 0)
    assert np.all(np.isinf(np.diagonal(found.covariance, 0, 1, 2)))
    assert all(np.all(a == 0) for a in jax.tree.leaves(gradient))


def test_bad_requests():
    with pytest.raises(ValueError, match="sampling: expected a tolerance between 0 and 1"):
        psf_moments(LENS, Scene.point(0.0, jnp.inf, RGB), sampling=2.0)
    with pytest.raises(ValueError, match="order: expected a whole number from 1 to 42, got 43"):
        Gauss(43, "bilateral")
    with pytest.raises(ValueError, match="0.1 um"):
        psf_moments(LENS, Scene.point(0.0, jnp.inf, [0.1]))


def test_a_lens_fixed_inside_jit_is_a_known_scene():
    """Its rule is found, and the search for it is no part of the program."""
    lens = at(133.0)
    scaled = jax.jit(lambda s: s * psf_moments(lens, Scene.point(0.0, FAR, RGB), 1e-9).covariance)
    assert "while" not in str(jax.make_jaxpr(scaled)(1.0))
    wanted = 2 * psf_moments(lens, Scene.point(0.0, FAR, RGB), 1e-9).covariance
    np.testing.assert_allclose(scaled(2.0), wanted, rtol=1e-12)
