"""Transfer functions, Strehl ratios and Zernike coefficients: closed forms, other programs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Clipped, Gauss, load_lens
from drt_jax.image.coefficients import fringe_terms

COOKE = load_lens("cooke_triplet")
WAVES = (0.6, 0.53, 0.48)
RULE = Gauss(8, "bilateral")
# A paraboloid of f/50: a perfect image, its pupil even in direction cosines to 1e-4.
MIRROR = {
    "surfaces": [
        {"curvature": 0, "thickness": 100.0, "semi_diameter": 1.0, "stop": True},
        {"radius": -200, "conic": -1, "mirror": True, "thickness": -100.0},
    ]
}
APERTURE, WAVE = 1 / np.hypot(1, 100 - 1 / 400), 0.5
LIMIT = 2 * APERTURE / (WAVE * 1e-3)
# P10: the circle at .1, .25, .5, .75, .9 of the limit; the annulus of 0.612 at the same.
PARTS = np.array([0.0, 0.1, 0.25, 0.5, 0.75, 0.9, 1.0, 1.1])
CIRCLE = [0.8728885715695383, 0.6850376424742927, 0.3910022189557706, 0.14429361281438743]
CIRCLE = [1, *CIRCLE, 0.037386073468498655, 0, 0]
ANNULUS = [0.672741897596168, 0.2734419333643833, 0.15954292807930207, 0.18696185734888282]
# P01, and the Zernike coefficients that OpticStudio 25.1.1 prints.
P01 = {
    "surfaces": [
        {"curvature": 0, "thickness": 0.0, "semi_diameter": 1.0, "stop": True},
        {"radius": 20.0, "index": 1.5, "thickness": 1.0},
        {"radius": -20.0, "thickness": 19.792},
    ]
}
PRINTED = {1: -0.01473686, 4: 0.00031809, 11: 0.00684048, 22: 3.01e-06}


@pytest.mark.parametrize("cells, accuracy", [(64, 5e-5), (192, 1e-5)])
def test_the_transfer_function_of_a_perfect_circle(cells, accuracy):
    found = drt_jax.transfer(
        load_lens(MIRROR), 0.0, np.inf, WAVE, PARTS * LIMIT, rule=RULE, cells=cells
    )
    for way in range(2):
        np.testing.assert_allclose(found.mtf[0, way], CIRCLE, rtol=0, atol=accuracy)
    np.testing.assert_allclose(found.limit, found.mtf, rtol=0, atol=1e-6)


def test_defocus_and_strehl():
    """|OTF| of a defocused circle by Hopkins (Proc. R. Soc. A 231, 91 (1955)), here summed over the
    common area of two pupils; the Strehl ratio is sinc^2 of the waves at the edge."""
    lens = load_lens(MIRROR)
    side = (np.arange(2000) + 0.5) / 1000 - 1
    x, y = np.meshgrid(side, side)
    edges, parts = np.array([0.25, 0.5, 1.0]), np.array([0.1, 0.3, 0.6])
    steps = edges * WAVE * 1e-3 / (1 - np.sqrt(1 - APERTURE**2))
    given = lens, 0.0, np.inf, WAVE, parts * LIMIT
    found = drt_jax.transfer(*given, focus=steps, rule=RULE, cells=128)  # through focus
    assert found.mtf.shape == (1, 3, 2, 3)
    for k, (edge, focus) in enumerate(zip(edges, steps)):
        moved = dataclasses.replace(lens, sensor=lens.sensor + focus)
        ratio = drt_jax.strehl(moved, 0.0, np.inf, WAVE, RULE)
        np.testing.assert_allclose(ratio, np.sinc(edge) ** 2, rtol=0, atol=2e-4)
        for part, ours in zip(parts, found.mtf[0, k, 0]):
            both = (np.hypot(x, y + part) < 1) & (np.hypot(x, y - part) < 1)
            waves = np.cos(2 * np.pi * edge * 4 * y[both] * part)
            wanted = abs(np.sum(waves)) / np.sum(np.hypot(x, y) < 1)
            np.testing.assert_allclose(ours, wanted, rtol=0, atol=5e-4)


def test_the_limit_of_short_wavelengths_is_that_of_rays():
    """And the rays' is the mean over many traced ones."""
    fields, frequencies = [0.0, 0.2], np.linspace(0, 20, 5)
    scene = fields, np.inf, 0.55, frequencies
    rays = drt_jax.transfer(COOKE, *scene, "rays", rule=RULE, cells=96)
    points, weights = drt_jax.pupil.disc(30, 60)
    for k, field in enumerate(fields):
        traced = drt_jax.trace_rays(COOKE, field, np.inf, 0.55, points)
        hits = np.asarray(traced.points)[0, :, -1, :2]
        hits = hits - weights @ hits
        for way, place in enumerate((hits[:, 1], hits[:, 0])):
            wanted = np.exp(-2j * np.pi * np.outer(frequencies, place)) @ weights
            np.testing.assert_allclose(rays.otf[k, way], wanted, rtol=0, atol=1e-3)
    np.testing.assert_allclose(rays.limit, 1)


@pytest.mark.slow
def test_colours_add_up_about_one_point():
    """Lateral colour costs contrast: the sum of each wavelength's own, turned by where its light
    is."""
    frequencies = np.linspace(0, 100, 6)
    weights = np.array([1.0, 2.0, 1.5])
    found = drt_jax.transfer(
        COOKE, 0.2, np.inf, WAVES, frequencies, rule=RULE, wavelength_weights=weights
    )
    share = weights / weights.sum()
    spots = [drt_jax.spot_diagram(COOKE, 0.2, np.inf, w, RULE).centroid[0, 1] for w in WAVES]
    middle = share @ np.array(spots)
    wanted = 0
    for part, wave, spot in zip(share, WAVES, spots):
        one = drt_jax.transfer(COOKE, 0.2, np.inf, wave, frequencies, rule=RULE).otf[0, 0]
        wanted += part * np.asarray(one) * np.exp(-2j * np.pi * frequencies * float(spot - middle))
    np.testing.assert_allclose(found.otf[0, 0], wanted, rtol=0, atol=2e-6)


def test_the_zernike_coefficients_that_opticstudio_prints():
    lens = load_lens(P01)
    found = np.asarray(drt_jax.zernike_standard(lens, 0.0, np.inf, 0.543))[0, 0]
    wanted = np.zeros(37)
    for term, value in PRINTED.items():
        wanted[term - 1] = value
    np.testing.assert_allclose(found, wanted, rtol=0, atol=5.1e-9)
    rms = np.sqrt(np.sum(found[1:] ** 2))
    np.testing.assert_allclose(rms, 0.00684787, rtol=0, atol=5.1e-9)
    ratio = drt_jax.strehl(lens, 0.0, np.inf, 0.543, RULE)
    np.testing.assert_allclose(ratio, 0.998, atol=6e-4)
    np.testing.assert_allclose(ratio, np.exp(-((2 * np.pi * rms) ** 2)), atol=1e-4)


@pytest.mark.slow
def test_fringe_coefficients():
    """The same wavefront: terms of n, m are sqrt(n + 1) or sqrt(2 n + 2) times Noll's; the order as
    it is printed."""
    terms = fringe_terms()
    order = [(0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0), (3, 3)]
    assert terms[:10] == order and terms[15] == (6, 0) and terms[24] == (8, 0)
    assert len(terms) == 37 and terms[35:] == [(10, 0), (12, 0)]
    fringe = np.asarray(drt_jax.zernike_fringe(COOKE, 0.2, np.inf, 0.55))[0, 0]
    standard = np.asarray(drt_jax.zernike_standard(COOKE, 0.2, np.inf, 0.55, 91))[0, 0]
    np.testing.assert_allclose(fringe[3], np.sqrt(3) * standard[3], rtol=1e-6)
    np.testing.assert_allclose(fringe[8], np.sqrt(5) * standard[10], rtol=1e-6)
    np.testing.assert_allclose(fringe[7], np.sqrt(8) * standard[6], rtol=1e-6)  # coma along y


@pytest.mark.slow
def test_no_light_no_contrast():
    rule = Clipped(6, "bilateral")

    @jax.jit
    def both(lens):
        def total(lens):
            found = drt_jax.transfer(
                lens, jnp.array([0.1, 1.55]), np.inf, 0.55, jnp.array([0.0, 5.0]), rule=rule
            )
            ratio = drt_jax.strehl(lens, jnp.array([0.1, 1.55]), np.inf, 0.55, rule)
            return jnp.sum(found.mtf) + jnp.sum(ratio), (found, ratio)

        return jax.grad(total, has_aux=True)(lens)

    slope, (found, ratio) = both(load_lens("singlet"))
    assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves((slope, found, ratio)))
    np.testing.assert_allclose(found.mtf[0, :, 0], 1, rtol=1e-12)
    assert np.all(found.otf[1] == 0) and np.all(found.limit[1] == 0) and ratio[1, 0] == 0


@pytest.mark.slow
def test_derivatives_by_lens_numbers():
    """Reverse mode against central differences."""
    fields, frequencies = jnp.array([0.15]), jnp.array([20.0])

    @jax.jit
    def values(lens):
        parts = [
            drt_jax.transfer(lens, fields, np.inf, WAVES, frequencies, model, rule=RULE).mtf
            for model in ("waves", "rays")
        ]
        terms = drt_jax.zernike_standard(lens, fields, np.inf, 0.55, 11)
        ratio = drt_jax.strehl(lens, jnp.array([0.0]), np.inf, 0.55, RULE)
        return jnp.concatenate([jnp.ravel(a) for a in (*parts, terms, ratio)])

    slopes = jax.jit(jax.jacrev(values))(COOKE)
    for name, row, step in (("curvature", 2, 1e-7), ("thickness", 1, 1e-5)):
        array = getattr(COOKE, name)
        high, low = (
            values(dataclasses.replace(COOKE, **{name: array.at[row].add(s * step)}))
            for s in (1, -1)
        )
        ours, wanted = getattr(slopes, name)[:, row], (high - low) / (2 * step)
        np.testing.assert_allclose(ours, wanted, rtol=2e-4, atol=2e-5 * np.max(np.abs(wanted)))
