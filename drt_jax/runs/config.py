"""Strict configuration: YAML and overrides into a dataclass; nothing unknown, nothing guessed."""

import contextlib
import dataclasses
import difflib
import json
import pathlib
import typing
from collections.abc import Sequence
from typing import Any, Literal, TypeVar

import yaml

T = TypeVar("T")


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the source, the key, the remedy."""


def load_config(cls: type[T], path: str | pathlib.Path, overrides: Sequence[str] = ()) -> T:
    """Read a YAML file into a dataclass.

    cls: the dataclass; keys left out of the file keep its defaults.
    path: of the file.
    overrides: like "train.batch=8", applied afterwards.

    ConfigError for a file that cannot be read, an unknown key (with the nearest known one) or a
    value of the wrong type.
    """
    path = pathlib.Path(path)
    try:
        entry = yaml.safe_load(path.read_text()) or {}
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not a YAML file: {error}") from error
    config = _build(cls, entry, str(path), "")
    for override in overrides:
        key, equals, text = override.partition("=")
        if not equals:
            raise ConfigError(f"--set {override}: expected key=value, such as train.batch=8")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise ConfigError(f"--set {override}: {text!r} is not a YAML value") from error
        for name in reversed(key.strip().split(".")):
            value = {name: value}
        config = _build(cls, value, f"--set {override}", "", config)
    return config


def _build(cls: Any, entry: object, source: str, prefix: str, old: Any = None) -> Any:
    """The dataclass `cls` with the values of `entry`, the others those of `old` or defaults.

    source: what messages name. prefix: the keys that lead here, each with a dot behind.
    """
    if not isinstance(entry, dict):
        where = prefix.rstrip(".") or "the file"
        raise ConfigError(f"{source}: {where}: expected keys and values, got {entry!r}")
    known = typing.get_type_hints(cls)
    values = {}
    for key, value in entry.items():
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
            hint = f"did you mean {prefix}{near[0]}? " if near else ""
            listed = ", ".join(known)
            raise ConfigError(f"{source}: unknown key {prefix}{key}; {hint}known here: {listed}")
        values[key] = _convert(known[key], value, source, prefix + key, getattr(old, key, None))
    needed = (f.name for f in dataclasses.fields(cls) if f.default is dataclasses.MISSING)
    missing = [prefix + name for name in needed if old is None and name not in values]
    if missing:
        raise ConfigError(f"{source}: missing keys: {', '.join(missing)}")
    try:
        return cls(**values) if old is None else dataclasses.replace(old, **values)
    except ValueError as error:  # a dataclass that refuses its values
        raise ConfigError(f"{source}: {error}") from error


def _convert(kind: Any, value: object, source: str, key: str, old: Any = None) -> Any:
    """`value` as `kind`: a dataclass, bool, int, float, str, tuple[X, ...] or a Literal."""
    if dataclasses.is_dataclass(kind):
        return _build(kind, value, source, f"{key}.", old)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and isinstance(value, list | tuple):
        items = enumerate(value)
        return tuple(_convert(arguments[0], item, source, f"{key}[{i}]") for i, item in items)
    if origin is Literal and value in arguments:
        return value
    if kind is float and isinstance(value, int | float | str) and not isinstance(value, bool):
        with contextlib.suppress(ValueError):
            return float(value)  # YAML 1.1 reads 1e-3 as text
    if kind in (bool, int, str) and type(value) is kind:
        return value
    raise ConfigError(f"{source}: {key}: expected {_say(kind)}, got {value!r}")


def _say(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return f"a list, each item {_say(arguments[0])}"
    if origin is Literal:
        return "one of " + ", ".join(map(str, arguments))
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
    return names.get(kind, getattr(kind, "__name__", str(kind)))


def describe(cls: Any, prefix: str = "") -> list[str]:
    """A line "key: type" for each setting, for --help."""
    lines = []
    for name, kind in typing.get_type_hints(cls).items():
        if dataclasses.is_dataclass(kind):
            lines += describe(kind, f"{prefix}{name}.")
        else:
            lines.append(f"{prefix}{name}: {_say(kind)}")
    return lines


def dump_config(config: Any) -> str:
    """The resolved configuration as YAML that `load_config` reads back."""
    plain = json.loads(json.dumps(dataclasses.asdict(config)))  # tuples as lists
    return yaml.safe_dump(plain, sort_keys=False)
