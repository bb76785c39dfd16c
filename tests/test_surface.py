"""The sag against closed forms, its derivatives against 40-digit differences."""

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest

from drt_jax import surface

# curvature, conic, coefficients of r^2, r^4, ...
SHAPES = {
    "plane": (0.0, 0.0, []),
    "sphere": (1 / 50, 0.0, []),
    "ellipsoid": (-1 / 30, 0.4, []),
    "paraboloid": (1 / 40, -1.0, []),
    "hyperboloid": (-1 / 25, -2.25, []),
    "even asphere": (1 / 60, -0.5, [0.0, 1e-6, -3e-9]),
    "r2 term": (0.0, 0.0, [1e-3]),
}


def exact(x, y, c, k, a):
    r2 = mpmath.mpf(x) ** 2 + mpmath.mpf(y) ** 2
    c, k = mpmath.mpf(c), mpmath.mpf(k)
    z = c * r2 / (1 + mpmath.sqrt(1 - (1 + k) * c**2 * r2))
    return z + sum(mpmath.mpf(v) * r2 ** (j + 1) for j, v in enumerate(a))


@pytest.mark.parametrize("name", SHAPES)
def test_sag_and_derivatives_against_mpmath(name):
    c, k, a = SHAPES[name]
    shape = (jnp.array(c), jnp.array(k), jnp.array(a, float))
    x, y = 7.0, -4.0
    z, gradient, hessian = surface.sag_derivatives(jnp.array([x, y]), *shape)
    with mpmath.workdps(40):
        def f(x, y):
            return exact(x, y, c, k, a)

        assert abs(z - float(f(x, y))) < 1e-14
        wanted = [float(mpmath.diff(f, (x, y), n)) for n in ((1, 0), (0, 1))]
        np.testing.assert_allclose(gradient, wanted, rtol=1e-13, atol=1e-17)
        second = [float(mpmath.diff(f, (x, y), n)) for n in ((2, 0), (1, 1), (1, 1), (0, 2))]
        np.testing.assert_allclose(hessian.ravel(), second, rtol=1e-12, atol=1e-17)


def test_one_component_is_the_section_of_two():
    c, k, a = jnp.array(0.02), jnp.array(-0.3), jnp.array([0.0, 1e-6])
    z1, g1, h1 = surface.sag_derivatives(jnp.array([5.0]), c, k, a)
    z2, g2, h2 = surface.sag_derivatives(jnp.array([0.0, 5.0]), c, k, a)
    assert z1 == z2 and g1[0] == g2[1] and h1[0, 0] == h2[1, 1]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_finite_and_flagged_beyond_the_rim(dtype):
    c, k, a = jnp.asarray(0.1, dtype), jnp.asarray(0.0, dtype), jnp.zeros(0, dtype)
    for height in (9.9, 9.999999, 10.0, 10.1, 50.0, 1e6):
        w = jnp.array([height, 0.0], dtype)
        for part in surface.sag_derivatives(w, c, k, a):
            assert jnp.all(jnp.isfinite(part)) and part.dtype == dtype
        assert bool(surface.domain(w, c, k)) == (height < 9.9995)
