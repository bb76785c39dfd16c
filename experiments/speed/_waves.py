"""Run time against error of kernels and transfer functions by waves, of several programs.

The scene is one object point at infinity in one wavelength, with the sensor at the paraxial focus.
The reference is `_wave_reference`, for light that fills evenly the stop, or the beam in front of
the lens; each program is compared with the one to which it is closer. The error of a kernel is the
sum of absolute differences of its pixels; that of contrast the largest difference, tangential or
sagittal.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import numpy as np

import drt_jax
from drt_jax import Lens, Sampling

from . import _common, _curves, _psf_peers, _wave_reference, _work
from ._common import Numbers, not_empty, odd, within
from ._psf_peers import Shot

_NODES = 6  # Gauss nodes along the side of a pixel


@dataclasses.dataclass(frozen=True)
class Waves:
    """Settings of kernels and transfer functions.

    cells: numbers of cells along a side of our grids.
    samples: numbers of rays along a side of the pupils of other programs.
    pixel_um, size: side of a pixel, um, and side of the kernel, pixels.
    frequencies: frequencies of the contrast, cycles/mm.
    """

    cells: Annotated[tuple[int, ...], not_empty, within(8, 1024)] = (32, 48, 64, 96, 128, 192)
    samples: Annotated[tuple[int, ...], not_empty, within(16, 2048)] = (64, 128, 256, 512)
    pixel_um: Annotated[float, within(0.05, 1e4)] = 4.4
    size: Annotated[int, within(3, 255), odd] = 21
    frequencies: Annotated[Numbers, not_empty, within(1e-3, 1e5)] = (10.0, 30.0, 60.0)


def focused(lens: Lens, field: float, wavelength: float, sizes: Waves) -> Shot:
    """The shot of a lens that is refocused for an object at infinity."""
    waves = np.array([wavelength])
    first = drt_jax.first_order(lens, math.inf, waves)
    lens = dataclasses.replace(lens, sensor=first.image_distance[0])
    return Shot(lens, field, waves, 1e-3 * sizes.pixel_um, sizes.size)


def _curves_of(
    at: Shot, sizes: Waves, task: str, ours: Callable, makers: dict[str, tuple[str, Callable]],
    error: Callable, repeats: int,
) -> dict[str, Any]:  # fmt: skip
    """Curves of a task; and the reasons for programs that have none.

    ours: function of the lens and a sampling.
    makers: by sampling, the program and a function of the number of rays along a side that returns
        the call.
    error: function that returns the error of the result of a call.
    """
    tries, rule = [], at.model("waves", 1e-3).rule
    for cells in sizes.cells:
        call, _ = _work.compiled(partial(ours, sampling=Sampling("waves", rule, cells)), at.lens)
        tries.append(_curves.Try(_curves.OURS, "cells of the pupil", cells, call, error(call())))
    ways = (
        (program, sampling, lambda: (size, make(size)))
        for sampling, (program, make) in makers.items()
        for size in sizes.samples
    )
    return _curves.rows_of(task, tries, ways, error, repeats)


def kernels(at: Shot, sizes: Waves, repeats: int) -> dict[str, Any]:
    """Curves of the kernel about the chief ray."""
    size, pixel = at.size, at.pixel
    chief = np.ravel(drt_jax.image_point(at.lens, at.scene))
    t, weight = np.polynomial.legendre.leggauss(_NODES)
    side = ((np.arange(size) - size // 2)[:, None] + t / 2).ravel() * pixel
    places = chief + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    light, change = _wave_reference.image(at.lens, at.field, at.waves[0], places)
    _common.require(change < 1e-6, f"waves: the reference changes by {change:.0e}")
    light = light.reshape(2, size, _NODES, size, _NODES)
    truth = np.einsum("lymxn,m,n->lyx", light, weight, weight) * (pixel / 2) ** 2

    def ours(lens: Lens, sampling: Sampling) -> Any:
        return at.kernel(lens, sampling, chief)[0]

    def batoid(samples: int) -> Callable:
        psf = _psf_peers.batoid(at, samples)
        return lambda: _psf_peers.collected(*psf(), pixel, size)

    def prysm(samples: int) -> Callable:  # prysm does not trace: it gets our pupil function
        rule = at.model("waves", 1e-3).rule
        return _psf_peers.prysm(at, *_psf_peers.pupil(at, rule, samples, chief)[:2])

    def error(found: Any) -> float:
        return float(np.min(np.sum(np.abs(np.asarray(found) - truth), axis=(1, 2))))

    makers = {
        "FFT": ("optiland", partial(_psf_peers.optiland, at)),
        "FFT of the pupil": ("batoid", batoid),
        "our pupil": ("prysm", prysm),
    }
    return _curves_of(at, sizes, "kernel of waves", ours, makers, error, repeats)


def contrasts(at: Shot, sizes: Waves, repeats: int) -> dict[str, Any]:
    """Curves of the modulus of the transfer function, (2, N)."""
    frequencies = np.array(sizes.frequencies)
    truth, change = _wave_reference.transfer(at.lens, at.field, at.waves[0], frequencies)
    _common.require(change < 1e-6, f"waves: the reference changes by {change:.0e}")

    def ours(lens: Lens, sampling: Sampling) -> Any:
        return drt_jax.transfer(lens, at.scene, frequencies, sampling=sampling).mtf

    def optiland(samples: int) -> Callable:
        return _psf_peers.optiland_contrast(at, samples, frequencies)

    def batoid(samples: int) -> Callable:
        psf = _psf_peers.batoid(at, samples)
        return lambda: _psf_peers.contrast_of(*psf(), frequencies)

    def error(found: Any) -> float:
        return float(np.min(np.max(np.abs(np.asarray(found) - truth), axis=(1, 2))))

    makers = {"FFT": ("optiland", optiland), "FFT of the pupil": ("batoid", batoid)}
    return _curves_of(at, sizes, "contrast of waves", ours, makers, error, repeats)
