import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax.image.beam import beam_rule
from drt_jax.image.beam_psf import Sampling
from drt_jax.image.fields import GridMethod
from drt_jax.image.sensor_maps import RenderMethod
from drt_jax.numerics import known_values, run_if, safe_divide, safe_sqrt


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_finite_where_the_plain_functions_are_not(dtype):
    zero = jnp.zeros((), dtype)
    for value in (zero, -zero, jnp.asarray(-1.0, dtype)):
        assert safe_sqrt(value) == 0 and jax.grad(safe_sqrt)(value) == 0
    one = jnp.ones((), dtype)
    assert safe_divide(one, zero) == 0
    assert jax.grad(safe_divide, argnums=(0, 1))(one, zero) == (0, 0)
    assert safe_sqrt(one).dtype == dtype and safe_divide(one, zero).dtype == dtype


def test_unbiased_elsewhere():
    x = jnp.array([1e-300, 1e-9, 2.0, 1e300])
    np.testing.assert_array_equal(safe_sqrt(x), jnp.sqrt(x))
    np.testing.assert_array_equal(safe_divide(jnp.ones(4), x), 1 / x)
    np.testing.assert_allclose(
        jax.vmap(jax.grad(safe_sqrt))(x[1:3]), 0.5 / np.sqrt(x[1:3]), rtol=1e-15
    )


def test_a_branch_that_runs_where_it_is_asked_for():
    runs = []

    def double(value):
        jax.debug.callback(lambda: runs.append(1))
        return 2 * value

    some = jnp.array([False, True, False])
    found = jax.vmap(lambda go, x: run_if(go, double, x))(some, jnp.arange(3.0))
    np.testing.assert_array_equal(found, [0, 2, 2])
    jax.effects_barrier()
    before = len(runs)
    none = jax.jit(jax.vmap(lambda go, x: run_if(go, double, x)))(some & False, jnp.arange(3.0))
    jax.effects_barrier()
    np.testing.assert_array_equal(none, [0, 1, 2])
    assert before > 0 and len(runs) == before


def test_values_are_known_while_they_are_differentiated_eagerly():
    seen = []

    def f(x):
        seen.append(known_values({"x": x}))
        return jnp.sum(x**3)

    x = jnp.arange(3.0)
    for transformed in (f, jax.grad(f), jax.jacfwd(f), jax.grad(lambda x: jnp.sum(jax.grad(f)(x)))):
        seen.clear()
        transformed(x)
        np.testing.assert_array_equal(seen[0]["x"], x)
    for transformed in (jax.jit(f), jax.vmap(f), jax.jit(jax.grad(f))):
        seen.clear()
        transformed(x)
        assert seen == [None]


def test_rules_models_and_methods_print_one_line():
    array = jnp.linspace(0, 1, 300).reshape(3, 100)
    model = Sampling("rays", beam_rule(6, "bilateral"), 48)
    grid = GridMethod(array[0, 1], array[0], array[0, 1], model, array, (3, 3), 21, "none")
    for one in (model.rule.rule, model, grid, RenderMethod(grid, array, array, (9, 9), (3, 3))):
        assert len(repr(one).splitlines()) == 1 and repr(one).startswith(type(one).__name__)
    assert "positions=float64[28, 2], weights=float64[28]" in repr(model)
    assert all(f.name in repr(grid) for f in dataclasses.fields(grid))
