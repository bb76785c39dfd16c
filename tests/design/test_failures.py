"""The shortfall of rays: 0 for rays that pass; for failing rays finite, increasing, and
differentiable."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Scene, load_lens
from drt_jax.design.failures import shortfall
from drt_jax.lens.scene import checked_scene
from drt_jax.rays.aim import beam_size, paraxial_launch
from drt_jax.rays.snell import meetings
from drt_jax.rays.system import system_of

POINTS = tuple(jnp.asarray(np.stack([[0.0, 0.0, 0.7, 0.0], [0.0, 1.0, 0.7, -1.0]])))
WAVES = (0.48, 0.6)


def told(lens, field=0.2):
    """Status at the end and shortfall, (W, Q) each, for the paraxial guess."""
    system = system_of(lens, checked_scene(lens, Scene.point(field, jnp.inf, WAVES)))
    radius = lens.semi_diameter[lens.stop]
    target = tuple(jnp.broadcast_to(radius * p, (2, p.size)) for p in POINTS)
    launch = paraxial_launch(system, target, beam_size(system, target)[1])
    return meetings(system, launch).status[-1], shortfall(system, launch, target)


told = jax.jit(told)


def bent(lens, surface, factor):
    """The lens with one surface stronger."""
    return dataclasses.replace(lens, curvature=lens.curvature.at[surface].multiply(factor))


def test_rays_that_come_near_their_stop_points_lack_little():
    status, found = told(load_lens("cooke_triplet"))
    assert np.all(status == 0) and np.all(found >= 0) and np.max(found) < 0.05
    assert np.all(told(load_lens("singlet"))[1] < 1e-12)  # the stop comes first


@pytest.mark.parametrize(
    "name, surface", [("cooke_triplet", 5), ("cooke_triplet", 0), ("phone", 5)]
)
def test_the_stronger_a_surface_the_more_is_lacking(name, surface):
    lens, before = load_lens(name), -1.0
    for factor in (3.0, 4.0, 6.0):
        status, found = told(bent(lens, surface, factor))
        lost = np.asarray(status) != 0
        assert lost.any() and np.all(np.isfinite(found)) and np.all(found[lost] > 0)
        assert found.max() > before or surface == 0
        before = found.max()


@pytest.mark.slow
@pytest.mark.parametrize("name, surface", [("cooke_triplet", 5), ("phone", 5)])
def test_derivatives_are_those_of_differences(name, surface):
    """Derivatives by all curvatures and thicknesses, in forward and reverse mode, also for the
    axial ray."""
    lens = bent(load_lens(name), surface, 4.0)
    count = lens.curvature.size

    def total(x):
        moved = dataclasses.replace(lens, curvature=x[:count], thickness=x[count:])
        return jnp.sum(told(moved)[1])

    x = jnp.concatenate([lens.curvature, lens.thickness])
    forward, reverse = (jax.jit(d(total))(x) for d in (jax.jacfwd, jax.grad))
    assert np.all(np.isfinite(reverse)) and np.max(np.abs(reverse)) > 0
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-9 * np.max(np.abs(reverse)))
    best = np.inf
    for h in (1e-4, 1e-5, 1e-6):
        slopes = [(total(x + h * e) - total(x - h * e)) / (2 * h) for e in np.eye(len(x))]
        best = np.minimum(best, np.abs(np.stack(slopes) - reverse))
    assert np.max(best) < 1e-6 * np.max(np.abs(reverse))
