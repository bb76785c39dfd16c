"""Derivatives of traced rays three ways: our rule, finite differences, optimistix's own implicit
adjoint; and through the unrolled iteration. On lenses of different build, on and off axis."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from drt_jax import Status, load_lens, trace_rays
from drt_jax.rays import fermat
from drt_jax.pupil import rules as pupil
from drt_jax.rays.implicit import solve_rays
from drt_jax.rays.trace import trace_bundle

from . import oracle
from .conftest import RGB, assert_close
from .test_fermat import system_of

# One parameter group a row: (name, how large a relative step still is a small change).
LEAVES = (
    "curvature",
    "conic",
    "coefficients",
    "thickness",
    "semi_diameter",
    "sensor",
    "dispersion",
)


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
        # A conic moves by up to 0.1 and a coefficient of r^2 by 1e-4 per mm: the hits hardly feel
        # less, and its effect would drown in rounding.
        unit = {"conic": 10.0, "coefficients": 1e-2, "semi_diameter": 0.0, "dispersion": 0.0}
        unit = unit.get(leaf, 1e-3)
        scale = jnp.where(value != 0, jnp.abs(value), unit)
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
        ours = sum(
            jnp.vdot(g, d) for g, d in zip(jax.tree.leaves(gradient[0]), jax.tree.leaves(dl))
        )
        ours = float(ours + jnp.vdot(gradient[1], df) + gradient[2] * dd)

        def moved(h):
            shifted = jax.tree.map(lambda a, b: jnp.where(b == 0, a, a + h * b), lens, dl)
            return float(value(shifted, field + h * df, jnp.asarray(500.0 + h * dd)))

        steps = 10.0 ** -np.arange(2.0, 6.5, 0.5)
        errors = np.array([abs((moved(h) - moved(-h)) / (2 * h) - ours) for h in steps])
        scale = abs(ours) + 1e-9
        assert np.min(errors) < 3e-9 * scale + 1e-9, (leaf, errors / scale)
        # Where truncation stands well above rounding, which grows as 1/h: measured at the end.
        rounding = 10 * np.max(errors[-4:] * steps[-4:]) / steps
        clear = np.cumprod(errors > rounding).astype(bool)
        assert np.sum(clear) >= 3 or leaf == "sensor", (leaf, errors / scale)  # hits: linear in it
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
        hits, status, _ = solve_rays(system)
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


@pytest.mark.parametrize(
    "name", [pytest.param("double_gauss", marks=pytest.mark.slow), "cooke_triplet"]
)
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


POINTS = np.array([[0.3, 0.9], [-0.5, 0.2]])
FIELDS = jnp.array([0.0, 0.05, 0.1])
SINGLET = load_lens("singlet")


def hits_of(parameters, field, forward=False):
    """Sensor points (2, 2) of two rays through the singlet with other `parameters`."""
    lens = dataclasses.replace(SINGLET, **parameters)
    return trace_rays(lens, field, 300.0, [0.55], POINTS, forward).points[0, :, -1, :2]


def height(parameters, field, forward=False):
    """A scalar of the sensor points, not linear in them."""
    weights = jnp.asarray(np.random.default_rng(5).normal(size=(2, 2)))
    return jnp.sum(jnp.sin(weights * hits_of(parameters, field, forward)))


def parameters_of_singlet():
    return {name: getattr(SINGLET, name) for name in ("curvature", "conic", "thickness", "sensor")}


@pytest.mark.slow
def test_transformations_compose():
    """grad, jacrev, vmap and jit of each other, over fields and over lenses."""
    p = parameters_of_singlet()
    gradient = jax.jit(jax.grad(height))
    one_by_one = [gradient(p, field) for field in FIELDS]
    wanted = jax.tree.map(lambda *g: jnp.stack(g), *one_by_one)
    heights = jax.vmap(height, (None, 0))
    assert_close(jax.grad(height)(p, FIELDS[1]), one_by_one[1], 1e-12)  # no jit
    assert_close(jax.jit(jax.vmap(jax.grad(height), (None, 0)))(p, FIELDS), wanted, 1e-12)
    assert_close(jax.vmap(gradient, (None, 0))(p, FIELDS), wanted, 1e-12)
    assert_close(jax.jit(jax.jacrev(heights))(p, FIELDS), wanted, 1e-12)
    total = jax.jit(jax.grad(lambda p, f: jnp.sum(heights(p, f))))(p, FIELDS)
    assert_close(total, jax.tree.map(lambda g: jnp.sum(g, axis=0), wanted), 1e-12)
    scales = jnp.array([0.9, 1.0, 1.1])
    many = jax.tree.map(lambda a: scales.reshape(-1, *(1,) * a.ndim) * a, p)
    lenses = jax.jit(jax.vmap(jax.grad(height), (0, None)))(many, FIELDS[1])
    for i in range(len(scales)):
        one = gradient(jax.tree.map(lambda a: a[i], many), FIELDS[1])
        assert_close(jax.tree.map(lambda a: a[i], lenses), one, 1e-12)


def test_forward_is_the_transpose_of_reverse():
    """Jacobians of both modes; <ybar, J x> = <J^T ybar, x> for random x and ybar."""
    arguments = parameters_of_singlet(), FIELDS[2]
    reverse = jax.jit(jax.jacrev(hits_of, argnums=(0, 1)))(*arguments)
    forward = jax.jit(jax.jacfwd(lambda *a: hits_of(*a, forward=True), argnums=(0, 1)))(*arguments)
    assert_close(forward, reverse, 1e-10)
    generator = np.random.default_rng(6)
    x = jax.tree.map(lambda a: jnp.asarray(generator.normal(size=a.shape)), arguments)
    ybar = jnp.asarray(generator.normal(size=(2, 2)))
    push = jax.jit(lambda a, x: jax.jvp(lambda *a: hits_of(*a, forward=True), a, x)[1])
    pull = jax.jit(lambda a, ybar: jax.vjp(hits_of, *a)[1](ybar))
    left = jnp.vdot(ybar, push(arguments, x))
    pulled = pull(arguments, ybar)
    right = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(pulled), jax.tree.leaves(x)))
    np.testing.assert_allclose(left, right, rtol=1e-11)


@pytest.mark.slow
def test_hessian_vector_products():
    """Forward over reverse, reverse over reverse and forward over forward agree; and with
    differences of the gradient by a complex step through the oracle."""
    p, field = parameters_of_singlet(), FIELDS[2]
    generator = np.random.default_rng(7)
    unit = {"curvature": 1e-3, "conic": 0.3, "thickness": 0.3, "sensor": 3.0}
    v = {k: jnp.asarray(unit[k] * generator.normal(size=a.shape)) for k, a in p.items()}

    def slope(p, forward=False):
        return jax.jvp(lambda p: height(p, field, forward), (p,), (v,))[1]

    gradient = jax.grad(height)
    products = jax.jit(lambda p: jax.jvp(lambda p: gradient(p, field), (p,), (v,))[1])(p)

    def along(p):
        g = gradient(p, field)
        return sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(g), jax.tree.leaves(v)))

    assert_close(jax.jit(jax.grad(along))(p), products, 1e-10)
    assert_close(jax.jit(jax.jacfwd(lambda p: slope(p, True)))(p), products, 1e-10)

    weights = np.random.default_rng(5).normal(size=(2, 2))
    scene = oracle.Scene.of(SINGLET, field, 300.0, [0.55])

    def reference(h):
        """Gradient of `height` at p + h v, by complex steps."""
        moved = scene.replace(**{k: np.asarray(p[k] + h * v[k]) for k in p})
        x, y = oracle.aim(moved, POINTS.T)
        at = np.real(np.stack(oracle.trace(moved, x, y)[1][-1][:2], -1)[0])
        nodes = np.zeros((2, 1)) + 0.1, np.ones(1)
        jacobian = oracle.jacobian(moved, nodes, "disc", POINTS.T, list(p))["hits"]
        bar = weights * np.cos(weights * at)
        return {k: np.tensordot(bar, j[0, :, -1, :2], 2) for k, j in jacobian.items()}

    # Central differences of two steps, freed of their h^2 (Richardson): 1e-8 of the largest.
    coarse, fine = (
        jax.tree.map(lambda a, b: (a - b) / (2 * h), reference(h), reference(-h))
        for h in (2e-3, 1e-3)
    )
    assert_close(products, jax.tree.map(lambda c, f: (4 * f - c) / 3, coarse, fine), 1e-8)


def test_failed_rays_leave_forward_tangents_alone():
    """Rays that miss the exit face or are totally reflected there, beside those that pass."""
    lens = load_lens("singlet")
    lens = dataclasses.replace(
        lens,
        curvature=jnp.array([0.0, 0.0, -0.02]),
        thickness=jnp.array([2.0, 60.0]),
        semi_diameter=jnp.array([80.0, jnp.inf, jnp.inf]),
        sensor=jnp.array(150.0),
    )
    points = np.stack([np.zeros(9), np.linspace(-1, 1, 9)], axis=1)
    ones = jax.tree.map(lambda a: jnp.where(jnp.isfinite(a), 0.1, 0.0) * jnp.ones_like(a), lens)

    @jax.jit
    def push(lens, points):
        def rays(lens):
            rays = trace_rays(lens, 0.0, jnp.inf, [0.55], points, forward=True)
            return (rays.points, rays.path), rays.status

        (_, tangents, status) = jax.jvp(rays, (lens,), (ones,), has_aux=True)
        return tangents, status

    tangents, status = push(lens, points)
    good = np.asarray(status[0]) == Status.OK
    assert {Status.MISSED, Status.TIR} <= set(np.asarray(status[0]).tolist()) and good.any()
    alone, status = push(lens, points[good])
    assert np.all(status == Status.OK)
    for a, b in zip(tangents, alone):
        assert np.all(np.isfinite(a)) and np.all(a[:, ~good] == 0)
        np.testing.assert_allclose(a[:, good], b, rtol=1e-12, atol=1e-13)


def test_forward_mode_must_be_asked_for():
    with pytest.raises(TypeError, match="forward-mode autodiff"):
        jax.jacfwd(hits_of)(parameters_of_singlet(), FIELDS[1])
