"""Encircled energy: the fraction of the light within a circle about its centroid.

Waves: the pattern is the Fourier integral of the transfer function T(f), and the integral of a wave
exp(2 pi i f.x) over a circle of radius R is R J1(2 pi R |f|) / |f|. So the energy is the integral
of T(f) R J1(2 pi R |f|) / |f| over all frequencies. On the grid of the autocorrelation of the pupil
function this is exact, except for periodic copies of the pattern.

Rays: each ray is a spot with the width of its cell of the stop on the sensor, as in the kernel of
rays. So it passes the circle gradually, as a function of the square of the radius. This makes the
fraction a smooth function of all numbers, 0 at R = 0 and 1 beyond the last ray.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..numerics import Numbers, einsum, safe_divide, safe_sqrt
from ..pupil.rules import PupilRule
from .beam import Beam
from .beam_psf import Sampling, ray_spots, spot_below
from .refined import beams_of, to_tolerance
from .transfer import Model, centre_of, places_of, planned
from .wave_psf import amplitudes, autocorrelation, period

_UM = 1e3  # per mm
# Smallest number of cells to begin with, because the treatment of edge cells does not help the
# energy.
_LEAST = 96
# Polynomials 9.4.4 and 9.4.6 of Abramowitz and Stegun, in (z / 3)^2 and in 3 / z: accurate to 1e-7.
_NEAR = (0.5, -0.56249985, 0.21093573, -0.03954289, 0.00443319, -0.00031761, 0.00001109)
_SIZE = (0.79788456, 0.00000156, 0.01659667, 0.00017105, -0.00249511, 0.00113653, -0.00020033)
_PHASE = (-2.35619449, 0.12499612, 0.0000565, -0.00637879, 0.00074348, 0.00079824, -0.00029166)


def encircled_energy(
    lens: Lens,
    scene: Scene,
    radii: Numbers,
    kind: Model | None = None,
    focus: Numbers = 0.0,
    sampling: float | PupilRule | Sampling | None = None,
) -> Array:
    """Fraction of the light on the sensor within circles about the centroid of all wavelengths.

    lens, scene, kind, focus: as in `transfer`.
    radii: (N,), mm.
    sampling: as in `transfer`; a tolerance is the absolute error of the fraction. There are enough
        cells to keep periodic copies of waves out of the largest circle, too.

    Returns (..., N), or (..., Z, N) with Z values of `focus`; 0 where no light arrives. A spot too
    large for the grid of waves, 64 Airy radii for 128 cells, is computed by rays. Errors as of
    `transfer`.
    """
    scene, plan = checked_scene(lens, scene), planned(lens, scene, kind, sampling)
    values, steps = places_of(lens, "radii", radii, focus)
    beams, run = beams_of(lens, scene, plan.rule), functools.partial(_encircled, model=plan.kind)
    known = lens, beams, (scene.wavelengths, values, scene.spectrum), steps
    fewest = lambda *known: max(_LEAST, _cells(*known) if plan.kind == "waves" else 0)  # noqa: E731
    return to_tolerance(run, known, plan.cells, plan.tolerance, fewest)


@functools.partial(jit, wanted=LARGE, static_argnames=("model", "cells"))
def _encircled(
    lens: Lens, beams: Beam, asked: tuple[Array, Array, Array], focus: Array, model: Model,
    cells: int
) -> Array:  # fmt: skip
    """`encircled_energy` of beams (...), for a number of cells.

    asked: wavelengths (W,), radii (N,) and spectrum (W,).
    """
    return beams.map(lambda beam: encircled(lens, beam, *asked, model, cells), focus)


def encircled(
    lens: Lens,
    beam: Beam,
    wavelengths: Array,
    radii: Array,
    spectrum: Array,
    model: Model,
    cells: int,
) -> Array:
    """Fractions (N,) of one beam; arguments as in `encircled_energy`. spectrum: (W,), weights of
    the wavelengths."""
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
    """Fractions (W, N) of geometric spots.

    A spot at the distance r with the half width w along the radius extends from r^2 - reach to
    r^2 + reach in the square of the radius, reach = 2 r w + w^2. With B the integral of the
    biweight profile, the fraction within R is B((R^2 - r^2) / reach). Where the profile extends
    below 0, it is reflected there, so that each ray keeps the weight 1: the fraction is
    B((R^2 - r^2) / reach) + B((R^2 + r^2) / reach) - 1.
    """
    hits, width, weights = ray_spots(lens, beam, cells)
    x, y = hits - centre[:, None, None]
    square = x * x + y * y
    across = safe_divide((width[0] * x) ** 2 + (width[1] * y) ** 2, square)
    across = jnp.where(square > 0, across, width[0] * width[1])
    # Half width of the spot in the square of the radius; `across` is w^2.
    reach = 2 * safe_sqrt(square * across) + across

    def below_edge(inside: Array) -> Array:
        return jnp.where(
            reach > 0, spot_below(safe_divide(inside, reach)), (inside >= 0).astype(inside.dtype)
        )

    def at(radius: Array) -> Array:
        # The reflection of the part below 0, see above.
        fraction = below_edge(radius**2 - square) + below_edge(radius**2 + square) - 1
        return jnp.sum(fraction * weights, axis=-1)

    return safe_divide(jax.lax.map(at, radii).T, beam.throughput[:, None])


def _of_waves(
    lens: Lens, beam: Beam, wavelengths: Array, radii: Array, centre: Array, cells: int
) -> Array:
    """Fractions (W, N) of diffraction patterns: the sum over the frequencies of the grid, see
    the module docstring."""
    amplitude, step = amplitudes(lens, beam, wavelengths, cells)
    # Half of all frequencies; those of negative fx have conjugate values and count by a factor of
    # 2.
    transfer = autocorrelation(amplitude)
    unit = step * (beam.index * _UM / wavelengths)[None]
    lags = np.fft.fftfreq(2 * cells, 1 / (2 * cells))
    fx = (unit[0][:, None] * jnp.asarray(lags[:cells], unit.dtype)[None])[:, None]
    fy = (unit[1][:, None] * jnp.asarray(lags, unit.dtype)[None])[..., None]
    turn = 2 * jnp.pi * (fx * centre[0] + fy * centre[1])
    real = transfer.real * jnp.cos(turn) - transfer.imag * jnp.sin(turn)
    real = real * jnp.asarray(np.where(lags[:cells] > 0, 2, 1), unit.dtype)[None, None]
    # Normalise by the throughput, and not by T(0): in edge cells the squares of the mean amplitudes
    # miss part of the light.
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
        """A polynomial in t by Horner's scheme."""
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
def _cells(lens: Lens, beams: Beam, asked: tuple[Array, Array, Array], focus: Array) -> Array:
    """Number of cells, (), for which all spots and circles fit into one period of the pattern."""
    return jnp.max(beams.map(lambda beam: cells_needed(beam, *asked[:2]), focus))


def cells_needed(beam: Beam, wavelengths: Array, radii: Array) -> Array:
    """Number of cells (W,) for which the spot and the largest circle fit into one period of the
    pattern."""
    places = jnp.where(beam.known & (beam.throughput > 0)[:, None], beam.hits[:, -1], jnp.nan)
    reach = jnp.nan_to_num(jnp.nanmax(places, -1) - jnp.nanmin(places, -1))
    return jnp.max((reach + jnp.max(radii)) / period(beam, wavelengths, 1), axis=0)
