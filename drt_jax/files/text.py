"""Read the text of other programs' lens files: size limits, encodings, lines split into words."""

import codecs
import os
import re
from typing import NamedTuple

from ..inputs import InputError, one_line, read_bytes

LARGEST = 2**24  # bytes of a file
_MOST = 400_000  # lines
_LONGEST = 4000  # characters read of a line
_BOMS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class Words(NamedTuple):
    """A line of a file: its number from 1, its first word, the other words, and whether it is
    indented."""

    line: int
    key: str
    rest: list[str]
    indented: bool


def decoded(content: bytes) -> str:
    """The text of a file: its byte order mark or UTF-16's zero bytes decide, else UTF-8, else
    Latin-1. InputError, with the byte or character, if it is no text."""
    known = [name for mark, name in _BOMS if content.startswith(mark)]
    head = content[:1000]
    if not known and head[1::2].count(0) > len(head) // 4:
        known = ["utf-16-le"]
    elif not known and head[::2].count(0) > len(head) // 4:
        known = ["utf-16-be"]
    for name in known or ("utf-8", "latin-1"):
        try:
            text = content.decode(name)
        except UnicodeDecodeError as error:
            if known:
                raise InputError(
                    f"byte {error.start} is no {name} text: is the file cut short?"
                ) from error
            continue
        break
    odd = re.search("[\x00-\x08\x0e-\x19\x1b-\x1f]", text)
    if odd:
        raise InputError(f"character {odd.start()} is no text: is this a lens file?")
    return text


def lines_of(path: str | os.PathLike) -> list[str]:
    """The lines of a file of at most 16 MB. InputError if it cannot be read."""
    lines = decoded(read_bytes(path, LARGEST, "lens file")).splitlines()
    if len(lines) > _MOST:
        raise InputError(f"{len(lines)} lines are more than {_MOST}; is it the right file?")
    return lines


def words_of(lines: list[str]) -> list[Words]:
    """The lines of a file split into words, without empty lines; long notes are cut."""
    found = []
    for i, text in enumerate(lines):
        if len(text) > _LONGEST and re.match(r"\s*[A-Z]{4}\s+[-+.\d]", text):
            raise InputError(f"line {i + 1}: {len(text)} characters are more than {_LONGEST}")
        words = text[:_LONGEST].split()
        if words:
            found.append(Words(i + 1, one_line(words[0]).upper(), words[1:], text[0].isspace()))
    return found
