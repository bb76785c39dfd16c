"""The choice of a PSF model: its messages if light, degrees or grids do not suffice."""

import re
import warnings

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j0, j1

from drt_jax.image import psf as module
from drt_jax.image.beam import Beam
from drt_jax.image.kernel import Pixels
from drt_jax.pupil.patterns import disc

PIXEL, WAVE = 0.01, 0.5


def beam_of(radius, aperture=0.1):
    """Uniform light on a disc of a given radius in mm on the sensor, in a circular cone."""
    points, weights = disc(12, 25)
    points = np.asarray(points).T[:, None]
    directions = np.concatenate([aperture * points, np.ones_like(points[:1])])
    one = np.ones((1, weights.size))
    given = points, weights[None], radius * points[:, None], directions, 0 * one, np.ones(1)
    rest = np.array([0.0, 0, 1]), np.zeros(1), one > 0
    return Beam(*map(jnp.asarray, (*given, *rest)), 12, 12, False)


def size_told(radius, kind):
    waves, pixels = jnp.array([WAVE]), Pixels(jnp.array(PIXEL), 5)
    outside = np.array([[0.0], [0.2]])
    with pytest.warns(UserWarning, match="20 % of the light falls outside a kernel") as said:
        module._warn(outside, [None, beam_of(radius)].__getitem__, waves, pixels, kind)
    assert said[0].filename == __file__
    return int(re.search(r"; (\d+) x \1 hold 99 %", str(said[0].message))[1])


def test_the_size_that_would_do():
    """For rays that fill a disc; and for Airy's pattern, whose encircled energy is 1 - J0^2 -
    J1^2."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        module._warn(np.array([[0.01]]), None, None, None, "rays")
    assert 19 <= size_told(0.1, "rays") <= 21 and size_told(1e-6, "rays") == 7
    half = size_told(0.0, "waves") * PIXEL / 2
    v = 2 * np.pi * 0.1 * half / (WAVE * 1e-3)
    assert 0.988 < 1 - j0(v) ** 2 - j1(v) ** 2 < 0.993  # in the circle; the square contains more
    both = size_told(0.1, "waves")
    assert size_told(0.1, "rays") < both <= 20 + 2 * half / PIXEL
