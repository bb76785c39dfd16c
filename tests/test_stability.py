"""Random scenes made to break the tracer, a small part of `python -m experiments.stability`."""

import jax
import numpy as np
import pytest

from drt_jax import Status
from experiments import _survey
from experiments._scenes import FAMILIES, draw
from experiments.stability import row_of

SCENES = 40
# One static structure, so that a few compiled programs serve all: five surfaces, the stop third.
NAMES = ("aperture", "curvature", "conic", "asphere", "index", "edge", "touching", "distance",
         "focus", "field")  # fmt: skip
# Rays in 10,000 that Snell's law can trace and we do not find: see docs/limits.md.
LIMIT = 60


@pytest.fixture(scope="module")
def rows():
    surveys = {name: [_survey.survey(s) for s in draw(name, SCENES, 1, (2,))] for name in NAMES}
    return {name: row_of(name, parts) for name, parts in surveys.items()}


@pytest.mark.parametrize("name", NAMES)
def test_numbers_are_finite_and_good_rays_obey_snell(rows, name):
    row = rows[name]
    assert row["rays"] == 8 * SCENES and row["ok"] > row["rays"] / 10
    assert row["nan_values"] == row["nan_gradients"] == 0
    assert row["disagree_with_snell"] == 0


def test_the_families_hold_rays_of_every_kind(rows):
    for kind in ("ok", "missed", "tir"):
        assert sum(row[kind] for row in rows.values()) > 10


def test_rays_that_exist_are_found(rows):
    lost, rays = (sum(row[key] for row in rows.values()) for key in ("traceable", "rays"))
    assert 1e4 * lost <= LIMIT * rays


@pytest.mark.parametrize("name", ["cooke_triplet", "singlet"])
def test_float32_of_a_camera_within_a_tenth_of_a_micrometre(name):
    """99 % of rays of perturbed lenses, all surfaces and the sensor."""
    scenes = next(draw("camera, float32", 100, 1, (name,)))
    trace = _survey._compiled["plain"]
    single, reached = _survey._run(trace, *scenes)
    double, also = _survey._run(trace, *jax.tree.map(lambda a: a.astype(float), scenes))
    both = (reached == Status.OK) & (also == Status.OK)
    assert np.mean(both) > 0.8 and single.dtype == np.float32
    error = np.max(np.abs(single - double), axis=(-1, -2))[both]
    assert np.percentile(error, 99) < 1e-4


def test_an_aperture_of_a_tilted_lens_is_met():
    """Rays cross a tilted stop where they are asked to, in each of its own coordinates."""
    scenes = next(draw("tilted", 50, 1))
    assert FAMILIES["tilted"].dtype == "float64"
    points, status = _survey._run(_survey._compiled["plain"], *scenes)
    stop, good = scenes.lens.stop, status[:, 0] == Status.OK
    place = np.concatenate([np.zeros((50, 1)), np.cumsum(scenes.lens.thickness, axis=1)], axis=1)
    origin = np.stack([*scenes.lens.decentre[:, stop].T, place[:, stop]], -1)
    turn = np.asarray(jax.vmap(_survey.rotation_matrix)(scenes.lens.tilt[:, stop]))
    own = np.einsum("nij,nqi->nqj", turn, points[:, 0, :, stop] - origin[:, None])
    target = scenes.lens.semi_diameter[:, stop, None, None] * scenes.pupil
    assert np.mean(good) > 0.5
    np.testing.assert_allclose(own[good][:, :2], target[good], atol=1e-12)
