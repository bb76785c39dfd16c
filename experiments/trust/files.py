"""Lens files of other programs: read right, near, wrong or refused; and written again.

drt_jax and, where installed, Optiland and ray-optics read each `.zmx` and `.seq` file of some
folders in the same run. The numbers are compared with NAME.txt in the same folder, OpticStudio's
listing, or with INDEX.md, a table of focal lengths (column 4, mm, at the primary wavelength) that
other programs confirm.

- right: focal length, f-number, entrance pupil and all indices of glasses agree with the listing to
  its last digit, or the focal length with the table to 1e-6;
- near: they agree to a thousandth;
- wrong: they differ by more, and the program gives no message.

drt_jax also writes each lens that it reads in all formats, reads it back and compares. Writes
results.json: `rows` with `file`, `reader`, `outcome`, `off` (the largest relative error of a
number), `why` (the message, or the name of the number with this error), and for drt_jax `trips`: by
format "", or the reason why the file was not written or not read back as the same.
"""

import contextlib
import dataclasses
import decimal
import io
import pathlib
import re
import sys
import tempfile
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

import drt_jax

from . import _command, _common, _plots
from .runs.folder import Run

OUTCOMES = ("right", "near", "refused", "wrong", "unlisted", "absent")
FORMATS = (".zmx", ".seq", ".yaml")
_NEAR = 1e-3
_INDEX = 2e-9  # relative; the constants of silica have one more digit in some programs
Read = tuple[list[float], list[float], float | None]
_WIDE, _PLACE = "Entrance Pupil Diameter", "Entrance Pupil Position"
_NUMBERS = "Effective Focal Length", "Image Space F/#", _WIDE, _PLACE


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/files.yaml. folders: folders with files and
    listings."""

    folders: tuple[str, ...]


def _ours(path: str) -> Read:
    system = drt_jax.load_system(path)
    wave = np.array([system.wavelengths[system.primary]])
    found = drt_jax.first_order(system.lens, system.distance, wave)
    focal, pupil = float(found.effective_focal_length[0]), found.entrance_pupil
    wide, place = 2 * float(pupil.semi_diameter[0]), float(pupil.position[0])
    indices = np.asarray(system.lens.index(wave))[:, 0].tolist()
    return [focal, focal / wide, wide, place], indices, system.distance


def _optiland(path: str) -> Read:
    from optiland.fileio import load_codev_file, load_zemax_file

    optic = (load_codev_file if path.endswith(".seq") else load_zemax_file)(path)
    own = optic.paraxial
    values = (own.f2(), own.FNO(), own.EPD(), own.EPL())
    first = [float(np.ravel(value)[0]) for value in values]
    return first, np.ravel(optic.n(optic.primary_wavelength)).tolist(), None


def _rayoptics(path: str) -> Read:
    from rayoptics.gui.appcmds import open_model

    model = open_model(path)
    own = model["analysis_results"]["parax_data"].fod
    primary = model["osp"]["wvls"].reference_wvl
    indices = [float(row[primary]) for row in model["seq_model"].rndx]
    focal, wide = own.efl or np.inf, 2 * own.enp_radius  # 0 means that there is none
    return [focal, focal / wide, wide, own.enp_dist], indices, None


# [focal length, f-number, diameter and position of the entrance pupil], indices of all media, and
# the distance from the object to the origin of that position; None if the origin is surface 1, as
# in listings.
READERS: dict[str, Callable] = {"drt_jax": _ours, "optiland": _optiland, "rayoptics": _rayoptics}


def listed(content: str, key: str) -> tuple[float, float] | None:
    """A number of a listing, and one unit of its last digit; None if it is not listed."""
    found = re.search(rf"^{re.escape(key)}\s*:\s*([-+.\dEe]+)", content, re.MULTILINE)
    return found and (float(found[1]), 10.0 ** decimal.Decimal(found[1]).as_tuple().exponent)


def listed_indices(content: str) -> list[float]:
    """Indices of all listed glasses at the primary wavelength, except the medium behind the image;
    empty if there are none."""
    table = content.partition("INDEX OF REFRACTION")[2]
    head = re.search(r"^Surf .*?((?:\s+\d\.\d{8})+)", table, re.MULTILINE)
    primary = re.search(r"^Primary Wavelength.*:\s*([\d.]+)", content, re.MULTILINE)
    if not head or not primary:
        return []
    at = np.argmin(np.abs(np.array(head[1].split(), float) - float(primary[1])))
    own = re.split(r"\n\s*\n", table[head.end() :])[0]  # other tables follow
    rows = re.findall(r"^ +\d+ .*?((?:\s+\d\.\d{10})+)", own, re.MULTILINE)
    return [float(row.split()[at]) for row in rows[:-1]]


def differences(
    content: str, first: list[float], indices: list[float], far: float | None
) -> list[tuple]:
    """(relative error, whether it is right, text) for each number of a listing. Signs are not
    compared, because those behind mirrors differ between programs. A listing has 1e10 for a lens
    without a focal length."""
    found = []
    wide = (listed(content, _WIDE) or (1.0,))[0]
    finite = re.search(r"^ OBJ\s+\S+\s+\S+\s+([-+.\dEe]+)\s", content, re.MULTILINE)
    if finite and far is not None:
        first = [*first[:3], first[3] + far - float(finite[1])]
    for key, value in zip(_NUMBERS, first):
        number, step = listed(content, key) or (value, 0.0)
        if key != _PLACE:
            value, number = abs(value), abs(number)
        if min(abs(value), abs(number)) >= 1e7:
            continue
        off = abs(value - number)
        size = max(abs(number), wide if key == _PLACE else 0.0)
        right = off <= max(1.01 * step, 1e-9 * size)
        found.append((off / size, right, f"{key} {value:.7g}, listed {number:.7g}"))
    both = indices, listed_indices(content)
    glasses, truth = ([abs(n) for n in row if abs(n) != 1] for row in both)
    if not truth:
        return found
    if len(glasses) != len(truth):
        return [*found, (np.inf, False, f"{len(glasses)} glasses, listed {len(truth)}")]
    for own, number in zip(glasses, truth):
        off = abs(own - number)
        found.append((off, off <= _INDEX, f"index {own:.8g}, listed {number:.8g}"))
    return found


def indexed(path: pathlib.Path) -> float | None:
    """The focal length (mm) of a file in the table INDEX.md of its folder; None if the table does
    not have it."""
    index = path.with_name("INDEX.md")
    lines = index.read_text().splitlines() if index.is_file() else []
    cells = [[cell.strip() for cell in line.split("|")] for line in lines]
    return next((float(row[4]) for row in cells if row[1:2] == [path.name]), None)


def trips(path: pathlib.Path) -> dict[str, str]:
    """By format, the reason why a file is not written or not read back as the same; "" if it is."""
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system, numbers = drt_jax.load_system(path), _ours(str(path))
        for kind in FORMATS:
            out = pathlib.Path(folder) / f"again{kind}"
            try:
                drt_jax.save_lens(system, out)
            except drt_jax.LensError as error:
                found[kind] = f"refused: {str(error).removeprefix(str(out)).lstrip(', :')}"
                continue
            same = kind == ".yaml" or np.allclose(_ours(str(out))[0], numbers[0], 1e-9, 1e-9)
            found[kind] = "" if same else "wrong"
    return found


def outcome(path: pathlib.Path, reader: str) -> dict[str, Any]:
    """Row of one file read by one program. The output of the program is discarded."""
    row = {"file": path.name, "reader": reader, "off": None}
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            numbers = READERS[reader](str(path))
    except ModuleNotFoundError as error:
        if error.name != reader:
            raise
        return row | {"outcome": "absent", "why": f"{reader} is not installed"}
    except Exception as error:  # other programs may raise anything
        if isinstance(error, drt_jax.LensError):
            why = str(error).removeprefix(str(path)).lstrip(", :")
        elif reader == "drt_jax":
            raise
        else:
            why = " ".join(f"{type(error).__name__}: {error}".split())[:100]
        return row | {"outcome": "refused", "why": why}
    if np.any(np.isnan(numbers[0])):
        return row | {"outcome": "refused", "why": "the numbers are none: NaN"}
    if reader == "drt_jax":
        row["trips"] = trips(path)
    listing, known = path.with_suffix(".txt"), indexed(path)
    if listing.is_file():
        found = differences(listing.read_text("latin-1"), *numbers)
    elif known:
        own, off = abs(numbers[0][0]), abs(abs(numbers[0][0]) / known - 1)
        found = [(off, off <= 1e-6, f"focal length {own:.8g}, others {known:.8g}")]
    else:
        return row | {"outcome": "unlisted", "why": "no listing"}
    off, _, why = max(found, key=lambda one: np.nan_to_num(one[0], nan=np.inf))
    row["off"] = float(off) if np.isfinite(off) else None
    if all(right for _, right, _ in found):
        return row | {"outcome": "right", "why": ""}
    return row | {"outcome": "near" if off <= _NEAR else "wrong", "why": why}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Reads each file by each program."""
    each = [pathlib.Path(folder).glob("*") for folder in config.folders]
    paths = [p for own in each for p in sorted(own) if p.suffix.lower() in (".zmx", ".seq")]
    _common.require(len(paths) > 0, f"folders: no file in {', '.join(config.folders)}")

    jobs = {p.name: lambda p=p: [outcome(p, reader) for reader in READERS] for p in paths}
    return {"rows": sum(_common.measured(run, "file", jobs), []), "seconds": run.seconds}


def counts(rows: list[dict[str, Any]], reader: str) -> list[int]:
    """Number of files of each outcome."""
    own = [row["outcome"] for row in rows if row["reader"] == reader]
    return [own.count(name) for name in OUTCOMES]


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of outcomes by file and program, and of their counts. `why` is our message, or else
    the error of another program."""
    rows = []
    for (name,), group in _common.grouped(results["rows"], "file").items():
        errors = [f"{row['reader']}: {row['why']}" for row in group if row["outcome"] == "wrong"]
        why = [group[0]["why"]] if group[0]["why"] else errors[:1]
        cells = []
        for row in group:
            wrong = row["outcome"] in ("near", "wrong") and row["off"] is not None
            cells.append(row["outcome"] + (f" ({row['off']:.0e})" if wrong else ""))
        rows.append([name, *cells, "".join(why)])
    totals = [[reader, *counts(results["rows"], reader)] for reader in READERS]
    again = [row["trips"] | {"file": row["file"]} for row in results["rows"] if "trips" in row]
    written = []
    for kind in FORMATS:
        lost = [f"{row['file']}: {row[kind]}" for row in again if row[kind]]
        written.append([kind, len(again) - len(lost), len(lost), "; ".join(lost)])
    return {
        "files, round trips": _common.table(("format", "the same", "not written", "why"), written),
        "files": _common.table(("file", *READERS, "why"), rows),
        "files, counts": _common.table(("reader", *OUTCOMES), totals),
    }


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the number of files of each outcome."""
    shares = {reader: counts(results["rows"], reader) for reader in READERS}
    with _plots.picture(figures / "files.png", 8, 2.4) as (axes,):
        _plots.shares(axes, shares, OUTCOMES)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
