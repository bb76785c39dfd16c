"""New figures, and plots of PSF kernels."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# Colours of the fields, in the order of the fields; none of them is one of the wavelengths, blue to
# green to red (`analyses.colours`), so that a colour means one thing on a page.
FIELD_COLOURS = ("tab:orange", "tab:purple", "deeppink", "gold", "tab:cyan")


class _Figure(Figure):
    """A figure that a notebook can show."""

    def _repr_png_(self) -> bytes:
        written = io.BytesIO()
        self.savefig(written, format="png")
        return written.getvalue()


def new(
    rows: int = 1, columns: int = 1, width: float = 6.0, height: float = 4.0
) -> tuple[Figure, Any]:
    """A figure and its array of axes (rows, columns), without dimensions of length 1.

    width, height: of each panel, in inches.

    It is made without pyplot: no window opens and no global state changes. Write it with
    `figure.savefig(path)`. A notebook shows it if it is the last line of a cell.
    """
    figure = _Figure(figsize=(width * columns, height * rows), layout="constrained", dpi=150)
    return figure, figure.subplots(rows, columns)


def kernels(axes: Sequence[Axes], kernel: np.ndarray, titles: Sequence[str]) -> Sequence[Axes]:
    """PSF kernels on a common scale.

    axes: one for each channel.
    kernel: (C, K, K).
    titles: one for each channel.
    """
    for ax, values, title in zip(axes, kernel, titles):
        ax.imshow(values, vmin=0, vmax=np.max(kernel), cmap="magma", origin="lower")
        ax.set_title(title, fontsize=9)
        ax.set(xlabel="x (pixels)", ylabel="y (pixels)")
    return axes


# First digits of scales.
_DIGITS = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)


def rounded_up(values: ArrayLike, digits: Sequence[float] = _DIGITS) -> float:
    """The largest modulus of values, those that are not finite left out, rounded up to one of the
    first digits, the last of them 10; 1 for none."""
    sizes = np.abs(np.asarray(values, float))
    most = np.max(sizes, initial=0.0, where=np.isfinite(sizes)) or 1.0
    power = 10.0 ** np.floor(np.log10(most))
    return float(power * next(step for step in digits if step * power >= most))


def scale_bar(axes: Axes, unit: str) -> Axes:
    """A bar of a fifth of the width of axes or less, at their lower left, with its length."""
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    length = rounded_up(0.08 * (right - left), (1, 2, 5, 10))
    start, height = left + 0.04 * (right - left), low + 0.04 * (high - low)
    axes.plot([start, start + length], [height, height], color="black", linewidth=2)
    axes.text(start, height + 0.02 * (high - low), f"{length:g} {unit}", fontsize=7, va="bottom")
    axes.set(xlim=(left, right), ylim=(low, high))
    return axes
