"""Optiland beside us: its spots agree with ours, its optimisers run; without it, None."""

import dataclasses
import importlib.util
import math

import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax

from . import _optiland

needed = pytest.mark.skipif(
    importlib.util.find_spec("optiland") is None, reason="optiland is not installed"
)
LENS = drt_jax.load_lens("double_gauss")
FREE = (-math.inf, math.inf)


def ours_um(lens, field_deg, distance_mm=math.inf):
    found = drt_jax.psf_moments(
        lens, drt_jax.Scene.degrees(field_deg, distance_mm, _optiland.COLOURS)
    )
    mean, spread = np.asarray(found.mean), np.trace(np.asarray(found.covariance), axis1=1, axis2=2)
    return 1e3 * np.sqrt(np.mean(spread + np.sum((mean - mean.mean(0)) ** 2, axis=1)))


def test_without_optiland_there_is_none(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert _optiland.spots_um(LENS, (0.0,)) is None
    assert _optiland.singlet() is None
    assert _optiland.recover(LENS, _optiland.Told({0: FREE}, {10: FREE}, 99.5)) is None


def test_the_best_singlet_by_our_rays():
    assert _optiland.singlet_merit(25.29399893, 256.01212830) == pytest.approx(0.00172898452, 1e-7)


@needed
@pytest.mark.parametrize("distance", [math.inf, 25000.0])
def test_spots_agree_but_for_the_pupil(distance):
    """Its pupil is paraxial off axis; on axis only a colour's own pupil is left."""
    found = _optiland.spots_um(LENS, (0.0, 10.0), distance_mm=distance)
    for field, theirs, close in zip((0.0, 10.0), found, (2e-3, 1e-2)):
        assert theirs == pytest.approx(ours_um(LENS, field, distance), close)


@needed
def test_the_singlet_of_its_users():
    names = ("OptimizerGeneric", "OptimizerGeneric 1/R")
    usual, best = (_optiland.singlet(names)[name]["merit"] for name in names)
    assert usual == pytest.approx(0.00239564, 1e-4)
    assert best == pytest.approx(0.00172898452577, 1e-6)


@needed
def test_a_disturbed_lens_is_sharp_again():
    numbers = np.random.default_rng(0)
    bent = LENS.curvature * (1 + 0.01 * numbers.normal(size=12))
    start = dataclasses.replace(LENS, curvature=jnp.asarray(bent))
    focal = float(drt_jax.focal_length(LENS, np.array([0.5876]))[0])
    curved = {i: FREE for i in range(11) if float(LENS.curvature[i])}
    found = _optiland.recover(start, _optiland.Told(curved, {10: FREE}, focal))
    assert found["focal_length"] == pytest.approx(focal, abs=1e-5)
    assert np.max(found["spots_um"]) < 8
    np.testing.assert_allclose(found["lens"].thickness, LENS.thickness, rtol=1e-12)
    np.testing.assert_allclose(ours_um(found["lens"], 10.0), found["spots_um"][1], rtol=0.03)
