"""`.zmx` files: the meaning of each keyword, OpticStudio's own listings, and invalid files."""

import pathlib
import re
import time
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import (
    LensError,
    Scene,
    first_order,
    load_lens,
    load_system,
    sag,
    save_lens,
    trace_rays,
)
from drt_jax.lens.glass import nd_and_vd

SHARED = pathlib.Path(__file__).resolve().parents[3] / "shared" / "data" / "lens_files"
LISTED = pytest.mark.skipif(not SHARED.is_dir(), reason="listings lie beside the repository")
HEADER = {
    "UNIT": "MM X W X CM MR CPMM",
    "ENPD": "10",
    "GCAT": "SCHOTT",
    "FTYP": "0 0 2 2 0 0 0",
    "XFLN": "0 1 0 0",
    "YFLN": "0 5 0 0",
    "FWGN": "1 2 1 1",
    "VDXN": "0 0 0 0",
    "VDYN": "0 .1 0 0",
    "VCXN": "0 .2 0 0",
    "VCYN": "0 .3 0 0",
    "VANN": "0 90 0 0",
    "PWAV": "2",
}
WAVES = ["WAVM 1 .48 1", "WAVM 2 .55 3", "WAVM 3 .55 1"]
FRONT = "TYPE STANDARD|STOP|CURV .02|DISZ 4|GLAS N-BK7 0 0 1.5 40|DIAM 6 0"
BACK = "TYPE STANDARD|CURV -.02|DISZ 48|DIAM 6 0"
IMAGE = "TYPE STANDARD|CURV 0|DISZ 0"


def text(*surfaces, object="INFINITY", tail=("MNUM 1 1",), **header):
    """A file with these surfaces between object and image, whose lines are separated by |."""
    top = [f"{key} {value}" for key, value in (HEADER | header).items() if value is not None]
    blocks = [f"TYPE STANDARD|CURV 0|DISZ {object}", *surfaces, IMAGE]
    for i, block in enumerate(blocks):
        top += [f"SURF {i}", *(f"  {line}" for line in block.split("|"))]
    return "\n".join([*top[:13], *WAVES, *top[13:], *tail])


def read(folder, *surfaces, missing="error", configuration=None, **others):
    path = folder / "lens.zmx"
    path.write_text(text(*(surfaces or (FRONT, BACK)), **others))
    return load_system(path, missing, configuration)


def refused(folder, *surfaces, **others):
    with pytest.raises(LensError) as error:
        read(folder, *surfaces, **others)
    return str(error.value).partition("lens.zmx")[2]


def test_use_of_a_lens(tmp_path):
    """The first entries of the columns, in their order; repeated wavelengths are kept; pupil
    diameter."""
    system = read(tmp_path)
    np.testing.assert_array_equal(system.wavelengths, [0.48, 0.55])
    np.testing.assert_array_equal(system.wavelength_weights, [1, 3])
    assert system.primary == 1 and system.distance == np.inf and system.notes == ()
    np.testing.assert_allclose(np.degrees(system.fields), [[0, 0], [1, 5]])
    np.testing.assert_array_equal(system.field_weights, [1, 2])
    np.testing.assert_allclose(system.vignetting[1], [0, 0.1, 0.2, 0.3, np.pi / 2])
    assert float(system.lens.semi_diameter[0]) == 5  # stop at the first vertex
    assert np.isinf(system.lens.semi_diameter[1])  # DIAM alone clips nothing
    assert system.lens.glasses == ("air", "N-BK7", "air")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-8", "utf-8-sig", "latin-1"])
def test_encodings_and_indents(tmp_path, encoding):
    path = tmp_path / "lens.zmx"
    own = text(FRONT, BACK, NAME="Zweilinser für 5 µm").replace("\n  ", "\n")
    path.write_bytes(own.encode(encoding))
    lens = load_lens(path)
    assert lens.name == "Zweilinser für 5 µm" and lens.count == 2


def test_units(tmp_path):
    """Lengths are in inches, coefficients in their powers; wavelengths never are."""
    even = FRONT.replace("STANDARD", "EVENASPH") + "|PARM 1 .001|PARM 2 1e-5"
    mm, inch = read(tmp_path, even, BACK), read(tmp_path, even, BACK, UNIT="IN X")
    metres = [read(tmp_path, even, BACK, UNIT=word).lens for word in ("METER X", "M X")]
    assert metres[0].sensor == metres[1].sensor == 1000 * mm.lens.sensor
    scale = 25.4
    np.testing.assert_allclose(inch.lens.curvature, mm.lens.curvature / scale, rtol=1e-15)
    np.testing.assert_allclose(inch.lens.sensor, mm.lens.sensor * scale, rtol=1e-15)
    np.testing.assert_allclose(mm.lens.coefficients[0], [1e-3, 1e-5])  # of r^2, r^4
    np.testing.assert_allclose(inch.lens.coefficients[0], [1e-3 / scale, 1e-5 / scale**3])
    np.testing.assert_array_equal(inch.wavelengths, mm.wavelengths)


@pytest.mark.parametrize(
    ("own", "form", "coefficients"),
    [
        ("ODDASPHE|PARM 1 .01|PARM 3 1e-4", "odd_asphere", [0.01, 0, 1e-4]),
        ("TOROIDAL|PARM 1 40|PARM 2 1e-4|PARM 3 1e-6", "toroid", [0.025, 1e-4, 1e-6]),
        ("TOROIDAL|PARM 1 0", "toroid", [0]),  # flat in x
        ("BICONICX|PARM 1 -50|PARM 2 -1", "biconic", [-0.02, -1]),
        ("TILTSURF|PARM 1 .1|PARM 2 .2", "polynomial_xy", [0.1, 0.2]),
    ],
)
def test_types_of_surfaces(tmp_path, own, form, coefficients):
    lens = read(tmp_path, FRONT.replace("STANDARD", own) + "|CONI -.5", BACK).lens
    assert lens.forms[0] == form and lens.conic[0] == -0.5
    np.testing.assert_allclose(lens.coefficients[0], coefficients, rtol=1e-15)


def sags(folder, own, x, y):
    """Sags of the first surface, of radius 50 mm, with this type and these lines."""
    lens = read(folder, FRONT.replace("STANDARD", own), BACK).lens
    return float(sag(lens, 0, x, y)), lens


def test_extra_data_are_sags_over_their_radius(tmp_path):
    """Closed forms at x = 1, y = 2 mm with a norm radius of 4 mm; terms beyond the count are
    ignored."""
    x, y, radius = 1.0, 2.0, 4.0
    sphere, u = 50 - np.sqrt(50**2 - 5), np.sqrt(5) / 4
    own = "|".join(f"XDAT {k + 1} {v}" for k, v in enumerate([3, radius, 0.1, 0.2, 0.3, 9]))
    later = own.replace("XDAT 1 ", "PARM 13 ").replace("XDAT 2 ", "PARM 14 ")
    for lines in (own, later):
        found, _ = sags(tmp_path, f"XASPHERE|{lines}", x, y)
        np.testing.assert_allclose(found, sphere + 0.1 * u**2 + 0.2 * u**4 + 0.3 * u**6)
    found, _ = sags(tmp_path, f"XOSPHERE|{own}", x, y)
    np.testing.assert_allclose(found, sphere + 0.1 * u + 0.2 * u**2 + 0.3 * u**3)
    found, _ = sags(tmp_path, f"XPOLYNOM|{own}", x, y)
    np.testing.assert_allclose(found, sphere + 0.1 * x / 4 + 0.2 * y / 4 + 0.3 * x * x / 16)
    inch, _ = sags(tmp_path, f"XASPHERE|{own}", x, y)
    system = read(tmp_path, FRONT.replace("STANDARD", f"XASPHERE|{own}"), BACK, UNIT="IN X")
    np.testing.assert_allclose(sag(system.lens, 0, 25.4 * x, 25.4 * y), 25.4 * inch)


def test_zernike_sag_with_powers_of_r(tmp_path):
    """Astigmatism and coma with polar angles from x, as in listings; together with powers of r."""
    own = "SZERNSAG|PARM 0 1|PARM 1 .001|PARM 3 1e-6|XDAT 1 8|XDAT 2 4|XDAT 5 .01"
    found, lens = sags(tmp_path, f"{own}|XDAT 8 .1|XDAT 10 .2", 1.0, 2.0)
    angle, u = np.arctan2(2.0, 1.0), np.sqrt(5) / 4
    wanted = 50 - np.sqrt(50**2 - 5) + 0.001 * 5 + 1e-6 * 5**3
    wanted += 0.01 * 2 * u * np.sin(angle) + 0.1 * np.sqrt(6) * u**2 * np.cos(2 * angle)
    wanted += 0.2 * np.sqrt(8) * (3 * u**3 - 2 * u) * np.cos(angle)
    np.testing.assert_allclose(found, wanted, rtol=1e-13)
    assert lens.forms[0] == "zernike"
    beyond = FRONT.replace("STANDARD", own.replace("PARM 0 1", "PARM 0 0"))
    for missing in ("error", "warn"):  # data that change rays are never left out
        message = refused(tmp_path, beyond, BACK, missing=missing)
        assert "Zernike terms that end at 4 mm" in message
    assert "parameter 9" in refused(tmp_path, FRONT.replace("STANDARD", own + "|PARM 9 1"), BACK)


def test_fringe_zernike_sag(tmp_path):
    """Born and Wolf's fringe terms, 1 at the rim: 4 is defocus, 5 and 6 astigmatism, 8 coma."""
    own = (
        "FZERNSAG|PARM 0 1|PARM 2 1e-5|XDAT 1 9|XDAT 2 4|XDAT 3 .03|XDAT 6 .1|XDAT 8 .2|XDAT 10 .3"
    )
    x, y = 1.0, 2.0
    u2, angle = 5 / 16, np.arctan2(y, x)
    wanted = 50 - np.sqrt(50**2 - 5) + 1e-5 * 25 + 0.03 + 0.1 * (2 * u2 - 1)
    wanted += 0.2 * u2 * np.sin(2 * angle) + 0.3 * (3 * u2 - 2) * np.sqrt(u2) * np.sin(angle)
    found, _ = sags(tmp_path, f"{own}|XDAT 10 .3", x, y)
    np.testing.assert_allclose(found, wanted, rtol=1e-13)
    assert "fringe terms end with 37" in refused(
        tmp_path, FRONT.replace("STANDARD", "FZERNSAG|XDAT 1 38|XDAT 2 9|XDAT 40 1"), BACK
    )


def test_an_irregular_surface(tmp_path):
    """Zs u^4 + Za v^2 + Zc u^2 v over the semi-diameter of 6 mm; only this surface is decentred and
    tilted."""
    own = "IRREGULA|PARM 1 -1|PARM 2 .5|PARM 3 2|PARM 4 -3|PARM 5 .01|PARM 6 -.02|PARM 7 .03"
    found, lens = sags(tmp_path, own, 1.0, 2.0)
    u2, v = 5 / 36, 2 / 6
    wanted = 50 - np.sqrt(50**2 - 5) + 0.01 * u2**2 - 0.02 * v**2 + 0.03 * u2 * v
    np.testing.assert_allclose(found, wanted, rtol=1e-13)
    np.testing.assert_array_equal(lens.decentre[:2], [[-1, 0.5], [0, 0]])
    np.testing.assert_allclose(np.degrees(lens.tilt[:2]), [[2, -3, 0], [0, 0, 0]])
    angled = FRONT.replace("STANDARD", own + "|PARM 8 30")
    assert "an angle, PARM 8" in refused(tmp_path, angled, BACK)


def test_an_even_asphere_under_another_name(tmp_path):
    """An XASPHERE with PARM and no XDAT, as some programs write it, is read with a warning; with
    both it is refused."""
    lines = "|PARM 1 .001|PARM 2 1e-5|PARM 8 1e-20"
    for missing in ("error", "warn"):
        with pytest.warns(UserWarning, match="SURF 1: XASPHERE with PARM .* is an even asphere"):
            own = FRONT.replace("STANDARD", f"XASPHERE{lines}")
            lens = read(tmp_path, own, BACK, missing=missing).lens
        even = read(tmp_path, FRONT.replace("STANDARD", f"EVENASPH{lines}"), BACK).lens
        np.testing.assert_array_equal(lens.coefficients, even.coefficients)
        both = FRONT.replace("STANDARD", f"XASPHERE{lines}|XDAT 1 1|XDAT 2 9|XDAT 3 .1")
        assert "parameter 1 of SURF 1 is not read" in refused(tmp_path, both, BACK, missing=missing)


def test_forbes_aspheres(tmp_path):
    """The first Qbfs term is x (1 - x) / cos(conic) times Q_0 = 1; the first Qcon terms are x^2
    times 1, 6 x - 5 and 28 x^2 - 42 x + 15."""
    x2 = 5 / 16
    cosine = np.sqrt(1 - 5 / 50**2)
    sphere = 50 - np.sqrt(50**2 - 5)
    own = "QED_TYPE|XDAT 1 {}|XDAT 2 3|XDAT 3 4|XDAT 4 .1"
    found, lens = sags(tmp_path, own.format(0), 1.0, 2.0)
    assert lens.forms[0] == "qbfs"
    np.testing.assert_allclose(found, sphere + 0.1 * x2 * (1 - x2) / cosine)
    found, _ = sags(tmp_path, own.format(1) + "|XDAT 5 .2|XDAT 6 .3", 1.0, 2.0)
    strong = 0.1 + 0.2 * (6 * x2 - 5) + 0.3 * (28 * x2**2 - 42 * x2 + 15)
    np.testing.assert_allclose(found, sphere + x2**2 * strong)


def test_a_phase_in_radians_focuses(tmp_path):
    """A phase of -pi R^2 / (L f) radians over R makes a plane in air a lens with the focal length f
    at the wavelength L."""
    focal, wave, radius = 200.0, 0.55, 5.0
    strength = -np.pi * radius**2 / (wave * 1e-3 * focal)
    own = f"TYPE BINARY_2|STOP|CURV 0|PARM 0 1|XDAT 1 1|XDAT 2 {radius}|XDAT 3 {strength!r}"
    lens = read(tmp_path, own + "|DISZ 48|DIAM 6 0").lens
    found = first_order(lens, jnp.inf, jnp.array([wave])).effective_focal_length
    np.testing.assert_allclose(found, focal)
    twice = read(tmp_path, own.replace("PARM 0 1", "PARM 0 2") + "|DISZ 48|DIAM 6 0").lens
    found = first_order(twice, jnp.inf, jnp.array([wave])).effective_focal_length
    np.testing.assert_allclose(found, focal / 2)
    assert "PARM 0, the order" in refused(tmp_path, own.replace("|PARM 0 1", "") + "|DISZ 48")


def test_surfaces_that_touch_and_fields_of_90_degrees(tmp_path):
    """Touching surfaces that refract get a gap of 1e-6 mm; both are reported."""
    touching = FRONT.replace("STOP|", ""), BACK.replace("DISZ 48", "DISZ 0")
    dummy = "TYPE STANDARD|STOP|CURV 0|DISZ 0|DIAM 5 0"
    with pytest.warns(UserWarning, match="surfaces that touch stand 1e-06 mm apart: SURF 3, SURF"):
        lens = read(tmp_path, *touching, dummy, *touching, YFLN="0 90").lens
    np.testing.assert_allclose(lens.thickness, [4, 0, 1e-6, 4])
    np.testing.assert_allclose(lens.sensor, 8 + 2e-6)
    with pytest.warns(UserWarning, match="line 4: fields of 90 degrees and more cannot be traced"):
        assert np.degrees(read(tmp_path, YFLN="0 90").fields[1, 1]) == 90
    assert "line 4: a field angle of 90" in refused(tmp_path, YFLN="0 90", object="200")
    with pytest.warns(UserWarning, match="sensor: 3 mm lies before the vertex of surface 1"):
        read(tmp_path, FRONT, BACK.replace("DISZ 48", "DISZ -1"))


def test_apertures(tmp_path):
    """Floating and fixed rings, rectangles, obscurations, their centre; the size of the stop does
    not follow from its ring."""
    clear = "|FLAP 0 6 0|OBDC 1 -2"
    ring = "TYPE STANDARD|CURV 0|DISZ 2|CLAP 1 5 0"
    square = "TYPE STANDARD|CURV 0|DISZ 2|SQAP 3 4 0|OBDC 0 0"
    dark = "TYPE STANDARD|CURV 0|DISZ 2|OBSC 0 2 0"
    more = "TYPE STANDARD|CURV 0|DISZ 2|ELOB 1 2 0|ELAP 5 6 0|OEMA .5 0 0"
    lens = read(tmp_path, FRONT, BACK + clear, ring, square, dark, more).lens
    own = lens.apertures
    np.testing.assert_array_equal(lens.semi_diameter[1:3], [np.inf, 5])
    kinds = [*zip(own.surfaces, own.kinds, own.blocks, strict=True)]
    assert set(kinds) == {
        *((1, "circle", False), (2, "circle", True)),
        *((3, "rectangle", False), (4, "circle", True)),
        *((5, "ellipse", True), (5, "ellipse", False)),
    }
    half = dict(zip(kinds, own.half.tolist(), strict=True))
    assert half[1, "circle", False][0] == 6 and half[2, "circle", True][0] == 1
    assert half[3, "rectangle", False] == [3, 4]
    assert half[5, "ellipse", True] == [1, 2] and half[5, "ellipse", False] == [5, 6]
    np.testing.assert_array_equal(own.centre[kinds.index((1, "circle", False))], [1, -2])


BREAK = "TYPE COORDBRK|CURV 0|PARM 1 {}|PARM 2 {}|PARM 3 {}|PARM 4 {}|PARM 5 {}|PARM 6 {}|DISZ {}"


def test_coordinate_breaks_are_right_handed_and_have_an_order(tmp_path):
    """Order 0 decentres, then tilts about x, y, z; order 1 with all signs reversed is the
    inverse."""
    there = BREAK.format(1, 2, 10, 20, 30, 0, 5)
    back = BREAK.format(-1, -2, -10, -20, -30, 1, -5)
    moved = read(tmp_path, FRONT, BACK, there).lens
    x, y, z = (np.radians(angle) for angle in (10, 20, 30))
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    about_y = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    about_z = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    turn = about_x @ about_y @ about_z
    place, across, rotation = moved.places
    np.testing.assert_allclose(rotation[-1], turn, atol=1e-15)
    ahead = turn @ [0, 0, 5]
    np.testing.assert_allclose([*across[-1], place[-1]], [1, 2, 52] + ahead, rtol=1e-14)
    # The inverse cancels it: 5 mm forward, 5 mm back in the rotated frame.
    undone = read(tmp_path, FRONT, BACK, there, BREAK.format(0, 0, 0, 0, 0, 0, -5), back).lens
    place, across, rotation = undone.places
    np.testing.assert_allclose(rotation[-1], np.eye(3), atol=1e-15)
    np.testing.assert_allclose([*across[-1], place[-1]], [0, 0, 47], atol=1e-13)


@pytest.mark.parametrize("order", [0, 1])
def test_tilts_of_surfaces_are_coordinate_breaks(tmp_path, order):
    """SCBD in front of a mirror and behind it, for any `missing`; zeros are no break."""
    bare = "TYPE STANDARD|STOP|CURV 0|DISZ {}|GLAS MIRROR|DIAM 5"
    numbers = "1 2 30 -20 10"
    own = f"{bare.format(-20)}|SCBD 1 {order} 0 {numbers}|SCBD 2 {1 - order} 2 .1 0 -40 0 5"
    zeros = BACK + "|SCBD 2 1 2 -0.000E+000 -0. -0. -0. -0."
    first, second = (
        BREAK.format(*numbers.split(), order, 0),
        BREAK.format(0.1, 0, -40, 0, 5, 1 - order, -20),
    )
    front = FRONT.replace("|STOP", "")
    wanted = read(tmp_path, front, BACK, first, bare.format(0), second).lens.places
    for missing in ("error", "warn"):
        found = read(tmp_path, front, zeros, own, missing=missing).lens.places
        for one, two in zip(wanted, found, strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-14)


def test_the_hand_of_a_tilt_is_that_of_a_listing(tmp_path):
    """Global coordinates of OpticStudio behind a mirror that is tilted by -4.5 degrees about x."""
    mirror = "TYPE STANDARD|STOP|CURV -3.280839895013123e-4|DISZ -1524|GLAS MIRROR|DIAM 75"
    tilt, shift = (
        BREAK.format(0, 0, -4.5, 0, 0, 0, 0),
        BREAK.format(0, -119.9414012007, 0, 0, 0, 0, 0),
    )
    place, across, rotation = read(tmp_path, tilt, mirror, shift, object="1524").lens.places
    np.testing.assert_allclose([*across[-1], place[-1]], [0, -239.1433238, -1509.891523], atol=6e-7)
    listed = [[1, 0, 0], [0, 0.9969173337, 0.0784590957], [0, -0.0784590957, 0.9969173337]]
    np.testing.assert_allclose(rotation[-1], listed, atol=6e-11)


def test_a_mirror_keeps_the_medium_and_a_tilted_one_folds(tmp_path):
    tilt, mirror = (
        BREAK.format(0, 0, 45, 0, 0, 0, 0),
        "TYPE STANDARD|STOP|CURV 0|DISZ 0|GLAS MIRROR",
    )
    lens = read(
        tmp_path, FRONT.replace("|STOP", ""), BACK, tilt, mirror, tilt.replace("DISZ 0", "DISZ -20")
    ).lens
    assert lens.mirrors == (False, False, True)
    np.testing.assert_allclose(lens.places[1][-1], [0, 20], atol=1e-14)  # -y' is +y here


@pytest.mark.slow
def test_apertures_of_systems_by_their_definition(tmp_path):
    def first(**own):
        system = read(tmp_path, ENPD=None, **own)
        return first_order(system.lens, system.distance, jnp.array([0.55]))

    found = first(FNUM="8 0")
    wide = 2 * found.entrance_pupil.semi_diameter
    np.testing.assert_allclose(found.effective_focal_length / wide, 8)
    np.testing.assert_allclose(first(FNUM="8 1", object="200").f_number, 8)
    edge = np.tan(np.arcsin(0.02)) * 200
    for aperture in ("0.02 0", f"{np.degrees(np.arcsin(0.02))} 1", "0.02"):
        found = first(OBNA=aperture, object="200")
        np.testing.assert_allclose(found.entrance_pupil.semi_diameter, edge)
    np.testing.assert_allclose(first(FLOA="").entrance_pupil.semi_diameter, 6)

    np.testing.assert_allclose(
        first(OBNA="60 1", object="200").entrance_pupil.semi_diameter, np.tan(np.pi / 3) * 200
    )
    for angle in (90, 160, 180):
        message = refused(tmp_path, ENPD=None, OBNA=f"{angle} 1", object="200")
        assert f"an object cone of {angle} degrees" in message
    assert "an object at infinity" in refused(tmp_path, ENPD=None, OBNA="10 1")


def test_a_cone_in_a_medium_is_an_angle(tmp_path):
    """Half a cone of 30 degrees in glass: the tangent of this angle, not that for an NA of sin 30
    degrees."""
    path = tmp_path / "lens.zmx"
    own = text(FRONT, BACK, ENPD=None, OBNA="30 1", object="200")
    path.write_text(own.replace("DISZ 200", "DISZ 200|GLAS N-BK7".replace("|", "\n")))
    system = load_system(path)
    assert system.aperture_kind == "object cone angle" and system.aperture == 30
    np.testing.assert_allclose(system.lens.semi_diameter[0], np.tan(np.pi / 6) * 200)


OLD = {
    **{"XFLD": "0 1", "YFLD": "0 5", "FWGT": "1 2", "ZVDX": "0 0", "ZVDY": "0 .1"},
    **{"ZVCX": "0 .2", "ZVCY": "0 .3", "ZVAN": "0 90", "WAVL": ".48 .55", "WWGT": "1 3"},
}


def test_headers_of_older_versions(tmp_path):
    """Old lists are duplicates if the newer ones are present, right or wrong; otherwise they are
    read."""
    spoilt = dict.fromkeys(OLD, "7 7") | {"WAVN": "7 7", "WWGN": "7 7"}
    new = read(tmp_path, **spoilt)
    assert not new.notes
    none = dict.fromkeys(("XFLN", "YFLN", "FWGN", "VDXN", "VDYN", "VCXN", "VCYN", "VANN"))
    path = tmp_path / "old.zmx"
    for counts in ("0 0 2 2", "0"):  # the oldest have no numbers of fields and wavelengths
        own = text(FRONT, BACK, **(none | OLD | {"FTYP": counts}))
        path.write_text("\n".join(line for line in own.split("\n") if line not in WAVES))
        old = load_system(path)
        for key in ("heights", "field_weights", "vignetting", "wavelengths", "wavelength_weights"):
            np.testing.assert_array_equal(getattr(old, key), getattr(new, key))


def test_more_than_twelve_fields(tmp_path):
    """Twelve in each column, one in each line FEFD: x, y, weight and five vignetting factors."""
    columns = {"XFLN": "0 " * 12, "YFLN": " ".join(map(str, range(12))), "FWGN": "1 " * 12}
    columns |= {"VCYN": "0 " * 12, "VANN": None, "VDXN": None, "VDYN": None, "VCXN": None}
    columns |= {"MODE": "SEQ", "NAME": "many", "SDMA": "0 1 0", "ROPD": "2"}
    path = tmp_path / "lens.zmx"
    more = "FENF 14 14\nFEFD 0 12 1 0 0 0 0 0\nFEFD .5 13 2 .1 .2 .3 .4 90\nSURF 0"
    own = text(FRONT, BACK, FTYP="0 0 14 2 0 0 0 14", **columns)
    path.write_text(own.replace("SURF 0", more))
    system = load_system(path)
    np.testing.assert_array_equal(system.heights[:, 1], np.arange(14))
    assert system.heights[-1, 0] == 0.5 and system.field_weights.tolist() == [1] * 13 + [2]
    np.testing.assert_allclose(system.vignetting[-1], [0.1, 0.2, 0.3, 0.4, np.pi / 2])
    assert not np.any(system.vignetting[:-1]) and system.notes == ()
    path.write_text(own)
    with pytest.raises(LensError, match="XFLN has 12 of 14 fields"):
        load_system(path)


def test_a_virtual_object_and_a_virtual_image(tmp_path):
    """1 / s' = 1 / s + 1 / f of a thin lens: light that converges to 100 mm behind it; and a sensor
    in front of a negative lens, which is reported."""
    lens = "TYPE STANDARD|STOP|CURV {}|DISZ 1e-3|GLAS ___BLANK 1 0 1.5 0|DIAM 5"
    back = "TYPE STANDARD|CURV 0|DISZ {}|DIAM 5"
    system = read(tmp_path, lens.format(0.02), back.format(50), object="-100")
    assert system.distance == -100
    found = first_order(system.lens, system.distance, jnp.array([0.55]))
    np.testing.assert_allclose(found.image_distance, 50, rtol=1e-4)
    with pytest.warns(UserWarning, match="virtual image"):
        system = read(tmp_path, lens.format(-0.02), back.format(-100), object="-1e12")
    found = first_order(system.lens, system.distance, jnp.array([0.55]))
    np.testing.assert_allclose(found.image_distance, -100, rtol=1e-4)
    assert "the object touches" in refused(tmp_path, object="0")


def test_a_file_without_a_stop(tmp_path):
    with pytest.warns(UserWarning, match="no STOP: the stop is SURF 1"):
        system = read(tmp_path, FRONT.replace("|STOP", ""), BACK)
    assert system.lens.stop == 0 and float(system.lens.semi_diameter[0]) == 5


def test_kinds_of_fields(tmp_path):
    system = read(tmp_path, object="200", FTYP="1 0 2 2")
    np.testing.assert_allclose(np.tan(system.fields[1]), [-1 / 200, -5 / 200])
    scene = system.scene
    assert scene.shape == (2,) and scene.distance == 200
    np.testing.assert_array_equal(scene.field, system.fields)
    np.testing.assert_array_equal(scene.wavelength_weights, system.wavelength_weights)
    angled = read(tmp_path, object="200")  # measured at the entrance pupil, at the first vertex
    np.testing.assert_allclose(np.degrees(angled.fields[1]), [1, 5])
    system = read(tmp_path, FTYP="2 0 2 2")
    focal = float(first_order(system.lens, jnp.inf, jnp.array([0.55])).focal_length[0])
    np.testing.assert_allclose(np.tan(system.fields[1]), [1 / focal, 5 / focal])
    system = read(tmp_path, FTYP="3 0 2 2")
    assert system.fields is None
    with pytest.raises(ValueError, match="fields: real image heights; find each by field_of_image"):
        system.scene  # noqa: B018


def test_what_is_not_read_is_refused_by_line(tmp_path):
    assert re.match(
        r", line 29: SURF 2: type PARAXIAL is not known: an ideal thin lens",
        refused(tmp_path, FRONT, BACK.replace("STANDARD", "PARAXIAL")),
    )
    message = refused(tmp_path, FRONT.replace("N-BK7", "S-BSX7"), BACK)
    assert "line 26: SURF 1: unknown glass 'S-BSX7'" in message and "nd and vd" in message
    assert "N-BK7 is known of SCHOTT" in refused(tmp_path, GCAT="OHARA")
    assert "line 4: fields of kind 7" in refused(tmp_path, FTYP="7 0 2 2")
    assert "cut short" in refused(tmp_path, FRONT, BACK, tail=("SURF 4", "  DISZ 3"))
    assert "telecentric object space" in refused(tmp_path, FTYP="0 1 2 2")
    assert "a coordinate break is no image" in refused(
        tmp_path, FRONT, BACK, tail=("SURF 4", "  TYPE COORDBRK", "  DISZ 0")
    )
    toroid = FRONT.replace("STANDARD", "TOROIDAL|PARM 1 40|XDAT 1 4|XDAT 2 10|XDAT 3 0|XDAT 4 {}")
    assert read(tmp_path, toroid.format(0), BACK).lens.forms[0] == "toroid"
    assert "line 27: parameter 16 (XDAT 4) of SURF 1" in refused(
        tmp_path, toroid.format(1e-3), BACK
    )
    for key in ("USAP 0 0 0", "UDAP 1", "UDAD 1 -.5 -10 0"):
        assert "leaves it out" in refused(tmp_path, FRONT, f"{BACK}|{key}")
    spider = BACK + "|SPID .1 3"
    assert 'missing="warn" leaves it out' in refused(tmp_path, FRONT, spider)
    with pytest.warns(UserWarning, match="left out: SPID, a spider"):
        assert "SPID" in read(tmp_path, FRONT, spider, missing="warn").notes[0]


def test_glasses_of_no_catalogue(tmp_path):
    """nd and vd given with an unknown name are those of a model glass, and are reported; 1.5 and 40
    are OpticStudio's placeholders. Corning 7980, the constant N15, and air."""
    glass = "|GLAS N-BK7 0 0 1.5 40"
    with pytest.warns(UserWarning, match="SURF 1: no catalogue has XYZ9: nd 1.6.* vd 60.3"):
        known = read(tmp_path, FRONT.replace(glass, "|GLAS XYZ9 0 0 1.6204 60.3 0"), BACK).lens
    model = read(tmp_path, FRONT.replace(glass, "|GLAS ___BLANK 1 0 1.6204 60.3 0"), BACK).lens
    np.testing.assert_array_equal(known.index(0.5), model.index(0.5))
    for numbers in ("0 0 1.5 40", "", "0 0 0 0", "0 0 1.6 3"):
        own = FRONT.replace(glass, f"|GLAS XYZ9 {numbers}")
        assert "unknown glass 'XYZ9'" in refused(tmp_path, own, BACK)
    lens = read(tmp_path, FRONT.replace("N-BK7", "C79-80"), BACK, GCAT="SCHOTT CORNING").lens
    # Corning's sheet of 7980: nF, nd, nC at 22 C.
    np.testing.assert_allclose(
        lens.index([0.4861327, 0.5875618, 0.6562725])[1], [1.463132, 1.458467, 1.456370], atol=1e-6
    )
    lens = read(tmp_path, FRONT.replace("N-BK7", "N15"), BACK + "|GLAS AIR", "|".join([BACK])).lens
    np.testing.assert_array_equal(lens.index([0.45, 0.7]), [[1, 1], [1.5, 1.5], [1, 1], [1, 1]])


SLIT = "|".join(
    f"UDAD {line}" for line in ('0 "MY SLIT.UDA" 1', "1 -.5 -9 0", "2 .5 -9 0", "3 0 9 0")
)


def test_user_apertures_are_polygons(tmp_path):
    """The corners are in the file's unit, about the vertex or OBDC; written files are read back."""
    front, back = f"{FRONT}|USAP 0 0 0|{SLIT}", f"{BACK}|OBDC .1 .2|{SLIT}|UDAD 4 0 0 0|USOB 0 0 0"
    lens = read(tmp_path, front, back, UNIT="CM").lens
    clips = lens.apertures
    assert (clips.kinds, clips.surfaces) == (("polygon", "polygon"), (0, 1))
    assert clips.blocks == (False, True)
    np.testing.assert_allclose(clips.outline(0), [[-5, -90], [5, -90], [0, 90]])
    np.testing.assert_allclose(clips.outline(1), clips.outline(0))
    np.testing.assert_allclose(clips.centre, [[0, 0], [1, 2]])
    for name in ("lens.zmx", "lens.yaml"):
        save_lens(lens, tmp_path / name)
        again = load_lens(tmp_path / name).apertures
        assert again.blocks == clips.blocks and again.pieces == clips.pieces
        np.testing.assert_array_equal(again.corners, clips.corners)
        np.testing.assert_array_equal(again.centre, clips.centre)
    with pytest.raises(LensError, match="hold no polygon"):
        save_lens(lens, tmp_path / "lens.seq")


def test_a_polygon_behind_a_stop_whose_rim_is_its_aperture(tmp_path):
    """The circle of the stop is left out, the polygon is kept."""
    front = FRONT.replace("DIAM 6 0", "DIAM 5 0|FLAP 0 5 0")
    clips = read(tmp_path, front, f"{BACK}|USAP 0 0 0|{SLIT}").lens.apertures
    assert clips.kinds == ("polygon",) and clips.surfaces == (1,)
    np.testing.assert_allclose(clips.outline(0), [[-0.5, -9], [0.5, -9], [0, 9]])


def test_user_apertures_that_are_not_known_are_refused(tmp_path):
    for lines, why in (
        ("USAP 0 0 0", "SURF 1: a user aperture with no UDAD lines"),
        (SLIT, "UDAD lines without USAP or USOB"),
        (f"USAP 1 0 0|{SLIT}", "USAP: expected zeros"),
        (f"USAP 0 0 0|{SLIT}|UDAD 4 0 0 0|UDAD 5 1 1 0", "two polygons"),
        (f"USAP 0 0 0|{SLIT}|UDAD 5 1 1 0", "expected corners 1, 2"),
        (f"USAP 0 0 0|{SLIT}|UDAD 4 1 1 2", "expected corners 1, 2"),
        ("USAP 0 0 0|UDAD 0 SLIT.UDA 2", "a scale other than 1"),
        (f"USAP 0 0 0|{SLIT}|UDAD 4 9 0 0|UDAD 5 -9 0 0", "sides cross"),
    ):
        assert why in refused(tmp_path, f"{FRONT}|{lines}", BACK)


def test_what_is_read_otherwise_is_said(tmp_path):
    own = BACK + "|PZUP 1 -1 0 0|ABCD 7"
    with pytest.warns(UserWarning) as said:
        read(tmp_path, FRONT, own, tail=("MNUM 3 2",))
    message = str(said[0].message)
    assert all(
        word in message
        for word in ("3 configurations number 2", "line 33: solves and pickups", "ABCD (line 34)")
    )
    many = "".join(f"|ABC{k} 7" for k in range(11))
    with pytest.warns(UserWarning, match=r"ABC7 \(line 40\) and 3 more"):
        read(tmp_path, FRONT, BACK + many)


def test_model_glasses_without_dispersion_and_with(tmp_path):
    """Vd = 0 is a constant index; nd and vd agree with OpticStudio's listing of 1.511, 60.6 at 0.55
    um."""
    constant = read(tmp_path, FRONT.replace("N-BK7 0 0 1.5 40", "___BLANK 1 0 1.6 0"), BACK).lens
    np.testing.assert_array_equal(constant.index([0.45, 0.7])[1], [1.6, 1.6])
    model = read(tmp_path, FRONT.replace("N-BK7 0 0 1.5 40", "___BLANK 1 0 1.511 60.6 0"), BACK)
    np.testing.assert_allclose(model.lens.index(0.55)[1], 1.5128031808, rtol=0, atol=2e-10)


CROOKED = [
    {"radius": 60, "thickness": 4, "glass": "N-BK7", "tilt": [0.3, 0, 0]},
    {"radius": -60, "thickness": 3, "decentre": [0.1, -0.2]},
    {"radius": "inf", "thickness": 2, "stop": True, "semi_diameter": 4},
    {"radius": 40, "thickness": 3, "glass": "F2"},
    {"radius": 80, "thickness": 30},
    {"radius": -200, "mirror": True, "thickness": -20},
    {"radius": 100, "thickness": -3, "glass": "N-BK7"},
    {"radius": -100},
]
MOVED = [  # elements that end, one in another, a folded axis, pivots elsewhere
    {"surfaces": [0, 1], "shift": [0.1, 0.2, 0.3], "tilt": [1, -2, 0.5]},
    {"surfaces": [3, 4], "pivot": 1.5, "shift": [0, 0.2, -0.1], "tilt": [0.7, 0, 0]},
    {"surfaces": [3, 4], "about": 5, "shift": [0.05, 0, 0], "tilt": [0, 0.4, 0]},
    {"surfaces": [5, "sensor"], "tilt": [20, 0, 0]},
    {"surfaces": [6, 7], "about": 2, "shift": [0.1, 0, 0], "tilt": [0.1, 0.2, 0.3]},
]
SENSOR = {"sensor_tilt": [1, 0.5, 0], "sensor_decentre": [0.2, 0.1]}


def assert_same(one, two):
    """Asserts that two lenses agree to the last bit, except their names; model glasses to the last
    digits of nd."""
    for key in ("curvature", "conic", "thickness", "semi_diameter", "sensor"):
        np.testing.assert_array_max_ulp(np.asarray(getattr(one, key)), getattr(two, key), 1)
    width = one.coefficients.shape[1]
    np.testing.assert_allclose(two.coefficients[:, :width], one.coefficients, rtol=3e-16)
    assert not np.any(two.coefficients[:, width:])
    assert (one.stop, one.forms, one.mirrors) == (two.stop, two.forms, two.mirrors)
    low, high = (one.dispersion.range[k] for k in (0, 1))
    waves = np.linspace(max(low, 0.4), min(high, 0.7), 5)
    np.testing.assert_allclose(two.index(waves), one.index(waves), rtol=1e-15)


@pytest.mark.parametrize("name", ["cooke_triplet", "double_gauss", "phone", "hubble", "singlet"])
def test_written_and_read_back(tmp_path, name):
    lens = load_lens(name)
    save_lens(lens, tmp_path / "lens.zmx")
    assert_same(lens, load_lens(tmp_path / "lens.zmx"))
    # nd and vd, for programs that do not know a glass; and no glass with the name air.
    said = re.findall(r"GLAS (?!MIRROR)\S+ \d 0 (\S+) (\S+)", (tmp_path / "lens.zmx").read_text())
    known = np.asarray(nd_and_vd(lens.dispersion))
    glass = known[:-1][known[:-1, 1] > 0]
    np.testing.assert_allclose(np.array(said, float).reshape(-1, 2), glass, rtol=1e-3)


def test_written_forms_glasses_and_apertures(tmp_path):
    ring = "TYPE STANDARD|CURV 0|DISZ 2|OBSC 0 2 0|OBDC 1 2"
    glass = FRONT.replace("N-BK7 0 0 1.5 40", "___BLANK 1 0 1.511 60.6 0.01")
    odd = BACK.replace("STANDARD", "ODDASPHE|PARM 1 .01|PARM 3 1e-4")
    toroid = BACK.replace("STANDARD", "TOROIDAL|PARM 1 40|PARM 2 1e-4")
    lens = read(tmp_path, glass, odd, toroid, ring).lens
    save_lens(lens, tmp_path / "own.zmx")
    assert "___BLANK 1 0 1.511 60.6 0.01" in (tmp_path / "own.zmx").read_text()
    again = load_lens(tmp_path / "own.zmx")
    assert_same(lens, again)
    np.testing.assert_array_equal(lens.apertures.half, again.apertures.half)
    np.testing.assert_array_equal(lens.apertures.centre, again.apertures.centre)


def read_back(tmp_path, lens):
    save_lens(lens, tmp_path / "own.zmx")
    return load_lens(tmp_path / "own.zmx")


@pytest.mark.slow
def test_written_breaks(tmp_path):
    """Breaks that move all surfaces behind them have the same numbers. Elements that end, and
    decentres and tilts of single surfaces, have the same positions and rays to rounding."""
    turns = [BREAK.format(0, 1, 2, -3, 0.7, 0, 5), BREAK.format(0.5, 0, 0, 20, 3, 0, -2)]
    lens = read(tmp_path, FRONT, BACK, *turns, FRONT.replace("STOP|", "")).lens
    again = read_back(tmp_path, lens)
    assert lens.elements.spans == again.elements.spans == ((2, 3), (2, 3))
    for part in ("shift", "tilt", "pivot"):
        np.testing.assert_array_equal(*(getattr(own.elements, part) for own in (lens, again)))
    lens = load_lens({"surfaces": CROOKED, "elements": MOVED, "sensor": 4.0, **SENSOR})
    again = read_back(tmp_path, lens)
    (z, *others), (along, *found) = lens.places, again.places
    # The object is at infinity: the file does not contain the shift of the first element along z.
    np.testing.assert_allclose(z - z[0], along - along[0], rtol=0, atol=1e-13)
    for one, two in zip(others, found, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-14)
    points = np.random.default_rng(0).uniform(-0.7, 0.7, (9, 2))
    rays = [
        trace_rays(own, Scene.point(np.radians([1.0, 2.0]), np.inf, 0.55), points)
        for own in (lens, again)
    ]
    assert not np.any(rays[0].status)
    np.testing.assert_allclose(*(r.points[..., :2] for r in rays), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["czt_spect", "schlieren_system"])
def test_files_with_breaks_are_written_as_they_were(tmp_path, shared, name):
    with pytest.warns(UserWarning, match="pickups are read as their"):
        lens = load_lens(shared / "lens_files" / f"{name}.zmx")
    again = read_back(tmp_path, lens)
    assert_same(lens, again)
    for one, two in zip(lens.places, again.places, strict=True):
        np.testing.assert_array_equal(one, two)


def test_written_series_and_phases(tmp_path):
    """Extra data and radial phases are read back; and a sag that is computed without this
    reader."""
    series = "XDAT 1 3|XDAT 2 4|XDAT 3 {0}|XDAT 4 -.2|XDAT 5 .3"
    kinds = [f"{kind}|{series.format(0.1)}" for kind in ("XPOLYNOM", "SZERNSAG|PARM 0 1")]
    kinds.append("XASPHERE|XDAT 1 9|XDAT 2 20|XDAT 4 .1|XDAT 11 .2")
    kinds.append("QED_TYPE|XDAT 1 0|XDAT 2 2|XDAT 3 20|XDAT 4 .1|XDAT 5 .2")
    kinds.append("BINARY_2|PARM 0 -1|PARM 2 1e-5|XDAT 1 2|XDAT 2 20|XDAT 3 700|XDAT 4 .3")
    surfaces = [BACK.replace("STANDARD", kind).replace("48", "9") for kind in kinds]
    lens = read(tmp_path, FRONT, *surfaces).lens
    save_lens(lens, tmp_path / "own.zmx")
    again = load_lens(tmp_path / "own.zmx")
    assert_same(lens, again)
    np.testing.assert_allclose(lens.phase.coefficients, again.phase.coefficients, rtol=3e-16)
    assert again.phase.order.tolist() == [-1]
    linear = 0.1 * 1 / 4 - 0.2 * 2 / 4 + 0.3 * 1 / 16 - (50 - np.sqrt(50**2 - 5))
    np.testing.assert_allclose(sag(again, 1, 1.0, 2.0), linear)


def test_files_that_are_none(tmp_path):
    path, noise = tmp_path / "lens.zmx", np.random.default_rng(0)
    whole = text(FRONT, BACK).encode("utf-16")
    spoilt = [
        b"",
        b"0" * 2**25,
        b"SURF 0 " + b"1 " * 10**6,
        b"SURF 0\n" * 10**6,
        noise.bytes(10**5),
    ]
    spoilt += [bytes(10**5), b"x: 1\n", whole[:301], whole[: len(whole) // 2]]
    for content in spoilt:
        path.write_bytes(content)
        began = time.process_time()
        with pytest.raises(LensError) as error:
            load_lens(path)
        assert time.process_time() - began < 2
        assert str(path) in str(error.value) and "\n" not in str(error.value)
        assert len(str(error.value)) <= 300
    for _ in range(150):  # some bytes changed: an error of one line, or a lens
        own = bytearray(text(FRONT, BACK).encode())
        for place in noise.integers(0, len(own), 4):
            own[place] = noise.integers(0, 256)
        path.write_bytes(own)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                load_lens(path)
            except LensError as error:
                assert "\n" not in str(error) and str(path) in str(error)


def listing(name):
    return (SHARED / f"{name}.txt").read_text("latin-1")


def listed(content, key):
    """A number of a listing and half of its last digit."""
    found = re.search(rf"^{re.escape(key)}\s*:\s*(\S+)", content, re.MULTILINE)
    word = found[1]
    digits, _, power = word.lower().partition("e")
    step = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
    return float(word), step


# Those of the 28 whose glasses we have.
READ = (
    *("10281683", "1792917", "1843519", "2453260", "2645156", "528155", "5852515a", "6744570a"),
    *("7558005a", "7643216a", "7821720a", "7821720b", "895045a", "Dyson1959", "WIYN"),
    *("1791276", "Yang2016a", "9201224", "Miyamoto1964"),
)


@pytest.mark.slow
def rows(*operands):
    """Rows of two configurations: each operand with its two values."""
    each = ((*operand.split()[:2], operand.split()[2:]) for operand in operands)
    return [f"{key} {at} {k + 1} {v} 0 0" for key, at, both in each for k, v in enumerate(both)]


OPERANDS = (
    "MOFF 0 0 1", "THIC 1 4 5", "THIC 0 1.00E+10 70", "CRVT 2 -.02 -.03", "CONN 2 0 -1",
    "YFIE 2 5 3", "FLWT 2 2 4", "WAVE 1 .48 .5", "WLWT 2 3 7", "APER 0 10 8", "TEMP 0 20 20"
)  # fmt: skip


def test_each_configuration_is_read(tmp_path):
    """The numbers of the rows replace those of the surfaces; the current configuration has those of
    the surfaces."""
    tail = ("MNUM 2 1", *rows(*OPERANDS))
    with pytest.warns(UserWarning, match="of 2 configurations number 1; give `configuration`"):
        beside = read(tmp_path, tail=tail, UNIT="MM")
    first, second = (read(tmp_path, tail=tail, UNIT="MM", configuration=k) for k in (1, 2))
    assert (second.configurations, second.configuration, second.notes) == (2, 2, ())
    same = np.array_equal(first.lens.thickness, beside.lens.thickness)
    assert same and first.distance == beside.distance == np.inf and beside.configuration == 1
    assert second.distance == 70 and second.lens.thickness[0] == 5 and first.lens.thickness[0] == 4
    assert (second.lens.curvature[1], second.lens.conic[1], first.lens.conic[1]) == (-0.03, -1, 0)
    np.testing.assert_array_equal(second.heights, [[0, 0], [1, 3]])
    np.testing.assert_array_equal(second.field_weights, [1, 4])
    np.testing.assert_array_equal(second.wavelengths, [0.5, 0.55])
    np.testing.assert_array_equal(second.wavelength_weights, [1, 7])
    assert (first.aperture, second.aperture) == (10, 8)
    mixed = ("MNUM 2 1", *sorted(rows(*OPERANDS), key=lambda row: row.split()[2]))
    again = read(tmp_path, tail=mixed, UNIT="MM", configuration=2)
    np.testing.assert_array_equal(again.lens.curvature, second.lens.curvature)
    assert (again.distance, again.lens.thickness[0], again.aperture) == (70, 5, 8)
    found = read(tmp_path, tail=("MNUM 2 1", *rows("SDIA 1 6 3")), ENPD=None, FLOA="",
                 configuration=2)  # fmt: skip
    assert found.lens.semi_diameter[0] == 3


def test_rows_that_are_not_known_are_refused_where_they_differ(tmp_path):
    tail = ("MNUM 2 1", *rows("TEMP 0 20 60"))
    message = "line 39: TEMP, which differs between configurations; missing=.warn. leaves it out"
    with pytest.raises(LensError, match=message):
        read(tmp_path, tail=tail, configuration=2)
    assert read(tmp_path, tail=tail, configuration=1).configuration == 1
    tail = ("MNUM 2 1", *rows("LTTL 0 wide tele", "PRAM 2 0 10", "PRAM 2 0 0"))
    for missing in ("error", "warn"):  # of two parameters; what shapes a lens is never left out
        with pytest.raises(LensError, match="line 41: PRAM, which differs .* file of its own"):
            read(tmp_path, tail=tail, configuration=2, missing=missing)
    for row in ("THIC 9 1 2", "YFIE 9 1 2", "WAVE 9 1 2"):
        with pytest.raises(LensError, match=f"{row[:6]}: the file has none"):
            read(tmp_path, tail=("MNUM 2 1", *rows(row)), configuration=2)
    with pytest.raises(LensError, match="expected a number, got 'x'"):
        read(tmp_path, tail=("MNUM 2 1", *rows("THIC 1 4 x")), configuration=2)
    for wanted in (0, 3, "wide"):
        with pytest.raises(LensError, match=f"line 37: there is no configuration {wanted!r}; the"):
            read(tmp_path, tail=tail, configuration=wanted)


def wild(name, configuration):
    """A file from a public repository, and its first-order data at its primary wavelength."""
    (path,) = (SHARED.parent / "wild").glob(f"{name}*.zmx")
    system = load_system(path, "warn", configuration)
    return system, first_order(
        system.lens, system.distance, jnp.array(system.wavelengths[system.primary :][:1])
    )


@LISTED
@pytest.mark.parametrize(
    ("name", "focal"),
    [
        ("Ricoh_smc_Pentax-FA_28-70mm", (29.0, 50.0, 68.0)),
        ("Nikon_R-UW_AF_Zoom-Nikkor_20-35mm", (20.6, 26.5, 34.0)),
    ],
)
def test_zooms_of_patents_are_in_focus_in_every_configuration(name, focal):
    """Focal lengths of the patents, mm; in each configuration the sensor is in the paraxial
    focus."""
    for k, wanted in enumerate(focal):
        system, found = wild(name, k + 1)
        np.testing.assert_allclose(found.effective_focal_length, wanted, atol=6e-3)
        back = system.lens.sensor - jnp.sum(system.lens.thickness)
        np.testing.assert_allclose(found.back_focal_distance, back, atol=6e-3)


@LISTED
def test_a_macro_lens_of_a_patent_has_its_magnifications():
    for k, wanted in enumerate((0.0, -0.5, -1.0)):
        _, found = wild("Nikon_R-UW_AF_Micro-Nikkor_50mm", k + 1)
        np.testing.assert_allclose(found.magnification, wanted, atol=2e-4)


@LISTED
@pytest.mark.parametrize("name", READ)
def test_listed_first_order(name):
    """Focal length, pupil and f-number agree to the listing's last digit, indices to 2e-10."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system = load_system(SHARED / f"{name}.zmx")
    content, wave = listing(name), system.wavelengths[system.primary]
    found = first_order(system.lens, system.distance, jnp.array([wave]))
    focal, pupil = found.effective_focal_length[0], found.entrance_pupil
    wanted = {
        "Effective Focal Length": focal,
        "Image Space F/#": abs(focal) / (2 * pupil.semi_diameter[0]),
        "Paraxial Working F/#": 0.5 / found.numerical_aperture[0],
        "Entrance Pupil Diameter": 2 * pupil.semi_diameter[0],
        "Entrance Pupil Position": pupil.position[0],
        "Stop Radius": system.lens.semi_diameter[system.lens.stop],
    }
    for key, value in wanted.items():
        number, step = listed(content, key)
        assert abs(float(value) - number) <= 1.01 * step, key
    rows = re.findall(r"^ +\d+ .*?((?:\s+\d\.\d{10})+)", content.partition("INDEX OF")[2], re.M)
    indices = np.array([row.split() for row in rows[: system.lens.count]], float)
    # Silica's constants, Malitson's, have one digit more here.
    index, most = system.lens.index(system.wavelengths)[:-1], 2e-9 if name == "Dyson1959" else 2e-10
    np.testing.assert_allclose(index, indices, rtol=0, atol=most)
