"""Run folders of a run that was stopped, damaged in many ways: going on is refused, or right."""

import pathlib
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np

from ._ended import Ended, Toy, outcome, side_by_side, start

_METRICS, _CONFIG = "metrics.csv", "config.yaml"
_FILES = {"metrics": _METRICS, "settings": _CONFIG, "checkpoint": ""}
_TOUCH = 40  # where the run is killed that is damaged

Damage = Callable[[pathlib.Path, np.random.Generator], None]


def _checkpoint(folder: pathlib.Path) -> pathlib.Path:
    return next((folder / "checkpoints").glob("*.npz"))


def _bytes(name: str, change: Callable[[bytes, np.random.Generator], bytes]) -> Damage:
    def damage(folder: pathlib.Path, rng: np.random.Generator) -> None:
        path = folder / name if name else _checkpoint(folder)
        path.write_bytes(change(path.read_bytes(), rng))

    return damage


def _flipped(content: bytes, rng: np.random.Generator) -> bytes:
    k = int(rng.integers(len(content)))
    return content[:k] + bytes([content[k] ^ 1 << int(rng.integers(8))]) + content[k + 1 :]


def _spliced(content: bytes, rng: np.random.Generator) -> bytes:
    k, size = int(rng.integers(len(content))), int(rng.integers(1, 200))
    return content[:k] + rng.bytes(size) + content[k + size :]


_ANY: dict[str, Callable[[bytes, np.random.Generator], bytes]] = {
    "empty": lambda content, rng: b"",
    "half": lambda content, rng: content[: len(content) // 2],
    "noise": lambda content, rng: rng.bytes(len(content)),
    "a bit flipped": _flipped,
    "another bit flipped": _flipped,
    "a piece of noise": _spliced,
    "twice": lambda content, rng: content * 2,
    "not UTF-8": lambda content, rng: content[:50] + b"\xff\xfe" + content[50:],
    "its last byte lost": lambda content, rng: content[:-1],
}


def _gone(name: str, instead: bool) -> Damage:
    def damage(folder: pathlib.Path, rng: np.random.Generator) -> None:
        path = folder / name if name else _checkpoint(folder)
        path.unlink()
        if instead:
            path.mkdir()

    return damage


def _lines(change: Callable[[list[bytes]], list[bytes]]) -> Damage:
    return _bytes(_METRICS, lambda content, rng: b"".join(change(content.splitlines(True))))


def _row(k: int, change: Callable[[bytes], bytes]) -> Callable[[list[bytes]], list[bytes]]:
    return lambda lines: [*lines[:k], change(lines[k]), *lines[k + 1 :]]


def _entries(change: Callable[[dict[str, Any]], Any]) -> Damage:
    def damage(folder: pathlib.Path, rng: np.random.Generator) -> None:
        path = _checkpoint(folder)
        with np.load(path) as saved:
            entries = dict(saved)
        change(entries)
        np.savez(path, **entries)

    return damage


def _settings(old: bytes, new: bytes) -> Damage:
    return _bytes(_CONFIG, lambda content, rng: content.replace(old, new, 1))


def _swap(entries: dict[str, Any], one: str, two: str) -> None:
    entries[one], entries[two] = entries[two], entries[one]


DAMAGES: dict[str, Damage] = {
    **{f"{kind}: {way}": _bytes(n, c) for kind, n in _FILES.items() for way, c in _ANY.items()},
    **{f"{kind}: gone": _gone(name, False) for kind, name in _FILES.items()},
    **{f"{kind}: a folder": _gone(name, True) for kind, name in _FILES.items()},
    "metrics: no header": _lines(lambda lines: lines[1:]),
    "metrics: half a header": _lines(lambda lines: [lines[0][:5], *lines[1:]]),
    "metrics: header alone": _lines(lambda lines: lines[:1]),
    "metrics: other columns": _lines(_row(0, lambda row: row.replace(b"step", b"pest"))),
    "metrics: first row gone": _lines(lambda lines: [lines[0], *lines[2:]]),
    "metrics: a row gone": _lines(lambda lines: lines[:5] + lines[6:]),
    "metrics: a row twice": _lines(lambda lines: lines[:6] + lines[5:]),
    "metrics: rows swapped": _lines(lambda lines: [*lines[:3], lines[4], lines[3], *lines[5:]]),
    "metrics: last rows gone": _lines(lambda lines: lines[:-12]),
    "metrics: a damaged step": _lines(_row(3, lambda row: row.replace(b",", b",x", 1))),
    "metrics: a damaged number": _lines(_row(3, lambda row: row[:-3] + b"x\r\n")),
    "metrics: another job": _lines(_row(3, lambda row: b"x" + row)),
    "metrics: NUL": _lines(_row(3, lambda row: b"\0" * 20)),
    "checkpoint: step -3": _entries(lambda e: e.update(step=-3)),
    "checkpoint: step 500": _entries(lambda e: e.update(step=500)),
    "checkpoint: step 1.5": _entries(lambda e: e.update(step=1.5)),
    "checkpoint: NaN": _entries(lambda e: e.update(leaf0=e["leaf0"] * np.nan)),
    "checkpoint: cut": _entries(lambda e: e.update(leaf0=e["leaf0"][..., :1])),
    "checkpoint: other dtype": _entries(lambda e: e.update(leaf1=e["leaf1"].astype("float16"))),
    "checkpoint: a leaf lost": _entries(lambda e: e.pop("leaf1")),
    "checkpoint: a leaf more": _entries(lambda e: e.update(leaf99=e["leaf0"])),
    "checkpoint: leaves swapped": _entries(lambda e: _swap(e, "leaf0", "leaf1")),
    "checkpoint: of another run": _gone("", False),
    "settings: another seed": _settings(b"seed: 0", b"seed: 1"),
    "settings: more batches": _settings(b"batches: 40", b"batches: 50"),
    "settings: another camera": _settings(b"kernel: 9", b"kernel: 11"),
    "settings: unknown key": _settings(b"seed: 0", b"sead: 0"),
    "settings: a key twice": _settings(b"seed: 0", b"seed: 0\nseed: 0"),
}


def damaged(toy: Toy, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """So many damages to the folder of a run that was killed about half-way."""
    half = toy.new()
    Ended(start(half, dying=(str(_TOUCH), "0.0")))
    other = toy.new()
    Ended(start(other, "--set", "seed=3"))
    names = [*DAMAGES][:count] + [*DAMAGES] * (count // len(DAMAGES))

    def trial(name: str, own: np.random.Generator) -> list[tuple[str, str]]:
        folder = toy.new()
        shutil.copytree(half, folder)
        DAMAGES[name](folder, own)
        if name.endswith("of another run"):
            shutil.copy(_checkpoint(other), folder / "checkpoints")
        ended = Ended(start(folder, "--resume"))
        found = outcome(ended, folder, toy.truth)
        shutil.rmtree(folder)
        return [(found, f"{name}: {ended.message}")]

    rngs = rng.spawn(count)
    trials = [lambda n=n, r=r: trial(n, r) for n, r in zip(names[:count], rngs, strict=True)]
    return side_by_side("damaged folder, resumed", trials)
