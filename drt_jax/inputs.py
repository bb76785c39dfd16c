"""What comes from outside: text bounded and read strictly, values shown in few words.

Of YAML, prescriptions and settings need mappings, lists, text, numbers, true, false and null. What
else it has is refused with its line: aliases (a few of them make gigabytes), tags, second
documents, keys given twice, of which other readers take the last.
"""

import os
import reprlib
import stat
from typing import Any

import yaml

# The parser of libyaml, where PyYAML was built with it, takes a tenth of the time.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_RESOLVER, _CONSTRUCTOR = yaml.resolver.Resolver(), yaml.constructor.SafeConstructor()
# Bytes of a file, values in it, how deep they nest, characters of a number, of a message.
LARGEST = 2**20
_VALUES, _DEEPEST, _DIGITS, _LONGEST = 100_000, 20, 40, 300
_NO_KEY = object()
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = _SHORT.maxlong = 40
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = _SHORT.maxlevel = 3


class InputError(ValueError):
    """Something from outside that cannot be used, said in one line of at most 300 characters.

    message: names the place and the remedy. key: of a file, such as "surfaces[0].radius".
    """

    def __init__(self, message: str, key: str = ""):
        self.key = key
        super().__init__(one_line(message))


def one_line(text: str) -> str:
    """Text as one printable line; of a long one, the beginning and the end."""
    text = text if len(text) < 4 * _LONGEST else text[:_LONGEST] + text[-_LONGEST:]
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    head = _LONGEST - 100
    return text if len(text) <= _LONGEST else f"{text[:head]} ... {text[head + 5 - _LONGEST :]}"


def shown(value: object) -> str:
    """A value in a message: its `repr`, cut where it is long."""
    try:
        return _SHORT.repr(value)
    except ValueError:  # Python writes no integer of over 4300 digits
        return f"a {type(value).__name__} of too many digits"


class Lines(dict[str, int]):
    """The line of each key of a file, keys such as "surfaces[0].radius"."""

    def of(self, key: str) -> str:
        """ ", line 7" of a key or of what it is in; nothing where none is known."""
        while key and key not in self:
            key = key[: max(key.rfind("."), key.rfind("["), 0)]
        return f", line {self[key]}" if key else ""


def read_text(path: str | os.PathLike, largest: int = LARGEST) -> str:
    """Text of a file of at most so many bytes. InputError for what cannot be read."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):
            raise InputError("is not a file; give the path of a YAML file")
        with open(path, "rb") as file:
            content = file.read(largest + 1)
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}") from error
    except ValueError as error:  # a path with a NUL; an InputError as it is
        raise error if isinstance(error, InputError) else InputError(str(error)) from error
    if len(content) > largest:
        raise InputError(f"is larger than {largest // 2**20} MB; is it the right file?")
    try:
        return content.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start} is no UTF-8 text; save the file as UTF-8") from error


def read_yaml(path: str | os.PathLike) -> tuple[Any, Lines]:
    """What a YAML file holds, and the lines of its keys; see `parse`."""
    return parse(read_text(path))


def parse(text: str) -> tuple[Any, Lines]:
    """What YAML text holds: dict, list, str, int, float, bool, None; and the lines of its keys.

    InputError, with the line, for what is not YAML or is refused, see above.
    """
    building = _Building()
    try:
        for event in yaml.parse(text, Loader=_Loader):
            building.take(event)
    except yaml.YAMLError as error:
        mark, problem = getattr(error, "problem_mark", None), getattr(error, "problem", None)
        where = f"line {mark.line + 1}: " if mark else ""
        raise InputError(f"{where}not YAML: {problem or error}") from error
    return building.root, building.lines


class _Open:
    """A list or mapping that is being filled, what it is called, and the key that waits."""

    def __init__(self, value: Any, name: str):
        self.value, self.name, self.key = value, name, _NO_KEY

    def place(self) -> str:
        """What the next value is called."""
        if isinstance(self.value, list):
            return f"{self.name}[{len(self.value)}]"
        return f"{self.name}.{self.key}".lstrip(".")


class _Building:
    """Values built from the events of a parser, without recursion."""

    def __init__(self) -> None:
        self.root: Any = None
        self.lines = Lines()
        self._open: list[_Open] = []
        self._count = self._documents = 0

    def take(self, event: Any) -> None:
        """One event more."""
        line = event.start_mark.line + 1
        self._documents += isinstance(event, yaml.DocumentStartEvent)
        refused = {
            "an alias or an anchor (*name, &name)": getattr(event, "anchor", None) is not None,
            "a tag (!name)": getattr(event, "tag", None) is not None,
            "a second document": self._documents > 1,
            f"more than {_VALUES} values": self._count > _VALUES,
            f"nesting deeper than {_DEEPEST}": len(self._open) > _DEEPEST,
        }
        if any(refused.values()):
            what = next(what for what, is_so in refused.items() if is_so)
            raise InputError(f"line {line}: {what} is not taken; write the values out")
        if isinstance(event, yaml.ScalarEvent):
            self._add(_scalar(event, line), line)
        elif isinstance(event, yaml.CollectionStartEvent):
            value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
            self._open.append(_Open(value, self._add(value, line)))
        elif isinstance(event, yaml.CollectionEndEvent):
            self._open.pop()

    def _add(self, value: Any, line: int) -> str:
        """Put a value where it belongs; what it is called."""
        self._count += 1
        if not self._open:
            self.root = value
            return ""
        top = self._open[-1]
        if isinstance(top.value, list):
            place = top.place()
            top.value.append(value)
        elif top.key is _NO_KEY:
            if isinstance(value, dict | list):
                raise InputError(f"line {line}: a key must be text or a number")
            top.key = value
            place = top.place()
            if value in top.value:
                raise InputError(f"line {line}: {one_line(place)} is given twice", place)
        else:
            place = top.place()
            top.value[top.key], top.key = value, _NO_KEY
        self.lines.setdefault(place, line)
        return place


def _scalar(event: Any, line: int) -> Any:
    """A word, quoted or not, as YAML 1.1 reads it, but no date and no number of sixties."""
    text = event.value
    if not event.implicit[0]:
        return text
    tag = _RESOLVER.resolve(yaml.ScalarNode, text, (True, False)).rpartition(":")[2]
    if tag not in ("null", "bool", "int", "float") or (tag != "null" and ":" in text):
        return text
    if tag in ("int", "float") and len(text) > _DIGITS:
        raise InputError(f"line {line}: a number of {len(text)} characters; at most {_DIGITS}")
    node = yaml.ScalarNode(f"tag:yaml.org,2002:{tag}", text)
    return getattr(_CONSTRUCTOR, f"construct_yaml_{tag}")(node)
