"""Masks in the plane of the stop, made of pixels: coded apertures, apodisers, phase plates."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
from jax import Array

from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import brief, safe_divide
from ..rays.system import Vector
from ..rays.trace import Bundle
from .rules import PupilRule

_UM = 1e3  # per mm
_ROUND = 64  # machine epsilons by which a ray aimed at the rim may miss it


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Mask:
    """A mask in the stop: N x M pixels [y, x] on the square that circumscribes the stop.

    Row 0 has the lowest y and column 0 the lowest x. Transmission and path are constant over a
    pixel.

    amplitude: (N, M), or (W, N, M) with one table for each wavelength; amplitude transmission. The
        transmitted fraction of the light is its square.
    path: same shape as `amplitude`, optical path that a pixel adds, mm; None for none. It changes
        the phase of waves only; the directions of rays do not change.
    """

    amplitude: Array
    path: Array | None = None
    __repr__ = brief

    def check(self) -> None:
        """ValueError if the shapes of `amplitude` and `path` are not those of the class
        docstring."""
        shape = jnp.shape(self.amplitude)
        other = shape if self.path is None else jnp.shape(self.path)
        if len(shape) not in (2, 3) or other != shape:
            what = "expected an amplitude (N, M) or (W, N, M) and a path of that shape or None"
            raise ValueError(f"mask: {what}, got {shape} and {other}")

    def light(self, at: Array, half: Array) -> Array:
        """Mean of amplitude^2 over boxes, (W, ...); arguments as in `means`."""
        return self.means(jnp.asarray(self.amplitude, at.dtype) ** 2, at, half)

    def waves(self, wavelengths: Array, at: Array, half: Array) -> Array:
        """Mean of amplitude exp(2 pi i path / wavelength) over boxes, complex (W, ...).

        wavelengths: (W,), um.
        at, half: boxes, as in `means`.
        """
        given = self.amplitude, 0 * self.amplitude if self.path is None else self.path
        amplitude, path = (jnp.asarray(a, wavelengths.dtype) for a in given)
        shape = jnp.broadcast_shapes(path.shape, (len(wavelengths), 1, 1))
        phase = 2 * jnp.pi * _UM / wavelengths[:, None, None] * jnp.broadcast_to(path, shape)
        size = jnp.broadcast_to(amplitude, shape)
        return self.means(jax.lax.complex(size * jnp.cos(phase), size * jnp.sin(phase)), at, half)

    @staticmethod
    def means(pixels: Array, at: Array, half: Array) -> Array:
        """Means of a table of pixels over boxes, (W, ...).

        pixels: (N, M) or (W, N, M).
        at: (2, W, ...), x and y of the centres of the boxes, in units of the semi-diameter of the
            stop.
        half: (2, W, ...), half the sides of the boxes, same unit.

        A box with sides along x and y that is no larger than a pixel overlaps at most two pixels
        along each axis, so the mean is exact: a sum of four pixels with the product of the
        overlapped fractions as weights. A box of size 0 takes the pixel at its centre. Outside of
        the mask the table is 0.
        """
        padded = jnp.pad(pixels, [(0, 0)] * (pixels.ndim - 2) + [(1, 1)] * 2)
        padded = jnp.broadcast_to(padded, (at.shape[1], *padded.shape[-2:]))
        ends = []  # along x and y: the two pixels that a box overlaps, and the fractions
        for point, reach, count in zip(at, half, pixels.shape[:-3:-1]):
            low, wide = (point - reach + 1) * (count / 2), reach * count
            # A ray aimed at the rim takes the outermost pixel, even if rounding puts it just
            # outside of the mask.
            near = jnp.abs(jnp.abs(point) - 1) <= _ROUND * float(jnp.finfo(point.dtype).eps)
            low = jnp.where(near & (reach == 0), jnp.clip(low, 0, count - 1), low)
            first = jnp.floor(low)
            second = jnp.clip(safe_divide(low + wide - first - 1, wide), 0, 1)
            place = jnp.clip(first, -1, count).astype(jnp.int32) + 1
            ends.append([(place, 1 - second), (jnp.minimum(place + 1, count + 1), second)])
        take = jax.vmap(lambda table, y, x: table[y, x])
        found = jnp.zeros(at.shape[1:], padded.dtype)
        for (x, part), (y, other) in itertools.product(*ends):
            found += (part * other).astype(padded.dtype) * take(padded, y, x)
        return found


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Masked(PupilRule):
    """A pupil rule whose rays are weighted with the transmission of a mask.

    rule: pupil rule of the symmetry "none".
    mask: mask without a path, because a path does not change rays.

    Each ray takes the transmission of the pixel that it crosses. With Q rays, a sum over the pixels
    has a relative error of about the fraction of rays whose neighbour crosses another pixel: take
    many rays, for instance a `Pattern` of `pupil.square_grid`. `Sampling.masked` needs no more rays
    than a model without a mask. ValueError, when rays are traced, for another symmetry and for a
    mask with a path.
    """

    rule: PupilRule
    mask: Mask

    @property
    def symmetry(self):  # type: ignore[override]
        """Symmetry of `rule`."""
        return self.rule.symmetry

    def points(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights of `rule`. ValueError as described for the class."""
        self.mask.check()
        if self.symmetry != "none" or self.mask.path is not None:
            what = 'give a rule of the symmetry "none" and no path: a path acts on waves alone'
            raise ValueError(f"Masked: {what}, in psf")
        return self.rule.points(lens, scene)

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """Transmission (W, Q) of `rule` times that of the mask."""
        at = jnp.stack([hit[lens.stop] for hit in bundle.hits]) / lens.semi_diameter[lens.stop]
        return self.rule.transmission(lens, bundle) * self.mask.light(at, jnp.zeros_like(at))
