"""Surfaces that are inserted and removed change no ray that they should not change."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design, trace_rays

from .. import oracle

PUPIL = np.array([[0.0, 0.0], [0.6, -0.3], [-0.2, 0.8], [0.0, -0.9]])
GLASS, AIR = drt_jax.find_glass("N-LAK9"), drt_jax.find_glass("air")
SCENE = Scene.degrees([[0, 0], [3, 8]], 2e3, (0.6, 0.48))


def ends(lens, scene=SCENE):
    """Hits on the sensor and optical paths of some rays, by an independent trace."""
    points, path = oracle.rays_of(lens, scene, PUPIL)
    return points[..., -1, :], path


@pytest.mark.slow
def test_a_thin_meniscus_changes_rays_by_as_little_as_it_is_thin():
    lens, found = drt_jax.load_lens("cooke_triplet"), []
    for thin in (1e-3, 1e-4, 1e-5):
        more = design.inserted(lens, 1, GLASS, 2, 3.0, thin)
        assert more.count == lens.count + 2 and more.glasses[3] == "N-LAK9"
        assert more.stop == lens.stop + 2
        np.testing.assert_array_equal(more.curvature[2:4], [lens.curvature[2]] * 2)
        np.testing.assert_allclose(more.vertices[4:], lens.vertices[2:], atol=1e-13)
        more.check()
        found.append(np.max(np.abs(ends(more)[0] - ends(lens)[0])))
    np.testing.assert_allclose(found / found[0], [1, 0.1, 0.01], rtol=1e-3)


def test_a_meniscus_in_front_of_the_lens_moves_the_zero_of_z():
    lens = drt_jax.load_lens("cooke_triplet")
    more = design.inserted(lens, -1, 1, None, 0.2, 1e-5)
    assert more.glasses[1] == "SK16" and more.stop == lens.stop + 2
    np.testing.assert_allclose(more.vertices[2:], lens.vertices + 0.20001, atol=1e-13)
    np.testing.assert_allclose(more.sensor, lens.sensor + 0.20001, atol=1e-13)
    far = Scene.degrees([[0, 0], [3, 8]], np.inf, (0.6, 0.48))
    hits = [ends(a, far)[0][..., :2] for a in (more, lens)]
    np.testing.assert_allclose(*hits, rtol=0, atol=1e-5)


def test_a_pair_in_a_medium_of_the_same_index_changes_no_ray():
    lens = drt_jax.load_lens("cooke_triplet")
    same = dataclasses.replace(drt_jax.find_glass("SK16"), name="twin")
    one, two = ends(lens), ends(design.inserted(lens, 0, same, None, 1.0, 1.5))
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name, surface", [("phone", 0), ("camera_50mm", 0), ("double_gauss", 2)])
def test_a_split_element_put_together_is_the_very_lens(name, surface):
    lens = drt_jax.load_lens(name)
    split = design.inserted(lens, surface, AIR, distance=0.3 * abs(lens.thickness[surface]))
    assert split.count == lens.count + 2 and np.all(np.isfinite(ends(split)[1]))
    back = design.removed(split, (surface + 1, surface + 2))
    assert back.glasses == lens.glasses and back.forms == lens.forms and back.stop == lens.stop
    for a, b in zip(jax.tree.leaves(lens), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-13)


def test_derivatives_go_through_a_pair():
    lens = drt_jax.load_lens("cooke_triplet")

    def path(bend):
        more = design.inserted(lens, 1, GLASS)
        bent = dataclasses.replace(more, curvature=more.curvature.at[2].add(bend))
        return jnp.sum(trace_rays(bent, SCENE, PUPIL).path)

    slope, step = jax.grad(path)(0.0), 1e-5
    assert float(slope) == pytest.approx(float(path(step) - path(-step)) / (2 * step), rel=1e-6)
    assert abs(slope) > 1e-3


def test_what_a_lens_carries_goes_along():
    """Apertures, phases and elements of a lens file stay at their surfaces."""
    lens = drt_jax.load_lens("hubble")
    plate = drt_jax.find_glass("N-BK7")
    more = design.inserted(lens, lens.count - 1, plate)
    assert more.apertures.surfaces == lens.apertures.surfaces and more.mirrors[-2:] == (False,) * 2
    shifted = design.inserted(lens, 0, plate, distance=1.0)
    moved = tuple(i + 2 * (i > 0) for i in lens.apertures.surfaces)
    assert shifted.apertures.surfaces == moved and shifted.stop == lens.stop + 2 * (lens.stop > 0)


def test_an_element_taken_out_leaves_the_others_in_place():
    lens = drt_jax.load_lens("double_gauss")
    less = design.removed(lens, (0, 1))
    assert less.count == lens.count - 2 and less.glasses == lens.glasses[2:]
    z, own = np.asarray(lens.vertices), np.asarray(less.vertices)
    np.testing.assert_allclose(own, z[2:] - z[2], atol=1e-12)
    np.testing.assert_allclose(less.sensor, lens.sensor - z[2], atol=1e-12)
    last = design.removed(lens, (lens.count - 2, lens.count - 1))
    np.testing.assert_allclose(last.sensor, lens.sensor)
    assert len(last.thickness) == last.count - 1


def test_another_stop_passes_the_same_beam():
    lens = drt_jax.load_lens("double_gauss")
    other = design.with_stop(lens, 0)
    waves = 0.5875618
    one, two = (drt_jax.first_order(a, np.inf, waves) for a in (lens, other))
    np.testing.assert_allclose(one.f_number, two.f_number, rtol=1e-12)
    np.testing.assert_allclose(two.entrance_pupil.position, 0, atol=1e-12)


def test_a_sphere_becomes_an_asphere_that_can_be_bent():
    lens = drt_jax.load_lens("cooke_triplet")
    more = design.with_asphere(lens, 3, (4, 8))
    assert more.coefficients.shape == (lens.count + 1, 4) and not np.any(more.coefficients)
    assert design.with_asphere(more, 2, (4,)).coefficients.shape[1] == 4
    np.testing.assert_allclose(ends(more)[0], ends(lens)[0], rtol=0, atol=1e-12)
    vary = [design.Vary("coefficients", (3,), sag=0.1, semi_diameter=5)]
    names = design.Variables.from_lens(more, vary).names
    assert list(names) == [f"coefficients 3[{k}]" for k in (1, 2, 3)]


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda lens: design.inserted(lens, 9, GLASS), "surface: expected one from 0 to 5, got 9"),
        (lambda lens: design.inserted(lens, 1, AIR), "glass: air is behind surface 1 already"),
        (lambda lens: design.removed(lens, (0, 2)), "surfaces: expected some neighbours of 0 to 5"),
        (lambda lens: design.removed(lens, range(6)), "surfaces: expected some neighbours"),
        (lambda lens: design.removed(lens, (lens.stop,)), "surfaces: . is the stop: see `with_s"),
        (lambda lens: design.removed(lens, (0,)), "air in front of 0, SK16 behind 0: take out a"),
        (lambda lens: design.with_stop(lens, "2"), "surface: expected whole numbers"),
        (lambda lens: design.inserted(lens, 1, GLASS, distance=0), "expected two numbers above 0"),
        (lambda lens: design.inserted(lens, 1, GLASS, thickness=9), "9 mm behind surface 1: expec"),
        (lambda lens: design.with_asphere(lens, 1, (3,)), "orders: expected even powers from 4"),
    ],
)
def test_what_cannot_be_done_is_refused(change, told):
    with pytest.raises(ValueError, match=told):
        change(drt_jax.load_lens("cooke_triplet"))


def test_a_lens_in_float32_stays_so():
    """Also in a process with float64, for glasses of the catalogue."""
    small = jax.tree.map(lambda a: a.astype(jnp.float32), drt_jax.load_lens("cooke_triplet"))
    found = design.inserted(small, 1, drt_jax.find_glass("N-BK7"))
    assert {leaf.dtype for leaf in jax.tree.leaves(found)} == {jnp.dtype("float32")}
