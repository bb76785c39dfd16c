"""`.seq` files: the meaning of each command, CODE V's own listings, and invalid files."""

import re
import time
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import LensError, first_order, load_lens, load_system, sag, save_lens
from drt_jax.files.glasses import code_of
from drt_jax.files.load import read_record
from drt_jax.files.record import Breaking

from .. import oracle

HEAD = "RDM; LEN\nTITLE 'a lens'\nEPD 10\nDIM M\nWL 550 480\nREF 1\nYAN 0 5\n"
FRONT, BACK = "S 50 4 NBK7_SCHOTT; STO", "S -50 48"


def text(*lines, head=HEAD, object="SO 0 1e11", image="SI 0 0", tail="GO"):
    return "\n".join([head.rstrip(), object, *lines, image, tail])


def written(folder, *lines, **others):
    path = folder / "lens.seq"
    path.write_text(text(*(lines or (FRONT, BACK)), **others))
    return path


def record(folder, *lines, missing="error", configuration=None, **others):
    """The record that is read, before a lens is built."""
    return read_record(written(folder, *lines, **others), missing, configuration)


def entry(folder, *lines, at=0, **others):
    """The entries of a surface with these commands, behind the first surface and before the
    last."""
    found = record(folder, FRONT, *lines, "S 0 5", **others)
    return [part.entry for part in found.parts if not isinstance(part, Breaking)][1 + at]


def refused(folder, *lines, **others):
    with pytest.raises(LensError) as error:
        load_system(written(folder, *lines, **others))
    return str(error.value).partition("lens.seq")[2]


def read(folder, *lines, missing="error", **others):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_system(written(folder, *lines, **others), missing)


def test_lines_comments_quotes_and_letters(tmp_path):
    """`;` and new lines separate commands, `!` starts a comment, `&` continues a line; none of them
    does inside quotes."""
    lines = ["s 50 & ! first\n 4 nbk7_schott ! 500.625", "STOP; ThiCK 7", "S -50&\n 48;"]
    found = record(tmp_path, *lines, head=HEAD.replace("'a lens'", '"it\'s; 5! & up"'))
    rows = [part for part in found.parts if not isinstance(part, Breaking)]
    assert found.name == "it's; 5! & up" and [row.thickness for row in rows] == [7, 48, 0]
    assert rows[0].entry == {"curvature": 0.02, "glass": "N-BK7", "stop": True}
    assert found.notes == [] and found.use.wavelengths == [0.55, 0.48]
    messages = refused(tmp_path, FRONT, "S -50 &\n 1.2.3")
    assert ", line 10: expected a number, got '1.2.3'" in messages  # its first line


def test_radii_curvatures_and_units(tmp_path):
    even = "ASP; K -.5; A 1e-5; J 1e-20"
    mm = read(tmp_path, f"{FRONT}; {even}", BACK)
    curved = HEAD.replace("RDM;", "RDM N;")
    same = read(tmp_path, f"S .02 4 NBK7_SCHOTT; STO; {even}", "S -.02 48", head=curved).lens
    np.testing.assert_array_equal(mm.lens.curvature, same.curvature)
    assert float(mm.lens.coefficients[0, 1]) == 1e-5  # A is r^4, J is r^20; there is no I
    assert float(mm.lens.coefficients[0, 9]) == 1e-20 and float(mm.lens.conic[0]) == -0.5
    inch = read(tmp_path, f"{FRONT}; {even}", BACK, head=HEAD.replace("DIM M", "DIM I"))
    scale = 25.4
    np.testing.assert_allclose(inch.lens.curvature, mm.lens.curvature / scale, rtol=1e-15)
    np.testing.assert_allclose(inch.lens.sensor, mm.lens.sensor * scale, rtol=1e-15)
    np.testing.assert_allclose(inch.lens.coefficients[0, 9], 1e-20 / scale**19, rtol=1e-14)
    np.testing.assert_allclose(inch.lens.semi_diameter[0], 5 * scale, rtol=1e-14)
    np.testing.assert_array_equal(inch.wavelengths, mm.wavelengths)
    notes = record(tmp_path, "S .02 4 NBK7; STO", "S -.02 48", head=HEAD.replace("RDM;", ""))
    assert notes.notes == ["no RDM: the numbers of surfaces are curvatures"]


def test_use_of_a_lens(tmp_path):
    head = HEAD + "XAN 1 2\nWTF 1 3\nVUY 0 .2\nVLY 0 .1\nVUX 0 .4\nWTW 2 1\nREF 2\nYAN F2 7\n"
    system = read(tmp_path, head=head)
    np.testing.assert_array_equal(system.wavelengths, [0.55, 0.48])
    np.testing.assert_array_equal(system.wavelength_weights, [2, 1])
    np.testing.assert_allclose(np.degrees(system.fields), [[1, 0], [2, 7]])
    np.testing.assert_array_equal(system.field_weights, [1, 3])
    assert system.primary == 1 and system.distance == np.inf and system.notes == ()
    # The upper rim lies at 1 - VU, the lower one at -1 + VL.
    shift, compression = system.vignetting[1, :2], system.vignetting[1, 2:4]
    np.testing.assert_allclose(shift + 1 - compression, [0.6, 0.8])
    np.testing.assert_allclose(shift - 1 + compression, [-1, -0.9])
    assert float(system.lens.semi_diameter[0]) == 5 and system.ray_aiming == "chief"


@pytest.mark.slow
def test_apertures_of_systems_and_kinds_of_fields(tmp_path):
    """EPD, FNO, NA, NAO by their definitions: NA is NAO divided by the magnification, FNO 1 / (2
    NA)."""

    def first(own, object="SO 0 200", fields="YAN 0 5"):
        head = HEAD.replace("EPD 10", own).replace("YAN 0 5", fields)
        system = read(tmp_path, head=head, object=object)
        return system, first_order(system.lens, system.distance, jnp.array([0.55]))

    system, found = first("FNO 8", "SO 0 1e11")
    focal = float(found.effective_focal_length[0])
    np.testing.assert_allclose(2 * found.entrance_pupil.semi_diameter, focal / 8)
    assert (system.aperture, system.aperture_kind) == (8, "f-number")
    found = first("NA .0625", "SO 0 1e11")[1]
    np.testing.assert_allclose(2 * found.entrance_pupil.semi_diameter, focal / 8)
    found = first("NAO .02")[1]
    edge = 200 * np.tan(np.arcsin(0.02))
    np.testing.assert_allclose(found.entrance_pupil.semi_diameter, edge)
    magnified = abs(float(found.magnification[0]))
    for own in (f"NA {0.02 / magnified}", f"FNO {magnified / 0.04}"):
        np.testing.assert_allclose(first(own)[1].entrance_pupil.semi_diameter, edge)
    angles = first("NAO .02", fields="YOB 0 -5")[0].fields
    np.testing.assert_allclose(np.tan(angles[1]), [0, 5 / 200])
    angles = first("EPD 10", "SO 0 1e11", "YIM 0 5")[0].fields
    np.testing.assert_allclose(np.tan(angles[1]), [0, 5 / focal])
    assert first("EPD 10", "SO 0 1e11", "YRI 0 5")[0].fields is None


def test_glasses(tmp_path):
    """Names without hyphens with their maker; codes; nd:vd; a mirror keeps the medium."""
    assert code_of("517642") == (1.517, 64.2) and code_of("569.631") == (1.569, 63.1)
    assert code_of("516800.641700") == (1.5168, 64.17) and code_of("1.5168:64.17") == (
        1.5168,
        64.17,
    )
    assert code_of("1.5") is None and code_of("NBK7") is None
    words = {"NBK7_SCHOTT": "N-BK7", "nlasf31a_schott": "N-LASF31A", "F2": "F2", "sk16": "SK16"}
    for word, name in words.items():
        assert entry(tmp_path, f"S 9 1 {word}")["glass"] == name
    assert entry(tmp_path, "S 9 1 SILICA_SPECIAL")["glass"] == "silica"
    assert entry(tmp_path, "S 9 1 517.642")["nd"] == 1.517
    assert "glass" not in entry(tmp_path, "S 9 1 AIR")
    assert entry(tmp_path, "S 9 -1 REFL") == {"curvature": 1 / 9, "mirror": True}
    assert entry(tmp_path, "S 9 1; RMD REFL")["mirror"]
    assert entry(tmp_path, "S 9 1; GLA S2 F2")["glass"] == "F2"
    assert entry(tmp_path, "S 9 1 SLAL8_OHARA")["glass"] == "S-LAL8"
    assert entry(tmp_path, "S 9 1 SK16_SCHOTT")["glass"] == "SK16_SCHOTT"  # SK16 is Hikari's
    assert "unknown glass 'SLAL99'" in refused(tmp_path, "S 9 1 SLAL99_OHARA; STO", BACK)
    assert "N-BK7 is known of SCHOTT" in refused(tmp_path, "S 9 1 NBK7_HOYA; STO", BACK)


def test_private_glasses(tmp_path):
    """A table passes through its indices; formulas have their constants."""
    waves = np.array([0.7, 0.65, 0.6, 0.55, 0.5, 0.48])
    true = np.asarray(load_lens("singlet").index(waves)[2])
    prv = f"PRV\nPWL {' '.join(map(repr, (1000 * waves).tolist()))}\n'TAB' &\n"
    prv += " ".join(map(repr, true.tolist())) + "\nEND"
    lens = read(tmp_path, prv, "S 50 4 'TAB'; STO", BACK).lens
    np.testing.assert_allclose(lens.index(waves)[1], true, rtol=1e-11)
    np.testing.assert_allclose(lens.index(0.52)[1], load_lens("singlet").index(0.52)[2], rtol=1e-6)
    with pytest.raises(ValueError, match="outside the range of TAB, 0.48 to 0.7"):
        lens.index(0.8)
    # With more than six indices, those at the file's wavelengths, here 550 and 480 nm, are exact.
    more = np.round(np.linspace(0.4, 0.9, 51), 3)
    rough = np.round(np.asarray(load_lens("singlet").index(more)[2]), 4)
    numbers = f"PWL {' '.join(map(repr, (1000 * more).tolist()))}\n'T' "
    numbers += " ".join(map(repr, rough.tolist()))
    head = HEAD.replace("480", "480 650.3")
    system = read(tmp_path, f"PRV\n{numbers}\nEND", "S 50 4 T; STO", BACK, head=head)
    index = system.lens.index([0.55, 0.48, 0.6503])[1]
    held = rough[[np.argmin(abs(more - w)) for w in (0.55, 0.48)]]
    np.testing.assert_allclose(index[:2], held, atol=1e-12)
    np.testing.assert_allclose(index[2], load_lens("singlet").index(0.6503)[2], atol=1e-4)
    assert "Schott's formula through the indices of the table" in system.notes[0]
    square = 0.55**2
    formulas = {
        "LAU 2.25 -.01 .01": np.sqrt(2.25 - 0.01 * square + 0.01 / square),
        "GMS 1.1 .01 .2 90": np.sqrt(
            1 + 1.1 * square / (square - 0.01) + 0.2 * square / (square - 90)
        ),
        "CAU 1.5 .004 1e-4": 1.5 + 0.004 / square + 1e-4 / square**2,
    }
    for words, value in formulas.items():
        lens = read(tmp_path, f"PRV\nPWL 700 400\n'F' {words}\nEND", "S 50 4 'F'; STO", BACK).lens
        np.testing.assert_allclose(lens.index(0.55)[1, 0], value, rtol=1e-14)
    assert "known formulas" in refused(tmp_path, "PRV; 'F' HAR 1 2 3; END", "S 9 1 F; STO", BACK)


@pytest.mark.parametrize(
    ("own", "wanted"),
    [
        ("CON; K -1", {"conic": -1}),
        ("YTO; RDX 40; K .5; A 1e-4", {"form": "toroid", "curvature": 0.1, "curvature_x": 0.025,
                                       "conic": 0.5, "coefficients": {4: 1e-4}}),
        ("XTO; RDX 40", {"form": "toroid", "curvature": 0.025, "curvature_x": 0.1,
                         "tilt": [0, 0, 90]}),
        ("CYL", {"form": "toroid", "curvature": 0.1, "curvature_x": 0}),
        ("CUY 0; CYL; CUX .5", {"curvature": 0.5, "curvature_x": 0, "tilt": [0, 0, 90]}),
        ("AAS; CUX .2; KX 1; KY 2; BR 3", {"form": "biconic", "curvature_x": 0.2, "conic_x": 1,
                                           "conic": 2, "coefficients": {6: 3}}),
        ("SPS ODD 0.0; SCO K -1; SCO AR3 2; SCO C5 3", {"form": "odd_asphere", "conic": -1,
                                                        "coefficients": {3: 2, 4: 3}}),
        ("SPS ODD 2; SCO AR3 8", {"coefficients": {3: 1}}),
        ("SPS XYP 10.; SCO C2 5; SCO C5 7; SCO C8 1e3", {"form": "polynomial_xy", "coefficients":
                                                         {"x1y0": 0.5, "x1y1": 0.07, "x2y1": 1}}),
        ("SPS QBF; SCO NRADIUS 12; SCO C3 .1; SCO C5 .2; SCO C17 -2",
         {"form": "qbfs", "norm_radius": 12, "conic": -2, "coefficients": {0: 0.1, 2: 0.2}}),
        ("DIF GRT; GRO 1; GRS .002", {"phase": {"form": "linear", "order": 1,
                                                "coefficients": {"y": 500}}}),
        ("DIF DOE; HOR 1; HWL 500; HCT R; HCO C1 -.001", {"phase": {
            "form": "asphere", "order": 1, "coefficients": {2: -2}}}),
    ],
)  # fmt: skip
def test_kinds_of_surfaces(tmp_path, own, wanted):
    found = entry(tmp_path, f"S 10 2; {own}")
    for key, value in wanted.items():
        assert_close(found[key], value)


def assert_close(found, wanted):
    if isinstance(wanted, dict):
        assert found.keys() == wanted.keys()
        for key in wanted:
            assert_close(found[key], wanted[key])
    else:
        assert found == (wanted if isinstance(wanted, str) else pytest.approx(wanted, rel=1e-14))


@pytest.mark.slow
def test_a_zone_plate_focuses_as_its_optical_path_says(tmp_path):
    """The optical path C1 r^2 at HWL is that of a thin lens with f = -1 / (2 C1); f is proportional
    to 1 / wavelength."""
    own = "S 0 9; STO; DIF DOE; HOR 1; HWL 550; HCT R; HCO C1 -.005"
    system = read(tmp_path, own, "S 0 91", head=HEAD.replace("DIM M", "DIM C"))
    found = first_order(system.lens, np.inf, jnp.array([0.55, 0.5]))
    np.testing.assert_allclose(found.focal_length, [1000, 1100])  # 100 cm


@pytest.mark.slow
def test_fringe_polynomials(tmp_path):
    """9, spherical aberration, is 6 r^4 - 6 r^2 + 1; 5 and 6 are astigmatism, 8 is coma along y."""
    shapes = {
        9: lambda x, y: 6 * (x * x + y * y) ** 2 - 6 * (x * x + y * y) + 1,
        5: lambda x, y: x * x - y * y,
        6: lambda x, y: 2 * x * y,
        8: lambda x, y: (3 * (x * x + y * y) - 2) * y,
        37: lambda x, y: np.polynomial.legendre.legval(2 * (x * x + y * y) - 1, [0] * 6 + [1]),
    }
    x, y = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.7, -0.4])
    terms = "; ".join(f"SCO C{k + 3} .0{k}" for k in shapes)
    lens = read(tmp_path, f"S 0 4 NBK7_SCHOTT; STO; SPS ZFR; SCO NRADIUS 8; {terms}", BACK).lens
    wanted = sum(float(f".0{k}") * f(x, y) for k, f in shapes.items())
    np.testing.assert_allclose(sag(lens, 0, 8 * x, 8 * y), wanted, rtol=1e-12)


def test_what_clips(tmp_path):
    """EDG never clips, CIR is a semi-diameter, the others have labels; HOL and OBS are
    obscurations; ARO rotates by 90 degrees."""
    assert entry(tmp_path, "S 9 1; CIR 3; CIR EDG 2")["semi_diameter"] == 3
    own = "S 9 1; REX L'A' 1; REY L'A' 2; ADX L'A' 3; ADY L'A' -4"
    own += "; CIR OBS L'B' .5; ELX HOL 1; ELY HOL 2"
    found = entry(tmp_path, own)
    assert found["aperture"] == [{"rectangle": [1, 2], "centre": [3, -4]}]
    assert found["obscuration"] == [{"circle": 0.5}, {"ellipse": [1, 2]}]
    assert entry(tmp_path, "S 9 1; REX 1; REY 2; ARO 90")["aperture"] == [{"rectangle": [2, 1]}]
    assert entry(tmp_path, "S 9 1; XTO; REX 1; REY 2")["aperture"] == [{"rectangle": [2, 1]}]
    assert "semi_diameter" not in entry(tmp_path, "CA NO\nS 9 1; CIR 3")
    assert "turned by 30 degrees" in refused(tmp_path, FRONT, "S 9 1; REX 1; REY 2; ARO 30")
    # A circle on the stop whose size agrees with EPD is the stop itself; a narrower one clips.
    same = read(tmp_path, f"{FRONT}; CIR 5.0000000001", BACK).lens
    assert same.apertures is None and float(same.semi_diameter[0]) == 5.0000000001
    assert float(read(tmp_path, f"{FRONT}; CIR 4", BACK).lens.apertures.half[0, 0]) == 4


def places(lens):
    """Vertices (S + 1, 3) and rotations."""
    z, across, turned = lens.places
    across = np.zeros((len(z), 2)) if across is None else across
    return np.concatenate([across, np.asarray(z)[:, None]], axis=1), np.asarray(turned)


@pytest.mark.slow
def test_where_surfaces_stand(tmp_path):
    """Basic decentres, BEN, REV, RET and DAR, compared with geometry; ray-optics 0.9.8 has the same
    positions."""
    folded = read(tmp_path, FRONT, "S -50 20", "S 0 -30 REFL; ADE 45; BEN", "S 9 -1 F2", "S 0 -3")
    points, turned = places(folded.lens)
    # Left-handed about x: the mirror's normal lies between +z and +y, light goes down to -y.
    np.testing.assert_allclose(points[3:], [[0, -30, 24], [0, -31, 24], [0, -34, 24]], atol=1e-13)
    np.testing.assert_allclose(turned[3] @ [0, 0, 1], [0, 1, 0], atol=1e-14)
    prism = ["S 0 3", "S 0 2; YDE 2; ADE 30", "S 0 3; REV; YDE 2; ADE 30", "S 9 1 F2", "S 0 9"]
    points, turned = places(read(tmp_path, FRONT, BACK, *prism).lens)
    np.testing.assert_allclose(turned[-1], np.eye(3), atol=1e-15)
    sine, cosine = np.sin(np.radians(30)), np.cos(np.radians(30))
    moved = np.array([0, 2 + 2 * sine, 55 + 2 * cosine]) - [0, 2, -3]
    np.testing.assert_allclose(points[5], moved, atol=1e-12)
    back = ["S 0 3", "S 0 7; XDE 1; BDE 20; ADE 5", "S 0 4", "S 0 6; RET S3", "S 9 1 F2", "S 0 9"]
    points, turned = places(read(tmp_path, FRONT, BACK, *back).lens)
    np.testing.assert_allclose(points[[2, 5, 6]], [[0, 0, 52], [0, 0, 52], [0, 0, 58]], atol=1e-12)
    np.testing.assert_allclose(turned[6], np.eye(3), atol=1e-14)
    alone = read(tmp_path, FRONT, "S -50 48; XDE 1; BDE 3; CDE 4; DAR").lens
    np.testing.assert_array_equal(alone.decentre[1], [1, 0])
    np.testing.assert_allclose(np.degrees(alone.tilt[1]), [0, -3, 4], rtol=1e-15)
    assert alone.elements is None
    axial = read(tmp_path, FRONT, "S -50 48; ZDE 2; ADE 3; DAR").lens
    np.testing.assert_allclose(places(axial)[0][1:], [[0, 0, 6], [0, 0, 52]], atol=1e-14)
    assert "several axes" in refused(tmp_path, FRONT, BACK, "S 0 -9 REFL; ADE 9; BDE 9; BEN")
    assert "is moved itself" in refused(tmp_path, FRONT, BACK, "S 0 1; YDE 1", "S 0 1; RET S3")


# A three-mirror telescope whose rays CODE V 10.8 lists: the example of ray-optics, with its prints.
MIRRORS = """RDM; LEN; EPD 100; DIM M; WL 500; XAN 0 2; YAN 2 -2
SO 0 1e11
S 0 300
S -1058.98937 -276.006853 REFL; CON; K -1.314566; DAR; YDE 48.695345; ADE 8.438645
S 0 -0.981318; STO; DAR; YDE 11.444717; ADE 10.219900
S -324.065 319.160560 REFL; CON; K .889123; DAR; YDE 17.561821; ADE 9.661580
S -453.96516 -321.621031 REFL; ASP; K .226106; A .36895E-10; DAR; YDE 67.500535; ADE 9.514418
SI 0 15.407921; YDE -47.681342; ADE 8.716957; DAR
GO"""


def own_hits(system, field, points):
    """Intersections of the rays through (x, y, 0) with each surface, along its own axes, by the
    oracle."""
    wave = [system.wavelengths[system.primary]]
    scene = oracle.Scene.of(system.lens, field, np.inf, wave)
    x, y = (np.array([part]) for part in np.array(points).T)
    rays = oracle.trace(scene, x, y)
    return np.real([np.stack(np.broadcast_arrays(*hit), -1)[0] for hit in rays.own])


@pytest.mark.slow
def test_listed_rays_through_tilted_mirrors(tmp_path):
    """The sign of ADE, DAR, the defocus of a tilted image, the signs of fields: to 1e-5 mm, because
    radii are printed to 1e-5."""
    path = tmp_path / "mirrors.seq"
    path.write_text(MIRRORS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system = load_system(path)
    meridional = own_hits(system, system.fields[0], [[0, 112.848743]])
    np.testing.assert_allclose(meridional[1, 0], [0, 75.360070, -2.680329], atol=1e-5)
    np.testing.assert_allclose(meridional[4, 0], [0, -89.201217, -8.867643], atol=1e-5)
    np.testing.assert_allclose(meridional[5, 0], [0, 14.075077, 0], atol=1e-5)
    skew = own_hits(system, system.fields[1], [[-31.645678, 178.149440]])
    np.testing.assert_allclose(skew[2, 0], [0, 0, 0], atol=1e-5)
    np.testing.assert_allclose(skew[4, 0], [24.575385, -139.197865, -22.687357], atol=1e-5)
    np.testing.assert_allclose(skew[5, 0], [14.086350, -14.325065, 0], atol=1e-5)
    # The same tertiary from another listing, as SPS QBF with five digits.
    forbes = "SPS QBF; SCO NRADIUS 189.86; SCO C3 .42605; SCO C4 -.016782; SCO C5 8.2673E-04"
    forbes += "; SCO C6 -4.4487E-05; SCO C7 2.5242E-06; SCO C8 -1.3595E-07"
    own = MIRRORS.replace("ASP; K .226106; A .36895E-10", forbes).replace(
        "-453.96516", "-449.67012"
    )
    path.write_text(own)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        other = load_lens(path)
    r = np.linspace(0, 180, 19)
    np.testing.assert_allclose(sag(other, 4, 0, r), sag(system.lens, 4, 0, r), atol=2e-5)


GAUSS = """RDM N;LEN
TITLE 'Double Gauss F/2 -  Available Glasses'
EPD 50.0; DIM M; WL 656.3 587.6 486.1; REF 2; WTW 1 1 1
XAN 0.0 0.0 0.0; YAN 0.0 10.0000000023 14.0000000032
SO 0.0 993938392063.0
S 0.01779284094091543 8.75 NSSK2_SCHOTT; CCY 0
S 0.006566600536925569 0.5
S 0.02653743294670983 12.5 NSK2_SCHOTT
S 0.0 3.8 F5_SCHOTT
S 0.04126892878570084 16.36944492653564
S 0.0 13.74795696388906; THC 0; STO
S -0.03523942654429074 3.8 F5_SCHOTT
S 0.0 11.0 NSK16_SCHOTT
S -0.02636750828657709 0.5
S 0.005636604951748545 7.0 NSK16_SCHOTT
S -0.0125926458590576 61.4875364179821; PIM
SI 0.0 -0.4002686453541377
GO"""


@pytest.mark.slow
def test_listed_double_gauss(tmp_path):
    """CODE V 10.8 for its own file: indices, first-order data, rays, to the last printed digit."""
    path = tmp_path / "gauss.seq"
    path.write_text(GAUSS)
    with pytest.warns(UserWarning, match=r"line 16: solves and pickups are read as their"):
        system = load_system(path)
    glasses = np.asarray(system.lens.index(system.wavelengths))[[1, 3, 4, 8]]
    listed = [[1.618769, 1.622292, 1.630455], [1.604134, 1.607379, 1.614860]]
    listed += [[1.598744, 1.603417, 1.614617], [1.617271, 1.620408, 1.627559]]
    np.testing.assert_allclose(glasses, listed, atol=5.1e-7)
    found = first_order(system.lens, system.distance, jnp.array([0.5876]))
    pupil = found.entrance_pupil
    values = [found.effective_focal_length[0], found.back_focal_distance[0], pupil.position[0]]
    np.testing.assert_allclose(np.array(values), [100.0038, 61.4875, 57.9120], atol=5.1e-5)
    np.testing.assert_allclose(system.lens.semi_diameter[5], 15.852527, atol=5.1e-7)
    np.testing.assert_allclose(float(system.lens.sensor) - 77.9674, 61.0873, atol=1.1e-4)
    tangent = np.tan(system.fields[1, 1])
    chief, skew = (y - z * tangent for y, z in ((-10.199122, 0.933171), (-9.180390, 6.710684)))
    hits = own_hits(system, system.fields[1], [[0, chief], [25, skew]])
    np.testing.assert_allclose(hits[5], [[0, 0, 0], [15.727108, -0.223552, 0]], atol=3e-6)
    np.testing.assert_allclose(hits[10, 0], [0, 8.254743, -0.430202], atol=3e-6)
    np.testing.assert_allclose(hits[10, 1], [16.407589, 7.707488, -2.096743], atol=3e-6)
    np.testing.assert_allclose(hits[11, 0], [0, 17.485856, 0], atol=3e-6)


def test_later_changes_solves_and_zooms(tmp_path):
    """For a named surface or several, also by a second line of a surface; of the zoom positions
    one."""
    later = ["THI S1 5; CUY S2 -.03; THI S2 PIM", "GLA S1 F2", "S1 40 6"]
    found = record(tmp_path, FRONT, BACK, *later)
    rows = found.parts
    assert [row.thickness for row in rows] == [6, 48, 0]
    assert [row.entry["curvature"] for row in rows] == [1 / 40, -0.03, 0]
    assert rows[0].entry["glass"] == "F2" and "line 11: solves" in found.notes[0]
    zoom = ["ZOO 3", "ZOO THI S1 7 8 9", "ZOO THC S1 0 0 0", "ZOO YAN F2 3 4 5", "EPD Z2 40"]
    zoom += ["ZOO THI S2 44", "THI S1 Z3 6"]
    for wanted, gap, pupil, angle in (
        (None, 7, 10, 3),
        (1, 7, 10, 3),
        (2, 8, 40, 4),
        (3, 6, 10, 5),
    ):
        found = record(tmp_path, FRONT, BACK, *zoom, configuration=wanted)
        assert [row.thickness for row in found.parts[:2]] == [gap, 44]
        assert found.use.aperture == pupil and found.use.heights[1] == (0, angle)
        assert (found.configurations, found.configuration) == (3, wanted or 1)
        told = ["line 11: of 3 configurations number 1; give `configuration`"]
        assert found.notes == ([] if wanted else told)
    with pytest.raises(LensError, match="line 11: there is no configuration 4; the file has 3"):
        record(tmp_path, FRONT, BACK, *zoom, configuration=4)
    with pytest.raises(LensError, match="no configuration 2; the file has one alone"):
        record(tmp_path, FRONT, BACK, configuration=2)
    with pytest.raises(LensError, match="line 12: ZOO THI: 2 values"):
        record(tmp_path, FRONT, BACK, "ZOO 3", "ZOO THI S1 7 8")


def test_what_is_not_read_is_refused_by_line(tmp_path):
    assert re.match(
        r", line 10: S2: SPS ZRN is not read; known: ODD",
        refused(tmp_path, FRONT, "S 9 1; SPS ZRN"),
    )
    assert "line 10: GL1 is not read" in refused(tmp_path, FRONT, "GL1 S1 F2")
    assert "known: GRT, DOE with HCT R" in refused(tmp_path, FRONT, "S 0 9; DIF HOE")
    assert "AP, a lopsided asphere" in refused(tmp_path, FRONT, "S 9 9; AAS; AP 1")
    assert "C on a surface of kind CON" in refused(tmp_path, FRONT, "S 9 9; CON; C 1")
    assert "no SI follows" in refused(tmp_path, FRONT, BACK, image="", tail="")
    assert "no aperture is given" in refused(tmp_path, head=HEAD.replace("EPD 10", ""))
    assert "a second lens begins" in refused(tmp_path, FRONT, "LEN")
    assert "there is no surface S7 yet" in refused(tmp_path, FRONT, "THI S7 3")
    assert "an infinite thickness" in refused(tmp_path, FRONT, "S 9 1e13")
    assert "0 mm Hg; our indices are those of 760" in refused(tmp_path, head=HEAD + "PRE 0")
    hot = HEAD + "TEM 60"
    assert 'missing="warn" leaves it out' in refused(tmp_path, head=hot)
    assert "60 C" in record(tmp_path, FRONT, BACK, missing="warn", head=hot).notes[0]
    notes = record(tmp_path, FRONT, BACK, "XYZ 4", tail="GO\nSPO; GO").notes
    assert "XYZ (line 11)" in notes[1] and "line 14 on, is not read" in notes[0]


def assert_same(one, two):
    """Asserts that two lenses agree to 17 digits, except the names of glasses."""
    for key in ("curvature", "conic", "thickness", "semi_diameter", "sensor", "decentre", "tilt"):
        np.testing.assert_array_equal(getattr(one, key), getattr(two, key))
    width = min(one.coefficients.shape[1], two.coefficients.shape[1])
    np.testing.assert_allclose(two.coefficients[:, :width], one.coefficients[:, :width], rtol=3e-16)
    assert not np.any(one.coefficients[:, width:]) and not np.any(two.coefficients[:, width:])
    assert (one.stop, one.forms, one.mirrors) == (two.stop, two.forms, two.mirrors)
    assert one.dispersion.range == two.dispersion.range
    waves = np.linspace(max(one.dispersion.range[0], 0.4), min(one.dispersion.range[1], 0.7), 5)
    np.testing.assert_array_equal(two.index(waves), one.index(waves))


@pytest.mark.parametrize("name", ["cooke_triplet", "phone", "hubble", "microscope_objective"])
def test_written_and_read_back(tmp_path, name):
    lens = load_lens(name)
    save_lens(lens, tmp_path / "own.seq")
    assert_same(lens, read_back(tmp_path))


def read_back(folder):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_lens(folder / "own.seq")


@pytest.mark.slow
def test_written_forms_glasses_apertures_and_places(tmp_path):
    prv = "PRV\nPWL 700 400\n'A' LAU 2.25 -.01 .01\n'B' GMS 1.1 .01 .2 90\nEND"
    lines = [
        "S 50 4 'A'; STO; SPS ODD 0; SCO K -1; SCO AR3 1e-4",
        "S -50 3 'B'; YTO; RDX 40; A 1e-5; XDE .1; ADE 3; DAR",
        "S 70 9; AAS; CUX .01; KX 1; AR 1e-6; CIR L'A' 4; REX OBS 1; REY OBS 2; ADY OBS .5",
        "S 0 3 516800.641700; SPS XYP 1; SCO C4 1e-3",
        "S 40 20; SPS QBF; SCO NRADIUS 9; SCO C4 .01; DIF DOE; HWL 550; HCT R; HCO C1 -1e-4",
        "S 0 9 F2; SPS ZFR; SCO NRADIUS 9; SCO C8 .01",
        "S 0 30; DIF GRT; GRS .3",
    ]
    lens = read(tmp_path, prv, *lines).lens
    save_lens(lens, tmp_path / "own.seq")
    again = read_back(tmp_path)
    assert_same(lens, again)
    for part in ("half", "centre"):
        np.testing.assert_array_equal(*(getattr(own.apertures, part) for own in (lens, again)))
    assert lens.apertures.kinds == again.apertures.kinds
    assert lens.phase.forms == again.phase.forms
    np.testing.assert_allclose(lens.phase.coefficients, again.phase.coefficients, rtol=3e-16)
    assert " 5168.6417\n" in (tmp_path / "own.seq").read_text()
    # Rotations of the axis: with the same numbers if the pivot is a vertex, else to rounding.
    turns = ["S 0 3; YDE 1; ADE 20; CDE 3", "S 9 1 F2", "S 0 -9 REFL; BDE 30; BEN", "S 0 -5"]
    lens = read(tmp_path, FRONT, BACK, *turns[:2], "S 0 9").lens
    save_lens(lens, tmp_path / "own.seq")
    for one, two in zip(lens.places, read_back(tmp_path).places, strict=True):
        np.testing.assert_array_equal(one, two)
    lens = read(tmp_path, FRONT, BACK, *turns).lens
    save_lens(lens, tmp_path / "own.seq")
    for one, two in zip(lens.places, read_back(tmp_path).places, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-13)
    more = {"own": {"schott": [2.59, -0.0154, 0.0102, 0.00158, -1.9e-4, 1e-5, 1e-5, 0, 0]}}
    rows = [{"radius": 50, "thickness": 3, "glass": "own", "semi_diameter": 5, "stop": True}]
    rows.append({"radius": -50})
    lens = load_lens({"glasses": more, "surfaces": rows, "sensor": 50.0})
    with pytest.raises(LensError, match=r"glass own: .* to L\^-8: save as .yaml"):
        save_lens(lens, tmp_path / "more.seq")


def test_powers_that_asp_has_not(tmp_path):
    """An even asphere with r^2 or r^22 becomes an SPS ODD with the same sag."""
    rows = [{"radius": 50, "thickness": 3, "index": 1.5, "semi_diameter": 5, "stop": True}]
    own = {"radius": -50, "conic": -1, "coefficients": {2: 1e-3, 4: 1e-6, 22: 1e-20}}
    lens = load_lens({"surfaces": [*rows, own], "sensor": 50.0})
    save_lens(lens, tmp_path / "own.seq")
    again = read_back(tmp_path)
    assert again.forms[1] == "odd_asphere"
    np.testing.assert_allclose(sag(again, 1, 3.0, 4.0), sag(lens, 1, 3.0, 4.0), rtol=1e-14)
    own = own | {"coefficients": {2: 1e-3, 40: 1e-40}}
    with pytest.raises(LensError, match="hold no form odd_asphere of 40 here: save as .yaml"):
        save_lens(load_lens({"surfaces": [*rows, own], "sensor": 50.0}), tmp_path / "more.seq")


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8", "utf-8-sig", "latin-1"])
def test_encodings(tmp_path, encoding):
    path = tmp_path / "lens.seq"
    path.write_bytes(text(FRONT, BACK).replace("a lens", "für 5 µm").encode(encoding))
    assert read_record(path).name == "für 5 µm"


def test_files_that_are_none(tmp_path):
    path, noise = tmp_path / "lens.seq", np.random.default_rng(0)
    whole = text(FRONT, BACK)
    spoilt = [b"", b"0" * 2**25, b"S 0 " + b"1 " * 10**6, b"S 0 1\n" * 10**6, noise.bytes(10**5)]
    spoilt += [bytes(10**5), b"x: 1\n", whole.encode()[:60], b"S 0 1 &\n" * 10**5, b"'\"" * 1900]
    spoilt += [b"S 0 1\n" * 6000, b"SO 0 9;S 0 1 F2;RET S" + b"9" * 3900, b"ZOO " * 900]
    plain = whole.encode()
    far = ["SPS XYP 1e-200; SCO C9 1", "YDE 1e300; ADE 1e300", "CIR 1e200", "CUY 1e300; CIR 1"]
    spoilt += [plain.replace(b"STO", f"STO; {own}".encode()) for own in far]
    far = ["PWL 1e-300 1; 'A' 1 2", "PWL 500; 'A' 1e300", "'A' CAU 1e200 1e200", "'A' GMS 1 .3"]
    private = plain.replace(b"NBK7_SCHOTT", b"'A'")
    spoilt += [private.replace(b"SO", f"PRV; {own}; END\nSO".encode()) for own in far]
    spoilt += [(b"\"'" * 1900 + b"\n") * 100, b"ZFR;SPS;HCO;SCO;REF x;STO;RET;WL;DIM;YAN\n" * 9]
    for content in spoilt:
        path.write_bytes(content)
        began = time.process_time()
        with pytest.raises(LensError) as error:
            load_lens(path)
        assert time.process_time() - began < 2
        assert str(path) in str(error.value) and "\n" not in str(error.value)
        assert len(str(error.value)) <= 300
    own = text(
        "PRV; PWL 700 600 500; 'A' 1.5 1.51 1.52; END", "S 50 4 'A'; STO; CIR 4; ASP; A 1e-6", BACK
    )
    for _ in range(400):  # some bytes changed or removed: an error of one line, or a lens
        spoilt = bytearray(own.encode())
        for place in noise.integers(0, len(spoilt), 4):
            spoilt[place] = noise.choice(list(b"0 9.-;&!'\"SAZ\n\xff\x00e"))
        path.write_bytes(spoilt[: noise.integers(len(spoilt) // 2, 2 * len(spoilt))])
        try:
            read_record(path)
        except LensError as error:
            assert "\n" not in str(error) and str(path) in str(error)
