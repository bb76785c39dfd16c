"""Growth of a singlet whose optimum is known from another program, see `test_optimum`."""

import pytest

import drt_jax
from drt_jax import Scene, design
from drt_jax.design import Variables

from .test_optimum import OPTIMUM, SINGLET, grid


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    path = tmp_path_factory.mktemp("lens") / "singlet.yaml"
    path.write_text(SINGLET.format(1000, -1000))
    variables = Variables.from_lens(drt_jax.load_lens(path), ["curvature"])
    return design.Problem.from_variables(
        variables, ["spot"], Scene.radians(0.0, wavelengths=0.55), grid(5)
    )


@pytest.mark.slow
def test_a_lens_grows_to_its_whole_aperture_and_to_its_optimum(problem):
    parts = []
    found = design.grow(problem, 16 * OPTIMUM, callback=lambda search: parts.append(search.merit))
    assert found.done == 1 and found.ended and found.steps == len(parts)
    best = design.optimise(problem, found.vector)
    assert best.merit <= OPTIMUM * (1 + 1e-9)


@pytest.mark.slow
def test_growth_ends_where_the_target_is_out_of_reach(problem):
    """By third-order spherical aberration, r^2 of a spot is proportional to the sixth power of the
    aperture."""
    target = 0.1 * OPTIMUM
    found = design.grow(problem, target)
    assert found.ended and found.failed.score > target
    assert 0.66 < found.done < 0.71
    part = design.part_of(problem, found.done)
    assert part.merit(found.vector) <= target
