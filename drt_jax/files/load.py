"""Load lenses: the bundled ones, YAML prescriptions, and files of Zemax and CODE V with their
fields, wavelengths and aperture."""

import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import nearest, parse, read_text, require_one_of, shown
from ..lens.lens import Lens
from ..lens.paraxial import FirstOrder, entrance_pupil, first_order, image_height
from ..lens.scene import Scene, field_of_height
from .agf import load_agf
from .entry import LensError, require
from .record import ApertureKind, FieldKind, Missing, Record, Use, lines_of, naming
from .seq import read_seq
from .specs import build_lens, middle_of
from .zmx import read_zmx

_BUNDLED = pathlib.Path(__file__).resolve().parents[1] / "lens" / "catalogue" / "lenses"
_READERS = {".zmx": read_zmx, ".seq": read_seq}
_ENDINGS = (".yaml", ".yml", *_READERS)
_SAME = 1e-9  # relative tolerance of a stop size that a file gives twice


@dataclasses.dataclass(frozen=True)
class System:
    """A lens with the fields, wavelengths and aperture of its file.

    lens: the lens; the size of its stop follows from the aperture of the file.
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
    notes: features of the file that are missing in the lens or are read differently.
    configurations: number of configurations (zoom positions) of the file.
    configuration: number of the one that was read, from 1.
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
    aperture: float | None = None
    aperture_kind: ApertureKind | None = None
    ray_aiming: str = ""
    notes: tuple[str, ...] = ()
    configurations: int = 1
    configuration: int = 1

    @classmethod
    def of(cls, lens: Lens, scene: Scene) -> "System":
        """A lens with the fields, distance, wavelengths and weights of a scene, for `save_lens`.

        The fields are written as angles, measured at the entrance pupil as in other programs, or as
        object heights for a telecentric lens. The primary wavelength is the middle one.

        ValueError unless the scene has one distance.
        """
        fields = np.asarray(scene.field, float).reshape(-1, 2)
        waves = np.asarray(scene.wavelengths, float)
        distances = np.unique(np.asarray(scene.distance, float))
        require(len(distances) == 1, "scene: a file has one distance; make a system for each")
        primary = int(np.argsort(waves)[len(waves) // 2])
        far = abs(distances[0]) if np.isinf(distances[0]) else distances[0]
        place = float(entrance_pupil(lens, waves[primary]).position[0])
        kind: FieldKind = "object height" if math.isfinite(far) and math.isinf(place) else "angle"
        ratio = far / (far + place) if math.isfinite(far) else 1.0
        if kind == "angle":
            heights = np.degrees(np.arctan(ratio * np.tan(fields)))
        else:
            heights = -far * np.tan(fields)

        def weights(given: Array | None, count: int) -> np.ndarray:
            return np.ones(count) if given is None else np.asarray(given, float)

        return cls(
            lens,
            float(far),
            fields,
            heights,
            kind,
            field_weights=weights(scene.field_weights, len(fields)),
            vignetting=np.zeros((len(fields), 5)),
            wavelengths=waves,
            wavelength_weights=weights(scene.wavelength_weights, len(waves)),
            primary=primary,
        )

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
    use = Use(wavelengths=[middle_of(lens)], wavelength_weights=[1.0])
    return System(lens, math.inf, np.zeros((1, 2)), **_of_system(use))


def _of_system(use: Use) -> dict[str, Any]:
    """The fields of `System` that follow from the file without a ray trace."""
    names = {field.name for field in dataclasses.fields(System)}
    own = {key: value for key, value in vars(use).items() if key in names}
    return {key: np.array(v, float) if isinstance(v, list) else v for key, v in own.items()}


def lens_names() -> list[str]:
    """Names of the bundled prescriptions."""
    return sorted(path.stem for path in _BUNDLED.glob("*.yaml"))


def load_lens(
    source: str | pathlib.Path | Mapping,
    missing: Missing = "error",
    configuration: int | None = None,
) -> Lens:
    """Read a lens.

    The arrays have JAX's default floating dtype: float64 if the caller enabled it. LensError, with
    the line, for a missing file, an unknown key or glass, or numbers that make no lens.

    source: a bundled name (see `lens_names`), the path of a YAML prescription of at most 1 MB or
        of a Zemax `.zmx` or CODE V `.seq` file, see `load_system`, or a mapping with the keys of a
        prescription.
    missing, configuration: see `load_system`.
    """
    with jax.core.eval_context():  # a lens loaded inside a jitted function is a constant
        if isinstance(source, Mapping):
            return build_lens(_with_catalogues(dict(source), pathlib.Path()))
        path = pathlib.Path(source)
        if str(source) in lens_names():
            path = _BUNDLED / f"{source}.yaml"
        meant = nearest(source, lens_names())
        what = f"no bundled lens {shown(str(source))}{meant}; bundled: {', '.join(lens_names())}"
        remedy = f"for a file of your own give a path that ends in {', '.join(_ENDINGS)}"
        require(path.suffix, f"{what}; {remedy}")
        if known_ending(path) in _READERS:
            record = read_record(path, missing, configuration)
            lens = _lens_of(record)
            record.say()
            return lens
        only = f"{path}: configuration: a prescription in YAML has one alone"
        require(configuration is None, only)
        with naming(path):
            return _lens_of_yaml(read_text(path), path)


def known_ending(path: str | pathlib.Path) -> str:
    """The ending of a path in lower case. LensError if it is not one that is read and written."""
    kind = pathlib.Path(path).suffix.lower()
    require(kind in _ENDINGS, f"{path}: expected a name that ends in {', '.join(_ENDINGS)}")
    return kind


def lens_in(
    text: str, path: str | pathlib.Path, configuration: int | None = None
) -> tuple[Lens, dict[str, Any]]:
    """The lens in the text of a file, and the fields of `System` that need no ray trace (empty for
    a prescription). LensError as in `load_lens`. path: name of the file."""
    kind = known_ending(path)
    if kind not in _READERS:
        return _lens_of_yaml(text, pathlib.Path(path)), {}
    record = _READERS[kind](str(path), "error", text.splitlines(), configuration)
    return _lens_of(record), _of_system(record.use) | {"distance": record.distance}


def _lens_of_yaml(text: str, path: pathlib.Path) -> Lens:
    """The lens of a prescription. InputError if the text is not YAML."""
    values, lines = parse(text)
    try:
        return build_lens(_with_catalogues(values, path.parent), path.stem)
    except LensError as error:
        raise LensError(f"{path}{lines.of(error.key)}: {error}", error.key) from None


def _with_catalogues(top: Any, folder: pathlib.Path) -> Any:
    """Add the glasses that a prescription uses from its `catalogues` to its `glasses`.

    The glasses of the prescription take precedence over those of its catalogues, and these over the
    built-in table.
    """
    if not isinstance(top, dict) or "catalogues" not in top:
        return top
    paths, surfaces = top["catalogues"], top.get("surfaces")
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise LensError(f"catalogues: expected a list of paths, got {shown(paths)}", "catalogues")
    places = [top.get("object"), *(surfaces if isinstance(surfaces, list) else [])]
    used = [place.get("glass") for place in places if isinstance(place, dict)]
    found: dict[str, dict[str, list[float]]] = {}
    for path in paths:
        try:
            read = load_agf(folder / path, [name for name in used if isinstance(name, str)])
        except LensError as error:
            raise LensError(f"catalogues: {error}", "catalogues") from None
        for name, glass in read.items():
            constants = {key: [*getattr(glass, key)] for key in ("sellmeier", "schott", "range")}
            found.setdefault(name, constants)
    own = top.get("glasses", {})
    rest = {key: value for key, value in top.items() if key != "catalogues"}
    return rest | {"glasses": found | own if isinstance(own, dict) else own}


def load_system(
    path: str | pathlib.Path, missing: Missing = "error", configuration: int | None = None
) -> System:
    """Read a lens with its fields, wavelengths and aperture from a Zemax `.zmx` or CODE V
    `.seq` file of at most 16 MB; see docs/lens_files.md.

    One warning and `System.notes` list what is read differently from the file. A solve, for
    instance, is read as its present value. LensError, with the line of the file, for a feature that
    is not supported.

    missing: "error" raises LensError for unsupported features; "warn" leaves out those without
        which rays can be traced, and lists them.
    configuration: number of a configuration or zoom position, from 1 as in the file; None for the
        current one of a `.zmx` file, the first of a `.seq` file. `System.configurations` is their
        number.
    """
    known = pathlib.Path(path).suffix.lower() in _READERS
    what = f"{path}: fields and wavelengths are read from {', '.join(_READERS)}; use load_lens"
    require(known, what)
    with jax.core.eval_context():
        record = read_record(path, missing, configuration)
        lens = _lens_of(record)
        fields, own = _angles(record, lens), _of_system(record.use)
    record.say()
    own |= {name: getattr(record, name) for name in ("configurations", "configuration")}
    return System(lens, record.distance, fields, notes=tuple(record.notes), **own)


def read_record(
    path: str | pathlib.Path, missing: Missing = "error", configuration: int | None = None
) -> Record:
    """Read a file of another program."""
    require_one_of("missing", missing, ("error", "warn"))
    with naming(path):
        read = _READERS[pathlib.Path(path).suffix.lower()]
        return read(str(path), missing, lines_of(path), configuration)


def _lens_of(record: Record) -> Lens:
    """The lens of a file; the size of its stop follows from the aperture."""
    use = record.use
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
    return lens if direct else _opened(record, lens)


@jax.jit  # compiles one program instead of hundreds of small ones
def _paraxial(lens: Lens, distance: Array, wave: Array) -> tuple[FirstOrder, Array, Array]:
    """First-order data, the image height (mm) of a field of 45 degrees, and the refractive indices
    of object space and image space."""
    height = image_height(lens, jnp.full_like(distance, math.pi / 4), distance, wave)
    return first_order(lens, distance, wave), height, lens.index(wave)[jnp.array([0, -1])]


def _first(record: Record, lens: Lens) -> tuple[FirstOrder, float, list[float]]:
    """The results of `_paraxial` for the primary wavelength, as numbers."""
    wave = record.use.wavelengths[record.use.primary]
    found = _paraxial(lens, jnp.asarray(record.distance), jnp.asarray(wave))
    first, height, index = jax.tree.map(lambda a: np.asarray(a)[..., 0], found)
    return first, float(height), index.tolist()


def _opened(record: Record, lens: Lens) -> Lens:
    """The lens with the size of its stop set, by paraxial optics, to the aperture of the file.

    Each kind of aperture gives the radius `wide` of the entrance pupil, mm. The stop is scaled by
    the ratio of this radius to that of the present entrance pupil.
    """
    use, semi = record.use, float(lens.semi_diameter[lens.stop])
    value = float(use.aperture or 0)
    first, _, (front, last) = _first(record, lens)
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
        record.require(value < 90, use.line, f"{what}: light that starts backwards is not traced")
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
    """The lens without the first clear circle about the vertex of its stop. The stop itself has
    the same size, and clipping at both would lose rays by rounding."""
    own, rim = lens.apertures, (lens.stop, "circle", False)
    if own is None:
        return lens
    lies = [*zip(own.surfaces, own.kinds, own.blocks, strict=True)]
    keep = [k for k, place in enumerate(lies) if place != rim or rim in lies[:k]]
    return dataclasses.replace(lens, apertures=own.only(keep))


def _angles(record: Record, lens: Lens) -> np.ndarray | None:
    """The fields (F, 2), radians; None for real image heights."""
    use, far = record.use, record.distance
    line, heights = use.field_line, np.array(use.heights, float)
    if use.field_kind == "angle":
        beyond = bool(np.any(np.abs(heights) >= 90))
        if math.isinf(far):
            if beyond:
                record.note(line, "fields of 90 degrees and more cannot be traced")
            return np.radians(heights)
        what = "a field angle of 90 degrees and more; give object heights"
        record.require(not beyond, line, what)
        place = float(_first(record, lens)[0].entrance_pupil.position)
        what = "field angles at a telecentric lens; give object heights"
        record.require(math.isfinite(place), line, what)
        return np.asarray(field_of_height(-np.tan(np.radians(heights)) * (far + place), far))
    if use.field_kind == "object height":
        what = "object heights of an object at infinity; give angles"
        record.require(math.isfinite(far), line, what)
        return np.asarray(field_of_height(heights, far))
    if use.field_kind == "paraxial image height":
        scale = _first(record, lens)[1]
        what = "paraxial image heights of an image at infinity; give angles"
        record.require(math.isfinite(scale) and scale, line, what)
        return np.arctan(heights / scale)
    return None
