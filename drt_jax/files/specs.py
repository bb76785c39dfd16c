"""Prescriptions: a lens built from a mapping, its entries checked before anything is traced."""

import difflib
import itertools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.glass import Dispersion, Glass, find_glass
from ..lens.lens import Lens
from ..lens.surface import FORMS, Shape, by_form, powers_xy, surface_sag

_TOP_KEYS = ("name", "source", "object", "surfaces", "sensor", "sensor_tilt", "sensor_decentre")
_MEDIUM_KEYS = ("glass", "index")
_SURFACE_KEYS = (
    *("form", "radius", "curvature", "conic", "radius_x", "curvature_x", "conic_x"),
    *("coefficients", "thickness", *_MEDIUM_KEYS, "mirror", "semi_diameter", "stop"),
    *("tilt", "decentre"),
)
_EVEN = tuple(range(2, 400, 2))
# What the columns of a form's coefficients are: keys of a surface, and after them powers.
_COLUMNS: dict[str, tuple[tuple[str, ...], tuple[int | str, ...]]] = {
    "asphere": ((), _EVEN),
    "odd_asphere": ((), tuple(range(1, 200))),
    "biconic": (("curvature_x", "conic_x"), _EVEN),
    "toroid": (("curvature_x",), _EVEN),
    "polynomial_xy": ((), tuple(f"x{i}y{j}" for i, j in powers_xy(230))),
}
# Forms whose conic is one of r, so that it ends at a rim.
_ROUND = ("asphere", "odd_asphere", "polynomial_xy")
# Neighbours that overlap by less at their rims touch (mm).
_TOUCH = 1e-4
# The direction of a ray between vertices closer than this (mm) drowns in rounding.
_CLOSEST = 1e-6
_by_form = jax.jit(by_form, static_argnums=(0, 3))


class LensError(ValueError):
    """A prescription that cannot be used; the message names the file, the key and the remedy."""


class _Entry:
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
        self.values: dict[Any, Any] = values
        for key in values:
            if key not in keys:
                near = difflib.get_close_matches(str(key), map(str, keys), n=1, cutoff=0.7)
                hint = f"did you mean {near[0]!r}? " if near else ""
                raise self.error("", f"unknown key {key!r}; {hint}known: {known}")

    def __contains__(self, key: object) -> bool:
        return key in self.values

    def name(self, key: object) -> str:
        """What the entry `key` is called in messages."""
        return f"{self.place}.{key}" if self.place else str(key)

    def error(self, key: object, message: str) -> LensError:
        """An error of the entry `key` or, if that is empty, of the mapping."""
        name = self.place if key == "" else self.name(key)
        return LensError(f"{name}: {message}" if name else message)

    def number(self, key: object, default: float | None = None, finite: bool = True) -> float:
        """A number, given as such or as text: YAML 1.1 reads 1e-3 and inf as text."""
        value = self.values.get(key, default)
        try:
            number = math.nan if isinstance(value, bool) or value is None else float(value)
        except (TypeError, ValueError):
            number = math.nan
        if math.isnan(number):
            raise self.error(key, f"expected a number, got {value!r}")
        if finite and math.isinf(number):
            raise self.error(key, "must be finite")
        return number

    def vector(self, key: str, length: int) -> list[float]:
        """A list of `length` numbers; empty if there is none."""
        values = self.values.get(key)
        if values is None:
            return []
        if not isinstance(values, list | tuple) or len(values) != length:
            raise self.error(key, f"expected a list of {length} numbers, got {values!r}")
        each = _Entry(dict(enumerate(values)), self.name(key), range(length))
        return [each.number(i) for i in range(length)]

    def flag(self, key: str) -> bool:
        """True or false; false if it is not given."""
        value = self.values.get(key, False)
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


class _Row(NamedTuple):
    """One row of a lens, a surface or the sensor.

    form, curvature, conic, coefficients, semi_diameter: as in `Lens`.
    decentre, tilt: mm and degrees, empty if they are not given.
    """

    form: str = "asphere"
    curvature: float = 0.0
    conic: float = 0.0
    coefficients: tuple[float, ...] = ()
    semi_diameter: float = math.inf
    decentre: Sequence[float] = ()
    tilt: Sequence[float] = ()


def _medium(entry: _Entry) -> Glass:
    if "glass" in entry and "index" in entry:
        raise entry.error("", "give either glass or index, not both")
    if "index" in entry:
        value = entry.number("index")
        if value < 1:
            raise entry.error("index", f"{value:g} is below 1")
        if value == 1:  # the same medium as air, so that a surface between both bends no light
            return find_glass("air")
        return Glass(f"index {value!r}", schott=(value**2, 0.0, 0.0, 0.0, 0.0, 0.0))
    try:
        return find_glass(str(entry.values.get("glass", "air")))
    except ValueError as error:
        raise entry.error("glass", str(error)) from error


def _media(top: _Entry, surfaces: list[_Entry]) -> list[Glass]:
    """The medium in front of the lens, and that behind each surface."""
    media = [_medium(_Entry(top.values.get("object", {}), "object", _MEDIUM_KEYS))]
    for surface in surfaces:
        if surface.flag("mirror"):
            for key in _MEDIUM_KEYS:
                if key in surface:
                    raise surface.error(key, "behind a mirror is the medium before it")
            media.append(media[-1])
        else:
            media.append(_medium(surface))
    return media


def _coefficients(surface: _Entry, form: str) -> tuple[float, ...]:
    first, powers = _COLUMNS[form]
    for key in ("radius_x", "curvature_x", "conic_x"):
        if key in surface and key.replace("radius", "curvature") not in first:
            raise surface.error(key, f"a surface of the form {form} has none")
    given = _Entry(surface.values.get("coefficients", {}), surface.name("coefficients"), powers)
    columns = {len(first) + powers.index(power): given.number(power) for power in given.values}
    if "curvature_x" in first:
        columns[0] = surface.curvature("_x")
    if "conic_x" in first:
        columns[1] = surface.number("conic_x", 0.0)
    return tuple(columns.get(k, 0.0) for k in range(max(columns, default=-1) + 1))


def _row(surface: _Entry) -> _Row:
    form = surface.values.get("form", "asphere")
    if form not in FORMS:
        raise surface.error("form", f"unknown form {form!r}; known: {', '.join(FORMS)}")
    row = _Row(
        form=form,
        curvature=surface.curvature(),
        conic=surface.number("conic", 0.0),
        coefficients=_coefficients(surface, form),
        semi_diameter=surface.number("semi_diameter", math.inf, finite=False),
        decentre=surface.vector("decentre", 2),
        tilt=surface.vector("tilt", 3),
    )
    if row.semi_diameter <= 0:
        raise surface.error("semi_diameter", "must be positive")
    bent = (1 + row.conic) * row.curvature**2
    if math.isfinite(row.semi_diameter) and form in _ROUND and bent * row.semi_diameter**2 >= 1:
        raise surface.error(
            "semi_diameter",
            f"{row.semi_diameter:g} mm reaches beyond the surface, which ends at "
            f"{bent**-0.5:g} mm; lower it, or the curvature",
        )
    return row


def _stop(surfaces: list[_Entry], rows: list[_Row]) -> int:
    """The index of the stop."""
    stops = [i for i, surface in enumerate(surfaces) if surface.flag("stop")]
    if len(stops) != 1:
        raise LensError(f"surfaces: {len(stops)} have stop: true, exactly one must")
    if math.isinf(rows[stops[0]].semi_diameter):
        raise surfaces[stops[0]].error("semi_diameter", "the stop needs one")
    return stops[0]


def _gaps(top: _Entry, surfaces: list[_Entry]) -> list[float]:
    """Distances from each surface to the next and from the last to the sensor, mm."""
    gaps = [surface.number("thickness") for surface in surfaces[:-1]]
    if ("sensor" in top) == ("thickness" in surfaces[-1]):
        raise LensError(
            "give either sensor (mm from the first vertex) or the last surface's thickness "
            "(its distance to the sensor)"
        )
    if "sensor" in top:
        return [*gaps, top.number("sensor") - sum(gaps)]
    return [*gaps, surfaces[-1].number("thickness")]


def build_lens(values: object, name: str = "lens") -> Lens:
    """A lens from a mapping with the keys of a prescription.

    If a tilt or a decentre is given anywhere, be it zero, those of all surfaces are arrays of
    the lens, which can be varied; else they are None and the lens has its axis. The arrays have
    JAX's default floating dtype. LensError, naming the key, for what makes no lens.

    values: the mapping.
    name: of the lens, where the mapping gives none.
    """
    top = _Entry(values, "", _TOP_KEYS)
    entries = top.values.get("surfaces")
    if not isinstance(entries, list) or not entries:
        raise LensError("surfaces: expected a list of at least one surface")
    surfaces = [_Entry(e, f"surfaces[{i}]", _SURFACE_KEYS) for i, e in enumerate(entries)]
    rows = [*map(_row, surfaces)]
    rows += [_Row(decentre=top.vector("sensor_decentre", 2), tilt=top.vector("sensor_tilt", 3))]
    media, gaps = _media(top, surfaces), _gaps(top, surfaces)
    columns = max(len(row.coefficients) for row in rows)
    moved = any(row.decentre or row.tilt for row in rows)
    lens = Lens(
        curvature=_array([row.curvature for row in rows]),
        conic=_array([row.conic for row in rows]),
        coefficients=_table([row.coefficients for row in rows], columns),
        thickness=_array(gaps[:-1]),
        semi_diameter=_array([row.semi_diameter for row in rows]),
        sensor=_array(top.number("sensor", sum(gaps))),
        dispersion=Dispersion.of(media),
        decentre=_table([row.decentre for row in rows], 2) if moved else None,
        tilt=jnp.radians(_table([row.tilt for row in rows], 3)) if moved else None,
        stop=_stop(surfaces, rows),
        glasses=tuple(medium.name for medium in media),
        forms=tuple(row.form for row in rows),
        mirrors=tuple(surface.flag("mirror") for surface in surfaces),
        name=str(top.values.get("name", name)),
    )
    pairs = _pairs(lens, rows, gaps)
    _check_order(lens, pairs)
    _check_crossing(lens, pairs)
    return lens


def _array(values: object) -> Array:
    """Numbers as an array of the default floating dtype; in this way nothing is compiled."""
    return jax.device_put(np.asarray(values, jnp.result_type(float)))


def _table(rows: Sequence[Sequence[float]], width: int) -> Array:
    """Rows of numbers as an array (rows, `width`), zeros behind what they lack."""
    return _array([[*row, *[0.0] * (width - len(row))] for row in rows])


class _Pair(NamedTuple):
    """Rows `i` and `j` that light on the axis meets one right after the other.

    distance: mm from the vertex of `i` to that of `j`, along the z axis.
    sense: 1 where light travels along that axis, -1 where a mirror has turned it.
    """

    i: int
    j: int
    distance: float
    sense: int


def _pairs(lens: Lens, rows: list[_Row], gaps: list[float]) -> list[_Pair]:
    """Neighbours among the surfaces that bend light; of the last pair, one is the sensor.

    The straight ray between two of them may cross a stop that bends none before the first or
    behind the second, so that it may lie anywhere. A pair of which one is tilted or decentred is
    left out: away from the axis, or at an angle to it, it may lie before its neighbour there and
    behind it where the light goes.
    """
    off = [any(row.decentre) or any(row.tilt) for row in rows]
    chain = itertools.pairwise([*(lens.live or (lens.stop,)), lens.count])
    return [
        _Pair(i, j, sum(gaps[i:j]), int(lens.senses[i + 1]))
        for i, j in chain
        if not off[i] and not off[j]
    ]


def _check_order(lens: Lens, pairs: list[_Pair]) -> None:
    """LensError where light would have to go backwards from a surface to the next or the sensor."""
    for i, j, distance, sense in pairs:
        if sense * distance >= _CLOSEST:
            continue
        turned = "" if sense > 0 else ", as a mirror has turned the light"
        if j == lens.count:
            raise LensError(
                f"sensor: {float(lens.sensor):g} mm lies before the vertex of surface {i} at "
                f"{float(lens.vertices[i]):g} mm{turned}"
            )
        reach = "" if j == i + 1 else f" up to surface {j}, in sum"
        raise LensError(
            f"surfaces[{i}].thickness{reach}: must be {'positive' if sense > 0 else 'negative'}"
            f"{turned}, at least {_CLOSEST} mm; leave out one of two surfaces that touch"
        )


def _check_crossing(lens: Lens, pairs: list[_Pair]) -> None:
    """LensError where neighbours overlap inside both their clear apertures."""
    pairs = [pair for pair in pairs if pair.j < lens.count]
    if not pairs:
        return
    semi = np.asarray(lens.semi_diameter)
    common = np.array([min(semi[pair.i], semi[pair.j]) for pair in pairs])
    radius = np.where(np.isfinite(common), common, 0)[:, None] * np.linspace(0, 1, 17)
    rows = [*(pair.i for pair in pairs), *(pair.j for pair in pairs)]
    y = np.concatenate([radius, radius]).astype(semi.dtype)
    shape = jax.tree.map(
        lambda a: np.asarray(a)[rows].T[..., None],
        Shape(lens.curvature, lens.conic, lens.coefficients),
    )
    z = _by_form(surface_sag, (np.zeros_like(y), y), shape, tuple(lens.forms[i] for i in rows))
    front, back = np.split(np.asarray(z), 2)
    for k, (i, j, distance, sense) in enumerate(pairs):
        overlap = sense * (front[k] - back[k] - distance)
        if np.any(overlap > _TOUCH):
            where = radius[k, np.argmax(overlap > _TOUCH)]
            raise LensError(
                f"surfaces[{i}].thickness: {distance:g} mm makes surfaces {i} and {j} cross at "
                f"{where:.3g} mm from the axis, within their semi-diameters of {semi[i]:g} and "
                f"{semi[j]:g} mm; raise the thickness or lower a semi-diameter"
            )
