"""Patterns of pupil points: areas, symmetry, degrees of exactness, the Sobol sequence."""

import numpy as np
import pytest
from scipy.stats import qmc

from drt_jax import pupil

PATTERNS = {
    "meridian": pupil.meridian(5),
    "half_disc": pupil.half_disc(4, 5),
    "disc": pupil.disc(4, 5),
    "random_disc": pupil.random_disc(256, 1),
    "square_grid": pupil.square_grid(18),
    "hexapolar": pupil.hexapolar(8),
    "sobol_disc": pupil.sobol_disc(256),
}


@pytest.mark.parametrize("name", PATTERNS)
def test_weights_sum_to_one_on_points_of_the_disc(name):
    points, weights = PATTERNS[name]
    assert points.shape == (weights.size, 1 if name == "meridian" else 2)
    np.testing.assert_allclose(np.sum(weights), 1, rtol=1e-14)
    assert np.all(np.sum(points**2, axis=-1) <= 1 + 1e-15)


def average(pattern, function):
    points, weights = pattern
    return np.sum(weights * function(*points.T))


@pytest.mark.parametrize("order", [1, 2, 5, 12])
def test_gauss_rule_is_exact_to_its_degree(order):
    """<r^(2 k)> = 1 / (k + 1) for k < 2 n, and azimuthal orders m < 2 (n + 1) average to 0."""
    rule = pupil.disc(order, order + 1)
    for k in range(2 * order):
        got = average(rule, lambda x, y: (x * x + y * y) ** k)
        np.testing.assert_allclose(got, 1 / (k + 1), rtol=1e-13)
    beyond = average(rule, lambda x, y: (x * x + y * y) ** (2 * order))
    assert abs(beyond - 1 / (2 * order + 1)) > 1e-17 + 4.0 ** (-2 * order) / 50 / (2 * order + 1)
    for m in range(1, 2 * (order + 1)):
        np.testing.assert_allclose(average(rule, lambda x, y: (x + 1j * y) ** m), 0, atol=1e-14)


@pytest.mark.parametrize("rings", [1, 8, 30])
def test_hexapolar_rings_stand_for_equal_areas(rings):
    """Each ring has the mean r^2 of its annulus, except the centre, of area 1 / Q, which has r =
    0."""
    pattern = pupil.hexapolar(rings)
    count = 1 + 3 * rings * (rings + 1)
    assert pattern[1].size == count
    square = average(pattern, lambda x, y: x * x + y * y)
    np.testing.assert_allclose(square, 0.5 - 0.5 / count**2, rtol=1e-13)
    for m in range(1, 6):
        np.testing.assert_allclose(average(pattern, lambda x, y: (x + 1j * y) ** m), 0, atol=1e-14)


def test_square_grid_is_even_and_covers_the_area():
    for side in (7, 18, 200):
        pattern = pupil.square_grid(side)
        np.testing.assert_allclose(pattern[1].size, np.pi / 4 * side**2, rtol=1 / side)
        for m in (1, 2, 3):
            got = average(pattern, lambda x, y: (x + 1j * y) ** m)
            np.testing.assert_allclose(got, 0, atol=1e-14)
        square = average(pattern, lambda x, y: x * x + y * y)
        np.testing.assert_allclose(square, 0.5, rtol=1 / side)


@pytest.mark.parametrize("bits", [0, 4, 10, 16])
def test_sobol_sequence(bits):
    wanted = qmc.Sobol(2, scramble=False).random_base2(bits)
    np.testing.assert_array_equal(pupil.sobol(2**bits), wanted)
    # 2^m points lie at all multiples of 2^-m: their mean r^2 is (1 - 2^-m) / 2.
    square = average(pupil.sobol_disc(2**bits), lambda x, y: x * x + y * y)
    np.testing.assert_allclose(square, (1 - 0.5**bits) / 2, rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(pupil.sobol(11), pupil.sobol(16)[:11])


@pytest.mark.parametrize("function", [pupil.square_grid, pupil.hexapolar, pupil.sobol])
def test_patterns_refuse_to_be_empty(function):
    with pytest.raises(ValueError, match="expected at least 1.*, got 0"):
        function(0)
