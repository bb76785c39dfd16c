"""Afocal lenses: angles instead of heights, a plane instead of the reference sphere; and sensors in
collimated light."""

import dataclasses

import numpy as np
import pytest

import drt_jax
from drt_jax import Gauss, Scene, load_lens

# Mersenne's telescope of confocal paraboloids, f 100 and 25 mm: it has no aberration but the
# curvature of Petzval, 1/25 - 1/100. The stop, of 20 mm, is the primary.
TELESCOPE = {
    "surfaces": [
        {"radius": -200.0, "conic": -1, "mirror": True, "stop": True, "semi_diameter": 10.0},
        {"radius": -50.0, "conic": -1, "mirror": True, "thickness": 100.0},
    ],
    "afocal": True,
}
TELESCOPE["surfaces"][0]["thickness"] = -75.0
POWER, PETZVAL, EXIT = 4, 0.03, 2.5
FIELD, WAVE = 0.002, 0.5
RULE = Gauss(6, "bilateral")
LENS = load_lens(TELESCOPE)
PINHOLE = {
    "surfaces": [
        {"radius": "inf", "semi_diameter": 0.5, "stop": True, "thickness": 100.0},
        {"curvature": 0.0, "mirror": True},
    ],
    "sensor": 0.0,
}


@pytest.mark.slow
def test_the_wavefront_of_a_mersenne_telescope():
    """Light at the angle a leaves as from an image surface with Petzval's curvature, with that
    curvature times a^2 / 2 as vergence; at the edge the wavefront is ahead of the plane by half of
    the vergence times the squared radius."""
    points = [[0.0, 1.0], [1.0, 0.0], [0.0, -1.0], [0.6, 0.0]]
    found = drt_jax.wavefront(LENS, Scene.point(FIELD, np.inf, WAVE), points)
    vergence = (POWER * FIELD) ** 2 * PETZVAL / 2
    wanted = vergence * EXIT**2 / 2 / (WAVE * 1e-3) * np.array([1, 1, 1, 0.36])
    np.testing.assert_allclose(found.opd[0], wanted, rtol=1e-3)
    np.testing.assert_allclose(found.image[0], [0, 1e3 * POWER * FIELD], rtol=1e-5, atol=1e-12)
    # The sensor may stand anywhere in the collimated light.
    moved = dataclasses.replace(LENS, sensor=LENS.sensor + 300.0)
    again = drt_jax.wavefront(moved, Scene.point(FIELD, np.inf, WAVE), points)
    np.testing.assert_allclose(again.opd, found.opd, rtol=1e-3)


@pytest.mark.slow
def test_spots_chief_rays_and_foci_of_a_telescope():
    """In mrad, and foci in 1e-3 dioptre; the angle of a ray differs by the vergence times its
    height."""
    spots = drt_jax.spot_diagram(LENS, Scene.radians([0.0, FIELD], np.inf, WAVE), sampling=RULE)
    vergence = (POWER * FIELD) ** 2 * PETZVAL / 2
    blur = 1e3 * vergence * EXIT / np.sqrt(2)
    np.testing.assert_allclose(spots.rms, [0, blur], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(spots.airy_radius, 0.61 * WAVE / EXIT, rtol=1e-3)
    foci = drt_jax.field_curvature(LENS, Scene.radians([FIELD], np.inf, WAVE))
    np.testing.assert_allclose(foci, -1e6 * vergence * np.ones((2, 1, 1)), rtol=1e-3)
    tangent = drt_jax.distortion(LENS, Scene.radians([FIELD], np.inf, WAVE))
    np.testing.assert_allclose(tangent.focal_length, 1e3 * POWER, rtol=1e-9)
    rays = drt_jax.trace_rays(LENS, Scene.point(FIELD, np.inf, WAVE), [[0.0, 0.0], [0.0, 0.5]])
    up, along = np.asarray(rays.directions)[0, 0, -1, 1:]
    wanted = up / along / (POWER * np.tan(FIELD)) - 1
    np.testing.assert_allclose(tangent.relative, [[wanted]], rtol=1e-6)
    angle = drt_jax.chief_ray_angle(LENS, Scene.radians([FIELD], np.inf, WAVE))
    np.testing.assert_allclose(angle, [[np.arctan2(up, along)]], rtol=1e-9)
    assert rays.points[0, 0, -1, 2] == LENS.sensor  # rays themselves end where they end


@pytest.mark.slow
def test_contrast_of_a_telescope_is_that_of_its_exit_pupil():
    """In cycles/mrad, up to the width of the beam divided by the wavelength."""
    parts = np.array([0.0, 0.2, 0.5, 0.8])
    lines = parts * 2 * EXIT / WAVE
    found = drt_jax.transfer(
        LENS,
        Scene.radians([0.0], np.inf, WAVE),
        lines,
        sampling=drt_jax.Sampling.of("waves", RULE, 64),
    ).mtf[0]
    circle = 2 / np.pi * (np.arccos(parts) - parts * np.sqrt(1 - parts**2))
    np.testing.assert_allclose(found, [circle, circle], rtol=0, atol=5e-5)
    ratio = drt_jax.strehl(
        LENS, Scene.radians([0.0], np.inf, WAVE), sampling=drt_jax.Sampling.of("waves", RULE, 64)
    )
    np.testing.assert_allclose(ratio, 1, rtol=1e-9)


def test_an_afocal_lens_has_no_focus(tmp_path):
    drt_jax.save_lens(LENS, tmp_path / "t.yaml")
    assert load_lens(tmp_path / "t.yaml").afocal
    with pytest.raises(ValueError, match="no sensor position"):
        drt_jax.focus_moments(LENS, Scene.point(0.0, np.inf, WAVE), sampling=RULE)


@pytest.mark.slow
def test_collimated_light_on_a_sensor():
    """A pinhole: light without a lens has the defocus a^2 / (2 R) relative to the sphere about the
    sensor, and the irradiance of Fresnel's zones. One object point has no cone of light."""
    lens, zones = load_lens(PINHOLE), 0.5**2 / (200 * WAVE * 1e-3)
    ratio = drt_jax.strehl(
        lens, Scene.radians([0.0], np.inf, WAVE), sampling=drt_jax.Sampling.of("waves", RULE, 64)
    )
    np.testing.assert_allclose(ratio, np.sinc(zones / 2) ** 2, rtol=0, atol=2e-4)
    given = lens, Scene.radians([0.0, 0.3], np.inf, WAVE), RULE
    with pytest.raises(ValueError, match="point='sensor'"):
        drt_jax.relative_illumination(*given)


def test_the_focal_length_of_an_afocal_lens_is_infinite():
    """A power within rounding counts as 0."""
    for gap in (-75.0, -74.999):
        surfaces = [TELESCOPE["surfaces"][0] | {"thickness": gap}, TELESCOPE["surfaces"][1]]
        found = drt_jax.first_order(load_lens({"surfaces": surfaces}), np.inf, WAVE)
        afocal = gap == -75.0
        for length in (found.focal_length, found.effective_focal_length, found.image_distance):
            assert np.isinf(length[0]) == afocal
    first = {"radius": -2 / 3, "mirror": True, "stop": True, "semi_diameter": 0.1}
    second = {"radius": -2 / 30, "mirror": True, "thickness": 1.0}
    lens = load_lens({"surfaces": [first | {"thickness": -0.3}, second]})
    assert np.isinf(drt_jax.focal_length(lens, WAVE)[0])
