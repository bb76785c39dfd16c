"""The kinds of numbers of a lens that may change, each an array over rows and terms."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens


class Kind(NamedTuple):
    """One kind of number.

    rows: the rows of a lens that have one, all that is meant when none are named.
    allowed: the rows that may be named.
    terms: how many numbers a row has.
    read, write: the array (rows, terms) of a lens, and a lens with another.
    step: by how much a typical design moves one, from a length h (mm) across the beam: (power of h,
        factor), of coefficients from one term to the next h^-2 less.
    limits: between which its values mean anything.
    """

    rows: Callable[[Lens], list[int]]
    allowed: Callable[[Lens], list[int]]
    terms: Callable[[Lens], int]
    read: Callable[[Lens], Array]
    write: Callable[[Lens, Array], Lens]
    step: tuple[float, float]
    limits: tuple[float, float] = (-np.inf, np.inf)


def back_distance(lens: Lens) -> Array:
    """From the last vertex to the sensor along the axis (), mm."""
    return lens.sensor - jnp.sum(lens.thickness)


def _all(lens: Lens) -> list[int]:
    return list(range(lens.count))


def _live(lens: Lens) -> list[int]:
    return list(lens.live)


def _model(lens: Lens) -> list[int]:
    """Surfaces with a model glass behind them."""
    model = lens.dispersion.model
    known = [] if model is None else np.asarray(model)[:, 0].tolist()
    return [i for i in range(lens.count) if known and known[i + 1] > 1]


def _leaf(name: str) -> tuple[Callable, Callable]:
    """Reader and writer of an array over surfaces; zeros in place of none."""

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


_WIDTH = {"tilt": 3, "decentre": 2}


def _write_sensor(lens: Lens, array: Array) -> Lens:
    return dataclasses.replace(lens, sensor=jnp.sum(lens.thickness) + array[0, 0])


def _write_thickness(lens: Lens, array: Array) -> Lens:
    """The sensor goes along with the last vertex."""
    moved = dataclasses.replace(lens, thickness=array[:, 0])
    return _write_sensor(moved, back_distance(lens)[None, None])


def _glass(column: int) -> tuple[Callable, Callable]:
    """Reader and writer of nd or vd of the media behind the surfaces."""

    def read(lens: Lens) -> Array:
        model: Any = lens.dispersion.model
        return jnp.zeros((0, 1)) if model is None else model[1:, column : column + 1]

    def write(lens: Lens, array: Array) -> Lens:
        model: Any = lens.dispersion.model
        model = model.at[1:, column].set(array[:, 0])
        return dataclasses.replace(
            lens, dispersion=dataclasses.replace(lens.dispersion, model=model)
        )

    return read, write


def _one(lens: Lens) -> int:
    return 1


def _gaps(lens: Lens) -> list[int]:
    return list(range(lens.count - 1))


def _terms(lens: Lens) -> int:
    return lens.coefficients.shape[1]


KINDS: dict[str, Kind] = {
    "curvature": Kind(_live, _all, _one, *_leaf("curvature"), (-1, 0.02)),
    "conic": Kind(_live, _all, _one, *_leaf("conic"), (0, 0.1)),
    "coefficients": Kind(_live, _all, _terms, *_leaf("coefficients"), (-1, 0.01)),
    "thickness": Kind(_gaps, _gaps, _one, *_leaf("thickness")[:1], _write_thickness, (1, 0.05)),
    "sensor": Kind(
        lambda lens: [0],
        lambda lens: [0],
        _one,
        lambda lens: back_distance(lens).reshape(1, 1),
        _write_sensor,
        (1, 0.01),
    ),
    "index": Kind(_model, _model, _one, *_glass(0), (0, 0.02), (1.3, 2.2)),
    "abbe": Kind(_model, _model, _one, *_glass(1), (0, 2.0), (15, 100)),
    "tilt": Kind(
        _live, lambda lens: list(range(lens.count + 1)), lambda lens: 3, *_leaf("tilt"), (0, 1e-3)
    ),
    "decentre": Kind(
        _live,
        lambda lens: list(range(lens.count + 1)),
        lambda lens: 2,
        *_leaf("decentre"),
        (1, 1e-3),
    ),
    "semi_diameter": Kind(
        lambda lens: [
            i for i in range(lens.count) if np.isfinite(np.asarray(lens.semi_diameter)[i])
        ],
        _all,
        _one,
        *_leaf("semi_diameter"),
        (1, 0.05),
        (1e-6, np.inf),
    ),
}


def beam(lens: Lens) -> float:
    """A length across the beam, mm: the semi-diameter of the stop."""
    return float(np.asarray(lens.semi_diameter)[lens.stop])


def step_of(lens: Lens, kind: str, term: int) -> float:
    """By how much a typical design moves a number of a lens."""
    power, factor = KINDS[kind].step
    if kind == "coefficients":
        power -= 2 * term
    return factor * beam(lens) ** power
