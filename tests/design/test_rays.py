"""Merits, spots and yields count no ray as failed that the full search finds."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design
from drt_jax.design import Tolerance, Vary
from drt_jax.lens.scene import checked_scene
from drt_jax.rays.find import find, find_aimed

from ..known import aims

RGB = (0.486, 0.588, 0.656)
# Wider apertures and larger fields than those for which the lenses are made: the paraxial launch of
# 4 to 17 % of the rays misses the lens.
WIDE = (
    ("phone", 1.35, 24),
    ("telephoto_300mm", 1.1, 10),
    ("heliar_100mm", 1.1, 14),
    ("double_gauss", 1.7, 12),
)


def opened(name, factor):
    """A lens with a larger stop, and without any other aperture."""
    lens = drt_jax.load_lens(name)
    stop = np.arange(lens.count + 1) == lens.stop
    wide = jnp.where(stop, factor * lens.semi_diameter, jnp.inf)
    return dataclasses.replace(lens, semi_diameter=wide, apertures=None)


@jax.jit
def both(lens, scene, points):
    system, target = aims(lens, scene, points)
    return find_aimed(system, target), find(system, target)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "factor", "degrees"), WIDE)
def test_aiming_finds_what_the_full_search_finds(name, factor, degrees):
    lens = opened(name, factor)
    scene = checked_scene(lens, Scene.point(np.radians(degrees), np.inf, RGB))
    points, _ = drt_jax.Gauss(6, "bilateral").points(lens, scene)
    aimed, full = both(lens, scene, points)
    assert np.all(full.status == drt_jax.Status.OK)
    assert np.array_equal(aimed.status, full.status)
    for one, other in zip(aimed.hits, full.hits):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_spots_of_a_design_are_those_of_the_moments():
    """A fifth of the rays fail: the others have the weights of `psf_moments`."""
    lens, field = opened("phone", 1.5), np.radians(14.0)
    variables = design.Variables.from_lens(lens, [Vary("curvature")])
    rule = drt_jax.Gauss(6, "bilateral")
    problem = design.Problem.from_variables(
        variables, ["rms_spot", "spot"], Scene.radians([field], wavelengths=RGB), rule
    )
    judged = jax.jit(lambda p: p.evaluate(variables.start))(problem)
    moments = drt_jax.psf_moments(lens, Scene.point(field, np.inf, RGB), sampling=rule)
    assert int(judged.failed) > 0 and np.all(moments.throughput < 1)
    # About the centroid of all wavelengths.
    apart = moments.mean - jnp.mean(moments.mean, axis=0, keepdims=True)
    square = jnp.mean(jnp.trace(moments.covariance, axis1=1, axis2=2) + jnp.sum(apart**2, -1))
    spot = judged.residuals[1 : -(len(RGB) * (42 + 4))]
    np.testing.assert_allclose(judged.residuals[0], jnp.sqrt(square), rtol=1e-10)
    np.testing.assert_allclose(jnp.sum(spot**2), square, rtol=1e-10)


@pytest.mark.slow
def test_lenses_as_built_are_searched_in_full(monkeypatch):
    """The full search finds all rays that aiming misses, which are all rays here."""
    lens = opened("cooke_triplet", 1.0)
    variables = design.Variables.from_lens(lens, [Vary("curvature")])
    rule = drt_jax.Gauss(3, "none")
    problem = design.Problem.from_variables(
        variables, ["spot"], Scene.radians([0.2], wavelengths=(0.55,)), rule
    )
    perturbed = design.PerturbedLens.from_lens(
        lens, problem.beam_radius(lens), [Tolerance("thickness", 0.02)]
    )
    off = design.draw_perturbations(perturbed, 3, seed=1)
    wanted = design.monte_carlo(problem, perturbed, off, "focus")
    assert np.all(np.isfinite(wanted.squares))

    def blind(system, target):
        found = find_aimed(system, target)
        return found._replace(status=jnp.full_like(found.status, drt_jax.Status.UNCONVERGED))

    monkeypatch.setattr("drt_jax.design.tolerance.solve_aimed", blind)
    found = design.monte_carlo(problem, perturbed, off, "focus")
    np.testing.assert_allclose(found.squares, wanted.squares, rtol=1e-9)


@pytest.mark.slow
def test_an_optimum_is_searched_in_full(monkeypatch):
    """The same for the search for an optimum."""
    variables = design.Variables.from_lens(drt_jax.load_lens("singlet"), ["sensor"])
    problem = design.Problem.from_variables(
        variables, ["spot"], Scene.radians([0.0], wavelengths=(0.55,)), 3
    )
    wanted = design.optimise(problem)

    def blind(system, target):
        found = find_aimed(system, target)
        edge = jnp.arange(found.status.shape[-1]) == found.status.shape[-1] - 1
        failed = jnp.where(edge[None], drt_jax.Status.UNCONVERGED, found.status)
        return found._replace(status=failed.astype(jnp.int32))

    monkeypatch.setattr("drt_jax.design.optimum.solve_aimed", blind)
    monkeypatch.setattr("drt_jax.design.starts.solve_aimed", blind)
    found = design.optimise(problem)
    np.testing.assert_allclose(found.merit, wanted.merit, rtol=1e-9)
    starts, tiles = design.normal_starts(variables, 4, 1.0), []
    seen = lambda *tile: tiles.append(tile)  # noqa: E731
    minima = design.many_starts(problem, starts, steps=(20,), callback=seen).minima
    np.testing.assert_allclose(minima[0].merit, wanted.merit, rtol=1e-6)
    assert [tile[:2] for tile in tiles] == [(1, 1), (2, 2), (3, 3)]  # two of them in full
