"""experiments.zoom at toy size: two zoom positions of two lenses."""

import json
import pathlib

import numpy as np
import pytest

import drt_jax
from experiments import _command, zoom

ROOT = pathlib.Path(__file__).resolve().parents[2]
TOY = """\
VERS 150514
UNIT MM
ENPD 4
RAIM 0 2
FTYP 0 0 2 1 0 0 0
XFLN 0 0
YFLN 0 5
FWGN 1 1
WAVM 1 .55 1
PWAV 1
SURF 0
  TYPE STANDARD
  CURV 0
  DISZ INFINITY
SURF 1
  TYPE STANDARD
  CURV -.02
  DISZ 2
  GLAS ___BLANK 1 0 1.5 60 0
SURF 2
  TYPE STANDARD
  CURV 0
  DISZ 20
SURF 3
  STOP
  TYPE STANDARD
  CURV .05
  DISZ 3
  GLAS ___BLANK 1 0 1.5 60 0
SURF 4
  TYPE STANDARD
  CURV -.02
  DISZ 40
  DIAM 5 0
SURF 5
  TYPE STANDARD
  CURV 0
  DISZ 0
MNUM 2 1
THIC 2 1 20 0 0
THIC 2 2 10 0 0
THIC 4 1 38 0 0
THIC 4 2 43 0 0
YFIE 2 1 5 0 0
YFIE 2 2 4 0 0
"""


def run_of(folder, *more):
    """Results of a search at toy size, in a folder."""
    (folder / "toy.zmx").write_text(TOY)
    few = [f"lens={folder / 'toy.zmx'}", "order=2", "trials=60", "tolerance=0.1"]
    few += ["moving=[{kind: thickness, surfaces: [1], low: 1, high: 40}, {kind: sensor}]"]
    few += ["shared=[{kind: curvature}]", "operands=[{kind: spot}, {kind: air_edge, low: 0.1}]"]
    _command.main(zoom, ["--out", str(folder / "run"), "--set", *few, *more])
    return json.loads((folder / "run" / "results.json").read_text())


@pytest.mark.slow
def test_a_zoom_is_optimised_in_both_positions(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    rows = run_of(tmp_path, "keep=[{kind: effective_focal_length, per_cent: 2}]")["rows"]
    assert "gaps alone" in capsys.readouterr().out
    assert (tmp_path / "run" / "figures" / "zoom.png").is_file()
    assert [row["configuration"] for row in rows] == [1, 2]
    total = {name: sum(row[f"merit_{name}"] for row in rows) for name in ("start", "moved", "end")}
    assert total["end"] < total["moved"] < total["start"]
    lenses = [drt_jax.load_lens(tmp_path / "run" / f"designed_{k}.yaml") for k in (1, 2)]
    np.testing.assert_allclose(lenses[0].curvature, lenses[1].curvature, rtol=1e-12)
    for row, lens, field in zip(rows, lenses, (5, 4)):
        assert row["fields_deg"] == pytest.approx([0, field])
        assert row["focal_mm_designed"] == pytest.approx(row["focal_mm_start"], rel=0.0201)
        first = drt_jax.first_order(lens, np.inf, np.array([0.55]))
        start = drt_jax.load_lens(tmp_path / "run" / f"start_{row['configuration']}.yaml")
        before = drt_jax.first_order(start, np.inf, np.array([0.55]))
        np.testing.assert_allclose(first.f_number, before.f_number, rtol=1e-9)


@pytest.mark.slow
def test_a_zoom_is_searched_from_many_starts_for_given_focal_lengths(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    keep = "keep=[{kind: effective_focal_length, values: [26, 30], per_cent: 1}]"
    starts = "starts={count: 4, spread: 2, stages: [5, 25], keep: 1}"
    results = run_of(tmp_path, keep, starts)
    for row, wanted in zip(results["rows"], (26, 30)):
        assert row["focal_mm_designed"] == pytest.approx(wanted, rel=0.0101)
        assert row["merit_end"] <= 1.001 * row["merit_starts"]
    scores = [score for score in results["starts"]["scores"] if score is not None]
    assert len(scores) == results["starts"]["passed"] and results["starts"]["count"] == 4
    total = sum(row["merit_end"] for row in results["rows"])
    assert total <= 1.001 * min(scores)
    assert (tmp_path / "run" / "figures" / "starts.png").is_file()
    assert "| 4 starts" in zoom.tables(results)["zoom, toy, 4 starts: ends"]


def test_as_many_values_as_configurations_are_asked_for(tmp_path, capsys):
    (tmp_path / "toy.zmx").write_text(TOY)
    few = [f"lens={tmp_path / 'toy.zmx'}", "keep=[{kind: effective_focal_length, values: [26]}]"]
    with pytest.raises(SystemExit) as stopped:
        _command.main(zoom, ["--out", str(tmp_path / "run"), "--set", *few])
    assert stopped.value.code
    told = capsys.readouterr().err.strip()
    assert "keep: effective_focal_length: values: give one for each of 2, or none" in told


@pytest.mark.slow
def test_the_macro_lens_focuses_to_its_magnifications():
    """The object distances and gaps of the file are paraxial foci for infinity, 1:4 and 1:2."""
    path = ROOT / zoom.Config().lens.replace("us5568323", "us5257137")
    systems = [drt_jax.load_system(path, configuration=k) for k in (1, 2, 3)]
    for system, wanted in zip(systems, (0, -0.25, -0.5)):
        found = drt_jax.first_order(system.lens, system.distance, 0.5875618)
        np.testing.assert_allclose(found.image_distance, system.lens.sensor, atol=7e-3)
        np.testing.assert_allclose(found.magnification, wanted, atol=1e-5)
    kept = [
        [str(operand.kind) for operand in problem.operands] for problem in problems(systems[:2])
    ]
    assert ["magnification" in kinds for kinds in kept] == [False, True]


def problems(systems):
    keep = (zoom.Keep("magnification"),)
    config = zoom.Config(keep=keep, operands=(zoom.Operand("air_centre", low=0.1),))
    return [zoom.problem_of(config, system, config.moving) for system in systems]


def test_tables_of_near_objects_have_magnification_and_breathing():
    row = {"configuration": 1, "focal_mm_designed": 50.0}
    row |= {f"merit_{name}": 0.1 for name in ("start", "moved", "end")}
    row |= {f"spots_um_{name}": [1.0, 2.0] for name in ("start", "designed")}
    results = {"lens": "a/b.zmx", "rows": [row], "searches": {}}
    far, near = zoom.tables(results), row | {"magnification_designed": -0.5}
    results["rows"] = [near | {"breathing_designed": -0.2}]
    near = zoom.tables(results)["zoom, b"]
    assert "magnification" not in far["zoom, b"] and "-0.5" in near and "breathing" in near
