"""Figures: arrays in, axes out. The only module that imports matplotlib."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = [
    "by_family",
    "convergence",
    "error_curves",
    "growth",
    "kernels",
    "lens_drawing",
    "new",
    "patch_grid",
    "programs",
    "sigma_over_depth",
]

_FIELDS = ("tab:blue", "tab:green", "tab:red", "tab:purple", "tab:orange")
_COLOURS = ("tab:red", "tab:green", "tab:blue")


def new(
    rows: int = 1, columns: int = 1, width: float = 6.0, height: float = 4.0
) -> tuple[Figure, Any]:
    """A figure and its axes, `width` x `height` inches for each panel. Made without pyplot, so
    that no window opens and no global state changes; write it with `figure.savefig(path)`."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained", dpi=150)
    return figure, figure.subplots(rows, columns)


def lens_drawing(
    axes: Axes,
    glass: Sequence[np.ndarray],
    mirrors: Sequence[np.ndarray],
    stop: Sequence[np.ndarray],
    sensor: np.ndarray,
    rays: Sequence[Sequence[np.ndarray]],
) -> Axes:
    """A lens in section, from the polylines (N, 2) of (z, y) in mm of `drawing.draw`."""
    for outline in glass:
        axes.fill(*outline.T, facecolor="#cfe4f5", edgecolor="#30506b", linewidth=0.8)
    for mirror in mirrors:
        axes.plot(*mirror.T, color="#30506b", linewidth=2)
    for blade in stop:
        axes.plot(*blade.T, color="black", linewidth=2.5, solid_capstyle="butt")
    for fan, colour in zip(rays, _FIELDS * len(rays)):
        for ray in fan:
            axes.plot(*ray.T, color=colour, linewidth=0.6)
    axes.plot(*sensor.T, color="black", linewidth=1.5)
    axes.set_aspect("equal")
    axes.set(xlabel="z from the first vertex (mm)", ylabel="y (mm)")
    return axes


def convergence(
    axes: Axes,
    traces: Mapping[str, tuple[np.ndarray, np.ndarray]],
    ylabel: str,
    level: tuple[float, str] | None = None,
) -> Axes:
    """Lines (x, y) by label over training batches; `level`: a horizontal mark and its label."""
    for label, (x, y) in traces.items():
        axes.plot(x, y, linewidth=1.1, label=label)
    if level is not None:
        axes.axhline(level[0], color="black", linestyle=":", linewidth=1, label=level[1])
    axes.set(xlabel="training batch", ylabel=ylabel)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return axes


def error_curves(
    axes: Axes,
    curves: Mapping[str, tuple[Sequence[float], Sequence[Sequence[float]]]],
    xlabel: str,
    ylabel: str,
    note: tuple[float, float, str] | None = None,
) -> Axes:
    """Errors by label over cost, both logarithmic: (x (N,), errors (N, M) of M scenes).

    The line is the median of the scenes, the band goes from the best to the worst; errors that
    are not known (None) or 0 are left out. `note`: x, y and a text that points there.
    """
    for k, (label, (x, errors)) in enumerate(curves.items()):
        known = [[e for e in row if e] for row in errors]
        rows = [(a, min(row), float(np.median(row)), max(row)) for a, row in zip(x, known) if row]
        if not rows:
            continue
        across, low, middle, high = zip(*rows)
        colour = f"C{k}"
        axes.fill_between(across, low, high, color=colour, alpha=0.12, linewidth=0)
        axes.plot(
            across,
            middle,
            color=colour,
            marker="osD^v"[k % 5],
            markersize=4,
            linewidth=2.2 if k == 0 else 1.2,
            label=label,
            zorder=3 if k == 0 else 2,
        )
    if note is not None:
        axes.annotate(
            note[2],
            note[:2],
            xytext=(0, 22),
            textcoords="offset points",
            fontsize=8,
            ha="center",
            arrowprops={"arrowstyle": "-", "linewidth": 0.7},
        )
    axes.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    # Over less than a decade or so, labels between the powers of ten would overlap.
    axes.xaxis.set_minor_locator(ticker.LogLocator(subs=(2, 5)))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return axes


def programs(axes: Axes, marks: Mapping[str, Sequence[tuple[float, float]]], title: str) -> Axes:
    """Points (time of a call in ms, relative error) by program, both axes logarithmic."""
    for name, points in marks.items():
        axes.plot(*zip(*points), marker="o", linestyle="none", markersize=8, label=name)
    axes.set(xscale="log", yscale="log", title=title)
    axes.set(xlabel="time of a call (ms)", ylabel="error, relative")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return axes


def sigma_over_depth(
    axes: Axes,
    depths: np.ndarray,
    curves: Mapping[str, np.ndarray],
) -> Axes:
    """Blur (N, 3) in um of R, G, B over `depths` (N,) in m: the first curve dotted and pale,
    the others solid."""
    for k, (label, sigma) in enumerate(curves.items()):
        for channel, colour in enumerate(_COLOURS):
            axes.plot(
                depths,
                sigma[:, channel],
                color=colour,
                linestyle=":" if k == 0 else "-",
                alpha=0.6 if k == 0 else 1.0,
                label=f"{'RGB'[channel]}, {label}",
            )
    axes.set(xlabel="object distance (m)", ylabel=r"blur $\sigma$ (µm)", ylim=(0, None))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, ncols=len(curves))
    return axes


def patch_grid(
    rows: Mapping[str, Sequence[np.ndarray]],
    titles: Sequence[str],
    notes: Mapping[str, Sequence[str]],
) -> Figure:
    """Images (H, W, 3), 0 to 1, in labelled rows; `notes` stand in the corner of an image."""
    size = 1.7 * len(titles), 1.75 * len(rows) + 0.3
    figure = Figure(figsize=size, layout="constrained", dpi=150)
    axes = figure.subplots(len(rows), len(titles), squeeze=False)
    for line, (name, images) in zip(axes, rows.items()):
        line[0].set_ylabel(name)
        for k, (ax, image) in enumerate(zip(line, images)):
            ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
            ax.set(xticks=[], yticks=[])
            if name in notes:
                ax.text(
                    0.04,
                    0.96,
                    notes[name][k],
                    transform=ax.transAxes,
                    va="top",
                    fontsize=8,
                    bbox={"facecolor": "white", "edgecolor": "none", "pad": 1.2},
                )
    for ax, title in zip(axes[0], titles):
        ax.set_title(title, fontsize=9)
    return figure


def kernels(axes: Sequence[Axes], kernel: np.ndarray, titles: Sequence[str]) -> Sequence[Axes]:
    """PSF kernels (C, K, K), one an axis, on a common scale."""
    for ax, values, title in zip(axes, kernel, titles):
        ax.imshow(values, vmin=0, vmax=np.max(kernel), cmap="magma", origin="lower")
        ax.set_title(title, fontsize=9)
        ax.set(xlabel="x (pixels)", ylabel="y (pixels)")
    return axes


def growth(axes: Axes, series: Mapping[str, Sequence[tuple[float, float]]]) -> Axes:
    """Run time (s) against the number of each kind of thing, both logarithmic, and a line of
    slope one."""
    for name, points in series.items():
        number, seconds = np.asarray(points, float).T
        axes.loglog(number, 1e3 * seconds, marker="o", label=name)
    low, high = axes.get_xlim()
    number, seconds = np.asarray(points, float)[-1]
    line = np.array([low, high])
    axes.plot(line, 1e3 * seconds * line / number, color="grey", linestyle=":", label="linear")
    axes.set(xlabel="number", ylabel="run time (ms)", xlim=(low, high))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return axes


def by_family(axes: Axes, samples: Mapping[str, np.ndarray], label: str, log: bool = False) -> Axes:
    """Samples (N,) of each family as a box from the first to the third quartile with its median,
    whiskers from the 1st to the 99th percentile, and the largest as a point; on a logarithmic
    scale if `log`, which leaves out samples of 0."""
    names = [name for name, values in samples.items() if np.size(values)]
    shown = [np.asarray(samples[name], float) for name in names]
    shown = [values[values > 0] if log else values for values in shown]
    axes.boxplot(shown, orientation="horizontal", whis=(1, 99), showfliers=False, widths=0.6)
    for k, values in enumerate(shown):
        if values.size:
            axes.plot(np.max(values), k + 1, marker=".", color="tab:red", linestyle="none")
    axes.set_yticks(range(1, len(names) + 1), names)
    axes.invert_yaxis()
    if log:
        axes.set_xscale("log")
    axes.set_xlabel(label)
    axes.grid(axis="x", alpha=0.3)
    return axes
