"""The pairs of calls of `skips` for kernels, pictures and programs; see `_skips`."""

import dataclasses
import math
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.signal import fftconvolve
from scipy.special import erf

import drt_jax
from drt_jax import Lens, Scene, learn, pupil
from drt_jax.image.psf import difference
from drt_jax.image.sensor import convolve_taps

from . import _work
from ._reference import reference, relative_error
from ._skips import View, Way, once, program, view

# Side of kernels, pixels; number of standard deviations of a spot across a kernel.
_SIZE, _WIDE = 21, 6.0
# Number of rays of the reference of kernels, which are traced in parts.
_ROUNDS, _ROUND = 4, 2**16
_IMAGES, _PATCH = 16, 64  # images of a batch, and pixels along the side of each


def _pixel(at: View) -> float:
    """Side of a pixel, mm, for which the kernel contains the spot."""
    return _WIDE * float(np.max(at.truth.sigma)) / _SIZE


def _histogram(hits: Array, arrives: Array, pixel: float) -> Array:
    """Light (size, size) of rays on pixels about their centroid. hits: (Q, 2), mm. arrives: (Q,),
    bool."""
    weight = arrives / jnp.sum(arrives)
    centre = jnp.sum(jnp.where(arrives[:, None], hits, 0) * weight[:, None], axis=0)
    x, y = jnp.floor((hits - centre) / pixel + _SIZE / 2).astype(int).T
    inside = (jnp.minimum(x, y) >= 0) & (jnp.maximum(x, y) < _SIZE)
    place = jnp.where(inside, y * _SIZE + x, 0)
    return jnp.zeros(_SIZE**2).at[place].add(jnp.where(inside, weight, 0)).reshape(_SIZE, _SIZE)


def _traced(lens: Lens, scene: Scene, points: Array) -> tuple[Array, Array]:
    """Hits (Q, 2) of the first wavelength on the sensor, mm, and whether the rays arrive."""
    rays = drt_jax.trace_rays(lens, scene, points)
    return rays.points[0, :, -1, :2], rays.status[0] == drt_jax.Status.OK


_compiled_trace = jax.jit(_traced)


def _kernel(lens: Lens, scene: Scene, pixel: float) -> np.ndarray:
    """The kernel of the first wavelength by very many rays: the reference."""
    points = jnp.asarray(pupil.sobol_disc(_ROUNDS * _ROUND)[0]).reshape(_ROUNDS, _ROUND, 2)
    found = [_compiled_trace(lens, scene, some) for some in points]
    hits, arrives = (jnp.concatenate(part) for part in zip(*found))
    return np.asarray(_histogram(hits, arrives, pixel))


def separable(config: Any) -> list[Way]:
    """A batch of images, convolved with the row and the column of separable kernels, or with whole
    kernels."""
    at = view(config, True)
    found = drt_jax.psf_moments(at.lens, at.scene, at.rule)
    pixel, rng = _pixel(at), np.random.default_rng(0)
    side, channels = _PATCH + _SIZE - 1, len(config.wavelengths_um)
    scenes = jnp.asarray(rng.random((_IMAGES, side, side, channels)), jnp.float32)
    edges = (np.arange(_SIZE + 1) - _SIZE / 2) * pixel
    truth = np.empty((_IMAGES, _PATCH, _PATCH, channels))
    for c, covariance in enumerate(np.asarray(found.covariance)):
        row, column = (np.diff(erf(edges / np.sqrt(2 * s))) for s in np.diag(covariance))
        kernel = np.outer(column, row)[None] / (column.sum() * row.sum())
        truth[..., c] = fftconvolve(np.asarray(scenes[..., c], float), kernel, "valid")

    def error(images: Array) -> float:
        return float(np.max(np.abs(np.asarray(images, float) - truth)))

    def parts(mean: Array, covariance: Array, scenes: Array) -> Array:
        kernel = learn.separable_psf(mean, covariance, pixel, _SIZE)
        return convolve_taps(scenes, jax.tree.map(lambda a: a.astype(scenes.dtype), kernel))

    def whole(mean: Array, covariance: Array, scenes: Array) -> Array:
        kernel = learn.gaussian_psf(mean, covariance, pixel, _SIZE)
        return learn.convolve(scenes, kernel.astype(scenes.dtype))

    ways = {"separable_psf": parts, "gaussian_psf": whole}
    given = found.mean, found.covariance, scenes
    return [program(name, error, way, *given) for name, way in ways.items()]


def polynomials(config: Any) -> list[Way]:
    """A kernel from polynomials of the beam, or from a histogram of traced rays."""
    at = view(config, False)
    scene, pixel = dataclasses.replace(at.scene, wavelengths=at.scene.wavelengths[:1]), _pixel(at)
    truth = _kernel(at.lens, scene, pixel)
    given = at.lens, scene, pixel, _SIZE, "rays", config.kernels_to
    how, seconds = once(drt_jax.converge, drt_jax.psf, *given)
    points = jnp.asarray(pupil.sobol_disc(config.rays)[0])

    def error(found: Array) -> float:
        return difference(np.asarray(found), truth)

    def beam(lens: Lens) -> Array:
        return drt_jax.psf(lens, scene, pixel, _SIZE, sampling=how).kernel[0]

    def counted(lens: Lens) -> Array:
        return _histogram(*_traced(lens, scene, points), pixel)

    few = pupil.pupil_points(at.lens, scene, how.rule.rule)[1].size
    return [
        program(f"psf, {how.cells}^2 cells", error, beam, at.lens, rays=few, once_s=seconds),
        program("histogram of rays", error, counted, at.lens, rays=config.rays),
    ]


def few_kernels(config: Any) -> list[Way]:
    """Kernels of all pixels of a small picture: interpolated from a grid, or one for each."""
    at = view(config, False)
    pixel = _pixel(at)
    edge = math.tan(math.radians(config.field_deg)) / math.sqrt(2)
    line = np.linspace(-edge, edge, config.picture)
    fields = np.arctan(np.stack(np.meshgrid(line, line), -1).reshape(-1, 2))
    every = Scene.radians(fields, at.scene.distance, at.scene.wavelengths[:1])
    given = at.lens, every, pixel, _SIZE, config.nodes, "rays", config.kernels_to
    how, seconds = once(drt_jax.converge, drt_jax.kernel_grid, *given)
    some = np.linspace(0, len(fields) - 1, 4).astype(int)
    points = every.each()
    truth = [_kernel(at.lens, points[k], pixel) for k in some]
    few = pupil.pupil_points(at.lens, points[0], how.sampling.rule.rule)[1].size

    def error(found: Array) -> float:
        return difference(np.asarray(found)[some], np.array(truth))

    def grid(lens: Lens) -> Array:
        return drt_jax.kernel_grid(lens, every.wavelengths, how).at(every)[:, 0]

    def each(lens: Lens) -> Array:
        return drt_jax.psf(lens, every, pixel, _SIZE, sampling=how.sampling).kernel[:, 0]

    name, traced = f"kernel_grid, {how.nearest.size} traced", how.nearest.size * few
    return [
        program(name, error, grid, at.lens, rays=traced, once_s=seconds),
        program(f"psf of {len(fields)} pixels", error, each, at.lens, rays=len(fields) * few),
    ]


def kept(config: Any) -> list[Way]:
    """The first gradient in a new process, with compiled programs of an earlier process, or
    without."""
    file, distance = pathlib.Path(config.lens), 1e3 * config.distance_m
    lens = str(file.resolve()) if file.is_file() else config.lens
    truth = reference(drt_jax.load_lens(lens), 0.0, distance, [0.53])
    without, kept = _work.first_gradients(lens, 0.0, distance).tolist()

    def way(words: str, height: float, seconds: float) -> Way:
        return Way(words, None, relative_error(truth, 2**0.5 * height), seconds=seconds)

    return [way("a folder for programs", *kept), way("none", *without)]
