"""Spots, throughput and illumination over the field, compared with closed forms, moments and random
rays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import ConvexHull

import drt_jax
from drt_jax import Clipped, Gauss, Pattern, Scene, design, load_lens, pupil
from drt_jax.design import field_rays
from drt_jax.design.problem import trace_fields
from drt_jax.image import spots
from drt_jax.lens.scene import checked_scene

from ..known import check_slopes, freed

WAVES = (0.6, 0.53, 0.48)
COOKE = freed(load_lens("cooke_triplet"))
# The triplet behind a rim that vignettes its oblique beams.
RIM = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(6.5))
ANGLES = np.array([0.1, 0.2, 0.3])
SMALL = Gauss(4, "none")
SCENE = Scene.radians(ANGLES, np.inf, WAVES)


@pytest.fixture(scope="module")
def rules():
    """Rules of the triplet, without and with vignetting."""
    return [drt_jax.converge(drt_jax.spot_diagram, lens, SCENE) for lens in (COOKE, RIM)]


@pytest.mark.slow
def test_cos4_of_a_small_hole():
    """The light of a pixel through a hole is proportional to the fourth power of the cosine."""
    plate = [{"curvature": 0, "index": 1.5, "thickness": 0.1}, {"curvature": 0, "thickness": 1.0}]
    stop = {"curvature": 0, "thickness": 30.0, "semi_diameter": 0.003, "stop": True}
    lens, fields = load_lens({"surfaces": [*plate, stop]}), np.array([0.0, 0.2, 0.5, 1.0])
    light = drt_jax.relative_illumination(
        lens, Scene.radians(fields, np.inf, 0.55), SMALL, "sensor"
    )
    np.testing.assert_allclose(light[:, 0], np.cos(fields) ** 4, rtol=1e-7)
    area = drt_jax.solid_angle(lens, Scene.radians(fields, np.inf, 0.55), SMALL, "sensor")[0]
    np.testing.assert_allclose(area, np.pi * (0.003 / 30) ** 2, rtol=1e-7)


@pytest.mark.slow
def test_the_cone_of_a_ball():
    """A ball with the stop at its centre focuses on a sphere about the centre. A beam has the
    projected width of the stop, cos(field), and a flat sensor receives cos^2."""
    glass = {"index": 1.5, "thickness": 10.0}
    stop = {"curvature": 0, "semi_diameter": 0.003, "stop": True}
    ball = [{"radius": 10.0} | glass, stop | glass, {"radius": -10.0, "thickness": 5.0}]
    fields = np.array([0.2, 0.5, 1.0])
    light = drt_jax.relative_illumination(
        load_lens({"surfaces": ball}), Scene.radians(fields, np.inf, 0.55), SMALL
    )
    np.testing.assert_allclose(light[:, 0], np.cos(fields) ** 2, rtol=1e-7)


@pytest.mark.slow
def test_a_perfect_cone():
    """n = 1.5, R = 10, k = -1/n^2 has its focus at 30 mm, for any aperture: the cone is pi sin^2 of
    the angle of the rim, and the Airy radius 1.22 wavelength / (2 n sin)."""
    stop = {"curvature": 0, "thickness": 5.0, "semi_diameter": 6.0, "stop": True}
    front = {"radius": 10, "conic": -1 / 1.5**2, "index": 1.5, "thickness": 30.0}
    lens = load_lens({"surfaces": [stop, front]})
    depth = 30 - float(drt_jax.sag(lens, 1, 0.0, 6.0))
    sine = 6 / np.hypot(6, depth)
    rule = Gauss(16, "rotational")
    area = drt_jax.solid_angle(lens, Scene.radians([0.0], np.inf, 0.55), rule)
    np.testing.assert_allclose(area, np.pi * sine**2, rtol=1e-10)
    spot = drt_jax.spot_diagram(lens, Scene.radians([0.0], np.inf, 0.55), rule)
    np.testing.assert_allclose(spot.airy_radius, 1.2196698912665 * 0.55e-3 / (3 * sine), rtol=1e-9)
    assert spot.rms[0] < 1e-12 and spot.radius[0] < 1e-12
    np.testing.assert_allclose(
        drt_jax.vignetting(lens, Scene.radians([0.0], np.inf, 0.55), rule), 1, rtol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize("clipped", [False, True], ids=["whole", "clipped"])
def test_spots_are_those_of_the_moments(rules, clipped):
    lens, rule = (COOKE, RIM)[clipped], rules[clipped]
    assert isinstance(rule, (Gauss, Clipped)[clipped])
    spot = drt_jax.spot_diagram(lens, SCENE, rule)
    light = drt_jax.vignetting(lens, SCENE, rule)
    for k, angle in enumerate(ANGLES):
        found = drt_jax.psf_moments(lens, Scene.point(angle, np.inf, WAVES), sampling=rule)
        np.testing.assert_allclose(light[k], found.throughput, rtol=1e-9)
        share = np.asarray(found.throughput / np.sum(found.throughput))
        centroid = share @ np.asarray(found.mean)
        np.testing.assert_allclose(spot.centroid[k], centroid, atol=1e-10)
        beside = np.sum((np.asarray(found.mean) - centroid) ** 2, axis=1)
        square = share @ (np.trace(found.covariance, axis1=1, axis2=2) + beside)
        np.testing.assert_allclose(spot.rms[k], np.sqrt(square), rtol=1e-8)
        point = drt_jax.image_point(lens, Scene.point(angle, np.inf, WAVES))[1]
        np.testing.assert_allclose(spot.chief[k], point, atol=1e-12)
        apart = np.sum((centroid - point) ** 2)
        np.testing.assert_allclose(spot.rms_chief[k], np.sqrt(square + apart), rtol=1e-8)


@pytest.mark.slow
def test_the_light_of_random_rays(rules):
    """The area of the convex hull of the directions that arrive, and the number of rays that do."""
    points = pupil.random_disc(40_000, 1)[0]
    light = drt_jax.solid_angle(RIM, SCENE, rules[1])
    part = drt_jax.vignetting(RIM, SCENE, rules[1])
    for k, angle in enumerate(ANGLES):
        rays = drt_jax.trace_rays(RIM, Scene.point(angle, np.inf, WAVES[0]), points)
        good = np.asarray(rays.status[0]) == 0
        lines = np.asarray(rays.directions)[0, good, -1, :2]
        np.testing.assert_allclose(part[k, 0], np.mean(good), atol=0.01)
        np.testing.assert_allclose(light[k, 0], ConvexHull(lines).volume, rtol=5e-3)
    assert part[-1, 0] < 0.8


@pytest.mark.slow
def test_the_illumination_that_designs_keep():
    """Compared with the operand, by the same rule: cones at one point of the sensor."""
    angles = np.array([0.0, *ANGLES])
    variables = design.Variables.from_lens(COOKE, ["sensor"])
    problem = design.Problem.from_variables(
        variables, ["relative_illumination"], Scene.radians(angles, wavelengths=WAVES), 6
    )
    wanted = field_rays.relative_illumination(COOKE, trace_fields(problem, COOKE))
    rule = Gauss(6, "bilateral")
    found = drt_jax.relative_illumination(
        COOKE, Scene.radians(angles, np.inf, WAVES), rule, "sensor"
    )
    np.testing.assert_allclose(found[:, 1], wanted, rtol=1e-9)


@pytest.mark.slow
def test_geometric_radii_and_pictures(rules):
    """A hexapolar pattern, and the rim of the stop; mirror images of half a pupil."""
    points, weights = pupil.hexapolar(4)
    half = drt_jax.spot_diagram(COOKE, SCENE, rules[0])
    whole = drt_jax.spot_diagram(COOKE, SCENE, Pattern(points, weights))
    count = 2 * rules[0].points(COOKE, None)[1].size
    rim = np.linspace(0, 2 * np.pi, 721)
    circle = np.stack([np.sin(rim), np.cos(rim)], 1)
    for k, angle in enumerate(ANGLES):
        rays = drt_jax.trace_rays(COOKE, Scene.point(angle, np.inf, WAVES), circle)
        hits = np.asarray(rays.points)[:, :, -1, :2]
        far = np.linalg.norm(hits - np.asarray(half.chief[k]), axis=-1).max()
        for found in (half, whole):
            np.testing.assert_allclose(found.radius_chief[k], far, rtol=0.01)
            np.testing.assert_allclose(np.sum(found.weights[k]), 1, rtol=1e-12)
        x = np.sort(np.asarray(half.points)[k, 1, :count, 0])
        np.testing.assert_allclose(x, -x[::-1], atol=1e-15)


@jax.jit
def slopes(lens, fields):
    """Spots and illumination from one bundle of a clipped pupil: ((merit, results), gradient of the
    merit of the last field by the lens)."""
    scene, rule = Scene.radians(fields, np.inf, WAVES[:2]), Clipped(8, "bilateral")
    weights = 1e2, 1e2, 1e4, 3.0, 2.0

    def total(lens):
        light = spots._light(lens, checked_scene(lens, scene).with_axis(), rule, "object")

        def traced(_, seen, *rest):
            return jax.tree.map(lambda a: a[-len(seen.field) :], light)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(spots, "_light", traced)
            found = drt_jax.spot_diagram(lens, scene)
            relative = drt_jax.relative_illumination(lens, scene)
            part = drt_jax.vignetting(lens, scene)
        sizes = found.rms, found.centroid[:, 1], found.airy_radius, relative[:, 1], part[:, 1]
        last = jnp.stack(sizes)[:, -1] * jnp.array(weights)
        last = jnp.where(jnp.isfinite(last), last, 0)
        return jnp.sum(last), (found, relative)

    return jax.value_and_grad(total, has_aux=True)(lens)


@pytest.mark.slow
def test_no_light_is_infinite_and_dark():
    """At 89 degrees; the other field has the same result as alone, and there is no NaN."""
    (_, (spot, light)), slope = slopes(COOKE, jnp.array([0.1, 1.55]))
    assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves((slope, spot, light)))
    assert light[0, 0] > 0.9 and light[1, 0] == 0
    for name in ("rms", "radius", "centroid", "airy_radius"):
        part = np.asarray(getattr(spot, name))
        assert np.all(np.isfinite(part[0])) and np.all(np.isposinf(part[1])), name


@pytest.mark.slow
def test_derivatives_by_lens_numbers():
    """Reverse mode compared with central differences, also by the rim."""
    steps = {"curvature": 1e-8, "thickness": 1e-6, "semi_diameter": 1e-6}
    check_slopes(lambda lens: slopes(lens, jnp.array([0.1, 0.3])), RIM, steps, 1e-5)


def test_clear_errors():
    with pytest.raises(ValueError, match="make the rule outside and pass it on"):
        jax.jit(lambda lens: drt_jax.vignetting(lens, Scene.radians([0.1], np.inf, 0.55)))(COOKE)
    with pytest.raises(ValueError, match="point: expected one of object, sensor, got 'pupil'"):
        drt_jax.solid_angle(COOKE, Scene.radians([0.1], np.inf, 0.55), SMALL, "pupil")
    with pytest.raises(ValueError, match=r"wavelength_weights: expected \(3,\), got \(2,\)"):
        drt_jax.spot_diagram(
            COOKE, Scene.radians([0.1], np.inf, WAVES, wavelength_weights=[1, 2]), SMALL
        )
