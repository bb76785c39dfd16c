"""Tables of a design; and figures from its lens files: before and after, spots, merit, minima."""

import math
import pathlib
import statistics
from typing import Any

import numpy as np

import drt_jax
from drt_jax import Pattern, Scene, show
from drt_jax.pupil import hexapolar

from . import _common, _plots

# Columns of the table of other optimisers: medians over their starts.
_MEDIANS = "met_jacobians", "met_s", "seconds"
# Largest number of ranked minima; rings of rays of a drawn spot.
_RANKED, _RINGS = 30, 8


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of the spots by field, and of counts and times."""
    (row,), starts = results["rows"], results["starts"]
    fields = results["fields_deg"]
    peers = row.get("peer_spots_um") or [None] * len(fields)
    spots = [[field, um, peer] for field, um, peer in zip(fields, row["spots_um"], peers)]
    totals = (None if None in um else math.hypot(*um) for um in (row["spots_um"], peers))
    spots.append(["root of the sum of squares", *totals])
    rows = [
        ["merit, mm^2, start", row["merit_start"]],
        ["merit, mm^2, end", row["merit_end"]],
        ["worst limit exceeded by", row["worst_limit"]],
        ["Jacobians", row["jacobians"]],
        ["rays traced", row["rays"]],
        ["seconds", row["seconds"]],
        ["compilation, s", row["compile_s"]],
    ]
    if glasses := results.get("glasses"):
        rows.append(["seconds for the glasses", glasses["snap_s"]])
        foci = zip(results["wavelengths_um"], glasses["foci"], strict=True)
        rows += [[f"focus at {um:.4f} um, over the focal length", place] for um, place in foci]
    if starts["merits"]:
        rows += [["starts that pass light", starts["passed"]], ["minima", len(starts["merits"])]]
        rows += [["minima per minute", 60 * len(starts["merits"]) / max(starts["seconds"], 1e-9)]]
    if results["how"] == "as_built":
        rows.append(["starts no worse than the lens", f"{starts['no_worse']} of {starts['count']}"])
    name = row["problem"]
    found = {
        f"design, {name}: spots": _common.table(("field, deg", "RMS um", "by Optiland"), spots),
        f"design, {name}": _common.table(("what", "value"), rows),
    }
    if glasses:
        header = ["behind surface", "nd", "vd", "becomes", "merit before", "after"]
        keys = ("glass", "before", "after")
        snaps = glasses["snaps"]
        rows = [[", ".join(map(str, s["surfaces"])), *s["model"], *map(s.get, keys)] for s in snaps]
        found[f"design, {name}: glasses"] = _common.table(header, rows)
    if results.get("beside"):
        found[f"design, {name}: beside"] = _peers_table(results["beside"], results["how"])
    return found


def _peers_table(rows: list[dict[str, Any]], how: str) -> str:
    """Table of other optimisers, see `comparisons`."""
    goal = "no worse than the lens" if how == "as_built" else "within 1% of the design"
    header = ["optimiser", f"starts {goal}", "merit, best", "median", "limit exceeded by"]
    header += ["Jacobians until then", "s until then", "s a start"]
    lines = []
    for row in rows:
        met = "not installed" if row["met"] is None else f"{row['met']} of {row['starts']}"
        worst = max((x for x in row["worst"] if x is not None), default=None)
        known = ([x for x in row[key] if x is not None] for key in _MEDIANS)
        medians = (statistics.median(some) if some else None for some in known)
        lines.append([row["optimiser"], met, row["best"], row["median"], worst, *medians])
    return _common.table(header, lines)


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the lens before and after, its spots, the merit, and the minima."""
    folder, starts = figures.parent, results["starts"]
    fields, waves = results["fields_deg"], results["wavelengths_um"]
    scene = Scene.degrees(fields, results["distance_mm"] or math.inf, waves)

    def draw_lenses(to: str, titles: dict[str, str], height: float, columns: int) -> None:
        """Draws lens files with titles in panels of a height, inches."""
        with _plots.picture(figures / to, 2.5 * height, height, len(titles), columns) as axes:
            for ax, (name, title) in zip(axes, titles.items()):
                drawing = show.draw(drt_jax.load_lens(folder / f"{name}.yaml"), scene)
                show.lens_drawing(ax, drawing).set_title(title, fontsize=9)

    draw_lenses("lens.png", {"start": "start", "designed": "designed"}, 3.2, 1)
    rays = Pattern(*hexapolar(_RINGS), "none")
    found = drt_jax.spot_diagram(drt_jax.load_lens(folder / "designed.yaml"), scene, rays)
    reach = np.asarray(found.radius)  # inf where no light arrives
    half = 1.05e3 * float(np.max(reach, initial=1e-6, where=np.isfinite(reach)))
    with _plots.picture(figures / "spots.png", 3.2, 3.4, len(fields), len(fields)) as axes:
        for k, ax in enumerate(axes):
            show.spots(ax, found, k, waves, half).set_title(f"{fields[k]:g} deg", fontsize=9)
        axes[0].legend(fontsize=7, loc="upper left")
    with _plots.picture(figures / "merit.png", 6, 3.6) as (ax,):
        if starts["merits"]:
            best = 1e3 * np.sqrt(starts["best"])
            ax.semilogy(np.arange(1, len(best) + 1), best, color="tab:blue")
            _plots.label_axes(ax, "tiles of 16 searches, by stages", "root of the best merit (um)")
            ax.grid(alpha=0.3, which="both")
        else:
            merits, violations, _ = np.transpose(results["history"])
            ax.semilogy(1e3 * np.sqrt(merits), color="tab:blue")
            _plots.label_axes(ax, "trial", "root of the merit (um)")
            other = ax.twinx()
            other.plot(np.maximum(violations, 0), color="tab:red", linewidth=0.8)
            other.set_ylabel("worst limit exceeded by", color="tab:red")
    if starts["merits"]:
        sizes = [1e3 * math.sqrt(merit) for merit in starts["merits"][:_RANKED]]
        with _plots.picture(figures / "minima.png", 7, 3.6) as (ax,):
            bars = ax.bar(range(1, len(sizes) + 1), sizes, color="tab:blue")
            ax.bar_label(bars, starts["found"][:_RANKED], fontsize=7)
            what = "minimum, and how many starts ended there"
            _plots.label_axes(ax, what, "root of the merit (um)", "y")
        names = ["designed", *sorted(path.stem for path in folder.glob("minimum_*.yaml"))]
        titles = {name: f"{size:.3f} um" for name, size in zip(names, sizes)}
        draw_lenses("minima_drawn.png", titles, 2.5, 2)
