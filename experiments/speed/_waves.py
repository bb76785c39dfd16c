"""Run time against error of kernels and transfer functions by waves, of several programs.

One object point at infinity in one colour, with the sensor at the paraxial focus. Errors are
against `_wave_reference`, for light that fills the stop or the beam in front of the lens evenly,
whichever a program is closer to: of a kernel, the sum of absolute differences of its pixels; of
contrast, the largest difference, tangential or sagittal.
"""

import dataclasses
import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Annotated, Any

import numpy as np

import drt_jax
from drt_jax import Lens, Sampling, Scene

from . import _common, _curves, _peers, _psf_peers, _wave_reference, _work
from ._common import Numbers, not_empty, odd, within
from ._curves import Try
from ._reference import flatten

_NODES = 6  # of Gauss along a side of a pixel
Curves = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Waves:
    """Settings of kernels and transfer functions.

    cells: of our grids, along a side.
    samples: rays along a side of the pupils of other programs.
    pixel_um, size: of the kernel.
    frequencies: cycles/mm, of the contrast.
    """

    cells: Annotated[tuple[int, ...], not_empty, within(8, 1024)] = (32, 48, 64, 96, 128, 192)
    samples: Annotated[tuple[int, ...], not_empty, within(16, 2048)] = (64, 128, 256, 512)
    pixel_um: Annotated[float, within(0.05, 1e4)] = 4.4
    size: Annotated[int, within(3, 255), odd] = 21
    frequencies: Annotated[Numbers, not_empty, within(1e-3, 1e5)] = (10.0, 30.0, 60.0)


@dataclasses.dataclass(frozen=True)
class View:
    """A lens in focus at infinity, a field along y (radians), a wavelength (um), and settings."""

    lens: Lens
    field: float
    wavelength: float
    sizes: Waves

    @property
    def scene(self) -> Scene:
        """The object point."""
        return Scene.point(self.field, math.inf, (self.wavelength,))

    @property
    def pixel(self) -> float:
        """Side of a pixel, mm."""
        return 1e-3 * self.sizes.pixel_um

    @property
    def rule(self) -> Any:
        """The rays of our beams."""
        pixels = self.pixel, self.sizes.size
        return drt_jax.converge(drt_jax.psf, self.lens, self.scene, *pixels, "waves", 1e-3).rule

    def numbers(self) -> _peers.Lens:
        """For other programs."""
        given = self.lens, self.field, math.inf, (self.wavelength,)
        return _peers.Lens(*given, flatten(self.lens)[None])


def view(lens: Lens, field: float, wavelength: float, sizes: Waves) -> View:
    """The view of a lens, focused anew."""
    first = drt_jax.first_order(lens, math.inf, np.array([wavelength]))
    focused = dataclasses.replace(lens, sensor=first.image_distance[0])
    return View(focused, field, wavelength, sizes)


def _ours(at: View, of: Callable[[Lens, Sampling], Any]) -> Iterator[tuple]:
    """(size, call, value) of our grids. of: function of the lens and a sampling."""
    rule = at.rule
    for cells in at.sizes.cells:
        call, _ = _work.compiled(partial(of, sampling=Sampling("waves", rule, cells)), at.lens)
        yield cells, call, call()


def _tries(
    at: View, ours: Callable, makers: dict[str, tuple[str, Callable]], error: Callable
) -> tuple[list[Try], dict[str, str]]:
    """All tries, and why programs have none.

    ours: see `_ours`. makers: by sampling, its program, and call of (view, samples). error: of a
        value.
    """
    tries = [
        Try(_curves.OURS, "cells of the pupil", size, call, error(value))
        for size, call, value in _ours(at, ours)
    ]
    notes = {}
    for sampling, (program, make) in makers.items():
        for size in at.sizes.samples:

            def made() -> tuple:
                call = make(at, size)
                return call, error(call())

            ((label, found),) = _work.peer(program, made).items()
            if isinstance(found, str):
                notes[program] = found
                break
            tries.append(Try(label, sampling, size, *found))
    done = {one.program.split()[0] for one in tries}
    return tries, {name: why for name, why in notes.items() if name not in done}


def kernels(at: View, repeats: int) -> Curves:
    """Curves of the kernel about the chief ray, and of programs without one, why."""
    size, pixel = at.sizes.size, at.pixel
    chief = np.ravel(drt_jax.image_point(at.lens, at.scene))
    t, weight = np.polynomial.legendre.leggauss(_NODES)
    side = ((np.arange(size) - size // 2)[:, None] + t / 2).ravel() * pixel
    places = chief + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    light, change = _wave_reference.image(at.lens, at.field, at.wavelength, places)
    _common.require(change < 1e-6, f"waves: the reference changes by {change:.0e}")
    light = light.reshape(2, size, _NODES, size, _NODES)
    truth = np.einsum("lymxn,m,n->lyx", light, weight, weight) * (pixel / 2) ** 2

    def ours(lens: Lens, sampling: Sampling) -> Any:
        return drt_jax.psf(lens, at.scene, pixel, size, sampling=sampling, centre=chief).kernel[0]

    makers = {
        "FFT": ("optiland", _optiland_kernel),
        "FFT of the pupil": ("batoid", _batoid_kernel),
        "our pupil": ("prysm", partial(_prysm_kernel, chief=chief)),
    }

    def error(found: Any) -> float:
        return float(np.min(np.sum(np.abs(np.asarray(found) - truth), axis=(1, 2))))

    tries, notes = _tries(at, ours, makers, error)
    return {"curves": _curves.rows_of("kernel of waves", tries, repeats), "missing": notes}


def _optiland_kernel(at: View, samples: int) -> Callable:
    return _psf_peers.optiland(at.numbers(), at.pixel, at.sizes.size, samples, 4 * samples)


def _batoid_kernel(at: View, samples: int) -> Callable:
    psf, pixels = _psf_peers.batoid(at.numbers(), samples), (at.pixel, at.sizes.size)
    return lambda: _psf_peers.collected(*psf(), *pixels)


def _prysm_kernel(at: View, samples: int, chief: np.ndarray) -> Callable:
    """prysm traces nothing: the pupil is ours."""
    wavelength = np.array([at.wavelength])
    given = _psf_peers.pupil(at.lens, at.field, wavelength, at.rule, samples, chief)
    return _psf_peers.prysm(*given[:2], at.wavelength, at.pixel, at.sizes.size)


def contrasts(at: View, repeats: int) -> Curves:
    """Curves of the modulus of the transfer function, (2, N), and why programs have none."""
    frequencies = np.array(at.sizes.frequencies)
    given = at.lens, at.field, at.wavelength
    truth, change = _wave_reference.transfer(*given, frequencies)
    _common.require(change < 1e-6, f"waves: the reference changes by {change:.0e}")

    def ours(lens: Lens, sampling: Sampling) -> Any:
        return drt_jax.transfer(lens, at.scene, frequencies, sampling=sampling).mtf

    makers = {
        "FFT": ("optiland", _optiland_contrast),
        "FFT of the pupil": ("batoid", _batoid_contrast),
    }

    def error(found: Any) -> float:
        return float(np.min(np.max(np.abs(np.asarray(found) - truth), axis=(1, 2))))

    tries, notes = _tries(at, ours, makers, error)
    return {"curves": _curves.rows_of("contrast of waves", tries, repeats), "missing": notes}


def _optiland_contrast(at: View, samples: int) -> Callable:
    return _psf_peers.optiland_contrast(at.numbers(), samples, at.sizes.frequencies)


def _batoid_contrast(at: View, samples: int) -> Callable:
    psf, frequencies = _psf_peers.batoid(at.numbers(), samples), at.sizes.frequencies
    return lambda: _psf_peers.contrast_of(*psf(), frequencies)
