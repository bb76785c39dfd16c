"""Large bundles, aimed by polynomials and solved in tiles, compared with the same rays in small
bundles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.snell import trace_snell

from drt_jax import Scene, Status, load_lens, pupil
from drt_jax.lens.scene import checked_scene
from drt_jax.rays import find, solve
from drt_jax.rays.bundle import tile_of
from drt_jax.rays.trace import trace_bundle

from ..conftest import assert_close
from ..known import aims, known, search

# Three tiles, the last one padded; small bundles are one without tiles.
RAYS, PART, FIELD, WAVES = 2500, 500, 0.17, (0.6, 0.48)


@pytest.fixture(scope="module")
def lens():
    return load_lens("double_gauss")


@pytest.fixture(scope="module")
def points():
    return tuple(jnp.asarray(pupil.random_disc(RAYS, 0)[0].T))


def scene(lens, field=FIELD):
    return checked_scene(lens, Scene.point(field, 25e3, WAVES))


@pytest.fixture(scope="module")
def found(lens, points):
    return search(lens, scene(lens), points)


def parts_of(tree):
    """Small bundles from arrays whose last axis is that of rays."""
    return [jax.tree.map(lambda a, i=i: a[..., i : i + PART], tree) for i in range(0, RAYS, PART)]


def found_in_parts(found):
    parts = zip(*map(parts_of, (found.hits, found.arrival, found.status)))
    return [find.Found(*some, found.steps) for some in parts]


def joined(parts):
    return jax.tree.map(lambda *a: np.concatenate(a, axis=-1), *parts)


def test_sizes():
    assert tile_of(RAYS, len(WAVES)) == 1024 < RAYS and tile_of(PART, len(WAVES)) == PART


@pytest.mark.slow
def test_no_newton_step_remains(found):
    assert np.all(found.status == Status.OK)
    assert int(found.steps) == 0


@pytest.mark.slow
def test_every_ray_obeys_snell_and_crosses_its_stop_point(lens, points, found):
    some = tuple(p[::30] for p in points)
    few = jax.tree.map(lambda a: a[..., ::30] if a.ndim else a, found)
    bundle = jax.jit(lambda *a: trace_bundle(*a[:3], known(a[3])))(lens, scene(lens), some, few)
    own = np.stack(bundle.hits)  # along the axes of the surfaces, which are those of the lens
    for k, wave in enumerate(WAVES):
        first = np.moveaxis(own[:, 0, k], 0, -1)
        z = np.asarray(surface_height(lens, first))
        first = np.concatenate([first, z[:, None]], axis=-1)
        start = first + np.array([0.0, np.tan(FIELD) * 25e3, 25e3])
        d = start / np.linalg.norm(start, axis=-1, keepdims=True)
        hits, ok = jax.jit(jax.vmap(trace_snell, (None, None, 0, 0)))(
            lens, jnp.asarray(wave, float), first - 5 * d, d
        )
        assert np.all(ok)
        wanted = np.moveaxis(np.asarray(hits)[..., :2], (0, 1, 2), (2, 1, 0))
        np.testing.assert_allclose(own[:, :, k], wanted, rtol=0, atol=1e-11)
    crossed = own[:, lens.stop] / float(lens.semi_diameter[lens.stop])
    wanted = np.broadcast_to(np.stack(some)[:, None], crossed.shape)
    # Within rounding of the neighbouring hits: a stop that bends no light is not on the path.
    np.testing.assert_allclose(crossed, wanted, rtol=0, atol=1e-13)


def surface_height(lens, w):
    """Sag of the first surface, a sphere, at (..., 2)."""
    c, r2 = float(lens.curvature[0]), np.sum(w**2, axis=-1)
    return c * r2 / (1 + np.sqrt(1 - c**2 * r2))


def hits_of(lens, scene, points, found):
    return known(found)(*aims(lens, scene, points)).hits


def weighed(lens, scene, points, found, weights):
    """A scalar of the points on the sensor."""
    hits = hits_of(lens, scene, points, found)
    return sum(jnp.sum(w * h[-1]) for w, h in zip(weights, hits, strict=True))


gradient = jax.jit(jax.grad(weighed, (0, 1, 2)))


@jax.jit
def tangent(lens, scene, points, found, moving):
    """Tangents of the hits by the lens, the scene and the points."""
    return jax.jvp(lambda *at: hits_of(*at, found), (lens, scene, points), moving)[1]


def random_like(tree):
    generator = np.random.default_rng(0)
    return jax.tree.map(
        lambda a: jnp.where(jnp.isfinite(a), generator.normal(size=a.shape), 0), tree
    )


@pytest.mark.slow
def test_derivatives_are_those_of_small_bundles(lens, points, found):
    """In reverse and forward mode."""
    at = lens, scene(lens)
    weights = random_like((found.hits[0][0], found.hits[0][0]))
    whole = gradient(*at, points, found, weights)
    small = [
        gradient(*at, p, some, w)
        for p, some, w in zip(parts_of(points), found_in_parts(found), parts_of(weights))
    ]
    total = jax.tree.map(lambda *a: sum(a), *(one[:2] for one in small))
    assert_close(whole[:2], total, 1e-9)
    assert_close(whole[2], joined([one[2] for one in small]), 1e-10)

    way = random_like(at)
    moved = random_like(points)
    whole = tangent(*at, points, found, (*way, moved))
    small = [
        tangent(*at, p, some, (*way, m))
        for p, some, m in zip(parts_of(points), found_in_parts(found), parts_of(moved))
    ]
    assert_close(whole, joined(small), 1e-12)


@pytest.mark.slow
def test_rays_that_fail_are_told_apart(lens, points):
    """At a field at which a part of the beam is lost, the same rays arrive as in small bundles,
    with the same status, except for rays so close to an edge that rounding decides their status."""
    wide = scene(lens, 0.4)
    whole = search(lens, wide, points)
    parts = [search(lens, wide, p) for p in parts_of(points)]
    status = joined([part.status for part in parts])
    lost = int(np.sum(status != Status.OK))
    assert 0 < lost < status.size
    assert np.all((whole.status == Status.OK) == (status == Status.OK))
    assert int(np.sum(whole.status != status)) <= 3
    hits = joined([part.hits for part in parts])
    for a, b in zip(whole.hits, hits, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-11)
    weights = random_like((whole.hits[0][0], whole.hits[0][0]))
    slopes = gradient(lens, wide, points, whole, weights)
    assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(slopes))


@pytest.mark.parametrize("solver", [solve.solve, solve.solve_reverse])
def test_memory_a_ray_keeps_for_the_backward_pass(lens, solver, monkeypatch):
    """For each ray the hits, 16 bytes a row, its status and its stop point; the rest does not grow
    with the bundle."""

    def at_once(system, target):
        zero, rows = jnp.zeros_like(target[0]), len(system.forms)
        hits = (jnp.broadcast_to(zero, (rows, *zero.shape)),) * 2
        return find.Found(hits, (zero,) * 3, zero.astype(jnp.int32), jnp.int32(0))

    monkeypatch.setattr(solve, "find_many", at_once)

    def kept(rays):
        points = jax.ShapeDtypeStruct((rays,), jnp.float64)

        def backward(x, y):
            return jax.vjp(solver, *aims(lens, scene(lens), (x, y)))[1]

        leaves = jax.tree.leaves(jax.eval_shape(backward, points, points))
        return sum(leaf.size * leaf.dtype.itemsize for leaf in leaves)

    each = (kept(65536) - kept(4096)) / (65536 - 4096) / len(WAVES)
    assert each <= 16 * (len(lens.active) + 1) + 4 + 16
