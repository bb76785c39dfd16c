"""`drt-jax check`: its reference values are right, and it fails if a number is wrong."""

import dataclasses
import json

import numpy as np
import pytest

from drt_jax.__main__ import main
from drt_jax.check import scenes
from drt_jax.check.truth import TRUTHS
from drt_jax.files.load import load_lens

from . import outside

PRINTED = {"glass", "rays", "single", "spots", "mtf", "designed"}


def checked(*words):
    """Runs the command; returns its exit status."""
    try:
        main(["check", *map(str, words)])
    except SystemExit as ended:
        return ended.code
    return 0


@pytest.mark.slow
def test_two_scenes_are_right(tmp_path, capsys):
    """Checks table, versions, file and exit status."""
    file = tmp_path / "check.json"
    assert checked("glass", "sensor", "--json", file) == 0
    said = capsys.readouterr().out
    lines = said.splitlines()
    assert [line.split()[-1] for line in lines if line.startswith(("glass", "sensor"))] == [
        "ok"
    ] * 2
    assert "2 of 2 scenes are right" in lines[-1]
    for word in ("drt_jax", "jaxlib", "optimistix", "devices", "float64     on", "programs"):
        assert word in said
    kept = json.loads(file.read_text())
    assert kept["right"] and [row["name"] for row in kept["scenes"]] == ["glass", "sensor"]
    first = kept["scenes"][0]
    assert 0 < first["error"] <= first["allowed"] == 5.1e-7 and "CODE V" in first["source"]
    assert kept["machine"]["jax"] and first["again"] > 0


def test_an_index_that_is_wrong_by_a_millionth_is_named(monkeypatch, capsys):
    """A scene that cannot be computed, or has other numbers, does not stop the others."""

    def disturbed(source):
        lens = load_lens(source)
        constant = lens.dispersion.schott.at[..., 0].add(2 * 1.6 * 1e-6)
        dispersion = dataclasses.replace(lens.dispersion, schott=constant)
        return dataclasses.replace(lens, dispersion=dispersion)

    def broken():
        raise RuntimeError("no memory")

    monkeypatch.setattr(scenes, "load_lens", disturbed)
    monkeypatch.setattr(scenes, "mtf", broken)
    monkeypatch.setattr(scenes, "training", lambda: lambda: np.full(3, np.nan))
    monkeypatch.setattr(scenes, "kernel", lambda: lambda: np.zeros(3))
    assert checked("mtf", "glass", "training", "kernel", "sensor") == 1
    lines = capsys.readouterr().out.splitlines()
    ends = {line.split()[0]: line.split()[-1] for line in lines if line.split()[:1]}
    wanted = {"mtf": "FAILED", "glass": "WRONG", "training": "WRONG", "kernel": "FAILED"}
    assert {name: ends[name] for name in wanted} == wanted and ends["sensor"] == "ok"
    said = "\n".join(lines)
    assert "! RuntimeError: no memory" in said and "! expected: CODE V" in said
    assert "1 of 5 scenes are right" in said


def test_an_unknown_scene_is_one_line(capsys):
    assert checked("ray") == 2
    said = capsys.readouterr().err
    assert said.startswith("error: scenes: no 'ray'; known: glass, rays") and said.count("\n") == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(TRUTHS.keys() - PRINTED))
def test_truths_that_no_program_prints_come_from_outside(name):
    """They agree to the digits that are stored."""
    assert len(TRUTHS[name].values) == len(getattr(outside, name)())
    np.testing.assert_allclose(TRUTHS[name].values, getattr(outside, name)(), rtol=1e-11)


@pytest.mark.slow
def test_all_scenes_are_right(capsys):
    assert checked() == 0
    assert f"{len(TRUTHS)} of {len(TRUTHS)} scenes are right" in capsys.readouterr().out
