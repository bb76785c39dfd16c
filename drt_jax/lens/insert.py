"""Surfaces, elements and plates put into a lens and taken out, another stop, aspheric terms.

Stop, apertures, phases, tilts and elements move with their surfaces. Numbers of surfaces count
from 0 in the lens that is given. Numbers may be traced, except where an error says otherwise.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, whole_numbers
from ..numerics import Numbers, concrete, real_array
from .edit import reindexed
from .glass import Dispersion, Glass, with_media
from .lens import Labels, Lens
from .paraxial import marginal_ray, paraxial_system


def _surface(lens: Lens, name: str, surface: int, least: int = 0) -> int:
    """A surface of the lens; ValueError for another number. least: -1 to take that, too."""
    (number,) = whole_numbers(name, (surface,))
    count = lens.count
    require(least <= number < count, f"{name}: expected one from 0 to {count - 1}, got {surface}")
    return number


def inserted(
    lens: Lens,
    surface: int,
    glass: Glass | int,
    like: int | None = None,
    distance: Numbers = 0.01,
    thickness: Numbers = 0.01,
) -> Lens:
    """The lens with two surfaces more, of equal shape, and another medium between them.

    Glass in air is a thin meniscus; air in glass splits an element. The change of the rays is
    proportional to the thickness, so that a design can continue from there. A meniscus next to a
    surface of its own shape, `like`, turns a minimum nearly into a saddle point, from which the
    merit falls in two directions (Bociort and van Turnhout, Opt. Eng. 48, 063001, 2009).

    lens: the lens.
    surface: in the medium behind it the pair stands; -1 for a pair in front of the lens.
    glass: between the pair, such as `find_glass("air")`; or the number of a medium of the lens,
        from 0 in front of the first surface. ValueError for the medium that is there.
    like: the surface whose form, curvature, conic and coefficients both have; None: `surface`, or
        the first one; -1 for two planes, see also `with_plate`.
    distance: (), mm along the light from the vertex of `surface` to the pair; in front of the lens
        from the pair to the first vertex.
    thickness: (), mm along the light between the pair. Surfaces that touch cannot be traced: both
        must be above 0, and together less than the gap; ValueError otherwise.

    The new surfaces have the numbers `surface + 1` and `surface + 2`, and no aperture. All others
    and the sensor stay where they are. z and object distances count from the new first surface.
    """
    i = _surface(lens, "surface", surface, -1)
    row = max(i, 0) if like is None else _surface(lens, "like", like, -1)
    around = lens.glasses[i + 1]
    own = glass if isinstance(glass, int) else i + 1
    require(0 <= own <= lens.count, f"glass: expected a medium from 0 to {lens.count}, got {own}")
    name = lens.glasses[own] if isinstance(glass, int) else glass.name
    require(name != around, f"glass: {name} is behind surface {i} already")
    gaps, added = _gaps(lens, i, distance, thickness)
    rows = [*range(i + 1), -1, -1, *range(i + 1, lens.count + 1)]
    media = [*range(i + 2), own, *range(i + 1, lens.count + 1)]
    found, pair = reindexed(lens, rows, media, gaps), np.array([i + 1, i + 2])
    names, forms, shape = list(found.glasses), list(found.forms), {}
    names[i + 2] = name
    if row >= 0:
        forms[i + 1] = forms[i + 2] = lens.forms[row]
        for part in ("curvature", "conic", "coefficients"):
            shape[part] = getattr(found, part).at[pair].set(getattr(lens, part)[row])
    dispersion = found.dispersion
    if not isinstance(glass, int):
        inside = np.arange(len(names)) == i + 2
        dispersion = with_media(dispersion, inside, Dispersion.of([glass]))
    labels = Labels(lens.name, tuple(names))
    sensor = lens.sensor + added if i < 0 else lens.sensor
    return dataclasses.replace(
        found, dispersion=dispersion, labels=labels, forms=tuple(forms), sensor=sensor, **shape
    )


def _gaps(lens: Lens, i: int, distance: Numbers, thickness: Numbers) -> tuple[Array, Array]:
    """Thicknesses with a pair of surfaces behind surface i, and what the pair and its distance take
    along z; arguments and errors as in `inserted`."""
    gaps, sense = lens.thickness, float(lens.senses[i + 1])
    given = (("distance", distance), ("thickness", thickness))
    far, apart = (sense * real_array(name, value, gaps.dtype)[None] for name, value in given)
    room = gaps[max(i, 0) : i + 1] - far - apart  # none in front of the first, behind the last
    if concrete((far, apart, room)):
        fits = bool(np.all(sense * np.concatenate([far, apart, room]) > 0))
        what = f"distance, thickness: {distance} and {thickness} mm behind surface {i}"
        require(fits, f"{what}: expected two numbers above 0, together less than the gap")
    new = [far, apart, room] if i >= 0 else [apart, far]
    return jnp.concatenate([gaps[: max(i, 0)], *new, gaps[i + 1 :]]), (far + apart)[0]


def with_plate(
    lens: Lens,
    surface: int,
    glass: Glass,
    distance: Numbers,
    thickness: Numbers,
    wavelength: Numbers = 0.5875618,
) -> Lens:
    """The lens with a plane plate, such as a filter or a cover glass, and all that stands behind it
    moved away by the paraxial shift t (1 - n0 / n).

    Paraxial rays of this wavelength do not change behind the plate. `inserted` with `like=-1`
    inserts the plate and moves nothing.

    lens, surface, glass, distance, thickness: as in `inserted`; behind the last surface the
        distance counts from there towards the sensor.
    wavelength: (), um.
    """
    found, i = inserted(lens, surface, glass, -1, distance, thickness), surface
    around, inside = found.index(wavelength)[i + 1 : i + 3, 0]
    gaps, shift = found.thickness, found.thickness[i + 1] * (1 - around / inside)
    gaps = gaps.at[i + 2].add(shift) if i + 2 < len(gaps) else gaps
    return dataclasses.replace(found, thickness=gaps, sensor=found.sensor + shift)


def with_dummy(
    lens: Lens, surface: int, distance: Numbers = 0.0, curvature: Numbers | None = None
) -> Lens:
    """The lens with one surface more that changes no ray: a place for a stop, an aperture or a
    phase, in air or inside of a glass.

    `with_stop(with_dummy(lens, 3, 1.5), 4)` moves the stop there; `removed` takes it out.

    lens: the lens.
    surface: the new one is behind it, number `surface + 1`; -1 for one in front of the lens.
    distance: (), mm along the light from the vertex of `surface` to the new one; in front of the
        lens from the new one to the first vertex. It may leave the gap: the straight ray in the
        medium there is extended to it.
    curvature: (), 1/mm; None for a plane, which costs less.

    All others and the sensor stay where they are. z and object distances count from the new first
    surface.
    """
    i = _surface(lens, "surface", surface, -1)
    gaps, count = lens.thickness, lens.count
    far = float(lens.senses[i + 1]) * real_array("distance", distance, gaps.dtype)[None]
    around = gaps[max(i, 0) : i + 1]
    new = [far, around - far] if 0 <= i < count - 1 else [far]
    thickness = jnp.concatenate([gaps[: max(i, 0)], *new, gaps[i + 1 :]])
    rows = [*range(i + 1), -1, *range(i + 1, count + 1)]
    found = reindexed(lens, rows, [*range(i + 2), *range(i + 1, count + 1)], thickness)
    if curvature is not None:
        bend = found.curvature.at[i + 1].set(real_array("curvature", curvature, gaps.dtype))
        curved = tuple(sorted({*found.curved, i + 1}))
        found = dataclasses.replace(found, curvature=bend, curved=curved)
    return dataclasses.replace(found, sensor=lens.sensor + (far[0] if i < 0 else 0))


def _require_free(lens: Lens, out: Sequence[int]) -> None:
    """ValueError for surfaces that cannot be taken out."""
    gone, elements = set(out), lens.elements
    kept = set() if elements is None else {*elements.about}.union(*elements.spans)
    require(lens.stop not in gone, f"surfaces: {lens.stop} is the stop: see `with_stop`")
    require(not any(lens.mirrors[i] for i in out), "surfaces: mirrors cannot be taken out")
    require(not gone & kept, "surfaces: an element begins, ends or turns there")


def cemented(lens: Lens, surface: int, curvature: Numbers | None = None) -> Lens:
    """The lens with two elements cemented: their air gap is taken out, two faces become one, and
    all that stands behind moves up by the gap.

    lens: the lens.
    surface: the last face of the first element, which stays, with its conic, terms and place. The
        next face goes; the narrower of both apertures stays.
    curvature: (), 1/mm, of the common face; None for the mean of both.

    ValueError if there is no air between two glasses, for two of the same glass (`removed` takes
    out their gap), and if the next face is the stop, a mirror or one where elements begin, end or
    turn.
    """
    i, count = _surface(lens, "surface", surface), lens.count
    front, gap, back = (*lens.glasses[i : i + 3], "", "")[:3]
    fits = back and gap == "air" and gap not in (front, back) and front != back
    require(fits, f"surface: {front}, {gap}, {back or 'the sensor'} cannot be cemented at {i}")
    _require_free(lens, (i + 1,))
    gaps, others = lens.thickness, [k for k in range(count + 1) if k != i + 1]
    found = reindexed(lens, others, others, jnp.concatenate([gaps[:i], gaps[i + 1 :]]))
    pair = jnp.mean(lens.curvature[i : i + 2]) if curvature is None else curvature
    return dataclasses.replace(
        found,
        curvature=found.curvature.at[i].set(real_array("curvature", pair, gaps.dtype)),
        semi_diameter=found.semi_diameter.at[i].set(jnp.min(lens.semi_diameter[i : i + 2])),
        sensor=lens.sensor - gaps[i],
    )


def removed(lens: Lens, surfaces: Sequence[int]) -> Lens:
    """The lens without some surfaces. All others, and the sensor, stay where they are.

    A medium ends where the next surface that stays stands. z and distances count from the first
    surface that stays.

    lens: the lens.
    surfaces: numbers of neighbouring surfaces.

    ValueError if the media in front of them and behind them differ, and for the stop, mirrors, all
    surfaces, and those that elements begin, end or turn at.
    """
    out, count = sorted(whole_numbers("surfaces", surfaces)), lens.count
    together = bool(out) and out == list(range(out[0], out[-1] + 1))
    fits = together and out[0] >= 0 and out[-1] < count and len(out) < count
    require(fits, f"surfaces: expected some neighbours of 0 to {count - 1}, got {surfaces}")
    first, last, media = out[0], out[-1], lens.glasses
    _require_free(lens, out)
    what = f"surfaces: {media[first]} in front of {first}, {media[last + 1]} behind {last}"
    require(media[first] == media[last + 1], f"{what}: take out a whole element, or more")
    rows = [i for i in range(count + 1) if i not in out]
    gaps, before = lens.thickness, max(first - 1, 0)
    merged = jnp.sum(gaps[before : last + 1])[None] if first > 0 and last < count - 1 else gaps[:0]
    thickness = jnp.concatenate([gaps[:before], merged, gaps[last + 1 :]])
    found = reindexed(lens, rows, [*range(first + 1), *range(last + 2, count + 1)], thickness)
    lost = jnp.sum(gaps[: last + 1]) if first == 0 else 0.0
    return dataclasses.replace(found, sensor=lens.sensor - lost)


def with_stop(lens: Lens, surface: int, wavelength: Numbers = 0.5875618) -> Lens:
    """The lens with another surface as its stop, as wide as the beam on the axis is there.

    The beam is paraxial, of an object at infinity. The old stop keeps its width as an aperture.

    lens: the lens.
    surface: the new stop.
    wavelength: (), um.
    """
    number = _surface(lens, "surface", surface)
    waves = real_array("wavelength", wavelength, lens.curvature.dtype)[None]
    beam = marginal_ray(paraxial_system(lens, waves), jnp.zeros_like(waves))
    semi = lens.semi_diameter.at[number].set(jnp.abs(beam.height[number, 0]))
    return dataclasses.replace(lens, semi_diameter=semi, stop=number)


def with_asphere(lens: Lens, surface: int, orders: Sequence[int]) -> Lens:
    """The lens with aspheric terms of a surface, which are 0 where it had none.

    Then `Vary("coefficients", (surface,))` bends them.

    lens: the lens.
    surface: a sphere, conic or even asphere.
    orders: powers of the height, such as (4, 6, 8). ValueError for odd ones.
    """
    number, powers = _surface(lens, "surface", surface), whole_numbers("orders", orders)
    form = lens.forms[number]
    require(form == "asphere", f"surface: {number} is of the form {form}, which has its own terms")
    even = bool(powers) and all(power >= 4 and power % 2 == 0 for power in powers)
    require(even, f"orders: expected even powers from 4 on, got {orders}")
    more = max(max(powers) // 2 - lens.coefficients.shape[1], 0)
    return dataclasses.replace(lens, coefficients=jnp.pad(lens.coefficients, ((0, 0), (0, more))))
