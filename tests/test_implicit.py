"""Derivatives of traced rays three ways: our rule, finite differences, optimistix's own implicit
adjoint; and through the unrolled iteration. On lenses of different build, on and off axis."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from drt_jax import fermat, load_lens, pupil, trace_rays
from drt_jax.implicit import solve_rays
from drt_jax.trace import trace_bundle

from .conftest import LENSES, RGB
from .test_fermat import system_of

# One parameter group a row: (name, how large a relative step still is a small change).
LEAVES = ("curvature", "conic", "coefficients", "thickness", "semi_diameter", "sensor", "dispersion")


def problem(name, dim):
    """A lens with aspheric terms and a scalar of its traced hits, weighted at random."""
    lens = load_lens(name)
    count = len(lens.glasses) - 1
    lens = dataclasses.replace(lens, coefficients=jnp.zeros((count, 2)).at[:, 1].set(1e-7))
    points = pupil.meridian(3)[0] if dim == 1 else pupil.half_disc(2, 3)[0]
    field = jnp.array([0.1] if dim == 1 else [0.05, 0.1])
    shape = (dim, count + 1, len(RGB), points.shape[1])
    weights = jnp.asarray(np.random.default_rng(0).normal(size=shape))

    def scalar(lens, field, distance):
        hits, status, *_ = trace_bundle(lens, field, distance, jnp.array(RGB), points)
        return jnp.sum(weights * hits), status

    return lens, field, scalar


def direction(tree, leaf):
    """A random direction in one group of leaves, a millionth of its size to a change of 1."""
    generator = np.random.default_rng(1)

    def fill(path, value):
        inside = path[0].name == leaf
        scale = jnp.where(value != 0, jnp.abs(value), 1e-3 * (leaf not in ("semi_diameter", "dispersion")))
        scale = jnp.where(jnp.isfinite(scale), scale, 0.0)
        return float(inside) * scale * jnp.asarray(generator.normal(size=value.shape))

    return jax.tree_util.tree_map_with_path(fill, tree)


@pytest.mark.parametrize("name, dim", [("double_gauss", 2), ("cooke_triplet", 1)])
def test_against_finite_differences_of_second_order(name, dim):
    """Central differences over a swept step: the error falls with slope 2 until rounding, and
    our derivative is where it points to."""
    lens, field, scalar = problem(name, dim)
    value = jax.jit(lambda lens, f, d: scalar(lens, f, d)[0])
    gradient = jax.jit(jax.grad(value, argnums=(0, 1, 2)))(lens, field, jnp.array(500.0))
    moves = {leaf: (direction(lens, leaf), 0 * field, 0.0) for leaf in LEAVES}
    zero = jax.tree.map(jnp.zeros_like, lens)
    moves["field"] = (zero, jnp.full_like(field, 0.1), 0.0)
    moves["distance"] = (zero, 0 * field, 100.0)
    for leaf, (dl, df, dd) in moves.items():
        ours = sum(jnp.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient[0]), jax.tree.leaves(dl)))
        ours = float(ours + jnp.vdot(gradient[1], df) + gradient[2] * dd)

        def moved(h):
            shifted = jax.tree.map(lambda a, b: jnp.where(b == 0, a, a + h * b), lens, dl)
            return float(value(shifted, field + h * df, jnp.asarray(500.0 + h * dd)))

        steps = 10.0 ** -np.arange(2.0, 6.5, 0.5)
        errors = np.array([abs((moved(h) - moved(-h)) / (2 * h) - ours) for h in steps])
        scale = abs(ours) + 1e-9
        assert np.min(errors) < 3e-9 * scale + 1e-9, (leaf, errors / scale)
        clear = errors > 1e-7 * scale + 1e-9  # truncation well above rounding
        if np.sum(clear) >= 3:
            slope = np.polyfit(np.log(steps[clear][:4]), np.log(errors[clear][:4]), 1)[0]
            assert 1.8 < slope < 2.2, (leaf, slope)


@pytest.mark.parametrize("name, dim", [("double_gauss", 1), ("singlet", 2)])
def test_against_optimistix_and_the_unrolled_iteration(name, dim):
    lens = load_lens(name)
    system, start = system_of(lens, dim, 0.1, 1 / 300, rays=2)
    system = dataclasses.replace(
        system, conic=0 * system.conic, coefficients=0 * system.coefficients
    )
    stop, count = lens.stop, start.shape[1]
    unknown = jnp.array([i for i in range(count) if i != stop])
    weights = jnp.asarray(np.random.default_rng(0).normal(size=start.shape))

    def whole(y, system):
        hits = jnp.zeros_like(start).at[:, unknown].set(y)
        return hits.at[:, stop].set(jnp.broadcast_to(system.crossings, hits[:, stop].shape))

    def ours(system):
        hits, status, _ = solve_rays(system, start)
        return jnp.sum(weights * hits), status

    def theirs(system):
        root = optx.root_find(
            lambda y, system: fermat.residual(whole(y, system), system),
            optx.Newton(rtol=1e-12, atol=1e-12),
            start[:, unknown],
            args=system,
            max_steps=50,
        )
        return jnp.sum(weights * whole(root.value, system))

    def unrolled(system):
        def step(_, hits):
            blocks = fermat.hessian(fermat.geometry(hits, system), system)
            return hits - fermat.solve(blocks, fermat.residual(hits, system), stop)

        return jnp.sum(weights * jax.lax.fori_loop(0, 9, step, whole(start[:, unknown], system)))

    (value, status), gradient = jax.jit(jax.value_and_grad(ours, has_aux=True))(system)
    assert jnp.all(status == 0)
    their_value, their_gradient = jax.jit(jax.value_and_grad(theirs))(system)
    np.testing.assert_allclose(value, their_value, rtol=1e-13)
    for other in (their_gradient, jax.jit(jax.jacfwd(unrolled))(system)):
        for mine, yours in zip(jax.tree.leaves(gradient), jax.tree.leaves(other)):
            np.testing.assert_allclose(mine, yours, rtol=1e-9, atol=1e-10 * np.max(np.abs(yours)))


def test_failed_rays_change_no_gradient():
    lens = load_lens("singlet")
    lens = dataclasses.replace(lens, semi_diameter=jnp.array([80.0, jnp.inf, jnp.inf]))
    points = np.stack([np.zeros(9), np.linspace(-1, 1, 9)], axis=1)

    def total(lens, points):
        rays = trace_rays(lens, 0.0, jnp.inf, [0.55], points)
        return jnp.sum(rays.points[..., 1] ** 2), rays.status

    total = jax.jit(jax.grad(total, has_aux=True))
    gradient, status = total(lens, points)
    assert jnp.any(status != 0)
    good = points[np.asarray(status[0]) == 0]
    wanted, status = total(lens, good)
    assert jnp.all(status == 0)
    for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(wanted)):
        assert np.all(np.isfinite(a))
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)


def test_second_derivatives_and_transformations():
    """Reverse over reverse agrees with differences of the gradient; vmap with a loop."""
    lens = load_lens("singlet")

    def height(c, field):
        moved = dataclasses.replace(lens, curvature=lens.curvature.at[1].set(c))
        return trace_rays(moved, field, 300.0, [0.55], [[0.3, 0.9]]).points[0, 0, -1, 1]

    c, h, tilt = lens.curvature[1], 1e-6, jnp.array(0.05, float)
    slope = jax.jit(jax.value_and_grad(height))
    second = jax.jit(jax.grad(jax.grad(height)))(c, tilt)
    difference = (slope(c + h, tilt)[1] - slope(c - h, tilt)[1]) / (2 * h)
    np.testing.assert_allclose(second, difference, rtol=1e-6)
    fields = jnp.array([0.0, 0.05, 0.1])
    many = jax.jit(jax.vmap(jax.value_and_grad(height), (None, 0)))(c, fields)
    for k, field in enumerate(fields):
        for a, b in zip(many, slope(c, field)):
            np.testing.assert_allclose(a[k], b, rtol=1e-12)


@pytest.mark.parametrize("name", ["double_gauss", "cooke_triplet"])
def test_float32_gradient_is_the_rounded_float64_one(name):
    """The blur 5 mm out of focus: no difference of nearly equal hits is left in it."""
    lens = load_lens(name)
    lens = dataclasses.replace(lens, sensor=lens.sensor + 5)
    single = jax.tree.map(lambda a: a.astype(jnp.float32), lens)
    points = pupil.half_disc(2, 3)[0].T


    @jax.jit
    @jax.grad
    def gradient(lens):
        return jnp.sum(jnp.var(trace_rays(lens, 0.1, 25000.0, RGB, points).points[..., -1, 1], 1))

    exact, rough = gradient(lens), gradient(single)
    for a, b in zip(jax.tree.leaves(exact), jax.tree.leaves(rough)):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a, rtol=1e-4, atol=1e-4 * np.max(np.abs(a), initial=1e-9))
