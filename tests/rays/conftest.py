"""Listings of other programs, for the tests that compare with them."""

import pytest
import yaml


@pytest.fixture
def cases(shared):
    files = ("reference_cases.yaml", "psf_cases.yaml")
    rows = [row for name in files for row in yaml.safe_load((shared / name).read_text())["cases"]]
    return {case["id"].split("_")[0]: case for case in rows}
