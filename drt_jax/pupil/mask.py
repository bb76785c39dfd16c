"""Plates of pixels in the stop: coded apertures, apodisers, phase plates."""

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
_ROUND = 64  # last digits by which a ray on the rim may miss it


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Mask:
    """A plate of N x M pixels [y, x] that fills the square around the circle of the stop, from the
    lowest y and x on; each pixel is even.

    amplitude: (N, M) or (W, N, M), one for each wavelength; its square is the light that passes.
    path: of the same shape, optical path that a pixel adds, mm; None for none. It acts on waves:
        rays go on as they did.
    """

    amplitude: Array
    path: Array | None = None
    __repr__ = brief

    def check(self) -> None:
        """ValueError for other shapes."""
        shape = jnp.shape(self.amplitude)
        other = shape if self.path is None else jnp.shape(self.path)
        if len(shape) not in (2, 3) or other != shape:
            what = "expected an amplitude (N, M) or (W, N, M) and a path of that shape or None"
            raise ValueError(f"mask: {what}, got {shape} and {other}")

    def light(self, at: Array, half: Array) -> Array:
        """Mean part of the light that passes boxes, see `means`, (W, ...)."""
        return self.means(jnp.asarray(self.amplitude, at.dtype) ** 2, at, half)

    def waves(self, wavelengths: Array, at: Array, half: Array) -> Array:
        """Mean factor of waves in boxes, see `means`, complex (W, ...). wavelengths: (W,), um."""
        given = self.amplitude, 0 * self.amplitude if self.path is None else self.path
        amplitude, path = (jnp.asarray(a, wavelengths.dtype) for a in given)
        shape = jnp.broadcast_shapes(path.shape, (len(wavelengths), 1, 1))
        phase = 2 * jnp.pi * _UM / wavelengths[:, None, None] * jnp.broadcast_to(path, shape)
        size = jnp.broadcast_to(amplitude, shape)
        return self.means(jax.lax.complex(size * jnp.cos(phase), size * jnp.sin(phase)), at, half)

    @staticmethod
    def means(pixels: Array, at: Array, half: Array) -> Array:
        """Means (W, ...) of pixels (N, M) or (W, N, M) in boxes about points `at` (2, W, ...) with
        half sides `half` (2, W, ...), in semi-diameters of the stop: exact for boxes along x and y
        that are no larger than a pixel; the pixel itself for sides of 0; 0 beside the plate."""
        padded = jnp.pad(pixels, [(0, 0)] * (pixels.ndim - 2) + [(1, 1)] * 2)
        padded = jnp.broadcast_to(padded, (at.shape[1], *padded.shape[-2:]))
        ends = []  # of the box along x and y: two pixels and the parts of it that lie in them
        for point, reach, count in zip(at, half, pixels.shape[:-3:-1]):
            low, wide = (point - reach + 1) * (count / 2), reach * count
            # A ray on the rim crosses the pixel inside, also if rounding puts it beside the plate.
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
    """A rule whose rays carry the light that a mask lets pass.

    Each ray has the light of the pixel that it crosses. With the Q rays of a rule, sums over pixels
    come out to about the part of the rays whose neighbour crosses another pixel: take many, such as
    a `Pattern` of `pupil.square_grid`. `PsfModel.masked` needs no more rays than without a mask.

    rule: of the symmetry "none". mask: without a path, which turns no rays. ValueError for others,
    where rays are traced.
    """

    rule: PupilRule
    mask: Mask

    @property
    def symmetry(self):  # type: ignore[override]
        """Symmetry of the rule."""
        return self.rule.symmetry

    def points(self, lens: Lens, scene: Scene) -> tuple[Vector, Array]:
        """Points and weights of the rule."""
        self.mask.check()
        if self.symmetry != "none" or self.mask.path is not None:
            what = 'give a rule of the symmetry "none" and no path: a path acts on waves alone'
            raise ValueError(f"Masked: {what}, in psf")
        return self.rule.points(lens, scene)

    def transmission(self, lens: Lens, bundle: Bundle) -> Array:
        """Transmission of the rule times that of the mask, (W, Q)."""
        at = jnp.stack([hit[lens.stop] for hit in bundle.hits]) / lens.semi_diameter[lens.stop]
        return self.rule.transmission(lens, bundle) * self.mask.light(at, jnp.zeros_like(at))
