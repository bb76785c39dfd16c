"""`python -m drt_jax show`."""

import pytest

from drt_jax.__main__ import main


def test_a_lens_shows_itself(tmp_path, capsys):
    picture = tmp_path / "lens.png"
    words = ["show", "cooke_triplet", "--field", "0", "5", "--wavelengths", "0.55"]
    main([*words, "--out", str(picture)])
    lines = capsys.readouterr().out.splitlines()
    assert picture.stat().st_size > 10_000 and lines[-1] == f"drawn in {picture}"
    focal = next(float(line.split()[2]) for line in lines if "focal length" in line)
    assert 45 < focal < 55
    table = [line.split() for line in lines if line.split()[:1] in (["0"], ["5"])]
    assert [row[0] for row in table] == ["0", "5"]
    # f tan(5 degrees), less distortion
    assert abs(float(table[1][1]) / focal - 0.0875) < 1e-3 and float(table[0][3]) == 100


def test_what_looks_odd(tmp_path, capsys):
    """A near object, out of focus; a field from which no light comes."""
    words = ["show", "singlet", "--field", "0", "80", "--wavelengths", "0.55"]
    main([*words, "--distance", "200", "--out", str(tmp_path / "lens.png")])
    said = capsys.readouterr().out
    assert "! the sensor is far from the focus" in said and "! no ray" in said


@pytest.mark.parametrize(
    "words, message",
    [
        (["show", "nothing"], "no bundled lens 'nothing'"),
        (["show", "singlet", "--field", "90"], "--field: must be within 90 degrees"),
        (["show", "singlet", "--distance", "0"], "--distance: must be above 0"),
        (["show", "singlet", "--wavelengths", "9"], "outside the range"),
    ],
)
def test_errors_are_one_line(words, message, tmp_path, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*words, "--out", str(tmp_path / "lens.png")])
    said = capsys.readouterr().err
    assert ended.value.code == 2 and message in said and said.count("\n") == 1
