"""The kinds of variables of a lens. Each kind reads and writes an array over rows and terms."""

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import shown
from ..lens.forms import FORMS, Shape
from ..lens.lens import Lens
from ..lens.surface import surface_sag


class Kind(NamedTuple):
    """One kind of variable.

    rows: function of a lens, the rows that vary if none are named.
    allowed: function of a lens, the rows that may be named.
    terms: function of a lens, the number of values of each row.
    read: function of a lens, its array (rows, terms).
    write: function of a lens and an array (rows, terms), the lens with that array.
    step: (power, factor). The typical change is factor h^power for a semi-diameter h of the stop,
        mm. For coefficients it is the change of the sag at h, mm, and for a phase that of the
        phase, waves.
    limits: smallest and largest meaningful value.
    """

    rows: Callable[[Lens], list[int]]
    allowed: Callable[[Lens], list[int]]
    terms: Callable[[Lens], int]
    read: Callable[[Lens], Array]
    write: Callable[[Lens, Array], Lens]
    step: tuple[float, float]
    limits: tuple[float, float] = (-np.inf, np.inf)


def whole_numbers(what: str, given: Any) -> tuple[int, ...]:
    """Numbers of surfaces and the like as a tuple of int.

    ValueError, which begins with `what`, unless `given` is an iterable of whole numbers.
    """
    numbers = given if isinstance(given, Iterable) and not isinstance(given, str) else [None]
    found = tuple(numbers)
    if all(isinstance(n, int | np.integer) and not isinstance(n, bool) for n in found):
        return tuple(map(int, found))
    raise ValueError(f"{what}: expected whole numbers from 0, such as (0, 2), got {shown(given)}")


def back_distance(lens: Lens) -> Array:
    """Distance from the last vertex to the sensor along the axis, (), mm."""
    return lens.sensor - jnp.sum(lens.thickness)


def diffractive(lens: Lens) -> list[int]:
    """Surfaces with a phase."""
    return [] if lens.phase is None else list(lens.phase.surfaces)


def _phases(lens: Lens) -> Array:
    """Coefficients of the phases (S, K); zeros on surfaces without a phase."""
    phase: Any = lens.phase
    if phase is None:
        return jnp.zeros((0, 0))
    none = jnp.zeros((lens.count, phase.coefficients.shape[1]), phase.coefficients.dtype)
    return none.at[np.array(phase.surfaces)].set(phase.coefficients)


def _phase_terms(lens: Lens) -> int:
    """Number of coefficients of a phase."""
    return _phases(lens).shape[1]


def _with_phases(lens: Lens, array: Array) -> Lens:
    """The lens with other coefficients (S, K) of its phases."""
    phase: Any = lens.phase
    own = dataclasses.replace(phase, coefficients=array[np.array(phase.surfaces)])
    return dataclasses.replace(lens, phase=own)


def _all(lens: Lens) -> list[int]:
    """All surfaces."""
    return list(range(lens.count))


def _active(lens: Lens) -> list[int]:
    """The active surfaces."""
    return list(lens.active)


def model_glasses(lens: Lens) -> list[int]:
    """Surfaces behind which a model glass begins."""
    model, media = lens.dispersion.model, lens.glasses
    if model is None:
        return []
    known = np.asarray(model)[:, 0] > 1
    return [i for i in range(lens.count) if known[i + 1] and media[i] != media[i + 1]]


def _begins(lens: Lens) -> np.ndarray:
    """The surface (S,) at which the medium behind each surface begins.

    A mirror, or a stop inside of a glass, continues the medium in front of it.
    """
    found: list[int] = []
    for i in range(lens.count):
        same = i > 0 and lens.glasses[i] == lens.glasses[i + 1]
        found.append(found[-1] if same else i)
    return np.array(found)


def _finite(lens: Lens) -> list[int]:
    """Surfaces with a finite semi-diameter."""
    return np.flatnonzero(np.isfinite(np.asarray(lens.semi_diameter)[:-1])).tolist()


def _placed(lens: Lens) -> list[int]:
    """All surfaces and the sensor."""
    return list(range(lens.count + 1))


def _leaf(name: str) -> tuple[Callable, Callable]:
    """Reader and writer of an array over surfaces. The reader returns zeros if the array is
    None.
    """

    def read(lens: Lens) -> Array:
        array = getattr(lens, name)
        if array is None:
            array = jnp.zeros((lens.count + 1, _WIDTH[name]), lens.curvature.dtype)
        return array.reshape(len(array), -1)

    def write(lens: Lens, array: Array) -> Lens:
        old = getattr(lens, name)
        shape = array.shape if old is None else old.shape
        return dataclasses.replace(lens, **{name: array.reshape(shape)})  # type: ignore[arg-type]

    return read, write


_WIDTH = {"tilt": 3, "decentre": 2}  # components in each row


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
        model: Any = lens.dispersion.model
        model = model.at[1:, column].set(array[_begins(lens), 0])
        return dataclasses.replace(
            lens, dispersion=dataclasses.replace(lens.dispersion, model=model)
        )

    return read, write


def _one(lens: Lens) -> int:
    """One term in each row."""
    return 1


def _gaps(lens: Lens) -> list[int]:
    """Surfaces with a surface behind them."""
    return list(range(lens.count - 1))


def _terms(lens: Lens) -> int:
    """Number of coefficients of a surface."""
    return lens.coefficients.shape[1]


# The keys of `KINDS`; a test compares them.
VariableKind = Literal[
    "curvature", "conic", "coefficients", "thickness", "sensor", "index", "abbe", "tilt",
    "decentre", "semi_diameter", "phase"
]  # fmt: skip
KINDS: dict[str, Kind] = {
    "curvature": Kind(_active, _all, _one, *_leaf("curvature"), (-1, 0.02)),
    "conic": Kind(_active, _all, _one, *_leaf("conic"), (0, 0.1)),
    "coefficients": Kind(_active, _all, _terms, *_leaf("coefficients"), (1, 0.01)),
    "thickness": Kind(_gaps, _gaps, _one, _leaf("thickness")[0], _write_thickness, (1, 0.05)),
    "sensor": Kind(
        lambda lens: [0],
        lambda lens: [0],
        _one,
        lambda lens: back_distance(lens).reshape(1, 1),
        _write_sensor,
        (1, 0.01),
    ),
    "index": Kind(model_glasses, model_glasses, _one, *_glass(0), (0, 0.02), (1.3, 2.2)),
    "abbe": Kind(model_glasses, model_glasses, _one, *_glass(1), (0, 2.0), (15, 100)),
    "tilt": Kind(_active, _placed, lambda lens: 3, *_leaf("tilt"), (0, 1e-3)),
    "decentre": Kind(_active, _placed, lambda lens: 2, *_leaf("decentre"), (1, 1e-3)),
    "semi_diameter": Kind(
        _finite, _finite, _one, *_leaf("semi_diameter"), (1, 0.05), (1e-6, np.inf)
    ),
    # 10 h waves at the height h, mm: a tenth of the phase of a plate of f/4 in green light.
    "phase": Kind(diffractive, diffractive, _phase_terms, _phases, _with_phases, (1, 10)),
}
# Kinds that are coefficients of a form.
SERIES = ("coefficients", "phase")


def beam(lens: Lens) -> float:
    """Semi-diameter of the stop, mm, as a measure of the size of the beam."""
    return float(np.asarray(lens.semi_diameter)[lens.stop])


def step_of(lens: Lens, kind: str, row: int, term: int) -> float:
    """Typical change of a variable, in the units of the lens."""
    power, factor = KINDS[kind].step
    step = factor * beam(lens) ** power
    return step / lift_of(lens, kind, row, term, beam(lens)) if kind in SERIES else step


def _series(lens: Lens, kind: str, row: int) -> tuple[str, Shape]:
    """The form and the shape of a surface, or of its phase."""
    phase: Any = lens.phase
    if kind == "phase":
        row = phase.surfaces.index(row)
        form, shape = phase.forms[row], phase.shape
    else:
        form, shape = lens.forms[row], lens.shape
    return form, jax.tree.map(lambda a: a[..., row, None], shape)


def lift_of(lens: Lens, kind: str, row: int, term: int, away: float) -> float:
    """Largest change of the sag, mm, or of the phase, waves, for each unit of a coefficient.

    It is the largest absolute derivative of the sag at 8 azimuths.

    kind: one of `SERIES`.
    away: distance from the axis, mm.
    """
    name, shape = _series(lens, kind, row)
    angle, dtype = np.pi * np.arange(8) / 8, lens.curvature.dtype
    points = tuple(jnp.asarray(away * f(angle), dtype) for f in (np.cos, np.sin))

    def height(coefficients: Array) -> Array:
        return surface_sag(points, shape._replace(coefficients=coefficients), name)

    old = shape.coefficients
    _, lifted = jax.jvp(height, (old,), (jnp.zeros_like(old).at[term].set(1),))
    return float(jnp.max(jnp.abs(lifted))) or 1.0


def word_terms(lens: Lens, kind: str, row: int) -> list[int]:
    """Terms of a row that vary if none are named.

    These are all terms, except for the coefficient of r^2 of a surface, which the curvature
    replaces, or the norm radius if the form has one.
    """
    count = KINDS[kind].terms(lens)
    if kind not in SERIES:
        return list(range(count))
    form = FORMS[_series(lens, kind, row)[0]]
    left_out = "norm_radius" if "norm_radius" in form.named else 2 * (kind == "coefficients")
    labels = (*form.named, *form.powers)[:count]
    return [term for term, label in enumerate(labels) if label != left_out]
