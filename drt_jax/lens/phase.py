"""Diffractive structures: gratings, zone plates, metalenses, as phase that a surface adds."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from .forms import Shape


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Phase:
    """Structures on N surfaces, of any form, refracting or reflecting or between equal media.

    Each adds order x wavelength x phi(w) to the optical path of a ray through the point w. The
    phase phi, in waves, is written as the sag of a form in `surface.FORMS` is in mm, without
    curvature and conic: "linear" is a grating of a_0 lines per mm, whose first order turns light
    towards +y; "asphere" a radial phase, a zone plate of the focal length f at the wavelength L
    with -1 / (2 f L) waves/mm^2, L in mm; or "polynomial_xy".

    coefficients: (N, K), of the forms, in waves per mm to their powers.
    order: (N,), of diffraction: a whole number.

    Static:
    surfaces: the indices of the N surfaces, rising.
    forms: their N names.
    """

    coefficients: Array
    order: Array
    surfaces: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    forms: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    @property
    def shape(self) -> Shape:
        """Of the phase as a sag: arrays (N,) and (K, N)."""
        flat = jnp.zeros_like(self.order)
        return Shape(flat, flat, self.coefficients.T)
