"""Surfaces along the axis: which may lie anywhere, which keep their order, which may cross."""

import numpy as np
import pytest
import yaml

from drt_jax import LensError, Scene, Status, load_lens, trace_rays

STOP = {"radius": "inf", "semi_diameter": 1.0, "stop": True}
FRONT = {"radius": 20.0, "index": 1.5, "semi_diameter": 3.0}
BACK = {"radius": -20.0, "semi_diameter": 3.0}
MIRROR = {"radius": -100.0, "mirror": True, "semi_diameter": 20.0}


def in_order(*surfaces):
    """A prescription from surfaces and the distances behind them, alternately."""
    return {
        "surfaces": [
            {**surface, "thickness": gap} for surface, gap in zip(surfaces[::2], surfaces[1::2])
        ]
    }


ANYWHERE = {
    "at the first vertex": (STOP, 0.0, FRONT, 1.0, BACK, 20.0),
    "behind the first vertex": (STOP, -0.3, FRONT, 1.0, BACK, 20.0),
    "behind the whole lens": (STOP, -5.0, FRONT, 1.0, BACK, 20.0),
    "in the glass": (FRONT, 0.3, {**STOP, "index": 1.5}, 0.7, BACK, 20.0),
    "before a surface, listed behind it": (FRONT, 1.0, BACK, -2.0, STOP, 22.0),
    "behind the sensor": (FRONT, 1.0, BACK, 30.0, STOP, -10.0),
    "tangent to a mirror": (STOP, 0.0, MIRROR, -49.0),
    "behind the rim of a mirror": (STOP, -0.5, MIRROR, -49.0),
    "beyond a mirror, in its light": (MIRROR, 3.0, STOP, -52.0),
    "alone": (STOP, 10.0),
}


@pytest.mark.parametrize("name", ANYWHERE)
def test_a_stop_that_bends_no_light_may_lie_anywhere(name):
    surfaces = ANYWHERE[name]
    lens = load_lens(in_order(*surfaces))
    np.testing.assert_array_equal(lens.vertices, np.cumsum([0.0, *surfaces[1::2]]))
    assert lens.stop not in lens.active


def test_stop_plane_that_touches_a_lens(shared):
    """P01, which OpticStudio has traced: the stop is 0 mm in front of R = 20."""
    cases = yaml.safe_load((shared / "psf_cases.yaml").read_text())["cases"]
    stop, front, back = cases[0]["prescription"]["surfaces"]
    lens = load_lens(
        {
            "surfaces": [
                {"radius": s["R"], "thickness": s["t"], "index": s.get("n_after", 1.0)}
                | ({"stop": True, "semi_diameter": s["semi_diameter"]} if s is stop else {})
                for s in (stop, front, back)
            ]
        }
    )
    np.testing.assert_allclose(lens.vertices, [0, 0, 1, 20.792])


def test_index_1_is_air():
    """A surface in air bends no light, so that its order is free."""
    surfaces = in_order(FRONT, 1.0, BACK | {"index": 1.0}, 5.0, {"radius": 9.0}, -5.0, STOP, 20.0)
    lens = load_lens({"object": {"index": 1}, **surfaces})
    assert lens.glasses == ("air", "index 1.5", "air", "air", "air") and lens.active == (0, 1)


DUMMY = {"radius": 5.0, "semi_diameter": 4.0}
WIDE = {**FRONT, "semi_diameter": 10.0}
OPEN = {**STOP, "semi_diameter": 9.5}
BACKWARDS = {
    "past the stop": (
        (FRONT, 5.0, {**STOP, "index": 1.5}, -6.0, BACK, 20.0),
        r"surfaces\[0\].thickness up to surface 2, in sum: must be positive",
    ),
    "touching, with the stop between": (
        (FRONT, 5.0, {**STOP, "index": 1.5}, -5.0, BACK, 20.0),
        "leave out one of two surfaces that touch",
    ),
    "past a dummy": (
        (STOP, 0.0, FRONT, 1.0, {**DUMMY, "index": 1.5}, -2.0, BACK, 20.0),
        r"surfaces\[1\].thickness up to surface 3, in sum: must be positive",
    ),
    "past a mirror": (
        (MIRROR, -10.0, STOP, 11.0, MIRROR, 80.0),
        r"surfaces\[0\].thickness up to surface 2, in sum: must be negative, as a mirror",
    ),
    "crossing, with the stop between": (
        (WIDE, 2.0, {**OPEN, "index": 1.5}, 2.0, {**BACK, "semi_diameter": 10.0}, 20.0),
        r"surfaces\[0\].thickness: 4 mm makes surfaces 0 and 2 cross at .* mm from the axis",
    ),
    "sensor, behind the stop": (
        (FRONT, 1.0, BACK, -2.0, STOP, 2.0),
        "sensor: 1 mm touches the vertex of surface 1 at 1 mm; move it",
    ),
}


@pytest.mark.parametrize("name", BACKWARDS)
def test_surfaces_that_bend_light_keep_their_order(name):
    surfaces, message = BACKWARDS[name]
    with pytest.raises(LensError, match=message):
        load_lens(in_order(*surfaces))


def test_a_sensor_in_front_of_the_last_surface_shows_a_virtual_image():
    """Behind a stop alone, which bends no light, it may lie anywhere."""
    with pytest.warns(UserWarning, match="sensor: 0 mm lies before the vertex of surface 1 at 1"):
        load_lens(in_order(FRONT, 1.0, BACK, -2.0, STOP, 1.0))
    with pytest.warns(UserWarning, match="as a mirror has turned the light: rays are prolonged"):
        load_lens(in_order(STOP, 5.0, MIRROR, 10.0))
    load_lens(in_order(STOP, -1.0))


@pytest.mark.parametrize("key, zeros", [("decentre", [0, 0]), ("tilt", [0, 0, 0])])
def test_zeros_that_are_written_are_variables_and_turn_off_no_check(key, zeros):
    still = {key: zeros}
    lens = load_lens(in_order(STOP, 0.0, FRONT, 1.0, BACK | still, 20.0))
    np.testing.assert_array_equal(lens.decentre, np.zeros((4, 2)))
    np.testing.assert_array_equal(lens.tilt, np.zeros((4, 3)))
    with pytest.raises(LensError, match="must be positive"):
        load_lens(in_order(STOP | still, 0.0, FRONT | still, -1.0, BACK, 20.0))
    with pytest.raises(LensError, match="cross at"):
        load_lens(in_order(OPEN, 0.0, WIDE, 1.0, BACK | {"semi_diameter": 10} | still, 20.0))
    with pytest.warns(UserWarning, match="sensor: 0 mm lies before"):
        load_lens({**in_order(STOP, 0.0, FRONT, 1.0, BACK, -1.0), f"sensor_{key}": zeros})


@pytest.mark.parametrize("key, value", [("decentre", [0, 0.1]), ("tilt", [0, 0, 1.0])])
def test_only_neighbours_of_a_moved_surface_are_not_checked(key, value):
    """A mirror at 45 degrees reflects light sideways; its neighbours may have any z."""
    moved = {key: value}
    first, second = (FRONT, 1.0, BACK), (FRONT, -1.0, BACK)
    load_lens(in_order(*first, 2.0, STOP, 2.0, FRONT | moved, -1.0, BACK, 20.0))
    load_lens(in_order(*first, 2.0, STOP, 2.0, FRONT, -1.0, BACK | moved, 20.0))
    load_lens({**in_order(STOP, 1.0, *first, -9.0), f"sensor_{key}": value})
    for lens in (
        in_order(STOP | moved, 1.0, *second, 20.0),
        in_order(*second, 2.0, STOP, 2.0, FRONT | moved, 1.0, BACK, 20.0),
        {**in_order(STOP, 1.0, *second, 20.0), f"sensor_{key}": value},
    ):
        with pytest.raises(LensError, match="must be positive"):
            load_lens(lens)


def test_surfaces_that_cross_outside_of_the_light():
    """With apertures of 10 mm the faces cross at 8.75 mm. There is only a warning if the axial beam
    is narrower, as in files whose apertures a program has chosen."""
    rows = (WIDE, 4.0, {**BACK, "semi_diameter": 10.0}, 20.0)
    with pytest.warns(UserWarning, match="cross at 8.72 mm.*light that comes there is lost"):
        load_lens(in_order(STOP, 0.0, *rows))
    with pytest.raises(LensError, match="cross at 8"):
        load_lens(in_order({**STOP, "semi_diameter": 9.5}, 0.0, *rows))


@pytest.mark.slow
def test_surfaces_that_cross_at_the_rim():
    """With a rounded aperture the lens loads with a warning, and rays that arrive there are
    lost."""
    rows = [
        {"radius": 20.0, "thickness": 4.2, "index": 1.5, "semi_diameter": 9.0},
        {"radius": -20.0, "thickness": 1.0, "semi_diameter": 9.0},
        {"radius": "inf", "thickness": 15.0, "stop": True, "semi_diameter": 9.0},
    ]
    with pytest.warns(UserWarning, match="cross at 8.9. mm.*light that comes there is lost"):
        lens = load_lens({"surfaces": rows})
    heights = np.array([0.0, 3.0, 6.0, 9.0])
    rays = trace_rays(
        lens, Scene.point(0.0, np.inf, [0.55]), np.stack([0 * heights, heights / 9], axis=-1)
    )
    assert rays.status[0, :3].tolist() == [Status.OK] * 3 and rays.status[0, -1] != Status.OK
    assert np.all(np.isfinite(rays.points))
    rows[0]["thickness"] = 3.0
    with pytest.raises(LensError, match="cross at"):
        load_lens({"surfaces": rows})
