"""Both ways of every skip agree with the reference, and therefore with each other."""

import functools

import numpy as np
import pytest

from experiments import _skips, skips

# Not tested here, because they take long to compile: new processes and kernels.
UNTESTED = "kept", "polynomials", "kernels"
# Largest error of each way, with the skip and without it; that of random rays is statistical.
BOUNDS = {name: (1e-6, 1e-6) for name in skips.SKIPS} | {
    "quadrature": (1e-6, 0.2),
    "separable": (1e-5, 1e-5),
}


@functools.cache
def config():
    return skips.Config(
        **{"lens": "singlet", "field_deg": 2.0, "wavelengths_um": (0.55,), "generous": 12},
        **{"random": 256, "rays": 4096, "planes": 2, "picture": 3, "nodes": 2, "repeats": 1},
    )


def test_a_dead_surface_gets_a_name_of_its_own_and_no_other_index():
    lens = _skips.with_planes(_skips.drt_jax.load_lens("double_gauss"), 3)
    traced = _skips.all_traced(lens)
    assert (len(lens.active), len(traced.active)) == (10, lens.count) and lens.count == 14
    assert np.array_equal(lens.index([0.5]), traced.index([0.5]))
    assert float(lens.vertices[-2]) < float(lens.sensor) == float(traced.sensor)


def test_a_row_that_is_not_known_is_refused():
    with pytest.raises(ValueError, match="rows: unknown 'speed'; known: rotational, "):
        skips.Config(rows=("speed",))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in skips.SKIPS if name not in UNTESTED])
def test_both_ways_of_a_skip_are_right(name):
    row = skips.measure(config(), skips.SKIPS[name])
    for way, bound in zip(row["ways"], BOUNDS[name], strict=True):
        assert way["error"] < bound, way
    assert row["factor"] > 0
