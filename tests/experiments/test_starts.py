"""Every experiment runs from settings to pictures, with as little as its settings allow."""

import importlib
import json
import pathlib
import pkgutil

import jax
import pytest

import experiments
from experiments import _command, tables

from .test_experiments import TOY

ROOT = pathlib.Path(__file__).resolve().parents[2]
AXIAL = ["wavelengths_um=[0.55]", "distance_mm=.inf", "order=2"]
STARTS = {
    "accuracy": ["scenes=[{lens: singlet}]", "orders=[2]", "rays=[7]", "tolerances=[1e-2]"],
    "stability": ["families=[curvature]", "scenes=3"],
    "faults": ["parts=[files, images]", "files=24", "traced=1"],
    "benchmark": ["tasks=[axial]", "growth=false", "repeats=1", "lens=singlet"],
    "lenses": [
        "lenses=[{lens: singlet, field_deg: 3}]",
        *("parts=[0]", "copies=1", "fields=1", "sweep=8", "repeats=1"),
    ],
    "design": [*AXIAL, "fields_deg=[0]", "starts.count=1", "trials=2", "tolerance=0.1"],
    "tolerance": [
        *("lens=singlet", "tolerances=[{kind: radius, size: 1.0}]", "fields_deg=[[0, 0]]"),
        *(*AXIAL, "count=16", "draws=10", "limits_um=[50]"),
    ],
}


def runnable():
    """Names of what `python -m experiments.NAME` runs."""
    names = [module.name for module in pkgutil.iter_modules(experiments.__path__)]
    files = {name: importlib.util.find_spec(f"experiments.{name}").origin for name in names}
    main = '\nif __name__ == "__main__":'
    return {name for name, path in files.items() if main in pathlib.Path(path).read_text()}


def test_each_experiment_is_started_somewhere():
    """Those of the paper in `test_experiments`; the rest here."""
    assert runnable() == {*STARTS, *TOY, "tables"}


@pytest.mark.parametrize("name", STARTS)
def test_it_ends_with_results_tables_and_pictures(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    experiment = importlib.import_module(f"experiments.{name}")
    try:
        _command.main(experiment, ["--out", str(tmp_path), "--set", *STARTS[name]])
    finally:  # those on speed compile everything anew
        jax.config.update("jax_enable_compilation_cache", True)
    assert json.loads((tmp_path / "results.json").read_text())
    assert "done in" in capsys.readouterr().out
    assert all(p.stat().st_size > 3000 for p in (tmp_path / "figures").iterdir())


def test_tables_has_nothing_to_write(capsys):
    tables.main()
    assert capsys.readouterr().out == ""
