"""Lenses written and read back."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import LensError, lens_names, load_lens, save_lens

ODD = {
    "name": "odd",
    "object": {"glass": "water"},
    "surfaces": [
        {"radius": 30.1, "thickness": 0.1, "nd": 1.8, "vd": 30.3, "conic": -0.7}
        | {"obscuration": [{"circle": 1 / 3}, {"ellipse": [1 / 7, 3], "centre": [1 / 9, 0]}]},
        {"radius": -1 / 3, "thickness": 1 / 3, "glass": "F2", "coefficients": {4: 1e-300, 6: 0.1}},
        {"curvature": 0, "thickness": 2.0, "stop": True}
        | {"aperture": {"rectangle": [0.3, 1 / 7]}, "obscuration": {"rectangle": [0.1, 5]}},
        {"form": "biconic", "radius": 77.7, "radius_x": 55.5, "conic_x": 0.3, "thickness": 30.0},
        {"form": "polynomial_xy", "radius": -9e9, "coefficients": {"x1y1": 1e-3}, "mirror": True}
        | {"thickness": -12.0, "tilt": [0.1, 45, -7.7], "decentre": [0, 1 / 7]},
        {"form": "qbfs", "radius": 99, "norm_radius": 7.1, "coefficients": {0: 0.1, 3: 1e-3}}
        | {"thickness": -3.0},
        {"form": "zernike", "radius": 99, "norm_radius": 6.7, "coefficients": {7: 1e-3}}
        | {"thickness": -12.0, "index": 1.5},
    ],
    "sensor_tilt": [1, 2, 3],
}
STOP = {"semi_diameter": 5.0, "stop": True}
FOLDED = {
    "surfaces": [
        {"radius": 30.0, "thickness": 0.1, "glass": "F2", "stop": True, "semi_diameter": 1.0}
        | {"phase": {"order": -2, "coefficients": {2: 1 / 3, 6: 0.1}}},
        {"radius": "inf", "thickness": 1.0, "phase": {"form": "linear", "coefficients": {"y": 7}}},
        {"radius": "inf", "mirror": True, "thickness": -3.0, "tilt": [45, 0, 0]},
    ],
    "elements": [
        {"surfaces": ["sensor", "sensor"], "about": 2, "tilt": [90.0, 0, 0.1]},
        {"surfaces": [0, 1], "shift": [0.1, 1 / 7, 0], "pivot": 0.3},
    ],
}
CASES = {
    **{name: name for name in lens_names()},
    "odd": ODD,
    "folded": FOLDED,
    "glasses": {
        "glasses": {
            "SK16": {"schott": [2.6, -0.015, 0.01, 0.0016, 0, 0], "range": [0.4, 0.7]},
            "mine": {"sellmeier": [1.2, 0.5, 0.01, 100.0], "schott": [1.1, 0, 0, 0, 0, 0]},
            "constant": {"schott": [2.25, 0, 0, 0, 0, 0]},
        },
        "object": {"glass": "constant"},
        "surfaces": [
            {"radius": 50.0, "thickness": 4.0, "glass": "SK16"},
            {"radius": 90.0, "thickness": 4.0, "glass": "mine"},
            {"radius": "inf", "thickness": 50.0, "glass": "water", **STOP},
        ],
    },
    "index": {
        "surfaces": [
            {"radius": 50.0, "thickness": 4.0, "index": 1.1, "coefficients": {4: 0, 6: 0}},
            {"radius": "inf", "thickness": 50.0, "stop": True, "semi_diameter": 5.0},
        ]
    },
}


def test_a_lens_that_a_program_returns_keeps_its_glasses(tmp_path):
    """Its names are lost, as the program serves lenses of all names; constants tell the glasses."""
    lens = load_lens("double_gauss")
    returned = jax.jit(lambda lens: lens)(lens)
    assert returned.name == "" and returned.glasses[1] == "glass 1"
    save_lens(returned, tmp_path / "lens.yaml")
    assert load_lens(tmp_path / "lens.yaml").glasses == lens.glasses


@pytest.mark.parametrize("name", CASES)
def test_a_lens_comes_back(name, tmp_path):
    """Everything that is static, and every number but tilts to the last digit."""
    lens = load_lens(CASES[name])
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    assert again.glasses == lens.glasses and again.name == (lens.name or again.name)
    assert jax.tree.structure(again) == jax.tree.structure(dataclasses.replace(lens))
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(lens), strict=True):
        np.testing.assert_array_max_ulp(np.asarray(a), np.asarray(b), 1)
    for field in ("curvature", "conic", "coefficients", "thickness", "sensor", "dispersion"):
        pairs = zip(jax.tree.leaves(getattr(again, field)), jax.tree.leaves(getattr(lens, field)))
        assert all(np.array_equal(a, b) for a, b in pairs), field


def test_the_patent_lens_comes_back(shared, tmp_path):
    lens = load_lens(shared / "patent_rf50.yaml")
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    assert again.glasses == lens.glasses
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(lens), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_lens_that_an_optimiser_moved(tmp_path):
    """Numbers that nobody typed; the Abbe number of a model glass among them."""
    lens = load_lens(ODD)
    change = np.random.default_rng(0).normal(size=100)
    leaves, structure = jax.tree.flatten(lens)
    moved = [leaves[k] * (1 + 1e-3 * change[k]) for k in range(len(leaves))]
    found = jax.tree.unflatten(structure, moved)
    found = dataclasses.replace(found, dispersion=lens.dispersion)
    model = found.dispersion.model.at[1].mul(1.01)
    found = dataclasses.replace(found, dispersion=dataclasses.replace(lens.dispersion, model=model))
    save_lens(found, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_max_ulp(np.asarray(a), np.asarray(b), 1)


def test_glasses_that_an_optimiser_moved(tmp_path):
    """Two elements of one glass, moved apart, beside one that stayed as it is in the catalogue."""
    rows = [
        {"radius": 50, "thickness": 4, "glass": "SK16"},
        {"radius": -50, "thickness": 1, "glass": "F2"},
        {"radius": 90, "thickness": 4, "glass": "SK16"},
        {"radius": 70, "thickness": 90} | STOP,
    ]
    lens = load_lens({"surfaces": rows})
    schott = lens.dispersion.schott.at[1, 0].add(1e-3).at[3, 1].add(1e-5)
    moved = dataclasses.replace(
        lens, dispersion=dataclasses.replace(lens.dispersion, schott=schott)
    )
    save_lens(moved, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    assert again.glasses == ("air", "SK16", "F2", "SK16*", "air")
    np.testing.assert_array_equal(again.dispersion.ranges, lens.dispersion.ranges)
    for a, b in zip(jax.tree.leaves(again), jax.tree.leaves(moved), strict=True):
        np.testing.assert_array_equal(a, b)


def test_what_a_prescription_cannot_hold(tmp_path):
    lens = load_lens("singlet")
    curved = dataclasses.replace(lens, curvature=lens.curvature.at[-1].set(0.01))
    with pytest.raises(LensError, match="sensor"):
        save_lens(curved, tmp_path / "lens.yaml")
    patent = load_lens({"surfaces": [{"radius": 9, "nd": 1.5, "vd": 50, "thickness": 9} | STOP]})
    melted = dataclasses.replace(patent.dispersion, strength=patent.dispersion.strength + 1e-6)
    with pytest.raises(LensError, match=r"glasses\[1\]: a prescription has no constants beside nd"):
        save_lens(dataclasses.replace(patent, dispersion=melted), tmp_path / "lens.yaml")
    with pytest.raises(LensError, match="cannot be written"):
        save_lens(lens, tmp_path / "nowhere" / "lens.yaml")
    assert not any(tmp_path.iterdir()) and jnp.all(jnp.isfinite(lens.curvature))
