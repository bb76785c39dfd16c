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

    Two dummy planes come first: surface 0 at the first vertex, so that z and distances do not
    change, and surface 1, the pupil in object space. At every field and wavelength rays fill the
    pupil uniformly, and the chief ray passes its centre. The real stop becomes an ordinary surface
    without a semi-diameter: only `Lens.apertures` clip there.

    wavelength: () of the paraxial rays, the primary one, um.

    Differentiable: the pupil follows the lens. Tilts and decentres are neglected. ValueError for a
    pupil at infinity; inside a trace all rays then fail.
    """
    pupil = entrance_pupil(lens, wavelength)
    place, radius = pupil.position[0], pupil.semi_diameter[0]
    known = jnp.isfinite(place)
    if concrete(known) and not known:
        raise ValueError("pupil: the paraxial entrance pupil is at infinity: take the real stop")
    place = jnp.where(known, place, 0)

    def behind(array: Array, first: float | Array = 0.0) -> Array:
        return jnp.concatenate([jnp.full_like(array, first, shape=(2, *array.shape[1:])), array])

    def later(surfaces: tuple[int, ...]) -> tuple[int, ...]:
        return tuple(i + 2 for i in surfaces)

    rim = behind(lens.semi_diameter.at[lens.stop].set(jnp.inf), jnp.inf)
    phase, elements, extra = lens.phase, lens.elements, lens.apertures
    replace = dataclasses.replace
    return replace(
        lens,
        curvature=behind(lens.curvature),
        conic=behind(lens.conic),
        coefficients=behind(lens.coefficients),
        thickness=jnp.concatenate([jnp.stack([place, -place]), lens.thickness]),
        semi_diameter=rim.at[1].set(jnp.where(known, radius, jnp.inf)),
        dispersion=jax.tree.map(lambda a: behind(a, a[:1]), lens.dispersion),
        decentre=lens.decentre if lens.decentre is None else behind(lens.decentre),
        tilt=lens.tilt if lens.tilt is None else behind(lens.tilt),
        phase=phase and replace(phase, surfaces=later(phase.surfaces)),
        elements=elements
        and replace(elements, spans=tuple(map(later, elements.spans)), about=later(elements.about)),
        apertures=extra and replace(extra, surfaces=later(extra.surfaces)),
        stop=1,
        labels=Labels(lens.name, lens.glasses[:1] * 2 + lens.glasses),
        forms=("asphere", "asphere", *lens.forms),
        mirrors=(False, False, *lens.mirrors),
        curved=later(lens.curved),
    )
