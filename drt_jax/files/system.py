"""The use of a lens according to another program's file: fields, wavelengths, aperture."""

import dataclasses
import math
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.paraxial import FirstOrder, first_order, image_height
from ..lens.scene import field_of_height
from .record import Record

ApertureKind = Literal[
    "pupil diameter", "f-number", "working f-number", "object NA", "object cone angle", "image NA"
]
_SAME = 1e-9  # relative tolerance of a stop size that a file gives twice
FieldKind = Literal["angle", "object height", "paraxial image height", "real image height"]


@dataclasses.dataclass(frozen=True)
class System:
    """A lens and how a file uses it.

    lens: the lens; its stop is as wide as the aperture of the file requires.
    distance: from the object to the first vertex, mm; may be inf.
    fields: (F, 2), radians along x and y, see `Scene`; None if the file gives real image heights,
        for which `field_of_image(lens, height, ...)` finds the fields.
    heights: (F, 2), the fields as in the file: degrees, or mm.
    field_kind: the kind of `heights`.
    field_weights: (F,).
    vignetting: (F, 5), per field the shift of the pupil in x and y and its compression in x and y,
        as fractions of its radius, and its rotation in radians: x' = shift + (1 - compression) x.
    wavelengths: (W,), um. wavelength_weights: (W,). primary: the index of the primary wavelength.
    aperture: the file's value for `aperture_kind`; None if the aperture is the size of the stop.
    ray_aiming: where the other program aims rays. `off`: at the paraxial entrance pupil, see
        `with_paraxial_pupil`. `chief` (CODE V): the chief ray at the centre of the stop, the others
        around it over an entrance pupil of paraxial width. Otherwise at the stop, as here.
    notes: features of the file that the lens lacks or that are read differently.
    """

    lens: Lens
    distance: float
    fields: np.ndarray | None
    heights: np.ndarray
    field_kind: FieldKind
    field_weights: np.ndarray
    vignetting: np.ndarray
    wavelengths: np.ndarray
    wavelength_weights: np.ndarray
    primary: int
    aperture: float | None
    aperture_kind: ApertureKind | None
    ray_aiming: str = ""
    notes: tuple[str, ...] = ()


def system_for(lens: Lens) -> System:
    """A lens with an object at infinity on the axis and the d line or, if the glasses exclude it,
    the middle of their range."""
    low, high = lens.dispersion.range
    wave = 0.5875618 if low <= 0.5875618 <= high else (low + high) / 2
    none, one = np.zeros((1, 2)), np.ones(1)
    waves = np.array([wave])
    return System(
        *(lens, math.inf, none, none, "angle", one, np.zeros((1, 5)), waves, one, 0, None, None)
    )


@dataclasses.dataclass
class Use:
    """The values for `System` as they are read. line: of the aperture."""

    line: int = 0
    aperture: float | None = None
    aperture_kind: ApertureKind | None = None
    field_kind: FieldKind = "angle"
    field_line: int = 0
    heights: list[tuple[float, float]] = dataclasses.field(default_factory=lambda: [(0.0, 0.0)])
    field_weights: list[float] = dataclasses.field(default_factory=lambda: [1.0])
    vignetting: list[list[float]] = dataclasses.field(default_factory=lambda: [[0.0] * 5])
    wavelengths: list[float] = dataclasses.field(default_factory=list)
    wavelength_weights: list[float] = dataclasses.field(default_factory=list)
    primary: int = 0
    primary_line: int = 0
    ray_aiming: str = ""
    stop: float | None = None


def lens_of(record: Record, use: Use) -> Lens:
    """The lens of a file, with its stop as wide as the aperture requires."""
    if not use.wavelengths:
        raise record.error(0, "no wavelength is given")
    if not 0 <= use.primary < len(use.wavelengths):
        many = len(use.wavelengths)
        raise record.error(use.primary_line, f"the primary wavelength is none of the {many}")
    direct = use.aperture_kind is None
    if direct and not use.stop:
        raise record.error(use.line, "the aperture is the size of the stop, which has none")
    lens = record.lens(use.stop if direct else None)
    try:
        lens.check_wavelengths(use.wavelengths)
    except ValueError as error:
        raise record.error(use.primary_line, str(error)) from None
    return lens if direct else _opened(record, use, lens, use.wavelengths[use.primary])


def system_of(record: Record, use: Use) -> System:
    """The lens of a file and its use."""
    lens = lens_of(record, use)
    wave = use.wavelengths[use.primary]
    heights = np.array(use.heights, float)
    return System(
        lens=lens,
        distance=record.distance,
        fields=_angles(record, use, lens, heights, wave),
        heights=heights,
        field_kind=use.field_kind,
        field_weights=np.array(use.field_weights, float),
        vignetting=np.array(use.vignetting, float),
        wavelengths=np.array(use.wavelengths, float),
        wavelength_weights=np.array(use.wavelength_weights, float),
        primary=use.primary,
        aperture=use.aperture,
        aperture_kind=use.aperture_kind,
        ray_aiming=use.ray_aiming,
        notes=tuple(record.notes),
    )


@jax.jit  # compiles one program instead of hundreds of small ones
def _paraxial(lens: Lens, distance: Array, wave: Array) -> tuple[FirstOrder, Array, Array]:
    """First-order data, the image height (mm) of a field of 45 degrees, and the refractive indices
    of object space and image space."""
    height = image_height(lens, jnp.full_like(distance, math.pi / 4), distance, wave)
    return first_order(lens, distance, wave), height, lens.index(wave)[jnp.array([0, -1])]


def _first(record: Record, lens: Lens, wave: float) -> tuple[FirstOrder, float, list[float]]:
    """The results of `_paraxial` for one wavelength, as numbers."""
    found = _paraxial(lens, *map(jnp.asarray, (record.distance, wave)))
    first, height, index = jax.tree.map(lambda a: np.asarray(a)[..., 0], found)
    return first, float(height), index.tolist()


def _opened(record: Record, use: Use, lens: Lens, wave: float) -> Lens:
    """The lens with its stop as wide as the aperture requires in paraxial optics."""
    semi, value = float(lens.semi_diameter[lens.stop]), float(use.aperture or 0)
    first, _, (front, last) = _first(record, lens, wave)
    place, radius = map(float, first.entrance_pupil)
    far, kind = record.distance, use.aperture_kind
    if value <= 0:
        raise record.error(use.line, f"the aperture must be above 0, got {value:g}")
    if kind == "pupil diameter":
        wide = value / 2
    elif kind == "f-number":
        wide = abs(float(first.effective_focal_length)) / value / 2
    elif kind == "object cone angle":  # in degrees
        if value >= 90:
            what = f"an object cone of {value:g} degrees from the axis"
            raise record.error(use.line, f"{what}: light that starts backwards is not traced")
        if math.isinf(far):
            raise record.error(use.line, "an object cone of an object at infinity")
        wide = abs(math.tan(math.radians(value)) * (far + place))
    elif kind == "object NA":
        sine = value / front
        if not (sine < 1 and math.isfinite(far)):
            raise record.error(use.line, f"no object at {far:g} mm has an NA of {value:g}")
        wide = abs(math.tan(math.asin(sine)) * (far + place))
    elif kind == "image NA" and math.isinf(far):
        wide = abs(float(first.effective_focal_length)) * value
    elif kind == "image NA":  # the object NA is the image NA times the magnification
        sine = value * abs(float(first.magnification)) / front
        if not sine < 1:
            raise record.error(use.line, f"there is no image NA of {value:g}")
        wide = abs(math.tan(math.asin(sine)) * (far + place))
    else:
        wide = radius / (value * last) * float(first.f_number)
    found = semi * wide / radius if radius else math.nan
    if not (math.isfinite(found) and 0 < found < 1e9):
        raise record.error(use.line, f"no stop makes {kind} {value:g}: is the lens afocal there?")
    if use.stop and math.isclose(found, use.stop, rel_tol=_SAME):
        lens, found = _without_rim(lens), use.stop
    return dataclasses.replace(lens, semi_diameter=lens.semi_diameter.at[lens.stop].set(found))


def _without_rim(lens: Lens) -> Lens:
    """The lens without the first clear circle about the vertex of its stop. The stop has the same
    size, and clipping twice would lose rays by rounding."""
    own = lens.apertures
    if own is None:
        return lens
    lies = zip(own.surfaces, own.kinds, own.blocks, strict=True)
    rims = [k for k, place in enumerate(lies) if place == (lens.stop, "circle", False)]
    keep = [k for k in range(len(own.surfaces)) if k not in rims[:1]]
    if not keep:
        return dataclasses.replace(lens, apertures=None)
    return dataclasses.replace(lens, apertures=own.only(keep))


def _angles(
    record: Record, use: Use, lens: Lens, heights: np.ndarray, wave: float
) -> np.ndarray | None:
    """The fields (F, 2), radians; None for real image heights."""
    far, line = record.distance, use.field_line
    if use.field_kind == "angle":
        beyond = bool(np.any(np.abs(heights) >= 90))
        if math.isinf(far):
            if beyond:
                record.notes.append(f"line {line}: fields of 90 degrees and more cannot be traced")
            return np.radians(heights)
        if beyond:
            raise record.error(line, "a field angle of 90 degrees and more; give object heights")
        place = float(_first(record, lens, wave)[0].entrance_pupil.position)
        if not math.isfinite(place):
            raise record.error(line, "field angles at a telecentric lens; give object heights")
        return np.asarray(field_of_height(-np.tan(np.radians(heights)) * (far + place), far))
    if use.field_kind == "object height":
        if math.isinf(far):
            raise record.error(line, "object heights of an object at infinity; give angles")
        return np.asarray(field_of_height(heights, far))
    if use.field_kind == "paraxial image height":
        scale = _first(record, lens, wave)[1]
        if not math.isfinite(scale) or not scale:
            raise record.error(line, "paraxial image heights of an image at infinity; give angles")
        return np.arctan(heights / scale)
    return None
