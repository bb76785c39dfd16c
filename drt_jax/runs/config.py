"""Strict configuration: YAML and overrides into a dataclass; nothing unknown, nothing guessed."""

import dataclasses
import difflib
import pathlib
import typing
from typing import Any, TypeVar

import yaml

__all__ = ["ConfigError", "describe", "dump_config", "load_config"]

T = TypeVar("T")


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the source, the key, the remedy."""


def load_config(cls: type[T], path: str | pathlib.Path, overrides: typing.Sequence[str] = ()) -> T:
    """Read `path` (YAML) into the dataclass `cls`, then apply overrides like "train.batch=8".

    Keys left out keep their default. ConfigError for a file that cannot be read, an unknown
    key (with the nearest known one) or a value of the wrong type.
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
        config = _replace(config, key.strip().split("."), value, f"--set {override}", "")
    return config


def _dotted(prefix: str, key: object) -> str:
    return f"{prefix}.{key}" if prefix else str(key)


def _field(cls: type, key: object, source: str, prefix: str) -> Any:
    known = typing.get_type_hints(cls)
    if key not in known:
        near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
        hint = f"did you mean {_dotted(prefix, near[0])}? " if near else ""
        raise ConfigError(
            f"{source}: unknown key {_dotted(prefix, key)}; {hint}known here: {', '.join(known)}"
        )
    return known[key]


def _build(cls: type[T], entry: object, source: str, prefix: str) -> T:
    if not isinstance(entry, dict):
        raise ConfigError(
            f"{source}: {prefix or 'the file'}: expected keys and values, got {entry!r}"
        )
    values = {
        key: _convert(_field(cls, key, source, prefix), value, source, _dotted(prefix, key))
        for key, value in entry.items()
    }
    missing = [
        _dotted(prefix, field.name)
        for field in dataclasses.fields(cls)
        if field.name not in values and field.default is dataclasses.MISSING
    ]
    if missing:
        raise ConfigError(f"{source}: missing keys: {', '.join(missing)}")
    return _checked(lambda: cls(**values), source)


def _checked(make: typing.Callable[[], T], source: str) -> T:
    """What `make` makes; a dataclass that refuses its values is told the source."""
    try:
        return make()
    except ValueError as error:
        raise ConfigError(f"{source}: {error}") from error


def _replace(config: T, keys: list[str], value: object, source: str, prefix: str) -> T:
    kind = _field(type(config), keys[0], source, prefix)
    here = _dotted(prefix, keys[0])
    if len(keys) > 1:
        inner = getattr(config, keys[0])
        if not dataclasses.is_dataclass(inner):
            raise ConfigError(f"{source}: {here} has no keys of its own")
        new = _replace(inner, keys[1:], value, source, here)
    else:
        new = _convert(kind, value, source, here)
    return _checked(lambda: dataclasses.replace(config, **{keys[0]: new}), source)


def _convert(kind: Any, value: object, source: str, key: str) -> Any:
    """`value` as `kind`: a dataclass, bool, int, float, str, tuple[X, ...] or a Literal."""
    if dataclasses.is_dataclass(kind):
        return _build(kind, value, source, key)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple and isinstance(value, list | tuple):
        return tuple(
            _convert(arguments[0], item, source, f"{key}[{i}]") for i, item in enumerate(value)
        )
    if origin is typing.Literal and value in arguments:
        return value
    if kind is float and isinstance(value, int | float | str) and not isinstance(value, bool):
        try:
            return float(value)  # YAML 1.1 reads 1e-3 as text
        except ValueError:
            pass
    if kind in (bool, int, str) and type(value) is kind:
        return value
    raise ConfigError(f"{source}: {key}: expected {_say(kind)}, got {value!r}")


def _say(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return f"a list, each item {_say(arguments[0])}"
    if origin is typing.Literal:
        return "one of " + ", ".join(map(str, arguments))
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}
    return names.get(kind, getattr(kind, "__name__", str(kind)))


def describe(cls: type, prefix: str = "") -> list[str]:
    """A line "key: type" for each setting, for --help."""
    lines = []
    for field in dataclasses.fields(cls):
        kind = typing.get_type_hints(cls)[field.name]
        if dataclasses.is_dataclass(kind):
            lines += describe(kind, f"{prefix}{field.name}.")
        else:
            lines.append(f"{prefix}{field.name}: {_say(kind)}")
    return lines


def dump_config(config: Any) -> str:
    """The resolved configuration as YAML that `load_config` reads back."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        return [plain(item) for item in value] if isinstance(value, list | tuple) else value

    return yaml.safe_dump(plain(dataclasses.asdict(config)), sort_keys=False)
