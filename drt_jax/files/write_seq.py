"""Write a lens as a CODE V `.seq` file, the inverse of `seq`."""

import math
import textwrap
import warnings
from collections.abc import Iterable
from typing import Any, get_args

import jax.numpy as jnp
import numpy as np

from ..lens.forms import noll_of_fringe
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
from .entry import LensError
from .exact import degrees_of, number_for
from .media_out import media_of_lens
from .record import turns_of
from .seq_glass import folded, schott_through
from .seq_places import KEYS
from .seq_surfaces import LETTERS
from .system import FieldKind, System
from .write_zmx import gap_behind

_KINDS = {"circle": ("CIR",), "rectangle": ("REX", "REY"), "ellipse": ("ELX", "ELY")}
_STILL = 1e-12  # mm, radians: below this a surface stands on the axis of the one before it


def seq_text(system: System) -> str:
    """The text of a file. LensError, with the remedy, for features that are not written; a warning
    tells how far a model glass differs that becomes a private one."""
    lens, worst = system.lens, 0.0
    if lens.afocal:
        raise LensError(".seq files hold no afocal image space here: save as .yaml or .zmx")
    media, own = media_of_lens(lens)
    for i, keys in enumerate(media):
        made, off = _made(keys, system.wavelengths)
        own |= {f" {i}": made} if made else {}
        media[i], worst = {"glass": f" {i}"} if made else keys, max(worst, off)
    if worst:
        warnings.warn(
            "model glasses are private ones of .seq: their indices are the same at the wavelengths "
            f"in use and at F, d, C; from {VISIBLE[0]:g} to {VISIBLE[1]:g} um they differ by "
            f"{worst:.1g} at most",
            stacklevel=3,
        )
    private = {name: f"G{k + 1}" for k, name in enumerate(own)}
    title = "".join(" " if c in "'\"" or not c.isprintable() else c for c in lens.name)
    pupil = _pupil(lens, float(system.wavelengths[system.primary]))
    lines = ["RDM N", "LEN", f"TITLE '{' '.join(title.split())}'", f"EPD {pupil!r}", "DIM M"]
    lines += _use(system)
    if own:
        lines.append("PRV")
        for name, constants in own.items():
            lines += _private(name, private[name], constants)
        lines.append("END")
    words = [_word(keys, private) for keys in media]
    far = repr(float(system.distance)) if math.isfinite(system.distance) else "0.1e14"
    lines.append(f"SO 0.0 {far} {words[0]}".rstrip())
    places = _places(lens)
    for i in range(lens.count):
        word = "REFL" if lens.mirrors[i] else words[i + 1]
        numbers = f"{float(lens.curvature[i])!r} {gap_behind(lens, i)!r}"
        lines.append(f"S {numbers} {word}".rstrip())
        lines += [f"  {line}" for line in _surface(lens, i) + places[i]]
    lines.append(f"SI {float(lens.curvature[-1])!r} 0.0")
    conic = float(lens.conic[-1])
    lines += [f"  {line}" for line in [*(["CON", f"K {conic!r}"] if conic else []), *places[-1]]]
    return "\n".join([*lines, "GO", ""])


def _use(system: System) -> list[str]:
    """The lines of wavelengths, fields and vignetting."""
    kind = dict(zip(get_args(FieldKind), ("AN", "OB", "IM", "RI"), strict=True))[system.field_kind]
    dx, dy, cx, cy, turn = system.vignetting.T
    if np.any(turn * np.any(system.vignetting[:, :4], axis=1)):
        raise LensError("vignetting: .seq files hold no rotation: save as .zmx")
    columns = {
        "WL": [_nanometres(wave) for wave in system.wavelengths.tolist()],
        "WTW": system.wavelength_weights.tolist(),
        "REF": [system.primary + 1],
        f"X{kind}": system.heights[:, 0].tolist(),
        f"Y{kind}": system.heights[:, 1].tolist(),
        "WTF": system.field_weights.tolist(),
    }
    edges = {"VUX": cx - dx, "VLX": cx + dx, "VUY": cy - dy, "VLY": cy + dy}
    columns |= {key: edge.tolist() for key, edge in edges.items() if np.any(edge)}
    return [line for key, row in columns.items() for line in _wrapped(key, map(repr, row))]


def _wrapped(key: str, words: Iterable[str]) -> list[str]:
    """A command on lines that `&` continues."""
    text = textwrap.wrap(f"{key} {' '.join(words)}", 100, break_on_hyphens=False)
    return [*(f"{part} &" for part in text[:-1]), text[-1]]


def _made(keys: dict[str, Any], waves: np.ndarray) -> tuple[dict[str, Any], float]:
    """The constants of a private glass for a constant index, or for a model glass off the normal
    line, through its indices at the wavelengths in use and the lines F, d, C; and how far its index
    is off elsewhere. Empty for other media."""
    if "index" in keys:
        return {"schott": [keys["index"] ** 2]}, 0.0
    if not keys.get("partial"):
        return {}, 0.0
    glass = Dispersion.of([model_glass(keys["nd"], keys["vd"], keys["partial"])])
    held = [*dict.fromkeys([*waves.tolist(), *FRAUNHOFER[:3]])][:5]
    at = np.array([*held, *np.linspace(*VISIBLE, 99)])
    indices = np.asarray(refractive_index(glass, jnp.asarray(at)), float)[0]
    constants, off = schott_through(at, indices, [*range(len(held))])
    return {"schott": constants, "range": [*VISIBLE]}, off


def _pupil(lens: Lens, wave: float) -> float:
    """The diameter of the entrance pupil, mm."""
    wide = 2 * float(entrance_pupil(lens, wave).semi_diameter[0])
    if not (math.isfinite(wide) and wide > 0):
        raise LensError("the lens has no entrance pupil of finite size: save as .yaml")
    return wide


def _nanometres(wave: float) -> float:
    return number_for(wave, lambda value: value / 1000, round(wave * 1000, 9))


def _private(name: str, called: str, constants: dict[str, Any]) -> list[str]:
    """The lines of a private glass, which the file defines by its constants."""
    low, high = constants.get("range", ANY)
    sellmeier, schott = constants.get("sellmeier"), constants.get("schott")
    if sellmeier and schott:
        raise LensError(f"glass {name}: .seq files hold no two formulas at once: save as .yaml")
    if schott and len(schott) > 6:
        raise LensError(f"glass {name}: .seq files hold powers from L^2 to L^-8: save as .yaml")
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


def _surface(lens: Lens, i: int) -> list[str]:
    lines = ["STO"] if i == lens.stop else []
    semi = float(lens.semi_diameter[i])
    lines += [f"CIR {semi!r}"] if math.isfinite(semi) else []
    lines += _form(lens, i)
    extra = lens.apertures
    own = [] if extra is None else [k for k, s in enumerate(extra.surfaces) if s == i]
    for n, k in enumerate(own):
        assert extra is not None
        if extra.kinds[k] == "polygon":
            raise LensError(
                f"surfaces[{i}]: .seq files hold no polygon here: save as .yaml or .zmx"
            )
        label = f"{'OBS' if extra.blocks[k] else 'CLR'} L'A{n + 1}'"
        half = np.asarray(extra.half[k]).tolist()
        lines += [f"{key} {label} {v!r}" for key, v in zip(_KINDS[extra.kinds[k]], half)]
        if extra.centre is not None:
            centre = np.asarray(extra.centre[k]).tolist()
            lines += [f"{key} {label} {v!r}" for key, v in zip(("ADX", "ADY"), centre)]
    return lines + _phase(lens, i)


def _powers(lens: Lens, i: int, row: list[float], keys: dict[int, str]) -> list[str]:
    """The lines of the coefficients of r^2, r^4, ...; keys: the key of each power."""
    found = {2 * k + 2: value for k, value in enumerate(row) if value}
    for power in found:
        if power not in keys:
            raise LensError(
                f"surfaces[{i}].coefficients: .seq files hold no r^{power} here: save as .yaml"
            )
    return [f"{keys[power]} {value!r}" for power, value in found.items()]


def _form(lens: Lens, i: int) -> list[str]:
    """The lines of a surface's kind and of its coefficients."""
    name, conic = lens.forms[i], float(lens.conic[i])
    row = np.asarray(lens.coefficients[i], float).tolist()
    even = {power: letter for letter, power in LETTERS.items()}
    if name == "asphere" and any([*row[:1], *row[10:]]):  # ASP has r^4 to r^20
        name, row = "odd_asphere", [own for value in row for own in (0.0, value)]
    if name == "asphere":
        terms = _powers(lens, i, row, even)
        kind = ["ASP"] if terms else (["CON"] if conic else [])
        return kind + ([f"K {conic!r}"] if kind else []) + terms
    if name == "toroid":
        head = ["YTO", f"CUX {row[0]!r}", f"K {conic!r}"]
        return head + _powers(lens, i, row[1:], even)
    if name == "biconic":
        radial = dict(zip((4, 6, 8, 10), ("AR", "BR", "CR", "DR"), strict=True))
        head = ["AAS", f"CUX {row[0]!r}", f"KY {conic!r}", f"KX {row[1]!r}"]
        return head + _powers(lens, i, row[2:], radial)
    used = max((k + 1 for k, value in enumerate(row) if value), default=0)
    if name == "odd_asphere" and used <= 30:
        terms = [f"SCO AR{k + 1} {value!r}" for k, value in enumerate(row) if value]
        return ["SPS ODD 0.0", f"SCO K {conic!r}", *terms]
    if name == "polynomial_xy" and used <= 65:
        terms = [f"SCO C{k + 2} {value!r}" for k, value in enumerate(row) if value]
        return ["SPS XYP 1.0", f"SCO K {conic!r}", *terms]
    if name == "qbfs" and used <= 15:
        terms = [f"SCO C{k + 3} {value!r}" for k, value in enumerate(row[1:]) if value]
        return ["SPS QBF", f"SCO NRADIUS {row[0]!r}", f"SCO K {conic!r}", *terms]
    if name == "zernike":
        return _fringe(i, row, conic)
    raise LensError(f"surfaces[{i}]: .seq files hold no form {name} of {used} here: save as .yaml")


def _fringe(i: int, row: list[float], conic: float) -> list[str]:
    known = {noll: (k, rim) for k in range(1, 38) for noll, rim in [noll_of_fringe(k)]}
    lines = ["SPS ZFR", f"SCO NRADIUS {row[0]!r}", f"SCO K {conic!r}"]
    for number, value in enumerate(row[1:], 1):
        if not value:
            continue
        if number not in known:
            raise LensError(f"surfaces[{i}].coefficients: {number} is no fringe polynomial: .yaml")
        fringe, norm = known[number]
        own = number_for(value, norm.__rtruediv__, value * norm)
        lines.append(f"SCO C{fringe + 3} {own!r}")
    return lines


def _phase(lens: Lens, i: int) -> list[str]:
    """The lines of a grating or a radial phase."""
    if lens.phase is None or i not in lens.phase.surfaces:
        return []
    at = lens.phase.surfaces.index(i)
    order, form = float(lens.phase.order[at]), lens.phase.forms[at]
    row = np.asarray(lens.phase.coefficients[at], float).tolist()
    if form == "linear" and row[0]:
        spacing = number_for(row[0], lambda value: 1 / value, 1 / row[0])
        return ["DIF GRT", f"GRO {order!r}", f"GRS {spacing!r}"]
    if form == "asphere":
        wave = 587.5618 * 1e-6
        terms = [
            f"HCO C{k + 1} {number_for(a, lambda v: v / wave, a * wave)!r}"
            for k, a in enumerate(row)
            if a
        ]
        return ["DIF DOE", f"HOR {order!r}", "HWL 587.5618", "HCT R", *terms]
    raise LensError(f"surfaces[{i}].phase: .seq files hold no {form} phase here: save as .yaml")


def _places(lens: Lens) -> list[list[str]]:
    """The lines of decentre and tilt of each surface and the sensor: the values of the lens if it
    has no elements, else those relative to the surface before."""
    if lens.elements is None:
        zero = np.zeros((lens.count + 1, 3))
        shift = zero[:, :2] if lens.decentre is None else np.asarray(lens.decentre, float)
        tilt = zero if lens.tilt is None else np.asarray(lens.tilt, float)
        return [
            [*_moves([*s, 0.0], t), "DAR"] if np.any(s) or np.any(t) else []
            for s, t in zip(shift.tolist(), tilt, strict=True)
        ]
    simple = _simple(lens)
    if simple is not None:
        return simple
    z, across, turned = (np.asarray(part, float) for part in lens.places)
    points = np.concatenate([across, z[:, None]], axis=1)
    point, turn, found = np.zeros(3), np.eye(3), []
    for i in range(lens.count + 1):
        shift, own = turn.T @ (points[i] - point), turn.T @ turned[i]
        tilt = np.radians(turns_of(own))
        moved = np.abs(shift).max() > _STILL or np.abs(tilt).max() > _STILL
        found.append(_moves(shift.tolist(), tilt) if moved else [])
        if i < lens.count:
            turn = turned[i] if moved else turn
            point = (points[i] if moved else point + turn @ shift) + turn @ [
                0,
                0,
                gap_behind(lens, i),
            ]
    return found


def _simple(lens: Lens) -> list[list[str]] | None:
    """The lines of `_places` if each element turns the axis at the vertex of its first surface and
    nothing else is moved; otherwise None."""
    own, last = lens.elements, lens.count
    assert own is not None
    firsts = [first for first, _ in own.spans]
    if np.any(lens.decentre if lens.decentre is not None else 0) or np.any(
        lens.tilt if lens.tilt is not None else 0
    ):
        return None
    at_vertex = not np.any(np.asarray(own.pivot)) and list(own.about) == firsts
    if not at_vertex or len({*firsts}) < len(firsts) or {end for _, end in own.spans} != {last}:
        return None
    found: list[list[str]] = [[] for _ in range(last + 1)]
    for g, first in enumerate(firsts):
        found[first] = _moves(np.asarray(own.shift[g], float).tolist(), np.asarray(own.tilt[g]))
    return found


def _moves(shift: list[float], tilt: np.ndarray) -> list[str]:
    a, b, c = (degrees_of(angle) for angle in tilt)
    values = [*shift, 0.0 - a, 0.0 - b, c]
    return [f"{key} {value!r}" for key, value in zip(KEYS, values, strict=True) if value]
