"""Optical transfer functions: the pupil function of a beam, in direction cosines, against itself.

Light of a wavelength makes a grating of f cycles/mm on the sensor where two of its directions
differ by f wavelength / n. Its contrast is the integral of P(d + s / 2) conj(P(d - s / 2)) over
directions d, s the difference, over that of |P|^2, P the amplitude in direction cosines on the
sensor: Hopkins' formula with the real pupil (Goodman, Introduction to Fourier Optics, ch. 6). The
grid of d covers what both pupils share, however little that is, so that the function is right up to
where it ends. In the limit of short wavelengths it is the mean of exp(-2 pi i f.x) over rays.
"""

import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require_one_of
from ..lens.lens import Lens
from ..lens.scene import Scene, fields_array, scene_of, spectrum_of
from ..numerics import Numbers, real_array, safe_divide, safe_sqrt
from ..pupil.rules import PupilRule
from .beam import Beam, beam_rule, trace_beam
from .cover import cover
from .spot import normalised
from .spots import light_rule
from .wave_psf import pupil_function

Model = Literal["waves", "rays"]
_UM = 1e3  # per mm
# Cells of the grid of directions, along a side; degree of the polynomials.
_CELLS, _DEGREE = 64, 14


class Transfer(NamedTuple):
    """Transfer functions of F fields at N frequencies, of all wavelengths together.

    frequencies: (N,) cycles/mm on the sensor.
    otf: (F, 2, N) or, through focus, (F, Z, 2, N), complex, 1 at 0: of a grating across the y axis
        of the sensor (tangential, for a field along y), and across its x axis (sagittal), about the
        centroid of the light.
    limit: the same of waves without aberrations in the same pupil.

    All are 0 where no light arrives.
    """

    frequencies: Array
    otf: Array
    limit: Array

    @property
    def mtf(self) -> Array:
        """The modulus of the otf."""
        return jnp.abs(self.otf)


def transfer(
    lens: Lens,
    fields: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    frequencies: Numbers,
    model: Model = "waves",
    focus: Numbers = 0.0,
    wavelength_weights: Numbers | None = None,
    rule: PupilRule | None = None,
    degree: int = _DEGREE,
    cells: int = _CELLS,
) -> Transfer:
    """Optical transfer functions over frequency, field and focus, see `Transfer`.

    fields: (F,) along y or (F, 2), radians. distance: mm, inf allowed. wavelengths: (W,) um.
    frequencies: (N,) cycles/mm.
    model: "waves" (diffraction) or "rays" (geometric).
    focus: () mm by which the sensor stands behind its place; or (Z,), through focus: arrays are
        then (F, Z, 2, N), and no more rays are traced.
    wavelength_weights: (W,), of any sum; None: equal. Light that is lost counts less.
    rule: of the pupil, whose kind is kept (`Gauss` or `Clipped`); None: found, outside of a trace.
    degree: of the polynomials of the pupil. cells: of the grid, along a side.

    Differentiable in every mode. ValueError as of `scene_of`, and without a rule inside a trace.
    """
    scene = fields, distance, wavelengths
    given = arrays_of(
        lens, scene, model, focus, wavelength_weights, rule, "frequencies", frequencies
    )
    return _transfer(lens, *given, model, degree, cells)


def arrays_of(
    lens: Lens,
    scene: tuple[Numbers, Numbers, Numbers],
    model: Model,
    focus: Numbers,
    wavelength_weights: Numbers | None,
    rule: PupilRule | None,
    name: str,
    places: Numbers,
) -> tuple[Array, Scene, Array, Array, Array, PupilRule]:
    """Arguments of `transfer` and of `encircled_energy`, checked, as arrays: fields (F, 2), scene
    of the axis, places (N,), spectrum (W,), focus () or (Z,), and the rule. scene: fields, distance
    and wavelengths. name: of the places, for messages."""
    require_one_of("model", model, get_args(Model))
    dtype = lens.curvature.dtype
    axis, angles = scene_of(lens, 0.0, *scene[1:]), fields_array(scene[0], dtype)
    values, steps = real_array(name, places, dtype), real_array("focus", focus, dtype)
    if values.ndim != 1:
        raise ValueError(f"{name}: expected (N,), got shape {values.shape}")
    spectrum = spectrum_of(wavelength_weights, axis, dtype)
    if steps.ndim > 1:
        raise ValueError(f"focus: expected one number or (Z,), got shape {steps.shape}")
    rule = light_rule(lens, *scene) if rule is None else rule
    return angles, axis, values, spectrum, steps, rule


def strehl(
    lens: Lens,
    fields: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    rule: PupilRule | None = None,
    degree: int = _DEGREE,
    cells: int = 2 * _CELLS,
) -> Array:
    """Strehl ratio (F, W): the irradiance of the image of a point over that without aberrations in
    the same pupil, `|integral of P|^2 / (integral of |P|)^2` over direction cosines.

    At the place where the wavefront has no tilt, in the mean square over the pupil: the peak of an
    image of a quarter of a wave or better. 0 where no light arrives. Arguments as of `transfer`.
    """
    axis = scene_of(lens, 0.0, distance, wavelengths)
    angles = fields_array(fields, lens.curvature.dtype)
    if rule is None:
        rule = light_rule(lens, fields, distance, wavelengths)
    return _strehl(lens, angles, axis, rule, degree, cells)


@functools.partial(jit, wanted=LARGE, static_argnames=("degree", "cells"))
def _strehl(
    lens: Lens, fields: Array, axis: Scene, rule: PupilRule, degree: int, cells: int
) -> Array:
    made = beam_rule(degree, rule.symmetry, rule)

    def one(field: Array) -> Array:
        beam = trace_beam(lens, Scene(field, axis.distance, axis.wavelengths), made)
        return strehl_of(lens, beam, axis.wavelengths, cells)

    return jax.vmap(one)(fields)


def strehl_of(lens: Lens, beam: Beam, wavelengths: Array, cells: int) -> Array:
    """The ratio (W,) of one beam, see `strehl`."""
    lit = beam.throughput > 0
    low, high = beam.directions_extent()
    pupil = pupil_function(lens, beam, wavelengths, cells)
    density, inside, phase = pupil((low + high) / 2, (high - low) / cells)
    size = safe_sqrt(density) * inside
    share = normalised(size, (1, 2))
    # The tilt goes along x, then y, which have no mean and a product of their own.
    side = np.arange(cells) - (cells - 1) / 2
    for line in np.meshgrid(side, side):
        place = jnp.asarray(line, phase.dtype)[None]
        place = place - jnp.sum(share * place, axis=(1, 2), keepdims=True)
        phase = phase - jnp.sum(share * phase, axis=(1, 2), keepdims=True)
        square = jnp.sum(share * place**2, axis=(1, 2), keepdims=True)
        product = jnp.sum(share * place * phase, axis=(1, 2), keepdims=True)
        phase = phase - safe_divide(product, square) * place
    parts = (jnp.sum(share * f(phase), axis=(1, 2)) for f in (jnp.cos, jnp.sin))
    return jnp.where(lit, sum(p**2 for p in parts), 0)


@functools.partial(jit, wanted=LARGE, static_argnames=("model", "degree", "cells"))
def _transfer(
    lens: Lens,
    fields: Array,
    axis: Scene,
    frequencies: Array,
    spectrum: Array,
    focus: Array,
    rule: PupilRule,
    model: Model,
    degree: int,
    cells: int,
) -> Transfer:
    made = beam_rule(degree, rule.symmetry, rule)

    def one(field: Array) -> tuple[Array, Array]:
        beam = trace_beam(lens, Scene(field, axis.distance, axis.wavelengths), made)
        given = axis.wavelengths, frequencies, spectrum, model, cells
        return through_focus(beam, focus, lambda moved: transfer_of(lens, moved, *given))

    otf, limit = jax.vmap(one)(fields)
    return Transfer(frequencies, otf, limit)


def through_focus(beam: Beam, focus: Array, of: Callable[[Beam], Any]) -> Any:
    """`of` the beam with the sensor `focus` mm farther, (), or of all (Z,) in a first axis."""
    moved = lambda step: of(beam.refocused(step))  # noqa: E731
    return jax.vmap(moved)(focus) if focus.ndim else moved(focus)


def centre_of(beam: Beam, spectrum: Array) -> tuple[Array, Array]:
    """The part (W,) of the light on the sensor in each wavelength and the centroid (2,) of all, mm.
    spectrum: (W,), weights of the light that fills the stop."""
    share = normalised(spectrum * beam.throughput)
    centre = jnp.einsum("w,wq,dwq->d", share, normalised(beam.weights), beam.hits[:, -1])
    return share, centre


def transfer_of(
    lens: Lens,
    beam: Beam,
    wavelengths: Array,
    frequencies: Array,
    spectrum: Array,
    model: Model,
    cells: int,
) -> tuple[Array, Array]:
    """Transfer function and limit (2, N) of one beam, see `Transfer`."""
    share, centre = centre_of(beam, spectrum)
    of = _of_rays if model == "rays" else _of_waves
    found = of(lens, beam, wavelengths, frequencies, centre, cells)
    otf, limit = (jnp.einsum("w,wkn->kn", share.astype(a.dtype), a) for a in found)
    return otf, limit


def _turned(size: Array, phase: Array) -> Array:
    """size exp(i phase)."""
    return jax.lax.complex(size * jnp.cos(phase), size * jnp.sin(phase))


def _of_rays(
    lens: Lens, beam: Beam, wavelengths: Array, frequencies: Array, centre: Array, cells: int
) -> tuple[Array, Array]:
    """(W, 2, N) each: of the hits of all cells of the stop; the limit is 1."""
    side = (np.arange(cells) - (cells - 1) / 2) * (2 / cells)
    low, high = beam.extent()
    functions, middle, half = beam.over_stop(), (low + high) / 2, (high - low) / 2
    start, step = (middle - functions.centre) / functions.scale, half / functions.scale
    values = functions.on_grid(start, step, side, slice(0))[0]
    places = jnp.asarray(np.stack(np.meshgrid(side, side)), values.dtype)[:, None]
    stop = middle[..., None, None] + half[..., None, None] * places
    axes = middle, half * (2 / cells)
    weight = cover(lens, beam, stop, values[2:], beam.points, axes)
    weight = normalised(weight, (1, 2))
    hits = values[1::-1] - centre[::-1, None, None, None]  # y first

    def at(frequency: Array) -> Array:
        waves = _turned(jnp.broadcast_to(weight, hits.shape), -2 * jnp.pi * frequency * hits)
        return jnp.sum(waves, axis=(2, 3))

    otf = jnp.moveaxis(jax.lax.map(at, frequencies), (0, 1, 2), (2, 1, 0))
    return otf, jnp.ones(otf.shape, hits.dtype)


def _of_waves(
    lens: Lens, beam: Beam, wavelengths: Array, frequencies: Array, centre: Array, cells: int
) -> tuple[Array, Array]:
    """(W, 2, N) each."""
    pupil = pupil_function(lens, beam, wavelengths, cells)
    low, high = beam.directions_extent()

    def sheared(shear: Array) -> tuple[Array, Array]:
        """The integrals (W,) for a difference of two directions (2, W)."""
        step = jnp.maximum(high - low - jnp.abs(shear), 0) / cells
        middle = (low + high) / 2
        first, second = pupil(middle + shear / 2, step), pupil(middle - shear / 2, step)
        light = safe_sqrt(first[0] * second[0]) * jnp.minimum(first[1], second[1])
        light = light * (step[0] * step[1])[:, None, None]
        turned = _turned(light, first[2] - second[2])
        return jnp.sum(turned, axis=(1, 2)), jnp.sum(light, axis=(1, 2))

    def at(frequency: Array) -> tuple[Array, Array]:
        shear = frequency * wavelengths / (_UM * beam.index)
        turned, light = [], []
        for k in (1, 0):
            both = [shear if d == k else jnp.zeros_like(shear) for d in range(2)]
            first, second = sheared(jnp.stack(both))
            back = 2 * jnp.pi * frequency * centre[k]
            turned.append(first * _turned(jnp.ones_like(back), back))
            light.append(second)
        return jnp.stack(turned), jnp.stack(light)

    otf, light = jax.lax.map(at, frequencies)
    size = jnp.broadcast_to(sheared(jnp.zeros_like(low))[1], light.shape)
    otf, light = safe_divide(otf, size.astype(otf.dtype)), safe_divide(light, size)
    return jnp.moveaxis(otf, (0, 1, 2), (2, 1, 0)), jnp.moveaxis(light, (0, 1, 2), (2, 1, 0))
