"""Figures of tolerances, by the numbers on their axes."""

import numpy as np
import pytest

from drt_jax import design, show
from drt_jax.design.perturbed import Deviation


def test_bars_are_the_worse_signs_largest_first():
    deviations = (
        Deviation("thickness", 1, 0),
        Deviation("decentre", 0, 1),
        Deviation("radius", 2, 0),
    )
    before = 1e-3 * np.array([[1.0, -1.0], [3.0, 3.0], [90.0, 80.0]])
    after = 1e-3 * np.array([[1.0, -1.0], [2.0, 3.0], [np.inf, 1.0]])
    arrays = np.array([0.3, 0.4, 0.1]), before, after, np.zeros((3, 2, 0))
    table = design.Sensitivity("spot", "um", 1e3, 5e-3, 0.0, deviations, *arrays, (), "rays")
    _, axes = show.new()
    show.sensitivity(axes, table)
    held, bars = ([bar.get_width() for bar in group] for group in axes.containers)
    assert bars == pytest.approx([6, 3, 1]) and held == pytest.approx([6, 3, 1])
    names = [tick.get_text() for tick in axes.get_yticklabels()]
    assert (
        names[0] == "radius of surface 2: 0.1 %" and names[1] == "decentre of element 0, y: 0.4 mm"
    )
    assert axes.get_xlabel() == "spot: worse by (um)"


def test_yields_count_failed_lenses():
    _, axes = show.new()
    show.yields(axes, {"mtf": [0.5, -np.inf, 0.7, 0.6]}, "MTF", target=1)
    x, y = axes.lines[0].get_data()
    np.testing.assert_allclose(x, [0.7, 0.6, 0.5])
    np.testing.assert_allclose(y, [25, 50, 75])
