"""Derivatives of rays: our rule as `attach`, `solve` and `solve_reverse`, compared with each other,
with finite differences, with optimistix's own implicit adjoint and with the unrolled iteration."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from drt_jax import Status
from drt_jax.rays import fermat, linear, solve

from ..conftest import assert_close
from ..known import aims, known, search
from .problems import PROBLEMS, gradient, outcome, problem, random_like, weighed

GROUPS = (
    "curvature",
    "conic",
    "coefficients",
    "thickness",
    "semi_diameter",
    "sensor",
    "dispersion",
    "tilt",
    "decentre",
)


def each(a, b):
    """Pairs of the leaves of two trees."""
    return zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)


def dots(a, b):
    """Product of two trees."""
    return sum(float(np.vdot(x, y)) for x, y in each(a, b))


def direction(lens, group):
    """A random direction in one group of leaves, scaled so that 1 is a small change."""
    generator = np.random.default_rng(1)

    # A smaller change would have an effect on the hits below rounding.
    least = {"conic": 50.0, "coefficients": 1e-2, "decentre": 3.0, "tilt": 0.3}.get(group, 0.0)

    def fill(path, value):
        if path[0].name != group:
            return jnp.zeros_like(value)
        size = jnp.abs(value) if group == "coefficients" else jnp.maximum(jnp.abs(value), least)
        size = jnp.where(size == 0, least, jnp.where(jnp.isfinite(size), size, 0))
        return size * jnp.asarray(generator.normal(size=value.shape))

    return jax.tree_util.tree_map_with_path(fill, lens)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n == "tilted" else n for n in PROBLEMS]
)
def test_against_finite_differences_of_second_order(name):
    """Central differences of rays that are found anew, for varied steps: the error falls with slope
    2 until rounding, and its limit is our derivative."""
    lens, scene, points, found = problem(name)
    weights = random_like(found.hits)
    dlens, dscene, _ = gradient(lens, scene, points, found, weights)
    rest = jax.tree.map(jnp.zeros_like, scene)
    still = jax.tree.map(jnp.zeros_like, lens)
    moves = {group: (direction(lens, group), rest) for group in GROUPS}
    moves["field"] = (
        still,
        dataclasses.replace(rest, field=jnp.array([0.1 * len(points) - 0.1, 0.1])),
    )
    moves["distance"] = still, dataclasses.replace(rest, distance=jnp.array(100.0))
    for group, move in moves.items():
        ours = dots((dlens, dscene), move)

        def moved(h, move=move):
            shift = lambda a, b: np.where(b == 0, a, a + h * b)  # noqa: E731
            at = jax.tree.map(shift, (lens, scene), move)
            hits = search(*at, points).hits
            return float(weighed([np.asarray(a) for a in hits], weights))

        if not any(np.any(a) for a in jax.tree.leaves(move)):
            continue  # a centred lens has no tilt
        steps = 10.0 ** -np.arange(2.0, 6.5, 0.5)
        errors = np.array([abs((moved(h) - moved(-h)) / (2 * h) - ours) for h in steps])
        scale = abs(ours) + 1e-9
        assert np.min(errors) < 3e-9 * scale + 1e-9, (group, errors / scale)
        # Steps at which truncation is well above rounding, which is measured at the end and
        # grows as 1/h.
        rounding = 10 * np.max(errors[-4:] * steps[-4:]) / steps
        clear = np.cumprod(errors > rounding).astype(bool)
        assert np.sum(clear) >= 3 or group == "sensor", (group, errors / scale)  # linear in it
        if np.sum(clear) >= 3:
            slope = np.polyfit(np.log(steps[clear][:4]), np.log(errors[clear][:4]), 1)[0]
            assert 1.8 < slope < 2.2, (group, slope)


def equations(hits, system, target):
    """F, and the distances of the rays from their stop points; both are 0 for rays."""
    path = fermat.geometry(hits, system)
    short = linear.shortfall(path, system, target)
    return tuple(f[:-1] for f in short.residual), short.label


def test_against_optimistix():
    """The gradient by its Newton method for all rays together, from hits close to the rays, with
    its default adjoint."""
    given = lens, scene, points, found = problem("meridional")
    weights = random_like(found.hits)

    @jax.jit
    def theirs(*moved):
        newton = optx.Newton(rtol=1e-13, atol=1e-13)
        start = tuple(h + 1e-3 for h in found.hits)

        def value(*moved):
            root = optx.root_find(lambda y, a: equations(y, *a), newton, start, aims(*moved))
            return weighed(root.value, weights)

        return jax.value_and_grad(value, (0, 1, 2))(*moved)

    value, slopes = theirs(lens, scene, points)
    np.testing.assert_allclose(value, weighed(found.hits, weights), rtol=1e-13)
    assert_close(gradient(*given, weights), slopes, 1e-9)


@pytest.mark.slow
def test_against_the_unrolled_iteration():
    """Tangents through nine steps of Newton's method from hits close to the rays."""
    given = lens, scene, points, found = problem("tilted")

    @jax.jit
    def theirs(moved, moving):
        def hits(*moved):
            system, target = aims(*moved)

            def step(_, hits):
                path, good = fermat.geometry(hits, system), jnp.ones(target[0].shape, bool)
                short = linear.shortfall(path, system, target)
                change, _ = linear.solve(path, system, good, short)
                return tuple(h - c for h, c in zip(hits, change, strict=True))

            return jax.lax.fori_loop(0, 9, step, tuple(h + 1e-3 for h in found.hits))

        return jax.jvp(hits, moved, moving)

    moving = tangents_of(lens, scene, points)
    hits, tangents = theirs((lens, scene, points), moving)
    assert_close(hits, found.hits, 1e-13)
    assert_close(pushed(*given, moving), tangents, 1e-9)


@pytest.mark.slow
def test_solve_and_solve_reverse_are_one(monkeypatch):
    """Gradients by the system and the stop points, and those of `attach`, agree to 1e-12. Both use
    the rays that the search has found."""
    lens, scene, points, found = problem("tilted")
    weights = random_like(found.hits)
    monkeypatch.setattr(solve, "find_many", lambda *_: found)

    @functools.partial(jax.jit, static_argnums=0)
    def slopes(solver, lens, scene, points):
        def value(*moved):
            return weighed(solver(*aims(*moved)).hits, weights)

        return jax.grad(value, (0, 1, 2))(lens, scene, points)

    wanted = gradient(lens, scene, points, found, weights)
    for solver in (solve.solve, solve.solve_reverse):
        assert_close(slopes(solver, lens, scene, points), wanted, 1e-12)


def moved_by(change, lens, scene):
    """A lens and a scene with some of their arrays changed."""
    lens = dataclasses.replace(lens, **{k: getattr(lens, k) + v for k, v in change.items()})
    return lens, scene


@jax.jit
def second_order(change, way, lens, scene, points, found, weights):
    """The gradient by a change of the lens, and its product with `way`; products of the Hessian
    with `way`, forward over reverse and reverse over reverse; and the quadratic form of `way`,
    forward over forward."""

    def value(change):
        return outcome(*moved_by(change, lens, scene), points, found, weights)

    def along(change):
        return sum(jnp.vdot(a, b) for a, b in each(jax.grad(value)(change), way))

    def tangent(change):
        return jax.jvp(value, (change,), (way,))[1]

    first, forward = jax.jvp(jax.grad(value), (change,), (way,))
    slope, twice = jax.jvp(tangent, (change,), (way,))
    return first, slope, forward, jax.grad(along)(change), twice


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tilted", pytest.param("meridional", marks=pytest.mark.slow)])
def test_products_with_the_hessian(name):
    """Three ways agree with each other, and with differences of the gradient of rays that are found
    anew, extrapolated from two steps (Richardson), to 1e-8 of the largest."""
    lens, scene, points, found = problem(name)
    weights = random_like(found.hits)
    groups = ("curvature", "thickness", "conic", "sensor")
    way = {g: 1e-2 * getattr(direction(lens, g), g) for g in groups}
    still = jax.tree.map(jnp.zeros_like, way)
    given = lens, scene, points, found, weights
    first, slope, forward, reverse, twice = second_order(still, way, *given)
    np.testing.assert_allclose(slope, dots(first, way), rtol=1e-12)
    np.testing.assert_allclose(twice, dots(forward, way), rtol=1e-10)
    assert_close(reverse, forward, 1e-10)

    def reference(h):
        at = moved_by(jax.tree.map(lambda a: h * a, way), lens, scene)
        slopes = gradient(*at, points, search(*at, points), weights)[0]
        return {g: getattr(slopes, g) for g in groups}

    differences = [
        jax.tree.map(lambda a, b, h=h: (a - b) / (2 * h), reference(h), reference(-h))
        for h in (0.2, 0.1)
    ]
    wanted = jax.tree.map(lambda coarse, fine: (4 * fine - coarse) / 3, *differences)
    assert_close(forward, wanted, 1e-8)


@jax.jit
def pushed(lens, scene, points, found, moving):
    """Tangents of the hits."""

    def hits(lens, scene, points):
        return known(found)(*aims(lens, scene, points)).hits

    return jax.jvp(hits, (lens, scene, points), moving)[1]


def tangents_of(*tree):
    """Random tangents; 0 for numbers that cannot change."""
    return jax.tree.map(lambda x, a: jnp.where(jnp.isfinite(a), x, 0), random_like(tree, 1), tree)


def test_forward_is_the_transpose_of_reverse():
    """<y, J x> = <J^T y, x> for random x and y."""
    given = lens, scene, points, found = problem("tilted")
    x, y = tangents_of(lens, scene, points), random_like(found.hits, 2)
    # The scalar of `gradient` is not linear: it is J^T of y + 2e-2 y^2 hits.
    bar = jax.tree.map(lambda y, h: y + 2e-2 * y * y * h, y, found.hits)
    np.testing.assert_allclose(
        dots(pushed(*given, x), bar), dots(gradient(*given, y), x), rtol=1e-11
    )


def test_failed_rays_have_no_derivatives_and_change_no_other():
    """Stop points at infinity, out of reach, and NaN."""
    lens, scene, points, found = problem("tilted")
    for bad in (1e6, 30.0, np.nan, np.inf):
        some = np.array([False, True, False, True, False])
        hard = tuple(jnp.where(some, bad, p) for p in points)
        hurt = search(lens, scene, hard)
        good = np.asarray(hurt.status) == Status.OK
        assert np.all(good == ~some)
        for mine, wanted in zip(hurt.hits, found.hits, strict=True):
            assert np.all(np.asarray(mine)[:, :, some] == 0)
            kept = np.asarray(wanted)[:, :, ~some]
            np.testing.assert_allclose(np.asarray(mine)[:, :, ~some], kept, rtol=0, atol=1e-14)
        if not np.isfinite(bad):
            continue  # a product with the radius of the stop, in `aims`, has no derivative
        weights = random_like(found.hits)
        dlens, dscene, dpoints = gradient(lens, scene, hard, hurt, weights)
        assert all(np.all(np.asarray(p)[some] == 0) for p in dpoints)
        masked = tuple(jnp.where(some, 0, w) for w in weights)
        wanted = gradient(lens, scene, points, found, masked)
        assert_close((dlens, dscene), wanted[:2], 1e-12)
        moving = jax.tree.map(jnp.ones_like, (lens, scene, hard))
        for tangent in pushed(lens, scene, hard, hurt, moving):
            assert np.all(np.isfinite(tangent)) and np.all(np.asarray(tangent)[:, :, some] == 0)


@pytest.mark.slow
def test_float32_gradient_is_the_rounded_float64_one():
    lens, scene, points, found = problem("tilted")
    given = lens, scene, points, found, random_like(found.hits)
    exact = gradient(*given)
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == float else a, given)
    for a, b in zip(jax.tree.leaves(exact), jax.tree.leaves(gradient(*single)), strict=True):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-4 * np.max(np.abs(a), initial=1e-9))
