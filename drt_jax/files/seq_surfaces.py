"""Surfaces of `.seq` files: their commands, and conversion to prescription entries."""

import dataclasses
from collections.abc import Callable
from typing import Any

from ..lens.forms import noll_of_fringe
from .record import XY, Row, short
from .seq_text import SOLVES, Command

LETTERS = dict(zip("ABCDEFGHJ", range(4, 22, 2), strict=True))  # powers of r; CODE V has no I
RADIAL = {"AR": 4, "BR": 6, "CR": 8, "DR": 10}  # and of an anamorphic asphere
_LOPSIDED = ("AP", "BP", "CP", "DP")
_COEFFICIENTS = ("K", *LETTERS, "KX", "KY", *RADIAL, *_LOPSIDED, "CUF")
_POWERS = {"K", *LETTERS}
_TOROIDS = ("XTO", "YTO", "CYL")
# The coefficients of each kind of surface; those of SPS have numbers.
_KINDS: dict[str, set[str]] = {
    **{"SPH": set(), "CON": {"K"}, "ASP": _POWERS, **dict.fromkeys(_TOROIDS, _POWERS)},
    **{"AAS": {"KX", "KY", *RADIAL, *_LOPSIDED}, "SPS": set()},
}
# The types of SPS: form; numbers of the conic, of the first coefficient and of the norm radius (0:
# none); how many coefficients there are.
_SPECIAL = {
    "ODD": ("odd_asphere", 1, 2, 33, 30),
    "XYP": ("polynomial_xy", 1, 2, 0, 65),
    "QBF": ("qbfs", 17, 3, 1, 14),
    "ZFR": ("zernike", 1, 4, 3, 37),
}
_SPECIAL_TERMS, _LEAST = 99, 1e-6
MOVES = ("XDE", "YDE", "ZDE", "ADE", "BDE", "CDE")
# The commands of the size of each shape of aperture, along x and y.
SIZES = {"circle": ("CIR",), "rectangle": ("REX", "REY"), "ellipse": ("ELX", "ELY")}
_SHAPES = {key: kind for kind, keys in SIZES.items() for key in keys}
_MOST = 50  # apertures of a surface
_Sizes = dict[str, tuple[int, float]]


@dataclasses.dataclass
class Surface(Row):
    """What the commands of a surface have set so far; numbers are in units of the file.

    gap: distance to the next surface.
    curvature, curvature_x: 1/unit; curvature_x with its line, or None if it is not given.
    kind: a key of `_KINDS`.
    values: coefficients by key; the keys of SPS are C1, C2, ....
    special: the type of SPS.
    phase: values of the commands of gratings by key.
    glass: (line, word).
    moves: values of `MOVES` by key. turn: DAR, BEN, REV, RET or "". target: the surface to which
        RET returns. move_line: line of the last command of these.
    clips: apertures by use and label, (line, size) by key.
    """

    kind: str = "SPH"
    curvature: float = 0.0
    curvature_x: tuple[int, float] | None = None
    gap: float = 0.0
    glass: tuple[int, str] = (0, "")
    special: str = ""
    phase: dict[str, tuple[int, Any]] = dataclasses.field(default_factory=dict)
    moves: dict[str, float] = dataclasses.field(default_factory=dict)
    turn: str = ""
    target: int = 0
    move_line: int = 0
    clips: dict[tuple[str, str], _Sizes] = dataclasses.field(default_factory=dict)

    @property
    def moved(self) -> bool:
        """Whether the surface is decentred or tilted."""
        return any(self.moves.values())

    def entries(self) -> None:
        """Write form, curvature and coefficients as entries of a prescription."""
        kind, unit = self.kind, self.unit
        self.entry.setdefault("curvature", self.curvature / unit)
        for key, (line, value) in self.values.items():
            known = kind == "SPS" or key in _KINDS[kind] or not value
            self.require(known, f"{key} on a surface of kind {kind}", line)
        of_special = f"C{_SPECIAL[self.special][1]}" if self.special else "K"
        if conic := self.value({"AAS": "KY", "SPS": of_special}.get(kind, "K")):
            self.put("conic", conic, self.kind_line)
        if kind in _TOROIDS:
            self._toroid()
            return
        line, across = self.curvature_x or (0, self.curvature)
        if kind == "AAS":
            for key in _LOPSIDED:
                what = f"{key}, a lopsided asphere"
                self.require(not self.value(key), what, self.values.get(key, (0, 0.0))[0])
            own = {"curvature_x": across / unit, "conic_x": self.value("KX")}
            self.shape("biconic", self.powers(RADIAL), **own)
            return
        self.require(across in (0.0, self.curvature), f"a curvature in x on kind {kind}", line)
        if kind == "ASP":
            self.shape("asphere", self.powers(LETTERS))
        elif kind == "SPS":
            self._special_shape()

    def _toroid(self) -> None:
        """A curve in y rotated about an axis along y. For XTO the curve lies in x: our toroid,
        rotated by 90 degrees about z."""
        across = (self.curvature_x or (0, 0.0))[1] / self.unit
        along = self.curvature / self.unit
        turned = self.kind == "XTO" or (self.kind == "CYL" and across != 0)
        both = self.kind == "CYL" and across and along
        self.require(not both, "a cylinder that is curved both ways", self.kind_line)
        if turned:
            across, along = along, across
            self.put("tilt", [0.0, 0.0, 90.0], self.kind_line)
        self.shape("toroid", self.powers(LETTERS), curvature=along, curvature_x=across)

    def _special_shape(self) -> None:
        """The shape of a type of SPS."""
        (form, conic, first, own, count), found = _SPECIAL[self.special], dict[int, float]()
        self.values.setdefault("NRADIUS", self.values.get(f"C{own}", (0, 0.0)))
        for key, (line, value) in self.values.items():
            number = int(key[1:]) - first if key[1:].isdecimal() and key[0] == "C" else -1
            if 0 <= number < count:
                found |= {number: value} if value else {}
            else:
                known = not value or key in ("NRADIUS", f"C{conic}", f"C{own}")
                self.require(known, f"SCO {key} of SPS {self.special}", line)
        unit, radius = self.unit, self.value("NRADIUS")
        radius = radius if radius or self.special not in ("ODD", "XYP") else 1.0
        known = _LEAST <= radius <= 1 / _LEAST
        self.require(known, f"SPS {self.special} of NRADIUS {radius:g}", self.kind_line)
        terms: dict[Any, float] = {}
        for k, value in found.items():
            if form in ("qbfs", "zernike"):  # fringe polynomials are 1 at the rim
                number, rim = noll_of_fringe(k + 1) if form == "zernike" else (k, 1.0)
                terms[number] = value * unit / rim
            else:
                key, p = XY[k] if form == "polynomial_xy" else (k + 1, k + 1)
                terms[key] = value / radius**p * unit ** (1 - p)
        more = {"norm_radius": radius * unit} if form in ("qbfs", "zernike") else {}
        self.shape(form, terms, **more)

    def clip(self) -> float | None:
        """Write the apertures as entries of a prescription. For the stop, return the radius (mm) of
        a circle about its vertex, which may be the size of the stop; None if there is no such
        circle, and for other surfaces."""
        size = None
        for (use, label), sizes in self.clips.items():
            shapes = [] if use == "EDG" else self._shapes(sizes)  # a rim clips nothing
            if use == "HOL" and shapes:
                line = next(iter(sizes.values()))[0]
                self.record.note(line, f"{self.name}: a hole is read as an obscuration")
            for line, shape in shapes:
                if use != "CLR":
                    self.put_shape("obscuration", shape, line)
                elif self.put_clear(shape, line, bool(label)) and not label:
                    size = size if "centre" in shape else shape.get("circle") or size
        return size if self.entry.get("stop") else None

    def _shapes(self, sizes: _Sizes) -> list[tuple[int, dict[str, Any]]]:
        """The shapes of one use and label, each with its line."""
        value, found = {key: size * self.unit for key, (_, size) in sizes.items()}, []
        centre = [value.get("ADX", 0.0), value.get("ADY", 0.0)]
        turned = "tilt" in self.entry  # the axes of an XTO surface lie along y and -x
        centre = [centre[1], -centre[0]] if turned else centre
        turn = sizes.get("ARO", (0, 0.0))[1] % 180
        for kind in dict.fromkeys(_SHAPES[key] for key in sizes if key in _SHAPES):
            keys = SIZES[kind]
            line = next(own for key, (own, _) in sizes.items() if key in keys)
            self.require(all(key in value for key in keys), f"give both {' and '.join(keys)}", line)
            half = [value[key] for key in keys]
            if kind != "circle" and turn not in (0, 90):
                self.record.lacks(line, f"{self.name}: an aperture turned by {turn:g} degrees")
                continue
            half = half[::-1] if (turn == 90) != turned else half
            shape: dict[str, Any] = {kind: half[0] if kind == "circle" else half}
            found.append((line, shape | ({"centre": centre} if any(centre) else {})))
        return found

    def diffraction(self) -> None:
        """Write gratings and radial phases as entries of a prescription."""
        if not self.phase:
            return
        line, kind = self.phase.get("DIF", (next(iter(self.phase.values()))[0], ""))
        value = {key: own for key, (_, own) in self.phase.items()}
        what = short(f"DIF {kind} with HCT {value.get('HCT', '')}".removesuffix(" with HCT "))
        known = kind == "GRT" or (kind == "DOE" and value.get("HCT") == "R")
        self.require(known, f"{what}; known: GRT, DOE with HCT R", line)
        terms: dict[Any, float]
        if kind == "GRT":
            along = not (value.get("GRX") or value.get("GRZ"))
            self.require(along, "a grating whose lines are not along x", line)
            self.require(value.get("GRS"), "a grating without a spacing, GRS", line)
            form, order = "linear", value.get("GRO", 1.0)
            terms = {"y": 1 / (value["GRS"] * self.unit)}
        else:
            wave = value.get("HWL", 0.0) * 1e-6  # mm
            self.require(wave > 0, "a phase without a wavelength, HWL", line)
            found = {2 * int(k[1:]): v for k, v in value.items() if k[0] == "C"}
            form, order = "asphere", value.get("HOR", 1.0)
            terms = {p: v * self.unit ** (1 - p) / wave for p, v in found.items() if v}
        if terms and order:
            self.put("phase", {"form": form, "order": order, "coefficients": terms}, line)


def value_of(command: Command) -> float | None:
    """The value of a command; None for a solve, whose value is given elsewhere."""
    words = command.values
    if words and words[0][:3].upper() in SOLVES:
        command.record.solves.append(command.line)
        return None
    what = f"{command.key}: what is {short(' '.join(words[1:]))} behind its value?"
    command.require(len(words) < 2, what)
    return command.number()


def curvature(surface: Surface, command: Command) -> None:
    """Read RDY, CUY, RDX or CUX."""
    value = value_of(command)
    if value is None:
        return
    if command.key[:2] == "RD":
        value = 1 / value if abs(value) > 1e-12 else 0.0
    else:
        command.require(abs(value) <= 1e9, f"a curvature of {value:g}; which unit?")
    if command.key[2] == "X":
        surface.curvature_x = command.line, value
    else:
        surface.curvature, surface.lines["curvature"] = value, command.line


def thickness(surface: Surface, command: Command) -> None:
    """Read THI."""
    value = value_of(command)
    if value is not None:
        surface.gap, surface.lines["thickness"] = value, command.line


def glass(surface: Surface, command: Command) -> None:
    """Read a glass, AIR, REFL or REFR; REFR may also follow a glass."""
    modes = [word.upper()[:4] for word in command.values if word.upper()[:4] in ("REFL", "REFR")]
    names = [word for word in command.values if word.upper()[:4] not in ("REFL", "REFR")]
    what = f"{command.key} {short(' '.join(command.values))}: expected one glass, REFL or REFR"
    command.require(len(names) <= (command.key != "RMD") and len(modes) < 2, what)
    command.require(not names or "REFL" not in modes, "a glass and a mirror: give one of them")
    if modes or names:
        surface.entry.pop("mirror", None)
    if names or "REFL" in modes:
        surface.glass = command.line, names[0] if names else ""
    if "REFL" in modes:
        surface.put("mirror", True, command.line)


def _kind(surface: Surface, command: Command) -> None:
    """Read a kind of surface."""
    surface.kind, surface.kind_line, surface.special = command.key, command.line, ""
    if command.key != "SPS":
        return
    surface.special = short(command.values[0]).upper() if command.values else ""
    what = f"SPS {surface.special} is not read; known: {', '.join(_SPECIAL)}"
    surface.require(surface.special in _SPECIAL, what, command.line)
    if len(command.values) > 1:
        surface.values["NRADIUS"] = command.line, command.bounded(1)


def _coefficient(surface: Surface, command: Command) -> None:
    """Read a coefficient; SCO: C5, NRADIUS, or the names K and AR5."""
    number, name, own = command.of("C"), command.key, command
    if name == "SCO":
        named = not number and bool(command.values)
        own = dataclasses.replace(command, values=command.values[named:])
        name = f"C{number[0]}" if number else (command.values[0].upper() if named else "")
        if name == "K" and surface.special in _SPECIAL:
            name = f"C{_SPECIAL[surface.special][1]}"
        if name[:2] == "AR" and name[2:].isdecimal() and surface.special == "ODD" and len(name) < 5:
            name = f"C{int(name[2:]) + 1}"
        numbered = name[1:].isdecimal() and name[0] == "C" and len(name) < 4 and name != "C0"
        what = f"SCO {short(name)}: expected C1 to C{_SPECIAL_TERMS}"
        command.require(numbered or name == "NRADIUS", what)
    surface.values[name] = command.line, own.number()


def _diffract(surface: Surface, command: Command) -> None:
    """Read a command of a grating."""
    words, line, number, key = command.values, command.line, command.of("C"), command.key
    if key in ("DIF", "HCT"):
        surface.phase[key] = line, short(words[0]).upper() if words else ""
        return
    command.require((number is None) != (key == "HCO"), "HCO: expected HCO C1 and a number")
    if number:
        key = f"C{number[0]}"
        known = number[0].isdecimal() and 1 <= int(number[0]) <= 100
        command.require(known, f"HCO {key}: expected C1 to C100")
    surface.phase[key] = line, command.number()


def move(surface: Surface, command: Command) -> None:
    """Read one of `MOVES`, DAR, BEN, REV or RET; the reader sets the target of RET."""
    surface.move_line = command.line
    if command.key in MOVES:
        surface.moves[command.key] = command.bounded()
        return
    command.require(surface.turn in ("", command.key), f"both {surface.turn} and {command.key}")
    surface.turn = command.key


def _clip(surface: Surface, command: Command) -> None:
    """Read a size of an aperture."""
    own = surface.clips.setdefault((command.use or "CLR", command.label), {})
    command.require(len(surface.clips) <= _MOST, f"more than {_MOST} apertures of a surface")
    own[command.key] = command.line, command.bounded()


ON_SURFACES: dict[str, Callable[[Surface, Command], None]] = {
    **dict.fromkeys(("RDY", "CUY", "RDX", "CUX"), curvature),
    **{"THI": thickness, "GLA": glass, "RMD": glass},
    **dict.fromkeys(_KINDS, _kind),
    **dict.fromkeys((*_COEFFICIENTS, "SCO"), _coefficient),
    **dict.fromkeys((*_SHAPES, "ADX", "ADY", "ARO"), _clip),
    **dict.fromkeys((*MOVES, "DAR", "BEN", "REV"), move),
    **dict.fromkeys(("DIF", "HOR", "HWL", "HCT", "HCO"), _diffract),
    **dict.fromkeys(("GRO", "GRS", "GRX", "GRY", "GRZ"), _diffract),
}
