"""experiments.zoom at toy size: two positions of two lenses."""

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


@pytest.mark.slow
def test_a_zoom_is_optimised_in_both_positions(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    (tmp_path / "toy.zmx").write_text(TOY)
    few = [f"lens={tmp_path / 'toy.zmx'}", "order=2", "trials=60", "tolerance=0.1"]
    few += ["moving=[{kind: thickness, surfaces: [1], low: 1}, {kind: sensor}]"]
    few += ["shared=[{kind: curvature}]", "operands=[{kind: spot}, {kind: air_edge, low: 0.1}]"]
    few += ["keep=[{kind: effective_focal_length, per_cent: 2}]"]
    _command.main(zoom, ["--out", str(tmp_path / "run"), "--set", *few])
    assert "gaps alone" in capsys.readouterr().out
    assert (tmp_path / "run" / "figures" / "zoom.png").is_file()
    rows = json.loads((tmp_path / "run" / "results.json").read_text())["rows"]
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
