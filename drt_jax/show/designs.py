"""Pictures of a design: its spots, how its merit fell, its minima."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Ellipse

_COLOURS = ("tab:blue", "tab:green", "tab:red", "tab:purple", "tab:orange")


def spots(
    axes: Axes, hits: Mapping[str, np.ndarray], covariance: np.ndarray, side: float, title: str
) -> Axes:
    """A spot: hits (N, 2) in um about the centroid by colour, and the ellipse of one standard
    deviation of `covariance` (2, 2), um^2. side: of the square shown, um."""
    for (label, points), colour in zip(hits.items(), _COLOURS * len(hits)):
        axes.plot(points[:, 0], points[:, 1], ".", markersize=2, color=colour, label=label)
    sizes, turned = np.linalg.eigh(covariance)
    width, height = 2 * np.sqrt(np.maximum(sizes, 0))
    angle = np.degrees(np.arctan2(turned[1, 0], turned[0, 0]))
    axes.add_patch(Ellipse((0, 0), width, height, angle=angle, fill=False, color="black"))
    axes.set(xlim=(-side / 2, side / 2), ylim=(-side / 2, side / 2), aspect="equal")
    axes.set_title(title, fontsize=9)
    axes.grid(alpha=0.3)
    return axes


def merits(axes: Axes, history: np.ndarray) -> Axes:
    """How the root of the merit (um) fell over the trials, and by how much limits were exceeded;
    history (T, 3): merit in mm^2, worst limit, Jacobians."""
    axes.semilogy(1e3 * np.sqrt(history[:, 0]), color="tab:blue")
    axes.set(xlabel="trial", ylabel="root of the merit (um)")
    axes.grid(alpha=0.3)
    other = axes.twinx()
    other.plot(np.maximum(history[:, 1], 0), color="tab:red", linewidth=0.8)
    other.set_ylabel("worst limit exceeded by", color="tab:red")
    return axes


def searching(axes: Axes, best: np.ndarray) -> Axes:
    """How the root of the best merit (um) of many starts fell; best (T,): in mm^2, after each tile
    of searches."""
    axes.semilogy(np.arange(1, len(best) + 1), 1e3 * np.sqrt(best), color="tab:blue")
    axes.set(xlabel="tiles of 16 searches, by stages", ylabel="root of the best merit (um)")
    axes.grid(alpha=0.3, which="both")
    return axes


def ranks(axes: Axes, sizes: Sequence[float], found: Sequence[int]) -> Axes:
    """The distinct minima: the root of the merit (um) of each, and how often it was found."""
    axes.bar(range(1, len(sizes) + 1), sizes, color="tab:blue")
    for k, (size, often) in enumerate(zip(sizes, found), 1):
        axes.text(k, size, str(often), ha="center", va="bottom", fontsize=7)
    axes.set(xlabel="minimum, and how many starts ended there", ylabel="root of the merit (um)")
    axes.grid(alpha=0.3, axis="y")
    return axes
