"""What a prescription may say, and what is refused before anything is traced."""

import numpy as np
import pytest
import yaml

from drt_jax import LensError, Status, first_order, load_lens, trace_rays

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
    "index below 1": (lambda e: (drop(0, "glass")(e), surface(0, index=0.9)(e)), "below 1"),
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
        surface(0, obscuration=[{"circle": 1}] * 7),
        r"surfaces\[0\].obscuration\[6\]: a lens has 6 obscurations at most",
    ),
    "no stop": (surface(2, stop=False), "0 have stop: true"),
    "two stops": (surface(0, stop=True, semi_diameter=9.0), "2 have stop: true"),
    "open stop": (drop(2, "semi_diameter"), r"surfaces\[2\].semi_diameter: the stop needs one"),
    "sensor in the lens": (
        lambda e: e.update(sensor=3.0),
        "sensor: 3 mm lies before the vertex of surface 1 at 4 mm",
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
    "sensor behind a mirror": (
        lambda e: (drop(0, "glass")(e), surface(0, mirror=True)(e)),
        "sensor: 90 mm lies before the vertex of surface 0 at 0 mm, as a mirror has turned",
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


STOP = {"radius": "inf", "semi_diameter": 1.0, "stop": True}
FRONT = {"radius": 20.0, "index": 1.5, "semi_diameter": 3.0}
BACK = {"radius": -20.0, "semi_diameter": 3.0}
MIRROR = {"radius": -100.0, "mirror": True, "semi_diameter": 20.0}


def in_order(*surfaces):
    """Surfaces and the distances between and behind them, in turns, as a prescription."""
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
    assert lens.stop not in lens.live


def test_stop_plane_that_touches_a_lens(shared):
    """P01, which OpticStudio has traced: the stop at 0 mm before R = 20."""
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
    """A surface between them bends no light, so that it need not keep its order."""
    surfaces = in_order(FRONT, 1.0, BACK | {"index": 1.0}, 5.0, {"radius": 9.0}, -5.0, STOP, 20.0)
    lens = load_lens({"object": {"index": 1}, **surfaces})
    assert lens.glasses == ("air", "index 1.5", "air", "air", "air") and lens.live == (0, 1)


DUMMY = {"radius": 5.0, "semi_diameter": 4.0}
WIDE = {**FRONT, "semi_diameter": 10.0}
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
        (WIDE, 2.0, {**STOP, "index": 1.5}, 2.0, {**BACK, "semi_diameter": 10.0}, 20.0),
        r"surfaces\[0\].thickness: 4 mm makes surfaces 0 and 2 cross at .* mm from the axis",
    ),
    "sensor, behind the stop": (
        (FRONT, 1.0, BACK, -2.0, STOP, 1.0),
        "sensor: 0 mm lies before the vertex of surface 1 at 1 mm",
    ),
    "sensor before a lone stop": (
        (STOP, -1.0),
        "sensor: -1 mm lies before the vertex of surface 0",
    ),
}


@pytest.mark.parametrize("name", BACKWARDS)
def test_surfaces_that_bend_light_keep_their_order(name):
    surfaces, message = BACKWARDS[name]
    with pytest.raises(LensError, match=message):
        load_lens(in_order(*surfaces))


@pytest.mark.parametrize("key, zeros", [("decentre", [0, 0]), ("tilt", [0, 0, 0])])
def test_zeros_that_are_written_are_variables_and_turn_off_no_check(key, zeros):
    still = {key: zeros}
    lens = load_lens(in_order(STOP, 0.0, FRONT, 1.0, BACK | still, 20.0))
    np.testing.assert_array_equal(lens.decentre, np.zeros((4, 2)))
    np.testing.assert_array_equal(lens.tilt, np.zeros((4, 3)))
    with pytest.raises(LensError, match="must be positive"):
        load_lens(in_order(STOP | still, 0.0, FRONT | still, -1.0, BACK, 20.0))
    with pytest.raises(LensError, match="cross at"):
        load_lens(in_order(STOP, 0.0, WIDE, 1.0, BACK | {"semi_diameter": 10} | still, 20.0))
    with pytest.raises(LensError, match="sensor: 0 mm lies before"):
        load_lens({**in_order(STOP, 0.0, FRONT, 1.0, BACK, -1.0), f"sensor_{key}": zeros})


@pytest.mark.parametrize("key, value", [("decentre", [0, 0.1]), ("tilt", [0, 0, 1.0])])
def test_only_neighbours_of_a_moved_surface_are_not_checked(key, value):
    """A mirror at 45 degrees sends light sideways; its neighbours may lie at any z."""
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


@pytest.mark.parametrize(
    "entry", [{"nd": 1.835, "vd": 42.7}, {"glass": 835427}, {"glass": "835427"}]
)
def test_model_glasses(entry):
    """As patents give them, and as a code; between two of the same, no light bends."""
    rows = [
        {"radius": 50.0, "thickness": 4.0, **entry},
        {"radius": "inf", "thickness": 2.0, **entry},
        {"radius": "inf", "thickness": 50.0, "stop": True, "semi_diameter": 5.0},
    ]
    lens = load_lens({"surfaces": rows})
    assert lens.live == (0, 2)
    np.testing.assert_allclose(lens.index([0.5875618])[1:3, 0], 1.835, rtol=1e-12)
    with pytest.raises(ValueError, match="2 um is outside the range of model 1.835 42.7"):
        lens.index([2.0])


def test_glasses_of_the_file():
    """They win over the catalogue, have a range of their own, and n^2 is the sum of both forms."""
    rows = [
        {"radius": 50.0, "thickness": 4.0, "glass": "SK16"},
        {"radius": "inf", "thickness": 50.0, "stop": True, "semi_diameter": 5.0},
    ]
    one = {"sellmeier": [1.1, 0.2, 0.01, 90.0], "schott": [1.3, 0, 0.02, 0, 0, 0]}
    lens = load_lens({"glasses": {"SK16": one | {"range": [0.5, 0.6]}}, "surfaces": rows})
    n2 = 1.3 + 0.02 / 0.55**2 + 1.1 * 0.55**2 / (0.55**2 - 0.01) + 0.2 * 0.55**2 / (0.55**2 - 90)
    np.testing.assert_allclose(lens.index([0.55])[1, 0], n2**0.5, rtol=1e-14)
    with pytest.raises(ValueError, match="0.45 um is outside the range of SK16, 0.5 to 0.6 um"):
        lens.index([0.45])
    plain = load_lens({"glasses": {"mine": one}, "surfaces": rows})
    assert plain.glasses[1] == "SK16" and plain.dispersion.range == (0.4, 0.7)
    rows[0]["glass"] = "mine"
    assert load_lens({"glasses": {"mine": one}, "surfaces": rows}).dispersion.range == (
        0.365,
        1.014,
    )


def test_the_patent_lens(shared):
    """US 2021/0263286, example 1, as it stands: the focal length that the patent tells."""
    lens = load_lens(shared / "patent_rf50.yaml")
    focal = first_order(lens, np.inf, [0.5875618]).focal_length
    np.testing.assert_allclose(focal, 49.565, atol=5e-3)


def test_surfaces_that_cross_at_the_rim():
    """A rounded aperture: the lens loads with a warning, and light that comes there is lost."""
    rows = [
        {"radius": 20.0, "thickness": 4.2, "index": 1.5, "semi_diameter": 9.0},
        {"radius": -20.0, "thickness": 1.0, "semi_diameter": 9.0},
        {"radius": "inf", "thickness": 15.0, "stop": True, "semi_diameter": 9.0},
    ]
    with pytest.warns(UserWarning, match="cross at 8.9. mm.*light that comes there is lost"):
        lens = load_lens({"surfaces": rows})
    heights = np.array([0.0, 3.0, 6.0, 9.0])
    rays = trace_rays(lens, 0.0, np.inf, [0.55], np.stack([0 * heights, heights / 9], axis=-1))
    assert rays.status[0, :3].tolist() == [Status.OK] * 3 and rays.status[0, -1] != Status.OK
    assert np.all(np.isfinite(rays.points))
    rows[0]["thickness"] = 3.0
    with pytest.raises(LensError, match="cross at"):
        load_lens({"surfaces": rows})
