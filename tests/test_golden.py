"""Some results of golden.json in CI; `python -m tests.golden` compares all of them."""

import json

import pytest

from . import golden

QUICK = ("first_order", "third_order", "rays", "image_point")


def test_what_is_kept_is_what_is_asked():
    kept = json.loads(golden.FILE.read_text())
    assert {"double_gauss"} <= kept.keys() <= golden.SCENES.keys()
    for scene, numbers in kept.items():
        named = {name.split("']")[0].removeprefix("['") for name in numbers}
        own = golden.analyses(scene).keys()
        assert named == own | {f"d {name}" for name in golden.SLOPES}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the sensor")
def test_a_moved_house_computes_what_it_did():
    """Within rounding, which differs between processors."""
    apart = golden.differences("double_gauss", QUICK.__contains__)
    assert all(size < 1e-10 for size in apart.values()), apart
