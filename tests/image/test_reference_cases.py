"""Images compared with closed forms and with listings of OpticStudio."""

import dataclasses

import jax
import numpy as np
import pytest
import yaml

import drt_jax
from drt_jax import Gauss, Scene, load_lens
from drt_jax.image.beam import beam_rule, centroid_and_variances, trace_beam
from drt_jax.lens.scene import checked_scene

WAVE = 0.5
# P11: per axis, mm^2, of a paraboloid f = 50 of semi-diameter 20, out of focus by delta.
VARIANCES = {0.1: 0.00042233607320576864, -1.0: 0.042233607320576856}


@pytest.fixture(scope="module")
def variances():
    """Over the defocus of the sensor, in one program: variances of the moments with their
    derivative, and those of a beam moved to the sensor."""
    surface = {"radius": -100.0, "conic": -1.0, "mirror": True, "thickness": -50.0}
    lens = load_lens({"surfaces": [surface | {"stop": True, "semi_diameter": 20.0}]})
    scene = 0.0, np.inf, WAVE

    def of_moments(step):
        moved = dataclasses.replace(lens, sensor=lens.sensor + step)
        found = drt_jax.psf_moments(
            moved, Scene.point(*scene), sampling=Gauss(24, "bilateral")
        ).covariance[0]
        return found, found

    @jax.jit
    def both(step):
        beam = trace_beam(
            lens, checked_scene(lens, Scene.point(*scene)), beam_rule(20, "bilateral")
        ).refocused(step)
        moved = centroid_and_variances(beam.hits[:, -1], beam.weights)[1]
        slope, found = jax.jacfwd(of_moments, has_aux=True)(step)
        return found, slope, moved

    return both


@pytest.mark.slow
@pytest.mark.parametrize("delta", VARIANCES)
def test_the_exact_moment_of_defocus(variances, delta):
    """P11: a ray meets the sensor at delta h / (f - h^2 / (4 f)); the same for beams that are moved
    to it."""
    wanted = VARIANCES[delta]
    for step in (delta, -delta):  # the light runs backwards; only its size counts
        found, slope, (xx, xy, yy) = variances(step)
        np.testing.assert_allclose(found, wanted * np.eye(2), rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(slope, 2 * wanted / step * np.eye(2), rtol=1e-11, atol=1e-14)
        beam = [xx[0], xy[0], yy[0]]
        np.testing.assert_allclose(beam, [wanted, 0, wanted], rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_the_huygens_psf_that_opticstudio_prints(shared):
    """P04, within the error of OpticStudio's sampling of the edge of the pupil."""
    rows = yaml.safe_load((shared / "psf_cases.yaml").read_text())["cases"]
    case = next(row for row in rows if row["id"].startswith("P04"))
    printed, tolerance = case["reference"], case["tolerance"]
    stop = {"curvature": 0, "thickness": 0.0, "semi_diameter": 1.0, "stop": True}
    front = {"radius": 20.0, "index": 1.5, "thickness": 1.0}
    lens = load_lens({"surfaces": [stop, front, {"radius": -20.0, "thickness": 19.792}]})
    scene, wave = (lens, Scene.point(0.0, np.inf, 0.543)), 0.543e-3
    spacing, size = case["inputs"]["pixel_um"] * 1e-3, 127
    model = drt_jax.Sampling("waves", beam_rule(10, "bilateral"), 128)
    wanted = np.array(printed["profile_along_x_from_centre_pixels_0_to_20"])
    diagonal = np.array(printed["diagonal_from_centre_pixels_0_to_11"])
    pixel = spacing / 3
    found = drt_jax.psf(*scene, pixel, size, sampling=model)
    # Relative to the peak without aberrations, for the cone from the exit pupil.
    pupil = drt_jax.first_order(lens, np.inf, 0.543).exit_pupil
    away = float(lens.sensor - lens.vertices[-2] - pupil.position[0])
    sine = np.sin(np.arctan(float(pupil.semi_diameter[0]) / away))
    light = np.asarray(found.kernel[0]) * wave**2 / (pixel**2 * np.pi * sine**2)
    # A pixel is the mean over its square, larger than the value at its centre by the second
    # derivatives / 24.
    around = sum(np.roll(light, s, a) for s in (-1, 1) for a in (0, 1)) - 4 * light
    light = light - around / 24
    across = light[63, 63::3][: wanted.size]
    down = np.diagonal(light)[63::3][: diagonal.size]
    assert abs(across[0] - printed["strehl_printed"]) < tolerance["strehl"]
    np.testing.assert_allclose(across, wanted, rtol=0, atol=tolerance["intensity_abs"])
    np.testing.assert_allclose(down, diagonal, rtol=0, atol=tolerance["intensity_abs"])
