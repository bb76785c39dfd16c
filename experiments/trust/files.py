"""Lens files of another program against its own listings: right, refused, or silently wrong.

Each NAME.zmx of a folder is read; NAME.txt beside it is OpticStudio's listing. Right: focal length,
f-numbers, entrance pupil and stop are those of the listing to its last digit. Writes results.json:
`rows` hold `file`, `outcome` (right, refused, wrong, unlisted), `why` (the message, or what
differs).
"""

import dataclasses
import pathlib
import re
import sys
import warnings
from typing import Any

import numpy as np

import drt_jax
from drt_jax import show

from . import _command, _common, _plots
from .runs.folder import Run

OUTCOMES = ("right", "refused", "wrong", "unlisted")
COLUMNS = OUTCOMES


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/files.yaml.

    folder: of the files and listings.
    """

    folder: str


def listed(content: str, key: str) -> tuple[float, float] | None:
    """A number of a listing and one of its last digit; None if it is not there."""
    found = re.search(rf"^{re.escape(key)}\s*:\s*([-+.\dEe]+)", content, re.MULTILINE)
    if not found:
        return None
    digits, _, power = found[1].lower().partition("e")
    return float(found[1]), 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))


def first_order(system: drt_jax.System) -> dict[str, float]:
    """What a listing has, by its names."""
    wave = np.array([system.wavelengths[system.primary]])
    found = drt_jax.first_order(system.lens, system.distance, wave)
    focal, aperture = float(found.effective_focal_length[0]), float(found.numerical_aperture[0])
    pupil = 2 * float(found.entrance_pupil.semi_diameter[0])
    return {
        "Effective Focal Length": focal,
        "Image Space F/#": abs(focal) / pupil,
        "Paraxial Working F/#": 0.5 / aperture if aperture else np.inf,
        "Entrance Pupil Diameter": pupil,
        "Stop Radius": float(system.lens.semi_diameter[system.lens.stop]),
    }


def outcome(path: pathlib.Path) -> dict[str, str]:
    """One file. A focal length of 1e10 is what a listing writes for none."""
    row = {"file": path.name}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = first_order(drt_jax.load_system(path))
    except drt_jax.LensError as error:
        return row | {"outcome": "refused", "why": str(error).removeprefix(str(path)).lstrip(", :")}
    listing = path.with_suffix(".txt")
    if not listing.is_file():
        return row | {"outcome": "unlisted", "why": "no listing"}
    content, off = listing.read_text("latin-1"), []
    for key, value in found.items():
        number, step = listed(content, key) or (value, 0.0)
        afocal = np.isinf(value) and abs(number) >= 1e7
        if not (afocal or abs(value - number) <= max(1.01 * step, 1e-9 * abs(number))):
            off.append(f"{key} {value:.9g}, listed {number:.9g}")
    return row | {"outcome": "wrong" if off else "right", "why": "; ".join(off)}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Read each file."""
    paths = sorted(pathlib.Path(config.folder).glob("*.zmx"))
    _common.require(len(paths) > 0, f"folder: no .zmx file in {config.folder}")
    rows = _common.measured(run, "file", {p.name: lambda p=p: outcome(p) for p in paths})
    for row in rows:
        own = {name: np.array([float(row["outcome"] == name)]) for name in COLUMNS}
        run.log(row["file"], 0, own)
    return {"rows": rows, "seconds": run.seconds}


def counts(rows: list[dict[str, Any]]) -> list[int]:
    """How many files came to each outcome."""
    return [sum(row["outcome"] == name for row in rows) for name in OUTCOMES]


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Each file, and how many of each."""
    rows = [[row[key] for key in ("file", "outcome", "why")] for row in results["rows"]]
    return {
        "files": _common.table(("file", "outcome", "why"), rows),
        "files, counts": _common.table(OUTCOMES, [counts(results["rows"])]),
    }


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draw how many of each."""
    figure, axes = show.new(1, 1, 8, 2)
    _plots.shares(axes, {"drt_jax": counts(results["rows"])}, OUTCOMES)
    figure.savefig(figures / "files.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
