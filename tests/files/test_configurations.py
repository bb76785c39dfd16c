"""Several configurations of a lens in one file, and a lens with its scene."""

import dataclasses

import numpy as np
import pytest

from drt_jax import LensError, Scene, System, design, first_order, load_lens, load_system, save_lens
from drt_jax.__main__ import main

WAVES, DISTANCES = (0.48, 0.55, 0.65), (np.inf, 1000.0, 500.0)


@pytest.fixture(scope="module")
def systems():
    """A triplet that focuses by two gaps, with a variable curvature and stop, a conic and
    vignetting in the second configuration alone; and weights of everything."""
    lens = load_lens("cooke_triplet")
    numbers = {
        "sensor": (42.2, 45.1, 47.3),
        "thickness 3": (4.75, 4.9, 4.9),
        "curvature 1": (-0.002, -0.0021, -0.002),
        "conic 5": (0.0, -0.5, 0.0),
        f"semi_diameter {lens.stop}": (3.0, 2.5, 2.25),
    }
    weights = {"wavelength_weights": (1, 3, 2), "field_weights": (2, 1)}
    scenes = [Scene.degrees([0, 14], far, WAVES, **weights) for far in DISTANCES]
    found = [System.of(*pair) for pair in zip(design.configured(lens, numbers), scenes)]
    found[1] = dataclasses.replace(found[1], vignetting=np.array([[0] * 5, [0, 0.1, 0, 0.2, 0]]))
    return found


@pytest.mark.parametrize("kind", ["zmx", "seq"])
def test_all_configurations_come_back(systems, kind, tmp_path):
    file = tmp_path / f"lens.{kind}"
    save_lens(systems, file)
    for k, system in enumerate(systems, 1):
        again = load_system(file, configuration=k)
        assert (again.configurations, again.configuration, again.primary) == (3, k, 1)
        np.testing.assert_allclose(again.vignetting, system.vignetting, atol=1e-15)
        for name in ("curvature", "conic", "thickness", "sensor"):
            pair = getattr(again.lens, name), getattr(system.lens, name)
            np.testing.assert_allclose(*pair, rtol=1e-12)
        stop = again.lens.semi_diameter[again.lens.stop]
        np.testing.assert_allclose(stop, system.lens.semi_diameter[system.lens.stop], rtol=1e-12)
        np.testing.assert_allclose(again.scene.field, system.scene.field, rtol=1e-12)
        assert again.distance == system.distance
        assert [*again.wavelength_weights] == [1, 3, 2] and [*again.field_weights] == [2, 1]


def test_an_angle_in_a_file_is_seen_from_the_entrance_pupil(systems):
    """For an object point of known height, the tangent of its angle is the height divided by the
    distance to the entrance pupil."""
    near = systems[1]
    place = first_order(near.lens, np.inf, 0.55).entrance_pupil.position[0]
    height = 1000 * np.tan(np.radians(14))
    np.testing.assert_allclose(np.tan(np.radians(near.heights[1, 1])), height / (1000 + place))
    assert np.degrees(near.fields[1, 1]) == 14 and near.heights[1, 1] != 14


@pytest.mark.parametrize("distance", [np.inf, 80.0])
def test_a_telecentric_lens_is_written(distance, tmp_path):
    """Its entrance pupil is at infinity: a near object has heights, a far one angles."""
    surfaces = [
        {"radius": 50.0, "thickness": 5.0, "index": 1.5},
        {"radius": -50.0, "thickness": 40.0},
        {"radius": "inf", "thickness": 20.0, "stop": True, "semi_diameter": 4.0},
    ]
    lens = load_lens({"surfaces": surfaces})
    focus = first_order(design.removed(design.with_stop(lens, 0), (2,)), np.inf, 0.55)
    gap = focus.back_focal_distance[0]
    lens = dataclasses.replace(lens, thickness=lens.thickness.at[1].set(gap))
    assert np.isinf(first_order(lens, 80.0, 0.55).entrance_pupil[0][0])
    scene = Scene.degrees([0, 3], distance, 0.55)
    save_lens(System.of(lens, scene), tmp_path / "lens.zmx")
    again = load_system(tmp_path / "lens.zmx")
    np.testing.assert_allclose(again.scene.field, scene.field, atol=1e-15)
    if np.isfinite(distance):
        np.testing.assert_allclose(again.heights[1, 1], -80 * np.tan(np.radians(3)))


def test_rows_are_those_of_a_patents_file(shared, tmp_path, capsys):
    """A zoom from a file of another program: its gaps are written in the same rows; after
    conversion to `.seq`, all three positions have the same focal lengths."""
    given = shared / "wild" / "Ricoh_smc_Pentax-FA_28-70mm_F2.8_AL_1d59b8.zmx"
    main(["convert", str(given), str(tmp_path / "zoom.zmx")])
    main(["convert", str(given), str(tmp_path / "zoom.seq")])
    assert "3 configurations, 26 surfaces" in capsys.readouterr().out

    def rows(file):
        words = [line.split() for line in file.read_text(errors="replace").splitlines()]
        gaps = [w for w in words if w[:1] == ["THIC"] and w[1] != "0"]
        return {(w[1], w[2]): float(w[3]) for w in gaps}

    ours, theirs = rows(tmp_path / "zoom.zmx"), rows(given)
    moved = {place: theirs[place] for place in theirs if int(place[0]) < 26}
    assert moved and all(ours[place] == gap for place, gap in moved.items())
    for k in (1, 2, 3):
        both = [load_system(file, configuration=k) for file in (given, tmp_path / "zoom.seq")]
        focal = [first_order(own.lens, np.inf, 0.5875618).focal_length for own in both]
        np.testing.assert_allclose(*focal, rtol=1e-6)


def test_what_no_row_changes_is_refused(systems, tmp_path):
    first, second, _ = systems
    other = dataclasses.replace(second, lens=design.removed(second.lens, (4, 5)))
    turned = design.configured(load_lens("cooke_triplet"), {"tilt 1[0]": (0.0, 0.01)})
    for given, message in (
        ([first, other], "differ in more than numbers"),
        ([first, dataclasses.replace(second, primary=0)], "differ in PWAV"),
        (turned, "differ in more than numbers"),
        ([], "expected a lens, a system, or several"),
    ):
        with pytest.raises(LensError, match=message):
            save_lens(given, tmp_path / "lens.zmx")
    with pytest.raises(LensError, match="one configuration"):
        save_lens(systems, tmp_path / "lens.yaml")
    assert not [*tmp_path.iterdir()]
    with pytest.raises(ValueError, match="one distance"):
        System.of(first.lens, Scene.degrees([0, 14], [np.inf, 500.0]))
