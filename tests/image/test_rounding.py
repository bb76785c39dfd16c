"""float32, JAX's default: results are right, or there is a warning."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design
from drt_jax.image import rounding
from drt_jax.image.beam import beam_rule
from drt_jax.image.cover import cover
from drt_jax.lens.scene import checked_scene

from .test_psf_model import beam_of

REMEDY = r'in float32 path differences may be wrong by .* waves RMS.*"jax_enable_x64", True'
GREEN = (0.55,)


def single(lens):
    return jax.tree.map(lambda a: a.astype(jnp.float32), drt_jax.load_lens(lens))


@pytest.mark.slow
def test_a_telescope_of_metres_is_told_a_camera_is_right():
    """The estimate of rounding compared with path differences in float64: the singlet, 1e-4 waves,
    gives no warning; Hubble, 1e-2 waves, does."""
    pupil = drt_jax.pupil.sobol_disc(48)[0]
    for name, field, loud in (("singlet", 0.1, False), ("hubble", 0.0005, True)):
        exact = drt_jax.wavefront(drt_jax.load_lens(name), Scene.point(field, np.inf, GREEN), pupil)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            found = drt_jax.wavefront(single(name), Scene.point(field, np.inf, GREEN), pupil)
        assert [bool(said)] == [loud] and found.opd.dtype == np.float32
        good = (np.asarray(exact.status) == 0) & (np.asarray(found.status) == 0)
        error = np.std((np.asarray(found.opd) - np.asarray(exact.opd))[good])
        told = rounding.path_rounding(
            single(name), [checked_scene(single(name), Scene.point(field, np.inf, GREEN))]
        )
        assert 0.3 * error < told < 3 * error and (told > 1e-3) == loud
        assert not loud or (len(said) == 1 and said[0].filename == __file__)


@pytest.mark.slow
def test_strehl_of_hubble():
    """1 on the axis; float32 once gave 0.008 without a warning."""
    with pytest.warns(UserWarning, match=REMEDY):
        found = drt_jax.strehl(single("hubble"), Scene.radians(jnp.zeros(1), np.inf, GREEN))
    np.testing.assert_allclose(found, 1, atol=0.02)


def test_no_light_comes_from_far_beside_the_rays():
    """Polynomials extrapolate, and come back to values that the stop seems to pass, in cells of a
    grid of directions three times as wide as the cone of 0.1."""
    beam, cells, step = beam_of(1.0), 30, 0.02
    axes = jnp.zeros((2, 1)), jnp.full((2, 1), step)
    stop = jnp.zeros((2, 1, cells, cells))
    inside = np.asarray(cover(None, beam, stop, None, beam.direction[:2], axes)[0][0])
    side = (np.arange(cells) - (cells - 1) / 2) * step
    radius = np.hypot(*np.meshgrid(side, side))
    assert np.all(inside[radius < 0.1] == 1) and np.all(inside[radius > 0.1 + 2 * step] == 0)


@pytest.mark.slow
def test_strehl_of_a_phone_at_a_slant():
    """32.2 degrees: 0.644 in float64; once 0.03, by light far from the rays, without a warning."""
    field, rule = jnp.array([np.radians(32.2)], jnp.float32), drt_jax.Gauss(8, "bilateral")
    found = drt_jax.strehl(
        single("phone"),
        Scene.radians(field, np.inf, GREEN),
        sampling=drt_jax.Sampling.of("waves", rule, 64),
    )
    np.testing.assert_allclose(found, 0.644, atol=5e-3)


@pytest.mark.slow
def test_rounding_of_a_high_image_is_told():
    """At 67 degrees hits 235 mm high are rounded by 0.29 of 2^-16 mm RMS, and paths by nearly as
    much: 0.0074 waves. The error of Strehl ratios was 0.02, without a warning."""
    lens = single("hypergon_100mm")
    scene = checked_scene(lens, Scene.point(np.radians(67.0), np.inf, GREEN))
    told = [rounding.path_rounding(lens, [scene], of_beams) for of_beams in (False, True)]
    by_hand = 0.29 * 2.0**-16 * np.sin(np.radians(67)) / 0.55e-3
    assert told[0] < 1e-3 and 0.5 * by_hand < told[1] < 2 * by_hand


@pytest.mark.slow
def test_float32_stays():
    """In a process that also has float64, dtypes follow the lens, and nothing is promoted. Traced,
    not compiled; one radius represents all azimuths."""
    lens, rule = single("hubble"), drt_jax.Clipped(6, "rotational")
    light = drt_jax.Sampling("waves", beam_rule(8, "rotational", rule), 32)

    def both(lens):
        ratio = drt_jax.strehl(lens, Scene.radians(jnp.zeros(1), jnp.inf, GREEN), rule)
        return ratio, drt_jax.psf(lens, Scene.point(0.0, jnp.inf, GREEN), 0.01, 5, sampling=light)

    found = jax.tree.leaves(jax.eval_shape(both, lens))
    assert {a.dtype for a in found} == {np.dtype("float32")}


@pytest.mark.slow
def test_a_focus_that_rounding_moves_is_told():
    """The shift is 0.09 of the depth of focus for a telescope; there is no warning for a camera."""
    remedy = r'in float32 the focus may be wrong by 9e-02 of its depth.*"jax_enable_x64", True'
    with pytest.warns(UserWarning, match=remedy) as said:
        drt_jax.field_curvature(
            single("ritchey_chretien"), Scene.radians(jnp.zeros(1), np.inf, GREEN)
        )
    with pytest.warns(UserWarning, match=remedy) as more:
        drt_jax.axial_colour(single("ritchey_chretien"), Scene.point(0.0, np.inf, GREEN))
    with pytest.warns(UserWarning, match=remedy) as solved:
        solve = design.Solve("paraxial_focus", wavelengths=GREEN)
        design.Variables.from_lens(
            single("ritchey_chretien"), ["sensor", "curvature"], solves=[solve]
        )
    assert {one[0].filename for one in (said, more, solved)} == {__file__}
    drt_jax.field_curvature(single("cooke_triplet"), Scene.radians(jnp.zeros(1), np.inf, GREEN))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, pixel, loud", [("microscope_objective", 5e-4, True), ("double_gauss", 2.2e-3, False)]
)
def test_kernels_of_rays_that_rounding_spoils_are_told(name, pixel, loud):
    """At Airy's radius the error is 6e-3 for a microscope objective, and 5e-5 for a lens with a
    large spot, although hits of both are rounded by more than 1e-2 of a pixel."""
    assert rounding.hit_rounding(single(name)) > 0.01 * pixel
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        drt_jax.converge(
            drt_jax.psf, single(name), Scene.point(0.0, np.inf, GREEN), pixel, 15, "rays"
        )
    assert any("in float32 kernels may be wrong" in str(one.message) for one in said) == loud


@pytest.mark.slow
def test_a_tolerance_that_rounding_spoils_is_refused():
    """If it is given; without a tolerance there is a warning, see above."""
    small, scene = single("microscope_objective"), Scene.point(0.0, np.inf, GREEN)
    remedy = (
        'sampling: in float32 {} may be wrong by .*"jax_enable_x64", True.*leave the tolerance out'
    )
    with pytest.raises(ValueError, match=remedy.format("kernels")):
        drt_jax.psf(small, scene, 5e-4, 15, "rays", 1e-3)
    with pytest.raises(ValueError, match=remedy.format("contrast")):
        drt_jax.strehl(single("hubble"), scene, 1e-3)
    double = drt_jax.load_lens("microscope_objective")
    assert drt_jax.psf(double, scene, 5e-4, 15, "rays", 1e-3).kernel.dtype == np.float64


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["rays", "kernel", "contrast", "energy"])
def test_no_product_is_rounded_by_a_gpu(answer):
    """GPUs round the factors of float32 products of matrices to 10 bits unless a program requests
    more precision: the error of the refractive index would be 5e-4."""
    waves, rule = jnp.array([0.5, 0.6]), drt_jax.Gauss(4, "bilateral")
    pupil, field = jnp.asarray(drt_jax.pupil.sobol_disc(5000)[0]), jnp.array([0.1])
    model = drt_jax.Sampling("waves", beam_rule(6, "bilateral"), 32)
    of = {
        "rays": lambda lens: drt_jax.trace_rays(lens, Scene.point(0.1, np.inf, waves), pupil).path,
        "kernel": lambda lens: (
            drt_jax.psf(lens, Scene.point(0.1, np.inf, waves), 4e-3, 9, sampling=model).kernel
        ),
        "contrast": lambda lens: (
            drt_jax.transfer(
                lens,
                Scene.radians(field, np.inf, waves),
                jnp.array([30.0]),
                sampling=drt_jax.Sampling.of("waves", rule, 32),
            ).mtf
        ),
        "energy": lambda lens: drt_jax.encircled_energy(
            lens,
            Scene.radians(field, np.inf, waves),
            jnp.array([0.01]),
            sampling=drt_jax.Sampling.of("waves", rule, 32),
        ),
    }[answer]
    gradient = jax.jit(jax.grad(lambda lens: jnp.sum(of(lens))))
    text = gradient.lower(drt_jax.load_lens("cooke_triplet")).as_text()
    products = [line for line in text.splitlines() if "dot_general" in line]
    assert products and all("[HIGHEST, HIGHEST]" in line for line in products)
