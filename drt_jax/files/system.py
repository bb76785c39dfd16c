"""The use of a lens according to another program's file: fields, wavelengths, aperture."""

import dataclasses
import math
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.paraxial import FirstOrder, first_order, image_height
from ..lens.scene import Scene, field_of_height
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

    @property
    def scene(self) -> Scene:
        """Fields, distance and wavelengths with their weights, for analyses and designs.

        ValueError for real image heights, which `field_of_image` turns into fields.
        """
        if self.fields is None:
            raise ValueError("fields: real image heights; find each by field_of_image(lens, ...)")
        weights = {"wavelength_weights": self.wavelength_weights}
        weights |= {"field_weights": self.field_weights}
        return Scene.radians(self.fields, self.distance, self.wavelengths, **weights)


def system_for(lens: Lens) -> System:
    """A lens with an object at infinity on the axis and the d line or, if the glasses exclude it,
    the middle of their range."""
    low, high = lens.dispersion.range
    wave = 0.5875618 if low <= 0.5875618 <= high else (low + high) / 2
    use = Use(wavelengths=[wave], wavelength_weights=[1.0])
    return System(lens, math.inf, np.zeros((1, 2)), **use.of_system())


@dataclasses.dataclass
class Use:
    """The values for `System` as they are read, by the same names. stop: its size, mm, where the
    file gives that. line, field_line, primary_line: of the aperture, the fields and the
    wavelengths."""

    aperture: float | None = None
    aperture_kind: ApertureKind | None = None
    field_kind: FieldKind = "angle"
    heights: list[tuple[float, float]] = dataclasses.field(default_factory=lambda: [(0.0, 0.0)])
    field_weights: list[float] = dataclasses.field(default_factory=lambda: [1.0])
    vignetting: list[list[float]] = dataclasses.field(default_factory=lambda: [[0.0] * 5])
    wavelengths: list[float] = dataclasses.field(default_factory=list)
    wavelength_weights: list[float] = dataclasses.field(default_factory=list)
    primary: int = 0
    ray_aiming: str = ""
    stop: float | None = None
    line: int = 0
    field_line: int = 0
    primary_line: int = 0

    def of_system(self) -> dict[str, Any]:
        """The fields of `System` that need no ray."""
        own = {key: value for key, value in vars(self).items() if key in _OWN}
        return {key: np.array(v, float) if isinstance(v, list) else v for key, v in own.items()}


_OWN = {field.name for field in dataclasses.fields(System)}


def lens_of(record: Record, use: Use) -> Lens:
    """The lens of a file, with its stop as wide as the aperture requires."""
    many, direct = len(use.wavelengths), use.aperture_kind is None
    record.require(many, 0, "no wavelength is given")
    what = f"the primary wavelength is none of the {many}"
    record.require(0 <= use.primary < many, use.primary_line, what)
    what = "the aperture is the size of the stop, which has none"
    record.require(use.stop or not direct, use.line, what)
    lens = record.lens(use.stop if direct else None)
    try:
        lens.check_wavelengths(use.wavelengths)
    except ValueError as error:
        raise record.error(use.primary_line, str(error)) from None
    return lens if direct else _opened(record, use, lens)


def system_of(record: Record, use: Use) -> System:
    """The lens of a file and its use."""
    lens = lens_of(record, use)
    fields, own = _angles(record, use, lens), use.of_system()
    return System(lens, record.distance, fields, notes=tuple(record.notes), **own)


@jax.jit  # compiles one program instead of hundreds of small ones
def _paraxial(lens: Lens, distance: Array, wave: Array) -> tuple[FirstOrder, Array, Array]:
    """First-order data, the image height (mm) of a field of 45 degrees, and the refractive indices
    of object space and image space."""
    height = image_height(lens, jnp.full_like(distance, math.pi / 4), distance, wave)
    return first_order(lens, distance, wave), height, lens.index(wave)[jnp.array([0, -1])]


def _first(record: Record, use: Use, lens: Lens) -> tuple[FirstOrder, float, list[float]]:
    """The results of `_paraxial` for the primary wavelength, as numbers."""
    found = _paraxial(lens, *map(jnp.asarray, (record.distance, use.wavelengths[use.primary])))
    first, height, index = jax.tree.map(lambda a: np.asarray(a)[..., 0], found)
    return first, float(height), index.tolist()


def _opened(record: Record, use: Use, lens: Lens) -> Lens:
    """The lens with its stop as wide as the aperture requires in paraxial optics."""
    semi, value = float(lens.semi_diameter[lens.stop]), float(use.aperture or 0)
    first, _, (front, last) = _first(record, use, lens)
    place, radius = map(float, first.entrance_pupil)
    focal = abs(float(first.effective_focal_length))
    far, kind = record.distance, use.aperture_kind
    record.require(value > 0, use.line, f"the aperture must be above 0, got {value:g}")
    if kind == "pupil diameter":
        wide = value / 2
    elif kind == "f-number":
        wide = focal / value / 2
    elif kind == "working f-number":
        wide = radius / (value * last) * float(first.f_number)
    elif kind == "image NA" and math.isinf(far):
        wide = focal * value
    elif kind == "object cone angle":  # in degrees
        what = f"an object cone of {value:g} degrees from the axis"
        what = f"{what}: light that starts backwards is not traced"
        record.require(value < 90, use.line, what)
        record.require(math.isfinite(far), use.line, "an object cone of an object at infinity")
        wide = abs(math.tan(math.radians(value)) * (far + place))
    else:  # an NA; that of the object is that of the image times the magnification
        at_image = kind == "image NA"
        sine = (value * abs(float(first.magnification)) if at_image else value) / front
        where = "there is no image NA of" if at_image else f"no object at {far:g} mm has an NA of"
        record.require(sine < 1 and math.isfinite(far), use.line, f"{where} {value:g}")
        wide = abs(math.tan(math.asin(sine)) * (far + place))
    found = semi * wide / radius if radius else math.nan
    what = f"no stop makes {kind} {value:g}: is the lens afocal there?"
    record.require(math.isfinite(found) and 0 < found < 1e9, use.line, what)
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
    return dataclasses.replace(lens, apertures=own.only(keep) if keep else None)


def _angles(record: Record, use: Use, lens: Lens) -> np.ndarray | None:
    """The fields (F, 2), radians; None for real image heights."""
    far, line, heights = record.distance, use.field_line, np.array(use.heights, float)
    if use.field_kind == "angle":
        beyond = bool(np.any(np.abs(heights) >= 90))
        if math.isinf(far):
            if beyond:
                record.note(line, "fields of 90 degrees and more cannot be traced")
            return np.radians(heights)
        what = "a field angle of 90 degrees and more; give object heights"
        record.require(not beyond, line, what)
        place = float(_first(record, use, lens)[0].entrance_pupil.position)
        what = "field angles at a telecentric lens; give object heights"
        record.require(math.isfinite(place), line, what)
        return np.asarray(field_of_height(-np.tan(np.radians(heights)) * (far + place), far))
    if use.field_kind == "object height":
        what = "object heights of an object at infinity; give angles"
        record.require(math.isfinite(far), line, what)
        return np.asarray(field_of_height(heights, far))
    if use.field_kind == "paraxial image height":
        scale = _first(record, use, lens)[1]
        what = "paraxial image heights of an image at infinity; give angles"
        record.require(math.isfinite(scale) and scale, line, what)
        return np.arctan(heights / scale)
    return None
