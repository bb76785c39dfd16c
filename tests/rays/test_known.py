"""Rays that analyses find outside of `jit`, by programs that they share."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, Status, load_lens
from drt_jax.lens.scene import checked_scene
from drt_jax.pupil.boundary import _known_stages
from drt_jax.pupil.rules import rule_rays
from drt_jax.rays.known import SEARCH, known_rays, trace_tile
from drt_jax.rays.trace import trace_bundle

from ..conftest import assert_close

# Rays in several tiles, without any order.
POINTS = drt_jax.pupil.random_disc(300, 0)[0].T


@pytest.fixture(scope="module")
def dimmed():
    """The Double Gauss with rims that vignette the beam of an oblique field."""
    lens = load_lens("double_gauss")
    edges = (0.8 * lens.semi_diameter).at[lens.stop].set(9.0)
    return dataclasses.replace(lens, semi_diameter=edges)


@pytest.mark.slow
def test_known_rays_are_those_of_a_search():
    """In tiles; also for points that are not finite, and if rays fail, with a stop that is much too
    wide."""
    lens = load_lens("singlet")
    wide = lens.semi_diameter.at[lens.stop].multiply(6.0)
    lens = dataclasses.replace(lens, semi_diameter=wide)
    scene = checked_scene(lens, Scene.radians([0.0, 0.2], np.inf, (0.6, 0.5)))
    points = POINTS.copy()
    points[:, 7] = np.inf
    known, aimed = known_rays(lens, scene, points), tuple(map(jnp.asarray, points))
    search = jax.jit(lambda point: trace_bundle(lens, point, aimed))
    for k, point in enumerate(scene.each()):
        own = jax.tree.map(lambda a: a[k], known)
        found = jax.jit(lambda point, own: trace_bundle(lens, point, aimed, own))(point, own)
        wanted = search(point)
        np.testing.assert_array_equal(found.status, wanted.status)
        assert found.status[0, 7] == Status.MISSED
        assert np.mean(found.status == Status.CROSSED) > 0.2
        assert_close(found.hits, wanted.hits, 1e-12)


def test_nothing_is_known_inside_of_jit():
    lens, seen = load_lens("singlet"), []

    def search(field):
        scene = checked_scene(lens, Scene.point(0.1, np.inf, 0.55))
        seen.append(known_rays(lens, scene, POINTS))
        return field

    jax.jit(search)(0.1)
    assert seen == [SEARCH]
    many = drt_jax.pupil.random_disc(2000, 0)[0].T
    assert known_rays(lens, checked_scene(lens, Scene.point(0.1)), many) == SEARCH


@pytest.mark.slow
def test_analyses_share_the_programs_that_find_rays(dimmed):
    """For any analysis, rule, and number of object points."""
    two = Scene.degrees([0, 14], wavelengths=(0.6, 0.48))
    drt_jax.spot_diagram(dimmed, two)
    rule_rays(dimmed, checked_scene(dimmed, two), drt_jax.Clipped(5, "bilateral"))
    programs = trace_tile, _known_stages
    before = [program.program()._cache_size() for program in programs]
    three = Scene.degrees([0, 7, 14], wavelengths=(0.6, 0.48))
    drt_jax.psf_moments(dimmed, three, drt_jax.Clipped(9, "bilateral"))
    drt_jax.wavefront(dimmed, three, POINTS.T)
    drt_jax.distortion(dimmed, three)
    drt_jax.trace_rays(dimmed, three, POINTS.T[:20])
    assert [program.program()._cache_size() for program in programs] == before


@pytest.mark.slow
def test_parts_of_a_pupil_are_those_inside_of_jit():
    """Points and weights of a rule with an obscuration, from a plan of known numbers."""
    lens, rule = load_lens("hubble"), drt_jax.Clipped(6, "bilateral")
    scene = checked_scene(lens, Scene.degrees(0.1, wavelengths=0.55))
    eager = rule.points(lens, scene, rule.plan(lens, scene))
    inside = jax.jit(lambda lens: rule.points(lens, scene))(lens)
    assert_close(eager, inside, 1e-12)
