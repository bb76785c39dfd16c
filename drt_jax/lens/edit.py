"""The same lens at another size, or reversed."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import Numbers, concrete, real_array
from .forms import FORMS
from .lens import Labels, Lens
from .phase import Phase

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


def _resized(coefficients: Array, forms: tuple[str, ...], factor: Array) -> Array:
    """Coefficients (N, K) of forms or phases, after all lengths were multiplied by `factor`."""
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
    phase, elements, apertures = lens.phase, lens.elements, lens.apertures
    if phase is not None:
        own = _resized(phase.coefficients, phase.forms, size)
        phase = dataclasses.replace(phase, coefficients=own)
    if elements is not None:
        shift, pivot = elements.shift * size, elements.pivot * size
        elements = dataclasses.replace(elements, shift=shift, pivot=pivot)
    if apertures is not None:
        centre = None if apertures.centre is None else apertures.centre * size
        apertures = dataclasses.replace(apertures, half=apertures.half * size, centre=centre)
    return dataclasses.replace(
        lens,
        curvature=lens.curvature / size,
        coefficients=_resized(lens.coefficients, lens.forms, size),
        thickness=lens.thickness * size,
        semi_diameter=lens.semi_diameter * size,
        sensor=lens.sensor * size,
        decentre=None if lens.decentre is None else lens.decentre * size,
        phase=phase,
        elements=elements,
        apertures=apertures,
    )


def flipped(lens: Lens) -> Lens:
    """The lens reversed: light takes each path backwards.

    The sensor is not reversed, and keeps its distance from the last vertex. ValueError for a lens
    with mirrors or elements.
    """
    if any(lens.mirrors) or lens.elements is not None:
        raise ValueError("lens: with mirrors or elements it cannot be flipped")
    count = lens.count
    order = np.array([*range(count)[::-1], count])
    other = {i: count - 1 - i for i in range(count)} | {count: count}
    signs = np.array([_terms(form, lens.coefficients.shape[1])[1] for form in lens.forms])
    signs[-1], turn = 1, np.array([*[-1] * count, 1])  # the sensor is not reversed
    dtype = lens.curvature.dtype
    tilt = lens.tilt
    if tilt is not None:  # tilts about x and y change their sign
        tilt = (tilt * jnp.asarray(np.stack([turn, turn, turn**2], axis=1), dtype))[order]
    phase, apertures = lens.phase, lens.apertures
    if phase is not None:
        phase = Phase(
            phase.coefficients[::-1],
            phase.order[::-1],
            tuple(other[i] for i in phase.surfaces[::-1]),
            phase.forms[::-1],
        )
    if apertures is not None:
        places = tuple(other[i] for i in apertures.surfaces)
        apertures = dataclasses.replace(apertures, surfaces=places)
    return dataclasses.replace(
        lens,
        curvature=(lens.curvature * jnp.asarray(turn, dtype))[order],
        conic=lens.conic[order],
        coefficients=(lens.coefficients * jnp.asarray(signs, dtype))[order],
        thickness=lens.thickness[::-1],
        semi_diameter=lens.semi_diameter[order],
        dispersion=jax.tree.map(lambda a: a[::-1], lens.dispersion),
        decentre=None if lens.decentre is None else lens.decentre[order],
        tilt=tilt,
        phase=phase,
        apertures=apertures,
        stop=other[lens.stop],
        labels=Labels(lens.name, lens.glasses[::-1]),
        forms=tuple(lens.forms[i] for i in order),
        mirrors=lens.mirrors[::-1],
        curved=tuple(sorted(other[i] for i in lens.curved)),
    )
