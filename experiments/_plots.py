"""Plots of the experiments' results: arrays in, axes out."""

import contextlib
import pathlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from PIL import Image

from drt_jax import show

# Errors of images are drawn so many times as large.
GAIN = 4


@contextlib.contextmanager
def picture(
    path: pathlib.Path, width: float, height: float, count: int = 1, columns: int = 2
) -> Iterator[np.ndarray]:
    """Axes (count,) of a picture, which is written to a file at the end of the `with` block.

    width, height: of each panel, inches.
    count: number of panels.
    columns: number of panels side by side.
    """
    columns = min(columns, count)
    figure, axes = show.new(-(-count // columns), columns, width, height)
    for spare in np.ravel(axes)[count:]:
        spare.set_visible(False)
    yield np.ravel(axes)[:count]
    figure.savefig(path)


def label_axes(axes: Axes, xlabel: str, ylabel: str, grid: str = "both", **legend: Any) -> None:
    """Labels, a grid, and a legend where there are labelled lines."""
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3, axis=grid)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**{"fontsize": 8} | legend)


def curves(
    axes: Axes,
    series: Mapping[str, tuple[np.ndarray, np.ndarray]],
    xlabel: str,
    ylabel: str,
    level: tuple[float, str] | None = None,
    styles: Sequence[dict[str, Any]] = (),
) -> None:
    """Lines: (x (N,), y (N,)) by label.

    level: height and label of a horizontal line.
    styles: style of each line; by default thin lines, dashed from the 11th on.
    """
    thin = [{"linewidth": 1.1, "linestyle": "-" if k < 10 else "--"} for k in range(len(series))]
    for (label, (x, y)), style in zip(series.items(), styles or thin):
        axes.plot(x, y, label=label, **style)
    if level is not None:
        axes.axhline(level[0], color="black", linestyle=":", linewidth=1, label=level[1])
    label_axes(axes, xlabel, ylabel)


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
    label_axes(axes, xlabel, ylabel)


def programs(axes: Axes, curves: Mapping[tuple[str, str], Sequence[dict]], title: str) -> None:
    """Error over time of a call, both logarithmic, with bars from the first to the third
    quartile. The first program has a thick line; each of the others a colour of its own.

    curves: rows with `quartiles_s` and `error`, by program and sampling.
    """
    colours = {name: f"C{k}" for k, name in enumerate(dict.fromkeys(name for name, _ in curves))}
    for k, ((program, sampling), rows) in enumerate(curves.items()):
        low, middle, high = 1e3 * np.array([row["quartiles_s"] for row in rows]).T
        errors = [max(row["error"], 1e-16) for row in rows]
        style = {"color": colours[program], "marker": "osD^vP*X"[k % 8], "markersize": 5}
        style |= {"linewidth": 1.0 if k else 2.4, "linestyle": "--" if "stop" in sampling else "-"}
        bars = np.stack([middle - low, high - middle])
        axes.errorbar(middle, errors, xerr=bars, label=f"{program}: {sampling}", **style)
    axes.set(xscale="log", yscale="log", title=title)
    label_axes(axes, "time of a call (ms)", "error", fontsize=7, loc="upper center",
               bbox_to_anchor=(0.5, -0.14), ncols=2)  # fmt: skip


def shares_solved(axes: Axes, ratios: Mapping[str, np.ndarray], tolerance: float) -> None:
    """A performance profile: the share of scenes that each program solves within x times the time
    of the fastest. ratios: (N,) of N scenes by program, inf where it does not."""
    for k, (program, own) in enumerate(ratios.items()):
        done = np.sort(own[np.isfinite(own)])
        across = np.concatenate([[1.0], done, [1e4]])
        share = np.append(np.arange(len(done) + 1), len(done)) / len(own)
        axes.step(across, share, where="post", linewidth=1.2 if k else 2.4, label=program)
    count = max(map(len, ratios.values()), default=0)
    title = f"error of the spot below {tolerance:.0e} ({count} scenes)"
    axes.set(xscale="log", xlim=(0.9, 1e4), ylim=(-0.02, 1.02), title=title)
    label_axes(axes, "time / that of the fastest", "share of scenes solved", loc="center right")


def patch_grid(
    path: pathlib.Path,
    titles: Sequence[str],
    truth: np.ndarray,
    images: Mapping[str, np.ndarray],
    errors: Mapping[str, np.ndarray],
) -> None:
    """A picture of patches in labelled rows, each with its root mean square error.

    titles: of the columns.
    truth: true images (N, H, W, 3), 0 to 1, of which the first row shows as many as titles.
    images: other images by label.
    errors: images by label of which only the error is shown, `GAIN` times, on grey.
    """
    rows = {"truth": truth, **images}
    rows |= {name: 0.5 + GAIN * (image - truth) for name, image in errors.items()}
    size, box = (len(rows), len(titles)), {"facecolor": "white", "edgecolor": "none", "pad": 1.2}
    with picture(path, 1.7, 1.75 + 0.3 / size[0], size[0] * size[1], size[1]) as axes:
        axes = np.reshape(axes, size)
        for line, (name, shown) in zip(axes, rows.items()):
            line[0].set_ylabel(name)
            for ax, image in zip(line, shown):
                ax.imshow(np.clip(image, 0, 1), interpolation="nearest")
                ax.set(xticks=[], yticks=[])
        for line, image in zip(axes[1:], (*images.values(), *errors.values())):
            for ax, error in zip(line, image - truth):
                note = f"{np.sqrt(np.mean(error**2)):.3f}"
                ax.text(0.04, 0.96, note, transform=ax.transAxes, va="top", fontsize=8, bbox=box)
        for ax, title in zip(axes[0], titles):
            ax.set_title(title, fontsize=9)


def photographs(
    path: pathlib.Path, folder: pathlib.Path, titles: Mapping[str, str], size: tuple[float, float]
) -> None:
    """A picture of the .png files of a folder side by side. titles: by name of the file. size:
    width and height of each, inches."""
    with picture(path, *size, len(titles), len(titles)) as axes:
        for ax, (name, title) in zip(axes, titles.items()):
            pixels = np.asarray(Image.open(folder / f"{name}.png"))
            ax.imshow(pixels, interpolation="antialiased")
            ax.set(xticks=[], yticks=[], title=title)


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
    label_axes(axes, "number", "run time (ms)")


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
    label_axes(axes, label, "", "x")


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
    label_axes(axes, "share", "", ncols=len(names), **above)
