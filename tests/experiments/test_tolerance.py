"""experiments.tolerance at toy size: rows, tables, figures, resuming, invalid settings."""

import json
from typing import get_args

import numpy as np
import pytest

from drt_jax.design.tolerance import Order
from experiments import _command, tolerance as experiment

SETTINGS = {
    "lens": "singlet",
    "tolerances": [{"kind": "radius", "size": 1.0}, {"kind": "thickness", "size": 0.3}],
    "fields_deg": [[0, 0], [0, 3], [0, -3]],
    "order": 2,
    "scales": [1, 0.5],
    "count": 60,
    "draws": 2000,
    "limits_um": [50, 100],
}


def main(*argv):
    _command.main(experiment, [str(word) for word in argv])


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    """A file with the settings."""
    path = tmp_path_factory.mktemp("tolerance") / "some.yaml"
    path.write_text(json.dumps(SETTINGS))
    return path


@pytest.mark.slow
def test_it_writes_rows_and_pictures_and_resumes(config, tmp_path, capsys):
    folder = tmp_path / "run"
    main("--config", config, "--out", folder)
    said = capsys.readouterr().out
    assert "| radius, surface 1" in said
    assert all(f"| {order} " in said for order in get_args(Order))  # the words of `Predicted.at`
    results = json.loads((folder / "results.json").read_text())
    assert [(row["kind"], row["place"]) for row in results["rows"]] == [
        *(("radius", 1), ("thickness", 0), ("thickness", 1)),
    ]
    for row in results["rows"]:
        assert len(row["traced_um"]) == len(row["predicted_um"]) == len(row["moves"]) == 2
        np.testing.assert_allclose(row["traced_um"], row["predicted_um"], rtol=0.1, atol=0.02)
        np.testing.assert_allclose(row["moves"], row["predicted_moves"], rtol=0.1, atol=1e-3)
    first, second = results["scales"]
    assert first["traced"]["mean_um"] == pytest.approx(first["second"]["mean_um"], rel=0.05)
    assert first["traced"]["p90_um"] > second["traced"]["p90_um"] > 0
    assert {path.stem for path in (folder / "figures").iterdir()} == {
        *("yield", "offenders", "histogram"),
    }
    (folder / "results.json").unlink()
    main("--resume", "--out", folder)
    again = json.loads((folder / "results.json").read_text())
    assert again.pop("machines") and results.pop("machines")
    assert again == results
