"""Experiments on speed at toy size: what they write, with peers that are missing or fail."""

import json

import jax
import numpy as np
import pytest

from experiments import _command, _peers, _work, benchmark, lenses


def main(experiment, *argv):
    try:
        _command.main(experiment, [*map(str, argv)])
    finally:  # these experiments compile everything anew
        jax.config.update("jax_enable_compilation_cache", True)


@pytest.mark.slow
def test_benchmark_without_peers(tmp_path, capsys, monkeypatch):
    """One task: a row for each peer, which is measured or says what is missing, and the counts."""

    def missing(name):
        raise ModuleNotFoundError(name=name)

    monkeypatch.setattr(_work, "version", missing)
    options = ["tasks=[axial]", "growth=false", "repeats=1"]
    main(benchmark, "--out", tmp_path / "run", "--set", *options)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert [(row["peer"], row["peer_s"], row["note"]) for row in results["rows"]] == [
        (name, None, f"{name} is not installed: pip install -e '.[peers]'")
        for name in ("optiland", "batoid")
    ]
    assert all(row["ours_s"] > 0 and row["ours_error"] < 1e-8 for row in results["rows"])
    solves = list(results["counts"].values())
    assert solves[:2] == [0, 0] and solves[2] > 0


@pytest.mark.slow
def test_lenses_measures_a_lens(tmp_path, capsys, monkeypatch):
    """One lens on the axis, copies of it and a sweep; peers that fail have their reason."""

    def fails(lens, rays):
        raise ValueError("no lens of this kind")

    for name in ("optiland_spot", "batoid_spot"):
        monkeypatch.setattr(_peers, name, fails)
    options = ["lenses=[{lens: singlet, field_deg: 3}]", "parts=[0]", "copies=2", "fields=2"]
    main(lenses, "--out", tmp_path / "run", "--set", *options, "sweep=8", "repeats=1")
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    (row,), (group,), (swept,) = (results[key] for key in ("rows", "copies", "sweeps"))
    assert row["tight_error"] < 1e-6 and row["loose_error"] < 1e-3 and row["passed"] == 1
    assert set(row["notes"].values()) == {"no lens of this kind"} and not row["peers"]
    assert group["bad"] == 0 and max(swept["steps"]["values"]) < 0.1
    assert "singlet" in capsys.readouterr().out


def test_a_step_is_seen():
    smooth = np.sin(np.linspace(0, 1, 200))
    stepped = smooth + (np.arange(200) > 90)
    assert lenses._roughness(smooth) < 1e-6 < 0.3 < lenses._roughness(stepped)
