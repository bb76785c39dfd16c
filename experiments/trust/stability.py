"""Thousands of random scenes made to break the tracer: are its numbers, its derivatives and its
verdicts to be trusted?

Every ray that is reported good is compared with a sequential trace by Snell's law; for every ray
that is not, that trace searches for one through the same point of the stop. Writes results.json
and a figure of steps and errors by family.
"""

import dataclasses

import jax
import numpy as np
from tqdm import tqdm

from drt_jax import Status
from drt_jax.show import plot
from drt_jax.runs.folder import Run

from . import _common
from ._scenes import FAMILIES, draw
from ._survey import COUNTS, KEYS, survey

_COLUMNS = ("scenes", "rays", "ok", *COUNTS, "traceable")


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
        for name in self.families:
            known = ", ".join(FAMILIES)
            _common.require(name in FAMILIES, f"families: unknown {name!r}; known: {known}")


def joined(parts: list[dict]) -> dict[str, np.ndarray]:
    """The surveys of a family's variants as one: arrays end to end, counts added up."""
    return {
        key: np.concatenate([part[key] for part in parts])
        if np.ndim(value)
        else np.asarray(sum(part[key] for part in parts))
        for key, value in parts[0].items()
    }


def row_of(name: str, found: dict[str, np.ndarray]) -> dict[str, object]:
    """The row of a family in results.json, from its survey."""
    status, lost = found["status"], found["lost"]
    steps, errors = found["steps"], found["float32_error"]
    row = {"name": name, "scenes": len(status), "rays": status.size}
    for code in Status:
        row[code.name.lower()] = int(np.sum(status == code))
    row |= {
        "nan_values": int(found["nan_values"]),
        "nan_gradients": int(found["nan_gradients"]),
        "disagree_with_snell": int(np.sum(found["disagree"])),
        "newton_steps_median": float(np.median(steps)),
        "newton_steps_max": int(np.max(steps)),
        "float32_error_p99": float(np.percentile(errors, 99)) if errors.size else 0.0,
        "traceable": int(np.sum(lost)),
        "traceable_unconverged": int(np.sum(lost & (status == Status.UNCONVERGED))),
        "traceable_per_10000": 1e4 * float(np.mean(lost)),
        "snell_error_max_roundings": float(np.max(found["ratio"])),
        "float32_rays": int(errors.size),
        "dtype": FAMILIES[name].dtype,
    }
    return row


def run(config: Config, run: Run) -> None:
    """Draw and survey the families one by one, print the table, write the results."""
    names = config.families or tuple(FAMILIES)
    total = sum(len(FAMILIES[name].variants) for name in names)
    rows, spread, known = [], {}, set()
    with tqdm(total=total, unit="batch", dynamic_ncols=True) as bar:
        for name in names:
            bar.set_description(name)
            batches = list(draw(name, config.scenes, config.seed))
            empty = dict.fromkeys(KEYS, np.zeros(0))
            step, found = run.load(name, empty, (name,))
            if step:
                bar.update(len(batches))
            else:
                kinds = {(jax.tree.structure(b), b.distance.dtype) for b in batches}
                if not kinds <= known:  # drop other programs: what a process may map has an end
                    jax.clear_caches()
                known = kinds | (known if kinds <= known else set())
                parts = []
                for scenes in batches:
                    parts.append(survey(scenes))
                    bar.update()
                found = joined(parts)
                run.save(name, 1, found)
            found = {key: np.asarray(value) for key, value in found.items()}
            rows.append(row_of(name, found))
            spread[name] = found["steps"], found["float32_error"]
            if not step:
                run.log(name, 0, {c: np.array([float(rows[-1][c])]) for c in _COLUMNS})
    sums = {
        key: sum(row[key] for row in rows)
        for key in (*_COLUMNS, "nan_values", "nan_gradients", "disagree_with_snell")
    }
    sums["traceable_per_10000"] = 1e4 * sums["traceable"] / sums["rays"]
    apart = [row for row in rows if row["name"] != "touching"]
    lost, rays = (sum(row[key] for row in apart) for key in ("traceable", "rays"))
    sums["traceable_per_10000_but_touching"] = 1e4 * lost / max(rays, 1)
    cameras = [row for row in rows if row["name"].startswith("camera")]
    sums["camera_float32_error_p99"] = max((r["float32_error_p99"] for r in cameras), default=0.0)
    results = {"families": rows, "total": sums, "seconds": run.seconds}
    path = run.finish(results)
    header = (
        "family",
        "scenes",
        "rays",
        "ok",
        "missed",
        "tir",
        "clipped",
        "unconv.",
        "traceable",
        "NaN",
        "NaN grad",
        "not Snell",
        "steps",
        "max",
        "float32 p99 mm",
    )
    lines = [
        (
            r["name"],
            *(
                r[c]
                for c in (
                    "scenes",
                    "rays",
                    "ok",
                    *COUNTS,
                    "traceable",
                    "nan_values",
                    "nan_gradients",
                    "disagree_with_snell",
                )
            ),
            f"{r['newton_steps_median']:g}",
            r["newton_steps_max"],
            f"{r['float32_error_p99']:.1e}",
        )
        for r in rows
    ]
    print(_common.table(header, lines))
    print(
        f"{sums['scenes']} scenes, {sums['rays']} rays: {sums['nan_values']} values and "
        f"{sums['nan_gradients']} derivatives not finite, {sums['disagree_with_snell']} good "
        "rays that Snell's law denies"
    )
    print(
        f"rays reported as failed that Snell's law can trace: {sums['traceable']}, "
        f"{sums['traceable_per_10000']:.2f} in 10,000; without surfaces that touch "
        f"{sums['traceable_per_10000_but_touching']:.2f}"
    )
    figure, axes = plot.new(1, 2, 6, 5)
    plot.by_family(axes[0], {k: v[0] for k, v in spread.items()}, "Newton steps of a scene")
    errors = {name: 1e3 * values for name, (_, values) in spread.items()}
    plot.by_family(axes[1], errors, "float32 error (µm)", log=True)
    figure.savefig(run.figures / "families.png")
    print(f"results in {path}\nfigure {run.figures / 'families.png'}")


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _common.main("stability", Config, _COLUMNS, run, argv)


if __name__ == "__main__":
    main()
