"""Difficult random scenes, a small part of `python -m experiments.stability`."""

from functools import partial

import jax
import numpy as np
import pytest
from experiments._families import FAMILIES, draw
from experiments.stability import bound, row_of, tables

from drt_jax import Status
from experiments import _survey

SCENES = 16
# One static structure, so that a few compiled programs serve all: five surfaces, the stop third.
NAMES = ("curvature", "asphere", "index", "edge", "close", "touching", "distance", "focus", "field")
NAMES += ("immersed", "inside focus", "collimated", "virtual image", "virtual object")
# Stops that are labels: one structure. `test_starts` has the family "offaxis". The family "rims",
# whose rays fail at rims, takes as long as all others: results/stability has it, and test_clipped
# and test_apertures test such rays.
LABELS = {"phone": 3}
# Rays in 10,000 that a sequential trace finds and we do not.
LIMIT = 1


def test_bounds_of_counts():
    """The rule of three; and 1 of 10 by Clopper and Pearson, whose upper limit solves (1 - p)^10 +
    10 p (1 - p)^9 = 0.05."""
    assert bound(0, 620) == pytest.approx(3 / 620, rel=5e-3)
    p = bound(1, 10)
    assert (1 - p) ** 10 + 10 * p * (1 - p) ** 9 == pytest.approx(0.05)
    assert bound(7, 7) == 1


def test_a_family_without_its_files_is_named():
    total = dict.fromkeys(("scenes", "rays", "nan_values", "nan_gradients"), 1)
    total |= dict.fromkeys(("disagree_with_snell", "traceable_per_10000"), 0)
    total["traceable_per_10000_but_touching"] = 0
    found = tables({"families": [], "absent": {"files": "lens files"}, "total": total})
    assert "not run: the files are not here" in found["stability, families"]


@pytest.fixture(scope="module")
def rows():
    surveys = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_survey, "_BATCH", SCENES)
        for name, variant in {**dict.fromkeys(NAMES, 2), **LABELS}.items():
            share = FAMILIES[name].share
            surveys[name] = [_survey.survey(s) for s in draw(name, SCENES / share, 1, (variant,))]
    join = partial(jax.tree.map, lambda *a: np.concatenate(a))
    return {name: row_of(name, join(*parts)) for name, parts in surveys.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NAMES, *LABELS])
def test_numbers_are_finite_and_good_rays_obey_snell(rows, name):
    row = rows[name]
    assert row["rays"] == 8 * SCENES
    assert row["ok"] > (0 if name == "touching" else row["rays"] / 5)
    assert row["nan_values"] == row["nan_gradients"] == 0
    assert row["disagree_with_snell"] == 0


@pytest.mark.slow
def test_the_families_hold_rays_of_every_kind(rows):
    for kind in ("ok", "missed", "tir"):
        assert sum(row[kind] for row in rows.values()) > 10


@pytest.mark.slow
def test_rays_that_exist_are_found(rows):
    found = [row for row in rows.values() if row["name"] != "touching"]  # its limit is known
    lost, rays = (sum(row[key] for row in found) for key in ("traceable", "rays"))
    assert 1e4 * lost <= LIMIT * rays


@pytest.mark.slow
def test_float32_of_a_camera_within_a_tenth_of_a_micrometre():
    """For 99 % of the rays of perturbed triplets, on all surfaces and the sensor."""
    scenes = next(draw("camera, float32", 100, 1, ("cooke_triplet",)))
    single = _survey._plain(*scenes)
    double = _survey._plain(*jax.tree.map(np.float64, scenes))
    both = (single.status == Status.OK) & (double.status == Status.OK)
    assert np.mean(both) > 0.8 and single.points.dtype == np.float32
    error = np.max(np.abs(single.points - double.points), axis=(-1, -2))[both]
    assert np.percentile(error, 99) < 1e-4
