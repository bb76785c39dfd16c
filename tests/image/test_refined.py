"""Cells of the pupil by a tolerance: arguments, trials and results; without optics."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax.image.refined import CELLS, to_tolerance

NONE = lambda *_: 0  # noqa: E731


def rule(truth, cells):
    """A rule whose error is proportional to 1 / cells^2."""
    tried.append(cells)
    return jnp.asarray(truth) + 5.0 / cells**2, jnp.zeros(2)


tried: list[int] = []


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 2e-4, 5e-5])
def test_the_error_is_within_the_tolerance(tolerance):
    tried.clear()
    found, _ = to_tolerance(rule, (jnp.asarray(0.3),), None, tolerance, NONE)
    assert abs(float(found) - 0.3) < tolerance
    assert tried == sorted(tried) and len(tried) >= 2


def test_what_cannot_be_met_warns_and_nothing_else_does():
    with pytest.warns(UserWarning, match="512 x 512 cells .* to 2e-05 only, not to 1e-06"):
        to_tolerance(rule, (jnp.asarray(0.3),), None, 1e-6, NONE)
    with pytest.raises(ValueError, match="sampling: expected a tolerance between 0 and 1"):
        drt_jax.strehl(drt_jax.load_lens("singlet"), drt_jax.Scene.point(), 0.0)


def test_cells_are_those_asked_for_and_128_in_a_trace():
    given = (jnp.asarray(0.3),)
    tried.clear()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        to_tolerance(rule, given, 32, 1e-6, NONE)
        jax.jit(lambda x: to_tolerance(rule, (x,), None, 1e-6, NONE))(*given)
    assert tried == [32, CELLS]


def test_a_derivative_takes_the_cells_of_the_values():
    tried.clear()
    slope = jax.grad(lambda x: to_tolerance(rule, (x,), None, 1e-3, lambda *_: 100)[0])(0.3)
    assert slope == 1 and tried == [128, 192, 192]
    np.testing.assert_array_less(0, tried)
