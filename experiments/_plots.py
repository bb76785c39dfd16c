"""Plots of the experiments' results: arrays in, axes out."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from drt_jax.show import new
from drt_jax.show.figures import FIELD_COLOURS


def _label(axes: Axes, xlabel: str, ylabel: str, grid: str = "both", **legend: Any) -> None:
    """Labels, a grid, and a legend where there are labelled lines."""
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3, axis=grid)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, **legend)


def curves(
    axes: Axes,
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    level: tuple[float, str] | None = None,
) -> None:
    """Lines: (x (N,), y (N,)) by label. level: height and label of a horizontal line."""
    for k, (label, (x, y)) in enumerate(series.items()):
        axes.plot(x, y, linewidth=1.1, linestyle="-" if k < 10 else "--", label=label)
    if level is not None:
        axes.axhline(level[0], color="black", linestyle=":", linewidth=1, label=level[1])
    _label(axes, xlabel, ylabel)


def error_curves(
    axes: Axes,
    curves: Mapping[str, tuple[Sequence[float], Sequence[Sequence[float | None]]]],
    xlabel: str,
    ylabel: str,
    note: tuple[float, float, str] | None = None,
) -> None:
    """Errors over cost, both logarithmic: a line for the median of the scenes, a band from the best
    to the worst.

    curves: (x (N,), errors (N, M) of M scenes) by label, without errors of None or 0.
    note: x, y and a text that points there.
    """
    for k, (label, (x, errors)) in enumerate(curves.items()):
        known = [(a, [e for e in row if e]) for a, row in zip(x, errors)]
        bands = [(a, min(row), np.median(row), max(row)) for a, row in known if row]
        if not bands:
            continue
        across, low, middle, high = np.array(bands).T
        axes.fill_between(across, low, high, color=f"C{k}", alpha=0.12, linewidth=0)
        (line,) = axes.plot(across, middle, color=f"C{k}", linewidth=1.2, zorder=2, label=label)
        line.set(marker="osD^v"[k % 5], markersize=4)
        if k == 0:
            line.set(linewidth=2.2, zorder=3)
    if note is not None:
        point, text = note[:2], note[2]
        arrow = {"arrowstyle": "-", "linewidth": 0.7}
        above = axes.annotate(text, point, (0, 22), textcoords="offset points", arrowprops=arrow)
        above.set(fontsize=8, ha="center")
    axes.set(xscale="log", yscale="log")
    # More labels between the powers of ten would overlap.
    axes.xaxis.set_minor_locator(ticker.LogLocator(subs=(2, 5)))
    _label(axes, xlabel, ylabel)


def programs(axes: Axes, marks: Mapping[str, Sequence[tuple[float, float]]], title: str) -> None:
    """Points of programs, both axes logarithmic.

    marks: (time of a call in ms, relative error) of each point, by program.
    """
    for name, points in marks.items():
        axes.plot(*zip(*points), marker="o", linestyle="none", markersize=8, label=name)
    axes.set(xscale="log", yscale="log", title=title)
    _label(axes, "time of a call (ms)", "error, relative")


def sigma_over_depth(axes: Axes, depths: np.ndarray, curves: Mapping[str, np.ndarray]) -> None:
    """Blur over the object distance: the first curve dotted and pale, the others solid.

    depths: (N,), m.
    curves: blur (N, 3) of R, G, B, by label, um.
    """
    for k, (label, sigma) in enumerate(curves.items()):
        for channel, colour in enumerate(("red", "green", "blue")):
            name = f"{colour[0].upper()}, {label}"
            (line,) = axes.plot(depths, sigma[:, channel], color=f"tab:{colour}", label=name)
            if k == 0:
                line.set(linestyle=":", alpha=0.6)
    axes.set_ylim(0, None)
    _label(axes, "object distance (m)", r"blur $\sigma$ (µm)", ncols=len(curves))


def patch_grid(
    rows: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str],
    notes: Mapping[str, Sequence[str]],
) -> Figure:
    """Images in labelled rows.

    rows: images (H, W, 3), 0 to 1, by label.
    notes: texts in the corners of the images, by label of the row.
    """
    figure, axes = new(len(rows), len(titles), 1.7, 1.75 + 0.3 / len(rows))
    axes = np.reshape(axes, (len(rows), len(titles)))
    box = {"facecolor": "white", "edgecolor": "none", "pad": 1.2}
    for line, (name, images) in zip(axes, rows.items()):
        line[0].set_ylabel(name)
        for ax, image in zip(line, images):
            ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
            ax.set(xticks=[], yticks=[])
        for ax, note in zip(line, notes.get(name, ())):
            ax.text(0.04, 0.96, note, transform=ax.transAxes, va="top", fontsize=8, bbox=box)
    for ax, title in zip(axes[0], titles):
        ax.set_title(title, fontsize=9)
    return figure


def growth(axes: Axes, series: Mapping[str, Sequence[tuple[float, float]]]) -> None:
    """Run time over numbers, both logarithmic, and a line of slope one.

    series: (number, time in s) of each point, by name of the number.
    """
    for name, points in series.items():
        number, seconds = np.asarray(points, float).T
        axes.loglog(number, 1e3 * seconds, marker="o", label=name)
    line = np.array(axes.get_xlim())
    slope = 1e3 * seconds[-1] / number[-1]
    axes.plot(line, slope * line, color="grey", linestyle=":", label="linear")
    axes.set_xlim(*line)
    _label(axes, "number", "run time (ms)")


def by_family(axes: Axes, samples: Mapping[str, np.ndarray], label: str, log: bool = False) -> None:
    """A box for each family from the first to the third quartile with the median, whiskers from
    the 1st to the 99th percentile, and the largest sample as a point.

    samples: (N,) by family.
    log: True for a logarithmic scale, without samples of 0.
    """
    shown = {name: np.asarray(values, float) for name, values in samples.items() if np.size(values)}
    if log:
        shown = {name: values[values > 0] for name, values in shown.items()}
        axes.set_xscale("log")
    axes.boxplot(
        list(shown.values()), orientation="horizontal", whis=(1, 99), showfliers=False, widths=0.6
    )
    for k, values in enumerate(shown.values()):
        if values.size:
            axes.plot(np.max(values), k + 1, marker=".", color="tab:red", linestyle="none")
    axes.set_yticks(range(1, len(shown) + 1), list(shown))
    axes.invert_yaxis()
    _label(axes, label, "", "x")


def shares(axes: Axes, rows: Mapping[str, Sequence[float]], names: Sequence[str]) -> None:
    """Stacked bars of fractions. rows: counts of `names` by label."""
    labels = list(rows)
    parts = np.array([rows[label] for label in labels], float)
    sums = np.cumsum(parts / np.maximum(parts.sum(axis=1, keepdims=True), 1), axis=1)
    for k, name in enumerate(names):
        begin = sums[:, k - 1] if k else 0.0
        axes.barh(labels, sums[:, k] - begin, left=begin, label=name)
    axes.invert_yaxis()
    above = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
    _label(axes, "share", "", ncols=len(names), **above)


def spots(
    axes: Axes, hits: Mapping[str, np.ndarray], covariance: np.ndarray, side: float, title: str
) -> None:
    """A spot, and the ellipse of one standard deviation.

    hits: (N, 2) about the centroid, by wavelength, um.
    covariance: (2, 2), um^2.
    side: side of the square shown, um.
    """
    for (label, points), colour in zip(hits.items(), FIELD_COLOURS * len(hits)):
        axes.plot(points[:, 0], points[:, 1], ".", markersize=2, color=colour, label=label)
    variances, directions = np.linalg.eigh(covariance)
    width, height = 2 * np.sqrt(np.maximum(variances, 0))
    angle = np.degrees(np.arctan2(directions[1, 0], directions[0, 0]))
    axes.add_patch(Ellipse((0, 0), width, height, angle=angle, fill=False, color="black"))
    axes.set(xlim=(-side / 2, side / 2), ylim=(-side / 2, side / 2), aspect="equal")
    axes.set_title(title, fontsize=9)
    axes.grid(alpha=0.3)


def merits(axes: Axes, history: np.ndarray) -> None:
    """Root of the merit (um) and violation of the worst limit over the trials. history: (T, 3),
    merit in mm^2, worst limit, Jacobians."""
    axes.semilogy(1e3 * np.sqrt(history[:, 0]), color="tab:blue")
    _label(axes, "trial", "root of the merit (um)")
    other = axes.twinx()
    other.plot(np.maximum(history[:, 1], 0), color="tab:red", linewidth=0.8)
    other.set_ylabel("worst limit exceeded by", color="tab:red")


def searching(axes: Axes, best: np.ndarray) -> None:
    """Root of the best merit of many starts, um. best: (T,), after each tile of searches, mm^2."""
    axes.semilogy(np.arange(1, len(best) + 1), 1e3 * np.sqrt(best), color="tab:blue")
    axes.set(xlabel="tiles of 16 searches, by stages", ylabel="root of the best merit (um)")
    axes.grid(alpha=0.3, which="both")


def ranks(axes: Axes, sizes: Sequence[float], found: Sequence[int]) -> None:
    """The distinct minima. sizes: roots of their merits, um. found: how often each was found."""
    axes.bar(range(1, len(sizes) + 1), sizes, color="tab:blue")
    for k, (size, often) in enumerate(zip(sizes, found), 1):
        axes.text(k, size, str(often), ha="center", va="bottom", fontsize=7)
    _label(axes, "minimum, and how many starts ended there", "root of the merit (um)", "y")


def offenders(
    axes: Axes, names: Sequence[str], series: Mapping[str, np.ndarray], xlabel: str
) -> None:
    """Groups of horizontal bars, the first on top.

    series: lengths (N,) by label; the first filled, the others as outlines.
    """
    places = np.arange(len(names))
    for k, (label, values) in enumerate(series.items()):
        outline: dict[str, Any] = {"fill": False, "edgecolor": f"C{k}"}
        fill = outline if k else {"color": "C0", "alpha": 0.7}
        axes.barh(places, values, height=0.8 - 0.25 * k, label=label, linewidth=1.4, **fill)
    axes.set_yticks(places, list(names), fontsize=8)
    axes.invert_yaxis()
    _label(axes, xlabel, "", "x")


def _style(k: int) -> dict[str, Any]:
    """The style of line k of those that may coincide; dots lie on top, in black."""
    if k % 3 == 2:
        return {"color": "black", "linestyle": ":", "linewidth": 2.2, "zorder": 4}
    return {"color": f"C{k}", "linestyle": ("-", "--")[k % 3], "linewidth": 1.5}


def yields(
    axes: Axes, curves: Mapping[str, tuple[np.ndarray, np.ndarray]], xlabel: str, ylabel: str
) -> None:
    """Shares of lenses over the limit that they meet; the first curve broad, the others thin.

    curves: (x (N,), shares (N,) in per cent) by label.
    """
    truth = {"color": "black", "alpha": 0.35, "linewidth": 4}
    for k, (label, (x, share)) in enumerate(curves.items()):
        axes.plot(x, share, label=label, **(_style(k) if k else truth))
    _label(axes, xlabel, ylabel)


def histogram(
    axes: Axes,
    edges: np.ndarray,
    shares: Mapping[str, np.ndarray],
    marks: Mapping[str, float],
    xlabel: str,
) -> None:
    """Shares of samples between edges.

    edges: (N + 1,).
    shares: (N,) by label, per cent; the first filled, the others as lines.
    marks: positions of vertical lines, by label.
    """
    fill = {"color": "black", "alpha": 0.2, "fill": True}
    for k, (label, values) in enumerate(shares.items()):
        axes.stairs(values, edges, label=label, **(_style(k) if k else fill))
    on_top = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points", "fontsize": 8}
    for k, (label, place) in enumerate(marks.items()):
        axes.axvline(place, color="black", linestyle="-.", linewidth=0.8)
        axes.annotate(label, (place, 1), (3, -10 - 11 * k), **on_top)
    _label(axes, xlabel, "share (%)", loc="center right")
