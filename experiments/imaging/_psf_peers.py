"""FFT and matrix Fourier PSFs of other programs, collected on our pixels; each may be missing.

A peer gives samples of the irradiance. A pixel takes what a cubic spline through their running sum
gains across it.
"""

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
from scipy.interpolate import RectBivariateSpline

import drt_jax
from drt_jax.image.beam import BeamRule, centroid_and_variances, trace_beam
from drt_jax.image.transfer import pupil_function
from drt_jax.lens.scene import scene_of

from . import _peers

_UM = 1e3  # per mm


def collected(samples: np.ndarray, step: float, pixel: float, size: int) -> np.ndarray:
    """What `size` x `size` pixels about the middle sample, [n // 2, n // 2], collect of samples
    (n, n) that lie `step` mm apart: of all their light."""
    n = samples.shape[0]
    total = np.pad(np.cumsum(np.cumsum(samples, 0), 1), ((1, 0), (1, 0)))
    edges = (np.arange(n + 1) - n // 2 - 0.5) * step
    below = RectBivariateSpline(edges, edges, total / total[-1, -1])
    wanted = (np.arange(size + 1) - size / 2) * pixel
    return np.diff(np.diff(below(wanted, wanted), axis=0), axis=1)


def pupil(
    lens: drt_jax.Lens, field: float, wavelength: np.ndarray, rule: BeamRule, count: int
) -> tuple[np.ndarray, float, np.ndarray]:
    """What prysm is given of one wavelength (1,), an object at infinity: the pupil function on a
    square grid of direction cosines, its step, and the place (2,) mm about which it lies."""
    scene = scene_of(lens, field, np.inf, wavelength)
    beam = trace_beam(lens, scene, rule)
    low, high = (np.asarray(a)[:, 0] for a in beam.directions_extent())
    middle, step = (low + high) / 2, float(np.max(high - low)) / count
    grid = jnp.asarray(middle[:, None]), jnp.full((2, 1), step)
    made = pupil_function(lens, beam, scene.wavelengths, count)(*grid)
    density, inside, phase = (np.asarray(a)[0] for a in made)
    centre = np.asarray(centroid_and_variances(beam.hits[:, -1], beam.weights)[0])[:, 0]
    side = (np.arange(count) - (count - 1) / 2) * step
    x, y = np.meshgrid(side, side)
    phase = phase + 2 * np.pi * _UM / wavelength[0] * (x * centre[0] + y * centre[1])
    # Its exponent has the other sign.
    return np.sqrt(density) * inside * np.exp(-1j * phase), step, centre


def optiland(numbers: _peers.Lens, pixel: float, size: int, rays: int, grid: int) -> Callable:
    """call() -> (size, size): Optiland's FFT PSF of `rays` x `rays` rays in a grid of `grid`, about
    the chief ray, of the first wavelength."""
    from optiland import backend
    from optiland.psf import FFTPSF

    backend.set_backend("numpy")
    optic = _peers._optiland_system(numbers, numbers.index[:, 0], numbers.wavelengths[0])
    field = 0, 1 if numbers.field else 0

    def call() -> np.ndarray:
        found = FFTPSF(optic, field, numbers.wavelengths[0], num_rays=rays, grid_size=grid)
        step = found._get_psf_units(found.psf)[0] / grid / _UM
        return collected(np.asarray(found.psf), step, pixel, size)

    return call


def prysm(
    pupil: np.ndarray, step: float, wavelength: float, pixel: float, size: int, fine: int = 9
) -> Callable:
    """call() -> (size, size): prysm's matrix Fourier transform of a pupil function (N, N) on a grid
    of direction cosines `step` apart, `fine` x `fine` samples a pixel."""
    from prysm.propagation import Wavefront

    # At a focal length of 1 mm a direction cosine is a place in mm.
    sample, across = pixel / fine, len(pupil)

    def amplitude(function: np.ndarray, samples: int) -> np.ndarray:
        wave = Wavefront(function, wavelength, step)
        return np.asarray(wave.focus_fixed_sampling(1.0, _UM * sample, samples).data)

    # What it makes of the sum over a pupil, which is known at the middle, and the light of all.
    unit = abs(amplitude(np.ones((across, across), complex), 1).item()) / across**2
    scale = (step * sample * _UM / (wavelength * unit)) ** 2 / np.sum(np.abs(pupil) ** 2)

    def call() -> np.ndarray:
        light = np.abs(amplitude(pupil, fine * size)) ** 2
        return light.reshape(size, fine, size, fine).sum(axis=(1, 3)) * scale

    return call
