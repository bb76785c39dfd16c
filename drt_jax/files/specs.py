"""Prescriptions: a lens built from a mapping, its entries checked before anything is traced."""

import difflib
import itertools
import math
import warnings
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.glass import Dispersion, Glass, find_glass, model_glass
from ..lens.lens import Lens
from ..lens.surface import FORMS, Shape, powers_xy, surface_sag

_TOP_KEYS = ("name", "source", "object", "surfaces", "sensor", "sensor_tilt", "sensor_decentre")
_MEDIUM_KEYS = ("glass", "index", "nd", "vd")
_SURFACE_KEYS = (
    *("form", "radius", "curvature", "conic", "radius_x", "curvature_x", "conic_x"),
    *("coefficients", "thickness", *_MEDIUM_KEYS, "mirror", "semi_diameter", "stop"),
    *("tilt", "decentre"),
)
_EVEN = tuple(range(2, 400, 2))
# What the columns of a form's coefficients are: keys of a surface, and after them powers.
COLUMNS: dict[str, tuple[tuple[str, ...], tuple[int | str, ...]]] = {
    "asphere": ((), _EVEN),
    "odd_asphere": ((), tuple(range(1, 200))),
    "biconic": (("curvature_x", "conic_x"), _EVEN),
    "toroid": (("curvature_x",), _EVEN),
    "polynomial_xy": ((), tuple(f"x{i}y{j}" for i, j in powers_xy(230))),
}
# Forms whose conic is one of r, so that it ends at a rim.
_ROUND = ("asphere", "odd_asphere", "polynomial_xy")
# Neighbours that overlap by less at their rims touch (mm); from this part of the smaller
# semi-diameter on they may cross, as apertures of prescriptions are rounded.
_TOUCH, _RIM = 1e-4, 0.9
# The direction of a ray between vertices closer than this (mm) drowns in rounding.
_CLOSEST = 1e-6
_sag = jax.jit(surface_sag, static_argnums=2)


class LensError(ValueError):
    """A prescription that cannot be used; the message names the file, the key and the remedy."""


class _Entry(dict[Any, Any]):
    """A mapping in a prescription, and what its place is called in messages.

    values: the mapping.
    place: such as "surfaces[0]"; empty for the prescription itself.
    keys: those that it may have.
    """

    def __init__(self, values: object, place: str, keys: Sequence[Any]):
        self.place = place
        known = ", ".join(map(str, keys[:20])) + (", ..." if len(keys) > 20 else "")
        if not isinstance(values, dict):
            raise self.error("", f"expected a mapping with the keys {known}")
        super().__init__(values)
        for key in self:
            if key not in keys:
                near = difflib.get_close_matches(str(key), map(str, keys), n=1, cutoff=0.7)
                hint = f"did you mean {near[0]!r}? " if near else ""
                raise self.error("", f"unknown key {key!r}; {hint}known: {known}")

    def name(self, key: object) -> str:
        """What the entry `key` or, if that is empty, the mapping is called in messages."""
        return ".".join(filter(None, (self.place, str(key))))

    def error(self, key: object, message: str) -> LensError:
        """An error of the entry `key` or, if that is empty, of the mapping."""
        return LensError(": ".join(filter(None, (self.name(key), message))))

    def number(self, key: object, default: float | None = None, finite: bool = True) -> float:
        """A number, given as such or as text: YAML 1.1 reads 1e-3 and inf as text."""
        value: Any = self.get(key, default)
        try:
            number = math.nan if isinstance(value, bool) else float(value)
        except (TypeError, ValueError):
            number = math.nan
        if math.isnan(number):
            raise self.error(key, f"expected a number, got {value!r}")
        if finite and math.isinf(number):
            raise self.error(key, "must be finite")
        return number

    def vector(self, key: str, length: int) -> list[float]:
        """A list of `length` numbers; empty if there is none."""
        values = self.get(key)
        if values is None:
            return []
        if not isinstance(values, list | tuple) or len(values) != length:
            raise self.error(key, f"expected a list of {length} numbers, got {values!r}")
        each = _Entry(dict(enumerate(values)), self.name(key), range(length))
        return [each.number(i) for i in range(length)]

    def flag(self, key: str) -> bool:
        """True or false; false if it is not given."""
        value = self.get(key, False)
        if not isinstance(value, bool):
            raise self.error(key, "expected true or false")
        return value

    def curvature(self, suffix: str = "") -> float:
        """The curvature (1/mm) that `radius` or `curvature`, followed by `suffix`, tells."""
        radius, curvature = f"radius{suffix}", f"curvature{suffix}"
        if (radius in self) == (curvature in self):
            raise self.error("", f"give either {radius} (inf for a plane) or {curvature}")
        if curvature in self:
            return self.number(curvature)
        value = self.number(radius, finite=False)
        if value == 0:
            raise self.error(radius, f"0 is no surface; a plane is {radius}: inf")
        return 1 / value


def _medium(entry: _Entry) -> Glass:
    given = [key for key in ("glass", "index", "nd") if key in entry]
    if len(given) > 1:
        raise entry.error("", f"give either {' or '.join(given)}, not both")
    if ("nd" in entry) != ("vd" in entry):
        raise entry.error("", "nd and vd make a model glass together: give both or neither")
    if "nd" in entry:
        return _model_glass(entry, "nd", entry.number("nd"), entry.number("vd"))
    if "index" in entry:
        value = entry.number("index")
        if value < 1:
            raise entry.error("index", f"{value:g} is below 1")
        if value == 1:  # the same medium as air, so that a surface between both bends no light
            return find_glass("air")
        return Glass(f"index {value!r}", schott=(value**2, 0.0, 0.0, 0.0, 0.0, 0.0))
    name = str(entry.get("glass", "air"))
    if len(name) == 6 and name.isdecimal():  # the code of a glass: (nd - 1) 1000 and 10 vd
        return _model_glass(entry, "glass", 1 + int(name[:3]) / 1000, int(name[3:]) / 10)
    try:
        return find_glass(name)
    except ValueError as error:
        raise entry.error("glass", str(error)) from error


def _model_glass(entry: _Entry, key: str, nd: float, vd: float) -> Glass:
    try:
        return model_glass(nd, vd)
    except ValueError as error:
        raise entry.error(key, str(error)) from error


def _media(top: _Entry, surfaces: list[_Entry]) -> list[Glass]:
    """The medium in front of the lens, and that behind each surface."""
    media = [_medium(_Entry(top.get("object", {}), "object", _MEDIUM_KEYS))]
    for surface in surfaces:
        mirror = surface.flag("mirror")
        for key in _MEDIUM_KEYS:
            if mirror and key in surface:
                raise surface.error(key, "behind a mirror is the medium before it")
        media.append(media[-1] if mirror else _medium(surface))
    return media


def _form(surface: _Entry) -> str:
    form = surface.get("form", "asphere")
    if form not in FORMS:
        raise surface.error("form", f"unknown form {form!r}; known: {', '.join(FORMS)}")
    return form


def _coefficients(surface: _Entry) -> list[float]:
    form = _form(surface)
    first, powers = COLUMNS[form]
    for key in ("radius_x", "curvature_x", "conic_x"):
        if key in surface and key.replace("radius", "curvature") not in first:
            raise surface.error(key, f"a surface of the form {form} has none")
    given = _Entry(surface.get("coefficients", {}), surface.name("coefficients"), powers)
    columns = {len(first) + powers.index(power): given.number(power) for power in given}
    if "curvature_x" in first:
        columns[0] = surface.curvature("_x")
    if "conic_x" in first:
        columns[1] = surface.number("conic_x", 0.0)
    return [columns.get(k, 0.0) for k in range(max(columns, default=-1) + 1)]


def _semi_diameter(surface: _Entry) -> float:
    """The clear aperture, mm, which lies on the surface; of the stop it is finite."""
    semi = surface.number("semi_diameter", math.inf, finite=False)
    if semi <= 0:
        raise surface.error("semi_diameter", "must be positive")
    if math.isinf(semi):
        if surface.flag("stop"):
            raise surface.error("semi_diameter", "the stop needs one")
        return semi
    bent = (1 + surface.number("conic", 0.0)) * surface.curvature() ** 2
    if _form(surface) in _ROUND and bent * semi**2 >= 1:
        reach = f"{semi:g} mm reaches beyond the surface, which ends at {bent**-0.5:g} mm"
        raise surface.error("semi_diameter", f"{reach}; lower it, or the curvature")
    return semi


def _gaps(top: _Entry, surfaces: list[_Entry]) -> list[float]:
    """Distances from each surface to the next and from the last to the sensor, mm."""
    gaps = [surface.number("thickness") for surface in surfaces[:-1]]
    if ("sensor" in top) == ("thickness" in surfaces[-1]):
        raise LensError(
            "give either sensor (mm from the first vertex) or the last surface's thickness "
            "(its distance to the sensor)"
        )
    end = top.number("sensor") - sum(gaps) if "sensor" in top else surfaces[-1].number("thickness")
    return [*gaps, end]


def build_lens(values: object, name: str = "lens") -> Lens:
    """A lens from a mapping with the keys of a prescription.

    If a tilt or a decentre is given anywhere, be it zero, those of all surfaces are arrays of
    the lens, which can be varied; else they are None and the lens has its axis. The arrays have
    JAX's default floating dtype. LensError, naming the key, for what makes no lens.

    values: the mapping.
    name: of the lens, where the mapping gives none.
    """
    top = _Entry(values, "", _TOP_KEYS)
    entries = top.get("surfaces")
    if not isinstance(entries, list) or not entries:
        raise LensError("surfaces: expected a list of at least one surface")
    surfaces = [_Entry(e, f"surfaces[{i}]", _SURFACE_KEYS) for i, e in enumerate(entries)]
    stops = [i for i, surface in enumerate(surfaces) if surface.flag("stop")]
    if len(stops) != 1:
        raise LensError(f"surfaces: {len(stops)} have stop: true, exactly one must")
    # The last row of each is the sensor.
    coefficients = [*map(_coefficients, surfaces), []]
    decentre = [*(s.vector("decentre", 2) for s in surfaces), top.vector("sensor_decentre", 2)]
    tilt = [*(s.vector("tilt", 3) for s in surfaces), top.vector("sensor_tilt", 3)]
    moved = any(decentre) or any(tilt)
    media, gaps = _media(top, surfaces), _gaps(top, surfaces)
    lens = Lens(
        curvature=_array([*(surface.curvature() for surface in surfaces), 0.0]),
        conic=_array([*(surface.number("conic", 0.0) for surface in surfaces), 0.0]),
        coefficients=_table(coefficients, max(map(len, coefficients))),
        thickness=_array(gaps[:-1]),
        semi_diameter=_array([*map(_semi_diameter, surfaces), math.inf]),
        sensor=_array(top.number("sensor", sum(gaps))),
        dispersion=Dispersion.of(media),
        decentre=_table(decentre, 2) if moved else None,
        tilt=jnp.radians(_table(tilt, 3)) if moved else None,
        stop=stops[0],
        glasses=tuple(medium.name for medium in media),
        forms=(*map(_form, surfaces), "asphere"),
        mirrors=tuple(surface.flag("mirror") for surface in surfaces),
        name=str(top.get("name", name)),
    )
    _check_order(lens, gaps, [any(d) or any(t) for d, t in zip(decentre, tilt)])
    return lens


def _array(values: object) -> Array:
    """Numbers as an array of the default floating dtype; in this way nothing is compiled."""
    return jax.device_put(np.asarray(values, jnp.result_type(float)))


def _table(rows: list[list[float]], width: int) -> Array:
    """Rows of numbers as an array (rows, `width`), zeros behind what they lack."""
    return _array([[*row, *[0.0] * (width - len(row))] for row in rows])


def _check_order(lens: Lens, gaps: list[float], moved: list[bool]) -> None:
    """LensError where light would go backwards, or neighbours overlap in both their apertures; only
    a warning where they do so near the rim, where light then goes backwards and is lost.

    Neighbours are the surfaces that bend light, and the sensor behind the last. The straight ray
    between two of them may cross a stop that bends none before the first or behind the second, so
    that it may lie anywhere. A pair of which one is tilted or decentred is left out: away from the
    axis, or at an angle to it, it may lie before its neighbour there and behind it where the light
    goes.

    gaps: mm from each surface to the next and from the last to the sensor.
    moved: of each surface and the sensor.
    """
    chain = itertools.pairwise([*(lens.live or (lens.stop,)), lens.count])
    pairs = [(i, j, sum(gaps[i:j])) for i, j in chain if not moved[i] and not moved[j]]
    for i, j, distance in pairs:
        forwards = lens.senses[i + 1] > 0
        turned = "" if forwards else ", as a mirror has turned the light"
        if (distance if forwards else -distance) >= _CLOSEST:
            continue
        if j == lens.count:
            raise LensError(
                f"sensor: {float(lens.sensor):g} mm lies before the vertex of surface {i} at "
                f"{float(lens.vertices[i]):g} mm{turned}"
            )
        reach = "" if j == i + 1 else f" up to surface {j}, in sum"
        raise LensError(
            f"surfaces[{i}].thickness{reach}: must be {'positive' if forwards else 'negative'}"
            f"{turned}, at least {_CLOSEST} mm; leave out one of two surfaces that touch"
        )
    semi = np.asarray(lens.semi_diameter)
    shape = [np.asarray(a) for a in (lens.curvature, lens.conic, lens.coefficients)]
    for i, j, distance in pairs:
        rim = min(semi[i], semi[j])
        if j == lens.count or math.isinf(rim):
            continue
        y = np.linspace(0, rim, 257, dtype=semi.dtype)
        front, back = (
            np.asarray(_sag((0 * y, y), Shape(*(a[k] for a in shape)), lens.forms[k]))
            for k in (i, j)
        )
        crossed = lens.senses[i + 1] * (front - back - distance) > _TOUCH
        if not np.any(crossed):
            continue
        place = y[np.argmax(crossed)]
        message = (
            f"surfaces[{i}].thickness: {distance:g} mm makes surfaces {i} and {j} cross at "
            f"{place:.3g} mm from the axis, within their semi-diameters of "
            f"{semi[i]:g} and {semi[j]:g} mm; raise the thickness or lower a semi-diameter"
        )
        if place < _RIM * rim:
            raise LensError(message)
        warnings.warn(f"{message}; light that comes there is lost", stacklevel=4)
