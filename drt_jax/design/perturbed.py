"""A lens as built: tolerances, and the deviations of its parts as a vector."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, require_one_of
from ..lens.elements import Elements
from ..lens.glass import refractive_index
from ..lens.lens import Lens
from ..lens.surface import by_form, surface_sag
from .media import elements_of, pieces_of
from .parts import PARTS, with_arrays

# A fringe is half a wave of green light (ISO 10110-5: 0.5460740 um), in mm.
_FRINGE = 0.5460740e-3 / 2
_LINES = (0.4861327, 0.5875618, 0.6562725)  # F, d, C
_MINUTE = math.pi / 180 / 60
# Forms whose first coefficient is the curvature along x.
_WITH_X = ("biconic", "toroid")
# The keys of `KINDS`, for type checkers and settings; a test compares them.
ToleranceKind = Literal[
    "radius", "fringes", "irregularity", "wedge", "thickness", "index", "abbe", "shift",
    "tilt", "sensor", "sensor tilt"
]  # fmt: skip


class _Errors(NamedTuple):
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
    why_none: what is said of a lens that has no such places.
    """

    whole: str
    axes: int
    unit: str
    places: Callable[[Lens], Sequence[int]]
    change: Callable[[Lens, _Errors], Lens]
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


def _with_radii(lens: Lens, errors: _Errors) -> Lens:
    """The lens with other radii, by per cent."""
    own, at, part = errors.nominal, errors.at, 1 / (1 + errors.by / 100) - 1
    return _curved(lens, at, own.curvature[at] * part, _x_curvatures(own, at) * part)


def _with_fringes(along: float, across: float, lens: Lens, errors: _Errors) -> Lens:
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


def _with_glass(kind: str, lens: Lens, errors: _Errors) -> Lens:
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


def _with_part(part: str, unit: float, lens: Lens, errors: _Errors) -> Lens:
    """The lens with another part of `PARTS`, by deviations in the unit `unit`."""
    return _added(lens, part, errors.at, errors.axis, errors.by * unit)


def _moved(name: str, unit: float, lens: Lens, errors: _Errors) -> Lens:
    """The lens with other shifts or tilts of its elements, by deviations in the unit `unit`."""
    elements: Any = lens.elements
    array = getattr(elements, name).at[errors.at, errors.axis].add(errors.by * unit)
    return dataclasses.replace(lens, elements=dataclasses.replace(elements, **{name: array}))


def _active(lens: Lens) -> Sequence[int]:
    """The active surfaces."""
    return lens.active


def _bendable(lens: Lens) -> list[int]:
    """Active surfaces that may have another curvature along x than along y."""
    return [i for i in lens.active if lens.forms[i] in ("asphere", *_WITH_X)]


def _pieces(lens: Lens) -> Sequence[int]:
    """Surfaces in front of pieces of glass."""
    return [*pieces_of(lens)]


def _elements(lens: Lens) -> Sequence[int]:
    """The numbers of the elements."""
    return range(len(elements_of(lens)))


_gaps = PARTS["thickness"].rows
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
    "index": Kind("surface", 1, "", _pieces, partial(_with_glass, "index"), why_none=_NO_GLASS),
    "abbe": Kind("surface", 1, "%", _pieces, partial(_with_glass, "abbe"), 100, _NO_GLASS),
    "shift": Kind("element", 2, "mm", _elements, partial(_moved, "shift", 1)),
    "tilt": Kind("element", 2, "arc min", _elements, partial(_moved, "tilt", _MINUTE)),
    "sensor": Kind("sensor", 1, "mm", lambda lens: [0], partial(_with_part, "sensor", 1)),
    "sensor tilt": Kind(
        "sensor", 2, "arc min", lambda lens: [lens.count], partial(_with_part, "tilt", _MINUTE)
    ),
}


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """Largest deviation of parts of one kind, in both directions.

    kind: one of the following. A fringe is half a wave of 546 nm.
        Of surfaces: "radius", of the vertex, per cent; "fringes", a change of curvature, measured
        along the normal at the rim of the beam; "irregularity", a cylinder, in fringes between both
        directions (half of them along y, and minus half of them along x); "wedge", a tilt about x
        and y, arc minutes.
        Behind surfaces: "thickness", mm; "index", of the d line; "abbe", per cent.
        Of elements: "shift" along x and y, mm; "tilt" about x and y through the first vertex, arc
        minutes.
        Of the sensor: "sensor", its distance, mm; "sensor tilt" about x and y, arc minutes.
    size: largest deviation, in these units.
    which: numbers of surfaces or elements, from 0; () for all that have this kind of deviation.
    own: True if the deviation of each configuration is its own, such as that of a gap which a cam
        sets in each position of a zoom; False for one that all configurations share.
    """

    kind: ToleranceKind
    size: float
    which: tuple[int, ...] = ()
    own: bool = False

    def __post_init__(self) -> None:
        require_one_of("tolerances: kind", self.kind, KINDS)
        most = KINDS[self.kind].most
        below = "" if math.isinf(most) else f" and below {most:g}"
        what = f"tolerances: {self.kind}: size: must be above 0{below}, got {self.size:g}"
        require(0 < self.size < most, what)


class Deviation(NamedTuple):
    """One number of a lens that deviates.

    kind: as in `Tolerance`.
    place: number of the surface or element.
    axis: component, 0 for x, 1 for y; 0 for a kind without components.
    configuration: number of the only configuration that deviates; None if all do.
    """

    kind: str
    place: int
    axis: int
    configuration: int | None = None

    def __str__(self) -> str:
        kind = KINDS[self.kind]
        axis = f", {'xy'[self.axis]}" if kind.axes > 1 else ""
        place = "" if kind.whole == "sensor" else f" of {kind.whole} {self.place}"
        only = self.configuration
        return f"{self.kind}{place}{axis}{'' if only is None else f' of configuration {only}'}"


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PerturbedLens:
    """A lens with P deviations, in one configuration or in several.

    lens: the nominal lens, with all arrays that the deviations need; of several configurations the
        first.
    beam_radius: (S,), radius of the beam footprint on each surface, mm.
    sizes: (P,), largest deviations, in the units of `Tolerance`.
    others: nominal lenses of the other configurations.

    Static:
    deviations: the P deviations; the components x and y of one part follow each other.
    spans: first and last surface of each element.
    groups: index of each element in `lens.elements`.
    """

    lens: Lens
    beam_radius: Array
    sizes: Array
    deviations: tuple[Deviation, ...] = dataclasses.field(metadata={"static": True})
    spans: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})
    groups: tuple[int, ...] = dataclasses.field(metadata={"static": True}, default=())
    others: tuple[Lens, ...] = ()

    @classmethod
    def from_lens(
        cls, lens: Lens | Sequence[Lens], beam_radius: Array, tolerances: Sequence[Tolerance]
    ) -> "PerturbedLens":
        """The lens with the deviations that tolerances allow.

        lens: the nominal lens, or those of several configurations, of the same parts.
        beam_radius: (S,), mm, for instance that of `Problem.beam_radius` or, the largest of all,
            of `Configurations.beam_radius`.
        tolerances: the tolerances.

        ValueError for no tolerance, for a part that does not exist (the message lists those that
        do) or is named twice, and for configurations of other surfaces or elements.
        """
        lens, *others = [lens] if isinstance(lens, Lens) else lens
        shape = np.shape(beam_radius)
        require(shape == (lens.count,), f"beam_radius: expected ({lens.count},), got shape {shape}")
        sizes: dict[Deviation, float] = {}
        for tolerance in tolerances:
            for deviation in _deviations_of(lens, tolerance, 1 + len(others)):
                require(
                    deviation not in sizes, f"tolerances: {deviation} is named twice; remove one"
                )
                sizes[deviation] = tolerance.size
        require(sizes, "tolerances: none; name at least one")
        spans, dtype = elements_of(lens), lens.curvature.dtype
        (lens, groups), *more = (_with_parts(one, spans, sizes) for one in (lens, *others))
        structure: Any = jax.tree.structure(lens)
        for number, (other, own) in enumerate(more, start=1):
            alike = elements_of(other) == spans and own == groups
            require(
                alike and structure == jax.tree.structure(other),
                f"lens: configuration {number} differs from 0 in more than numbers (surfaces, "
                "elements, tilts that only one has); make them by `configured`",
            )
        numbers = jnp.asarray(beam_radius, dtype), jnp.asarray([*sizes.values()], dtype)
        rest = tuple(other for other, _ in more)
        return cls(lens, *numbers, tuple(sizes), spans, groups, rest)

    def around(self, *lenses: Lens) -> "PerturbedLens":
        """The same deviations of another nominal lens with the same surfaces, or of those of all
        configurations. Works in `jit`."""
        first, *others = (_with_parts(lens, self.spans, self.deviations)[0] for lens in lenses)
        return dataclasses.replace(self, lens=first, others=tuple(others))

    @property
    def lenses(self) -> tuple[Lens, ...]:
        """The nominal lens of each configuration."""
        return self.lens, *self.others

    @property
    def parts(self) -> list[list[int]]:
        """Indices of the deviations of each part: one index, or those of the components x and y."""
        parts: dict[tuple, list[int]] = {}
        for k, error in enumerate(self.deviations):
            parts.setdefault((*error[:2], error.configuration), []).append(k)
        return list(parts.values())

    def lens_of(self, perturbation: Array) -> Lens:
        """The lens with a perturbation.

        Works in `jit`, `vmap` and under differentiation.

        perturbation: (P,), deviations in units of their largest.
        """
        return self.lenses_of(perturbation)[0]

    def lenses_of(self, perturbation: Array) -> list[Lens]:
        """The lens of each configuration with a perturbation (P,), as `lens_of`."""
        return [
            self._disturbed(lens, number, perturbation * self.sizes)
            for number, lens in enumerate(self.lenses)
        ]

    def _disturbed(self, nominal: Lens, number: int, by: Array) -> Lens:
        """The nominal lens of a configuration with deviations (P,), in the units of `Tolerance`."""
        lens = nominal
        for kind in dict.fromkeys(error.kind for error in self.deviations):
            here = [error.configuration in (None, number) for error in self.deviations]
            alike = [error.kind == kind for error in self.deviations]
            own = np.flatnonzero(np.array(here) & np.array(alike))
            if not len(own):
                continue
            at, axis = np.array([self.deviations[k][1:3] for k in own]).T
            at = np.array(self.groups)[at] if KINDS[kind].whole == "element" else at
            errors = _Errors(nominal, self.beam_radius, at, axis, by[own])
            lens = KINDS[kind].change(lens, errors)
        return lens


def _deviations_of(lens: Lens, tolerance: Tolerance, configurations: int) -> list[Deviation]:
    """The deviations that one tolerance allows; see `PerturbedLens.from_lens`."""
    kind = KINDS[tolerance.kind]
    possible, what = kind.places(lens), f"tolerances: {tolerance.kind}"
    require(possible, f"{what}: {kind.why_none}")
    some = ", ".join(map(str, possible))
    for place in tolerance.which:
        require(place in possible, f"{what}: no {kind.whole} {place} can deviate; there are {some}")
    apart = tolerance.own and configurations > 1
    each = range(configurations) if apart else [None]
    places = itertools.product(each, tolerance.which or possible, range(kind.axes))
    return [Deviation(tolerance.kind, place, axis, only) for only, place, axis in places]


def _with_parts(
    lens: Lens, spans: tuple[tuple[int, int], ...], deviations: Iterable[Deviation]
) -> tuple[Lens, tuple[int, ...]]:
    """The same lens with all arrays that deviations need; and the groups of its elements, see
    `PerturbedLens`."""
    kinds, groups = {deviation.kind for deviation in deviations}, tuple[int, ...]()
    if any(KINDS[kind].whole == "element" for kind in kinds):
        lens, groups = _with_elements(lens, spans)
    if kinds & {"wedge", "sensor tilt"}:
        lens = with_arrays(lens, ["tilt"])
    if "irregularity" in kinds:
        lens = _with_cylinders(lens)
    return lens, groups


def _with_elements(lens: Lens, spans: tuple[tuple[int, int], ...]) -> tuple[Lens, tuple[int, ...]]:
    """The same lens with a group for each element, and the indices of these groups.

    Groups that the lens already has are kept, inside of the new ones or around them.
    """
    zero, old = jnp.zeros(3, lens.curvature.dtype), lens.elements
    new = [(span, span[0], zero, zero, zero[0]) for span in spans]
    kept = [] if old is None else [*zip(old.spans, old.about, old.shift, old.tilt, old.pivot)]
    for ((a, b), *_), (first, last) in itertools.product(kept, spans):
        require(
            not (a < first <= b < last or first < a <= last < b),
            f"tolerances: the element of surfaces {first} to {last} is cut by that of the "
            f"lens file, {a} to {b}; put one inside the other, or apart",
        )
    # A group comes before the groups inside it.
    groups = sorted([*kept, *new], key=lambda group: (group[0][0], -group[0][1]))
    where, about, *arrays = zip(*groups)
    shift, tilt, pivot = map(jnp.stack, arrays)
    elements = Elements(shift, tilt, pivot, where, about)
    order = [id(group) for group in groups]
    return dataclasses.replace(lens, elements=elements), tuple(order.index(id(g)) for g in new)


def _with_cylinders(lens: Lens) -> Lens:
    """The same lens with every asphere as a biconic of equal curvatures."""
    round_ = np.array([form == "asphere" for form in lens.forms])
    own = jnp.stack([lens.curvature, lens.conic], axis=1)
    wide = jnp.concatenate([own, lens.coefficients], axis=1)
    narrow = jnp.concatenate([lens.coefficients, jnp.zeros_like(own)], axis=1)
    wide = jnp.where(round_[:, None], wide, narrow)
    forms = tuple("biconic" if r else form for r, form in zip(round_, lens.forms))
    return dataclasses.replace(lens, coefficients=wide, forms=forms)
