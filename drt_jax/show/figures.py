"""Curves, kernels and patches: arrays in, axes out."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure


class _Figure(Figure):
    """A figure that a notebook can show."""

    def _repr_png_(self) -> bytes:
        written = io.BytesIO()
        self.savefig(written, format="png")
        return written.getvalue()


def new(
    rows: int = 1, columns: int = 1, width: float = 6.0, height: float = 4.0
) -> tuple[Figure, Any]:
    """A figure and its axes (rows, columns), without those that are 1.

    width, height: of each panel, in inches.

    Made without pyplot, so that no window opens and no global state changes; write it with
    `figure.savefig(path)`. A notebook shows it where it is the last line of a cell.
    """
    figure = _Figure(figsize=(width * columns, height * rows), layout="constrained", dpi=150)
    return figure, figure.subplots(rows, columns)


def _finished(axes: Axes, xlabel: str, ylabel: str, columns: int = 1) -> Axes:
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=columns)
    return axes


def convergence(
    axes: Axes,
    traces: Mapping[str, tuple[np.ndarray, np.ndarray]],
    ylabel: str,
    level: tuple[float, str] | None = None,
) -> Axes:
    """Lines over training batches.

    traces: (x (N,), y (N,)) by label.
    level: a horizontal mark and its label.
    """
    for label, (x, y) in traces.items():
        axes.plot(x, y, linewidth=1.1, label=label)
    if level is not None:
        axes.axhline(level[0], color="black", linestyle=":", linewidth=1, label=level[1])
    return _finished(axes, "training batch", ylabel)


def curves(
    axes: Axes, series: Mapping[str, tuple[np.ndarray, np.ndarray]], xlabel: str, ylabel: str
) -> Axes:
    """Lines: (x (N,), y (N,)) by label."""
    for k, (label, (x, y)) in enumerate(series.items()):
        axes.plot(x, y, linewidth=1.1, linestyle="-" if k < 10 else "--", label=label)
    return _finished(axes, xlabel, ylabel)


def error_curves(
    axes: Axes,
    curves: Mapping[str, tuple[Sequence[float], Sequence[Sequence[float | None]]]],
    xlabel: str,
    ylabel: str,
    note: tuple[float, float, str] | None = None,
) -> Axes:
    """Errors over cost, both logarithmic: the median of the scenes as a line, and a band from the
    best to the worst.

    curves: (x (N,), errors (N, M) of M scenes) by label; errors that are not known (None) or 0
        are left out.
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
    # Over less than a decade or so, labels between the powers of ten would overlap.
    axes.xaxis.set_minor_locator(ticker.LogLocator(subs=(2, 5)))
    return _finished(axes, xlabel, ylabel)


def programs(axes: Axes, marks: Mapping[str, Sequence[tuple[float, float]]], title: str) -> Axes:
    """Points of programs, both axes logarithmic.

    marks: (time of a call in ms, relative error) of each point, by program.
    """
    for name, points in marks.items():
        axes.plot(*zip(*points), marker="o", linestyle="none", markersize=8, label=name)
    axes.set(xscale="log", yscale="log", title=title)
    return _finished(axes, "time of a call (ms)", "error, relative")


def sigma_over_depth(axes: Axes, depths: np.ndarray, curves: Mapping[str, np.ndarray]) -> Axes:
    """Blur over the object distance: the first curve dotted and pale, the others solid.

    depths: (N,) in m.
    curves: blur (N, 3) in um of R, G, B, by label.
    """
    for k, (label, sigma) in enumerate(curves.items()):
        for channel, colour in enumerate(("red", "green", "blue")):
            name = f"{colour[0].upper()}, {label}"
            (line,) = axes.plot(depths, sigma[:, channel], color=f"tab:{colour}", label=name)
            if k == 0:
                line.set(linestyle=":", alpha=0.6)
    axes.set_ylim(0, None)
    return _finished(axes, "object distance (m)", r"blur $\sigma$ (µm)", len(curves))


def patch_grid(
    rows: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str],
    notes: Mapping[str, Sequence[str]],
) -> Figure:
    """Images in labelled rows.

    rows: images (H, W, 3), 0 to 1, by label.
    titles: of the columns.
    notes: texts for the corners of the images, by the label of their row.
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


def kernels(axes: Sequence[Axes], kernel: np.ndarray, titles: Sequence[str]) -> Sequence[Axes]:
    """PSF kernels on a common scale.

    axes: one for each channel.
    kernel: (C, K, K).
    titles: of the channels.
    """
    for ax, values, title in zip(axes, kernel, titles):
        ax.imshow(values, vmin=0, vmax=np.max(kernel), cmap="magma", origin="lower")
        ax.set_title(title, fontsize=9)
        ax.set(xlabel="x (pixels)", ylabel="y (pixels)")
    return axes


def growth(axes: Axes, series: Mapping[str, Sequence[tuple[float, float]]]) -> Axes:
    """Run time against a number of things, both logarithmic, and a line of slope one.

    series: (number, time in s) of each point, by what is counted.
    """
    for name, points in series.items():
        number, seconds = np.asarray(points, float).T
        axes.loglog(number, 1e3 * seconds, marker="o", label=name)
    line = np.array(axes.get_xlim())
    slope = 1e3 * seconds[-1] / number[-1]
    axes.plot(line, slope * line, color="grey", linestyle=":", label="linear")
    axes.set_xlim(*line)
    return _finished(axes, "number", "run time (ms)")


def by_family(axes: Axes, samples: Mapping[str, np.ndarray], label: str, log: bool = False) -> Axes:
    """A box for each family, from the first to the third quartile with its median, whiskers from
    the 1st to the 99th percentile, and the largest sample as a point.

    samples: (N,) by family.
    label: of the axis.
    log: a logarithmic scale, which leaves out samples of 0.
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
    axes.set_xlabel(label)
    axes.grid(axis="x", alpha=0.3)
    return axes


def shares(axes: Axes, rows: Mapping[str, Sequence[float]], names: Sequence[str]) -> Axes:
    """Bars of what parts of each row come to: the numbers of `names` by label, as shares."""
    labels = list(rows)
    parts = np.array([rows[label] for label in labels], float)
    ends = np.cumsum(parts / np.maximum(parts.sum(axis=1, keepdims=True), 1), axis=1)
    for k, name in enumerate(names):
        begin = ends[:, k - 1] if k else 0.0
        axes.barh(labels, ends[:, k] - begin, left=begin, label=name)
    axes.invert_yaxis()
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=len(names), loc="lower center", bbox_to_anchor=(0.5, 1.0))
    axes.set(xlabel="share")
    return axes
