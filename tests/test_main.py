"""`python -m drt_jax show` and `convert`."""

import re
import signal
import subprocess
import sys

import numpy as np
import pytest

from drt_jax import Scene, first_order, load_lens, psf_moments, save_lens, show
from drt_jax.__main__ import _options, main
from drt_jax.show.command import view_of
from drt_jax.show.layout import beam_of


@pytest.fixture
def undrawn(monkeypatch):
    """The printed lines without the sheet, which takes longer; see tests/show/test_sheet.py."""
    monkeypatch.setattr("drt_jax.show.command.sheet", lambda *_: show.new()[0])


@pytest.mark.slow
def test_a_lens_shows_itself(tmp_path, capsys):
    picture = tmp_path / "lens.png"
    words = ["show", "cooke_triplet", "--field", "0", "5", "--wavelengths", "0.55"]
    main([*words, "--out", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    assert picture.stat().st_size > 10_000 and lines[-1] == f"drawn in {picture}"
    (drawn,) = (k for k, line in enumerate(lines) if line.startswith("the lens is drawn in"))
    assert drawn < next(k for k, line in enumerate(lines) if line.startswith(" field"))
    focal = next(float(line.split()[2]) for line in lines if "focal length" in line)
    assert 45 < focal < 55
    table = [line.split() for line in lines if line.split()[:1] in (["0"], ["5"])]
    assert [row[0] for row in table] == ["0", "5"]
    assert all(row[4] == "none" for row in table)
    assert "stops nothing" not in "".join(lines) and "!" not in "".join(lines)
    (pupil,) = (line for line in lines if line.startswith("  exit pupil"))
    assert pupil.endswith(" mm from the last vertex")
    # f tan(5 degrees), less distortion
    assert abs(float(table[1][1]) / focal - 0.0875) < 1e-3 and float(table[0][3]) == 100


RIM = """
surfaces:
  - {radius: 51.68, thickness: 4, glass: N-BK7, semi_diameter: 12}
  - {radius: inf, thickness: 1, semi_diameter: 5.03}
  - {radius: inf, thickness: 95, semi_diameter: 5, stop: true}
"""


@pytest.mark.slow
def test_a_rim_that_shaves_the_axial_beam_is_named_wherever_it_matters(tmp_path, capsys, undrawn):
    """0.8 % were vignetted by "none", and a warning said that apertures vignette. Spots are those
    of `psf_moments`, cells of the table are separate, and a large defocus is reported."""
    (tmp_path / "mine.yaml").write_text(RIM)
    words = ["show", str(tmp_path / "mine.yaml"), "--field", "0", "9", "--wavelengths", "0.55"]
    main([*words, "--out", str(tmp_path / "lens.png")])
    said = capsys.readouterr().out
    rows = [re.split(r" {2,}", line.strip()) for line in said.splitlines() if " 1" in line]
    axial, oblique = (row for row in rows if row[0] in ("0", "9"))
    lens = load_lens(tmp_path / "mine.yaml")
    for row, field in ((axial, 0.0), (oblique, np.radians(9))):
        found = psf_moments(lens, Scene.point(field, np.inf, 0.55))
        spot = 1e3 * float(np.trace(found.covariance[0])) ** 0.5
        assert len(row) == 5 and float(row[2]) == pytest.approx(spot, rel=2e-4)
        assert float(row[3]) == pytest.approx(100 * float(found.throughput[0]), abs=0.02)
    # Light converges from the rim to the stop.
    back = float(first_order(lens, np.inf, 0.55).back_focal_distance[0])
    share = 100 * (5.03 / 5 * back / (back + 1)) ** 2
    assert axial[-1] == "1" and float(axial[3]) == pytest.approx(share, abs=0.2)
    assert "! on the axis 0." in said and said.count("limiting surfaces: 1\n") == 1
    assert "! out of focus on the axis: the spot of " in said and "mm further" in said


def test_what_is_known_is_said_before_the_rays_are_traced(monkeypatch, tmp_path, capsys):
    def stop(*args):
        assert "focal length" in capsys.readouterr().out
        raise ValueError("reached")

    monkeypatch.setattr("drt_jax.show.command.beam_of", stop)
    with pytest.raises(SystemExit):
        main(["show", "singlet", "--out", str(tmp_path / "lens.png")])
    assert capsys.readouterr().err == "error: reached\n"


@pytest.mark.slow
def test_what_looks_odd(tmp_path, capsys, undrawn):
    """A near object, out of focus; a field without light."""
    words = ["show", "singlet", "--field", "0", "80", "--wavelengths", "0.55"]
    main([*words, "--distance", "200", "--out", str(tmp_path / "lens.png")])
    said = capsys.readouterr().out
    assert "! out of focus on the axis" in said and "mm further" in said and "! no ray" in said


AFOCAL = """
surfaces:
  - {curvature: 0.01, index: 1.5, thickness: 3, semi_diameter: 5, stop: true}
  - {curvature: -0.01}
sensor: 110
afocal: true
"""
PARABOLA = """
surfaces: [{curvature: -0.005, conic: -1, mirror: true, semi_diameter: 10, stop: true}]
sensor: -100
"""


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["afocal", "perfect"])
def test_no_focus_and_no_spot(kind, tmp_path, capsys, undrawn):
    """An afocal lens has no focus, but a vergence: 1000 / 99.4975 mm here. A spot that is only
    rounding error has no size."""
    (tmp_path / "mine.yaml").write_text(AFOCAL if kind == "afocal" else PARABOLA)
    words = ["show", str(tmp_path / "mine.yaml"), "--field", "0", "--wavelengths", "0.55"]
    main([*words, "--out", str(tmp_path / "lens.png")])
    said = capsys.readouterr().out
    assert "!" not in said
    if kind == "afocal":
        (row,) = [line.split() for line in said.splitlines() if "vergence" in line]
        assert float(row[1]) == 10.05 and "paraxial focus" not in said
    else:
        (row,) = [line.split() for line in said.splitlines() if line.split()[:1] == ["0"]]
        assert row[2] == "<1e-6" and "paraxial focus" in said


@pytest.mark.slow
def test_words_for_apertures_and_focal_length(tmp_path, capsys, undrawn):
    """A diameter given as semi-diameter; an aperture that vignettes; a wrong sign."""
    lens = """
    focal_length: 100
    surfaces:
      - {radius: 51.68, thickness: 4, glass: N-BK7, semi_diameter: 12}
      - {radius: inf, thickness: 1, semi_diameter: 4}
      - {radius: inf, thickness: 95, semi_diameter: 5, stop: true}
    """
    (tmp_path / "mine.yaml").write_text(lens)
    words = ["show", str(tmp_path / "mine.yaml"), "--field", "0", "--wavelengths", "0.55"]
    main([*words, "--out", str(tmp_path / "lens.png")])
    said = capsys.readouterr().out
    (row,) = [line.split() for line in said.splitlines() if line.split()[:1] == ["0"]]
    assert row[-1] == "1" and 62 < float(row[3]) < 66  # (4 / 5)^2
    assert "! surface 0: the light of these fields needs 3.9" in said and "diameter?" in said
    assert "! surface 1" not in said and "focal_length" not in said
    (tmp_path / "mine.yaml").write_text(lens.replace("radius: 51.68", "radius: -51.68"))
    with pytest.warns(UserWarning, match="focal_length: 100 mm is stated, but it is -100 mm at"):
        load_lens(tmp_path / "mine.yaml")


def test_lens_files_are_converted(tmp_path, capsys):
    """From any format to any; a solve, a part that is left out, and data that are not written are
    reported."""
    lines = (
        "RDM; LEN; EPD 9; WL 550\nSO 0 1e11; S 50 4 NBK7; STO; CIR 6; S -50 48; PIM\nTEM 90\nSI; GO"
    )
    (tmp_path / "a.seq").write_text(lines)
    with pytest.raises(SystemExit):
        main(["convert", str(tmp_path / "a.seq"), str(tmp_path / "b.yaml")])
    assert 'line 3: 90 C; our indices are those of 20; missing="warn"' in capsys.readouterr().err
    main(["convert", str(tmp_path / "a.seq"), str(tmp_path / "b.yaml"), "--missing", "warn"])
    said = capsys.readouterr().out
    assert "left out: 90 C" in said and "solves and pickups" in said and "not written" in said
    for one, two in (("b.yaml", "c.zmx"), ("c.zmx", "d.seq"), ("d.seq", "e.yaml")):
        main(["convert", str(tmp_path / one), str(tmp_path / two)])
        assert capsys.readouterr().out.endswith(f"is written to {tmp_path / two}\n")
    first, last = (load_lens(tmp_path / name) for name in ("b.yaml", "e.yaml"))
    np.testing.assert_array_equal(first.curvature, last.curvature)
    np.testing.assert_array_equal(first.semi_diameter, last.semi_diameter)
    assert first.sensor == last.sensor == 52 and first.glasses == last.glasses


def test_a_lens_file_is_shown_as_it_is_used(tmp_path):
    """With its fields, distance and wavelengths, the primary one in the middle; options take
    precedence."""
    path = tmp_path / "a.zmx"
    save_lens(load_lens("singlet"), path)
    used = path.read_text().replace("WAVM 1 0.5875618 1\n", "").replace("DISZ INFINITY", "DISZ 500")
    waves = "".join(
        f"WAVM {k} {w} {0.5 if k == 2 else 1}\n"
        for k, w in enumerate((0.5876, 0.4861, 0.7, 0.6563), 1)
    )
    used = re.sub("YFLN.*", "YFLN 3 0 -2 0 0 0 0 0 0 0 0 0", used).replace(
        "PWAV 1", waves + "PWAV 1"
    )
    path.write_text(used.replace("FTYP 0 0 1 1", "FTYP 0 0 3 4"))
    view = view_of(_options(["show", str(path)]))
    assert view.lens.count == 3 and view[1:3] == ([-2, 0, 3], 500)
    assert view[3:] == ([0.7, 0.6563, 0.5876, 0.4861], [1, 1, 1, 0.5], "")
    given = ["--field", "1", "--distance", "9e3", "--wavelengths", "0.5"]
    assert view_of(_options(["show", str(path), *given]))[1:] == ([1], 9e3, [0.5], [1], "")
    more = path.read_text().replace("PWAV 1", "WAVM 5 0.55 1\nWAVM 6 0.6 1\nPWAV 1")
    path.write_text(more.replace("FTYP 0 0 3 4", "FTYP 0 0 3 6"))
    view = view_of(_options(["show", str(path)]))
    assert view.wavelengths == [0.7, 0.5876, 0.4861]
    assert view.note == "  ! left out of what the file has: wavelengths 0.6563, 0.6, 0.55 um"
    path.write_text(re.sub("YFLN.*", "YFLN 0 0 0", path.read_text()))  # the axis alone
    assert view_of(_options(["show", str(path)]))[1] == [0]
    view = view_of(_options(["show", "singlet"])).lit()
    assert view[1:4] == ([0, 7, 10], np.inf, [0.6562725, 0.5875618, 0.4861327])


@pytest.mark.slow
def test_fields_of_a_telescope_have_light():
    view = view_of(_options(["show", "hubble"])).lit()
    assert view.fields == [0, 0.875, 1.25]
    shares = [beam_of(view.lens, point).share for point in view.scene.each()]
    assert shares[2] >= shares[0] / 2


def test_ctrl_c_is_one_line(monkeypatch, capsys):
    def stop(*args):
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("drt_jax.show.command.load_lens", stop)
    with pytest.raises(SystemExit) as ended:
        main(["show", "singlet"])
    assert ended.value.code == 130 and capsys.readouterr().err == "stopped\n"


@pytest.mark.parametrize(
    "words, message",
    [
        (["show", "nothing"], "no bundled lens 'nothing'; bundled"),
        (["show", "double-gauss"], "'double-gauss'; did you mean 'double_gauss'?; bundled"),
        (["show", "singlet", "--field", "90"], "--field: must be within 90 degrees"),
        (["show", "singlet", "--distance", "0"], "distance: must be 1e-06 mm or more"),
        (["show", "singlet", "--wavelengths", "9"], "outside the range"),
        (["convert", "singlet", "a.zmx", "--configuration", "2"], "in YAML has one alone"),
        (["convert", "singlet", "lens.txt"], "lens.txt: expected a name that ends in .yaml"),
    ],
)
def test_errors_are_one_line(words, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*words, *(["--out", str(tmp_path / "lens.png")] if words[0] == "show" else [])])
    said = capsys.readouterr().err
    assert ended.value.code == 2 and message in said and said.count("\n") == 1


def test_a_reader_that_has_enough_is_no_error():
    """As with `head`: there is no message about a closed pipe."""
    words = [sys.executable, "-m", "drt_jax", "glass", "SF53"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as run:
        run.stdout.close()
        assert run.stderr.read() == b""
    assert run.returncode == 1


def test_a_glass_shows_itself(tmp_path, capsys):
    """N-BK7 by Schott's sheet: nd 1.51680, vd 64.17, P_gF 0.5349, 0.0009 below the normal line."""
    picture = tmp_path / "map.png"
    main(["glass", "N-BK7", "--plot", str(picture)])
    said = capsys.readouterr().out
    assert re.search(r"d, 587.56 nm +1.51680", said) and re.search(r"vd +64.17\n", said)
    assert "0.5349, -0.0009" in said and "(SCHOTT)" in said and "0.3 to 2.5 um" in said
    assert "H-K9L" in said and picture.stat().st_size > 10_000
    main(["glass", "--near", "1.6204,60.3", "--makers", "SCHOTT"])
    assert "N-SK16\n" in capsys.readouterr().out
    for words, message in {
        ("BAF4",): "error: glass 'BAF4' is of several makers",
        ("--near", "1,2,3"): "error: --near: expected ND,VD",
        (): "error: give the name of a glass or --near",
        ("IRG22", "--plot", "no.png"): "error: --plot: IRG22 is not known at the lines F and C",
    }.items():
        with pytest.raises(SystemExit):
            main(["glass", *words])
        assert capsys.readouterr().err.startswith(message)
