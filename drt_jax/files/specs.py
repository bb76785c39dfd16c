"""Build a lens from a prescription, a mapping; its entries are checked before any tracing."""

import dataclasses
import itertools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import shown, warn
from ..lens.edit import with_paraxial_pupil
from ..lens.elements import Elements
from ..lens.forms import FORMS
from ..lens.glass import POWERS, VISIBLE, Dispersion, Glass, model_glass
from ..lens.glasses import find_glass, flaw
from ..lens.lens import Labels, Lens
from ..lens.order import crossings, heights, neighbours
from ..lens.paraxial import (
    first_order,
    focal_length,
    marginal_ray,
    paraxial_system,
)
from ..lens.phase import Phase
from ..lens.scene import D_LINE
from ..numerics import array
from .apertures import apertures_of, semi_diameter
from .entry import STEEP, WIDE, Entry, LensError, require, table

SURFACES = 5000  # surfaces
_ELEMENTS = 500
_DENSEST = 10  # index
MEDIUM_KEYS = ("glass", "index", "nd", "vd", "dPgF")
_FOCUS = "focus"  # value of `sensor`
_TOP_KEYS = (
    *("name", "source", "focal_length", "glasses", "object", "surfaces", "elements"),
    *("sensor", "sensor_tilt", "sensor_decentre", "afocal", "pupil"),
)
_ELEMENT_KEYS = ("surfaces", "about", "pivot", "shift", "tilt")
# Prescriptions round semi-diameters: neighbours may cross beyond this fraction of the smaller
# semi-diameter.
_RIM = 0.9
# Between vertices closer than this (mm), rounding errors hide the direction of a ray.
CLOSEST = 1e-6
TOUCHING = CLOSEST - 1e-9  # sums of thicknesses are rounded
_SURFACE_KEYS = (
    *("form", "radius", "curvature", "conic", "radius_x", "curvature_x", "conic_x"),
    *("norm_radius", "coefficients", "thickness", *MEDIUM_KEYS, "mirror", "semi_diameter", "stop"),
    *("tilt", "decentre", "phase", "aperture", "obscuration"),
)


def _form(entry: Entry) -> str:
    form = entry.text("form", "asphere")
    known = form in FORMS
    entry.require(known, "form", f"unknown form {shown(form)}; known: {', '.join(FORMS)}")
    return form


def _coefficients(surface: Entry) -> list[float]:
    """The coefficients of a surface, or of its phase."""
    form = _form(surface)
    first, powers = FORMS[form].named, FORMS[form].powers
    for key in ("radius_x", "curvature_x", "conic_x", "norm_radius"):
        known = key.replace("radius_x", "curvature_x") in first
        surface.require(known or key not in surface, key, f"a surface of the form {form} has none")
    values = surface.get("coefficients", {})
    if isinstance(values, dict):  # a power may be given as text, as in JSON
        keys = [int(k) if isinstance(k, str) and k.isdecimal() else k for k in values]
        what = "one of them is given twice, as a number and as text"
        surface.require(len({*keys}) == len(keys), "coefficients", what)
        values = dict(zip(keys, values.values(), strict=True))
    given = Entry(values, surface.name("coefficients"), powers)
    columns = {len(first) + powers.index(power): given.number(power, most=WIDE) for power in given}
    if "curvature_x" in first:
        columns[0] = surface.curvature("_x")
    if "conic_x" in first:
        columns[1] = surface.number("conic_x", 0.0, most=STEEP)
    if "norm_radius" in first:
        columns[0] = surface.positive("norm_radius")
    return [columns.get(k, 0.0) for k in range(max(columns, default=-1) + 1)]


def _phase(surfaces: list[Entry]) -> Phase | None:
    """The diffractive phases of the surfaces; None if there are none."""
    keys = ("form", "order", "norm_radius", "coefficients")
    at = {i: s for i, s in enumerate(surfaces) if "phase" in s}
    given = [Entry(s["phase"], s.name("phase"), keys) for s in at.values()]
    if not given:
        return None
    known = [name for name, form in FORMS.items() if form.round]
    for entry in given:
        entry.require(_form(entry) in known, "form", f"expected one of {', '.join(known)}")
        entry.require(entry.get("coefficients"), "coefficients", "give at least one, in waves")
        entry.require(entry.number("order", 1.0) % 1 == 0, "order", "must be a whole number")
    rows = [*map(_coefficients, given)]
    return Phase(
        coefficients=table(rows, max(map(len, rows))),
        order=array([entry.number("order", 1.0) for entry in given]),
        surfaces=tuple(at),
        forms=tuple(map(_form, given)),
    )


def _elements(top: Entry, count: int) -> Elements | None:
    """The elements of a lens of `count` surfaces; None if there are none."""
    listed = top.get("elements", [])
    top.require(isinstance(listed, list), "elements", "expected a list")
    many = len(listed)
    top.require(many <= _ELEMENTS, "elements", f"{many} are more than {_ELEMENTS}")
    entries = [Entry(entry, f"elements[{g}]", _ELEMENT_KEYS) for g, entry in enumerate(listed)]
    # Outer elements precede the elements inside them.
    found = [(_span(entry, count), entry) for entry in entries]
    found.sort(key=lambda own: (own[0][0], -own[0][1]))
    if not found:
        return None
    for ((_, last), one), ((first, end), two) in itertools.combinations(found, 2):
        cuts = f"cuts into {one.place}: put one inside the other, or apart"
        two.require(not first <= last < end, "surfaces", cuts)
    spans, groups = zip(*found, strict=True)
    abouts = [_row(own, "about", own.get("about", first), count) for (first, _), own in found]
    return Elements(
        shift=array([entry.vector("shift", 3) or [0.0] * 3 for entry in groups]),
        tilt=jnp.radians(array([entry.vector("tilt", 3) or [0.0] * 3 for entry in groups])),
        pivot=array([entry.number("pivot", 0.0) for entry in groups]),
        spans=spans,
        about=tuple(abouts),
    )


def _span(entry: Entry, count: int) -> tuple[int, int]:
    """The first and the last surface of an element."""
    given: Any = entry.get("surfaces")
    wrong = f"expected [first, last], got {shown(given)}"
    entry.require(isinstance(given, list | tuple) and len(given) == 2, "surfaces", wrong)
    first, last = (_row(entry, "surfaces", end, count) for end in given)
    entry.require(first <= last, "surfaces", wrong)
    return first, last


def _row(entry: Entry, key: str, value: Any, count: int) -> int:
    """The index of a surface; `count` for the sensor."""
    row = count if value == "sensor" else value
    what = f"expected a surface, 0 to {count - 1}, or sensor; got {shown(value)}"
    entry.require(type(row) is int and 0 <= row <= count, key, what)
    return row


def _own_glass(name: str, entry: Entry) -> Glass:
    given = [key for key in ("sellmeier", "schott") if key in entry]
    entry.require(given, "", "give sellmeier, schott or both")
    terms = entry.get("sellmeier", [0.0, 0.0])
    if not isinstance(terms, list) or not terms or len(terms) % 2:
        raise entry.error("sellmeier", f"expected a list, all B and then all C, got {shown(terms)}")
    powers = entry.get("schott", [])
    more = isinstance(powers, list) and 6 < len(powers) <= len(POWERS)
    lengths = {"sellmeier": len(terms), "schott": len(powers) if more else 6}
    constants: dict[str, Any] = {key: tuple(entry.vector(key, lengths[key])) for key in given}
    low, high = entry.vector("range", 2) or VISIBLE
    what = f"expected 0 < shortest < longest, got {low:g} and {high:g} um"
    entry.require(0 < low < high, "range", what)
    glass = Glass(name, range=(low, high), **constants)
    if wrong := flaw(glass):
        raise entry.error("sellmeier" if "lies" in wrong else "", wrong)
    return glass


def _medium(entry: Entry, own: dict[str, Glass]) -> Glass:
    given = [key for key in ("glass", "index", "nd") if key in entry]
    entry.require(len(given) < 2, "", f"give either {' or '.join(given)}, not both")
    both = ("nd" in entry) == ("vd" in entry)
    entry.require(both, "", "nd and vd make a model glass together: give both or neither")
    if "nd" in entry:
        values = entry.number("nd"), entry.number("vd"), entry.number("dPgF", 0.0)
        with entry.naming("nd"):
            glass = model_glass(*values)
        return glass
    entry.require("dPgF" not in entry, "dPgF", "belongs to a model glass: give nd and vd as well")
    if "index" in entry:
        value = entry.number("index")
        entry.require(1 <= value <= _DENSEST, "index", f"{value:g} is not between 1 and {_DENSEST}")
        if value == 1:  # the same medium as air: a surface between the two refracts nothing
            return find_glass("air")
        return Glass(f"index {value!r}", schott=(value**2, 0.0, 0.0, 0.0, 0.0, 0.0))
    if "glass" not in entry:
        return find_glass("air")
    name = entry.text("glass", "air")
    if name in own:
        return own[name]
    with entry.naming("glass"):
        if len(name) == 6 and name.isdecimal():  # a glass code: 1000 (nd - 1), then 10 vd
            glass = model_glass(1 + int(name[:3]) / 1000, int(name[3:]) / 10)
        else:
            glass = find_glass(name)
    return glass


def _media(top: Entry, surfaces: list[Entry]) -> list[Glass]:
    """The medium in front of the lens, then the medium behind each surface."""
    names, keys = top.get("glasses", {}), ("sellmeier", "schott", "range")
    entries = Entry(names, "glasses", list(names) if isinstance(names, dict) else ["NAME"])
    each = {str(name): Entry(values, entries.name(name), keys) for name, values in entries.items()}
    own = {name: _own_glass(name, entry) for name, entry in each.items()}
    media = [_medium(Entry(top.get("object", {}), "object", MEDIUM_KEYS), own)]
    for surface in surfaces:
        mirror = surface.flag("mirror")
        for key in MEDIUM_KEYS:
            known = not mirror or key not in surface
            surface.require(known, key, "behind a mirror is the medium before it")
        media.append(media[-1] if mirror else _medium(surface, own))
    return media


def _gaps(top: Entry, surfaces: list[Entry]) -> list[float]:
    """Distances from each surface to the next and from the last to the sensor, mm."""
    gaps = [surface.number("thickness") for surface in surfaces[:-1]]
    what = "give either sensor (mm from the first vertex, or focus) or the last surface's "
    what = f"{what}thickness (its distance to the sensor)"
    require(("sensor" in top) != ("thickness" in surfaces[-1]), what, "sensor")
    if top.get("sensor") == _FOCUS:
        return [*gaps, 0.0]  # a placeholder until the lens is built
    end = top.number("sensor") - sum(gaps) if "sensor" in top else surfaces[-1].number("thickness")
    return [*gaps, end]


def build_lens(values: object, name: str = "lens") -> Lens:
    """Build a lens from a mapping with the keys of a prescription.

    If any surface or the sensor has a tilt or a decentre, even zero, the lens has arrays of both
    for all surfaces, which can be varied; else they are None and the lens is centred. The arrays
    have JAX's default floating dtype. LensError, naming the key, if the values make no lens.

    values: the mapping.
    name: the name of the lens if the mapping gives none.
    """
    top = Entry(values, "", _TOP_KEYS)
    entries = top.get("surfaces")
    if not isinstance(entries, list) or not entries:
        raise LensError("surfaces: expected a list of at least one surface", "surfaces")
    top.require(len(entries) <= SURFACES, "surfaces", f"{len(entries)} are more than {SURFACES}")
    surfaces = [Entry(e, f"surfaces[{i}]", _SURFACE_KEYS) for i, e in enumerate(entries)]
    stops = [i for i, surface in enumerate(surfaces) if surface.flag("stop")]
    top.require(len(stops) == 1, "surfaces", f"{len(stops)} have stop: true, exactly one must")
    # The last row of each list is that of the sensor.
    coefficients = [*map(_coefficients, surfaces), []]
    decentre = [*(s.vector("decentre", 2) for s in surfaces), top.vector("sensor_decentre", 2)]
    tilt = [*(s.vector("tilt", 3) for s in surfaces), top.vector("sensor_tilt", 3)]
    moved = any(decentre) or any(tilt)
    media, gaps = _media(top, surfaces), _gaps(top, surfaces)
    groups, focused = _elements(top, len(surfaces)), top.get("sensor") == _FOCUS
    lens = Lens(
        curvature=array([*(surface.curvature() for surface in surfaces), 0.0]),
        conic=array([*(surface.number("conic", 0.0, most=STEEP) for surface in surfaces), 0.0]),
        coefficients=table(coefficients, max(map(len, coefficients))),
        thickness=array(gaps[:-1]),
        semi_diameter=array([*map(semi_diameter, surfaces), math.inf]),
        sensor=array(sum(gaps) if focused else top.number("sensor", sum(gaps))),
        dispersion=Dispersion.of(media),
        decentre=table(decentre, 2) if moved else None,
        tilt=jnp.radians(table(tilt, 3)) if moved else None,
        phase=_phase(surfaces),
        elements=groups,
        apertures=apertures_of(surfaces),
        stop=stops[0],
        labels=Labels(top.text("name", name[:100]), tuple(medium.name for medium in media)),
        forms=(*map(_form, surfaces), "asphere"),
        mirrors=tuple(surface.flag("mirror") for surface in surfaces),
        afocal=top.flag("afocal"),
    )
    bent = (surface.curvature() or any(row) for surface, row in zip(surfaces, coefficients))
    curved = tuple(i for i, does in enumerate(bent) if does and i not in lens.active)
    lens = dataclasses.replace(lens, curved=curved)
    line = middle_of(lens)
    if focused:  # for an object at infinity
        place = first_order(lens, math.inf, line).image_distance[0]
        what = "focus: there is none, light leaves parallel; give mm and afocal: true"
        top.require(math.isfinite(float(place)), "sensor", what)
        lens = dataclasses.replace(lens, sensor=place)
        gaps[-1] = float(lens.sensor) - sum(gaps[:-1])
    _check_order(lens, gaps, [any(d) or any(t) for d, t in zip(decentre, tilt)], line)
    if "focal_length" in top:
        _check_focal_length(lens, top.number("focal_length"), line)
    pupil = top.text("pupil", "stop")
    known = pupil in ("stop", "paraxial")
    top.require(known, "pupil", f"expected stop or paraxial, got {shown(pupil)}")
    return with_paraxial_pupil(lens, line) if pupil == "paraxial" else lens


def middle_of(lens: Lens) -> float:
    """The d line or, if the glasses of a lens exclude it, the middle of their range, um."""
    low, high = lens.dispersion.range
    return D_LINE if low <= D_LINE <= high else (low + high) / 2


def _check_focal_length(lens: Lens, stated: float, wavelength: float) -> None:
    """Warn if the focal length differs from `stated` (mm) both in image space and in air."""
    found = float(focal_length(lens, wavelength)[0])
    air = float(first_order(lens, jnp.inf, wavelength).effective_focal_length[0])
    if not min(abs(found - stated), abs(air - stated)) <= 0.02 * abs(stated):
        warn(
            f"focal_length: {stated:g} mm is stated, but it is {found:g} mm at {wavelength:g} um: "
            "look for a wrong sign, unit or glass"
        )


@jax.jit
def _paraxial_beam(lens: Lens, wave: Array) -> Array:
    """Radius of the paraxial beam on each surface, from an object at infinity, mm."""
    return jnp.abs(marginal_ray(paraxial_system(lens, wave), jnp.zeros_like(wave)).height[:, 0])


def _check_order(lens: Lens, gaps: list[float], moved: list[bool], wave: float) -> None:
    """LensError if light would go backwards, or if neighbouring surfaces cross within both their
    apertures and within the axial beam. A warning if they cross only outside of the axial beam, or
    near the rim: rays that would go backwards there are lost. Also a warning for a sensor in front
    of the last surface, where the image is virtual.

    gaps, moved: see `lens.order.neighbours`, which returns the neighbours.
    wave: wavelength of the beam, um.
    """
    pairs = neighbours(lens, gaps, moved)
    for i, j, gap in pairs:
        if gap >= TOUCHING or (j == lens.count and i not in lens.active):
            continue
        key, forwards = f"surfaces[{i}].thickness", lens.senses[i + 1] > 0
        turned = "" if forwards else ", as a mirror has turned the light"
        if j < lens.count:
            reach = "" if j == i + 1 else f" up to surface {j}, in sum"
            least = f"{'positive' if forwards else 'negative'}{turned}, at least {CLOSEST} mm"
            remedy = "leave out one of two surfaces that touch"
            raise LensError(f"{key}{reach}: must be {least}; {remedy}", key)
        sensor = f"sensor: {float(lens.sensor):g} mm"
        vertex = f"the vertex of surface {i} at {float(lens.vertices[i]):g} mm"
        require(gap <= -CLOSEST, f"{sensor} touches {vertex}; move it by {CLOSEST} mm", "sensor")
        virtual = "rays are prolonged backwards to a virtual image"
        warn(f"{sensor} lies before {vertex}{turned}: {virtual}")
    semi = np.asarray(lens.semi_diameter)
    rows = zip(pairs, heights(lens, pairs)[1], crossings(lens, pairs), strict=True)
    for (i, j, gap), sags, place in rows:
        rim = min(semi[i], semi[j])
        if j == lens.count or np.isinf(rim):
            continue
        for k, sag in zip((i, j), sags, strict=True):
            what = f"surfaces[{k}]: not finite within {rim:g} mm of the axis; which unit?"
            require(np.all(np.isfinite(sag)), what, f"surfaces[{k}]")
        if place is None:
            continue
        message = (
            f"surfaces[{i}].thickness: {lens.senses[i + 1] * gap:g} mm makes surfaces {i} and {j} "
            f"cross at {place:.3g} mm from the axis, within their semi-diameters of "
            f"{semi[i]:g} and {semi[j]:g} mm; raise the thickness or lower a semi-diameter"
        )
        beam = np.asarray(_paraxial_beam(lens, jnp.asarray(wave, lens.curvature.dtype)))
        if place < min(_RIM * rim, max(beam[i], beam[j])):
            raise LensError(message, f"surfaces[{i}].thickness")
        warn(f"{message}; light that comes there is lost")
