"""A lens as built: the deviations of its parts as a vector."""

import dataclasses
import itertools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.elements import Elements
from ..lens.glass import Dispersion, refractive_index
from ..lens.lens import Lens
from ..lens.surface import by_form, surface_sag
from .deviations import (
    KINDS,
    WITH_X,
    Deviation,
    Tolerance,
    deviations_of,
    elements_of,
    pieces_of,
    x_curvatures,
)

# A fringe is half a wave of green light (ISO 10110-5: 0.5460740 um), in mm.
_FRINGE = 0.5460740e-3 / 2
_LINES = (0.4861327, 0.5875618, 0.6562725)  # F, d, C
_MINUTE = math.pi / 180 / 60


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PerturbedLens:
    """A lens with P deviations.

    lens: the nominal lens, with all arrays that the deviations need.
    beam_radius: (S,), radius of the beam footprint on each surface, mm.
    sizes: (P,), largest deviations, in the units of `Tolerance`.

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

    @classmethod
    def from_lens(
        cls, lens: Lens, beam_radius: Array, tolerances: Sequence[Tolerance]
    ) -> "PerturbedLens":
        """The lens with the deviations that tolerances allow.

        lens: the nominal lens.
        beam_radius: (S,), mm, for instance that of `Problem.beam_radius`.
        tolerances: the tolerances.

        ValueError for a part that does not exist (the message lists those that do) or is named
        twice.
        """
        if np.shape(beam_radius) != (lens.count,):
            raise ValueError(
                f"beam_radius: expected ({lens.count},), got shape {np.shape(beam_radius)}"
            )
        spans, dtype = elements_of(lens), lens.curvature.dtype
        sizes = deviations_of(lens, tolerances)
        kinds = {error.kind for error in sizes}
        lens, groups = _with_elements(lens, spans, kinds)
        if "wedge" in kinds and lens.tilt is None:
            lens = dataclasses.replace(lens, tilt=jnp.zeros((lens.count + 1, 3), dtype))
        if "irregularity" in kinds:
            lens = _with_cylinders(lens)
        largest = jnp.asarray([*sizes.values()], dtype)
        return cls(lens, jnp.asarray(beam_radius, dtype), largest, tuple(sizes), spans, groups)

    @property
    def parts(self) -> list[list[int]]:
        """Indices of the deviations of each part: one index, or those of the components x and y."""
        parts: dict[tuple, list[int]] = {}
        for k, error in enumerate(self.deviations):
            parts.setdefault(error[:2], []).append(k)
        return list(parts.values())

    def lens_of(self, perturbation: Array) -> Lens:
        """The lens with a perturbation.

        Works in `jit`, `vmap` and under differentiation.

        perturbation: (P,), deviations in units of their largest.
        """
        lens = self.lens
        found: dict[str, list[tuple[Deviation, Array]]] = {}
        for k, error in enumerate(self.deviations):
            found.setdefault(error.kind, []).append((error, perturbation[k] * self.sizes[k]))
        for kind, own in found.items():
            places = np.array([error.place for error, _ in own])
            axes = np.array([error.axis for error, _ in own])
            lens = self._deviated(lens, kind, places, axes, jnp.stack([by for _, by in own]))
        return lens

    def _deviated(self, lens: Lens, kind: str, at: np.ndarray, axis: np.ndarray, by: Array) -> Lens:
        """The lens with deviations `by` of one kind, at the places `at` and along the axes
        `axis`.
        """
        replace, own = dataclasses.replace, self.lens
        if kind == "radius":
            part = 1 / (1 + by / 100) - 1
            return _curved(lens, at, own.curvature[at] * part, x_curvatures(own, at) * part)
        if kind in ("fringes", "irregularity"):
            bend = by * _FRINGE / _rise(own, at, self.beam_radius)
            both = (bend, bend) if kind == "fringes" else (bend / 2, -bend / 2)
            return _curved(lens, at, *both)
        if kind == "thickness":
            gap = lens.thickness.at[at].add(by)
            return replace(lens, thickness=gap, sensor=lens.sensor + jnp.sum(by))
        if kind in ("index", "abbe"):
            pieces = pieces_of(own)
            media = np.concatenate([pieces[i] for i in at])
            by = by[np.repeat(np.arange(len(at)), [len(pieces[i]) for i in at])]
            return replace(lens, dispersion=_medium(lens, own.dispersion, kind, media, by))
        if kind == "wedge":
            assert lens.tilt is not None
            return replace(lens, tilt=lens.tilt.at[at, axis].add(by * _MINUTE))
        elements = lens.elements
        assert elements is not None
        rows = np.array(self.groups)[at]
        if kind == "shift":
            elements = replace(elements, shift=elements.shift.at[rows, axis].add(by))
        else:
            elements = replace(elements, tilt=elements.tilt.at[rows, axis].add(by * _MINUTE))
        return replace(lens, elements=elements)


def _with_elements(
    lens: Lens, spans: tuple[tuple[int, int], ...], kinds: set[str]
) -> tuple[Lens, tuple[int, ...]]:
    """The same lens with a group for each element, and the indices of these groups.

    The lens is unchanged if no deviation moves an element. Groups that the lens already has are
    kept, inside of the new ones or around them.
    """
    if not any(KINDS[kind].whole == "element" for kind in kinds):
        return lens, ()
    zero = jnp.zeros((len(spans), 3), lens.curvature.dtype)
    arrays = [(zero, zero, zero[:, 0])]
    where, about, old = list(spans), [first for first, _ in spans], lens.elements
    if old is not None:
        for (a, b), (first, last) in itertools.product(old.spans, spans):
            if a < first <= b < last or first < a <= last < b:
                raise ValueError(
                    f"tolerances: the element of surfaces {first} to {last} is cut by that of the "
                    f"lens file, {a} to {b}; put one inside the other, or apart"
                )
        arrays.insert(0, (old.shift, old.tilt, old.pivot))
        where, about = [*old.spans, *where], [*old.about, *about]
    # A group comes before the groups inside it.
    order = sorted(range(len(where)), key=lambda g: (where[g][0], -where[g][1], g))
    shift, tilt, pivot = (jnp.concatenate(parts)[np.array(order)] for parts in zip(*arrays))
    elements = Elements(
        shift, tilt, pivot, tuple(where[g] for g in order), tuple(about[g] for g in order)
    )
    new = range(len(where) - len(spans), len(where))
    return dataclasses.replace(lens, elements=elements), tuple(order.index(g) for g in new)


def _with_cylinders(lens: Lens) -> Lens:
    """The same lens with every asphere as a biconic of equal curvatures."""
    round_ = np.array([form == "asphere" for form in lens.forms])
    own = jnp.stack([lens.curvature, lens.conic], axis=1)
    wide = jnp.concatenate([own, lens.coefficients], axis=1)
    narrow = jnp.concatenate([lens.coefficients, jnp.zeros_like(own)], axis=1)
    wide = jnp.where(round_[:, None], wide, narrow)
    forms = tuple("biconic" if r else form for r, form in zip(round_, lens.forms))
    return dataclasses.replace(lens, coefficients=wide, forms=forms)


def _curved(lens: Lens, at: np.ndarray, by: Array, across: Array) -> Lens:
    """The lens with the curvatures of surfaces `at` changed by `by`, and those along x by
    `across`.
    """
    own = np.array([lens.forms[i] in WITH_X for i in at])
    coefficients = lens.coefficients
    if own.any():
        coefficients = coefficients.at[at[own], 0].add(across[own])
    curvature = lens.curvature.at[at].add(by)
    return dataclasses.replace(lens, curvature=curvature, coefficients=coefficients)


def _rise(lens: Lens, at: np.ndarray, beam_radius: Array) -> Array:
    """Displacement of surfaces `at` along the normal at the rim of the beam, mm for each 1/mm of
    curvature along y.

    It is d(sag)/d(curvature) / sqrt(1 + slope^2).
    """
    shape = jax.tree.map(lambda a: a[..., at], lens.shape)
    forms, zero = tuple(lens.forms[i] for i in at), jnp.zeros(len(at), lens.curvature.dtype)

    def height(y: Array, bend: Array) -> Array:
        changed = shape._replace(curvature=shape.curvature + bend)
        return by_form(surface_sag, (jnp.zeros_like(y), y), changed, forms)

    rim = beam_radius[at], zero
    _, slope = jax.jvp(height, rim, (zero + 1, zero))
    _, rise = jax.jvp(height, rim, (zero, zero + 1))
    return rise / jnp.sqrt(1 + slope**2)


def _medium(lens: Lens, nominal: Dispersion, kind: str, at: np.ndarray, by: Array) -> Dispersion:
    """Dispersion with a change of nd of the media `at`, or of vd by per cent at constant nd.

    For a glass with a dispersion formula, n^2 changes by a constant that gives the change at the d
    line, or by a term in 1/L^2 (L the wavelength) that gives the change of n_F - n_C.
    """
    constants, model = lens.dispersion, lens.dispersion.model
    own = jnp.zeros(len(at), bool)
    if model is not None:
        own = model[at, 0] > 1
        if kind == "index":
            model = model.at[at, 0].add(jnp.where(own, by, 0))
        else:
            model = model.at[at, 1].add(jnp.where(own, model[at, 1] * by / 100, 0))
    f, d, c = refractive_index(nominal, jnp.asarray(_LINES, lens.curvature.dtype))[at].T
    schott = constants.schott
    if kind == "index":
        schott = schott.at[at, 0].add(jnp.where(own, 0, 2 * d * by + by**2))
    else:
        change = (f - c) * (1 / (1 + by / 100) - 1)
        inverse = [1 / line**2 for line in _LINES]
        slope = (inverse[0] - inverse[1]) / (2 * f) + (inverse[1] - inverse[2]) / (2 * c)
        strength = jnp.where(own, 0, change / slope)
        schott = schott.at[at, 2].add(strength).at[at, 0].add(-strength * inverse[1])
    return dataclasses.replace(constants, schott=schott, model=model)
