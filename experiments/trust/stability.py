"""Thousands of random scenes made to break the tracer: are its numbers, its derivatives and its
verdicts to be trusted?

Every ray that is reported good is compared with a sequential trace by Snell's law; for every ray
that is not, that trace searches for one through the same point of the stop. Draws steps and errors
by family.
"""

import dataclasses
import functools
import pathlib
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from drt_jax import Status, show
from drt_jax.runs.folder import Run

from . import _command, _common
from ._families import FAMILIES, draw
from ._survey import survey

# Of each family in metrics.csv, and summed over all in results.json.
_COLUMNS = (
    "scenes",
    "rays",
    *(status.name.lower() for status in Status),
    "traceable",
    "nan_values",
    "nan_gradients",
    "disagree_with_snell",
)
# Programs of more structures than this exhaust what a process may map.
_STRUCTURES = 6


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/stability.yaml.

    scenes: of a family of full size, some have half. seed: of all random numbers. families: the
    names of those to run, empty for all.
    """

    scenes: int = 620
    seed: int = 0
    families: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        _common.require(self.scenes >= 3, "scenes: must be at least 3")
        _common.require_known("families", self.families, FAMILIES)


def joined(parts: list[dict]) -> dict[str, np.ndarray]:
    """The surveys of a family's variants as one: arrays end to end, counts added up."""
    return {
        key: np.concatenate([part[key] for part in parts])
        if np.ndim(value)
        else np.asarray(sum(part[key] for part in parts))
        for key, value in parts[0].items()
    }


def row_of(name: str, found: dict[str, np.ndarray]) -> dict[str, Any]:
    """The row of a family in results.json, from its survey."""
    status, lost = found["status"], found["lost"]
    steps, errors = found["steps"], found["float32_error"]
    return {
        "name": name,
        "what": FAMILIES[name].what,
        "dtype": FAMILIES[name].dtype,
        "scenes": len(status),
        "rays": status.size,
        **{code.name.lower(): int(np.sum(status == code)) for code in Status},
        "nan_values": int(found["nan_values"]),
        "nan_gradients": int(found["nan_gradients"]),
        "disagree_with_snell": int(np.sum(found["disagree"])),
        "newton_steps_median": float(np.median(steps)),
        "newton_steps_max": int(np.max(steps)),
        "float32_rays": int(errors.size),
        "float32_error_p99": float(np.percentile(errors, 99)) if errors.size else 0.0,
        "traceable": int(np.sum(lost)),
        "traceable_unconverged": int(np.sum(lost & (status == Status.UNCONVERGED))),
        "traceable_per_10000": 1e4 * float(np.mean(lost)),
        "snell_error_max_roundings": float(np.max(found["ratio"])),
        "residual_max_of_bound": float(np.max(found["residual"])),
    }


def totals(rows: list[dict]) -> dict[str, float]:
    """Sums over all families, and rates of rays that are lost."""
    sums: dict[str, float] = {key: sum(row[key] for row in rows) for key in _COLUMNS}
    for name, some in (
        ("traceable_per_10000", rows),
        ("traceable_per_10000_but_touching", [row for row in rows if row["name"] != "touching"]),
    ):
        lost, rays = (sum(row[key] for row in some) for key in ("traceable", "rays"))
        sums[name] = 1e4 * lost / max(rays, 1)
    cameras = [row["float32_error_p99"] for row in rows if row["name"].startswith("camera")]
    return sums | {"camera_float32_error_p99": max(cameras, default=0.0)}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Draw and survey the families one by one."""
    found, known = [], set()
    bar = tqdm(config.families or FAMILIES, unit="family", dynamic_ncols=True)
    for name in bar:
        bar.set_description(name)
        found.append(_common.remembered(run, name, lambda: measure(config, name, run, known)))
    rows = [family["row"] for family in found]
    steps, errors = (sum((family[k] for family in found), []) for k in ("steps", "errors"))
    return {
        "families": rows,
        "total": totals(rows),
        "seconds": run.seconds,
        "newton_steps": np.array(steps, np.int32),
        "float32_error_mm": np.array(errors, np.float32),
    }


def measure(config: Config, name: str, run: Run, known: set) -> dict[str, Any]:
    """The row of a family, and samples of the steps of its scenes and of errors in float32 (mm);
    logs the row. `known`: structures whose programs are kept."""
    batches = list(draw(name, config.scenes, config.seed))
    known.update((jax.tree.structure(batch), batch.distance.dtype) for batch in batches)
    if len(known) > _STRUCTURES:
        known.clear()
        jax.clear_caches()
    found = joined([survey(scenes) for scenes in batches])
    row = row_of(name, found)
    run.log(name, 0, {key: np.array([float(row[key])]) for key in _COLUMNS})
    return {"row": row, "steps": found["steps"].tolist(), "errors": found["float32_error"].tolist()}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Each family, and the whole."""
    header = ["family", "rays", "good", "lost", "not finite", "not Snell"]
    header += ["Newton steps, median and most", "float32 within, 99 %"]
    rows = []
    for row in results["families"]:
        values = row["rays"], row["ok"], row["traceable"]
        bad = row["nan_values"] + row["nan_gradients"], row["disagree_with_snell"]
        steps = f"{row['newton_steps_median']:g}, {row['newton_steps_max']}"
        what = f"{row['name']}: {row['what']}" if row.get("what") else row["name"]
        rows.append((what, *values, *bad, steps, f"{row['float32_error_p99']:.1e} mm"))
    total = results["total"]
    lost = total["traceable_per_10000_but_touching"]
    beside = [
        ("scenes", total["scenes"]),
        ("rays", total["rays"]),
        ("values that are not finite", total["nan_values"]),
        ("derivatives that are not finite", total["nan_gradients"]),
        ("good rays that Snell's law denies", total["disagree_with_snell"]),
        ("rays in 10,000 that it finds and we do not", f"{total['traceable_per_10000']:.2f}"),
        ("the same without surfaces that touch", f"{lost:.2f}"),
    ]
    return {
        "stability": _common.table(("of all families", ""), beside),
        "stability, families": _common.table(header, rows),
    }


def report(results: dict[str, Any], figures: pathlib.Path) -> str:
    """Draw steps and float32 errors by family."""
    rows = results["families"]

    def by_family(samples: np.ndarray, size: str) -> dict[str, np.ndarray]:
        ends = np.cumsum([row[size] for row in rows])[:-1]
        return dict(zip([row["name"] for row in rows], np.split(samples, ends)))

    figure, axes = show.new(1, 2, 6, 5)
    steps = by_family(results["newton_steps"], "scenes")
    show.by_family(axes[0], steps, "Newton steps of a scene")
    errors = by_family(1e3 * results["float32_error_mm"], "float32_rays")
    show.by_family(axes[1], errors, "float32 error (µm)", log=True)
    figure.savefig(figures / "families.png")
    return "\n\n".join(tables(results).values())


main = functools.partial(_command.main, "stability", Config, _COLUMNS, run, report)

if __name__ == "__main__":
    main()
