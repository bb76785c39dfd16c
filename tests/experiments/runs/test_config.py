import dataclasses
import functools
from typing import Annotated, Literal

import pytest

from experiments._common import different, not_empty, odd, or_zero, within
from experiments.runs.config import ConfigError, describe, dump_config, load_config


@dataclasses.dataclass(frozen=True)
class Inner:
    batch: int = 16
    rate: float = 1e-3
    form: Literal["integrated", "sampled"] = "integrated"


@dataclasses.dataclass(frozen=True)
class Config:
    starts: tuple[float, ...]
    name: str = "x"
    fast: bool = False
    train: Inner = Inner()
    at: float | None = None


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "some.yaml"
    path.write_text("starts: [130, 1.5e2]\ntrain: {rate: 1e-4}\n")
    return path


def test_yaml_overrides_and_round_trip(path, tmp_path):
    config = load_config(
        Config, path, ["train.batch=8", "starts=[1]", "fast=true", "train={form: sampled}"]
    )
    assert config == Config((1.0,), "x", True, Inner(8, 1e-4, "sampled"), None)
    assert load_config(Config, path, ["at=2"]).at == 2.0
    assert isinstance(config.starts[0], float)
    (tmp_path / "resolved.yaml").write_text(dump_config(config))
    assert load_config(Config, tmp_path / "resolved.yaml") == config


BAD = {
    "train.bacth=8": r"--set train.bacth=8: unknown key train.bacth; did you mean train.batch\?",
    "batch=8": r"unknown key batch; did you mean train.batch\?",
    "trian.batch=8": r"unknown key trian; did you mean train\?",
    "train.batch=eight": "train.batch: expected a whole number, got 'eight'",
    "train.batch=8.5": "train.batch: expected a whole number, got 8.5",
    "train.batch=true": "train.batch: expected a whole number, got True",
    "train.rate=fast": "train.rate: expected a number, got 'fast'",
    "train.form=gauss": "train.form: expected one of integrated, sampled, got 'gauss'",
    "at=[2]": r"at: expected a number, got \[2\]",
    "fast=1": "fast: expected true or false, got 1",
    "name=3": "name: expected text, got 3",
    "starts=5": "starts: expected a list, each item a number, got 5",
    "starts=[a]": r"starts\[0\]: expected a number, got 'a'",
    "train=3": "train: expected keys and values, got 3",
    "name.first=3": "name: expected text, got {'first': 3}",
    "train.batch": "expected key=value",
    "name=[": "--set name=.: line 2: not YAML",
}


@pytest.mark.parametrize("override", BAD)
def test_bad_overrides_name_the_key(path, override):
    with pytest.raises(ConfigError, match=BAD[override]):
        load_config(Config, path, [override])


@dataclasses.dataclass(frozen=True)
class Ends:
    low: float = 1.0
    high: float = 2.0
    field: float | tuple[float, ...] = 0.0

    def __post_init__(self):
        if not self.low < self.high:
            raise ValueError(f"high: {self.high:g} is not above low")


def test_overrides_count_all_at_once(tmp_path):
    """Settings that are valid only together, in any order; of several values for a key, the last
    one."""
    (tmp_path / "ends.yaml").write_text("")
    load = functools.partial(load_config, Ends, tmp_path / "ends.yaml")
    assert load(["low=5", "high=4", "high=6"]) == load(["high=6", "low=5"]) == Ends(5.0, 6.0)
    with pytest.raises(ConfigError, match="^--set high=0: high: 0 is not above low"):
        load(["field=3", "high=0"])
    with pytest.raises(ConfigError, match="^--set low=5 --set field=3: high: 2 is not above low"):
        load(["low=5", "field=3"])


def test_one_value_or_a_list(tmp_path):
    (tmp_path / "ends.yaml").write_text("field: [1, 2.5]")
    found = load_config(Ends, tmp_path / "ends.yaml")
    assert found.field == (1.0, 2.5)
    (tmp_path / "again.yaml").write_text(dump_config(found))
    assert load_config(Ends, tmp_path / "again.yaml") == found
    assert load_config(Ends, tmp_path / "again.yaml", ["field=7"]).field == 7.0
    for wrong, message in (("x", "expected a number, got 'x'"), ("[x]", "expected a number")):
        with pytest.raises(ConfigError, match=message):
            load_config(Ends, tmp_path / "again.yaml", [f"field={wrong}"])
    assert describe(Ends)[2] == "field: a number or a list, each item a number"


@dataclasses.dataclass(frozen=True)
class Checked:
    rates: Annotated[tuple[float, ...], not_empty, different, within(0, 1)] = (0.5,)
    kernel: Annotated[int, within(0, 9), or_zero(odd)] = 0


@dataclasses.dataclass(frozen=True)
class Several:
    items: tuple[Checked, ...] = ()


@pytest.mark.parametrize(
    "entry, message",
    [
        ("{rates: [0, 2]}", r"items\[1\].rates: expected 0 to 1, got 2.0"),
        ("{rates: []}", r"items\[1\].rates: needs at least one item"),
        ("{rates: [1, 1]}", r"items\[1\].rates: an item stands twice"),
        ("{rates: [x]}", r"items\[1\].rates\[0\]: expected a number, got 'x'"),
        ("{kernel: 4}", r"items\[1\].kernel: expected an odd number, or 0"),
    ],
)
def test_checks_of_a_setting_name_its_key(entry, message, tmp_path):
    (tmp_path / "some.yaml").write_text("items: [{kernel: 3}]")
    assert load_config(Several, tmp_path / "some.yaml").items == (Checked(kernel=3),)
    with pytest.raises(ConfigError, match=message):
        load_config(Several, tmp_path / "some.yaml", [f"items=[{{}}, {entry}]"])
    assert describe(Checked) == ["rates: a list, each item a number", "kernel: a whole number"]


def test_bad_files_name_the_file(tmp_path):
    cases = {
        "starts: [1]\nsped: 3": "unknown key sped",
        "- 1": "expected keys",
        "a: [": "line 2: not YAML",
    }
    for text, message in cases.items():
        path = tmp_path / "bad.yaml"
        path.write_text(text)
        with pytest.raises(ConfigError, match=message) as error:
            load_config(Config, path)
        assert str(path) in str(error.value)
    with pytest.raises(ConfigError, match="No such file"):
        load_config(Config, tmp_path / "none.yaml")
    (tmp_path / "empty.yaml").write_text("")
    with pytest.raises(ConfigError, match="missing keys: starts"):
        load_config(Config, tmp_path / "empty.yaml")


def test_description_lists_every_setting():
    assert describe(Config)[0] == "starts: a list, each item a number"
    assert "train.form: one of integrated, sampled" in describe(Config)
