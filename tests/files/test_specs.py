"""Valid prescriptions, and those that raise an error before anything is traced."""

import numpy as np
import pytest
import yaml

from drt_jax import LensError, Scene, first_order, load_lens, save_lens, trace_rays

GOOD = {
    "surfaces": [
        {"radius": 50.0, "thickness": 4.0, "glass": "N-BK7"},
        {"radius": "inf", "thickness": 2.0, "glass": "air"},
        {"curvature": 0, "semi_diameter": 5.0, "stop": True},
    ],
    "sensor": 90.0,
}


def write(tmp_path, change):
    entry = yaml.safe_load(yaml.safe_dump(GOOD))
    change(entry)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(entry))
    return path


def surface(i, **values):
    return lambda entry: entry["surfaces"][i].update(values)


def drop(i, key):
    return lambda entry: entry["surfaces"][i].pop(key)


BAD = {
    "unknown key": (
        surface(0, radus=3.0),
        r"surfaces\[0\]: unknown key 'radus'; did you mean 'radius'",
    ),
    "unknown top key": (lambda e: e.update(sensr=1), "unknown key 'sensr'; did you mean 'sensor'"),
    "unknown glass": (
        surface(0, glass="N-BK8"),
        r"surfaces\[0\].glass: unknown glass 'N-BK8'.*N-BK7",
    ),
    "glass and index": (surface(0, index=1.5), "either glass or index"),
    "nd without vd": (lambda e: (drop(0, "glass")(e), surface(0, nd=1.5)(e)), "give both"),
    "glass code": (surface(0, glass="999001"), r"surfaces\[0\].glass: expected 1 < nd"),
    "index below 1": (lambda e: (drop(0, "glass")(e), surface(0, index=0.9)(e)), "not between"),
    "zero radius": (surface(0, radius=0), r"surfaces\[0\].radius: 0 is no surface"),
    "no radius": (drop(0, "radius"), "either radius"),
    "text": (surface(0, thickness="thick"), r"thickness: expected a number, got 'thick'"),
    "not a number": (surface(0, thickness=float("nan")), "expected a number"),
    "infinite": (surface(0, thickness=float("inf")), "must be finite"),
    "no thickness": (drop(0, "thickness"), r"thickness: expected a number, got None"),
    "negative thickness": (
        surface(0, thickness=-1.0),
        r"surfaces\[0\].thickness: must be positive",
    ),
    "touching": (surface(0, thickness=1e-8), r"surfaces\[0\].thickness: .* leave out one of two"),
    "odd power": (
        surface(0, coefficients={3: 1e-5}),
        r"surfaces\[0\].coefficients: unknown key 3; .*known: 2, 4, 6",
    ),
    "too wide": (surface(0, semi_diameter=60.0), r"60 mm reaches beyond the surface.* 50 mm"),
    "negative aperture": (surface(2, semi_diameter=-1.0), "must be positive"),
    "two shapes": (
        surface(1, aperture={"circle": 1, "ellipse": [1, 2]}),
        r"surfaces\[1\].aperture: give one of circle, ellipse, rectangle",
    ),
    "no shape": (surface(1, aperture={"centre": [0, 1]}), "give one of circle"),
    "flat aperture": (
        surface(1, aperture=[{"circle": 1}, {"ellipse": [1, 0]}]),
        r"surfaces\[1\].aperture\[1\].ellipse: must be positive",
    ),
    "negative obscuration": (
        surface(0, obscuration={"circle": -1}),
        r"surfaces\[0\].obscuration.circle: must be positive",
    ),
    "wide aperture": (
        surface(0, aperture={"rectangle": [30, 10], "centre": [0, 35]}),
        r"aperture.rectangle: 54.0833 mm reaches beyond the surface, which ends at 50 mm",
    ),
    "many obscurations": (
        surface(0, obscuration=[{"circle": 1} for _ in range(7)]),
        r"surfaces\[0\].obscuration\[6\]: a lens has 6 obscurations at most",
    ),
    "no stop": (surface(2, stop=False), "0 have stop: true"),
    "two stops": (surface(0, stop=True, semi_diameter=9.0), "2 have stop: true"),
    "open stop": (drop(2, "semi_diameter"), r"surfaces\[2\].semi_diameter: the stop needs one"),
    "sensor at the lens": (
        lambda e: e.update(sensor=4.0),
        "sensor: 4 mm touches the vertex of surface 1 at 4 mm; move it",
    ),
    "no focus": (
        lambda e: (surface(0, radius="inf")(e), e.update(sensor="focus")),
        "sensor: focus: there is none",
    ),
    "no sensor": (lambda e: e.pop("sensor"), "either sensor"),
    "two sensors": (surface(2, thickness=84.0), "either sensor"),
    "empty": (lambda e: e.update(surfaces=[]), "at least one surface"),
    "infinite curvature": (
        lambda e: (drop(0, "radius")(e), surface(0, curvature="inf")(e)),
        "must be finite",
    ),
    "unknown form": (
        surface(0, form="spline"),
        r"surfaces\[0\].form: unknown form 'spline'; known: asphere",
    ),
    "crossing": (
        lambda e: (
            surface(0, semi_diameter=20.0)(e),
            surface(1, semi_diameter=20.0, radius=-50)(e),
            surface(2, semi_diameter=20.0)(e),  # the stop: light comes there
        ),
        r"surfaces\[0\].thickness: 4 mm makes surfaces 0 and 1 cross at .* mm from the axis",
    ),
    "mirror with glass": (
        surface(0, mirror=True),
        r"surfaces\[0\].glass: behind a mirror is the medium",
    ),
    "light turned": (
        lambda e: (drop(0, "glass")(e), surface(0, mirror=True)(e), surface(1, glass="F2")(e)),
        r"surfaces\[0\].thickness: must be negative, as a mirror has turned the light",
    ),
    "short tilt": (surface(1, tilt=[1.0]), r"surfaces\[1\].tilt: expected a list of 3 numbers"),
    "text in decentre": (
        surface(1, decentre=[0, "up"]),
        r"decentre.1: expected a number, got 'up'",
    ),
    "no radius in x": (surface(0, form="toroid"), "either radius_x"),
    "conic_x": (
        surface(0, form="toroid", radius_x=9.0, conic_x=1.0),
        "conic_x: a surface of the form toroid has none",
    ),
    "power of x": (
        surface(0, form="polynomial_xy", coefficients={"x2": 1.0}),
        "coefficients: unknown key 'x2'; known: x1y0, x0y1, x2y0, x1y1",
    ),
    "no norm radius": (surface(0, form="qbfs"), r"surfaces\[0\].norm_radius: expected a number"),
    "norm radius 0": (
        surface(0, form="zernike", norm_radius=0),
        r"surfaces\[0\].norm_radius: must be positive",
    ),
    "norm radius": (
        surface(0, norm_radius=3),
        "norm_radius: a surface of the form asphere has none",
    ),
    "Zernike terms": (
        surface(0, form="zernike", norm_radius=9, coefficients={92: 1e-6}),
        "coefficients: unknown key 92; .*known: 1, 2, 3",
    ),
    **{
        f"glass {k}": (lambda e, g=glass: e.update(glasses={"mine": g}), f"glasses.mine{message}")
        for k, (glass, message) in enumerate(
            [
                ({"range": [0.4, 0.7]}, ": give sellmeier, schott or both"),
                ({"schott": [2.25]}, r".schott: expected a list of 6 numbers"),
                ({"sellmeier": [1.0, 0.01, 2.0]}, r".sellmeier: expected a list, all B and then"),
                ({"sellmeier": ["x", 0.01]}, r".sellmeier.0: expected a number"),
                ({"sellmeier": [1.0, 0.25]}, r".sellmeier: C = 0.25 um\^2 lies within the range"),
                ({"sellmeier": [-0.5, 0.01]}, ": no index above 1 at 0.365 um"),
                ({"schott": [2, -1, 0, 0, 0, 0], "range": [1, 2]}, ": no index above 1 at "),
                ({"sellmeier": [1.0, 0.01], "range": [0.7, 0.4]}, ".range: expected 0 < shortest"),
                (3, ": expected a mapping"),
            ]
        )
    },
    "glasses": (lambda e: e.update(glasses=["SK16"]), "glasses: expected a mapping with the keys"),
    "no mapping": (lambda e: e.update(object="water"), "object: expected a mapping with the keys"),
    "true": (surface(0, thickness=True), "thickness: expected a number, got True"),
    "flag": (surface(2, stop="yes, please"), r"surfaces\[2\].stop: expected true or false"),
    "object": (lambda e: e.update(object={"glass": "N-BK8"}), "object.glass: unknown glass"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_prescriptions_get_one_clear_message(tmp_path, name):
    change, message = BAD[name]
    path = write(tmp_path, change)
    with pytest.raises(LensError, match=message) as error:
        load_lens(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_own_lens(tmp_path):
    lens = load_lens(write(tmp_path, surface(1, conic=-0.5, coefficients={4: "1e-6"})))
    assert lens.stop == 2 and lens.glasses == ("air", "N-BK7", "air", "air")
    np.testing.assert_array_equal(lens.curvature, [0.02, 0, 0, 0])
    np.testing.assert_array_equal(lens.coefficients, [[0, 0], [0, 1e-6], [0, 0], [0, 0]])
    np.testing.assert_array_equal(lens.semi_diameter, [np.inf, np.inf, 5, np.inf])
    np.testing.assert_array_equal(lens.vertices, [0, 4, 6, 90])
    assert lens.decentre is None and lens.tilt is None


def test_a_stop_has_the_circle_round_its_aperture(tmp_path):
    """About the vertex; and lists of apertures, in the order of the surfaces."""
    shapes = {"aperture": [{"rectangle": [3.0, 4.0]}, {"circle": 9}], "semi_diameter": "inf"}
    entry = surface(1, obscuration={"ellipse": [0.2, 0.1], "centre": [0, 1]})
    lens = load_lens(write(tmp_path, lambda e: (entry(e), surface(2, **shapes)(e))))
    assert lens.semi_diameter[2] == 5 and lens.apertures.surfaces == (1, 2, 2)
    assert lens.apertures.kinds == ("ellipse", "rectangle", "circle")
    assert lens.apertures.blocks == (True, False, False)
    np.testing.assert_array_equal(lens.apertures.half, [[0.2, 0.1], [3, 4], [9, 9]])
    np.testing.assert_array_equal(lens.apertures.centre, [[0, 1], [0, 0], [0, 0]])
    moved = load_lens(write(tmp_path, lambda e: (e.pop("sensor"), surface(2, thickness=84.0)(e))))
    assert moved.sensor == lens.sensor == 90


def test_every_form_from_a_file(tmp_path):
    entry = {
        "object": {"index": 1.1},
        "surfaces": [
            {
                "form": "biconic",
                "radius": 50,
                "radius_x": 40,
                "conic_x": -1,
                "coefficients": {4: 1e-6},
                "thickness": 3,
                "glass": "N-BK7",
            },
            {
                "form": "toroid",
                "radius": 60,
                "curvature_x": 0.01,
                "coefficients": {2: 1e-4},
                "thickness": 3,
                "tilt": [1.0, 0, 0],
            },
            {
                "form": "odd_asphere",
                "radius": "inf",
                "coefficients": {3: 1e-5},
                "thickness": 3,
                "semi_diameter": 2,
                "stop": True,
            },
            {
                "form": "polynomial_xy",
                "radius": "inf",
                "coefficients": {"x1y1": 1e-4},
                "thickness": 9,
                "mirror": True,
                "decentre": [0, 1],
            },
        ],
        "sensor_tilt": [0, 2.0, 0],
    }
    path = tmp_path / "forms.yaml"
    path.write_text(yaml.safe_dump(entry))
    for lens in (load_lens(path), load_lens(entry)):
        assert lens.forms == ("biconic", "toroid", "odd_asphere", "polynomial_xy", "asphere")
        assert lens.mirrors == (False, False, False, True)
        assert lens.glasses == ("index 1.1", "N-BK7", "air", "air", "air")
        np.testing.assert_allclose(
            lens.coefficients,
            [
                [1 / 40, -1, 0, 1e-6],
                [0.01, 1e-4, 0, 0],
                [0, 0, 1e-5, 0],
                [0, 0, 0, 1e-4],
                [0, 0, 0, 0],
            ],
        )
        np.testing.assert_allclose(lens.tilt[1], [np.radians(1.0), 0, 0])
        np.testing.assert_allclose(lens.tilt[-1], [0, np.radians(2.0), 0])
        np.testing.assert_array_equal(lens.decentre[3], [0, 1])
        np.testing.assert_array_equal(lens.senses, [1, 1, 1, 1, -1])


@pytest.mark.slow
def test_a_sensor_in_focus(tmp_path):
    """It is where an axial ray close to the axis crosses the axis; it is written as a number."""
    lens = load_lens(write(tmp_path, lambda e: e.update(sensor="focus")))
    (wanted,) = first_order(lens, np.inf, 0.5875618).image_distance
    assert float(lens.sensor) == pytest.approx(float(wanted), abs=1e-12)
    rays = trace_rays(lens, Scene.point(0.0, np.inf, 0.5875618), [(0.0, 1e-4)])
    assert abs(float(rays.points[0, 0, -1, 1])) < 1e-9
    save_lens(lens, tmp_path / "again.yaml")
    assert load_lens(tmp_path / "again.yaml").sensor == lens.sensor


def test_powers_of_json_are_numbers():
    """JSON has keys as text: "4" is the coefficient 4, here of a Zernike polynomial."""
    rows = {"form": "zernike", "radius": 50, "norm_radius": 9, "thickness": 9, "index": 1.5}
    stop = {"radius": -50, "thickness": 90, "stop": True, "semi_diameter": 5}
    for keys in ({"4": 0.01, "11": 0.02}, {4: 0.01, "11": 0.02}):
        lens = load_lens({"surfaces": [rows | {"coefficients": keys}, stop]})
        assert lens.coefficients[0, 4] == 0.01 and lens.coefficients[0, 11] == 0.02
    with pytest.raises(LensError, match=r"surfaces\[0\].coefficients: .* given twice"):
        load_lens({"surfaces": [rows | {"coefficients": {4: 0.01, "4": 0.02}}, stop]})
    with pytest.raises(LensError, match="unknown key 0;"):
        load_lens({"surfaces": [rows | {"coefficients": {"0": 0.01}}, stop]})
