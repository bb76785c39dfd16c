"""Write a lens as a CODE V `.seq` file, the inverse of `seq`."""

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from ..inputs import warn
from ..lens.forms import FORMS, noll_of_fringe
from ..lens.glass import (
    ANY,
    FRAUNHOFER,
    VISIBLE,
    Dispersion,
    model_glass,
    refractive_index,
)
from ..lens.glasses import find_glass
from ..lens.lens import Lens
from ..lens.paraxial import entrance_pupil
from .entry import LensError, require
from .load import System
from .record import turns_of
from .seq import FIELDS, VIGNETTING
from .seq_glass import folded, schott_through
from .seq_surfaces import LETTERS, MOVES, RADIAL, SIZES
from .seq_text import micrometres
from .written import (
    degrees_of,
    differing,
    element_of,
    entry_of,
    gap_behind,
    media_of_lens,
    number_for,
    place_of,
)

# By form: the type of SPS with what follows it, the largest number of coefficients, and the letters
# and the number of the first one.
_SPECIAL = {
    "odd_asphere": ("ODD 0.0", 30, "AR", 1),
    "polynomial_xy": ("XYP 1.0", 65, "C", 2),
    "qbfs": ("QBF", 14, "C", 3),
    "zernike": ("ZFR", 91, "C", 4),
}
_STILL = 1e-12  # mm, radians: below this a surface is on the axis of the surface before it


def seq_text(systems: Sequence[System]) -> str:
    """The text of a file of one zoom position or more. LensError, with the remedy, for features
    that are not written. If a model glass becomes a private glass, a warning gives its error.
    """
    texts = [_lines(system, len(systems) > 1) for system in systems]
    whole = ["\n".join(lines).replace(" &\n", " ").split("\n") for lines in texts]
    return "\n".join([*texts[0], *_zooms(whole), "GO", ""])


def _zooms(texts: Sequence[Sequence[str]]) -> list[str]:
    """The commands for the numbers that differ between zoom positions. texts: the lines of each."""
    found = [f"ZOO {len(texts)}"] if len(texts) > 1 else []
    last = sum(line.startswith("S") for line in texts[0]) - 1
    for surface, words, at, values in differing(texts, "S"):
        key, place = words[0], "SI" if surface == last else f"S{surface}"
        if key in ("S", "SO", "SI") and at in (1, 2):
            command = f"{'CUY' if at == 1 else 'THI'} {place}"
        elif surface >= 0 and len(words) == 2 and at == 1:
            command = f"{key} {place}"
        elif key in ("WL", "WTW") or key[1:] in FIELDS or key in (*VIGNETTING, "WTF"):
            command = f"{key} {'W' if key in ('WL', 'WTW') else 'F'}{at}"
        elif key == "EPD":
            command = key
        else:
            some = f"{' '.join(words)[:40]}, {' and '.join(values)}"
            raise LensError(f"zoom positions differ in {some}, which is not written")
        found += _wrapped(f"ZOO {command}", values)
    return found


def _lines(system: System, several: bool) -> list[str]:
    """The lines of one zoom position before GO: head, private glasses, fields and wavelengths, then
    the surfaces with their decentres and tilts. A model glass off the normal line becomes a private
    glass, with a warning of its error.

    several: True to write conics and vignetting of 0, which may differ in other positions.
    """
    lens, worst = system.lens, 0.0
    require(not lens.afocal, ".seq files hold no afocal image space here: save as .yaml or .zmx")
    media, own = media_of_lens(lens)
    for i, keys in enumerate(media):
        made, off = _made(keys, system.wavelengths)
        if made:
            own[f" {i}"], media[i], worst = made, {"glass": f" {i}"}, max(worst, off)
    if worst:
        what = "model glasses are private ones of .seq: their indices are the same at the"
        where = "from {:g} to {:g} um they differ by".format(*VISIBLE)
        what = f"{what} wavelengths in use and at F, d, C; {where} {worst:.1g} at most"
        warn(what)
    private = {name: f"G{k + 1}" for k, name in enumerate(own)}
    title = "".join(" " if c in "'\"" or not c.isprintable() else c for c in lens.name)
    wave = float(system.wavelengths[system.primary])
    pupil = 2 * float(entrance_pupil(lens, wave).semi_diameter[0])
    what = "the lens has no entrance pupil of finite size: save as .yaml"
    require(math.isfinite(pupil) and pupil > 0, what)
    lines = ["RDM N", "LEN", f"TITLE '{' '.join(title.split())}'", f"EPD {pupil!r}", "DIM M"]
    tables = [line for name in own for line in _private(name, private[name], own[name])]
    lines += [*_use(system, several), *(["PRV", *tables, "END"] if own else [])]
    words = [_word(keys, private) for keys in media]
    far = repr(float(system.distance)) if math.isfinite(system.distance) else "0.1e14"
    lines.append(f"SO 0.0 {far} {words[0]}".rstrip())
    places = _places(lens)
    for i in range(lens.count):
        word = "REFL" if lens.mirrors[i] else words[i + 1]
        lines.append(f"S {float(lens.curvature[i])!r} {gap_behind(lens, i)!r} {word}".rstrip())
        entry = entry_of(lens, i, {}) | ({"conic": float(lens.conic[i])} if several else {})
        lines += [f"  {line}" for line in _surface(i, entry) + places[i]]
    lines.append(f"SI {float(lens.curvature[-1])!r} 0.0")
    conic = float(lens.conic[-1])
    lines += [f"  {line}" for line in [*(["CON", f"K {conic!r}"] if conic else []), *places[-1]]]
    return lines


def _use(system: System, several: bool) -> list[str]:
    """The lines of wavelengths, fields and vignetting."""
    kind = next(key for key, kind in FIELDS.items() if kind == system.field_kind)
    dx, dy, cx, cy, turn = system.vignetting.T
    turned = np.any(turn * np.any(system.vignetting[:, :4], axis=1))
    require(not turned, "vignetting: .seq files hold no rotation: save as .zmx")
    columns = {
        "WL": [_nanometres(wave) for wave in system.wavelengths.tolist()],
        "WTW": system.wavelength_weights.tolist(),
        "REF": [system.primary + 1],
        f"X{kind}": system.heights[:, 0].tolist(),
        f"Y{kind}": system.heights[:, 1].tolist(),
        "WTF": system.field_weights.tolist(),
    }
    edges = {"VUX": cx - dx, "VLX": cx + dx, "VUY": cy - dy, "VLY": cy + dy}
    columns |= {key: edge.tolist() for key, edge in edges.items() if several or np.any(edge)}
    return [line for key, row in columns.items() for line in _wrapped(key, map(repr, row))]


def _wrapped(key: str, words: Iterable[str]) -> list[str]:
    """A command on several lines, which `&` continues."""
    text = textwrap.wrap(f"{key} {' '.join(words)}", 100, break_on_hyphens=False)
    return [*(f"{part} &" for part in text[:-1]), text[-1]]


def _made(keys: dict[str, Any], waves: np.ndarray) -> tuple[dict[str, Any], float]:
    """The constants of a private glass, and the error of its index between the wavelengths.

    A constant index or a model glass off the normal line becomes a private glass through its
    indices at the wavelengths in use and the lines F, d, C. Empty for other media.
    """
    if "index" in keys:
        return {"schott": [keys["index"] ** 2]}, 0.0
    if not keys.get("dPgF"):
        return {}, 0.0
    glass = Dispersion.of([model_glass(keys["nd"], keys["vd"], keys["dPgF"])])
    held = [*dict.fromkeys([*waves.tolist(), *FRAUNHOFER[:3]])][:5]
    at = np.array([*held, *np.linspace(*VISIBLE, 99)])
    indices = np.asarray(refractive_index(glass, jnp.asarray(at)), float)[0]
    constants, off = schott_through(at, indices, [*range(len(held))])
    return {"schott": constants, "range": [*VISIBLE]}, off


def _nanometres(wave: float) -> float:
    return number_for(wave, micrometres, wave * 1000)


def _private(name: str, called: str, constants: dict[str, Any]) -> list[str]:
    """The lines of a private glass, which the file defines by its constants."""
    low, high = constants.get("range", ANY)
    sellmeier, schott = constants.get("sellmeier"), constants.get("schott")
    holds, remedy = f"glass {name}: .seq files hold", "save as .yaml"
    require(not (sellmeier and schott), f"{holds} no two formulas at once: {remedy}")
    require(len(schott or ()) <= 6, f"{holds} powers from L^2 to L^-8: {remedy}")
    if sellmeier:
        half = len(sellmeier) // 2
        pairs = zip(sellmeier[:half], sellmeier[half:], strict=True)
        words = ["GMS", *(repr(value) for pair in pairs for value in pair)]
    else:
        words = ["LAU", *map(repr, schott or [1.0])]
    text = _wrapped(f"'{called}'", words)
    return [f"  {line}" for line in (f"PWL {_nanometres(high)!r} {_nanometres(low)!r}", *text)]


def _word(keys: dict[str, Any], private: dict[str, str]) -> str:
    """The word for a medium; "" for air."""
    if "nd" in keys:
        nd, vd = repr(keys["nd"]), repr(keys["vd"])
        if nd[:2] != "1." or not vd[:2].isdecimal() or vd[2:3] != "." or "e" in nd + vd:
            return f"{nd}:{vd}"
        return f"{nd[2:].ljust(3, '0')}.{(vd[:2] + vd[3:]).ljust(3, '0')}"
    name = keys.get("glass", "")
    if not name or name in private:
        return f"'{private[name]}'" if name else ""
    maker = find_glass(name).maker
    return folded(name.removesuffix(f"_{maker}")) + (f"_{maker}" if maker else "")


def _surface(i: int, entry: Mapping[str, Any]) -> list[str]:
    """The lines of a surface except those of its position."""
    lines = ["STO"] if "stop" in entry else []
    lines += [f"CIR {entry['semi_diameter']!r}"] if "semi_diameter" in entry else []
    lines += _form(i, entry)
    shapes = [("CLR", own) for own in entry.get("aperture", [])]
    shapes += [("OBS", own) for own in entry.get("obscuration", [])]
    for n, (use, own) in enumerate(shapes, 1):
        for kind, size in own.items():
            what = f"surfaces[{i}]: .seq files hold no polygon here: save as .yaml or .zmx"
            require(kind != "polygon", what)
            keys = SIZES.get(kind, ("ADX", "ADY"))
            values = size if isinstance(size, list) else [size]
            lines += [f"{key} {use} L'A{n}' {value!r}" for key, value in zip(keys, values)]
    return lines + (_phase(i, entry["phase"]) if "phase" in entry else [])


def _form(i: int, entry: Mapping[str, Any]) -> list[str]:
    """The lines of a surface's kind and of its coefficients."""
    name, conic, row = entry.get("form", "asphere"), entry.get("conic", 0.0), entry["coefficients"]
    values = [*row.values()]
    if name == "asphere" and any([*values[:1], *values[10:]]):  # ASP has r^4 to r^20
        name = "odd_asphere"
    letters = {p: key for key, p in (RADIAL if name == "biconic" else LETTERS).items()}
    used = {power: value for power, value in row.items() if value}
    if name in ("asphere", "toroid", "biconic"):
        for power in used:
            what = f"surfaces[{i}].coefficients: .seq files hold no r^{power} here: save as .yaml"
            require(power in letters, what)
        terms = [f"{letters[power]} {value!r}" for power, value in used.items()]
        if name == "asphere":
            head = ["ASP"] if terms else (["CON"] if "conic" in entry else [])
            return head + ([f"K {conic!r}"] if head else []) + terms
        across = f"CUX {entry['curvature_x']!r}"
        if name == "toroid":
            return ["YTO", across, f"K {conic!r}", *terms]
        return ["AAS", across, f"KY {conic!r}", f"KX {entry['conic_x']!r}", *terms]
    kind, most, key, first = _SPECIAL.get(name, ("", 0, "", 0))
    numbers = {power: k for k, power in enumerate(FORMS[name].powers)}
    count = max((numbers[power] + 1 for power in used), default=0)
    what = f"form {name} of {count + len(FORMS[name].named)} here: save as .yaml"
    require(count <= most, f"surfaces[{i}]: .seq files hold no {what}")
    lines = [f"SPS {kind}"]
    lines += [f"SCO NRADIUS {entry['norm_radius']!r}"] if "norm_radius" in entry else []
    lines.append(f"SCO K {conic!r}")
    if name == "zernike":
        return lines + _fringe(i, used)
    return lines + [f"SCO {key}{numbers[power] + first} {value!r}" for power, value in used.items()]


def _fringe(i: int, used: Mapping[int, float]) -> list[str]:
    """The lines of Zernike coefficients as fringe polynomials, which are 1 at the rim."""
    known = {noll: (k, rim) for k in range(1, 38) for noll, rim in [noll_of_fringe(k)]}
    lines = []
    for number, value in used.items():
        what = f"surfaces[{i}].coefficients: {number} is no fringe polynomial: save as .yaml"
        require(number in known, what)
        fringe, norm = known[number]
        own = number_for(value, norm.__rtruediv__, value * norm)
        lines.append(f"SCO C{fringe + 3} {own!r}")
    return lines


def _phase(i: int, phase: Mapping[str, Any]) -> list[str]:
    """The lines of a grating or a radial phase."""
    order, form, row = phase["order"], phase["form"], [*phase["coefficients"].values()]
    if form == "linear" and row[0]:
        spacing = number_for(row[0], lambda value: 1 / value, 1 / row[0])
        return ["DIF GRT", f"GRO {order!r}", f"GRS {spacing!r}"]
    if form == "asphere":
        wave = 587.5618 * 1e-6
        per_wave = [number_for(a, lambda v: v / wave, a * wave) if a else a for a in row]
        terms = [f"HCO C{k} {a!r}" for k, a in enumerate(per_wave, 1) if a]
        return ["DIF DOE", f"HOR {order!r}", "HWL 587.5618", "HCT R", *terms]
    raise LensError(f"surfaces[{i}].phase: .seq files hold no {form} phase here: save as .yaml")


def _places(lens: Lens) -> list[list[str]]:
    """The lines of decentre and tilt of each surface and the sensor.

    They are the values of the lens if it has no elements; the values of the elements if each
    rotates the axis at the vertex of its first surface and nothing else is moved; otherwise values
    relative to the surface before. For these, `point` and `turn` are the vertex and the axes that
    the next surface has without a move, and the lines are its difference from them.
    """
    own, count = lens.elements, lens.count + 1
    places = [place_of(lens, i) for i in range(count)]
    lines = [_moves([*at.get("decentre", []), 0.0], at.get("tilt", [])) for at in places]
    if own is None:
        return [[*found, "DAR"] if found else [] for found in lines]
    groups = [element_of(own, g) for g in range(len(own.spans))]
    firsts = {group["surfaces"][0] for group in groups}
    at_vertex = all(
        group["pivot"] == 0 and [group["about"], lens.count] == group["surfaces"]
        for group in groups
    )
    if at_vertex and len(firsts) == len(groups) and not any(lines):
        for group in groups:
            lines[group["about"]] = _moves(group["shift"], group["tilt"])
        return lines
    z, across, turned = (np.asarray(part, float) for part in lens.places)
    points = np.concatenate([across, z[:, None]], axis=1)
    point, turn = np.zeros(3), np.eye(3)
    for i in range(count):
        shift, tilt = turn.T @ (points[i] - point), np.radians(turns_of(turn.T @ turned[i]))
        moved = np.abs(shift).max() > _STILL or np.abs(tilt).max() > _STILL
        lines[i] = _moves(shift.tolist(), degrees_of(tilt)) if moved else []
        turn = turned[i] if moved else turn
        gap = gap_behind(lens, i) if i < lens.count else 0.0
        point = (points[i] if moved else point + turn @ shift) + turn @ [0, 0, gap]
    return lines


def _moves(shift: list[float], tilt: list[float]) -> list[str]:
    """The lines of a decentre (mm) and tilts (degrees)."""
    x, y, z = shift if len(shift) == 3 else [0.0] * 3
    a, b, c = tilt or [0.0] * 3
    values = [x, y, z, 0.0 - a, 0.0 - b, c]
    return [f"{key} {value!r}" for key, value in zip(MOVES, values, strict=True) if value]
