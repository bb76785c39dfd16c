"""Two lenses one behind the other. Numbers may be traced."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, require_one_of
from ..numerics import Numbers, concrete, real_array
from .edit import reindexed
from .glass import with_media
from .lens import Labels, Lens


def _stacked(one: Array | None, two: Array | None, counts: Sequence[int]) -> Array | None:
    """The rows of two arrays, one after the other. Narrower rows are filled with zeros, and so are
    `counts` rows of None; None if both are."""
    given = two if one is None else one
    if given is None:
        return None
    empty = jnp.zeros((0, *given.shape[1:]), given.dtype)
    both = [empty if a is None else a for a in (one, two)]
    wide = np.max([a.shape[1:] for a in both], axis=0)
    more = [[(0, n - len(a)), *zip(0 * wide, wide - a.shape[1:])] for a, n in zip(both, counts)]
    return jnp.concatenate([jnp.pad(a, pad) for a, pad in zip(both, more)])


def _together(one: Any, two: Any) -> Any:
    """Phases, elements or apertures of two lenses as one record; None if both are None."""
    if one is None or two is None:
        return two if one is None else one
    counts, parts = [len(jax.tree.leaves(a)[0]) for a in (one, two)], dict[str, Any]()
    for field in dataclasses.fields(one):
        a, b = (getattr(record, field.name) for record in (one, two))
        parts[field.name] = a + b if field.metadata else _stacked(a, b, counts)
    return type(one)(**parts)


def joined(first: Lens, second: Lens, gap: Numbers, stop: str = "first") -> Lens:
    """A lens behind another one, such as a camera behind an attachment or an eyepiece behind an
    objective.

    The result has all parts of both, except the sensor of the first with its apertures and tilts. A
    coordinate break of the first lens, which moves its sensor, also moves the second lens.

    first, second: the lenses.
    gap: (), mm along the axis from the last vertex of the first lens to the first vertex of the
        second; above 0.
    stop: "first" or "second": whose stop is the stop. The other one keeps its width as an aperture.

    ValueError if the medium behind the first lens is not that in front of the second, for lenses
    of two dtypes, if light leaves the first lens backwards, after an odd number of mirrors, and if
    some of its elements turns about its sensor.
    """
    require_one_of("stop", stop, ("first", "second"))
    count, more, dtype = first.count, second.count, first.curvature.dtype
    media = first.glasses[-1], second.glasses[0]
    require(media[0] == media[1], f"second: {media[0]} ends first, {media[1]} begins second")
    require(dtype == second.curvature.dtype, "second: must have the dtype of the first")
    require(first.senses[-1] == 1, "first: light leaves it backwards, after a mirror")
    space = real_array("gap", gap, dtype)
    require(not concrete(space) or space > 0, f"gap: expected mm above 0, got {gap}")
    elements, apertures = first.elements, first.apertures
    if apertures is not None:
        apertures = apertures.only([k for k, i in enumerate(apertures.surfaces) if i < count])
    if elements is not None:
        elements = elements.only([g for g, span in enumerate(elements.spans) if span[0] < count])
        about = () if elements is None else elements.about
        require(count not in about, "first: an element turns about its sensor")
    first = dataclasses.replace(first, elements=elements, apertures=apertures)
    thickness = jnp.concatenate([first.thickness, space[None], second.thickness])
    ahead = [*range(count), *[-1] * more, count], [*range(count + 1), *[count] * more]
    behind = [*[-1] * count, *range(more + 1)], [*[0] * count, *range(more + 1)]
    one, two = reindexed(first, *ahead, thickness), reindexed(second, *behind, thickness)
    kept = np.delete(np.arange(count + more + 2), count)  # without the sensor of the first
    names = "curvature", "conic", "coefficients", "semi_diameter", "decentre", "tilt"
    parts: dict[str, Any] = {}
    for name in names:
        pair = getattr(first, name), getattr(second, name)
        rows = _stacked(*pair, (count + 1, more + 1))
        parts[name] = rows if rows is None else rows[kept]
    for name in ("phase", "elements", "apertures"):
        parts[name] = _together(getattr(one, name), getattr(two, name))
    return dataclasses.replace(
        one if stop == "first" else two,
        **parts,
        sensor=jnp.sum(thickness[:count]) + second.sensor,
        dispersion=with_media(one.dispersion, np.arange(count + more + 1) > count, two.dispersion),
        labels=Labels(f"{first.name} and {second.name}", first.glasses + second.glasses[1:]),
        forms=first.forms[:-1] + second.forms,
        mirrors=first.mirrors + second.mirrors,
        curved=(*(i for i in one.curved if i < count), *two.curved),
        afocal=second.afocal,
        free=tuple(sorted({*first.free, *second.free})),
        held=(),
    )
