"""Apertures of `.seq` files: commands with the same surface, use and label describe one."""

import dataclasses
from typing import Any

from .record import Record, Row
from .seq_text import Command

KEYS = ("CIR", "REX", "REY", "ELX", "ELY", "ADX", "ADY", "ARO")
_KINDS = {"C": "circle", "R": "rectangle", "E": "ellipse"}
_SIZES = {"C": ("CIR",), "R": ("REX", "REY"), "E": ("ELX", "ELY")}
_MOST = 50


@dataclasses.dataclass
class Clips:
    """Apertures of a surface. found: by use and label, (line, size in the file's unit) by key."""

    found: dict[tuple[str, str], dict[str, tuple[int, float]]] = dataclasses.field(
        default_factory=dict
    )

    def take(self, record: Record, command: Command) -> None:
        """Read a command of `KEYS`."""
        own = self.found.setdefault((command.use or "CLR", command.label), {})
        if len(self.found) > _MOST:
            raise record.error(command.line, f"more than {_MOST} apertures of a surface")
        own[command.key] = command.line, record.bounded(command.line, command.values)

    def entries(self, record: Record, row: Row, unit: float, stop: bool) -> float | None:
        """Write the apertures as prescription entries. Return the radius (mm) of a circle about the
        vertex of the stop, which `lens_of` may take for the stop itself; None if there is none."""
        size = None
        for (use, label), sizes in self.found.items():
            if use == "EDG":
                continue  # the rim of the glass clips nothing
            shapes = self._shapes(record, row, unit, sizes)
            if use == "HOL" and shapes:
                line = next(iter(sizes.values()))[0]
                record.notes.append(f"line {line}: {row.name}: a hole is read as an obscuration")
            for line, shape in shapes:
                if use == "CLR":
                    size = self._clear(row, line, shape, stop and not label, label) or size
                else:
                    row.put("obscuration", [*row.entry.get("obscuration", []), shape], line)
        return size

    def _shapes(
        self, record: Record, row: Row, unit: float, sizes: dict[str, tuple[int, float]]
    ) -> list[tuple[int, dict[str, Any]]]:
        """The shapes, each with its line."""
        value = {key: size for key, (_, size) in sizes.items()}
        centre = [value.get("ADX", 0.0) * unit, value.get("ADY", 0.0) * unit]
        turned = "tilt" in row.entry  # the axes of an XTO surface lie along y and -x
        centre = [centre[1], -centre[0]] if turned else centre
        found = []
        for letter in dict.fromkeys(key[0] for key in sizes if key[0] in _KINDS):
            keys = _SIZES[letter]
            line = next(own for key, (own, _) in sizes.items() if key in keys)
            if not all(key in value for key in keys):
                raise record.error(line, f"{row.name}: give both {' and '.join(keys)}")
            half = [value[key] * unit for key in keys]
            turn = value.get("ARO", 0.0) % 180
            if letter != "C" and turn not in (0, 90):
                record.lacks(line, f"{row.name}: an aperture turned by {turn:g} degrees")
                continue
            half = half[::-1] if (turn == 90) != turned else half
            shape: dict[str, Any] = {_KINDS[letter]: half[0] if letter == "C" else half}
            found.append((line, shape | ({"centre": centre} if any(centre) else {})))
        return found

    @staticmethod
    def _clear(row: Row, line: int, shape: dict[str, Any], stop: bool, label: str) -> float | None:
        radius, centred = shape.get("circle"), "centre" not in shape
        rim = (row.entry.get("conic", 0.0) + 1) * (row.entry["curvature"] * (radius or 0)) ** 2
        if centred and row.entry.get("form") is None and rim >= 1:
            return None  # it lies beyond the end of the surface
        plain = not label and not row.entry.get("stop") and "semi_diameter" not in row.entry
        if radius and centred and plain:
            row.put("semi_diameter", radius, line)
            return None
        row.put("aperture", [*row.entry.get("aperture", []), shape], line)
        return radius if stop and centred else None
