"""PSF kernel of wave optics: plane waves of all directions of a beam, superposed on the pixels.

The field at a point x of the sensor is U(x) = sum over directions d of c(d) exp(i k n d.x), with
k = 2 pi / wavelength, the directions from the sphere of the exit pupil (`Beam.on_sphere`), and
|c|^2 the light times the area of the cell of direction cosines. On a regular grid of directions
with the step s,

    |U(x)|^2 = sum over lags l of T(l) exp(i k n s l.x),

where T, the autocorrelation of c, is the optical transfer function; two Fourier transforms give it.
The integral of each of these waves over a pixel is a sinc. So the kernel is a product of three
matrices, exact for the grid. Sources: Goodman, Introduction to Fourier Optics (2005), ch. 6;
Soummer et al., Opt. Express 15, 15935 (2007) for the product.
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
from .kernel import Pixels

_UM = 1e3  # per mm


def wave_kernel(lens: Lens, beam: Beam, wavelengths: Array, pixels: Pixels, cells: int) -> Array:
    """Diffraction PSF kernel of a beam on the pixels.

    lens, beam: the lens and its beam.
    wavelengths: (W,), um.
    pixels: with their centre.
    cells: number of cells along a side of the grid of directions. The pattern on the sensor repeats
        after one `period`.

    Returns (W, size, size) [y, x]. The sum is the part of the throughput that falls on the kernel.
    A cell at an edge has the mean of its amplitude. Because of this, the kernel lacks a fraction
    (pi x / period)^2 / 3 of the light that edges diffract to the distance x: with 128 cells 1.5e-3
    of the light of an Airy pattern within half a period.
    """
    pixel, size = pixels.side, pixels.size
    amplitude, step = amplitudes(lens, beam, wavelengths, cells)
    transfer = autocorrelation(amplitude)
    lags = np.fft.fftfreq(2 * cells, 1 / (2 * cells))
    # Frequencies of the lags, cycles/mm, (2, W, 2 N).
    unit = step * (beam.index * _UM / wavelengths)[None]
    frequency = unit[..., None] * jnp.asarray(lags, unit.dtype)[None, None]
    place = (jnp.arange(size, dtype=pixel.dtype) - (size - 1) / 2) * pixel
    waves = []
    for f, c in zip((frequency[0, :, :cells], frequency[1]), pixels.centre):
        f, x = f[:, None], (place + c)[None, :, None]
        phase = 2 * jnp.pi * f * x
        wave = jax.lax.complex(jnp.cos(phase), jnp.sin(phase))
        waves.append(wave * jnp.sinc(f * pixel).astype(wave.dtype))
    across, down = waves
    # The lags of negative u, which `transfer` leaves out, have conjugate values: count the others
    # twice.
    across = across * jnp.asarray(np.where(lags[:cells] > 0, 2, 1), across.dtype)[None, None]
    kernel = einsum("wyv,wvu,wxu->wyx", down, transfer, across).real
    cell = step[0] * step[1] * beam.index * _UM / wavelengths
    return kernel * (cell * pixel)[:, None, None] ** 2


def period(beam: Beam, wavelengths: Array, cells: int) -> Array:
    """Distance along x and y, (2, W), mm, after which the pattern of a grid of `cells` x `cells`
    directions repeats: wavelength / (n step)."""
    step = _grid(beam, cells)[1]
    return (wavelengths / (_UM * beam.index))[None] / step


def _grid(beam: Beam, cells: int) -> tuple[Array, Array]:
    """Centre and step of the grid of direction cosines, (2, W) each."""
    low, high = beam.directions_extent()
    return (low + high) / 2, (high - low) / cells


class PupilCells(NamedTuple):
    """The pupil function on a grid of directions, (W, N, N) cells.

    light: pi times the light per unit area of direction cosines.
    inside: fraction of the cell that light fills.
    phase: at the middle of the cell, radians.
    turn: (2, W, N, N), change of the phase over a cell along x and y, radians.
    middle: (2, W, N, N), centroid of the light in the cell, see `cover`.
    """

    light: Array
    inside: Array
    phase: Array
    turn: Array
    middle: Array


def pupil_function(
    lens: Lens, beam: Beam, wavelengths: Array, cells: int
) -> Callable[[Array, Array], PupilCells]:
    """The pupil function of a beam, as a function of the centre and the step of a grid of
    directions, (2, W) each.

    The light per unit area of direction cosines is that of the stop times the Jacobian |d(stop
    point) / d(direction)|.
    """
    functions, side = beam.over_directions(), np.arange(cells) - (cells - 1) / 2
    turns = (2 * jnp.pi * _UM / wavelengths)[:, None, None]

    def pupil(middle: Array, step: Array) -> PupilCells:
        start = (middle - functions.centre) / functions.scale
        values, *slopes = functions.on_grid(start, step / functions.scale, side, slice(3))
        # Derivatives by the direction cosines, [direction, value].
        change = jnp.stack(slopes) / functions.scale[:, None, :, None, None]
        (_, ax, ay), (_, bx, by) = change
        turn = turns[None] * change[:, 0] * step[..., None, None]
        axes = middle, step
        inside, off = cover(lens, beam, values[1:3], values[3:], beam.on_sphere()[0], axes)
        return PupilCells(jnp.abs(ax * by - ay * bx), inside, turns * values[0], turn, off)

    return pupil


def shared_part(first: PupilCells, second: PupilCells) -> Array:
    """Fraction (W, N, N) of each cell that the light of two pupils fills, if they fill the
    fractions a and b.

    With c, the cosine of the angle between the directions of the two centroids: where their edges
    are parallel (c = 1) it is min(a, b), where they face each other (c = -1) it is max(a + b - 1,
    0), and where they cross at right angles (c = 0) it is a b. In between, it is interpolated
    linearly in |c|.
    """
    one, other = first.inside, second.inside
    sizes = (safe_sqrt(jnp.sum(p.middle**2, axis=0)) for p in (first, second))
    cosine = safe_divide(jnp.sum(first.middle * second.middle, axis=0), jnp.multiply(*sizes))
    along = jnp.where(cosine > 0, jnp.minimum(one, other), jnp.maximum(one + other - 1, 0))
    return one * other + jnp.abs(cosine) * (along - one * other)


def amplitudes(lens: Lens, beam: Beam, wavelengths: Array, cells: int) -> tuple[Array, Array]:
    """Complex amplitudes c on a regular grid of direction cosines.

    Returns (W, cells, cells) [y, x], whose squared moduli are the light per unit area of direction
    cosines, and the step of the grid, (2, W).
    """
    middle, step = _grid(beam, cells)
    light, inside, phase, *_ = pupil_function(lens, beam, wavelengths, cells)(middle, step)
    size = safe_sqrt(light / jnp.pi) * inside
    waves = jax.lax.complex(size * jnp.cos(phase), size * jnp.sin(phase))
    return _masked(waves, beam, wavelengths, middle, step), step


def _masked(waves: Array, beam: Beam, wavelengths: Array, middle: Array, step: Array) -> Array:
    """Waves (W, N, N) on a grid of directions, times the beam's mask: each cell takes the mean
    of the mask over the stop area that it maps to."""
    if beam.mask is None:
        return waves
    functions, cells = beam.over_directions(), waves.shape[-1]
    start, unit = (middle - functions.centre) / functions.scale, step / functions.scale
    side = np.arange(cells) - (cells - 1) / 2
    values, *slopes = functions.on_grid(start, unit, side, slice(1, 3))
    half = sum(abs(s) * u[None, :, None, None] for s, u in zip(slopes, unit)) / 2
    return waves * beam.mask.waves(wavelengths, values[1:3], half)


def autocorrelation(amplitude: Array) -> Array:
    """Autocorrelation T(v, u) = sum over y, x of c[y + v, x + u] conj(c[y, x]), without wrapping.

    amplitude: (W, N, N), c.

    Returns (W, 2 N, N), with v in the order of `numpy.fft.fftfreq` and u from 0 to N - 1. T(-v, -u)
    is the conjugate of T(v, u). By the Wiener-Khinchin theorem T is the inverse transform of
    |FFT(c)|^2 with c padded to 2 N.
    """
    cells = amplitude.shape[-1]
    pad = functools.partial(jnp.pad, pad_width=((0, 0), (0, cells), (0, cells)))
    spectrum = jnp.fft.fft2(pad(amplitude))
    power = spectrum.real**2 + spectrum.imag**2
    return jnp.conj(jnp.fft.rfft2(power))[..., :cells] / (2 * cells) ** 2
