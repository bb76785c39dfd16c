"""Rays through the paraxial entrance pupil, as design programs launch them without ray aiming."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import Numbers, concrete
from .lens import Labels, Lens
from .paraxial import entrance_pupil


def with_paraxial_pupil(lens: Lens, wavelength: Numbers = 0.5875618) -> Lens:
    """The lens with its paraxial entrance pupil as the stop.

    Two dummy planes are put in front: surface 0 at the first vertex, so that z and distances do not
    change, and surface 1, the pupil in object space. At every field and wavelength rays fill the
    pupil uniformly, and the chief ray passes through its centre. The real stop becomes an ordinary
    surface without a semi-diameter, at which only `Lens.apertures` clip.

    Differentiable: the pupil moves with the lens. Tilts and decentres are neglected.

    lens: the lens.
    wavelength: (), of the paraxial rays, the primary wavelength, um.

    ValueError for a pupil at infinity; inside a trace all rays then fail.
    """
    pupil = entrance_pupil(lens, wavelength)
    place, radius = pupil.position[0], pupil.semi_diameter[0]
    known = jnp.isfinite(place)
    if concrete(known) and not known:
        raise ValueError("pupil: the paraxial entrance pupil is at infinity: take the real stop")
    place = jnp.where(known, place, 0)

    def padded(array: Array, first: float | Array = 0.0) -> Array:
        return jnp.concatenate([jnp.full_like(array, first, shape=(2, *array.shape[1:])), array])

    def moved(surfaces: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(i + 2 for i in surfaces)

    rim = padded(lens.semi_diameter.at[lens.stop].set(jnp.inf), jnp.inf)
    phase, elements, extra = lens.phase, lens.elements, lens.apertures
    replace = dataclasses.replace
    return replace(
        lens,
        curvature=padded(lens.curvature),
        conic=padded(lens.conic),
        coefficients=padded(lens.coefficients),
        thickness=jnp.concatenate([jnp.stack([place, -place]), lens.thickness]),
        semi_diameter=rim.at[1].set(jnp.where(known, radius, jnp.inf)),
        dispersion=jax.tree.map(lambda a: padded(a, a[:1]), lens.dispersion),
        decentre=lens.decentre if lens.decentre is None else padded(lens.decentre),
        tilt=lens.tilt if lens.tilt is None else padded(lens.tilt),
        phase=phase and replace(phase, surfaces=moved(phase.surfaces)),
        elements=elements
        and replace(elements, spans=tuple(map(moved, elements.spans)), about=moved(elements.about)),
        apertures=extra and replace(extra, surfaces=moved(extra.surfaces)),
        stop=1,
        labels=Labels(lens.name, lens.glasses[:1] * 2 + lens.glasses),
        forms=("asphere", "asphere", *lens.forms),
        mirrors=(False, False, *lens.mirrors),
        curved=moved(lens.curved),
    )
