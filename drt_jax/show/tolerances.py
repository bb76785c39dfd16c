"""What tolerances do: bars of the worst, and how often lenses are how good."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes


def offenders(axes: Axes, names: Sequence[str], series: Mapping[str, np.ndarray]) -> Axes:
    """Groups of horizontal bars, the first on top.

    names: of the groups, N. series: lengths (N,) by label; the first filled, the others as outlines
    of it.
    """
    places = np.arange(len(names))
    for k, (label, values) in enumerate(series.items()):
        fill: dict[str, Any] = {"fill": False, "edgecolor": f"C{k}"}
        if k == 0:
            fill = {"color": "C0", "alpha": 0.7}
        axes.barh(places, values, height=0.8 - 0.25 * k, label=label, linewidth=1.4, **fill)
    axes.set_yticks(places, list(names), fontsize=8)
    axes.invert_yaxis()
    axes.grid(axis="x", alpha=0.3)
    axes.legend(fontsize=8)
    return axes


# Lines that may lie on each other, below one broad line of what is true.
_TRUE: dict[str, Any] = {"color": "black", "alpha": 0.35, "linewidth": 4}
_STYLES = ("-", "--", ":")
_DOTS = {"color": "black", "linewidth": 2.2, "zorder": 4}  # on top of what they agree with


def yields(
    axes: Axes, curves: Mapping[str, tuple[np.ndarray, np.ndarray]], xlabel: str, ylabel: str
) -> Axes:
    """Shares of lenses, in per cent, over what they reach: the first curve broad, those that are
    to be compared with it thin.

    curves: (x (N,), shares (N,) in per cent) by label.
    """
    for k, (label, (x, share)) in enumerate(curves.items()):
        style: dict[str, Any] = {"color": f"C{k}", "linestyle": _STYLES[k % 3], "linewidth": 1.5}
        style |= _DOTS if k % 3 == 2 else {}
        axes.plot(x, share, label=label, **(style if k else _TRUE))
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return axes


def histogram(
    axes: Axes,
    edges: np.ndarray,
    shares: Mapping[str, np.ndarray],
    marks: Mapping[str, float],
    xlabel: str,
) -> Axes:
    """Shares of samples between edges, in per cent.

    edges: (N + 1,). shares: (N,) by label; the first filled, the others as lines. marks: places of
    vertical lines, by label.
    """
    for k, (label, values) in enumerate(shares.items()):
        line: dict[str, Any] = {"color": f"C{k}", "linestyle": _STYLES[k % 3], "linewidth": 1.5}
        line |= _DOTS if k % 3 == 2 else {}
        fill: dict[str, Any] = {"color": "black", "alpha": 0.2, "fill": True}
        axes.stairs(values, edges, label=label, **(line if k else fill))
    for k, (label, place) in enumerate(marks.items()):
        axes.axvline(place, color="black", linestyle="-.", linewidth=0.8)
        axes.annotate(
            label, (place, 1), (3, -10 - 11 * k), xycoords=("data", "axes fraction"),
            textcoords="offset points", fontsize=8,
        )  # fmt: skip
    axes.set(xlabel=xlabel, ylabel="share (%)")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="center right")
    return axes
