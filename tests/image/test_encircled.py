"""Encircled energy compared with closed forms and counted rays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j0, j1

import drt_jax
from drt_jax import Gauss, Scene, load_lens

from .test_transfer import APERTURE, MIRROR, RULE, WAVE

LENS = load_lens(MIRROR)
# Radii in wavelength / (2 NA) that P10 names: the first two zeros of Airy's pattern.
ZEROS = np.array([1.2196698912665045, 2.2331306]) * WAVE * 1e-3 / (2 * APERTURE)


@pytest.mark.slow
def test_airys_pattern():
    """P10, and 1 - J0^2 - J1^2 at other radii."""
    some = np.linspace(0, 6e-2, 7)
    radii = np.concatenate([ZEROS, some])
    found = np.asarray(
        drt_jax.encircled_energy(LENS, Scene.radians([0.0], np.inf, WAVE), radii, sampling=RULE)
    )[0]
    printed = [0.8377848691733143, 0.9099305350856731]
    np.testing.assert_allclose(found[:2], printed, rtol=0, atol=1e-4)
    v = 2 * np.pi * some * APERTURE / (WAVE * 1e-3)
    np.testing.assert_allclose(found[2:], 1 - j0(v) ** 2 - j1(v) ** 2, rtol=0, atol=3e-4)


@pytest.mark.slow
def test_an_even_disc_of_rays():
    """For the paraboloid out of focus, a ray of the height h is at d h / (f - h^2 / (4 f)), f =
    100."""
    step, f = 1.0, 100.0
    place = lambda h: step * h / (f - h**2 / (4 * f))  # noqa: E731
    heights = np.array([0.0, 0.1, 0.3, 0.5, 0.8, 0.95, 1.1, 3.0])
    given = place(heights), "rays", np.array([-step, step]), RULE
    found = np.asarray(drt_jax.encircled_energy(LENS, Scene.point(0.0, np.inf, WAVE), *given))
    wanted = np.broadcast_to(np.minimum(heights**2, 1), found.shape)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=3e-3)
    assert np.all(found[:, 0] == 0)
    np.testing.assert_allclose(found[:, -1], 1, rtol=1e-12)


@pytest.mark.slow
def test_waves_come_to_counted_rays_and_slopes_to_differences():
    """Off axis in the triplet, where aberrations are larger than diffraction."""
    lens, field, rule = load_lens("cooke_triplet"), jnp.array([0.2]), Gauss(8, "bilateral")
    radii = jnp.array([5e-3, 1e-2, 2e-2])
    points, weights = drt_jax.pupil.disc(60, 120)
    hits = np.asarray(drt_jax.trace_rays(lens, Scene.point(0.2, np.inf, 0.55), points).points)[
        0, :, -1, :2
    ]
    far = np.hypot(*(hits - weights @ hits).T)
    counted = [weights @ (far < r) for r in np.asarray(radii)]

    @jax.jit
    def energy(lens):
        return jnp.stack(
            [
                drt_jax.encircled_energy(
                    lens,
                    Scene.radians(field, np.inf, 0.55),
                    radii,
                    model,
                    sampling=drt_jax.Sampling.of(model, rule, 96),
                )[0]
                for model in ("rays", "waves")
            ]
        )

    rays, waves = energy(lens)
    np.testing.assert_allclose(rays, counted, rtol=0, atol=5e-3)
    np.testing.assert_allclose(waves, counted, rtol=0, atol=5e-2)
    slopes = jax.jit(jax.jacrev(energy))(lens).thickness[..., 1]
    moved = (
        energy(dataclasses.replace(lens, thickness=lens.thickness.at[1].add(s)))
        for s in (1e-5, -1e-5)
    )
    high, low = moved
    wanted = (high - low) / 2e-5
    np.testing.assert_allclose(slopes, wanted, rtol=1e-3, atol=1e-4 * np.max(np.abs(wanted)))
