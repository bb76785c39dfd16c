"""Fields, vignetting and wavelengths of `.seq` files."""

from .record import Record
from .seq_text import Command
from .system import FieldKind, Use

_KINDS: dict[str, FieldKind] = {
    "AN": "angle",
    "OB": "object height",
    "IM": "paraxial image height",
    "RI": "real image height",
}
_VIGNETTING = ("VUX", "VLX", "VUY", "VLY")
FIELD_KEYS = (*(f"{axis}{kind}" for axis in "XY" for kind in _KINDS), *_VIGNETTING, "WTF")
WAVE_KEYS = ("WL", "WTW", "REF")
_MOST = 1000


class Fields:
    """The numbers by key as they are read, with the line of each key's last command."""

    def __init__(self) -> None:
        self.lists: dict[str, list[float]] = {}
        self.lines: dict[str, int] = {}

    def take(self, record: Record, command: Command) -> None:
        """Read a whole list, or one number of it if a qualifier F or W names its place."""
        key, line = command.key, command.line
        at = command.of("F") or command.of("W")
        values = record.numbers(line, command.values, max(len(command.values), 1))
        if len(values) > _MOST:
            raise record.error(line, f"{key}: more than {_MOST} numbers")
        self.lines[key] = line
        if at is None:
            self.lists[key] = values
            return
        if len(values) != 1 or not at[0].isdecimal() or at[0] != at[1]:
            raise record.error(line, f"{key}: expected one number behind one field or wavelength")
        place, own = int(at[0]) - 1, self.lists.setdefault(key, [])
        if not 0 <= place < _MOST:
            raise record.error(line, f"{key}: there is no number {place + 1}")
        own += [0.0] * (place + 1 - len(own))
        own[place] = values[0]

    @property
    def wavelengths(self) -> list[float]:
        """The wavelengths, um."""
        return [value / 1000 for value in self.lists.get("WL", [])]

    def finish(self, record: Record, use: Use, unit: float) -> None:
        """Write fields and wavelengths into `use`, as `System` holds them."""
        waves = self.wavelengths
        if waves and min(waves) <= 0:
            raise record.error(self.lines["WL"], f"a wavelength of {1000 * min(waves):g} nm")
        use.wavelengths = waves
        use.wavelength_weights = self._column(record, "WTW", 1.0, len(waves))
        reference = self.lists.get("REF", [float(len(waves) // 2 + 1)])[0]
        use.primary_line = self.lines.get("REF", 0)
        if reference % 1:
            raise record.error(use.primary_line, f"REF {reference:g}: expected a whole number")
        use.primary = int(reference) - 1
        if "REF" not in self.lists and len(waves) > 1:
            record.notes.append("no REF: the reference is the wavelength in the middle")
        given = [key for key in FIELD_KEYS if key in self.lists and key[1:] in _KINDS]
        kinds = {key[1:] for key in given} or {"AN"}
        if len(kinds) > 1:
            raise record.error(self.lines[given[-1]], f"fields of two kinds: {', '.join(given)}")
        (kind,) = kinds
        count = max((len(self.lists[key]) for key in given), default=1)
        use.field_kind = _KINDS[kind]
        use.field_line = max((self.lines[key] for key in given), default=0)
        scale = 1.0 if kind == "AN" else unit
        x, y = (self._column(record, f"{axis}{kind}", 0.0, count) for axis in "XY")
        use.heights = [(a * scale, b * scale) for a, b in zip(x, y, strict=True)]
        use.field_weights = self._column(record, "WTF", 1.0, count)
        ux, lx, uy, ly = (self._column(record, key, 0.0, count) for key in _VIGNETTING)
        use.vignetting = [
            [(b - a) / 2, (d - c) / 2, (a + b) / 2, (c + d) / 2, 0.0]
            for a, b, c, d in zip(ux, lx, uy, ly, strict=True)
        ]

    def _column(self, record: Record, key: str, default: float, count: int) -> list[float]:
        values = self.lists.get(key, [])
        if len(values) > count:
            raise record.error(self.lines[key], f"{key} has {len(values)} numbers for {count}")
        return values + [default] * (count - len(values))
