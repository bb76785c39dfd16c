"""experiments.design at toy size: what it writes, how it resumes, its errors."""

import json
import pathlib

import numpy as np
import pytest

import drt_jax
from drt_jax import Scene
from drt_jax.design import growth as growing
from experiments import _command, design

ROOT = pathlib.Path(__file__).resolve().parents[2]
NAMED = {"problem", "merit_start", "merit_end", "spots_um", "jacobians", "rays", "seconds"}
FEW = ["starts.count=3", "starts.stages=[2,2]", "order=2", "tolerance=0.1", "trials=3"]
FEW += ["fields_deg=[0,14]", "wavelengths_um=[0.5876]"]


def main(config, folder, *settings, options=()):
    path = ROOT / "configs" / "design" / f"{config}.yaml"
    given = ["--set", *settings] if settings else []
    _command.main(design, ["--config", str(path), "--out", str(folder), *options, *given])


@pytest.mark.slow
def test_a_lens_is_designed_from_several_starts(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    main("triplet", tmp_path / "run", *FEW)
    said = capsys.readouterr().out
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    (row,) = results["rows"]
    assert set(row) >= NAMED and row["merit_end"] < row["merit_start"] and "RMS um" in said
    lens = drt_jax.load_lens(tmp_path / "run" / "designed.yaml")
    np.testing.assert_allclose(drt_jax.focal_length(lens, (0.5876,)), 50, rtol=1e-12)
    moments = drt_jax.psf_moments(lens, Scene.point(0.0, np.inf, (0.5876,)), 0.1)
    spot = 1e3 * np.sqrt(np.trace(moments.covariance[0]))
    np.testing.assert_allclose(spot, row["spots_um"][0], rtol=1e-9)
    figures = {path.stem for path in (tmp_path / "run" / "figures").glob("*.png")}
    assert figures == {"lens", "spots", "merit", "minima", "minima_drawn"}
    # A finished job is not searched for again.
    (tmp_path / "run" / "results.json").unlink()
    monkeypatch.setattr(design.design, "many_starts", None)
    monkeypatch.setattr(design.design, "optimise", None)
    _command.main(design, ["--out", str(tmp_path / "run"), "--resume"])
    again = json.loads((tmp_path / "run" / "results.json").read_text())
    assert again["rows"] == results["rows"]


@pytest.mark.slow
def test_a_lens_grows_with_its_aperture(tmp_path, monkeypatch, capsys):
    """First half of the beam, then more, each until it is good enough; a run that is stopped
    continues from its checkpoint; if growth stops, the error names the part that was reached."""
    monkeypatch.chdir(ROOT)
    growth = ["growth.first=0.5", "growth.step=0.3", "growth.trials=20", "tolerance=0.1"]
    searched = []
    optimise = design.design.optimise
    monkeypatch.setattr(design, "draw", lambda *_: None)

    def watched(problem, *given):
        if len(searched) == 2:
            searched.append(None)
            raise KeyboardInterrupt
        found = optimise(problem, *given)
        size = float(problem.variables.lens.semi_diameter[0])
        searched.append((size, found.score, found.jacobians))
        return found

    for module in (design.design, growing):
        monkeypatch.setattr(module, "optimise", watched)
    growth.append("growth.good_um=100")
    with pytest.raises(SystemExit) as caught:
        main("singlet", tmp_path / "run", *growth)
    assert caught.value.code == 130
    _command.main(design, ["--out", str(tmp_path / "run"), "--resume"])
    main("singlet", tmp_path / "unbroken", *growth)
    parts = [part for part in searched if part]
    semis, scores, jacobians = zip(*parts[:4])
    np.testing.assert_allclose(semis, [3.75, 6.45, 7.5, 7.5])
    assert np.all(np.array(scores) <= 0.1**2)
    assert parts[:4] == parts[4:]
    (row,), (other,) = (
        json.loads((tmp_path / name / "results.json").read_text())["rows"]
        for name in ("run", "unbroken")
    )
    np.testing.assert_allclose(row["merit_end"], 0.00172898452577, rtol=1e-9)
    np.testing.assert_allclose(row["merit_start"], 30.0924206902, rtol=1e-9)
    assert row["jacobians"] == sum(jacobians) and row["rays"] > 91 * sum(jacobians)
    for name in ("merit_start", "merit_end", "spots_um", "jacobians", "rays"):
        assert row[name] == other[name]
    with pytest.raises(SystemExit) as caught:
        main("singlet", tmp_path / "other", *growth, "growth.good_um=10", "growth.trials=4")
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert "of field and aperture, where no step leads to 10 um: the next comes to " in said
    assert "raise growth.good_um or growth.trials" in said


@pytest.mark.release
def test_a_phone_lens_from_a_crude_start(tmp_path, monkeypatch):
    """Five aspheres, f/2 and 35 degrees: spots below 3 um at all fields, within all limits. One
    wavelength and four fields take a quarter of the time; results/design/phone has all."""
    monkeypatch.chdir(ROOT)
    fewer = ["fields_deg=[0,14,28,35]", "wavelengths_um=[0.5876]", "order=4"]
    main("phone", tmp_path / "run", *fewer, "trials=120", "tolerance=1e-3")
    (row,) = json.loads((tmp_path / "run" / "results.json").read_text())["rows"]
    assert max(row["spots_um"]) < 3 and row["worst_limit"] < 1e-3
    lens = drt_jax.load_lens(tmp_path / "run" / "designed.yaml")
    np.testing.assert_allclose(drt_jax.focal_length(lens, (0.5876,)), 4, rtol=1e-9)
    assert (
        5 <= lens.sensor <= 6 and abs(drt_jax.first_order(lens, np.inf, 0.5876).f_number - 2) < 0.01
    )


@pytest.mark.parametrize("path", sorted((ROOT / "configs" / "design" / "lenses").glob("*.yaml")))
def test_starts_load(path):
    assert drt_jax.load_lens(path).count > 1


@pytest.mark.slow
def test_glasses_become_real(tmp_path, monkeypatch):
    """The lens that is written has real glasses and the reported merit, and no model glass."""
    monkeypatch.chdir(ROOT)
    few = ["glasses.count=3", "glasses.steps=3", "trials=15", "tolerance=0.1", "order=3"]
    main("apochromat", tmp_path / "run", *few)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    lens = drt_jax.load_lens(tmp_path / "run" / "designed.yaml")
    assert lens.dispersion.model is None
    taken = {snap["surfaces"][0]: snap["glass"] for snap in results["glasses"]["snaps"]}
    assert lens.glasses == ("air", taken[0], taken[1], "air")
    assert results["rows"][0]["merit_end"] == results["glasses"]["snaps"][-1]["after"]
    moments = drt_jax.psf_moments(lens, Scene.point(0.0, np.inf, results["wavelengths_um"]), 0.1)
    mean, covariance = np.asarray(moments.mean), np.asarray(moments.covariance)
    apart = np.sum((mean - mean.mean(axis=0)) ** 2, axis=1)
    spot = np.sqrt(np.mean(np.trace(covariance, axis1=1, axis2=2) + apart))
    np.testing.assert_allclose(1e3 * spot, results["rows"][0]["spots_um"][0], rtol=1e-9)
    assert results["glasses"]["foci"][-1] == 0
