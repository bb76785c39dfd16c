"""Kinds of deviations of a lens as built: what can have each, its unit, and the lens with it."""

import dataclasses
import math
from collections.abc import Callable, Collection
from functools import partial
from operator import attrgetter
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.glass import refractive_index
from ..lens.lens import Lens
from ..lens.surface import by_form, surface_sag
from .media import elements_of, pieces_of
from .parts import PARTS

# A fringe is half a wave of green light (ISO 10110-5: 0.5460740 um), in mm.
_FRINGE = 0.5460740e-3 / 2
_LINES = (0.4861327, 0.5875618, 0.6562725)  # F, d, C
_MINUTE = math.pi / 180 / 60
# Forms whose first coefficient is the curvature along x.
_WITH_X = ("biconic", "toroid")
# The keys of `KINDS`, for type checkers and settings; a test compares them.
ToleranceKind = Literal[
    "radius", "fringes", "irregularity", "wedge", "thickness", "index", "abbe", "decentre",
    "tilt", "sensor", "sensor tilt"
]  # fmt: skip


class Errors(NamedTuple):
    """K deviations of one kind.

    nominal: the nominal lens.
    beam_radius: (S,), as in `PerturbedLens`, mm.
    at: (K,), numbers of the surfaces, or indices of the groups of `Lens.elements`.
    axis: (K,), components.
    by: (K,), deviations in the unit of the kind.
    """

    nominal: Lens
    beam_radius: Array
    at: np.ndarray
    axis: np.ndarray
    by: Array


class Kind(NamedTuple):
    """A kind of deviation.

    whole: what deviates, a "surface", an "element" or the "sensor".
    axes: number of components, 2 for x and y.
    unit: unit of the deviation.
    places: function of a lens, the numbers of the surfaces or elements that can have it.
    change: function of a lens and of deviations of this kind, the lens with them.
    most: upper bound of the size, in that unit.
    why_none: end of the error message for a lens without such places.
    """

    whole: str
    axes: int
    unit: str
    places: Callable[[Lens], Collection[int]]
    change: Callable[[Lens, Errors], Lens]
    most: float = math.inf
    why_none: str = "the lens has none"


def _x_curvatures(lens: Lens, at: np.ndarray) -> Array:
    """Curvatures along x of the surfaces `at`, 1/mm; 0 for a form without a separate curvature
    along x.
    """
    has = np.array([lens.forms[i] in _WITH_X for i in at])
    if not has.any():
        return jnp.zeros(len(at), lens.curvature.dtype)
    return jnp.where(has, lens.coefficients[at, 0], 0)


def _curved_surfaces(lens: Lens) -> list[int]:
    """Active surfaces with a curvature along y or x."""
    across = np.asarray(_x_curvatures(lens, np.arange(lens.count)))
    curved = (np.asarray(lens.curvature)[:-1] != 0) | (across != 0)
    return [i for i in lens.active if curved[i]]


def _added(lens: Lens, part: str, at: np.ndarray, axis: np.ndarray | int, by: Array) -> Lens:
    """The lens with `by` added to a part of `PARTS`, in the rows `at` and the terms `axis`."""
    return PARTS[part].write(lens, PARTS[part].read(lens).at[at, axis].add(by))


def _curved(lens: Lens, at: np.ndarray, by: Array, across: Array) -> Lens:
    """The lens with the curvatures of surfaces `at` changed by `by`, and those along x by
    `across`.
    """
    own = np.array([lens.forms[i] in _WITH_X for i in at])
    if own.any():
        lens = _added(lens, "coefficients", at[own], 0, across[own])
    return _added(lens, "curvature", at, 0, by)


def _with_radii(lens: Lens, errors: Errors) -> Lens:
    """The lens with other radii, by per cent."""
    own, at, part = errors.nominal, errors.at, 1 / (1 + errors.by / 100) - 1
    return _curved(lens, at, own.curvature[at] * part, _x_curvatures(own, at) * part)


def _with_fringes(along: float, across: float, lens: Lens, errors: Errors) -> Lens:
    """The lens with curvatures along y and x that differ by so many times the fringes."""
    own, at = errors.nominal, errors.at
    shape = jax.tree.map(lambda a: a[..., at], own.shape)
    forms, zero = tuple(own.forms[i] for i in at), jnp.zeros(len(at), own.curvature.dtype)

    def height(y: Array, bend: Array) -> Array:
        changed = shape._replace(curvature=shape.curvature + bend)
        return by_form(surface_sag, (jnp.zeros_like(y), y), changed, forms)

    # Displacement along the normal at the rim of the beam, mm for each 1/mm of curvature along y.
    rim = errors.beam_radius[at], zero
    _, slope = jax.jvp(height, rim, (zero + 1, zero))
    _, rise = jax.jvp(height, rim, (zero, zero + 1))
    bend = errors.by * _FRINGE / (rise / jnp.sqrt(1 + slope**2))
    return _curved(lens, at, along * bend, across * bend)


def _with_glass(kind: str, lens: Lens, errors: Errors) -> Lens:
    """The lens with another nd ("index"), or vd by per cent at constant nd ("abbe").

    For a glass with a dispersion formula, n^2 changes by a constant that gives the change at the d
    line, or by a term in 1/L^2 (L the wavelength) that gives the change of n_F - n_C.
    """
    pieces = [pieces_of(errors.nominal)[i] for i in errors.at]
    at = np.concatenate(pieces)
    by = errors.by[np.repeat(np.arange(len(pieces)), [*map(len, pieces)])]
    schott, model = lens.dispersion.schott, lens.dispersion.model
    own = jnp.zeros(len(at), bool)
    if model is not None:
        own = model[at, 0] > 1
        change = by if kind == "index" else model[at, 1] * by / 100
        model = model.at[at, int(kind == "abbe")].add(jnp.where(own, change, 0))
    lines = jnp.asarray(_LINES, lens.curvature.dtype)
    f, d, c = refractive_index(errors.nominal.dispersion, lines)[at].T
    if kind == "index":
        schott = schott.at[at, 0].add(jnp.where(own, 0, 2 * d * by + by**2))
    else:
        change = (f - c) * (1 / (1 + by / 100) - 1)
        inverse = [1 / line**2 for line in _LINES]
        slope = (inverse[0] - inverse[1]) / (2 * f) + (inverse[1] - inverse[2]) / (2 * c)
        strength = jnp.where(own, 0, change / slope)
        schott = schott.at[at, 2].add(strength).at[at, 0].add(-strength * inverse[1])
    glass = dataclasses.replace(lens.dispersion, schott=schott, model=model)
    return dataclasses.replace(lens, dispersion=glass)


def _with_part(part: str, unit: float, lens: Lens, errors: Errors) -> Lens:
    """The lens with another part of `PARTS`, by deviations in the unit `unit`."""
    return _added(lens, part, errors.at, errors.axis, errors.by * unit)


def _moved(name: str, unit: float, lens: Lens, errors: Errors) -> Lens:
    """The lens with other shifts or tilts of its elements, by deviations in the unit `unit`."""
    elements: Any = lens.elements
    array = getattr(elements, name).at[errors.at, errors.axis].add(errors.by * unit)
    return dataclasses.replace(lens, elements=dataclasses.replace(elements, **{name: array}))


def _bendable(lens: Lens) -> list[int]:
    """Active surfaces that may have another curvature along x than along y."""
    return [i for i in lens.active if lens.forms[i] in ("asphere", *_WITH_X)]


def _elements(lens: Lens) -> range:
    """The numbers of the elements."""
    return range(len(elements_of(lens)))


_active, _gaps = attrgetter("active"), PARTS["thickness"].rows
_NOT_CURVED = "no surface is curved; for planes use fringes"
_NOT_ROUND = "no surface is a sphere, conic, even asphere, biconic or toroid"
_NO_GAP = "the lens has one surface, without a thickness behind it"
_NO_GLASS = "the lens has no glass"
KINDS: dict[str, Kind] = {
    "radius": Kind("surface", 1, "%", _curved_surfaces, _with_radii, 100, _NOT_CURVED),
    "fringes": Kind("surface", 1, "fringes", _active, partial(_with_fringes, 1, 1)),
    "irregularity": Kind(
        "surface", 1, "fringes", _bendable, partial(_with_fringes, 0.5, -0.5), why_none=_NOT_ROUND
    ),
    "wedge": Kind("surface", 2, "arc min", _active, partial(_with_part, "tilt", _MINUTE)),
    "thickness": Kind(
        "surface", 1, "mm", _gaps, partial(_with_part, "thickness", 1), why_none=_NO_GAP
    ),
    "index": Kind("surface", 1, "", pieces_of, partial(_with_glass, "index"), why_none=_NO_GLASS),
    "abbe": Kind("surface", 1, "%", pieces_of, partial(_with_glass, "abbe"), 100, _NO_GLASS),
    "decentre": Kind("element", 2, "mm", _elements, partial(_moved, "shift", 1)),
    "tilt": Kind("element", 2, "arc min", _elements, partial(_moved, "tilt", _MINUTE)),
    "sensor": Kind("sensor", 1, "mm", lambda lens: [0], partial(_with_part, "sensor", 1)),
    "sensor tilt": Kind(
        "sensor", 2, "arc min", lambda lens: [lens.count], partial(_with_part, "tilt", _MINUTE)
    ),
}
