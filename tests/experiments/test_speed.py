"""What experiments on speed measure with. `test_starts` runs them."""

import numpy as np

from experiments import lenses


def test_a_step_is_seen():
    smooth = np.sin(np.linspace(0, 1, 200))
    stepped = smooth + (np.arange(200) > 90)
    assert lenses._roughness(smooth) < 1e-6 < 0.3 < lenses._roughness(stepped)
