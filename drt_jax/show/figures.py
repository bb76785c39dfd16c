"""New figures, and plots of PSF kernels."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
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
