"""Drawings agree with the rays."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Scene, first_order, load_lens, show
from drt_jax.show import layout

FOLDED = {
    "surfaces": [
        {"radius": "inf", "semi_diameter": 8, "stop": True, "thickness": 10},
        {"radius": 60, "thickness": 5, "glass": "N-BK7", "semi_diameter": 12},
        {"radius": -200, "thickness": 30, "semi_diameter": 12},
        {"radius": "inf", "mirror": True, "tilt": [45, 0, 0], "semi_diameter": 18},
    ],
    "sensor": 45.0,
    "sensor_decentre": [0, 60],
    "sensor_tilt": [90, 0, 0],
}
# The vertex of the front surface lies 0.2 mm before its stop, its rim behind.
PHONE = {
    "surfaces": [
        {"radius": "inf", "semi_diameter": 1.0, "stop": True, "thickness": -0.2},
        {"radius": 1.7, "thickness": 0.8, "glass": "N-BK7", "semi_diameter": 1.2},
        {"radius": -9.0, "semi_diameter": 1.2},
    ],
    "sensor": 3.0,
}


@pytest.fixture(scope="module")
def folded():
    return show.draw(load_lens(FOLDED), Scene.radians([0.0, 0.05]))


@pytest.mark.slow
def test_a_folded_lens(folded):
    drawn = folded
    assert len(drawn.glass) == 1 and len(drawn.mirrors) == 1 and len(drawn.stop) == 2
    np.testing.assert_allclose(drawn.glass[0][0], drawn.glass[0][-1])  # a closed outline
    np.testing.assert_allclose(drawn.mirrors[0][:, 0] - 45, drawn.mirrors[0][:, 1], atol=1e-12)
    np.testing.assert_allclose(drawn.sensor[:, 1], 60, atol=1e-12)
    for fan in drawn.rays:
        assert len(fan) == 7
        for path in fan:
            mirror, end = path[-2], path[-1]
            np.testing.assert_allclose(mirror[0] - 45, mirror[1], atol=1e-12)
            np.testing.assert_allclose(end[1], 60, atol=1e-12)
            low, high = np.sort(drawn.sensor[:, 0])
            assert low < end[0] < high


@pytest.mark.slow
def test_a_lens_without_apertures_is_drawn_to_its_rays():
    lens = load_lens(PHONE)
    semi = jnp.full_like(lens.semi_diameter, jnp.inf).at[0].set(1.0)
    drawn = show.draw(dataclasses.replace(lens, semi_diameter=semi), Scene.radians(0.1))
    (fan,) = drawn.rays
    reach = max(np.max(np.abs(path[1:-1, 1])) for path in fan)
    np.testing.assert_allclose(np.max(drawn.glass[0][:, 1]), 1.1 * reach)


@pytest.mark.slow
def test_a_lens_is_drawn_to_its_clear_apertures_and_a_mirror_with_its_hole():
    faces = [{k: v for k, v in face.items() if k != "semi_diameter"} for face in FOLDED["surfaces"]]
    faces[0]["semi_diameter"] = 8
    faces[1]["aperture"] = {"rectangle": [5, 9], "centre": [0, 1]}
    faces[3] |= {"aperture": {"circle": 18}, "obscuration": {"ellipse": [1, 3], "centre": [0, 2]}}
    drawn = show.draw(load_lens(FOLDED | {"surfaces": faces}))
    front = drawn.glass[0][: len(drawn.glass[0]) // 2]
    np.testing.assert_allclose([front[:, 1].min(), front[:, 1].max()], [-8, 10])
    along = drawn.mirrors[0][:, 1] * 2**0.5
    gone = np.linspace(-18, 18, len(along))[np.isnan(along)]
    np.testing.assert_allclose([gone[0], gone[-1]], [-1, 5], atol=0.25)
    np.testing.assert_allclose(np.nanmax(abs(along)), 18)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [np.inf, 40.0])
def test_a_stop_that_pokes_through_a_surface_is_drawn_and_is_no_corner_of_a_ray(distance):
    drawn = show.draw(load_lens(PHONE), Scene.radians(0.1, distance))
    for side, blade in zip((-1, 1), drawn.stop, strict=True):
        np.testing.assert_allclose(blade[:, 0], 0, atol=1e-12)
        assert blade[0, 1] == side and abs(blade[1, 1]) > 1
    (face,) = drawn.glass
    assert face[:, 0].min() < -0.19 and face[0, 0] > 0  # the stop lies between vertex and rim
    paths = np.stack(drawn.rays[0])  # start, two faces, sensor
    assert paths.shape == (7, 4, 2) and np.all(np.diff(paths[:, :, 0]) > 0)
    z, y = np.moveaxis(paths[:, :2], -1, 0)
    crossed = y[:, 1] - z[:, 1] * np.diff(y)[:, 0] / np.diff(z)[:, 0]
    np.testing.assert_allclose(crossed, np.linspace(-1, 1, 7), atol=1e-9)


def test_the_picture_holds_every_line_and_says_which_field_has_which_colour(folded):
    figure, axes = show.new()
    show.lens_drawing(axes, folded)
    labels = axes.get_legend().get_texts()
    assert [text.get_text() for text in labels] == ["0°", "2.865°"]
    lines = [line for line in axes.lines if len(line.get_xdata())]
    assert len(lines) == 1 + 14 + 2 + 1 + 1 and len(axes.patches) == 1
    colours = [line.get_color() for line in axes.get_legend().get_lines()]
    assert colours == [lines[1].get_color(), lines[8].get_color()] and colours[0] != colours[1]
    assert figure.axes == [axes]
    *numbers, bar = [text.get_text() for text in axes.texts]
    assert numbers == [str(i) for i, _ in folded.numbers] and bar.endswith(" mm")
    start, end = lines[-1].get_xdata()
    assert end - start == pytest.approx(float(bar.split()[0]))


@pytest.mark.slow
def test_an_element_has_one_rim_and_its_planes_are_planes():
    """The plane and the sphere of an element end at the larger of their semi-diameters. A plane
    continues the sphere beyond its own semi-diameter; if this plane crosses the other surface, the
    rims stay separate."""
    face = {"radius": 20.0, "thickness": 4, "glass": "N-BK7", "semi_diameter": 5, "stop": True}
    plane = {"radius": "inf", "semi_diameter": 8.0}
    lens = load_lens({"surfaces": [face, plane], "sensor": 40})
    (outline,) = show.draw(lens).glass
    z, y = outline.T
    rim = np.isclose(np.abs(y), 8)
    sag = 20 - (20**2 - 5**2) ** 0.5
    np.testing.assert_allclose(np.unique(np.round(z[rim], 9)), [sag, 4], atol=1e-9)
    assert np.max(z) == 4 and np.all(np.abs(y[z == 4]) <= 8)
    back = {"radius": -20.0, "semi_diameter": 8.0}
    thin = load_lens({"surfaces": [face | {"thickness": 2}, back], "sensor": 40})
    (outline,) = show.draw(thin).glass
    assert np.max(np.abs(outline[np.isclose(outline[:, 0], sag), 1])) == pytest.approx(5)


# Its beam at 0.1 rad is cut by the rims of both faces, at 0 by none; the planes bend no light, so
# that the edges of the beam are known.
RIMS = {
    "surfaces": [
        {"radius": "inf", "semi_diameter": 5.0, "thickness": 10},
        {"radius": "inf", "semi_diameter": 5.0, "thickness": 10, "stop": True},
        {"radius": -500.0, "semi_diameter": 5.5, "glass": "N-BK7", "thickness": 2},
        {"radius": "inf", "semi_diameter": 9.0},
    ],
    "sensor": 60.0,
}


@pytest.mark.slow
def test_the_edges_of_a_vignetted_beam_are_drawn():
    """The lower edge ray passes the rim of the plane in front of the stop, the upper one that of
    the surface behind it. Both are additional to the rays of the fan."""
    lens = load_lens(RIMS)
    axial, oblique = show.draw(lens, Scene.radians([0.0, 0.1])).rays
    assert len(axial) == 7
    heights = [path[1:, 1] for path in axial]
    reach = np.max(np.abs([height[0] for height in heights]))
    np.testing.assert_allclose(reach, 5.0, atol=0.02)  # the marginal ray, parallel to the axis
    lower, upper = oblique[-2:]
    slope = np.tan(0.1)
    z, y = lower[1]  # where it meets the glass
    np.testing.assert_allclose(y - slope * z, -5.0, atol=1e-6)
    np.testing.assert_allclose(upper[1, 1], 5.5, atol=1e-6)
    for path in oblique[:-2]:
        assert lower[1, 1] < path[1, 1] < upper[1, 1]


@pytest.mark.slow
def test_the_light_between_an_obscuration_and_the_rim_has_four_edges():
    faces = [dict(face) for face in RIMS["surfaces"]]
    faces[0]["obscuration"] = {"circle": 2.0}
    lens = load_lens(RIMS | {"surfaces": faces})
    # The rim before the stop, as wide as it, grazes the light and stops none.
    assert layout.beam_of(lens, Scene.point(0.0)).obscured
    (fan,) = show.draw(lens, Scene.radians(0.0), rays=3).rays
    ends = sorted(path[1, 1] for path in fan)
    np.testing.assert_allclose(ends, [-5.0, -2.0, 2.0, 5.0], atol=1e-6)


@pytest.mark.slow
def test_a_steep_ray_does_not_leave_the_picture():
    """Its length in front of the lens is twice the distance of the plane at which other rays
    start."""
    axial, steep = show.draw(load_lens("fisheye_8mm"), Scene.radians([0.0, 1.3]), rays=3).rays
    begin, corner = steep[1][:2]
    assert np.tan(1.3) == pytest.approx((corner[1] - begin[1]) / (corner[0] - begin[0]))
    assert np.hypot(*(corner - begin)) == pytest.approx(2 * (corner[0] - axial[1][0, 0]))


@pytest.mark.slow
@pytest.mark.parametrize("tilted", [False, True])
def test_a_beam_tells_who_clips_it_and_where_it_is_sharp(tilted):
    more = {"sensor_tilt": [0, 0, 0]} if tilted else {}
    beam = layout.beam_of(load_lens(RIMS | more), Scene.point(0.1, np.inf, 0.55))
    assert beam.clipping == [0, 2] and not beam.ends
    lens = load_lens({"surfaces": [{"radius": 50, "glass": "N-BK7", "semi_diameter": 1,
                                    "stop": True, "thickness": 2}, {"radius": "inf"}],
                      "sensor": 60} | more)  # fmt: skip
    focus = float(first_order(lens, np.inf, 0.55).image_distance[0])
    beam = layout.beam_of(lens, Scene.point(0.0, np.inf, 0.55))
    assert beam.clipping == beam.ends == []
    assert 60 + beam.shift == pytest.approx(focus, abs=0.05) and beam.best < 1e-4
    # A cone of f/N has an RMS radius of defocus / (2 N) / sqrt(2).
    cone = abs(beam.shift) / (2 * float(first_order(lens, jnp.inf, 0.55).f_number[0])) / 2**0.5
    assert beam.spot == pytest.approx(cone, rel=0.01)


def test_a_notebook_shows_a_figure():
    """IPython requests the figures of the last value of a cell."""
    figure, _ = show.new()
    assert figure._repr_png_().startswith(b"\x89PNG")
