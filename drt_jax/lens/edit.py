"""The same lens at another size, reversed, or with its paraxial entrance pupil as the stop."""

import dataclasses
import re
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import Numbers, concrete, real_array, selected
from .forms import FORMS
from .lens import Labels, Lens
from .paraxial import entrance_pupil

# How the named coefficients of forms change: the power of the size with which they scale, and their
# sign if the sag changes sign.
_NAMED = {"curvature_x": (-1, -1), "conic_x": (0, 1), "norm_radius": (1, 1)}


def _degree(power: int | str) -> int:
    """Degree of a term in the coordinates, by its name in files: 4, "y" or "x1y2"."""
    if isinstance(power, int):
        return power
    return sum(map(int, re.findall(r"\d+", power))) or 1


def _terms(form: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """How `count` coefficients of a form change.

    Returns the powers of the size with which they scale, and their signs if the sag changes sign.
    """
    record = FORMS[form]
    by_radius = "norm_radius" in record.named  # coefficients are heights, mm
    terms = [_NAMED[name] for name in record.named]
    terms += [(1 if by_radius else 1 - _degree(power), -1) for power in record.powers[:count]]
    terms += [(0, 1)] * count  # of forms with fewer terms the rest is 0
    powers, signs = np.array(terms[:count], int).reshape(count, 2).T
    return powers, signs


def resized(coefficients: Array, forms: tuple[str, ...], factor: Array) -> Array:
    """Coefficients (N, K) of forms or phases, after all lengths were multiplied by `factor`, one or
    (N, 1)."""
    powers = np.array([_terms(form, coefficients.shape[1])[0] for form in forms])
    return coefficients * factor ** jnp.asarray(powers, factor.dtype)


def scaled(lens: Lens, factor: Numbers) -> Lens:
    """The lens with all lengths multiplied by a factor.

    Rays keep their angles, and all aberrations in mm scale with the factor. Gratings and other
    phases keep the angles, too.

    lens: the lens.
    factor: (), above 0; differentiable. ValueError for another factor, where it is known.
    """
    size = real_array("factor", factor, lens.curvature.dtype)
    if size.shape or (concrete(size) and not size > 0):
        raise ValueError(f"factor: expected one number above 0, got {factor}")

    def larger(part: Any, *names: str, **others: Any) -> Any:
        """The lens, or a part of it, with the lengths of these names multiplied."""
        lengths = {name: jax.tree.map(lambda a: a * size, getattr(part, name)) for name in names}
        return dataclasses.replace(part, **lengths, **others)

    phase, elements, apertures = lens.phase, lens.elements, lens.apertures
    if phase is not None:
        own = resized(phase.coefficients, phase.forms, size)
        phase = dataclasses.replace(phase, coefficients=own)
    return larger(
        lens,
        *("thickness", "semi_diameter", "sensor", "decentre"),
        curvature=lens.curvature / size,
        coefficients=resized(lens.coefficients, lens.forms, size),
        phase=phase,
        elements=elements and larger(elements, "shift", "pivot"),
        apertures=apertures and larger(apertures, "half", "centre"),
    )


def reindexed(lens: Lens, rows: Sequence[int], media: Sequence[int], thickness: Array) -> Lens:
    """The lens with its surfaces in another order, with planes added, or with fewer surfaces.

    Here every field of `Lens` that has rows for surfaces or media, or numbers of surfaces, is
    mapped.

    lens: the lens.
    rows: (T + 1,), for each of the T new surfaces and the sensor the old row; -1 for a new plane
        without an aperture. No old row occurs twice; the stop, and the ends and pivots of elements,
        occur.
    media: (T + 1,), for each new medium the old one.
    thickness: (T - 1,), between the new vertices, mm.
    """
    old, into = np.array(rows), np.array(media)
    new = {row: k for k, row in enumerate(rows)}

    def numbers(surfaces: Iterable[int]) -> tuple[int, ...]:
        return tuple(new[i] for i in surfaces)

    def stay(surfaces: Sequence[int]) -> list[int]:
        return [k for k, i in enumerate(surfaces) if i in new]

    def taken(array: Array | None, plane: float = 0.0) -> Any:
        if array is None:
            return None
        is_new = np.reshape(old < 0, (-1, *(1,) * (array.ndim - 1)))
        return jnp.where(is_new, plane, array[old])

    phase, elements, apertures = lens.phase, lens.elements, lens.apertures
    replace = dataclasses.replace
    if phase is not None:
        ruled = phase.surfaces
        phase = selected(phase, sorted(stay(ruled), key=lambda k: new[ruled[k]]))
        phase = phase and replace(phase, surfaces=numbers(phase.surfaces))
    if apertures is not None:
        apertures = apertures.only(stay(apertures.surfaces))
        apertures = apertures and replace(apertures, surfaces=numbers(apertures.surfaces))
    if elements is not None:
        spans = tuple((new[first], new[last]) for first, last in elements.spans)
        elements = replace(elements, spans=spans, about=numbers(elements.about))
    return replace(
        lens,
        **{name: taken(getattr(lens, name)) for name in ("curvature", "conic", "coefficients")},
        thickness=thickness,
        semi_diameter=taken(lens.semi_diameter, np.inf),
        dispersion=jax.tree.map(lambda a: a[into], lens.dispersion),
        decentre=taken(lens.decentre),
        tilt=taken(lens.tilt),
        phase=phase,
        elements=elements,
        apertures=apertures,
        stop=new[lens.stop],
        labels=Labels(lens.name, tuple(lens.glasses[i] for i in media)),
        forms=tuple(lens.forms[i] if i >= 0 else "asphere" for i in rows),
        mirrors=tuple(i >= 0 and lens.mirrors[i] for i in rows[:-1]),
        curved=tuple(sorted(numbers(i for i in lens.curved if i in new))),
    )


def named(lens: Lens, name: str) -> Lens:
    """The lens with another name, which stands on sheets and in files.

    lens: the lens.
    name: its name.
    """
    return dataclasses.replace(lens, labels=Labels(name, lens.glasses))


def flipped(lens: Lens) -> Lens:
    """The lens reversed: light takes each path backwards.

    The sensor is not reversed, and keeps its distance from the last vertex. ValueError for a lens
    with mirrors or elements.
    """
    simple = not any(lens.mirrors) and lens.elements is None
    require(simple, "lens: with mirrors or elements it cannot be flipped")
    count, dtype = lens.count, lens.curvature.dtype
    rows = [*range(count)[::-1], count]
    turned = reindexed(lens, rows, range(count + 1)[::-1], lens.thickness[::-1])
    # Surfaces are reversed, the sensor is not; tilts about z keep their sign.
    turn = np.array([*[-1] * count, 1])
    signs = np.array([_terms(form, lens.coefficients.shape[1])[1] for form in turned.forms])
    signs[-1] = 1
    tilt = turned.tilt
    if tilt is not None:
        tilt = tilt * jnp.asarray(np.stack([turn, turn, turn**2], axis=1), dtype)
    return dataclasses.replace(
        turned,
        curvature=turned.curvature * jnp.asarray(turn, dtype),
        coefficients=turned.coefficients * jnp.asarray(signs, dtype),
        tilt=tilt,
    )


def with_paraxial_pupil(lens: Lens, wavelength: Numbers = 0.5875618) -> Lens:
    """The lens with its paraxial entrance pupil as the stop, as design programs launch rays without
    ray aiming.

    Two dummy planes are put in front: surface 0 at the first vertex, so that z and distances do not
    change, and surface 1, the pupil in object space. At every field and wavelength rays fill the
    pupil uniformly, and the chief ray passes through its centre. The real stop becomes an ordinary
    surface without a semi-diameter, at which only `Lens.apertures` clip.

    Differentiable: the pupil moves with the lens. Tilts and decentres are neglected.

    lens: the lens.
    wavelength: (), of the paraxial rays, the primary wavelength, um.

    ValueError for a pupil at infinity; inside a trace all rays then fail.
    """
    pupil, count = entrance_pupil(lens, wavelength), lens.count
    place, radius = pupil.position[0], pupil.semi_diameter[0]
    known = jnp.isfinite(place)
    if concrete(known) and not known:
        raise ValueError("pupil: the paraxial entrance pupil is at infinity: take the real stop")
    place = jnp.where(known, place, 0)
    thickness = jnp.concatenate([jnp.stack([place, -place]), lens.thickness])
    found = reindexed(lens, [-1, -1, *range(count + 1)], [0, 0, *range(count + 1)], thickness)
    rim = found.semi_diameter.at[found.stop].set(jnp.inf)
    rim = rim.at[1].set(jnp.where(known, radius, jnp.inf))
    return dataclasses.replace(found, semi_diameter=rim, stop=1)
