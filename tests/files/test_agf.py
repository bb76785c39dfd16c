"""Catalogues of glasses in Zemax's format."""

import re

import numpy as np
import pytest

import drt_jax
from drt_jax import LensError
from drt_jax.files.agf import load_agf
from drt_jax.lens.glass import Glass
from drt_jax.lens.glasses import find_glass, indices


# Zemax's formulas with invented constants, and n^2 at 0.6 um by the formulas of its manual.
def terms(*pairs):
    return sum(b * 0.36 / (0.36 - c) for b, c in pairs)


def powers(*pairs):
    return sum(a * 0.6**power for power, a in pairs)


LOW = (0, 2.2), (2, -0.01), (-2, 0.01), (-4, 0.002), (-6, -1e-4), (-8, 1e-5)
B = (1, 0.01), (0.2, 0.02), (0.9, 100), (0.1, 0.03), (0.05, 0.04)
FORMULAS = {
    1: ("2.2 -.01 .01 .002 -1e-4 1e-5", powers(*LOW)),
    2: ("1 .01 .2 .02 .9 100", 1 + terms(*B[:3])),
    4: (".2 1 .1 .02 .2", 1.2 + terms(B[0]) + 0.02 / (0.36 - 0.04)),
    6: ("1 .01 .2 .02 .9 100 .1 .03", 1 + terms(*B[:4])),
    7: ("2.3 .02 .04 .01", 2.3 + 0.02 / (0.36 - 0.04) - 0.01 * 0.36),
    8: ("1.3 1 .01 .02", 1.3 + terms(B[0]) - 0.02 * 0.36),
    9: ("1.3 1 .01 .9 100", 1.3 + terms(B[0], B[2])),
    10: ("2.2 -.01 .01 .002 -1e-4 1e-5 2e-6 -3e-7", powers(*LOW, (-10, 2e-6), (-12, -3e-7))),
    11: ("1 .01 .2 .02 .9 100 .1 .03 .05 .04", 1 + terms(*B)),
    12: ("2.2 -.01 .01 .002 -1e-4 1e-5 3e-3 4e-3", powers(*LOW, (4, 3e-3), (6, 4e-3))),
    13: (
        "2.2 -.01 3e-3 .01 .002 -1e-4 1e-5 2e-6 -3e-7",
        powers(*LOW, (4, 3e-3), (-10, 2e-6), (-12, -3e-7)),
    ),
}


def glass_of(name, formula, constants, limits="0.4 0.7"):
    return (
        f"NM {name} {formula} 517642 1.5 64 0 1\nCD {constants}\nTD 0 0 0 0 0 0 20\nLD {limits}\n"
    )


def test_every_formula(tmp_path):
    path = tmp_path / "my.agf"
    text = "CC a catalogue\n" + "".join(glass_of(f"G{f}", f, c) for f, (c, _) in FORMULAS.items())
    path.write_text(text, "utf-16")
    found = load_agf(path)
    assert [*found] == [f"G{formula}" for formula in FORMULAS]
    for formula, (_, square) in FORMULAS.items():
        n = indices(found[f"G{formula}"], np.array([0.6]))[0]
        np.testing.assert_allclose(n, square**0.5, rtol=1e-14, err_msg=str(formula))


BAD = {
    "no line begins with NM": "CC nothing\n",
    "line 1: expected NM, a name": "NM\n",
    "line 1: X: formula 3 is not read, of 1, 2, 4": glass_of("X", 3, "1 2 3"),
    "line 2: X: formula 12 with more than 8 terms": glass_of("X", 12, "2 0 0 0 0 0 0 .1 .1"),
    "line 2: X: C = 0.25 um^2 lies within the range": glass_of("X", 2, "1 .25"),
    "line 2: X: no index above 1 at 0.4 um": glass_of("X", 1, "1"),
    "line 1: X: its line LD is missing": "NM X 2 0 1.5 60\nCD 1 .01 0 0 0 0\n",
    "line 4: X: no range: 0.7 to 0.4": glass_of("X", 2, "1 .01", "0.7 0.4"),
    "line 2: expected a number, got 'nan'": glass_of("X", 2, "1 nan"),
    "line 5: X: another glass of this name": glass_of("X", 2, "1 .01") + glass_of("X", 2, "1 .02"),
    "character 0 is no text": "\x01\x02",
}


@pytest.mark.parametrize("message", BAD)
def test_what_is_no_catalogue_is_refused_in_a_line(tmp_path, message):
    path = tmp_path / "my.agf"
    path.write_text(BAD[message])
    with pytest.raises(LensError, match=re.escape(message)) as error:
        load_agf(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)


def test_a_prescription_names_its_catalogues(tmp_path):
    """Glasses that it does not use may have any formula; its glasses take precedence over the
    table."""
    own = ("MINE", 12, FORMULAS[12][0]), ("N-BK7", 2, "1.3 .01"), ("X", 3, "1")
    mine = "".join(glass_of(*one) for one in own)
    (tmp_path / "my.agf").write_text(mine)
    path = tmp_path / "lens.yaml"
    text = """
catalogues: [my.agf]
surfaces:
  - {radius: 50, thickness: 4, glass: MINE, semi_diameter: 5, stop: true}
  - {radius: -50, thickness: 4, glass: GLASS}
  - {radius: 90, thickness: 90}
"""
    path.write_text(text.replace("GLASS", "N-BK7"))
    lens = drt_jax.load_lens(path)
    wanted = np.sqrt([FORMULAS[12][1], 1 + 1.3 * 0.36 / 0.35])
    np.testing.assert_allclose(np.asarray(lens.index(0.6))[1:3].ravel(), wanted, rtol=1e-14)
    drt_jax.save_lens(lens, tmp_path / "again.yaml")
    again = drt_jax.load_lens(tmp_path / "again.yaml")
    np.testing.assert_array_equal(again.index(0.6), lens.index(0.6))
    path.write_text(text.replace("GLASS", "X"))
    with pytest.raises(LensError, match=r"yaml, line 2: catalogues: .*my.agf, line 9: X: form"):
        drt_jax.load_lens(path)
    path.write_text(text.replace("[my.agf]", "my.agf"))
    with pytest.raises(LensError, match="line 2: catalogues: expected a list of paths"):
        drt_jax.load_lens(path)


def test_glasses_of_a_maker_in_files(tmp_path):
    """NAME_MAKER in a prescription; in `.zmx` the order of the catalogues determines the maker,
    where possible. No order gives both Schott's F2 and Hikari's SK16, so that one of them keeps the
    maker in its name."""
    names = ("SK16", "F2", "S-BSM14", "SK16_SCHOTT")
    for some in (names[:2], names[1:3], names[1:]):
        surfaces = [
            {"radius": 50 + i, "thickness": 9, "glass": name} for i, name in enumerate(some)
        ]
        surfaces[0] |= {"semi_diameter": 2, "stop": True}
        lens = drt_jax.load_lens({"surfaces": [*surfaces, {"radius": -60, "thickness": 90}]})
        for kind in ("yaml", "zmx"):
            drt_jax.save_lens(lens, tmp_path / f"lens.{kind}")
            again = drt_jax.load_lens(tmp_path / f"lens.{kind}")
            assert again.glasses == lens.glasses
            np.testing.assert_array_equal(again.index(0.55), lens.index(0.55))
        text = (tmp_path / "lens.zmx").read_text()
        assert ("_SCHOTT" in text) == (some == names[:2])
    assert isinstance(find_glass("F2", "HIKARI"), Glass)


def test_temperature_and_status(tmp_path):
    """Lines of Schott's and Zeon's catalogues; zeros and missing words are unknown values."""
    path = tmp_path / "my.agf"
    path.write_text(
        "NM F2 2 620364.361 1.62004 36.37 0 1 2\nED 8.200000 9.200000 3.610000 0.0002 0\n"
        "CD 1 .01 .2 .02 .9 100\nTD 1.51E-06 1.56E-08 -2.78E-11 9.34E-07 1.04E-09 0.25 25\n"
        "LD 0.4 0.7\nNM 330R 1 509560 1.509420 56.0\nED 0 -1 0.95 0\n"
        "CD 2.2 -.01 .01 .002 -1e-4 1e-5\nTD 0 0 0 0 0 0 25.0\nLD 0.4 0.7\n"
        "NM OLD 1 509560 1.509420 56.0 0 2.000 -1\nCD 2.2 -.01 .01 .002 -1e-4 1e-5\nLD 0.4 0.7\n"
    )
    one, two, three = load_agf(path).values()
    assert one.thermal == (1.51e-6, 1.56e-8, -2.78e-11, 9.34e-7, 1.04e-9, 0.25)
    assert (one.expansion, one.celsius, one.status) == (8.2, 25.0, "preferred")
    assert (two.thermal, two.expansion, two.celsius, two.status) == ((), None, 25.0, "")
    assert (three.thermal, three.celsius, three.status) == ((), 20.0, "obsolete")
