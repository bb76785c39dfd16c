"""Model glasses, glasses that a file defines, and a patent lens with such glasses."""

import jax
import numpy as np
import pytest

from drt_jax import first_order, load_lens
from drt_jax.files.written import medium_of


@pytest.mark.parametrize(
    "entry", [{"nd": 1.835, "vd": 42.7}, {"glass": 835427}, {"glass": "835427"}]
)
def test_model_glasses(entry):
    """By nd and vd as in patents, and by a code; a surface between two equal media does not
    refract."""
    rows = [
        {"radius": 50.0, "thickness": 4.0, **entry},
        {"radius": "inf", "thickness": 2.0, **entry},
        {"radius": "inf", "thickness": 50.0, "stop": True, "semi_diameter": 5.0},
    ]
    lens = load_lens({"surfaces": rows})
    assert lens.active == (0, 2)
    np.testing.assert_allclose(lens.index([0.5875618])[1:3, 0], 1.835, rtol=1e-12)
    with pytest.raises(ValueError, match="2 um is outside the range of model 1.835 42.7"):
        lens.index([2.0])


def test_glasses_of_the_file():
    """They take precedence over the catalogue and have a range; n^2 is the sum of both formulas."""
    rows = [
        {"radius": 50.0, "thickness": 4.0, "glass": "SK16"},
        {"radius": "inf", "thickness": 50.0, "stop": True, "semi_diameter": 5.0},
    ]
    one = {"sellmeier": [1.1, 0.2, 0.01, 90.0], "schott": [1.3, 0, 0.02, 0, 0, 0]}
    lens = load_lens({"glasses": {"SK16": one | {"range": [0.5, 0.6]}}, "surfaces": rows})
    n2 = 1.3 + 0.02 / 0.55**2 + 1.1 * 0.55**2 / (0.55**2 - 0.01) + 0.2 * 0.55**2 / (0.55**2 - 90)
    np.testing.assert_allclose(lens.index([0.55])[1, 0], n2**0.5, rtol=1e-14)
    with pytest.raises(ValueError, match="0.45 um is outside the range of SK16, 0.5 to 0.6 um"):
        lens.index([0.45])
    plain = load_lens({"glasses": {"mine": one}, "surfaces": rows})
    assert plain.glasses[1] == "SK16" and plain.dispersion.range == (0.4, 0.7)
    rows[0]["glass"] = "mine"
    assert load_lens({"glasses": {"mine": one}, "surfaces": rows}).dispersion.range == (
        0.365,
        1.014,
    )


def test_air_has_no_name_in_a_file_of_float32_either():
    lens = load_lens("singlet")
    single = jax.tree.map(lambda a: a.astype(np.float32), lens)
    assert [medium_of(own, i) for own in (lens, single) for i in (0, lens.count)] == [{}] * 4


def test_the_patent_lens(shared):
    """US 2021/0263286, example 1, as printed, has the focal length of the patent."""
    lens = load_lens(shared / "patent_rf50.yaml")
    focal = first_order(lens, np.inf, [0.5875618]).focal_length
    np.testing.assert_allclose(focal, 49.565, atol=5e-3)
