"""Accuracy of the Gaussian model: its kernels compared with those of diffraction."""

from typing import NamedTuple

import numpy as np

from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..numerics import Numbers, known_values
from .beam_psf import Sampling
from .psf import psf
from .psf_model import chosen_psf, difference

_LINES = 64  # at least so many frequencies up to Nyquist


class GaussianError(NamedTuple):
    """Differences of Gaussian kernels from those of waves for object points (...), each for the
    worst wavelength.

    misplaced: (...), sum of the absolute differences of all pixels: 0 to 2.
    contrast: (...), largest difference of the MTF of both kernels up to the pixels' Nyquist
        frequency.
    outside: (...), fraction of the light that falls outside of the kernel of waves.
    """

    misplaced: np.ndarray
    contrast: np.ndarray
    outside: np.ndarray


def gaussian_error(
    lens: Lens, scene: Scene, pixel: Numbers, size: int = 21, tolerance: float = 1e-2
) -> GaussianError:
    """Differences between the Gaussian kernels of the moments and the kernels with diffraction.

    lens, scene: the lens, and object points with their wavelengths.
    pixel: side of a pixel, mm.
    size: number of pixels along a side of a kernel.
    tolerance: of the kernels of waves, as in `psf`.

    All numbers must be known. ValueError inside a trace, and as of `psf`.
    """
    known = known_values((lens, scene, pixel))
    if known is None:
        raise ValueError("gaussian_error compares known numbers: call it outside of jax.jit")
    lens, scene, pixel = known
    fine = chosen_psf(lens, scene, pixel, size, "waves", tolerance)[0]
    models = Sampling("gaussian", fine.rule, 0), fine
    found = []
    for point in checked_scene(lens, scene).each():
        blur, light = (psf(lens, point, pixel, size, sampling=model) for model in models)
        a, b = np.asarray(blur.kernel), np.asarray(light.kernel)
        found.append((difference(a, b), _contrast(a, b), np.max(np.asarray(light.outside))))
    return GaussianError(*np.array(found).T.reshape(3, *scene.shape))


def _contrast(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference of the MTFs of two sets of kernels (W, size, size)."""
    count = max(2 * _LINES, 2 * a.shape[-1])
    spectra = [np.abs(np.fft.rfft2(k, (count, count))) for k in (a, b)]
    first, second = (s / np.maximum(s[:, :1, :1], 1e-300) for s in spectra)
    return float(np.max(np.abs(first - second)))
