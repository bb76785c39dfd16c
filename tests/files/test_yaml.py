"""Lenses by name and from files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import LensError, load_lens

from ..conftest import LENSES, RGB


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(LensError, match=r"no bundled lens 'triplett'.*cooke_triplet"):
        load_lens("triplett")
    with pytest.raises(LensError, match=r"none.yaml: cannot be read: No such file"):
        load_lens(tmp_path / "none.yaml")
    (tmp_path / "broken.yaml").write_text("surfaces: [")
    with pytest.raises(LensError, match=r"broken.yaml: not a YAML file"):
        load_lens(tmp_path / "broken.yaml")
    (tmp_path / "empty.yaml").write_text("")
    with pytest.raises(LensError, match=r"empty.yaml: expected a mapping with the keys name, "):
        load_lens(tmp_path / "empty.yaml")


def test_a_file_without_a_name_gives_its_own(tmp_path):
    entry = "surfaces: [{radius: 50, semi_diameter: 5, stop: true, index: 1.5, thickness: 90}]"
    (tmp_path / "mine.yml").write_text(entry)
    assert load_lens(tmp_path / "mine.yml").name == "mine"
    assert load_lens(str(tmp_path / "mine.yml")).sensor == 90


@pytest.mark.parametrize("name", LENSES)
def test_bundled_lenses_load_and_focus_on_their_sensor(name):
    lens = load_lens(name)
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(lens))
    focus = jax.jit(drt_jax.image_distance)(lens, jnp.inf, jnp.array(RGB))
    assert np.all(np.abs(lens.sensor - focus) < 1.5)
    assert sorted(drt_jax.lens_names()) == sorted(LENSES)


def test_a_lens_may_be_loaded_inside_jit():
    power = jax.jit(lambda s: s / drt_jax.focal_length(load_lens("singlet"), [0.55])[0])
    np.testing.assert_allclose(
        power(1.0), 1 / drt_jax.focal_length(load_lens("singlet"), [0.55])[0]
    )
