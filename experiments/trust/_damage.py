"""Random damage to files: to bytes, words, and values of the YAML tree."""

import copy
from typing import Any

import numpy as np
import yaml

# Words that a careless or hostile author may write.
_WORDS = (
    *("0", "-1", "1e-320", "1e308", "-1e39", ".inf", "-.inf", ".nan", "nan", "inf", "null", "~"),
    *("true", "no", "''", "'0x10'", "0x10", "1:30", "2001-99-99", "1_000", "1e", "--5", "9" * 400),
    *("9" * 5000, "[]", "{}", "[1, 2]", "{a: 1}", "[[1]]", "[asphere]", "{2: 1}", "!!int abc"),
    *("!!python/object/apply:os.getcwd []", "&a", "*a", "<<", "---", "...", "#", "\t", ": ", "- "),
    *("\x00", "\x1b[31m", "\ud83d\ude00", "\u202e", "é", "x" * 3000, "[" * 400, "{a: " * 400, "|"),
    *("surfaces", "radius", "coefficients", "sellmeier", "zernike", "qbfs", "toroid", "1.5", "inf"),
)
_VALUES: tuple[Any, ...] = (
    *(0, -1, 1, 2, 3, 1e-320, 1e308, -1e39, 1e30, float("inf"), float("-inf"), float("nan")),
    *(None, True, False, "", "a", "inf", "N-BK7", "835427", "air", [], {}, [1, 2], [1, 2, 3]),
    *({"circle": 1}, {2: 1e-3}, {4: 1e30}, {"x1y1": 1}, 10**30, -(10**18), "x" * 500, 1e-7),
    *("asphere", "zernike", "qbfs", "toroid", "biconic", "polynomial_xy", "linear", "sensor"),
)
# Changes of a few bytes and of a value, as often as they stand here.
_OF_BYTES = ("remove", "double", "flip", "write a word", "write a word", "cut", "double a line")
_OF_VALUES = ("exchange",) * 3 + ("scale",) * 2 + ("drop", "copy another", "rename")


def damaged(text: str, rng: np.random.Generator, values: float = 0.6) -> bytes:
    """A file with one to four random changes. values: fraction of changes to values of the YAML
    tree; the rest are to bytes."""
    content = text.encode("utf-8", "surrogatepass")
    for _ in range(rng.integers(1, 5)):
        change = _change_value if rng.random() < values else _change_bytes
        content = change(content, rng)
    return content


def _change_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    kind = _OF_BYTES[rng.integers(len(_OF_BYTES))]
    if kind == "double a line":
        lines = content.split(b"\n")
        k = int(rng.integers(len(lines)))
        return b"\n".join([*lines[: k + 1], *lines[k:]])
    first = int(rng.integers(len(content) + 1))
    last = min(len(content), first + int(rng.integers(1, 40)))
    before, after = content[:first], content[last:]
    if kind == "double":
        return content[:last] + content[first:]
    if kind == "flip":
        return before + bytes([rng.integers(256)]) + content[first + 1 :]
    if kind == "write a word":
        word = _WORDS[rng.integers(len(_WORDS))].encode("utf-8", "surrogatepass")
        return before + word + (after if rng.random() < 0.5 else content[first:])
    return before if kind == "cut" else before + after


def _change_value(content: bytes, rng: np.random.Generator) -> bytes:
    """Changes one value of a YAML file, at any depth; nothing if the file is none any more."""
    kind = _OF_VALUES[rng.integers(len(_OF_VALUES))]
    try:
        tree = yaml.safe_load(content) if len(content) < 50_000 else None
    except (yaml.YAMLError, ValueError, RecursionError):
        return content
    places: list[tuple[Any, Any]] = []  # container and key of each value
    nodes = [tree]
    while nodes:
        node = nodes.pop()
        keys = node if isinstance(node, dict) else range(len(node)) if type(node) is list else ()
        places += [(node, key) for key in keys]
        nodes += [node[key] for key in keys]
    if not places:
        return content
    node, key = places[rng.integers(len(places))]
    if kind == "exchange":
        node[key] = copy.deepcopy(_VALUES[rng.integers(len(_VALUES))])
    elif kind == "scale":
        if isinstance(node[key], int | float) and not isinstance(node[key], bool):
            node[key] = node[key] * float(rng.choice([-1, 0, 0.1, 3, 10, 1e6, 1e200]))
    elif kind == "drop":
        del node[key]
    elif kind == "copy another":
        other, place = places[rng.integers(len(places))]
        node[key] = copy.deepcopy(other[place])
    elif isinstance(node, dict):
        node[str(key) + "x"] = node.pop(key)
    text = yaml.safe_dump(tree, sort_keys=False, allow_unicode=True)
    return text.encode("utf-8", "surrogatepass")
