"""The paraxial entrance pupil as the stop: spots of another program, and the parts of the lens that
stay."""

import dataclasses
import importlib.resources

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import drt_jax
from drt_jax import Gauss, Scene, load_lens, psf_moments, save_lens, trace_rays, with_paraxial_pupil

WAVE = 0.5876
INF = float("inf")
MOVED = [
    {"radius": 60, "thickness": 4.0, "glass": "N-BK7", "semi_diameter": 9.0},
    {"radius": -90, "thickness": 3.0, "phase": {"coefficients": {2: -0.5}}},
    {
        "radius": INF,
        "thickness": 5.0,
        "stop": True,
        "semi_diameter": 4.0,
        "aperture": {"circle": 5},
    },
    {"radius": -70, "thickness": 2.0, "nd": 1.6, "vd": 40.0, "tilt": [0.3, 0, 0]},
    {"radius": 200, "thickness": 60.0},
]
HELD = {"surfaces": [3, 4], "about": 3, "tilt": [0.5, 0, 0]}


@jax.jit
def spots(lens, field):
    """RMS radii, mm."""
    rule = Gauss(12, "bilateral")
    return jnp.sqrt(
        jnp.trace(psf_moments(lens, Scene.point(field, INF, WAVE), sampling=rule).covariance[0])
    )


@pytest.mark.slow
def test_spots_are_those_that_another_program_prints(shared):
    """OpticStudio without ray aiming, with clear apertures ignored: 16 fields, to 1e-9 each.
    Through the real stop, spots at the edge of the field are different."""
    cases = yaml.safe_load((shared / "field_cases.yaml").read_text())["cases"]
    case = next(case for case in cases if case["id"].startswith("F01"))
    folder = importlib.resources.files(drt_jax) / "lens" / "catalogue" / "lenses"
    own = yaml.safe_load((folder / "double_gauss.yaml").read_text())
    own["glasses"] = {"F5": case["glasses"]["F5"]}
    own["sensor"] = sum(row.get("thickness", 0) for row in own["surfaces"]) + 57.314537905
    lens = load_lens(own)
    wide = 33.33 / 2 / drt_jax.first_order(lens, jnp.inf, WAVE).entrance_pupil.semi_diameter[0]
    open_ones = jnp.full_like(lens.semi_diameter, INF)
    stop = lens.semi_diameter[lens.stop] * wide
    lens = dataclasses.replace(lens, semi_diameter=open_ones.at[lens.stop].set(stop))
    aimed, printed = with_paraxial_pupil(lens, WAVE), np.array(case["rms_um"])
    fields = np.radians(np.arange(16) * 14 / 15)
    ours = np.array([1e3 * spots(aimed, field) for field in fields])
    np.testing.assert_allclose(ours, printed, rtol=1e-9)
    assert abs(1e3 * float(spots(lens, fields[-1])) / printed[-1] - 1) > 0.005


@pytest.mark.slow
def test_all_else_of_the_lens_stays():
    """First-order data, and the paths of rays; the old stop clips only if it has an aperture of its
    own."""
    lens = load_lens({"surfaces": MOVED, "object": {"index": 1.2}, "elements": [HELD]})
    aimed = with_paraxial_pupil(lens, WAVE)
    aimed.check()
    assert aimed.stop == 1 and aimed.count == lens.count + 2
    for distance in (INF, 150.0):
        found = (drt_jax.first_order(each, distance, WAVE) for each in (aimed, lens))
        for ours, wanted in zip(*map(jax.tree.leaves, found), strict=True):
            np.testing.assert_allclose(ours, wanted, rtol=1e-12)
        rays = trace_rays(aimed, Scene.point(0.05, distance, WAVE), [[0.0, 0.4], [0.3, -0.2]])
        # The same rays by where they cross the old stop.
        old = np.asarray(rays.points)[0, :, 4, :2] / 4.0
        wanted = trace_rays(lens, Scene.point(0.05, distance, WAVE), old)
        assert np.all(rays.status == 0) and np.all(wanted.status == 0)
        np.testing.assert_allclose(rays.points[:, :, 2:], wanted.points, atol=1e-11)
        np.testing.assert_allclose(rays.path, wanted.path, atol=1e-11)
    edge = trace_rays(aimed, Scene.point(0.0, INF, WAVE), [[0.0, 1.15], [0.0, 1.4]]).status
    np.testing.assert_array_equal(edge[0], [0, drt_jax.Status.CLIPPED])


@pytest.mark.slow
def test_the_pupil_follows_the_lens():
    """Derivatives through its position and size, compared with differences."""
    lens = load_lens("cooke_triplet")

    @jax.jit
    @jax.value_and_grad
    def merit(curvature):
        moved = dataclasses.replace(lens, curvature=lens.curvature.at[1].add(curvature))
        aimed = with_paraxial_pupil(moved, WAVE)
        return psf_moments(
            aimed, Scene.point(0.1, INF, WAVE), sampling=Gauss(3, "bilateral")
        ).covariance[0, 1, 1]

    slope = merit(0.0)[1]
    ends = [merit(h)[0] for h in (1e-6, -1e-6)]
    np.testing.assert_allclose(slope, (ends[0] - ends[1]) / 2e-6, rtol=1e-6)


@pytest.mark.slow
def test_a_file_may_ask_for_it(tmp_path):
    """`save_lens` writes the planes, so that the file has the same lens."""
    lens = load_lens({"surfaces": MOVED, "pupil": "paraxial"})
    wanted = with_paraxial_pupil(load_lens({"surfaces": MOVED}), 0.5875618)
    jax.tree.map(np.testing.assert_array_equal, lens, wanted)
    save_lens(lens, tmp_path / "lens.yaml")
    again = load_lens(tmp_path / "lens.yaml")
    for ours, there in zip(*map(jax.tree.leaves, (again, lens)), strict=True):
        np.testing.assert_allclose(ours, there, rtol=1e-15)
    with pytest.raises(ValueError, match="pupil: expected stop or paraxial, got 'real'"):
        load_lens({"surfaces": MOVED, "pupil": "real"})


@pytest.mark.slow
def test_a_pupil_at_infinity_is_none():
    """A stop in the rear focus of the surfaces in front of it: an error; inside a trace there are
    no rays."""
    glass = {"index": 2.0, "thickness": 100.0}
    stop = {"radius": INF, "stop": True, "semi_diameter": 2.0} | glass
    lens = load_lens({"surfaces": [{"radius": 50} | glass, stop]})
    with pytest.raises(ValueError, match="entrance pupil is at infinity: take the real stop"):
        with_paraxial_pupil(lens, WAVE)

    @jax.jit
    def aimed(lens):
        return trace_rays(
            with_paraxial_pupil(lens, WAVE), Scene.point(0.0, INF, WAVE), [[0.0, 0.0], [0.0, 0.5]]
        )

    rays = aimed(lens)
    assert np.all(rays.status != 0) and np.all(np.isfinite(rays.points))
