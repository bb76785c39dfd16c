"""Operands of diffraction: transfer functions, Strehl ratios, encircled energy, kernels, and the
error of the best linear filter behind them.

They are computed from the rays that a problem has traced, by the polynomials of `image.beam`, and
trace no other rays. With the rule `Gauss`, all light that fills the stop counts, clipped or not.
With `Soft` and `Clipped`, only the light that passes the apertures counts.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ..image.beam import Beam, BeamRule, beam_of
from ..image.beam_psf import Kind, Psf, psf_of_beam
from ..image.encircled import encircled
from ..image.kernel import check_pixels
from ..image.sensor import noise_of
from ..image.transfer import strehl_of, transfer_of
from ..image.wiener import wiener
from ..inputs import require, shown
from ..lens.lens import Lens
from ..lens.scene import Scene, over_points
from ..numerics import Numbers, safe_sqrt
from ..pupil.clipped import Clipped
from ..pupil.rules import Gauss, PupilRule, Soft
from ..rays.system import Vector
from ..rays.trace import Bundle
from .field_rays import EXTRAS, FieldRays

# Cells of the pupil along a side: for transfer functions and Strehl ratios, for encircled energy.
_CELLS, _ENERGY = 64, 128


def degree_of(rule: PupilRule) -> int:
    """Degree of the polynomials of the pupil that the rays of a rule determine, see `beam_rule`.

    It is 0 for a rule of too low an order or of another kind. The rules of problems are not padded.
    """
    if isinstance(rule, Gauss | Soft):
        return 2 * (rule.order - 1)
    return 2 * max(rule.size - 2, 0) if isinstance(rule, Clipped) else 0


def _of_beams(lens: Lens, rays: FieldRays, function: Callable[[Beam], Any]) -> Any:
    """Evaluates a function of the beam of each view: arrays (V, ...)."""
    full, degree = isinstance(rays.rule, Gauss), degree_of(rays.rule)
    light = rays.stop_weights if full else rays.weights * rays.throughput[..., None]
    light = jnp.where(rays.arrives, light, 0)
    # The azimuths of `gauss_points` determine no more azimuthal terms.
    azimuths = rays.rule.order if isinstance(rays.rule, Gauss | Soft) else degree
    rule = BeamRule(rays.rule, degree, azimuths=azimuths)

    def one(scene: Scene, points: Vector, light: Array, bundle: Bundle) -> Any:
        return function(beam_of(lens, scene, rule, points, light, bundle))

    of_rays = jax.tree.map(lambda a: a[..., EXTRAS:], (rays.points, light, rays.bundle))
    return over_points(one, rays.scene, *of_rays)


def _asked(rays: FieldRays, at: Numbers) -> tuple[Array, Array, Array]:
    """Wavelengths (W,), um, `Operand.at` (1,), and weights of the wavelengths (W,)."""
    waves = rays.scene.wavelengths
    return waves, jnp.reshape(jnp.asarray(at, waves.dtype), 1), rays.scene.spectrum


def mtf(lens: Lens, rays: FieldRays, at: Numbers) -> Array:
    """Modulus (V, 2) of the transfer function of all wavelengths, tangential and sagittal.

    at: frequency on the sensor, cycles/mm.
    """
    arguments = _asked(rays, at)
    transfer = lambda beam: transfer_of(lens, beam, *arguments, "waves", _CELLS)[0]  # noqa: E731
    otf = _of_beams(lens, rays, transfer)[..., 0]
    return safe_sqrt(otf.real**2 + otf.imag**2)


def strehl(lens: Lens, rays: FieldRays) -> Array:
    """Strehl ratio (V, W), see `image.transfer.strehl`."""
    return _of_beams(lens, rays, lambda beam: strehl_of(lens, beam, rays.scene.wavelengths, _CELLS))


def encircled_energy(lens: Lens, rays: FieldRays, at: Numbers) -> Array:
    """Fraction (V,) of the light within a circle about the centroid of all wavelengths.

    at: radius of the circle, mm.
    """
    arguments = _asked(rays, at)
    energy = lambda beam: encircled(lens, beam, *arguments, "waves", _ENERGY)  # noqa: E731
    return _of_beams(lens, rays, energy)[:, 0]


def psf(
    lens: Lens,
    rays: FieldRays,
    pixel: Numbers,
    size: int = 21,
    kind: Kind = "waves",
    cells: int = _ENERGY,
) -> Psf:
    """Kernels of all views and their light, for operands of your own; see `drt_jax.psf`.

    lens: the lens.
    rays: its rays, as `trace_fields` returns them or as an operand gets them.
    pixel: pixel pitch, mm.
    size: side of the kernels, pixels.
    kind: of the kernels, see `drt_jax.psf`.
    cells: number of cells of the pupil grid along a side; more for spots of many pixels, see
        `converge`.

    Returns a `Psf` with kernels (V, W, size, size). ValueError for a rule whose rays do not
    determine polynomials.
    """
    what = f"rule: needs Gauss, Soft or Clipped of a higher order; got {shown(rays.rule)}"
    require(degree_of(rays.rule) >= 2, what)
    waves = rays.scene.wavelengths
    options = waves, check_pixels(pixel, size, waves.dtype), kind, cells
    return _of_beams(lens, rays, lambda beam: psf_of_beam(lens, beam, *options))


def filter_error(
    kernels: Callable[[Lens, FieldRays], Psf], light: Numbers, noise: Numbers, power: Numbers
) -> Callable[[Lens, FieldRays], Array]:
    """A function for `Operand`: the error of the best linear filter behind the lens, common to all
    fields, distances and wavelengths of a problem, see `image.wiener`.

    Its merit is the mean square error of the filtered images, summed over the channels, one for
    each wavelength; rays that fail add to it as with every operand. It needs neither images nor
    training. Start from a lens that is optimised for spots.

    kernels: function that returns the kernels of the object points, by `psf`:
        `lambda lens, rays: psf(lens, rays, pixel)`.
    light: (W,) or (), solid angle of the light for which the noise is given, see `drt_jax.psf`. The
        noise of points with less light is amplified.
    noise: see `learn.noise_of`.
    power: (N, N // 2 + 1, W, W), spectrum of the scenes, see `learn.power_of`; N at least as large
        as the kernels.
    """

    def residuals(lens: Lens, rays: FieldRays) -> Array:
        seen = kernels(lens, rays)
        full = jnp.broadcast_to(jnp.asarray(light), seen.solid_angle.shape)
        grain = noise_of(noise, seen.solid_angle / full)
        return safe_sqrt(wiener(seen.kernel, grain, power, 1).error).ravel()

    return residuals
