"""A thin meniscus at a surface: the saddle point, and the descents from it in both directions."""

import dataclasses
import sys

import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design

SCENE = Scene.degrees([0, 5], np.inf, (0.588,))
ROW = {"radius": 60, "thickness": 6, "glass": "N-BK7", "semi_diameter": 8, "stop": True}
LENS = {"surfaces": [ROW, {"radius": -150}], "sensor": 86}


def problem_of(lens):
    vary = [design.Vary("curvature", low=-0.1, high=0.1), "sensor"]
    operands = ["spot", design.Operand("focal_length", low=85, high=85.01)]
    return design.Problem.from_variables(design.Variables.from_lens(lens, vary), operands, SCENE, 3)


def test_two_lines_of_equal_merit_cross_at_a_thin_meniscus():
    """With c the curvature of the surface, menisci (c, u, u) and (u, u, c) change nearly nothing; a
    change of the middle curvature alone does."""
    lens = design.open_apertures(drt_jax.load_lens(LENS))
    thin = design.inserted(lens, 1, 1, distance=0.05, thickness=0.05)  # behind the last surface
    problem = problem_of(thin)

    def merit(change):
        curvature = thin.curvature.at[1:4].add(1e-3 * np.array(change))
        return float(problem.merit(problem.variables.vector(
            dataclasses.replace(thin, curvature=curvature)
        )))  # fmt: skip

    own = merit((0, 0, 0))
    for change in ((0, 1, 1), (1, 1, 0), (0, -1, -1), (-1, -1, 0)):
        assert merit(change) == pytest.approx(own, rel=3e-3)
    assert min(merit((0, 1, 0)), merit((0, -1, 0))) > 10 * own


@pytest.mark.slow
def test_both_ways_down_from_every_surface():
    lens = design.open_apertures(drt_jax.load_lens(LENS))
    problem = problem_of(lens)
    best = design.optimise(problem, problem.variables.start, 50)
    found = list(design.insertions(best.lens, problem_of, max_steps=40))
    assert [(one.at, one.front, one.way) for one in found] == [
        *((0, True, 1), (0, True, -1), (1, False, 1), (1, False, -1)),
    ]
    assert all(one.optimum.merit < best.merit for one in found)
    assert all(one.optimum.lens.glasses.count("N-BK7") == 2 for one in found)
    # Independent of the search: psf_moments of the best one.
    least = min(found, key=lambda one: one.optimum.merit).optimum
    spots = [
        drt_jax.psf_moments(least.lens, Scene.degrees([angle], np.inf, (0.588,)), 1e-6)
        for angle in (0, 5)
    ]
    squares = sum(float(np.trace(spot.covariance[0, 0])) for spot in spots)
    assert squares == pytest.approx(least.merit, rel=0.1)  # order 3 of the design


def test_a_narrow_gap_gets_a_thinner_meniscus(monkeypatch):
    """A gap of 0.06 mm had no room for one of 0.05 mm, which ended the scan."""
    room = sys.modules["drt_jax.design.insertions"]  # whose name is that of its function, too
    monkeypatch.setattr(room, "optimise", lambda *_: None)
    rows = [ROW | {"thickness": 3}, {"radius": -150, "thickness": 0.06}, ROW | {"stop": False}]
    lens = design.open_apertures(
        drt_jax.load_lens({"surfaces": [*rows, {"radius": -90}], "sensor": 60})
    )
    found = list(design.insertions(lens, problem_of))
    assert [(one.at, one.front) for one in found[::2]] == [
        *((0, True), (1, False), (2, True), (3, False)),
    ]
    for one in found:
        thick = one.problem.variables.lens_of(one.problem.variables.start).thickness
        thin = 0.02 if one.at in (1, 2) else 0.05
        assert np.all(thick > 0) and np.sum(np.abs(thick - thin) < 1e-12) >= 2 - (one.at in (0, 3))


def test_a_lens_without_glass_is_refused():
    lens = drt_jax.load_lens("hubble")
    with pytest.raises(ValueError, match="has no surface between air and glass"):
        next(design.insertions(lens, problem_of))
