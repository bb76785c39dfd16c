"""Derivatives of rays: our rule as `attach`, `solve` and `solve_reverse` against each other, finite
differences, optimistix's own implicit adjoint and the unrolled iteration; and the searches."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

from drt_jax import Status, load_lens, scene_of, trace_rays
from drt_jax.rays import aim, fermat, find, linear, solve

from ..conftest import assert_close
from ..known import aims, known, search
from .systems import COLOURS, lens_with

POINTS = tuple(jnp.asarray(p) for p in ([0.0, 0.5, -0.3, 0.8, -0.9], [0.1, 0.6, -0.8, -0.2, 0.1]))
# A mirror and a stop that bends light, all tilted; meridional rays and one that bends none.
PROBLEMS = {"tilted": ("live", True, 2), "meridional": ("between", False, 1)}
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


@functools.cache
def problem(name):
    """A lens, a scene, points and the rays through them."""
    stop, tilted, dim = PROBLEMS[name]
    lens, points = lens_with(stop, tilted), POINTS[2 - dim :]
    scene = scene_of(lens, [0.03, -0.05] if dim == 2 else 0.08, 300.0, COLOURS)
    found = search(lens, scene, points)
    assert np.all(found.status == Status.OK)
    return lens, scene, points, found


def random_like(tree, seed=0):
    generator = np.random.default_rng(seed)
    return jax.tree.map(lambda a: jnp.asarray(generator.normal(size=a.shape)), tree)


def each(a, b):
    """Pairs of the leaves of two trees."""
    return zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)


def dots(a, b):
    """Product of two trees."""
    return sum(float(np.vdot(x, y)) for x, y in each(a, b))


def weighed(hits, weights):
    """A scalar that is not linear in the hits."""
    return sum(jnp.sum(w * h + 1e-2 * (w * h) ** 2) for w, h in zip(weights, hits, strict=True))


def outcome(lens, scene, points, found, weights):
    """The scalar of rays that are known."""
    hits = known(found)(*aims(lens, scene, points)).hits
    return weighed(hits, weights)


gradient = jax.jit(jax.grad(outcome, (0, 1, 2)))
crossings = jax.jit(lambda lens, scene, points: aims(lens, scene, points)[1])


def direction(lens, group):
    """A random direction in one group of leaves, of such a size that 1 is a small change."""
    generator = np.random.default_rng(1)

    # The hits hardly feel less, and its effect would drown in rounding.
    least = {"conic": 50.0, "coefficients": 1e-2, "decentre": 3.0, "tilt": 0.3}.get(group, 0.0)

    def fill(path, value):
        if path[0].name != group:
            return jnp.zeros_like(value)
        size = jnp.abs(value) if group == "coefficients" else jnp.maximum(jnp.abs(value), least)
        size = jnp.where(size == 0, least, jnp.where(jnp.isfinite(size), size, 0))
        return size * jnp.asarray(generator.normal(size=value.shape))

    return jax.tree_util.tree_map_with_path(fill, lens)


@pytest.mark.parametrize("name", PROBLEMS)
def test_against_finite_differences_of_second_order(name):
    """Central differences of rays found anew over a swept step: the error falls with slope 2 until
    rounding, and our derivative is where it points to."""
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
        # Where truncation stands well above rounding, which grows as 1/h: measured at the end.
        rounding = 10 * np.max(errors[-4:] * steps[-4:]) / steps
        clear = np.cumprod(errors > rounding).astype(bool)
        assert np.sum(clear) >= 3 or group == "sensor", (group, errors / scale)  # linear in it
        if np.sum(clear) >= 3:
            slope = np.polyfit(np.log(steps[clear][:4]), np.log(errors[clear][:4]), 1)[0]
            assert 1.8 < slope < 2.2, (group, slope)


def equations(hits, system, target):
    """F and by how much the rays miss their stop points; both are 0 for rays."""
    path = fermat.geometry(hits, system)
    short = linear.shortfall(path, system, target)
    return tuple(f[:-1] for f in short.force), short.label


def test_against_optimistix():
    """The gradient by its Newton method for all rays at once, from hits near to them, and its
    default adjoint."""
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


def test_against_the_unrolled_iteration():
    """Tangents through nine steps of Newton's method from hits near to the rays."""
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


def test_solve_and_solve_reverse_are_one(monkeypatch):
    """Gradients by the system and the stop points, and those of `attach`: to 1e-12. Both are handed
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
    """A lens and a scene with some of their arrays moved."""
    lens = dataclasses.replace(lens, **{k: getattr(lens, k) + v for k, v in change.items()})
    return lens, scene


@jax.jit
def second_order(change, way, lens, scene, points, found, weights):
    """The gradient by a change of the lens, and along `way`; products of the Hessian with `way`:
    forward over reverse and reverse over reverse; and `way` with it, forward over forward."""

    def value(change):
        return outcome(*moved_by(change, lens, scene), points, found, weights)

    def along(change):
        return sum(jnp.vdot(a, b) for a, b in each(jax.grad(value)(change), way))

    def tangent(change):
        return jax.jvp(value, (change,), (way,))[1]

    first, forward = jax.jvp(jax.grad(value), (change,), (way,))
    slope, twice = jax.jvp(tangent, (change,), (way,))
    return first, slope, forward, jax.grad(along)(change), twice


@pytest.mark.parametrize("name", ["tilted", pytest.param("meridional", marks=pytest.mark.slow)])
def test_products_with_the_hessian(name):
    """Three ways, and against differences of the gradient of rays found anew, two steps freed of
    their h^2 (Richardson): 1e-8 of the largest."""
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
    """Random tangents; 0 where there is nothing to move."""
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
    """Stop points at infinity, out of reach, and not a number."""
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


@jax.jit
def aimed(lens, scene, points, off):
    """What aiming finds that starts `off` mm from the paraxial launch."""
    system, target = aims(lens, scene, points)
    sizes = aim.beam_size(system, target)
    launch = aim.paraxial_launch(system, target, sizes[1])
    start = tuple(a + b for a, b in zip(launch, off, strict=True))
    return aim.aim(system, target, start, sizes)


ZERO = tuple(jnp.zeros((len(COLOURS), 5)) for _ in range(2))


def test_aiming_from_crude_starts():
    """The same launch from 3 mm around; what cannot be reached says so, and spoils no other."""
    lens, scene, points, _ = problem("tilted")
    exact = aimed(lens, scene, points, ZERO)
    assert np.all(exact.status == Status.OK) and int(exact.steps) <= 6
    off = tuple(3 * a for a in random_like(ZERO))
    crude = aimed(lens, scene, points, off)
    assert np.all(crude.status == Status.OK) and int(crude.steps) <= 12
    # A step of Newton's method from a millionth of the beam leaves some 1e-12 of it.
    assert_close(crude.launch, exact.launch, 1e-10)
    far = tuple(p.at[3].set(30.0) for p in points)
    status = np.asarray(aimed(lens, scene, far, ZERO).status)
    assert np.all((status == Status.OK) == (np.arange(5) != 3))


@jax.jit
def polished(lens, scene, points, hits, active):
    """What `BlockNewton` makes of hits."""
    system, target = aims(lens, scene, points)

    def function(hits, args):
        system, target, _ = args
        path = fermat.geometry(hits, system)
        return (linear.shortfall(path, system, target), path), None

    eps = float(jnp.finfo(hits[0].dtype).eps)
    newton = find.BlockNewton(rtol=2 * eps, atol=2 * eps)
    args = system, target, active
    found = optx.root_find(function, newton, hits, args, has_aux=True, max_steps=16, throw=False)
    successful = found.result == optx.RESULTS.successful
    return found.value, found.state.solved, found.stats["num_steps"], successful


def test_newton_from_the_crudest_start():
    """Every hit at the stop point: all rays within 8 steps. Those that are not to move stay; one
    that has no solution tells, stays finite and leaves the others alone."""
    lens, scene, points, found = problem("tilted")
    start = tuple(
        jnp.broadcast_to(c, h.shape) for c, h in zip(crossings(lens, scene, points), found.hits)
    )
    every = jnp.ones(found.status.shape, bool)
    hits, solved, steps, successful = polished(lens, scene, points, start, every)
    assert np.all(solved) and successful and int(steps) <= 8
    assert_close(hits, found.hits, 1e-13)
    hits, solved, steps, successful = polished(lens, scene, points, start, ~every)
    assert np.all(solved) and successful and int(steps) == 0
    assert_close(hits, start, 0)
    hard = np.arange(5) == 3
    far = tuple(jnp.where(hard, 30.0, p) for p in points)
    hits, solved, _, successful = polished(lens, scene, far, start, every)
    assert np.all(np.asarray(solved) == ~hard) and not successful
    for mine, wanted in zip(hits, found.hits, strict=True):
        mine, wanted = np.asarray(mine), np.asarray(wanted)
        assert np.all(np.isfinite(mine))
        np.testing.assert_allclose(mine[:, :, ~hard], wanted[:, :, ~hard], rtol=0, atol=1e-12)


def test_hits_that_rounding_would_turn_are_not_accepted():
    """Two equal surfaces a nanometre of a nanometre apart: rays exist, their directions drown."""
    lens, scene, points, _ = problem("meridional")
    same = {k: getattr(lens, k).at[1].set(getattr(lens, k)[0]) for k in ("curvature", "conic")}
    same["coefficients"] = lens.coefficients.at[1].set(lens.coefficients[0])
    close = dataclasses.replace(lens, thickness=lens.thickness.at[0].set(1e-9), **same)
    status = np.asarray(search(close, scene, points).status)
    wide = np.abs(np.asarray(points[0])) > 0.2
    assert np.all(status[:, wide] == Status.UNCONVERGED)
    apart = dataclasses.replace(close, thickness=lens.thickness.at[0].set(1e-6))
    assert np.all(search(apart, scene, points).status == Status.OK)


def hostile(seed):
    """A lens with the structure of the "tilted" one, and a scene, to break the search."""
    generator = np.random.default_rng(seed)
    lens, scene, *_ = problem("tilted")
    bent = lens.curvature * generator.uniform(-4, 6, lens.curvature.shape)
    wide = lens.semi_diameter.at[lens.stop].mul(generator.uniform(0.5, 2))
    conic = lens.conic + generator.normal(size=lens.conic.shape)
    lens = dataclasses.replace(lens, curvature=bent, conic=conic, semi_diameter=wide)
    return lens, dataclasses.replace(scene, field=jnp.asarray(generator.uniform(-0.9, 0.9, 2)))


def test_hostile_lenses():
    """Nothing is ever not finite; what is found crosses the stop at its point; and the fan finds
    rays that the first aim does not, beside those that it does."""
    _, _, points, found = problem("tilted")
    weights = random_like(found.hits)
    saved = mixed = lost = 0
    for seed in range(40):
        lens, scene = hostile(seed)
        found, first = search(lens, scene, points), aimed(lens, scene, points, ZERO)
        good = np.asarray(found.status) == Status.OK
        for hits, target in zip(found.hits, crossings(lens, scene, points), strict=True):
            ours = np.asarray(hits)[2]  # the stop is the third live surface
            np.testing.assert_allclose(ours[good], np.asarray(target)[good], rtol=0, atol=1e-12)
        every = found.hits, gradient(lens, scene, points, found, weights)
        assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(every))
        late = good & (np.asarray(first.status) != Status.OK)
        saved, lost = saved + np.sum(late), lost + np.sum(~good)
        mixed += np.any(late) and np.any(good & ~late)
    print(saved, mixed, lost)
    assert saved >= 20 and mixed >= 2 and lost >= 20


def test_the_fan_under_vmap():
    """Scenes that need it and scenes that do not, side by side: each as alone."""
    _, _, points, _ = problem("tilted")
    scenes = [hostile(seed) for seed in range(8)]
    alone = [search(*scene, points) for scene in scenes]
    batch = jax.tree.map(lambda *a: jnp.stack(a), *scenes)
    together = jax.jit(jax.vmap(search, (0, 0, None)))(*batch, points)
    for i, one in enumerate(alone):
        np.testing.assert_array_equal(together.status[i], one.status)
        for mine, wanted in zip(together.hits, one.hits, strict=True):
            np.testing.assert_allclose(mine[i], wanted, rtol=0, atol=1e-11)


def test_float32_gradient_is_the_rounded_float64_one():
    lens, scene, points, found = problem("tilted")
    given = lens, scene, points, found, random_like(found.hits)
    exact = gradient(*given)
    single = jax.tree.map(lambda a: a.astype(jnp.float32) if a.dtype == float else a, given)
    for a, b in zip(jax.tree.leaves(exact), jax.tree.leaves(gradient(*single)), strict=True):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a, rtol=0, atol=1e-4 * np.max(np.abs(a), initial=1e-9))


def test_several_rays_that_are_sought():
    """Two of a bundle that the first aim does not find: each from its own nearest starts."""
    radius, gap = (-21.77, -9.051, 14.174, 9.3, "inf"), (2.219, 1.995, 6.392, 6.941, 22.718)
    index = (1.804, 1, 1.402, 1, 1)
    names = "radius", "thickness", "index"
    rows = [dict(zip(names, row, strict=True)) for row in zip(radius, gap, index, strict=True)]
    rows[-1] |= {"stop": True, "semi_diameter": 8.1456}
    points = [[0, 0], [0, 1], [0, -1], [1, 0], [-0.113, 0.078], [0.866, 0.282], [0.648, -0.427]]
    rays = trace_rays(load_lens({"surfaces": rows}), 0.23138, 1e3, [0.55], points)
    assert np.all(rays.status == Status.OK)
