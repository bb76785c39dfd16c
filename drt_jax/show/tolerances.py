"""Plots of tolerances: the effect of each error, and the yield over a level of the criterion."""

from collections.abc import Mapping

import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes

from ..design import Sensitivity
from ..design.deviations import KINDS

_LARGEST = 2.0  # bars are cut at this many times the largest change after compensation


def sensitivity(axes: Axes, table: Sensitivity, count: int = 14) -> Axes:
    """Bars of the errors that change a criterion most after compensation, the largest first, for
    the worse sign. Pale bars behind them are the changes without compensation, cut if too long.

    count: largest number of errors.
    """
    some = table.worst(count)
    held = some._replace(after=some.before).growth * some.factor
    after = some.growth * some.factor
    names = [
        f"{one}: {size:.3g} {KINDS[one.kind].unit}".strip()
        for one, size in zip(some.deviations, some.sizes)
    ]
    finite = after[np.isfinite(after)]
    most = _LARGEST * float(np.max(np.abs(finite), initial=0)) or 1.0
    axes.barh(names, np.minimum(held, most), 0.8, color="0.8", label="before")
    axes.barh(names, np.minimum(after, most), 0.5, color="tab:blue", label="after compensation")
    for k in np.flatnonzero(held > most).tolist():
        words = f"{held[k]:.3g}" if np.isfinite(held[k]) else "fails"
        axes.text(most, k, words, ha="right", va="center", fontsize=6, color="0.3")
    axes.set_xlim(min(0.0, 1.05 * float(np.min(finite, initial=0))), 1.02 * most)
    axes.tick_params("y", labelsize=7)
    axes.invert_yaxis()  # the largest on top
    unit = f" ({some.unit})" if some.unit else ""
    axes.set(xlabel=f"{some.criterion}: worse by{unit}")
    axes.legend(fontsize=7, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1), ncols=2)
    return axes


def yields(axes: Axes, values: Mapping[str, ArrayLike], label: str, target: float = 0) -> Axes:
    """Share of lenses, per cent, that are at least as good as each value of a criterion.

    values: for each name of a curve the values (K,) of lenses as built, in the unit of the plot.
        Lenses that fail, with infinite values, count as worse than all others.
    label: what the values are, with their unit.
    target: target of the criterion; a lens is better if its criterion is nearer to it.
    """
    for name, given in values.items():
        each = np.ravel(np.asarray(given, float))
        each = each[np.argsort(np.abs(each - target), kind="stable")]
        share = 100 * np.arange(1, each.size + 1) / each.size
        whole = np.isfinite(each)
        axes.step(each[whole], share[whole], where="post", label=name)
    axes.set(ylim=(0, 102), xlabel=label, ylabel="lenses at least so good (%)")
    axes.grid(alpha=0.3)
    if len(values) > 1:
        axes.legend(fontsize=7, frameon=False)
    return axes
