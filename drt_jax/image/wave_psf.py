"""The kernel of wave optics: plane waves of all directions of a beam, added up on the pixels.

The field at a place x of the sensor is U(x) = sum over directions d of c exp(i k n d.x), with k = 2
pi / wavelength, directions from the sphere of the exit pupil (`Beam.on_sphere`), and |c|^2 the
light times the cell's area of direction cosines. On a regular grid of direction cosines |U|^2 is a
sum over the differences of two directions, the optical transfer function: the autocorrelation of c,
which two Fourier transforms give. A pixel's integral of each of its waves is a sinc, so that the
kernel is a product of three matrices, and exact for the grid. Source: Goodman, Introduction to
Fourier Optics (2005), ch. 6; Soummer et al., Opt. Express 15, 15935 (2007) for the product.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..numerics import einsum, safe_divide, safe_sqrt
from .beam import Beam
from .cover import cover

_UM = 1e3  # per mm


def wave_kernel(
    lens: Lens,
    beam: Beam,
    wavelengths: Array,
    centre: Array,
    pixel: Array,
    size: int,
    cells: int,
) -> Array:
    """What pixels collect of the light, (W, size, size) [y, x], adding to the part of the
    throughput that falls on the grid.

    wavelengths: (W,) um. centre: (2,) mm of the grid on the sensor. pixel: () mm. cells: of the
    grid of directions, along a side; the kernel repeats every `period`. Cells at an edge hold the
    mean of their amplitude. So a kernel lacks a fraction (pi x / period)^2 / 3 of the light that
    edges diffract to the distance x: with 128 cells 1.5e-3 of Airy's light within half a period.
    """
    amplitude, step = amplitudes(lens, beam, wavelengths, cells)
    transfer = autocorrelation(amplitude)
    lags = np.fft.fftfreq(2 * cells, 1 / (2 * cells))
    # Waves of the differences of two directions, cycles a mm: (2, W, 2 N).
    unit = step * (beam.index * _UM / wavelengths)[None]
    frequency = unit[..., None] * jnp.asarray(lags, unit.dtype)[None, None]
    place = (jnp.arange(size, dtype=pixel.dtype) - (size - 1) / 2) * pixel
    waves = []
    for f, c in zip((frequency[0, :, :cells], frequency[1]), centre):
        f, x = f[:, None], (place + c)[None, :, None]
        phase = 2 * jnp.pi * f * x
        wave = jax.lax.complex(jnp.cos(phase), jnp.sin(phase))
        waves.append(wave * jnp.sinc(f * pixel).astype(wave.dtype))
    across, down = waves
    # The lags that `transfer` leaves out have the conjugate values.
    across = across * jnp.asarray(np.where(lags[:cells] > 0, 2, 1), across.dtype)[None, None]
    kernel = einsum("wyv,wvu,wxu->wyx", down, transfer, across).real
    cell = step[0] * step[1] * beam.index * _UM / wavelengths
    return kernel * (cell * pixel)[:, None, None] ** 2


def period(beam: Beam, wavelengths: Array, cells: int) -> Array:
    """After how many mm along x and y, (2, W), the kernel of so many cells repeats."""
    step = _grid(beam, cells)[1]
    return (wavelengths / (_UM * beam.index))[None] / step


def _grid(beam: Beam, cells: int) -> tuple[Array, Array]:
    """Centre and step of the grid of direction cosines, (2, W) each."""
    low, high = beam.directions_extent()
    return (low + high) / 2, (high - low) / cells


class PupilCells(NamedTuple):
    """Cells of a grid of directions, (W, N, N).

    light: pi times the light a unit of directions. inside: the part of a cell that it fills.
    phase: at the middle of the cell, radians. turn: (2, W, N, N), its change over a cell along x
        and y. middle: (2, W, N, N), of the light, see `cover`.
    """

    light: Array
    inside: Array
    phase: Array
    turn: Array
    middle: Array


def pupil_function(
    lens: Lens, beam: Beam, wavelengths: Array, cells: int
) -> Callable[[Array, Array], PupilCells]:
    """The cells as a function of the middle and the step of their grid, (2, W) each."""
    functions, side = beam.over_directions(), np.arange(cells) - (cells - 1) / 2
    turns = (2 * jnp.pi * _UM / wavelengths)[:, None, None]

    def pupil(middle: Array, step: Array) -> PupilCells:
        start = (middle - functions.centre) / functions.scale
        values, *slopes = functions.on_grid(start, step / functions.scale, side, slice(3))
        # [direction, value], by the directions themselves.
        change = jnp.stack(slopes) / functions.scale[:, None, :, None, None]
        (_, ax, ay), (_, bx, by) = change
        turn = turns[None] * change[:, 0] * step[..., None, None]
        axes = middle, step
        inside, off = cover(lens, beam, values[1:3], values[3:], beam.on_sphere()[0], axes)
        return PupilCells(jnp.abs(ax * by - ay * bx), inside, turns * values[0], turn, off)

    return pupil


def shared_part(first: PupilCells, second: PupilCells) -> Array:
    """The part of cells that the light of both fills, (W, N, N): the lesser part where their edges
    are parallel, the product where they cross at right angles, and in between by the cosine."""
    one, other = first.inside, second.inside
    sizes = (safe_sqrt(jnp.sum(p.middle**2, axis=0)) for p in (first, second))
    cosine = safe_divide(jnp.sum(first.middle * second.middle, axis=0), jnp.multiply(*sizes))
    along = jnp.where(cosine > 0, jnp.minimum(one, other), jnp.maximum(one + other - 1, 0))
    return one * other + jnp.abs(cosine) * (along - one * other)


def amplitudes(lens: Lens, beam: Beam, wavelengths: Array, cells: int) -> tuple[Array, Array]:
    """Amplitudes (W, cells, cells) [y, x] on a regular grid of direction cosines, whose squares are
    the light a unit of their area, and the step of the grid, (2, W)."""
    middle, step = _grid(beam, cells)
    light, inside, phase, *_ = pupil_function(lens, beam, wavelengths, cells)(middle, step)
    size = safe_sqrt(light / jnp.pi) * inside
    waves = jax.lax.complex(size * jnp.cos(phase), size * jnp.sin(phase))
    return _masked(waves, beam, wavelengths, middle, step), step


def _masked(waves: Array, beam: Beam, wavelengths: Array, middle: Array, step: Array) -> Array:
    """Waves (W, N, N) on a grid of directions behind the beam's mask: each cell gets the mean of
    the pixels that it covers."""
    if beam.mask is None:
        return waves
    functions, cells = beam.over_directions(), waves.shape[-1]
    start, unit = (middle - functions.centre) / functions.scale, step / functions.scale
    side = np.arange(cells) - (cells - 1) / 2
    values, *slopes = functions.on_grid(start, unit, side, slice(1, 3))
    half = sum(abs(s) * u[None, :, None, None] for s, u in zip(slopes, unit)) / 2
    return waves * beam.mask.waves(wavelengths, values[1:3], half)


def autocorrelation(amplitude: Array) -> Array:
    """Sums over the cells of products with those some cells away, at a lag (v, u) of
    c[y + v, x + u] conj(c[y, x]): (W, 2 N, N), v in the order of `numpy.fft.fftfreq`, u from 0 to
    N - 1. At (-v, -u) the sum is the conjugate."""
    cells = amplitude.shape[-1]
    pad = functools.partial(jnp.pad, pad_width=((0, 0), (0, cells), (0, cells)))
    spectrum = jnp.fft.fft2(pad(amplitude))
    power = spectrum.real**2 + spectrum.imag**2
    return jnp.conj(jnp.fft.rfft2(power))[..., :cells] / (2 * cells) ** 2
