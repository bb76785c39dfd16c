"""Diffractive surfaces, such as gratings, zone plates and metalenses: phases added to rays."""

import dataclasses

import jax
import jax.numpy as jnp
from jax import Array

from .forms import Shape


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Phase:
    """Phases on N surfaces, which may refract, reflect or do neither.

    Each adds order * wavelength * phi(w) to the optical path of a ray through the point w. The
    phase phi, in waves, has the formula of a sag without curvature and conic, see `forms`. "linear"
    is a grating of a_0 lines per mm, whose first order turns light towards +y. "asphere" is a
    radial phase; a_0 = -1 / (2 f L) is a zone plate of focal length f at the wavelength L, both in
    mm. The third possible form is "polynomial_xy".

    coefficients: (N, K), waves / mm^power.
    order: (N,), order of diffraction, a whole number.

    Static:
    surfaces: indices of the N surfaces, in increasing order.
    forms: names of the N forms.
    """

    coefficients: Array
    order: Array
    surfaces: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    forms: tuple[str, ...] = dataclasses.field(metadata={"static": True})

    @property
    def shape(self) -> Shape:
        """Shape whose sag is the phase, N rows."""
        flat = jnp.zeros_like(self.order)
        return Shape(flat, flat, self.coefficients.T)
