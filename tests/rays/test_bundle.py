"""Large bundles: aimed by polynomials, solved in tiles, against the same rays solved plainly."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Status, load_lens, trace_rays
from drt_jax.rays import implicit
from drt_jax.pupil import rules as pupil

RAYS, FIELD, WAVES = 2500, 0.17, (0.6, 0.48)


@pytest.fixture(scope="module")
def lens():
    return load_lens("double_gauss")


@pytest.fixture(scope="module")
def points():
    return jnp.asarray(pupil.random_disc(RAYS, 0)[0].T)


@pytest.fixture(scope="module")
def rays(lens, points):
    return trace_rays(lens, FIELD, 25e3, WAVES, points)


def test_no_newton_step_remains(rays):
    assert jnp.all(rays.status == Status.OK)
    assert int(rays.newton_steps) == 0


def test_every_ray_obeys_snell_and_crosses_its_stop_point(lens, points, rays):
    some = slice(0, RAYS, 10)
    for k, wave in enumerate(WAVES):
        hits, ok = jax.vmap(drt_jax.trace_snell, (None, None, 0, 0))(
            lens, jnp.asarray(wave), rays.points[k, some, 0], rays.directions[k, some, 0]
        )
        assert jnp.all(ok)
        np.testing.assert_allclose(rays.points[k, some], hits, rtol=0, atol=1e-11)
    crossed = rays.points[:, :, lens.stop, :2] / lens.semi_diameter[lens.stop]
    np.testing.assert_allclose(crossed, jnp.broadcast_to(points, crossed.shape), rtol=0, atol=1e-15)


def test_gradients_are_those_of_small_bundles(lens, points):
    weight = jnp.asarray(np.random.default_rng(0).standard_normal((RAYS, 2)))

    def total(lens, field, points, weight):
        rays = trace_rays(lens, field, 25e3, WAVES, points)
        return jnp.sum(weight * rays.points[:, :, -1, :2]) + jnp.sum(weight[:, 0] * rays.path)

    gradient = jax.jit(jax.grad(total, (0, 1, 2), allow_int=True))
    whole = gradient(lens, FIELD, points, weight)
    parts = [
        gradient(lens, FIELD, points[i : i + 500], weight[i : i + 500]) for i in range(0, RAYS, 500)
    ]
    lenses = [part[0] for part in parts]
    for name in ("curvature", "conic", "thickness", "sensor", "semi_diameter"):
        small = sum(getattr(one, name) for one in lenses)
        np.testing.assert_allclose(
            getattr(whole[0], name), small, rtol=1e-9, atol=1e-9 * float(jnp.max(jnp.abs(small)))
        )
    np.testing.assert_allclose(whole[1], sum(part[1] for part in parts), rtol=1e-10)
    np.testing.assert_allclose(
        whole[2], jnp.concatenate([part[2] for part in parts]), rtol=1e-8, atol=1e-8
    )


@pytest.mark.slow
def test_forward_mode(lens, points):
    def sensor(curvature):
        changed = dataclasses.replace(lens, curvature=curvature)
        return trace_rays(changed, FIELD, 25e3, WAVES[:1], points, forward=True).points[
            0, :, -1, :2
        ]

    step = 1e-6 * jnp.cos(jnp.arange(lens.curvature.size))
    slope = jax.jit(lambda: jax.jvp(sensor, (lens.curvature,), (step,))[1])()
    value = jax.jit(sensor)
    change = value(lens.curvature + 1e-2 * step) - value(lens.curvature - 1e-2 * step)
    np.testing.assert_allclose(
        slope, change / 2e-2, rtol=0, atol=1e-6 * float(jnp.max(jnp.abs(slope)))
    )


@pytest.mark.slow
def test_rays_that_fail_are_told_apart(lens, points):
    """A field at which part of the beam is lost: the same rays as in small bundles, and the same
    verdicts, but for rays so close to an edge that rounding decides what is said of them."""
    whole = trace_rays(lens, 0.4, 25e3, WAVES[:1], points[:1500])
    parts = [trace_rays(lens, 0.4, 25e3, WAVES[:1], points[i : i + 500]) for i in (0, 500, 1000)]
    status = jnp.concatenate([part.status for part in parts], axis=1)
    assert 0 < int(jnp.sum(status != Status.OK)) < 1500
    assert jnp.all((whole.status == Status.OK) == (status == Status.OK))
    assert int(jnp.sum(whole.status != status)) <= 3
    np.testing.assert_allclose(
        whole.points, jnp.concatenate([part.points for part in parts], axis=1), rtol=0, atol=1e-11
    )
    gradient = jax.grad(
        lambda field: jnp.sum(
            trace_rays(lens, field, 25e3, WAVES[:1], points[:1500]).points[:, :, -1]
        )
    )(0.4)
    assert jnp.isfinite(gradient)


def test_memory_a_ray_keeps_for_the_backward_pass(lens):
    """The hits and a status: 16 bytes a surface and 4; the rest does not grow with the bundle."""

    def kept(rays):
        points = jax.ShapeDtypeStruct((2, rays), jnp.float64)

        def solve(points):
            scene = jnp.array([0.0, FIELD]), jnp.array(25e3), jnp.array(WAVES[:1])
            system = drt_jax.rays.trace.system_of(
                lens, drt_jax.rays.trace._live_surfaces(lens), *scene, points
            )
            return jax.vjp(implicit.solve_rays, system)

        out = jax.eval_shape(solve, points)
        return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(out[1]))

    few, many = kept(4096), kept(65536)
    assert (many - few) / (65536 - 4096) <= 16 * 12 + 4 + 16  # and the stop points themselves
