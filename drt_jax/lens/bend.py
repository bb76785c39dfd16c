"""Elements bent, and split by power, at the same paraxial power. Numbers may be traced."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jax import Array

from ..inputs import require, whole_numbers
from ..numerics import Numbers, concrete, real_array, safe_divide
from .glass import Glass
from .insert import inserted
from .lens import Lens
from .paraxial import paraxial_system, trace_yu


def _group(lens: Lens, surfaces: Sequence[int]) -> range:
    """Neighbouring surfaces, two or more, that refract; ValueError for others."""
    numbers = whole_numbers("surfaces", surfaces)
    faces = range(min(numbers, default=0), max(numbers, default=-1) + 1)
    is_group = [*faces] == sorted(numbers) and len(faces) > 1 and {*faces} <= {*range(lens.count)}
    what = f"surfaces: expected neighbours of 0 to {lens.count - 1}, such as (2, 3), got {surfaces}"
    require(is_group, what)
    refract = all(i in lens.active and not lens.mirrors[i] for i in faces)
    require(refract, f"surfaces: one of {[*faces]} does not refract")
    return faces


def _power(lens: Lens, faces: range, wavelength: Array) -> Array:
    """Paraxial power (), 1/mm, of a group of faces in the media where it stands."""
    system, first, end = paraxial_system(lens, wavelength[None]), faces.start, faces.stop
    index = system.index[first : end + 1, 0]
    one = jnp.ones_like(index[0])
    rays = trace_yu(system.power[first:end, 0], system.gaps[first : end - 1], index, one, 0 * one)
    return -index[-1] * rays[1][-1]


def _solved(lens: Lens, surface: int, faces: range, power: Array, wavelength: Array) -> Lens:
    """The lens with the curvature of one face for which a group of faces has a power.

    The power is linear in the curvature of each of its faces, so that one step is exact.
    """

    def with_bend(bend: Array) -> Lens:
        return dataclasses.replace(lens, curvature=lens.curvature.at[surface].add(bend))

    zero = jnp.zeros_like(power)
    own, slope = jax.jvp(
        lambda bend: _power(with_bend(bend), faces, wavelength), (zero,), (zero + 1,)
    )
    return with_bend(safe_divide(power - own, slope))


def bent(
    lens: Lens, surfaces: Sequence[int], curvature: Numbers, wavelength: Numbers = 0.5875618
) -> Lens:
    """The lens with an element bent at constant power.

    The curvature is added to all faces of the element except the last. The curvature of the last is
    solved for, so that the paraxial power of the thick element stays the same. The shape factor
    (c1 + c2) / (c1 - c2) of a thin element grows by 2 curvature / (c1 - c2). All vertices and the
    sensor stay, so the principal planes move, and the focal length of a lens of several elements
    changes a little.

    lens: the lens.
    surfaces: the faces of the element, such as (0, 1); of a cemented one all its faces.
    curvature: (), 1/mm, added.
    wavelength: (), um, of the paraxial ray.
    """
    faces, dtype = _group(lens, surfaces), lens.curvature.dtype
    wave = real_array("wavelength", wavelength, dtype)
    added, last = real_array("curvature", curvature, dtype), faces.stop - 1
    more = lens.curvature.at[faces.start : last].add(added)
    found = dataclasses.replace(lens, curvature=more)
    return _solved(found, last, faces, _power(lens, faces, wave), wave)


def split(
    lens: Lens,
    surface: int,
    share: Numbers = 0.5,
    gap: Numbers = 0.1,
    wavelength: Numbers = 0.5875618,
) -> Lens:
    """The lens with an element split in two of the same glass, with air between them.

    The outer faces and all other surfaces stay as they are and where they are. The new faces,
    numbers `surface + 1` and `surface + 2`, are spheres without an aperture: the curvature of the
    first gives the first element its share of the power, that of the second gives the pair the
    paraxial power of the element. Its principal planes may move by a part of the gap. The glass
    thickness is divided in the same ratio as the power, so that rims become thinner only in
    proportion.

    lens: the lens.
    surface: the first face of the element, cemented to others or not.
    share: (), of the power for the first element, between 0 and 1.
    gap: (), mm along the light between the new faces. ValueError unless it is above 0 and less
        than the thickness.
    wavelength: (), um, of the paraxial ray.
    """
    faces, dtype = _group(lens, (surface, surface + 1)), lens.curvature.dtype
    part, wave = real_array("share", share, dtype), real_array("wavelength", wavelength, dtype)
    fits = not concrete(part) or 0 < part < 1
    require(fits, f"share: expected a number between 0 and 1, got {share}")
    air, glass = real_array("gap", gap, dtype), abs(lens.thickness[surface])
    found = inserted(lens, surface, Glass("air"), -1, part * (glass - air), air)
    power = _power(lens, faces, wave)
    found = _solved(found, surface + 1, faces, part * power, wave)
    return _solved(found, surface + 2, range(surface, surface + 4), power, wave)
