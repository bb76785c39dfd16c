"""Build a lens from a prescription, a mapping; its entries are checked before any tracing."""

import dataclasses
import math
import warnings

import jax.numpy as jnp

from ..inputs import shown
from ..lens.entrance import with_paraxial_pupil
from ..lens.forms import FORMS
from ..lens.glass import Dispersion
from ..lens.lens import Labels, Lens
from ..lens.paraxial import first_order, focal_length
from ..lens.phase import Phase
from .apertures import apertures_of, semi_diameter
from .elements import elements_of
from .entry import STEEP, WIDE, Entry, LensError, array, table
from .media import MEDIUM_KEYS, media_of
from .order import check_order

_D_LINE = 0.5875618  # um
_MOST = 5000  # surfaces
_FOCUS = "focus"  # value of `sensor`
_TOP_KEYS = (
    *("name", "source", "focal_length", "glasses", "object", "surfaces", "elements"),
    *("sensor", "sensor_tilt", "sensor_decentre", "afocal", "pupil"),
)
_SURFACE_KEYS = (
    *("form", "radius", "curvature", "conic", "radius_x", "curvature_x", "conic_x"),
    *("norm_radius", "coefficients", "thickness", *MEDIUM_KEYS, "mirror", "semi_diameter", "stop"),
    *("tilt", "decentre", "phase", "aperture", "obscuration"),
)


def _form(entry: Entry) -> str:
    form = entry.text("form", "asphere")
    if form not in FORMS:
        raise entry.error("form", f"unknown form {shown(form)}; known: {', '.join(FORMS)}")
    return form


def _coefficients(surface: Entry) -> list[float]:
    """The coefficients of a surface, or of its phase."""
    form = _form(surface)
    first, powers = FORMS[form].named, FORMS[form].powers
    for key in ("radius_x", "curvature_x", "conic_x", "norm_radius"):
        if key in surface and key.replace("radius_x", "curvature_x") not in first:
            raise surface.error(key, f"a surface of the form {form} has none")
    given = Entry(_numbered(surface), surface.name("coefficients"), powers)
    columns = {len(first) + powers.index(power): given.number(power, most=WIDE) for power in given}
    if "curvature_x" in first:
        columns[0] = surface.curvature("_x")
    if "conic_x" in first:
        columns[1] = surface.number("conic_x", 0.0, most=STEEP)
    if "norm_radius" in first:
        columns[0] = surface.number("norm_radius")
        if columns[0] <= 0:
            raise surface.error("norm_radius", "must be positive")
    return [columns.get(k, 0.0) for k in range(max(columns, default=-1) + 1)]


def _numbered(surface: Entry) -> object:
    """The entry `coefficients`; a power may be given as text, as in JSON."""
    given = surface.get("coefficients", {})
    if not isinstance(given, dict):
        return given
    keys = [int(key) if isinstance(key, str) and key.isdecimal() else key for key in given]
    if len({*keys}) < len(keys):
        raise surface.error("coefficients", "one of them is given twice, as a number and as text")
    return dict(zip(keys, given.values(), strict=True))


def _phase(surfaces: list[Entry]) -> Phase | None:
    """The diffractive phases of the surfaces; None if there are none."""
    keys = ("form", "order", "norm_radius", "coefficients")
    at = {i: s for i, s in enumerate(surfaces) if "phase" in s}
    given = [Entry(s["phase"], s.name("phase"), keys) for s in at.values()]
    if not given:
        return None
    for entry in given:
        known = [name for name, form in FORMS.items() if form.round]
        if _form(entry) not in known:
            raise entry.error("form", f"expected one of {', '.join(known)}")
        if not entry.get("coefficients"):
            raise entry.error("coefficients", "give at least one, in waves")
        if entry.number("order", 1.0) % 1:
            raise entry.error("order", "must be a whole number")
    rows = [*map(_coefficients, given)]
    return Phase(
        coefficients=table(rows, max(map(len, rows))),
        order=array([entry.number("order", 1.0) for entry in given]),
        surfaces=tuple(at),
        forms=tuple(map(_form, given)),
    )


def _gaps(top: Entry, surfaces: list[Entry]) -> list[float]:
    """Distances from each surface to the next and from the last to the sensor, mm."""
    gaps = [surface.number("thickness") for surface in surfaces[:-1]]
    if ("sensor" in top) == ("thickness" in surfaces[-1]):
        raise LensError(
            "give either sensor (mm from the first vertex, or focus) or the last surface's "
            "thickness (its distance to the sensor)",
            "sensor",
        )
    if top.get("sensor") == _FOCUS:
        return [*gaps, 0.0]  # a placeholder, see `_focused`
    end = top.number("sensor") - sum(gaps) if "sensor" in top else surfaces[-1].number("thickness")
    return [*gaps, end]


def _focused(lens: Lens, wavelength: float) -> Lens:
    """The lens with its sensor at the paraxial focus for an object at infinity."""
    place = first_order(lens, math.inf, wavelength).image_distance[0]
    if not math.isfinite(float(place)):
        raise LensError(
            "sensor: focus: there is none, light leaves parallel; give mm and afocal: true",
            "sensor",
        )
    return dataclasses.replace(lens, sensor=place)


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
    if len(entries) > _MOST:
        raise LensError(f"surfaces: {len(entries)} are more than {_MOST}", "surfaces")
    surfaces = [Entry(e, f"surfaces[{i}]", _SURFACE_KEYS) for i, e in enumerate(entries)]
    stops = [i for i, surface in enumerate(surfaces) if surface.flag("stop")]
    if len(stops) != 1:
        raise LensError(f"surfaces: {len(stops)} have stop: true, exactly one must", "surfaces")
    # The last row of each list is that of the sensor.
    coefficients = [*map(_coefficients, surfaces), []]
    decentre = [*(s.vector("decentre", 2) for s in surfaces), top.vector("sensor_decentre", 2)]
    tilt = [*(s.vector("tilt", 3) for s in surfaces), top.vector("sensor_tilt", 3)]
    moved = any(decentre) or any(tilt)
    media, gaps = media_of(top, surfaces), _gaps(top, surfaces)
    groups, focused = elements_of(top, len(surfaces)), top.get("sensor") == _FOCUS
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
    low, high = lens.dispersion.range
    line = _D_LINE if low <= _D_LINE <= high else (low + high) / 2
    if focused:
        lens = _focused(lens, line)
        gaps[-1] = float(lens.sensor) - sum(gaps[:-1])
    check_order(lens, gaps, [any(d) or any(t) for d, t in zip(decentre, tilt)], line)
    if "focal_length" in top:
        _check_focal_length(lens, top.number("focal_length"), line)
    return _with_pupil(top, lens, line)


def _with_pupil(top: Entry, lens: Lens, wavelength: float) -> Lens:
    """The lens with the pupil that the prescription asks for: `stop` or `paraxial`."""
    pupil = top.text("pupil", "stop")
    if pupil not in ("stop", "paraxial"):
        raise top.error("pupil", f"expected stop or paraxial, got {shown(pupil)}")
    return with_paraxial_pupil(lens, wavelength) if pupil == "paraxial" else lens


def _check_focal_length(lens: Lens, stated: float, wavelength: float) -> None:
    """Warn if the focal length differs from `stated` (mm) both in image space and in air."""
    found = float(focal_length(lens, wavelength)[0])
    air = float(first_order(lens, jnp.inf, wavelength).effective_focal_length[0])
    if not min(abs(found - stated), abs(air - stated)) <= 0.02 * abs(stated):
        warnings.warn(
            f"focal_length: {stated:g} mm is stated, but it is {found:g} mm at {wavelength:g} um: "
            "look for a wrong sign, unit or glass",
            stacklevel=4,
        )
