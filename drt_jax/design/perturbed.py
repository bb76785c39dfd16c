"""A lens as it is made: errors of its parts as a vector."""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.elements import Elements
from ..lens.glass import Dispersion, refractive_index
from ..lens.lens import Lens

_Kind = Literal[
    *("radius", "fringes", "thickness", "index", "abbe"),
    *("shift", "tilt", "wedge", "irregularity"),
]
# Fringes are counted in green light, half a wave each; um.
_GREEN = 0.5460740
_LINES = (0.4861327, 0.5875618, 0.6562725)  # F, d, C
_MINUTE = math.pi / 180 / 60


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """By how much parts of a kind may be off, to either side.

    kind: "radius" in per cent, "fringes" of it over the light's extent, "thickness" in mm, "index",
        "abbe" in per cent; of elements "shift" across the axis in mm and "tilt" about their first
        vertex in arc minutes, each in x and y; of surfaces "wedge", their tilt, in arc minutes,
        in x and y, and "irregularity" in fringes of a cylinder (positive along y, negative along x).
    size: the largest error, in these units.
    which: surfaces or elements, from 0; empty: all that there are.
    """

    kind: _Kind
    size: float
    which: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.kind not in get_args(_Kind):
            raise ValueError(
                f"tolerances: unknown {self.kind!r}; known: {', '.join(get_args(_Kind))}"
            )
        if not 0 < self.size < math.inf:
            raise ValueError(f"tolerances: {self.kind}: size: must be above 0, got {self.size:g}")


class Error(NamedTuple):
    """One number that may be off: what, where (a surface or an element), its component, and by how
    much at most."""

    kind: str
    place: int
    axis: int
    size: float

    def __str__(self) -> str:
        axis = f" {'xy'[self.axis]}" if self.kind in _TWO else ""
        whole = "element" if self.kind in _OF_ELEMENTS else "surface"
        return f"{self.kind} of {whole} {self.place}{axis}"


_OF_ELEMENTS = ("shift", "tilt")
_TWO = (*_OF_ELEMENTS, "wedge")


def elements_of(lens: Lens) -> tuple[tuple[int, int], ...]:
    """First and last surface of each element: neighbours with glass between them, cemented ones
    together; a mirror is one."""
    media, spans = lens.glasses, []
    for i in lens.live:
        if spans and media[i] != media[0] and spans[-1][1] < i and not lens.mirrors[i]:
            spans[-1] = (spans[-1][0], i)
        else:
            spans.append((i, i))
    return tuple(spans)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Perturbed:
    """A lens with P errors.

    lens: without any, in the form that errors need. extents: (S,), of the light on its surfaces, mm.

    Static: errors, spans of the elements.
    """

    lens: Lens
    extents: Array
    errors: tuple[Error, ...] = dataclasses.field(metadata={"static": True})
    spans: tuple[tuple[int, int], ...] = dataclasses.field(metadata={"static": True})

    @classmethod
    def of(cls, lens: Lens, extents: Array, tolerances: Sequence[Tolerance]) -> "Perturbed":
        """The errors that some tolerances allow.

        ValueError, which lists what there is, for a part that does not exist or stands twice.
        """
        spans, errors = elements_of(lens), []
        for tolerance in tolerances:
            kind = tolerance.kind
            there = _there(lens, spans, kind)
            if not there:
                raise ValueError(f"tolerances: {kind}: the lens has none")
            for place in tolerance.which:
                if place not in there:
                    known = ", ".join(map(str, there))
                    raise ValueError(f"tolerances: {kind}: no number {place}; there are {known}")
            axes = range(2 if kind in _TWO else 1)
            for place, axis in itertools.product(tolerance.which or there, axes):
                errors.append(Error(kind, place, axis, tolerance.size))
        keys = [error[:3] for error in errors]
        for error in errors:
            if keys.count(error[:3]) > 1:
                raise ValueError(f"tolerances: {error} stands twice; leave one out")
        if not errors:
            raise ValueError("tolerances: none; name at least one")
        return cls(_prepared(lens, spans, {e.kind for e in errors}), extents, tuple(errors), spans)

    def lens_of(self, off: Array) -> Lens:
        """The lens with errors `off` (P,) in parts of their largest. Differentiable."""
        lens = self.lens
        found: dict[str, list[tuple[Error, Array]]] = {}
        for k, error in enumerate(self.errors):
            found.setdefault(error.kind, []).append((error, off[k] * error.size))
        for kind, some in found.items():
            places = np.array([error.place for error, _ in some])
            axes = np.array([error.axis for error, _ in some])
            lens = self._off(lens, kind, places, axes, jnp.stack([size for _, size in some]))
        return lens

    def _off(self, lens: Lens, kind: str, at: np.ndarray, axis: np.ndarray, by: Array) -> Lens:
        replace = dataclasses.replace
        if kind == "radius":
            c = lens.curvature[at] / (1 + by / 100)
            return _bent(lens, at, c - lens.curvature[at], 0)
        if kind in ("fringes", "irregularity"):
            # A curvature that is off by d raises the rim by d h^2 / 2.
            bend = by * 1e-3 * _GREEN / self.extents[at] ** 2
            return _bent(lens, at, bend, int(kind == "irregularity"))
        if kind == "thickness":
            gap = lens.thickness.at[at].add(by)
            return replace(lens, thickness=gap, sensor=lens.sensor + jnp.sum(by))
        if kind in ("index", "abbe"):
            return replace(lens, dispersion=_medium(lens, kind, at, by))
        if kind == "wedge":
            tilt = jnp.zeros((lens.count + 1, 3)) if lens.tilt is None else lens.tilt
            return replace(lens, tilt=tilt.at[at, axis].add(by * _MINUTE))
        groups = lens.elements
        assert groups is not None
        rows = at + len(groups.spans) - len(self.spans)
        size, name = (by, "shift") if kind == "shift" else (by * _MINUTE, "tilt")
        moved = getattr(groups, name).at[rows, axis].add(size)
        return replace(lens, elements=replace(groups, **{name: moved}))


def _there(lens: Lens, spans: tuple[tuple[int, int], ...], kind: str) -> list[int]:
    """The numbers of the surfaces or elements that may be off."""
    live = list(lens.live)
    if kind in _OF_ELEMENTS:
        return list(range(len(spans)))
    if kind == "thickness":
        return list(range(lens.count - 1))
    if kind in ("index", "abbe"):
        return [i for i in range(lens.count) if lens.glasses[i + 1] not in (lens.glasses[0], "air")]
    if kind == "radius":
        return [i for i in live if float(lens.curvature[i]) != 0]
    if kind == "irregularity":
        return [i for i in live if lens.forms[i] == "asphere"]
    return live


def _prepared(lens: Lens, spans: tuple[tuple[int, int], ...], kinds: set[str]) -> Lens:
    """The lens in the form that errors of these kinds need; the same lens."""
    dtype = lens.curvature.dtype
    if kinds & {*_OF_ELEMENTS}:
        old, count = lens.elements, len(spans)
        zero = jnp.zeros((count, 3), dtype)
        parts = [zero, zero, jnp.zeros(count, dtype)]
        where, about = spans, tuple(first for first, _ in spans)
        if old is not None:
            arrays = (old.shift, old.tilt, old.pivot)
            parts = [jnp.concatenate(pair) for pair in zip(arrays, parts)]
            where, about = (*old.spans, *where), (*old.about, *about)
        lens = dataclasses.replace(lens, elements=Elements(*parts, where, about))
    if "irregularity" in kinds:
        # A biconic with the same curvature and conic in both directions.
        round_ = np.array([form == "asphere" for form in lens.forms])
        own = jnp.stack([lens.curvature, lens.conic], axis=1)
        wide = jnp.concatenate([own, lens.coefficients], axis=1)
        kept = jnp.concatenate([lens.coefficients, jnp.zeros_like(own)], axis=1)
        wide = jnp.where(round_[:, None], wide, kept)
        forms = tuple("biconic" if r else form for r, form in zip(round_, lens.forms))
        lens = dataclasses.replace(lens, coefficients=wide, forms=forms)
    return lens


def _bent(lens: Lens, at: np.ndarray, by: Array, axis: int) -> Lens:
    """Curvatures changed; `axis`: 0 in both directions alike, 1: more along y, less along x."""
    lens_x = np.array([lens.forms[i] == "biconic" for i in at])
    coefficients = lens.coefficients
    if lens_x.any():
        x = -by if axis else by
        coefficients = coefficients.at[at[lens_x], 0].add(x[lens_x])
    bent = lens.curvature.at[at].add(by)
    return dataclasses.replace(lens, curvature=bent, coefficients=coefficients)


def _medium(lens: Lens, kind: str, at: np.ndarray, by: Array) -> Dispersion:
    """Dispersion with indices off by a constant, or with nF - nC off by per cent and nd kept."""
    constants = lens.dispersion
    model = constants.model
    if model is not None:
        own = np.asarray(model)[at + 1, 0] > 1
        rows, some = at[own] + 1, by[own]
        if kind == "index":
            model = model.at[rows, 0].add(some)
        else:
            model = model.at[rows, 1].multiply(1 + some / 100)
        constants, at, by = dataclasses.replace(constants, model=model), at[~own], by[~own]
    f, d, c = refractive_index(constants, jnp.asarray(_LINES, lens.curvature.dtype))[at + 1].T
    schott = constants.schott
    if kind == "index":
        schott = schott.at[at + 1, 0].add(2 * d * by + by**2)
    else:
        # vd off by a part e: nF - nC becomes itself / (1 + e), by a term in 1 / L^2.
        change = (f - c) * (1 / (1 + by / 100) - 1)
        inverse = 1 / np.square(_LINES)
        strength = 2 * d * change / (inverse[0] - inverse[2])
        schott = schott.at[at + 1, 2].add(strength).at[at + 1, 0].add(-strength * inverse[1])
    return dataclasses.replace(constants, schott=schott)
