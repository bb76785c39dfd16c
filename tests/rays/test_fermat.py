"""The closed-form system against automatic differentiation, its solves against dense ones."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import load_lens
from drt_jax.rays import fermat
from drt_jax.rays.fermat import Blocks, System

from .conftest import LENSES, RGB


def system_of(lens, dim, tangent, vergence, rays=3):
    """A system, and hits near but not at a stationary path."""
    extend = lambda a: jnp.concatenate([a, jnp.zeros_like(a[:1])])  # noqa: E731
    generator = np.random.default_rng(3)
    stop = generator.uniform(-0.5, 0.5, (dim, rays)) * float(lens.semi_diameter[lens.stop])
    system = System(
        vertex=jnp.append(lens.vertices, lens.sensor),
        curvature=extend(lens.curvature),
        conic=extend(lens.conic) + 0.1,
        coefficients=jnp.full((2, len(lens.glasses)), 1e-6),
        index=lens.index(jnp.array(RGB)),
        source=jnp.array([0.0] * (dim - 1) + [-tangent, -1.0]),
        vergence=jnp.array(vergence),
        target=jnp.asarray(stop),
        stop=lens.stop,
        forms=(*lens.forms, "asphere"),
        mirrors=lens.mirrors,
    )
    hits = stop[:, None, None] * np.linspace(1.2, 0.3, len(lens.glasses))[:, None, None]
    hits = hits + generator.normal(0, 0.02, (dim, len(lens.glasses), 3, rays))
    return system, jnp.asarray(hits)


CASES = [(name, dim, v) for name in LENSES for dim in (1, 2) for v in (0.0, 1 / 25000, 1 / 60)]

residual = jax.jit(fermat.residual)
optical_path = jax.jit(fermat.optical_path)
hessian = jax.jit(lambda hits, system: fermat.hessian(fermat.geometry(hits, system), system))
solve = jax.jit(fermat.solve, static_argnums=2)
solve_transposed = jax.jit(fermat.solve_transposed, static_argnums=2)
stationary = jax.jit(fermat.stationary)
gradient = jax.jit(jax.grad(lambda hits, system: jnp.sum(fermat.optical_path(hits, system))))


@pytest.mark.parametrize("name, dim, vergence", CASES)
def test_residual_is_the_gradient_of_the_path(name, dim, vergence):
    system, hits = system_of(load_lens(name), dim, 0.2, vergence)
    np.testing.assert_allclose(residual(hits, system), gradient(hits, system)[:, :-1], atol=2e-15)


@pytest.mark.parametrize("name, dim", [("double_gauss", 1), ("double_gauss", 2), ("singlet", 2)])
def test_blocks_solve_and_transpose_against_the_dense_jacobian(name, dim):
    lens = load_lens(name)
    system, hits = system_of(lens, dim, 0.2, 1 / 500, rays=1)
    system = dataclasses.replace(system, index=system.index[:, :1])
    hits = hits[:, :, :1]
    unknown = [i for i in range(hits.shape[1]) if i != lens.stop]
    dense = jax.jit(jax.jacobian(fermat.residual))(hits, system)[:, :, 0, 0, :, :, 0, 0]
    dense = dense[:, :, :, jnp.array(unknown)].reshape(dim * (hits.shape[1] - 1), -1)
    blocks = hessian(hits, system)

    rhs = jnp.asarray(np.random.default_rng(0).normal(size=hits[:, :-1].shape))
    x = solve(blocks, rhs, lens.stop)
    assert jnp.all(x[:, lens.stop] == 0)
    wanted = jnp.linalg.solve(dense, rhs.ravel())
    scale = float(jnp.max(jnp.abs(wanted)))
    np.testing.assert_allclose(x[:, jnp.array(unknown)].ravel(), wanted, atol=1e-12 * scale)

    rhs = jnp.asarray(np.random.default_rng(1).normal(size=hits.shape))
    y = solve_transposed(blocks, rhs, lens.stop)
    wanted = jnp.linalg.solve(dense.T, rhs[:, jnp.array(unknown)].ravel())
    scale = float(jnp.max(jnp.abs(wanted)))
    np.testing.assert_allclose(y.ravel(), wanted, atol=1e-12 * scale)


def test_solve_and_transpose_are_adjoint():
    """<y, A^-1 x> = <A^-T y, x> for a bundle."""
    lens = load_lens("double_gauss_addon")
    system, hits = system_of(lens, 2, 0.1, 1 / 25000, rays=5)
    blocks = hessian(hits, system)
    generator = np.random.default_rng(2)
    x = jnp.asarray(generator.normal(size=hits[:, :-1].shape))
    y = jnp.asarray(generator.normal(size=hits.shape))
    left = jnp.sum(y * solve(blocks, x, lens.stop))
    right = jnp.sum(solve_transposed(blocks, y, lens.stop) * x)
    np.testing.assert_allclose(left, right, rtol=1e-11)


def test_first_segment_is_continuous_to_infinity():
    lens = load_lens("double_gauss")
    far, hits = system_of(lens, 2, 0.1, 0.0)
    previous = None
    for distance in (1e4, 1e6, 1e9):
        near = dataclasses.replace(far, vergence=jnp.array(1 / distance))
        change = float(jnp.max(jnp.abs(residual(hits, near) - residual(hits, far))))
        path = optical_path(hits, near) - optical_path(hits, far)
        assert change < 30 / distance and float(jnp.max(jnp.abs(path))) < 400 / distance
        assert previous is None or change < previous / 50
        previous = change


def test_zero_blocks_stay_finite():
    zeros = jnp.zeros((2, 2, 4, 1, 1))
    solved = fermat.solve(Blocks(zeros, zeros), jnp.ones((2, 4, 1, 1)), 2)
    assert jnp.all(jnp.isfinite(solved))


def test_only_rays_are_stationary():
    lens = load_lens("singlet")
    system, _ = system_of(lens, 1, 0.0, 0.0, rays=1)
    system = dataclasses.replace(
        system, conic=0 * system.conic, coefficients=0 * system.coefficients
    )
    on_axis = jnp.zeros((1, 4, 3, 1))
    assert jnp.all(stationary(on_axis, system))
    outside = on_axis.at[0, 1].set(60.0)  # the radius of surface 1 is 51.68
    assert not jnp.any(stationary(outside, system))
    elsewhere = on_axis.at[0, 3].set(1.0)
    assert not jnp.any(stationary(elsewhere, system))
    # 60 degrees inside the glass at the plane exit face: beyond the critical angle
    steep = on_axis.at[0, 2].set(4.0 * np.tan(np.pi / 3))
    assert not jnp.any(stationary(steep, system))
