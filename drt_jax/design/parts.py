"""The parts of a lens by name, which variables, ties, solves and deviations refer to.

A part is an array of numbers over rows, which are mostly surfaces, and over terms of a row. One
table says how each part is read and written, and which of its numbers may vary.
"""

import dataclasses
from collections.abc import Callable, Collection, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..lens.forms import FORMS, Shape
from ..lens.lens import Lens
from ..lens.surface import surface_sag
from .media import back_distance, model_glasses


class Part(NamedTuple):
    """A part of a lens.

    rows: function of a lens, the rows that may vary.
    read: function of a lens, its array (rows, terms).
    write: function of a lens and an array (rows, terms), the lens with that array.
    step: (power, factor). The typical change is factor h^power for a semi-diameter h of the stop,
        mm. For coefficients it is the change of the sag at h, mm, and for a phase that of the
        phase, waves.
    of_active: True if the name of the part alone stands only for its active surfaces.
    limits: smallest and largest meaningful value.
    why_none: what to do for a lens that has none.
    """

    rows: Callable[[Lens], Sequence[int]]
    read: Callable[[Lens], Array]
    write: Callable[[Lens, Array], Lens]
    step: tuple[float, float]
    of_active: bool = False
    limits: tuple[float, float] = (-np.inf, np.inf)
    why_none: str = "the lens has none"


class Place(NamedTuple):
    """One number of a lens: the name of its part, its row and its term within the row."""

    kind: str
    row: int
    term: int

    def __str__(self) -> str:
        term = f"[{self.term}]" if self.kind in (*SERIES, "tilt", "decentre") else ""
        return self.kind if self.kind == "sensor" else f"{self.kind} {self.row}{term}"


def _leaf(name: str, width: int = 1) -> tuple[Callable, Callable]:
    """Reader and writer of an array over surfaces.

    width: number of terms of the zeros that are read if the array is None.
    """

    def read(lens: Lens) -> Array:
        array = getattr(lens, name)
        if array is None:
            array = jnp.zeros((lens.count + 1, width), lens.curvature.dtype)
        return array.reshape(len(array), -1)

    def write(lens: Lens, array: Array) -> Lens:
        old = getattr(lens, name)
        shape = array.shape if old is None else old.shape
        return dataclasses.replace(lens, **{name: array.reshape(shape)})  # type: ignore[arg-type]

    return read, write


def _read_sensor(lens: Lens) -> Array:
    """The distance of the sensor from the last vertex."""
    return back_distance(lens).reshape(1, 1)


def _write_sensor(lens: Lens, array: Array) -> Lens:
    """Writes the distance of the sensor from the last vertex."""
    return dataclasses.replace(lens, sensor=jnp.sum(lens.thickness) + array[0, 0])


def _write_thickness(lens: Lens, array: Array) -> Lens:
    """Writes thicknesses. The sensor keeps its distance from the last vertex."""
    changed = dataclasses.replace(lens, thickness=array[:, 0])
    return _write_sensor(changed, back_distance(lens)[None, None])


def _glass(column: int) -> tuple[Callable, Callable]:
    """Reader and writer of nd or vd of the media behind the surfaces."""

    def read(lens: Lens) -> Array:
        model: Any = lens.dispersion.model
        return jnp.zeros((0, 1)) if model is None else model[1:, column : column + 1]

    def write(lens: Lens, array: Array) -> Lens:
        # A mirror, or a stop inside of a glass, continues the medium in front of it.
        rows, names = np.arange(lens.count), np.array(lens.glasses)
        begins = np.maximum.accumulate(np.where(names[1:] != names[:-1], rows, 0))
        model: Any = lens.dispersion.model
        model = model.at[1:, column].set(array[begins, 0])
        own = dataclasses.replace(lens.dispersion, model=model)
        return dataclasses.replace(lens, dispersion=own)

    return read, write


def _read_phase(lens: Lens) -> Array:
    """Coefficients of the phases (S, K); zeros on surfaces without a phase."""
    if lens.phase is None:
        return jnp.zeros((0, 0))
    own = lens.phase.coefficients
    none = jnp.zeros((lens.count, own.shape[1]), own.dtype)
    return none.at[np.array(lens.phase.surfaces)].set(own)


def _write_phase(lens: Lens, array: Array) -> Lens:
    """The lens with other coefficients (S, K) of its phases."""
    phase: Any = lens.phase
    own = dataclasses.replace(phase, coefficients=array[np.array(phase.surfaces)])
    return dataclasses.replace(lens, phase=own)


def _surfaces(lens: Lens) -> range:
    """All surfaces."""
    return range(lens.count)


def _surfaces_and_sensor(lens: Lens) -> range:
    """All surfaces and the sensor."""
    return range(lens.count + 1)


def _gaps(lens: Lens) -> range:
    """Surfaces with a surface behind them."""
    return range(lens.count - 1)


def _diffractive(lens: Lens) -> Sequence[int]:
    """Surfaces with a phase."""
    return () if lens.phase is None else lens.phase.surfaces


def _finite(lens: Lens) -> list[int]:
    """Surfaces with a finite semi-diameter."""
    return np.flatnonzero(np.isfinite(np.asarray(lens.semi_diameter)[:-1])).tolist()


_NO_COEFFICIENTS = "the lens has none; add some that are 0, as with_asphere does"
_NO_PHASE = "the lens has none; write one into its prescription, zeros too"
_NO_MODEL = "the lens has no model glass; write nd and vd into its prescription"
_NO_GAP = "the lens has one surface; its distance to the sensor is the kind sensor"
# The keys of `PARTS`, for type checkers and settings; a test compares them.
VariableKind = Literal[
    "curvature", "conic", "coefficients", "thickness", "sensor", "index", "abbe", "tilt",
    "decentre", "semi_diameter", "phase"
]  # fmt: skip
# In the order in which they are written: thicknesses before the sensor, whose distance counts from
# the last vertex.
PARTS: dict[str, Part] = {
    "curvature": Part(_surfaces, *_leaf("curvature"), (-1, 0.02), True),
    "conic": Part(_surfaces, *_leaf("conic"), (0, 0.1), True),
    "coefficients": Part(
        _surfaces, *_leaf("coefficients"), (1, 0.01), True, why_none=_NO_COEFFICIENTS
    ),
    "thickness": Part(_gaps, _leaf("thickness")[0], _write_thickness, (1, 0.05), why_none=_NO_GAP),
    "sensor": Part(lambda lens: [0], _read_sensor, _write_sensor, (1, 0.01)),
    "index": Part(model_glasses, *_glass(0), (0, 0.02), False, (1.3, 2.2), _NO_MODEL),
    "abbe": Part(model_glasses, *_glass(1), (0, 2.0), False, (15, 100), _NO_MODEL),
    "tilt": Part(_surfaces_and_sensor, *_leaf("tilt", 3), (0, 1e-3), True),
    "decentre": Part(_surfaces_and_sensor, *_leaf("decentre", 2), (1, 1e-3), True),
    "semi_diameter": Part(_finite, *_leaf("semi_diameter"), (1, 0.05), limits=(1e-6, np.inf)),
    # 10 h waves at the height h, mm: a tenth of the phase of a plate of f/4 in green light.
    "phase": Part(_diffractive, _read_phase, _write_phase, (1, 10), why_none=_NO_PHASE),
}
# Parts that are coefficients of a form.
SERIES = ("coefficients", "phase")


def number_at(lens: Lens, place: Place) -> tuple[Array, Callable[[Array], Lens]]:
    """The number () of a lens at a place, and a function from such a number to the lens with it."""
    part = PARTS[place.kind]
    array = part.read(lens)

    def with_number(number: Array) -> Lens:
        return part.write(lens, array.at[place.row, place.term].set(number))

    return array[place.row, place.term], with_number


def with_numbers(lens: Lens, changes: Collection[tuple[Place, Array]]) -> Lens:
    """The lens with changed numbers."""
    for name, part in PARTS.items():
        own = [(place, number) for place, number in changes if place.kind == name]
        if own:
            rows, terms = (np.array([place[k] for place, _ in own]) for k in (1, 2))
            numbers = jnp.stack([number for _, number in own])
            lens = part.write(lens, part.read(lens).at[rows, terms].set(numbers))
    return lens


def with_arrays(lens: Lens, kinds: Collection[str]) -> Lens:
    """The lens with arrays of zeros for tilts and decentres among `kinds` that are None."""
    for kind in {"tilt", "decentre"}.intersection(kinds):
        lens = PARTS[kind].write(lens, PARTS[kind].read(lens))
    return lens


def places_of(
    what: str, lens: Lens, kind: str, surfaces: tuple[int, ...], terms: tuple[int, ...] = ()
) -> list[Place]:
    """Places of a part.

    surfaces: () for all, see `Vary`.
    terms: () for all except the coefficient of r^2 of a surface, which the curvature replaces, or
        the norm radius if the form has one.

    ValueError, which begins with `what`, for a surface or term that does not exist; the message
    lists those that do.
    """
    part = PARTS[kind]
    rows, count = part.rows(lens), part.read(lens).shape[1]
    require(rows and count, f"{what}: {kind}: {part.why_none}")
    for name, named, possible in (("surface", surfaces, rows), ("term", terms, range(count))):
        some = ", ".join(map(str, possible))
        for number in named:
            require(number in possible, f"{what}: {kind}: no {name} {number}; there are {some}")

    def usual_terms(row: int) -> list[int]:
        if kind not in SERIES:
            return list(range(count))
        form = FORMS[_series(lens, kind, row)[0]]
        left_out = "norm_radius" if "norm_radius" in form.named else 2 * (kind == "coefficients")
        labels = (*form.named, *form.powers)[:count]
        return [term for term, label in enumerate(labels) if label != left_out]

    usual = [row for row in rows if row in lens.active or not part.of_active]
    return [
        Place(kind, row, term) for row in surfaces or usual for term in terms or usual_terms(row)
    ]


def step_of(lens: Lens, place: Place) -> float:
    """Typical change of a number, in the units of the lens."""
    power, factor = PARTS[place.kind].step
    beam = float(np.asarray(lens.semi_diameter)[lens.stop])  # a measure of its size, mm
    step = factor * beam**power
    return step / lift_of(lens, place, beam) if place.kind in SERIES else step


def _series(lens: Lens, kind: str, row: int) -> tuple[str, Shape]:
    """The form and the shape of a surface, or of its phase."""
    form, shape = lens.forms[row], lens.shape
    if kind == "phase":
        phase: Any = lens.phase
        row = phase.surfaces.index(row)
        form, shape = phase.forms[row], phase.shape
    return form, jax.tree.map(lambda a: a[..., row, None], shape)


def lift_of(lens: Lens, place: Place, away: float) -> float:
    """Largest change of the sag, mm, or of the phase, waves, for each unit of a coefficient.

    It is the largest absolute derivative of the sag at 8 azimuths.

    place: of a part among `SERIES`.
    away: distance from the axis, mm.
    """
    form, shape = _series(lens, place.kind, place.row)
    angle, dtype = np.pi * np.arange(8) / 8, lens.curvature.dtype
    points = tuple(jnp.asarray(away * f(angle), dtype) for f in (np.cos, np.sin))

    def height(coefficients: Array) -> Array:
        return surface_sag(points, shape._replace(coefficients=coefficients), form)

    old = shape.coefficients
    _, lifted = jax.jvp(height, (old,), (jnp.zeros_like(old).at[place.term].set(1),))
    return float(jnp.max(jnp.abs(lifted))) or 1.0
