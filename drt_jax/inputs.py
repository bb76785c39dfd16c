"""Input from outside: text is limited in size and parsed strictly, and values are shown shortened.

Prescriptions and settings need mappings, lists, text, numbers, true, false and null of YAML.
Everything else is refused with its line number: aliases (a few of them can expand to gigabytes),
tags, second documents, and duplicate keys (other readers take the last one).
"""

import difflib
import os
import reprlib
import stat
import sys
import warnings
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import yaml

# The parser of libyaml takes a tenth of the time, where PyYAML was built with it.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_CONSTRUCTOR = yaml.constructor.SafeConstructor()
# Largest number of bytes of a file, of values in it, of nested levels, of characters of a number,
# and of characters of a message.
LARGEST = 2**20
_VALUES, _DEEPEST, _DIGITS, _LONGEST = 100_000, 20, 40, 300
# Packages whose frames a warning passes, see `warn`.
_INSIDE = __name__.partition(".")[0], "jax", "contextlib"
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 40
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxlevel = 3


class InputError(ValueError):
    """Input from outside that cannot be used, with a message of one line of at most 300 characters.

    message: names the place and the remedy.
    key: key in a file, such as "surfaces[0].radius".
    """

    def __init__(self, message: str, key: str = ""):
        self.key = key
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """Text as one printable line. Long text is reduced to its beginning and its end."""
    text = text if len(text) < 4 * _LONGEST else text[:_LONGEST] + text[-_LONGEST:]
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    head = _LONGEST - 100
    return text if len(text) <= _LONGEST else f"{text[:head]} ... {text[head + 5 - _LONGEST :]}"


def shown(value: object) -> str:
    """A value in a message: its `repr`, shortened where it is long."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python does not print an integer of more than 4300 digits
        return f"a {type(value).__name__} of too many digits"


def require(condition: object, message: str, error: type[ValueError] = ValueError) -> None:
    """Raises an error with this message unless the condition holds."""
    if not condition:
        raise error(message)


def warn(message: str) -> None:
    """Warns at the line that called this package, past its own frames and those of JAX."""
    frame, level = sys._getframe(), 1
    while frame.f_back and frame.f_globals["__name__"].partition(".")[0] in _INSIDE:
        frame, level = frame.f_back, level + 1
    warnings.warn(message, stacklevel=level)


def require_tolerance(sampling: Any) -> float:
    """A tolerance as a float. ValueError unless it is a number between 0 and 1."""
    what = "a tolerance between 0 and 1, or what drt_jax.converge returns"
    is_right = isinstance(sampling, int | float | np.number) and 0 < sampling < 1
    require(is_right, f"sampling: expected {what}, got {sampling!r:.80}")
    return float(sampling)


def require_one_of(
    what: str, value: object, known: Iterable[str], elsewhere: Mapping[str, str] = {}
) -> None:
    """Raises ValueError, which lists the known words, for a value that is none of them.

    elsewhere: known words by those of other programs, in small letters.
    """
    words = [*known]
    some = f"{what}: expected one of {', '.join(words)}, got {shown(value)}"
    other = elsewhere.get(str(value)[:40].lower())
    require(value in words, some + nearest(other or value, words))


def nearest(value: object, known: Iterable[str]) -> str:
    """End of a message about an unknown word that resembles a known one, such as "; did you mean
    'spot'?"."""
    close = difflib.get_close_matches(str(value)[:40].lower().replace("-", "_"), known, n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def whole_numbers(what: str, given: Any) -> tuple[int, ...]:
    """Numbers of surfaces and the like as a tuple of int.

    ValueError, which begins with `what`, unless `given` is an iterable of whole numbers.
    """
    numbers = given if isinstance(given, Iterable) and not isinstance(given, str) else [None]
    found = tuple(numbers)
    if all(isinstance(n, int | np.integer) and not isinstance(n, bool) for n in found):
        return tuple(map(int, found))
    raise ValueError(f"{what}: expected whole numbers from 0, such as (0, 2), got {shown(given)}")


class Lines(dict[str, int]):
    """The line number of each key of a file, with keys such as "surfaces[0].radius"."""

    def of(self, key: str) -> str:
        """The text ", line 7" for a key, or for the mapping or list that contains it; "" if not
        known.
        """
        while key and key not in self:
            key = key[: max(key.rfind("."), key.rfind("["), 0)]
        return f", line {self[key]}" if key else ""


def read_bytes(path: str | os.PathLike, largest: int = LARGEST, what: str = "YAML file") -> bytes:
    """Content of a file of at most `largest` bytes. InputError if it cannot be read."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise InputError(f"is not a file; give the path of a {what}")
        with open(path, "rb") as file:
            content = file.read(largest + 1)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from error
    except ValueError as error:  # a path with a NUL; an InputError passes unchanged
        raise error if isinstance(error, InputError) else InputError(str(error)) from error
    if len(content) > largest:
        raise InputError(f"is larger than {largest // 2**20} MB; is it the right file?")
    return content


def read_text(path: str | os.PathLike, largest: int = LARGEST) -> str:
    """UTF-8 text of a file of at most `largest` bytes. InputError if it cannot be read."""
    try:
        return read_bytes(path, largest).decode()
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start} is no UTF-8 text; save the file as UTF-8") from error


def read_yaml(path: str | os.PathLike) -> tuple[Any, Lines]:
    """The content of a YAML file, and the line numbers of its keys; see `parse`."""
    return parse(read_text(path))


def parse(text: str) -> tuple[Any, Lines]:
    """The content of YAML text, and the line numbers of its keys.

    The content consists of dict, list, str, int, float, bool and None.

    InputError, with the line number, for text that is not YAML or is refused, see above.
    """
    try:
        _check(yaml.parse(text, Loader=_Loader))
        root = yaml.compose(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        where = f"line {mark.line + 1}: " if mark else ""
        raise InputError(f"{where}not YAML: {problem or error}") from error
    lines = Lines()
    return (None if root is None else _value(root, "", lines)), lines


def _check(events: Iterable[Any]) -> None:
    """Raises InputError, with the line number, for YAML that is refused.

    It checks parser events, before nodes are composed, because composing is recursive.
    """
    documents = values = depth = 0
    for event in events:
        documents += isinstance(event, yaml.DocumentStartEvent)
        values += isinstance(event, yaml.ScalarEvent | yaml.CollectionStartEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        refused = {
            "an alias or an anchor (*name, &name)": getattr(event, "anchor", None) is not None,
            "a tag (!name)": getattr(event, "tag", None) is not None,
            "a second document": documents > 1,
            f"more than {_VALUES} values": values > _VALUES,
            f"nesting deeper than {_DEEPEST}": depth > _DEEPEST,
        }
        if any(refused.values()):
            what = next(what for what, is_so in refused.items() if is_so)
            line = event.start_mark.line + 1
            raise InputError(f"line {line}: {what} is not taken; write the values out")


def _value(node: Any, name: str, lines: Lines) -> Any:
    """The value of a YAML node with the key `name`; adds the line numbers of all keys in it."""
    if name:
        lines.setdefault(name, node.start_mark.line + 1)
    if isinstance(node, yaml.ScalarNode):
        return _scalar(node)
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, f"{name}[{k}]", lines) for k, item in enumerate(node.value)]
    mapping: dict[Any, Any] = {}
    for key_node, item in node.value:
        line = key_node.start_mark.line + 1
        if not isinstance(key_node, yaml.ScalarNode):
            raise InputError(f"line {line}: a key must be text or a number")
        key = _scalar(key_node)
        place = f"{name}.{key}".lstrip(".")
        if key in mapping:
            raise InputError(f"line {line}: {one_line(place)} is given twice", place)
        lines.setdefault(place, line)
        mapping[key] = _value(item, place, lines)
    return mapping


def _scalar(node: Any) -> Any:
    """A scalar, quoted or not, as YAML 1.1 reads it, but without dates and without sexagesimal
    numbers.
    """
    text, kind = node.value, node.tag.rpartition(":")[2]
    if kind not in ("null", "bool", "int", "float") or (kind != "null" and ":" in text):
        return text
    if kind in ("int", "float") and len(text) > _DIGITS:
        line = node.start_mark.line + 1
        raise InputError(f"line {line}: a number of {len(text)} characters; at most {_DIGITS}")
    return getattr(_CONSTRUCTOR, f"construct_yaml_{kind}")(node)
