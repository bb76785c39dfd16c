"""Other optimisers on a finished design, from the same starts:

python -m comparisons.design results/design/singlet comparisons/singlet.yaml

Adds to the results.json of that folder `beside`, a row for each, and to its row `peer_spots_um`,
the spots by Optiland's rays, and of those of Optiland's optimisers the one with the best
lens: `peer`, `peer_merit`, `peer_s`."""

import json
import pathlib
import sys

import drt_jax
from drt_jax import design
from drt_jax.__main__ import set_up
from experiments import design as experiment
from experiments.runs.config import load_config

from . import _optiland, _optimisers
from ._settings import Beside, require_told


def main(folder: pathlib.Path, settings_file: str) -> None:
    """Compare and add to the results."""
    set_up()
    config = load_config(experiment.Config, folder / "config.yaml")
    settings = load_config(Beside, settings_file)
    require_told(config, settings.peers)
    start = drt_jax.load_lens(config.lens)
    start = design.open_apertures(start) if config.floating else start
    problem = experiment.problem_of(config, start)
    vectors = experiment.starts_of(problem.variables, config.starts)
    path, designed = folder / "results.json", drt_jax.load_lens(folder / "designed.yaml")
    results = json.loads(path.read_text())
    order = experiment.order_of(config, designed)
    row = results["rows"][0]
    rows = _optimisers.beside(config, settings, problem, vectors, order, row)
    scene = config.fields_deg, config.wavelengths_um, config.distance_mm
    row |= _optimisers.peer(rows) | {"peer_spots_um": _optiland.spots_um(designed, *scene)}
    results["beside"] = rows
    path.write_text(json.dumps(results, indent=1))
    print("\n\n".join(experiment.tables(results).values()))


if __name__ == "__main__":
    main(pathlib.Path(sys.argv[1]), sys.argv[2])
