"""PSF kernels of a beam on the pixels, by one of three models."""

import dataclasses
import functools
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from ..lens.lens import Lens
from ..numerics import safe_divide
from ..pupil.mask import Mask
from ..pupil.rules import PupilRule
from .beam import Beam, BeamRule, beam_rule, centroid_and_variances
from .kernel import gaussian_shares
from .ray_psf import ray_kernel, ray_spots
from .wave_psf import wave_kernel

Kind = Literal["gaussian", "rays", "waves"]
# Number of cells along a side of the pupil, and degree of polynomials, where none is given.
CELLS, DEGREE = 128, 14
_FINE = 8  # cells along each side of a pixel of a mask


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Psf:
    """Light of an object point on the pixels, for W wavelengths. Several points are the first axes
    of all arrays.

    kernel: (W, size, size), [wavelength, y, x], with the sum 1 - outside.
    outside: (W,), fraction of the light on the sensor that falls outside of the kernel.
    centre: (2,), mm, centre of the kernel on the sensor.
    throughput: (W,), fraction of the light through the stop that reaches the sensor.
    solid_angle: (W,), area of the cone of light on the sensor in direction cosines. Irradiance is
        radiance times this area. Its ratio to the area on the axis is the relative illumination.
    """

    kernel: Array
    outside: Array
    centre: Array
    throughput: Array
    solid_angle: Array


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("rule", "errors"),
    meta_fields=("kind", "cells"),
)
@dataclasses.dataclass(frozen=True)
class Sampling:
    """How kernels, contrast and energy are computed: of which kind, by which rays, on which grid.
    `converge` makes one for a tolerance.

    kind: "gaussian" (the moments of the rays), "rays" (all their light) or "waves" (with
        diffraction).
    rule: rays and polynomials of the beam.
    cells: number of cells along a side of the pupil grid; 0 for "gaussian".
    errors: with "auto", the difference between the kernel of each kind and that of "waves" at the
        worst wavelength, which is compared with the tolerance.
    """

    kind: Kind
    rule: BeamRule
    cells: int
    errors: dict[str, float] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(
        cls, kind: Kind, rule: PupilRule, cells: int = CELLS, degree: int = DEGREE
    ) -> "Sampling":
        """A sampling by hand.

        kind: "gaussian", "rays" or "waves".
        rule: pupil rule, whose symmetry and kind (`Gauss` or `Clipped`) the rays have.
        cells: number of cells along a side of the pupil grid. Too few lower the contrast of a large
            blur, and never raise it.
        degree: of the polynomials of the pupil.
        """
        return cls(kind, beam_rule(degree, rule.symmetry, rule), cells)

    def masked(self, mask: Mask, cells: int = 0) -> "Sampling":
        """The sampling with a mask in the stop. Also in `jax.jit`; differentiable in the mask.

        mask: the mask.
        cells: number of cells along a side of the grid; 0 for the larger of its own number
            and 8 for each pixel of the mask. docs/images.md gives the accuracy.

        No more rays are traced than without the mask, and kernels are centred as without it.
        ValueError for a mask of a wrong shape, for the kind "gaussian", which only has the moments
        of the whole stop, and for a mask with a path for the kind "rays".
        """
        mask.check()
        if self.kind == "gaussian" or (self.kind == "rays" and mask.path is not None):
            what = "a mask" if mask.path is None else "a mask with a path"
            raise ValueError(f'{what} in the kind "{self.kind}": make one of "waves"')
        cells = cells or max(self.cells, _FINE * max(jnp.shape(mask.amplitude)[-2:]))
        rule = dataclasses.replace(self.rule, mask=mask)
        return dataclasses.replace(self, rule=rule, cells=cells)


def psf_of_beam(
    lens: Lens,
    wavelengths: Array,
    beam: Beam,
    pixel: Array,
    centre: Array | None,
    size: int,
    kind: Kind,
    cells: int,
) -> Psf:
    """The `Psf` of a beam.

    lens, beam: the lens and its beam.
    wavelengths: (W,), um.
    pixel: (), mm.
    centre: (2,), mm, or None for the mean of the centroids.
    size, kind, cells: as in `Sampling` and `psf`.
    """
    mean, (xx, xy, yy) = centroid_and_variances(beam.hits[:, -1], beam.weights)
    if centre is None:
        centre = jnp.mean(mean, axis=-1)
    light = beam.throughput
    if beam.mask is not None:
        light = jnp.sum(ray_spots(lens, beam, cells)[2], axis=-1)
    total = light[:, None, None]
    if kind == "gaussian":
        covariance = jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)
        kernel = gaussian_shares((mean - centre[:, None]).T, covariance, pixel, size)
        kernel = jnp.where(total > 0, kernel, 0)
    else:
        if kind == "rays":
            kernel = ray_kernel(lens, beam, centre, pixel, size, cells)
        else:
            kernel = wave_kernel(lens, beam, wavelengths, centre, pixel, size, cells)
        kernel = jnp.where(total > 0, kernel / jnp.where(total > 0, total, 1), 0)
    outside = jnp.where(light > 0, 1 - jnp.sum(kernel, axis=(1, 2)), 0)
    solid_angle = beam.solid_angle() * safe_divide(light, beam.throughput)
    return Psf(kernel, outside, centre, light, solid_angle)
