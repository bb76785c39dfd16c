"""PSFs and transfer functions by waves of other programs; each program may be missing.

A peer returns samples of the irradiance. They are integrated over pixels: the light of a pixel is
the difference between its edges of a cubic spline through the cumulative sum of the samples.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline, RectBivariateSpline

import drt_jax
from drt_jax import Lens, Sampling, Scene
from drt_jax.image.beam import BeamRule, centroid_and_variances, trace_beam
from drt_jax.image.wave_psf import pupil_function
from drt_jax.lens.scene import checked_scene

from . import _peers

_UM = 1e3  # per mm


@dataclasses.dataclass(frozen=True)
class Shot:
    """The kernel of an object point at infinity, which all programs compute.

    field: angle along y, radians. waves: (W,), um; other programs use only the first.
    pixel: side of a pixel, mm. size: side of the kernel, pixels.
    """

    lens: Lens
    field: float
    waves: np.ndarray
    pixel: float
    size: int

    @property
    def scene(self) -> Scene:
        """The object point."""
        return Scene.point(self.field, math.inf, self.waves)

    def model(self, kind: Any, tolerance: float = 1e-2) -> Sampling:
        """Our model of a kind converged to the tolerance."""
        given = self.lens, self.scene, self.pixel, self.size
        return drt_jax.converge(drt_jax.psf, *given, kind, tolerance)

    def kernel(self, lens: Lens, model: Sampling, centre: Any = None) -> jax.Array:
        """Our kernel (W, size, size) of a lens."""
        pixels = self.pixel, self.size
        return drt_jax.psf(lens, self.scene, *pixels, sampling=model, centre=centre).kernel

    def numbers(self) -> _peers.Lens:
        """The lens for other programs."""
        given = self.lens, self.field, math.inf, self.waves
        return _peers.Lens(*given, _peers.flatten(self.lens)[None])

    def optiland(self) -> tuple[Any, tuple[int, int], float]:
        """Optiland's lens, field and wavelength."""
        from optiland import backend

        backend.set_backend("numpy")
        numbers = self.numbers()
        optic = _peers._optiland_system(numbers, numbers.index[:, 0], self.waves[0])
        return optic, (0, 1 if self.field else 0), self.waves[0]


def collected(
    samples: np.ndarray, steps: tuple[float, float], pixel: float, size: int
) -> np.ndarray:
    """Fractions (size, size) of the light of samples (n, n) on pixels about the middle sample
    [n // 2, n // 2]. steps: distances of the samples along y and x, mm. pixel: side of a pixel,
    mm."""
    n = samples.shape[0]
    total = np.pad(np.cumsum(np.cumsum(samples, 0), 1), ((1, 0), (1, 0)))
    edges = np.arange(n + 1) - n // 2 - 0.5
    below = RectBivariateSpline(*(edges * step for step in steps), total / total[-1, -1])
    borders = (np.arange(size + 1) - size / 2) * pixel
    return np.diff(np.diff(below(borders, borders), axis=0), axis=1)


def pupil(
    shot: Shot, rule: BeamRule, count: int, centre: np.ndarray | None = None
) -> tuple[np.ndarray, float, np.ndarray]:
    """The input of prysm: the pupil function on a square grid of direction cosines, the step of the
    grid, and the centre (2,) of the image, mm. centre: None for the centroid of the light."""
    scene = checked_scene(shot.lens, dataclasses.replace(shot, waves=shot.waves[:1]).scene)
    beam = trace_beam(shot.lens, scene, rule)
    low, high = (np.asarray(a)[:, 0] for a in beam.directions_extent())
    middle, step = (low + high) / 2, float(np.max(high - low)) / count
    grid = jnp.asarray(middle[:, None]), jnp.full((2, 1), step)
    function = pupil_function(shot.lens, beam, scene.wavelengths, count)
    density, inside, phase = (np.asarray(a)[0] for a in function(*grid)[:3])
    if centre is None:
        centre = np.asarray(centroid_and_variances(beam.hits[:, -1], beam.weights)[0])[:, 0]
    side = (np.arange(count) - (count - 1) / 2) * step
    x, y = np.meshgrid(side, side)
    phase = phase + 2 * np.pi * _UM / shot.waves[0] * (x * centre[0] + y * centre[1])
    # The exponent of prysm has the other sign.
    return np.sqrt(density) * inside * np.exp(-1j * phase), step, centre


def optiland(shot: Shot, samples: int) -> Callable:
    """A function call() -> (size, size): Optiland's FFT PSF about the chief ray. samples: rays
    along a side."""
    from optiland.psf import FFTPSF

    given, grid = shot.optiland(), 4 * samples

    def call() -> np.ndarray:
        found = FFTPSF(*given, num_rays=samples, grid_size=grid)
        step = found._get_psf_units(found.psf)[0] / grid / _UM
        return collected(np.asarray(found.psf), (step, step), shot.pixel, shot.size)

    return call


def optiland_contrast(shot: Shot, samples: int, frequencies: Sequence[float]) -> Callable:
    """A function call() -> (2, N): Optiland's FFT MTF, tangential and sagittal, by a cubic spline
    through its frequencies. (HuygensMTF takes 2 s for 64 rays along a side, 9 s for 128, and has an
    error of 0.1.)

    samples: rays along a side. frequencies: (N,), cycles/mm.
    """
    from optiland.mtf import FFTMTF

    optic, field, wavelength = shot.optiland()

    def call() -> np.ndarray:
        found = FFTMTF(optic, [field], wavelength, num_rays=samples)
        lines = zip((found.freq_tang[0], found.freq_sag[0]), found.mtf[0])
        return np.array([CubicSpline(*line)(frequencies) for line in lines])

    return call


def batoid(shot: Shot, samples: int) -> Callable:
    """A function call() -> (psf, (dy, dx)): batoid's FFT PSF about the chief ray, and the steps of
    its samples, mm. samples: rays along a side."""
    import batoid
    from batoid.analysis import fftPSF

    numbers = shot.numbers()
    variant = numbers.variants[0]
    numbers.clear[numbers.stop] = numbers.semi  # the stop clips the rays of a square grid
    optic = _peers._batoid_optic(numbers, variant, numbers.index[:, 0])
    place, radius = variant.pupil
    at = batoid.CoordSys(origin=[0, 0, place])
    # The rays of batoid fill a little more than the paraxial pupil.
    known = {"pupilSize": 2.1 * radius, "backDist": place + 2 * radius + 10.0}
    known |= {"stopSurface": batoid.Interface(batoid.Plane(), coordSys=at)}
    known |= {"sphereRadius": sum(variant.gaps[numbers.stop :])}
    optic = batoid.CompoundOptic(
        optic.items, name="lens", inMedium=optic.inMedium, outMedium=optic.outMedium, **known
    )
    # The rays of batoid run towards -z, along the same lines as ours for a field of the other sign.
    given = optic, 0.0, -numbers.field, numbers.wavelengths[0] / _UM, "gnomonic", samples

    def call() -> tuple[np.ndarray, tuple[float, float]]:
        found = fftPSF(*given)
        # The first vector is along x, while the first axis of the array is along y.
        across, up = map(np.linalg.norm, found.primitiveVectors)
        return np.asarray(found.array), (float(up), float(across))

    return call


def contrast_of(
    samples: np.ndarray, steps: tuple[float, float], frequencies: Sequence[float]
) -> np.ndarray:
    """Modulus of the transfer function (2, N), tangential and sagittal, of samples [y, x] of the
    irradiance. steps: along y and x, mm. frequencies: (N,), cycles/mm."""
    lines = [(samples.sum(axis=1 - axis), step) for axis, step in enumerate(steps)]
    waves = [np.exp(-2j * np.pi * np.outer(frequencies, np.arange(len(a)) * d)) for a, d in lines]
    return np.abs([wave @ light for wave, (light, _) in zip(waves, lines)]) / samples.sum()


def prysm(shot: Shot, pupil: np.ndarray, step: float, fine: int = 9) -> Callable:
    """A function call() -> (size, size): prysm's matrix Fourier transform of a pupil function.

    pupil: (N, N). step: step of its direction cosines. fine: samples along the side of a pixel.
    """
    from prysm.propagation import Wavefront

    # At a focal length of 1 mm a direction cosine is a position in mm.
    sample, across, wavelength, size = shot.pixel / fine, len(pupil), shot.waves[0], shot.size

    def amplitude(function: np.ndarray, samples: int) -> np.ndarray:
        wave = Wavefront(function, wavelength, step)
        return np.asarray(wave.focus_fixed_sampling(1.0, _UM * sample, samples).data)

    # The scale of prysm follows from the known sum over a pupil of ones; and the total light.
    unit = abs(amplitude(np.ones((across, across), complex), 1).item()) / across**2
    scale = (step * sample * _UM / (wavelength * unit)) ** 2 / np.sum(np.abs(pupil) ** 2)

    def call() -> np.ndarray:
        light = np.abs(amplitude(pupil, fine * size)) ** 2
        return light.reshape(size, fine, size, fine).sum(axis=(1, 3)) * scale

    return call
