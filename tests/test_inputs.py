"""Input from outside: every invalid input raises an error of one line that names file, line, key
and remedy."""

import dataclasses
import time

import numpy as np
import pytest
import yaml
from experiments._damaged_files import outcome_of

from drt_jax import LensError, load_lens
from drt_jax.inputs import InputError, one_line, parse, shown
from experiments import _damaged_files
from experiments.runs.config import ConfigError, load_config

LENS = """\
name: singlet
surfaces:
  - {radius: 51.68, thickness: 4.0, glass: N-BK7}
  - {radius: -51.68, thickness: 2.0}
  - {radius: inf, semi_diameter: 5.0, stop: true}
sensor: 50.0
"""
DIGITS = "9" * 5000
BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{b}: &{b} [{', '.join(['*' + a] * 9)}]\n" for a, b in zip("abcdefgh", "bcdefghi")
)
# The replaced text of the file, its replacement, and the message.
LENSES = {
    "number of 400 digits": ("51.68", "9" * 400, "line 3: a number of 400 characters"),
    "5000 digits": ("4.0", DIGITS, "line 3: a number of 5000 characters"),
    "steep": ("radius: 51.68", "curvature: 1.0e+200", "line 3: surfaces[0].curvature: 1e+200 is"),
    "wide": ("5.0", "1.0e+200", "line 5: surfaces[2].semi_diameter: 1e+200 is not between"),
    "dense": ("glass: N-BK7", "index: 1.0e+200", "surfaces[0].index: 1e+200 is not between"),
    "form, a list": ("radius: 51.68", "form: [asphere], radius: 51.68", "surfaces[0].form"),
    "form, a mapping": ("radius: 51.68", "form: {a: 1}, radius: 51.68", "surfaces[0].form"),
    "date": ("4.0", "2001-99-99", "thickness: expected a number, got '2001-99-99'"),
    "tag int": ("4.0", "!!int abc", "line 3: a tag (!name) is not taken"),
    "tag float": ("4.0", "!!float abc", "line 3: a tag (!name) is not taken"),
    "code": ("4.0", "!!python/object/apply:os.system [ls]", "line 3: a tag (!name) is not taken"),
    "deep lists": ("4.0", "[" * 900 + "]" * 900, "line 3: nesting deeper than 20"),
    "deep mappings": ("4.0", "{a: " * 3000 + "1" + "}" * 3000, "line 3: nesting deeper than 20"),
    "bomb": ("name: singlet", BOMB + "name: *i", "line 1: an alias or an anchor"),
    "merge bomb": ("name: singlet", "a: &a {x: 1}\nb: {<<: *a}", "line 1: an alias or an anchor"),
    "power": ("glass: N-BK7", "coefficients: {1000000: 1.0}", "coefficients: unknown key 1000000"),
    "power of 0": ("glass: N-BK7", "coefficients: {20000: 0.0}", "unknown key 20000"),
    "vast power": ("glass: N-BK7", "coefficients: {1000000000000000000: 1}", "unknown key 1000"),
    "far": ("4.0", "1.0e+308", "surfaces[0].thickness: 1e+308 is not between"),
    "conic": ("glass: N-BK7", "conic: 1.0e+39", "surfaces[0].conic: 1e+39 is not between"),
    "twice": ("radius: 51.68", "radius: 51.68, radius: 500", "line 3: surfaces[0].radius is given"),
    "sensor twice": ("sensor: 50.0", "sensor: 50.0\nsensor: 60.0", "line 7: sensor is given twice"),
    "a value of 100 kB": ("4.0", "x" * 100_000, "surfaces[0].thickness: expected a number"),
    "a key of 900 letters": ("thickness", "x" * 900, "surfaces[0]: unknown key 'xxx"),
    "a glass of 100 kB": ("N-BK7", "x" * 100_000, "glass: expected at most 100 characters"),
    "a name that is a mapping": ("singlet", "{a: [1, 2]}", "line 1: name: expected text"),
    "syntax": ("singlet", "[", "line 3: not YAML"),
    "control": ("singlet", "a\x00b", "not YAML"),
    "two documents": ("name: singlet", "---\nname: a\n---\nname: b", "a second document"),
    "keys of lists": ("name: singlet", "? [1, 2]\n: 3", "line 1: a key must be text"),
    "no mapping": (LENS, "- 1\n- 2\n", "expected a mapping"),
    "large": ("name: singlet", "#" * 2**20 + "\nname: singlet", "is larger than 1 MB"),
    "surfaces": (
        LENS,
        f"surfaces: [{'{radius: 9}, ' * 6000}]",
        "surfaces: 6000 are more than 5000",
    ),
    "many values": (LENS, f"surfaces: [{'1, ' * 110_000}]", "more than 100000 values"),
    "elements": ("sensor", "elements: [" + "{a: 1}, " * 600 + "]\nsensor", "600 are more than 500"),
    "apertures": ("glass", f"aperture: [{'{circle: 1},' * 30}], glass", "30 are more than 20"),
    "unbounded": (
        "N-BK7",
        "N-BK7, semi_diameter: 8, coefficients: {398: 1e30}",
        "not finite within",
    ),
    "both unbounded": (
        "51.68, thickness: 4.0, glass: N-BK7}\n  - {radius: -51.68,",
        "inf, thickness: 4.0, glass: N-BK7, semi_diameter: 8, coefficients: {398: 1e30}}\n"
        "  - {radius: inf, semi_diameter: 8, coefficients: {398: 1e30},",
        "surfaces[0]: not finite within",
    ),
    "not UTF-8": ("singlet", "\udcff", "byte 6 is no UTF-8 text"),
}


def refused(call, kind):
    """The message of an error of this kind, which must be one short line."""
    start = time.perf_counter()
    with pytest.raises(kind) as error:
        call()
    message = str(error.value)
    assert time.perf_counter() - start < 5
    assert len(message) <= 300 and message.isprintable(), message
    return message


@pytest.mark.parametrize("case", LENSES)
def test_lens_files(case, tmp_path):
    old, new, wanted = LENSES[case]
    assert old in LENS
    path = tmp_path / "mine.yaml"
    path.write_bytes(LENS.replace(old, new, 1).encode("utf-8", "surrogateescape"))
    message = refused(lambda: load_lens(path), LensError)
    assert wanted in message and message.startswith(str(path)[:100])


def test_paths(tmp_path):
    (tmp_path / "folder.yaml").mkdir()
    cases = {
        "a\0b.yaml": "embedded null",
        "x" * 5000 + ".yaml": "File name too long",
        "x" * 5000: "no bundled lens",
        "none.yaml": "cannot be read: No such file",
        str(tmp_path / "folder.yaml"): "is not a file",
        "/dev/zero.yaml": "cannot be read",
        "": "no bundled lens",
        "../lenses/singlet": "no bundled lens",
    }
    for path, wanted in cases.items():
        assert wanted in refused(lambda path=path: load_lens(path), LensError)
    (tmp_path / "MINE.YAML").write_text(LENS)
    assert load_lens(tmp_path / "MINE.YAML").name == "singlet"


def test_mappings_are_bounded_as_files_are():
    entry = yaml.safe_load(LENS)
    for value in (10**5000, 10**400, [[1] * 10**6], {"a": 1}, "x" * 10**6, float("nan"), None):
        entry["surfaces"][0]["radius"] = value
        assert "surfaces[0].radius" in refused(lambda: load_lens(entry), LensError)


@dataclasses.dataclass(frozen=True)
class Inner:
    rate: float = 1.0
    words: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Settings:
    seed: int = 0
    name: str = "x"
    inner: Inner = Inner()


CONFIGS = {
    "seed=-1": "seed: expected a whole number from 0 to 2147483647, got -1",
    "seed=9223372036854775808": "seed: expected a whole number from 0",
    "inner.rate=" + "9" * 400: "line 1: a number of 400 characters",
    "inner.rate=1e308": "inner.rate: expected a number of at most 1e+12",
    "inner.rate=" + "'" + "9" * 400 + "'": "inner.rate: expected a number, got '99",
    "seed=" + DIGITS: "a number of 5000 characters",
    "seed=2001-99-99": "seed: expected a whole number, got '2001-99-99'",
    "seed=!!int abc": "a tag (!name) is not taken",
    "inner.words=" + "[" * 300: "nesting deeper than 20",
    "inner.words=[" + "a, " * 2000 + "]": "each item text, at most 1000",
    "name=" + "x" * 10_000: "name: expected text of at most 1000 characters",
    "x" * 10_000 + "=1": "unknown key",
    "x.y" * 3000 + "=1": "unknown key",
    "name=a\0b": "not YAML",
    "": "expected key=value",
    "inner={rate: 1, rate: 2}": "line 1: rate is given twice",
}


@pytest.mark.parametrize("override", CONFIGS, ids=lambda text: text[:20])
def test_settings(override, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("seed: 1\n")
    message = refused(lambda: load_config(Settings, path, [override]), ConfigError)
    assert CONFIGS[override] in message and message.startswith("--set")
    if "line" in message or "." in override.partition("=")[0]:
        return
    key, _, value = override.partition("=")
    path.write_bytes(f"name: y\n\n{key}: {value}\n".encode())
    refused(lambda: load_config(Settings, path), ConfigError)


def test_settings_name_the_line(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("seed: 1\ninner:\n  # a word\n  rate: fast\n")
    message = refused(lambda: load_config(Settings, path), ConfigError)
    assert message == f"{path}, line 4: inner.rate: expected a number, got 'fast'"


def test_messages():
    assert shown(10**5000) == "a int of too many digits" and len(shown(["x" * 10**6] * 99)) < 300
    text = one_line("a\n\tb\x1b[31m" + "x" * 10**7 + " the remedy")
    assert text.startswith("a b [31m") and text.endswith(" the remedy") and len(text) == 300
    assert len(str(InputError("x" * 1000))) == 300
    value, lines = parse("a: [1, {b: 2}]\n4: ~\nyes: 1e-3\n")
    assert value == {"a": [1, {"b": 2}], 4: None, True: "1e-3"}
    assert lines.of("a[1].b.c[3]") == ", line 1" and lines.of("q") == ""
    assert lines.of("q[[[") == lines.of("") == ""


@pytest.mark.parametrize("seed", range(2))
def test_random_mutants(seed, tmp_path):
    """Some of the damaged files of `experiments.faults`."""
    rng = np.random.default_rng(seed)
    path = tmp_path / "mine.yaml"
    for _ in range(40):
        path.write_bytes(content := _damaged_files.damaged(LENS, rng))
        found, said = outcome_of(lambda: _damaged_files.finite(load_lens(path)))
        assert found in ("refused", "survived"), (said, content)
