"""Parsing of CODE V `.seq` files: commands with their qualifiers and values."""

import dataclasses
import re
from collections.abc import Iterator
from decimal import Decimal

from ..inputs import InputError, one_line
from .record import LONGEST, Record, Words

_WIDEST = 100_000  # characters of a command over several lines
SURFACE = re.compile(r"S(\d{1,6}|O|I)?")
_QUALIFIER = re.compile(r"([SZFWC])(\d{1,6}|[OISK])(\.\.(?:\d{1,6}|[OISK]))?", re.IGNORECASE)
_LABEL = re.compile(r"L(['\"].*)", re.IGNORECASE | re.DOTALL)
# Letters of qualifiers other than S and Z, by key; with other keys, F2 is a glass.
_OTHERS = {
    "F": re.compile("[XY](AN|OB|IM|RI)|V[UL][XY]|WTF"),
    "W": re.compile("WL|WTW"),
    "C": re.compile("SCO|HCO"),
}
_USES = ("CLR", "EDG", "OBS", "HOL")
_PIECE = re.compile(r"""'[^']*'|"[^"]*"|[^'";!]+|.""", re.DOTALL)
_WORD = re.compile(r"""(?:'[^']*'|"[^"]*"|\S)+""")

# Ignored: names, drawing, variables, tolerances, ray aiming, analyses. They do not change rays.
COSMETIC = """
    LEN INI GO CWL SLB DER CLS DOR WID CUM THM POL PIK AUT VER INC
    CCY CCX THC GLC KC AC BC CC DC EC FC GC HC JC XDC YDC ZDC ADC BDC CDC SCC HCC CCF
""".split()  # noqa: SIM905
SOLVES = """
    PIM RED OAL HMY HMX HCY HCX UMY UMX UCY UCX IMY IMX ICY ICX APN APL CMY CMX EFL EFX EFY PIK
""".split()  # noqa: SIM905
# Commands that change rays and are refused.
REFUSED = """
    NSS GL1 GL2 INS DEL COP FLY SCA INV URN GRC GRI ARR CIG REG ELG SPL TRP GLB HOE HV1 HV2 HX1 HX2
    HY1 HY2 HZ1 HZ2 XOD YOD ZOD MOD SWI AFI TEL USR UDS MIR
""".split()  # noqa: SIM905


@dataclasses.dataclass
class Command(Words):
    """A command.

    line: line where it starts.
    key: its first three letters; `S` and its suffix for a surface; the whole word if it is quoted.
    values: the words behind its qualifiers. A qualifier is a letter with first and last number as
        in the file.
    label, use: of an aperture, "" for none.
    """

    quoted: bool = False
    qualifiers: list[tuple[str, str, str]] = dataclasses.field(default_factory=list)
    label: str = ""
    use: str = ""

    def of(self, letter: str) -> tuple[str, str] | None:
        """First and last of a qualifier such as S3 or S3..5; None if it is not given."""
        return next((q[1:] for q in self.qualifiers if q[0] == letter), None)


def micrometres(nanometres: float) -> float:
    """A wavelength in um, rounded once: 587.5618 nm are 0.5875618 um."""
    return float(Decimal(repr(nanometres)).scaleb(-3))


def _cut(text: str) -> tuple[list[str], bool]:
    """Split a line at `;` up to `!`, outside quotes; also return whether `&` continues it."""
    parts = [""]
    for piece in _PIECE.findall(text):
        if piece == "!":
            break
        if piece == ";":
            parts.append("")
        else:
            parts[-1] += piece
    rest = parts.pop().rstrip()
    return [*parts, rest.removesuffix("&")], rest.endswith("&")


def _parts(lines: list[str]) -> Iterator[tuple[int, str]]:
    """The line number and the text of each command."""
    begun, waiting = 0, ""
    for i, text in enumerate(lines):
        if len(text) > LONGEST:
            raise InputError(f"line {i + 1}: {len(text)} characters are more than {LONGEST}")
        (first, *others), more = _cut(text)
        parts = [(begun or i + 1, waiting + first), *((i + 1, other) for other in others)]
        begun, waiting = parts.pop() if more else (0, "")
        if len(waiting) > _WIDEST:
            raise InputError(f"line {begun}: a command of more than {_WIDEST} characters")
        yield from parts
    if waiting:
        yield begun, waiting


def _bare(word: str) -> str:
    """A word without the quotes around it."""
    return word[1:-1] if len(word) > 1 and word[0] in "'\"" and word[-1] == word[0] else word


def commands_of(record: Record, lines: list[str]) -> Iterator[Command]:
    """The commands of a file in order. InputError if a line is too long."""
    for line, text in _parts(lines):
        words = _WORD.findall(text)
        if not words:
            continue
        first, quoted = _bare(words[0]), words[0][0] in "'\""
        if not quoted:
            first = one_line(first.upper())
            first = first if SURFACE.fullmatch(first) else first[:3]
        yield command_of(record, line, first, words[1:], quoted)


def command_of(
    record: Record, line: int, key: str, words: list[str], quoted: bool = False
) -> Command:
    """Make a command from its key and the words that follow it."""
    command = Command(record, line, key, [], quoted=quoted)
    letters = "SZ" + "".join(more for more, known in _OTHERS.items() if known.fullmatch(key))
    for at, word in enumerate(words):
        found, named = _QUALIFIER.fullmatch(word), _LABEL.fullmatch(word)
        if found and found[1].upper() in letters:
            first = found[2].upper()
            last = (found[3] or first).strip(".").upper()
            command.qualifiers.append((found[1].upper(), first, last))
        elif named:
            command.label = _bare(named[1])
        elif word.upper() in _USES:
            command.use = word.upper()
        else:
            command.values = [*map(_bare, words[at:])]
            break
    return command
