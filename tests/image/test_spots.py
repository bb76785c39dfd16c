"""Spots, throughput and illumination over the field: closed forms, moments, random rays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

import drt_jax
from drt_jax import Clipped, Gauss, Pattern, design, load_lens, pupil
from drt_jax.design import field_rays
from drt_jax.design.problem import trace_fields

WAVES = (0.6, 0.53, 0.48)
COOKE = load_lens("cooke_triplet")
# The triplet behind a rim that cuts its oblique beams.
RIM = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(6.5))
ANGLES = np.array([0.1, 0.2, 0.3])
SMALL = Gauss(4, "bilateral")


def test_cos4_of_a_small_hole():
    """What a pixel collects through a hole falls with the fourth power of the cosine."""
    plate = [{"curvature": 0, "index": 1.5, "thickness": 0.1}, {"curvature": 0, "thickness": 1.0}]
    stop = {"curvature": 0, "thickness": 30.0, "semi_diameter": 0.003, "stop": True}
    lens, fields = load_lens({"surfaces": [*plate, stop]}), np.array([0.2, 0.5, 1.0])
    light = drt_jax.relative_illumination(lens, fields, np.inf, 0.55, SMALL, "sensor")
    np.testing.assert_allclose(light[:, 0], np.cos(fields) ** 4, rtol=1e-7)
    area = drt_jax.solid_angle(lens, 0.0, np.inf, 0.55, SMALL, "sensor")
    np.testing.assert_allclose(area, np.pi * (0.003 / 30) ** 2, rtol=1e-7)


def test_the_cone_of_a_ball():
    """A ball with the stop at its centre focuses on a sphere about it: a pencil as wide as the stop
    is seen, cos(field), which a flat sensor sees as cos^2."""
    glass = {"index": 1.5, "thickness": 10.0}
    stop = {"curvature": 0, "semi_diameter": 0.003, "stop": True}
    ball = [{"radius": 10.0} | glass, stop | glass, {"radius": -10.0, "thickness": 5.0}]
    fields = np.array([0.2, 0.5, 1.0])
    light = drt_jax.relative_illumination(
        load_lens({"surfaces": ball}), fields, np.inf, 0.55, SMALL
    )
    np.testing.assert_allclose(light[:, 0], np.cos(fields) ** 2, rtol=1e-7)


@pytest.mark.parametrize("symmetry", ["rotational", "bilateral", "none"])
def test_a_perfect_cone(symmetry):
    """n = 1.5, R = 10, k = -1/n^2 has its focus at 30 mm, for any aperture: pi sin^2 of the angle
    at which the rim is seen, and the Airy radius 1.22 wavelength / (2 n sin)."""
    stop = {"curvature": 0, "thickness": 5.0, "semi_diameter": 6.0, "stop": True}
    front = {"radius": 10, "conic": -1 / 1.5**2, "index": 1.5, "thickness": 30.0}
    lens = load_lens({"surfaces": [stop, front]})
    depth = 30 - float(drt_jax.sag(lens, 1, 0.0, 6.0))
    sine = 6 / np.hypot(6, depth)
    rule = Gauss(16, symmetry)
    area = drt_jax.solid_angle(lens, 0.0, np.inf, 0.55, rule)
    np.testing.assert_allclose(area, np.pi * sine**2, rtol=1e-10)
    spot = drt_jax.spot_diagram(lens, 0.0, np.inf, 0.55, rule)
    np.testing.assert_allclose(spot.airy_radius, 1.2196698912665 * 0.55e-3 / (3 * sine), rtol=1e-9)
    assert spot.rms[0] < 1e-12 and spot.radius[0] < 1e-12
    np.testing.assert_allclose(drt_jax.vignetting(lens, 0.0, np.inf, 0.55, rule), 1, rtol=1e-12)


@pytest.mark.parametrize("lens", [COOKE, RIM], ids=["whole", "clipped"])
def test_spots_are_those_of_the_moments(lens):
    spot = drt_jax.spot_diagram(lens, ANGLES, np.inf, WAVES)
    light = drt_jax.vignetting(lens, ANGLES, np.inf, WAVES)
    for k, angle in enumerate(ANGLES):
        found = drt_jax.psf_moments(lens, angle, np.inf, WAVES, 1e-8)
        np.testing.assert_allclose(light[k], found.throughput, rtol=1e-6)
        share = np.asarray(found.throughput / np.sum(found.throughput))
        centroid = share @ np.asarray(found.mean)
        np.testing.assert_allclose(spot.centroid[k], centroid, atol=1e-8)
        beside = np.sum((np.asarray(found.mean) - centroid) ** 2, axis=1)
        square = share @ (np.trace(found.covariance, axis1=1, axis2=2) + beside)
        np.testing.assert_allclose(spot.rms[k], np.sqrt(square), rtol=1e-6)
        point = drt_jax.image_point(lens, angle, np.inf, WAVES)[1]
        np.testing.assert_allclose(spot.chief[k], point, atol=1e-12)
        apart = np.sum((centroid - point) ** 2)
        np.testing.assert_allclose(spot.rms_chief[k], np.sqrt(square + apart), rtol=1e-6)


@pytest.mark.slow
def test_the_light_of_random_rays():
    """The area of directions within the hull of those that arrive, and how many do."""
    points = pupil.random_disc(40_000, 1)[0]
    light = drt_jax.solid_angle(RIM, ANGLES, np.inf, 0.55)
    part = drt_jax.vignetting(RIM, ANGLES, np.inf, 0.55)
    for k, angle in enumerate(ANGLES):
        rays = drt_jax.trace_rays(RIM, angle, np.inf, 0.55, points)
        good = np.asarray(rays.status[0]) == 0
        lines = np.asarray(rays.directions)[0, good, -1, :2]
        np.testing.assert_allclose(part[k, 0], np.mean(good), atol=0.01)
        np.testing.assert_allclose(light[k, 0], ConvexHull(lines).volume, rtol=5e-3)
    assert part[-1, 0] < 0.8


@pytest.mark.slow
def test_the_illumination_that_designs_keep():
    """The operand's, of the same rule: cones at one point of the sensor."""
    angles = np.array([0.0, *ANGLES])
    variables = design.Variables.from_lens(COOKE, ["sensor"])
    problem = design.Problem.from_variables(
        variables, ["relative_illumination"], angles, WAVES, rule=6
    )
    wanted = field_rays.relative_illumination(COOKE, trace_fields(problem, COOKE))
    rule = Gauss(6, "bilateral")
    found = drt_jax.relative_illumination(COOKE, angles, np.inf, WAVES, rule, "sensor")
    np.testing.assert_allclose(found[:, 1], wanted, rtol=1e-9)


def test_geometric_radii_and_pictures():
    """A hexapolar pattern, and the rim of the stop; mirror images of half a pupil."""
    points, weights = pupil.hexapolar(4)
    half = drt_jax.spot_diagram(COOKE, ANGLES, np.inf, WAVES, Gauss(6, "bilateral"))
    whole = drt_jax.spot_diagram(COOKE, ANGLES, np.inf, WAVES, Pattern(points, weights))
    rim = np.linspace(0, 2 * np.pi, 721)
    circle = np.stack([np.sin(rim), np.cos(rim)], 1)
    for k, angle in enumerate(ANGLES):
        rays = drt_jax.trace_rays(COOKE, angle, np.inf, WAVES, circle)
        hits = np.asarray(rays.points)[:, :, -1, :2]
        far = np.linalg.norm(hits - np.asarray(half.chief[k]), axis=-1).max()
        for found in (half, whole):
            np.testing.assert_allclose(found.radius_chief[k], far, rtol=0.01)
            np.testing.assert_allclose(np.sum(found.weights[k]), 1, rtol=1e-12)
        x = np.sort(np.asarray(half.points)[k, 1, :84, 0])
        np.testing.assert_allclose(x, -x[::-1], atol=1e-15)


@pytest.mark.slow
def test_no_light_is_infinite_and_dark():
    """Of the singlet at 89 degrees; the other field is as it is alone, and no NaN leaves."""
    lens = load_lens("singlet")
    rule = Clipped(6, "bilateral")
    fields = jnp.array([0.1, 1.55])

    def values(lens, fields):
        spot = drt_jax.spot_diagram(lens, fields, np.inf, 0.55, rule)
        light = drt_jax.relative_illumination(lens, fields, np.inf, 0.55, rule)
        return spot, light

    @jax.jit
    def both(lens):
        def total(lens):
            spot, light = values(lens, fields)
            finite = (jnp.where(jnp.isfinite(a), a, 0) for a in (spot.rms, spot.radius, light))
            return sum(jnp.sum(a) for a in finite), (spot, light)

        return jax.grad(total, has_aux=True)(lens)

    slope, (spot, light) = both(lens)
    assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves((slope, spot, light)))
    assert light[0, 0] > 0.9 and light[1, 0] == 0
    for name in ("rms", "radius", "centroid", "airy_radius"):
        part = np.asarray(getattr(spot, name))
        assert np.all(np.isfinite(part[0])) and np.all(np.isposinf(part[1])), name


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["whole", "clipped"])
def test_derivatives_by_lens_numbers(kind):
    """Reverse mode against central differences, with the rim itself among the numbers."""
    lens = COOKE if kind == "whole" else RIM
    rule = Gauss(6, "bilateral") if kind == "whole" else Clipped(8, "bilateral")
    fields = jnp.array([0.3])

    @jax.jit
    def values(lens):
        spot = drt_jax.spot_diagram(lens, fields, np.inf, WAVES, rule)
        light = drt_jax.relative_illumination(lens, fields, np.inf, WAVES, rule)
        part = drt_jax.vignetting(lens, fields, np.inf, WAVES, rule)
        sizes = 1e2 * spot.rms[0], spot.centroid[0, 1], 1e3 * spot.airy_radius[0]
        return jnp.stack([*sizes, light[0, 1], part[0, 1]])

    slopes = jax.jit(jax.jacrev(values))(lens)
    steps = [("curvature", 2, 1e-7), ("thickness", 1, 1e-5), ("semi_diameter", lens.stop, 1e-5)]
    for name, row, step in (*steps, ("semi_diameter", 0, 1e-5)):
        array = getattr(lens, name)
        high, low = (
            values(dataclasses.replace(lens, **{name: array.at[row].add(s * step)}))
            for s in (1, -1)
        )
        wanted = (high - low) / (2 * step)
        np.testing.assert_allclose(getattr(slopes, name)[:, row], wanted, rtol=1e-5, atol=1e-7)


def test_clear_errors():
    with pytest.raises(ValueError, match="make the rule outside and pass it on"):
        jax.jit(lambda lens: drt_jax.vignetting(lens, 0.1, np.inf, 0.55))(COOKE)
    with pytest.raises(ValueError, match="point: expected one of object, sensor, got 'pupil'"):
        drt_jax.solid_angle(COOKE, 0.1, np.inf, 0.55, SMALL, "pupil")
    with pytest.raises(ValueError, match=r"wavelength_weights: expected \(3,\), got \(2,\)"):
        drt_jax.spot_diagram(COOKE, 0.1, np.inf, WAVES, SMALL, wavelength_weights=[1, 2])
