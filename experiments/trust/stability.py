"""Reliability of rays, derivatives and statuses in thousands of difficult random scenes.

Every good ray is compared with a sequential trace by Snell's law. For every failed ray, this trace
is used to search for a ray through the same stop point. Draws steps and errors by family.
"""

import dataclasses
import functools
import pathlib
import sys
from typing import Annotated, Any, Literal

import jax
import numpy as np
from scipy import stats

from drt_jax import Status

from . import _command, _common, _families, _plots
from ._families import FAMILIES
from ._survey import survey
from .runs.folder import Run

# Counts of the survey; and counts of each family that are summed over all families.
_FAULTS = ("traceable", "nan_values", "nan_gradients", "disagree_with_snell")
_COUNTS = ("scenes", "rays", *(status.name.lower() for status in Status), *_FAULTS)
# Confidence of the bounds.
_SURE = 0.95
# Largest number of structures whose programs are kept: more exceed the memory maps of a process.
_STRUCTURES = 6


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/stability.yaml.

    scenes: number of scenes of a family of full size; some families have half as many.
    families: names of the families to run; empty for all.
    """

    scenes: Annotated[int, _common.within(3, 1e5)] = 620
    seed: int = 0
    families: tuple[Literal[*FAMILIES], ...] = ()


def bound(count: int, of: int) -> float:
    """Upper bound, with a confidence of 95 %, of the share of a population with some property, if
    `count` of `of` draws have it: the exact binomial bound (Clopper and Pearson 1934). It is about
    3 / of for a count of 0 (the rule of three)."""
    return float(stats.beta.ppf(_SURE, count + 1, of - count)) if count < of else 1.0


def row_of(name: str, found: dict[str, np.ndarray]) -> dict[str, Any]:
    """Row of a family in results.json, from its survey."""
    status, lost = found["status"], found["traceable"]
    steps, errors = found["steps"], found["float32_error"]
    wrong = found["disagree_with_snell"].any(axis=1)
    wrong |= found["nan_values"] + found["nan_gradients"] > 0
    faults = {"lost": lost.any(axis=1), "wrong": wrong}
    return {
        "name": name,
        "what": FAMILIES[name].what,
        "dtype": FAMILIES[name].dtype,
        "scenes": len(status),
        "rays": status.size,
        **{code.name.lower(): int(np.sum(status == code)) for code in Status},
        **{key: int(np.sum(found[key])) for key in _FAULTS},
        **{f"{key}_scenes": int(np.sum(bad)) for key, bad in faults.items()},
        **{f"{key}_scenes_bound": bound(int(np.sum(bad)), len(bad)) for key, bad in faults.items()},
        "lost_rays_bound": bound(int(np.sum(lost)), lost.size),
        "newton_steps_median": float(np.median(steps)),
        "newton_steps_max": int(np.max(steps)),
        "float32_rays": int(errors.size),
        "float32_error_p99": float(np.percentile(errors, 99)) if errors.size else 0.0,
        "traceable_unconverged": int(np.sum(lost & (status == Status.UNCONVERGED))),
        "traceable_per_10000": 1e4 * float(np.mean(lost)),
        "snell_error_max_roundings": float(np.max(found["ratio"])),
        "snell_error_max_mm": float(np.max(found["snell_error"])),
        "residual_max_of_bound": float(np.max(found["residual"])),
    }


def totals(rows: list[dict]) -> dict[str, float]:
    """Sums of the counts over all families, and rates of lost rays."""
    sums: dict[str, float] = {key: sum(row[key] for row in rows) for key in _COUNTS}
    others = [row for row in rows if row["name"] != "touching"]
    for name, some in ("", rows), ("_but_touching", others):
        lost, rays = (sum(row[key] for row in some) for key in ("traceable", "rays"))
        sums[f"traceable_per_10000{name}"] = 1e4 * lost / max(rays, 1)
    cameras = [row["float32_error_p99"] for row in rows if row["name"].startswith("camera")]
    return sums | {"camera_float32_error_p99": max(cameras, default=0.0)}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Draws and surveys the families one by one."""
    known: set = set()
    names = config.families or tuple(FAMILIES)
    absent = [name for name in names if (n := FAMILIES[name].needs) and not n.is_dir()]
    jobs = {n: functools.partial(measure, config, n, known) for n in names if n not in absent}
    found = _common.measured(run, "family", jobs)
    rows = [family["row"] for family in found]
    steps, errors = (sum((family[k] for family in found), []) for k in ("steps", "errors"))
    return {
        "families": rows,
        "absent": {name: FAMILIES[name].what for name in absent},
        "total": totals(rows),
        "seconds": run.seconds,
        "newton_steps": np.array(steps, np.int32),
        "float32_error_mm": np.array(errors, np.float32),
    }


def measure(config: Config, name: str, known: set) -> dict[str, Any]:
    """Surveys a family. Returns its row, the steps of each scene and the errors in float32, mm.
    known: structures whose programs are in JAX's caches."""
    batches = list(_families.draw(name, config.scenes, config.seed))
    known.update((jax.tree.structure(batch), batch.distance.dtype) for batch in batches)
    if len(known) > _STRUCTURES:
        known.clear()
        jax.clear_caches()
    found = jax.tree.map(lambda *a: np.concatenate(a), *map(survey, batches))
    parts = {"steps": found["steps"].tolist(), "errors": found["float32_error"].tolist()}
    return {"row": row_of(name, found)} | parts


def _bounded(count: int, row: dict[str, Any], of: str = "rays") -> tuple[int, str]:
    """A count of rays or scenes, and its bound in 10,000 of them."""
    return count, f"{1e4 * bound(min(count, row[of]), row[of]):.3g}"


def tables(results: dict[str, Any]) -> dict[str, str]:
    """A table of all families together, and one with a row for each; with bounds by `bound`."""
    header = ["family", "rays", "good", "lost", "in 10,000 rays, at most", "wrong"]
    header += ["in 10,000 rays, at most", "largest error of a good ray"]
    header += ["Newton steps, median and most", "float32 within, 99 %"]
    rows: list[tuple] = []
    for row in results["families"]:
        wrong = row["nan_values"] + row["nan_gradients"] + row["disagree_with_snell"]
        counts = row["rays"], row["ok"], *_bounded(row["traceable"], row), *_bounded(wrong, row)
        error = f"{row['snell_error_max_mm']:.0e} mm"
        steps = f"{row['newton_steps_median']:g}, {row['newton_steps_max']}"
        single = f"{row['float32_error_p99']:.1e} mm"
        rows.append((f"{row['name']}: {row['what']}", *counts, error, steps, single))
    for name, what in results.get("absent", {}).items():
        rows.append((f"{name}: {what}", "not run: the files are not here", *[""] * 8))
    total = results["total"]
    lost = total["traceable_per_10000_but_touching"]
    wrong = total["nan_values"] + total["nan_gradients"] + total["disagree_with_snell"]
    sums = [
        ("scenes", total["scenes"]),
        ("rays", total["rays"]),
        ("values that are not finite", total["nan_values"]),
        ("derivatives that are not finite", total["nan_gradients"]),
        ("good rays that Snell's law denies", total["disagree_with_snell"]),
        ("scenes in 10,000 with any of these, at most", _bounded(wrong, total, "scenes")[1]),
        ("rays in 10,000 that it finds and we do not", f"{total['traceable_per_10000']:.2f}"),
        ("the same without surfaces that touch", f"{lost:.2f}"),
    ]
    return {
        "stability": _common.table(("of all families", ""), sums),
        "stability, families": _common.table(header, rows),
    }


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws steps and float32 errors by family."""
    rows = results["families"]
    parts = (
        (results["newton_steps"], "scenes", "Newton steps of a scene"),
        (1e3 * results["float32_error_mm"], "float32_rays", "float32 error (µm)"),
    )
    with _plots.picture(figures / "families.png", 6, 1.5 + 0.14 * len(rows), 2) as axes:
        for ax, (samples, size, label) in zip(axes, parts):
            cuts = np.cumsum([row[size] for row in rows])[:-1]
            families = dict(zip([row["name"] for row in rows], np.split(samples, cuts)))
            _plots.by_family(ax, families, label, log=size == "float32_rays")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
