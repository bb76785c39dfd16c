"""Lenses by name and from files."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import LensError, Scene, load_lens


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(LensError, match=r"no bundled lens 'triplett'.*cooke_triplet"):
        load_lens("triplett")
    with pytest.raises(LensError, match=r"none.yaml: cannot be read: No such file"):
        load_lens(tmp_path / "none.yaml")
    (tmp_path / "broken.yaml").write_text("surfaces: [")
    with pytest.raises(LensError, match=r"broken.yaml: line 2: not YAML"):
        load_lens(tmp_path / "broken.yaml")
    (tmp_path / "empty.yaml").write_text("")
    with pytest.raises(LensError, match=r"empty.yaml: expected a mapping with the keys name, "):
        load_lens(tmp_path / "empty.yaml")


def test_a_file_without_a_name_gives_its_own(tmp_path):
    entry = "surfaces: [{radius: 50, semi_diameter: 5, stop: true, index: 1.5, thickness: 90}]"
    (tmp_path / "mine.yml").write_text(entry)
    assert load_lens(tmp_path / "mine.yml").name == "mine"
    assert load_lens(str(tmp_path / "mine.yml")).sensor == 90


# Of each source: focal length in mm and f-number at a wavelength in um, half field in degrees. Of
# the Zemax samples they are the titles, of the others in the patent or a listing of Zemax.
BUNDLED = {
    "camera_50mm": (49.565, 1.84, 0.5875618, 23.5),
    "cooke_triplet": (50.0, 5.0, 0.55, 20.0),
    "dagor_240mm": (239.8934, 8.0, 0.5875618, 26.6),
    "double_gauss": (99.5, None, 0.5875618, 14.0),
    "double_gauss_addon": (99.5, None, 0.5875618, 14.0),
    "fisheye_8mm": (7.999497, 3.999748, 0.5875618, 85.0),
    "heliar_100mm": (100.019, 3.5, 0.5875618, 26.6),
    "hubble": (57600.0, 24.0, 0.55, 0.1),
    "hypergon_100mm": (103.1537, 20.0, 0.5875618, 67.0),
    "microscope_objective": (4.518818, 0.7531364, 0.5875618, 2.0),
    "petzval_100mm": (99.97499, 2.2, 0.55, 8.0),
    "phone": (4.55419, 2.957266, 0.5875618, 32.2),
    "phone_tele": (4.69334, 1.706669, 0.5875618, 20.0),
    "ritchey_chretien": (22009.83, 22009.83 / 3500, 0.55, 0.2),
    "singlet": (100.0, 10.0, 0.5875618, 10.0),
    "telephoto_300mm": (299.9918, 5.999836, 0.5875618, 4.0),
}
# Lenses that other tests trace, or that are like one of these.
TRACED = {"cooke_triplet", "double_gauss", "double_gauss_addon", "singlet", "hubble"}
LARGER = {
    *("phone_tele", "heliar_100mm", "dagor_240mm", "telephoto_300mm"),
    *("camera_50mm", "hypergon_100mm", "phone", "fisheye_8mm"),
}
# Points of the stop along y, nearly to its edge (apertures of patents are rounded), and aside.
POINTS = jnp.array([[0.0, 0.98], [0.0, 0.5], [0.0, 0.0], [0.0, -0.5], [0.98, 0.0]])


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_lenses_are_those_of_their_sources(name):
    """Focal length, f-number and focus."""
    focal, number, wavelength, _ = BUNDLED[name]
    lens = load_lens(name)
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(lens))
    first = jax.jit(drt_jax.first_order)(lens, jnp.inf, jnp.array([wavelength]))
    np.testing.assert_allclose(first.focal_length, focal, rtol=2e-4 if number else 2e-2)
    np.testing.assert_allclose(first.f_number, number or first.f_number, rtol=1e-2)
    assert abs(lens.sensor - first.image_distance[0]) < 0.015 * focal


@jax.jit
def passed(lens, field, wavelength):
    rays = drt_jax.trace_rays(lens, Scene.point(field, jnp.inf, wavelength[None]), POINTS)
    return rays.status[0] == drt_jax.Status.OK


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.slow) if n in LARGER else n
        for n in sorted(set(BUNDLED) - TRACED)
    ],
)
def test_light_passes_bundled_lenses(name):
    """All light passes on the axis, and some at half of the largest field."""
    lens, (_, _, wavelength, half) = load_lens(name), BUNDLED[name]
    on_axis, off = (passed(lens, jnp.radians(f), jnp.array(wavelength)) for f in (0.0, half))
    assert on_axis.all() and off.any()


def test_every_bundled_lens_has_a_source():
    assert drt_jax.lens_names() == sorted(BUNDLED)


def test_a_lens_may_be_loaded_inside_jit():
    power = jax.jit(lambda s: s / drt_jax.focal_length(load_lens("singlet"), [0.55])[0])
    np.testing.assert_allclose(
        power(1.0), 1 / drt_jax.focal_length(load_lens("singlet"), [0.55])[0]
    )
