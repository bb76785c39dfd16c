"""Strict configuration: YAML and overrides into a dataclass."""

import dataclasses
import difflib
import json
import math
import pathlib
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any, Literal, TypeVar

import yaml

from drt_jax.inputs import InputError, parse, read_yaml, shown

T = TypeVar("T")
Source = Callable[[str], str]
# Limits: whole numbers, magnitude of other finite numbers, items of a list, characters of a text.
_MOST, _LARGEST, _ITEMS, _LONGEST = 2**31 - 1, 1e12, 1000, 1000
_NAMES = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
_NAMES[type(None)] = "null"


class ConfigError(InputError):
    """A configuration cannot be used; the message names the source, the key and the remedy."""


def load_config(cls: type[T], path: str | pathlib.Path, overrides: Sequence[str] = ()) -> T:
    """Reads a YAML file into a dataclass.

    cls: the dataclass; keys that are not in the file have its defaults.
    overrides: such as "train.batch=8"; all are applied together, after the file.

    ConfigError, with the line, for a file that cannot be read, an unknown key (with the nearest
    known one) or a value of a wrong type or size.
    """
    try:
        entry, lines = read_yaml(path)
    except InputError as error:
        raise ConfigError(f"{path}: {error}") from error
    entry = {} if entry is None else entry
    config = _build(cls, entry, lambda key: f"{path}{lines.of(key)}")
    names: dict[str, str] = {}  # overrides by key
    for override in overrides:
        name = f"--set {shown(override)[1:-1]}"
        key, equals, text = override.partition("=")
        if not equals:
            raise ConfigError(f"{name}: expected key=value, such as train.batch=8")
        try:
            value, _ = parse(text)
        except InputError as error:
            raise ConfigError(f"{name}: {error}") from error
        names[key.strip()] = name
        for part in reversed(key.strip().split(".")):
            value = {part: value}
        entry = _merged(entry, value)

    def source(key: str) -> str:
        """The last override of a key, or of a key that contains it; else all overrides."""
        own = [name for given, name in names.items() if f"{key}.".startswith(f"{given}.")]
        return own[-1] if own else " ".join(names.values())

    return _build(cls, entry, source) if names else config


def _merged(old: object, new: object) -> object:
    """Merges nested keys and values; the new ones win."""
    if not (isinstance(old, dict) and isinstance(new, dict)):
        return new
    return old | {key: _merged(old.get(key), value) for key, value in new.items()}


def _build(cls: Any, entry: object, source: Source, prefix: str = "") -> Any:
    """The dataclass `cls` with the values of `entry`, and defaults for the others.

    source: function of a key that returns where it was set, for messages.
    prefix: keys of the enclosing mappings, each followed by a dot.
    """
    here = prefix.rstrip(".")
    if not isinstance(entry, dict):
        where = here or "the file"
        raise _error(source, here, f"{where}: expected keys and values, got {shown(entry)}")
    known = typing.get_type_hints(cls, include_extras=True)
    values = {}
    for key, value in entry.items():
        if key not in known:
            word = str(key)[:_LONGEST]
            parts = (
                (name, getattr(kind, "__dataclass_fields__", ())) for name, kind in known.items()
            )
            near = [f"{name}.{word}" for name, keys in parts if word in keys]
            near = near or difflib.get_close_matches(word, known, n=1, cutoff=0.5)
            hint = f"did you mean {prefix}{near[0]}? " if near else ""
            unknown = f"unknown key {prefix}{shown(word)[1:-1]}; {hint}"
            raise _error(source, prefix + word, f"{unknown}known here: {', '.join(known)}")
        values[key] = _convert(known[key], value, source, prefix + key)
    needed = (f.name for f in dataclasses.fields(cls) if f.default is dataclasses.MISSING)
    missing = [prefix + name for name in needed if name not in values]
    if missing:
        raise _error(source, here, f"missing keys: {', '.join(missing)}")
    try:
        return cls(**values)
    except ValueError as error:  # the message of a dataclass names the key first
        raise _error(source, str(error).partition(":")[0], str(error)) from error


def _error(source: Source, key: str, message: str) -> ConfigError:
    return ConfigError(f"{source(key)}: {message}", key)


def _convert(kind: Any, value: object, source: Source, key: str) -> Any:
    """`value` converted to the type `kind`.

    kind: a dataclass, bool, int, float, str, tuple[X, ...], X | tuple[X, ...], X | None or a
        Literal; or Annotated[X, check, ...], where each check is a function of the value that
        returns the text of an error, "" for none.

    Sizes are limited for all values. YAML 1.1 reads 1e-3 as text, so text is accepted for numbers.
    """
    if dataclasses.is_dataclass(kind):
        return _build(kind, value, source, f"{key}.")
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Annotated:
        found = _convert(arguments[0], value, source, key)
        for wrong in (check(found) for check in arguments[1:]):
            if wrong:
                raise _error(source, key, f"{key}: {wrong}")
        return found
    limit = ""
    if origin in (types.UnionType, typing.Union):  # X | tuple[X, ...], or X | None
        if value is None and arguments[1] is type(None):
            return None
        listed = isinstance(value, list | tuple) and arguments[1] is not type(None)
        return _convert(arguments[listed], value, source, key)
    if origin is tuple and isinstance(value, list | tuple):
        limit = f", at most {_ITEMS}"
        if len(value) <= _ITEMS:
            items = enumerate(value)
            return tuple(_convert(arguments[0], item, source, f"{key}[{i}]") for i, item in items)
    # YAML 1.1 reads 1e-3 as text.
    if kind is float and isinstance(value, int | float | str) and not isinstance(value, bool):
        number = _number(value)
        if abs(number) <= _LARGEST or math.isinf(number):
            return number
        limit = "" if math.isnan(number) else f" of at most {_LARGEST:g} in size"
    if kind is int and type(value) is int:
        limit = f" from 0 to {_MOST}"
        if 0 <= value <= _MOST:
            return value
    if kind is str and type(value) is str:
        limit = f" of at most {_LONGEST} characters"
        if len(value) <= _LONGEST and "\0" not in value:
            return value
    if (kind is bool and type(value) is bool) or (origin is Literal and value in arguments):
        return value
    expected = f"{key}: expected {_say(kind)}{limit}, got {shown(value)}"
    near = difflib.get_close_matches(str(value)[:_LONGEST], map(str, arguments), n=1)
    raise _error(source, key, expected + (f"; did you mean {near[0]}?" if near else ""))


def _number(value: int | float | str) -> float:
    """The value as a number; NaN if it is not one, or is finite but too large for a float."""
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return math.nan
    written_so = isinstance(value, float) or "inf" in str(value).lower()
    return math.nan if math.isinf(number) and not written_so else number


def _say(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return f"a list, each item {_say(arguments[0])}"
    if origin in (types.UnionType, typing.Union):
        return " or ".join(map(_say, arguments))
    if origin is Literal:
        return "one of " + ", ".join(map(str, arguments))
    return _NAMES.get(kind, getattr(kind, "__name__", str(kind)))


def describe(cls: Any, prefix: str = "") -> list[str]:
    """The settings as lines "key: type", for --help."""
    lines = []
    for name, kind in typing.get_type_hints(cls).items():
        if dataclasses.is_dataclass(kind):
            lines += describe(kind, f"{prefix}{name}.")
        else:
            lines.append(f"{prefix}{name}: {_say(kind)}")
    return lines


def dump_config(config: Any) -> str:
    """The configuration as YAML that `load_config` reads back."""
    plain = json.loads(json.dumps(dataclasses.asdict(config)))  # tuples as lists
    return yaml.safe_dump(plain, sort_keys=False)
