"""What tolerances do: bars of the worst, and how often lenses are how good."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes


def offenders(axes: Axes, names: Sequence[str], series: Mapping[str, np.ndarray]) -> Axes:
    """Groups of horizontal bars, the first on top.

    names: of the groups, N. series: lengths (N,) by label; the first filled, the others as outlines
    of it.
    """
    places = np.arange(len(names))
    for k, (label, values) in enumerate(series.items()):
        fill = {"color": "C0", "alpha": 0.7} if k == 0 else {"fill": False, "edgecolor": f"C{k}"}
        axes.barh(places, values, height=0.8 - 0.25 * k, label=label, linewidth=1.4, **fill)
    axes.set_yticks(places, list(names), fontsize=8)
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)
    axes.legend(fontsize=8)
    return axes


def histogram(
    axes: Axes,
    edges: np.ndarray,
    counts: Mapping[str, np.ndarray],
    marks: Mapping[str, float],
    xlabel: str,
) -> Axes:
    """Shares of samples between edges, in per cent.

    edges: (N + 1,). counts: (N,) by label, of any sum; the first filled, the others as lines.
    marks: places of vertical lines, by label.
    """
    for k, (label, values) in enumerate(counts.items()):
        part = 100 * np.asarray(values) / np.sum(values)
        fill = {"color": "C0", "alpha": 0.35} if k == 0 else {"color": f"C{k}", "linewidth": 1.3}
        axes.stairs(part, edges, fill=k == 0, label=label, **fill)
    for k, (label, place) in enumerate(marks.items()):
        axes.axvline(place, color="black", linestyle=("-", "--", ":")[k % 3], linewidth=1)
        axes.annotate(
            label, (place, 1), (3, -10 - 11 * k), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8,
        )  # fmt: skip
    axes.set(xlabel=xlabel, ylabel="share (%)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="center right")
    return axes
