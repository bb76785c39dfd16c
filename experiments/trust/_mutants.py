"""Random damage to files: to bytes, words, and the YAML tree."""

import copy
from typing import Any

import numpy as np
import yaml

# Words of a hostile or careless author.
WORDS = (
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


def mutated(text: str, rng: np.random.Generator, trees: float = 0.6) -> bytes:
    """A file with one to four random changes. trees: fraction of changes to the YAML tree; the rest
    are to bytes."""
    content = text.encode("utf-8", "surrogatepass")
    for _ in range(rng.integers(1, 5)):
        spoil = _TREES if rng.random() < trees else _BYTES
        content = spoil[rng.integers(len(spoil))](content, rng)
    return content


def _slice(content: bytes, rng: np.random.Generator) -> tuple[int, int]:
    first = int(rng.integers(len(content) + 1))
    return first, min(len(content), first + int(rng.integers(1, 40)))


def _removed(content: bytes, rng: np.random.Generator) -> bytes:
    first, last = _slice(content, rng)
    return content[:first] + content[last:]


def _doubled(content: bytes, rng: np.random.Generator) -> bytes:
    first, last = _slice(content, rng)
    return content[:last] + content[first:]


def _flipped(content: bytes, rng: np.random.Generator) -> bytes:
    first, _ = _slice(content, rng)
    return content[:first] + bytes([rng.integers(256)]) + content[first + 1 :]


def _with_word(content: bytes, rng: np.random.Generator) -> bytes:
    first, last = _slice(content, rng)
    word = WORDS[rng.integers(len(WORDS))].encode("utf-8", "surrogatepass")
    return content[:first] + word + content[last if rng.random() < 0.5 else first :]


def _cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: _slice(content, rng)[0]]


def _line_doubled(content: bytes, rng: np.random.Generator) -> bytes:
    lines = content.split(b"\n")
    k = int(rng.integers(len(lines)))
    return b"\n".join([*lines[: k + 1], *lines[k:]])


def _tree(content: bytes) -> Any:
    """The YAML tree of a file; None if it is not YAML any more."""
    try:
        return yaml.safe_load(content) if len(content) < 50_000 else None
    except (yaml.YAMLError, ValueError, RecursionError):
        return None


def _places(tree: Any) -> list[tuple[Any, Any]]:
    """(container, key) of every value, at any depth."""
    found, rest = [], [tree]
    while rest:
        node = rest.pop()
        keys = node if isinstance(node, dict) else range(len(node)) if type(node) is list else ()
        for key in keys:
            found.append((node, key))
            rest.append(node[key])
    return found


def _of_tree(change: Any) -> Any:
    """Turns a change of the tree into one of a file's bytes."""

    def changed(content: bytes, rng: np.random.Generator) -> bytes:
        tree = _tree(content)
        places = _places(tree)
        if not places:
            return content
        node, key = places[rng.integers(len(places))]
        change(node, key, places, rng)
        return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True).encode(
            "utf-8", "surrogatepass"
        )

    return changed


def _put(node: Any, key: Any, places: list, rng: np.random.Generator) -> None:
    node[key] = copy.deepcopy(_VALUES[rng.integers(len(_VALUES))])


def _scaled(node: Any, key: Any, places: list, rng: np.random.Generator) -> None:
    if isinstance(node[key], int | float) and not isinstance(node[key], bool):
        node[key] = node[key] * float(rng.choice([-1, 0, 0.1, 3, 10, 1e6, 1e200]))


def _dropped(node: Any, key: Any, places: list, rng: np.random.Generator) -> None:
    del node[key]


def _moved(node: Any, key: Any, places: list, rng: np.random.Generator) -> None:
    other, place = places[rng.integers(len(places))]
    node[key] = copy.deepcopy(other[place])


def _renamed(node: Any, key: Any, places: list, rng: np.random.Generator) -> None:
    if isinstance(node, dict):
        node[str(key) + "x"] = node.pop(key)


_BYTES = (_removed, _doubled, _flipped, _with_word, _with_word, _cut, _line_doubled)
_TREES = tuple(map(_of_tree, (_put, _put, _put, _scaled, _scaled, _dropped, _moved, _renamed)))
