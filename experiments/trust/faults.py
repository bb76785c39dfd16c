"""Invalid input and interrupted runs: files damaged at random, runs killed and stopped.

A damaged file must raise an error of one line of at most 300 characters, or give a right result.
Writes results.json: `rows` hold `kind`, `tried`, `refused`, `survived` (with a right result),
`wrong` (a wrong result, or a message that is long or has several lines), `traceback`, `hang` (5 s
for a file, minutes for a run), and `examples` of the last three.
"""

import dataclasses
import functools
import pathlib
import sys
import tempfile
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np

from . import _command, _common, _damaged_files, _ended, _plots
from ._common import within
from ._damaged_files import OUTCOMES
from .runs.folder import Run

PARTS = ("files", "kills")


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/faults.yaml.

    files: number of damaged prescriptions and settings; a quarter as many .zmx files.
    traced: number of loaded lenses that are traced.
    kills: number of kills and stops of runs.
    parts: parts to run, of files and kills; empty for all.
    """

    files: Annotated[int, within(2, 1e6)] = 10_000
    traced: Annotated[int, within(0, 1e5)] = 20
    kills: Annotated[int, within(3, 1e4)] = 200
    parts: tuple[Literal[*PARTS], ...] = ()
    seed: int = 0


def rows_of(config: Config, part: str, folder: pathlib.Path) -> Iterator[dict[str, Any]]:
    """The rows of a part, which works in a folder."""
    rngs = np.random.default_rng([config.seed, PARTS.index(part)]).spawn(4)
    if part == "kills":
        yield from _ended.rows(folder, config.kills, rngs)
        return
    row, loaded = _damaged_files.prescriptions(folder, config.files // 2, rngs[0])
    yield row
    yield _damaged_files.traced(loaded[:: max(1, len(loaded) // max(config.traced, 1))])
    path, count = folder / "config.yaml", config.files - config.files // 2
    yield _damaged_files.settings(path, count, rngs[1])
    yield _damaged_files.lens_files(folder, config.files // 4, rngs[3])


def run(config: Config, run: Run) -> dict[str, Any]:
    """Runs each part."""

    def rows(part: str) -> list[dict[str, Any]]:
        with tempfile.TemporaryDirectory() as folder:
            return [*rows_of(config, part, pathlib.Path(folder))]

    jobs = {part: functools.partial(rows, part) for part in config.parts or PARTS}
    return {"rows": sum(_common.measured(run, "part", jobs), []), "seconds": run.seconds}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Table of the outcomes of each kind, and examples of faults."""
    header = ("kind", "tried", *OUTCOMES)
    rows = [[row[key] for key in header] for row in results["rows"]]
    found = {"faults": _common.table(header, rows)}
    faults = [f"{row['kind']}: {text}" for row in results["rows"] for text in row["examples"]]
    return found | ({"faults, examples": "\n".join(faults)} if faults else {})


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the outcomes of each kind."""
    rows = {row["kind"]: [row[name] for name in OUTCOMES] for row in results["rows"]}
    with _plots.picture(figures / "faults.png", 8, 3.6) as (axes,):
        _plots.shares(axes, rows, OUTCOMES)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
