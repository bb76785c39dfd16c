"""Encircled energy: the part of the light within a circle about its centroid.

Waves: the integral of the pattern over a circle of radius R is that of the transfer function times
R J1(2 pi R f) / f over all frequencies f; on the grid of the autocorrelation of the pupil function
it is exact but for light that the grid repeats. Rays: each has the width of its cell of the stop on
the sensor, as in the kernel of rays, and so passes the circle gradually, measured in the square of
the radius; so the part is smooth in all numbers, 0 at R = 0 and 1 beyond the last ray.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..numerics import Numbers, einsum, safe_divide, safe_sqrt
from ..pupil.rules import PupilRule
from .beam import Beam
from .ray_psf import ray_spots, spot_below
from .refined import TOLERANCE, beams_of, to_tolerance
from .transfer import Model, arrays_of, centre_of, through_focus
from .wave_psf import amplitudes, autocorrelation, period

_UM = 1e3  # per mm
# Degree of the polynomials; cells to begin with, as energy has no better use of cells at edges.
_DEGREE, _LEAST = 14, 96
# Polynomials 9.4.4 and 9.4.6 of Abramowitz and Stegun, in (z / 3)^2 and in 3 / z: right to 1e-7.
_NEAR = (0.5, -0.56249985, 0.21093573, -0.03954289, 0.00443319, -0.00031761, 0.00001109)
_SIZE = (0.79788456, 0.00000156, 0.01659667, 0.00017105, -0.00249511, 0.00113653, -0.00020033)
_PHASE = (-2.35619449, 0.12499612, 0.0000565, -0.00637879, 0.00074348, 0.00079824, -0.00029166)


def encircled_energy(
    lens: Lens,
    fields: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    radii: Numbers,
    model: Model = "waves",
    focus: Numbers = 0.0,
    wavelength_weights: Numbers | None = None,
    rule: PupilRule | None = None,
    degree: int = _DEGREE,
    cells: int | None = None,
    tolerance: float = TOLERANCE,
) -> Array:
    """The part (F, N) of the light on the sensor within circles about the centroid of all
    wavelengths; (F, Z, N) with Z values of `focus`. 0 where no light arrives.

    radii: (N,) mm. cells: of the grid of the pupil along a side; None: as many as keep the error
    of the part below `tolerance`, and what a grid of waves repeats out of the largest circle;
    inside `jit` and `vmap` 128. A spot too large for the grid, 64 Airy radii for 128 cells, is
    counted by rays. Other arguments, and errors, as of `transfer`.
    """
    scene = fields, distance, wavelengths
    given = arrays_of(lens, scene, model, focus, wavelength_weights, rule, "radii", radii)
    angles, axis, values, spectrum, steps, rule = given
    beams = beams_of(lens, angles, axis, rule, degree)
    of = functools.partial(_encircled, model=model)
    known = lens, beams, axis.wavelengths, values, spectrum, steps
    fewest = lambda *known: max(_LEAST, _cells(*known) if model == "waves" else 0)  # noqa: E731
    return to_tolerance(of, known, cells, tolerance, fewest)


@functools.partial(jit, wanted=LARGE, static_argnames=("model", "cells"))
def _encircled(
    lens: Lens,
    beams: Beam,
    wavelengths: Array,
    radii: Array,
    spectrum: Array,
    focus: Array,
    model: Model,
    cells: int,
) -> Array:
    given = wavelengths, radii, spectrum, model, cells
    of = lambda beam: encircled(lens, beam, *given)  # noqa: E731
    return jax.vmap(lambda beam: through_focus(beam, focus, of))(beams)


def encircled(
    lens: Lens,
    beam: Beam,
    wavelengths: Array,
    radii: Array,
    spectrum: Array,
    model: Model,
    cells: int,
) -> Array:
    """The parts (N,) of one beam, see `encircled_energy`."""
    share, centre = centre_of(beam, spectrum)
    parts = _of_rays(lens, beam, wavelengths, radii, centre, cells)
    if model == "waves":
        wide = cells_needed(beam, wavelengths, radii) > cells
        waves = _of_waves(lens, beam, wavelengths, radii, centre, cells)
        parts = jnp.where(wide[:, None], parts, waves)
    return einsum("w,wn->n", share, parts)


def _of_rays(
    lens: Lens, beam: Beam, wavelengths: Array, radii: Array, centre: Array, cells: int
) -> Array:
    """(W, N)."""
    hits, width, weights = ray_spots(lens, beam, cells)
    x, y = hits - centre[:, None, None]
    square = x * x + y * y
    along = safe_divide((width[0] * x) ** 2 + (width[1] * y) ** 2, square)
    along = jnp.where(square > 0, along, width[0] * width[1])
    # How far the square of the radius goes from the middle of a ray to its edge.
    reach = 2 * safe_sqrt(square * along) + along

    def part(inside: Array) -> Array:
        return jnp.where(
            reach > 0, spot_below(safe_divide(inside, reach)), (inside >= 0).astype(inside.dtype)
        )

    def at(radius: Array) -> Array:
        # What a ray would have below a square of 0 is turned back.
        found = part(radius**2 - square) + part(radius**2 + square) - 1
        return jnp.sum(found * weights, axis=-1)

    return safe_divide(jax.lax.map(at, radii).T, beam.throughput[:, None])


def _of_waves(
    lens: Lens, beam: Beam, wavelengths: Array, radii: Array, centre: Array, cells: int
) -> Array:
    """(W, N)."""
    amplitude, step = amplitudes(lens, beam, wavelengths, cells)
    # One half of all frequencies; the other has the conjugate values.
    transfer = autocorrelation(amplitude)
    unit = step * (beam.index * _UM / wavelengths)[None]
    lags = np.fft.fftfreq(2 * cells, 1 / (2 * cells))
    fx = (unit[0][:, None] * jnp.asarray(lags[:cells], unit.dtype)[None])[:, None]
    fy = (unit[1][:, None] * jnp.asarray(lags, unit.dtype)[None])[..., None]
    turn = 2 * jnp.pi * (fx * centre[0] + fy * centre[1])
    real = transfer.real * jnp.cos(turn) - transfer.imag * jnp.sin(turn)
    real = real * jnp.asarray(np.where(lags[:cells] > 0, 2, 1), unit.dtype)[None, None]
    # By the light itself: squares of amplitudes lack a part of it in the cells at edges.
    area = unit[0] * unit[1] * step[0] * step[1]
    real = real * safe_divide(area, beam.throughput)[:, None, None]
    frequency = safe_sqrt(fx**2 + fy**2)

    def at(radius: Array) -> Array:
        circle = 2 * jnp.pi * radius**2 * _bessel(2 * jnp.pi * radius * frequency)
        return jnp.sum(real * circle, axis=(1, 2))

    return jax.lax.map(at, radii).T


def _bessel(z: Array) -> Array:
    """J1(z) / z for z >= 0."""

    def sum_of(terms: tuple[float, ...], t: Array) -> Array:
        total = jnp.full_like(t, terms[-1])
        for term in terms[-2::-1]:
            total = total * t + term
        return total

    far = jnp.maximum(z, 3)
    wave = jnp.cos(far + sum_of(_PHASE, 3 / far)) * sum_of(_SIZE, 3 / far)
    return jnp.where(
        z < 3, sum_of(_NEAR, (jnp.minimum(z, 3) / 3) ** 2), wave / (far * jnp.sqrt(far))
    )


@functools.partial(jit, wanted=LARGE)
def _cells(
    lens: Lens, beams: Beam, wavelengths: Array, radii: Array, spectrum: Array, focus: Array
) -> Array:
    """So many cells, (), that the spots and the circles fit into what the grid repeats."""
    of = lambda beam: jnp.max(cells_needed(beam, wavelengths, radii))  # noqa: E731
    return jnp.max(jax.vmap(lambda beam: through_focus(beam, focus, of))(beams))


def cells_needed(beam: Beam, wavelengths: Array, radii: Array) -> Array:
    """So many cells (W,) that the spot and circles fit into what the grid repeats."""
    places = jnp.where(beam.known & (beam.throughput > 0)[:, None], beam.hits[:, -1], jnp.nan)
    reach = jnp.nan_to_num(jnp.nanmax(places, -1) - jnp.nanmin(places, -1))
    return jnp.max((reach + jnp.max(radii)) / period(beam, wavelengths, 1), axis=0)
