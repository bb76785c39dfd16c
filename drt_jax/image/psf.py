"""The point spread function (PSF) on the pixels, by one of three models.

"gaussian" uses the moments of the rays, as in the paper; "rays" the light of all rays; "waves" adds
diffraction. "auto" takes the first of these whose kernel is within the tolerance of "waves". The
number of rays and cells follows from a tolerance, outside of `jax.jit`; what `converge` makes is
accepted anywhere.
"""

import dataclasses
import functools
from typing import Literal

import jax
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..numerics import Numbers, known_values, real_array
from ..pupil.rules import require_fit
from .beam import trace_beam
from .beam_psf import Kind, Psf, Sampling, psf_of_beam
from .kernel import check_pixels
from .psf_model import LOST, TOLERANCE, converged_psf, traced, warn_of_loss


def psf(
    lens: Lens,
    scene: Scene,
    pixel: Numbers,
    size: int = 21,
    kind: Kind | Literal["auto"] = "auto",
    sampling: float | Sampling = TOLERANCE,
    centre: Numbers | None = None,
    defocus: Numbers = 0.0,
) -> Psf:
    """The point spread functions of object points on `size` x `size` pixels, see `Psf`.

    lens, scene: the lens, and object points with their wavelengths. Several points are traced one
        after the other, with one sampling; also in reverse mode only the rays of one are in memory.
    pixel: side of a pixel, mm.
    size: number of pixels along a side of the kernel.
    kind: "gaussian", "rays", "waves", or "auto": the cheapest of these within the tolerance of
        "waves".
    sampling: a tolerance, the bound of the sum of the absolute errors of a kernel's pixels; or a
        `Sampling`, which has its own kind and is needed inside `jax.jit` and `jax.vmap`.
    centre: (2,), mm, centre of the kernel on the sensor; by default the mean of the centroids of
        the wavelengths.
    defocus: (), mm by which the sensor is moved back. This needs no new ray trace.

    Returns a `Psf`, with the points of the scene as first axes. The stop is filled uniformly with
    light. Differentiable in all numbers, in every mode. With a `Sampling`, warns outside of
    `jax.jit` if more than 1 % of the light of one of several points falls outside of its kernel,
    with a size for which less does. ValueError as in `lens.scene.checked_scene`, for a pixel that
    is not above 0, if no ray arrives, and for a field whose symmetry the sampling does not have:
        one for
    fields along y traces half a pupil. Inside `jax.jit`, where the field is not known, the kernel
    of such a field is 0.
    """
    scene, made = checked_scene(lens, scene), isinstance(sampling, Sampling)
    pixel_, size = check_pixels(pixel, size, lens.curvature.dtype)
    if not isinstance(sampling, Sampling):
        sampling = converged_psf(lens, scene, pixel, size, kind, sampling)
    elif kind not in ("auto", sampling.kind):
        raise ValueError(f"kind: the sampling is of the kind {sampling.kind!r}, got {kind!r}")
    dtype = lens.curvature.dtype
    middle = None if centre is None else real_array("centre", centre, dtype)
    if middle is not None and middle.shape != (2,):
        raise ValueError(f"centre: expected x and y in mm, got shape {middle.shape}")
    step = real_array("defocus", defocus, dtype)
    require_fit(sampling.rule.rule.symmetry, scene.field)
    how = dataclasses.replace(sampling, errors={})  # numbers that no program needs
    settings = how, pixel_, middle, step, size
    if not scene.shape:
        return _psf(lens, scene, *settings)
    found = _psfs(lens, scene, *settings)
    if made:
        _warn_of_loss(lens, scene, found, pixel, size, sampling)
    return found


def _warn_of_loss(
    lens: Lens, scene: Scene, found: Psf, pixel: Numbers, size: int, sampling: Sampling
) -> None:
    """Warns of light outside of the kernels, if all numbers are known."""
    known = known_values((lens, scene, pixel, found.outside))
    if known is None:
        return
    lens, scene, pixel, outside = known
    lost = np.max(np.asarray(outside), axis=-1).ravel()
    k = int(np.argmax(lost))
    if lost[k] > LOST:
        with jax.core.eval_context():
            worst = scene.each()[k]
            beam = traced(lens, worst, sampling.rule)
        warn_of_loss(float(lost[k]), worst, beam, pixel, size, sampling.kind, 4)


@functools.partial(jit, wanted=LARGE, static_argnames="size")
def _psf(
    lens: Lens, scene: Scene, how: Sampling, pixel: Array, centre: Array | None, defocus: Array,
    size: int
) -> Psf:  # fmt: skip
    """`psf` of checked arguments, for one object point."""
    beam = trace_beam(lens, scene, how.rule).refocused(defocus)
    return psf_of_beam(lens, scene.wavelengths, beam, pixel, centre, size, how.kind, how.cells)


@functools.partial(jit, wanted=LARGE, static_argnames="size")
def _psfs(
    lens: Lens, scene: Scene, how: Sampling, pixel: Array, centre: Array | None, defocus: Array,
    size: int
) -> Psf:  # fmt: skip
    """`_psf` of several object points, one after the other."""

    def one(point: tuple[Array, Array]) -> Psf:
        return _psf(lens, scene.at(*point), how, pixel, centre, defocus, size)

    found = jax.lax.map(jax.checkpoint(one), scene.flat())
    return jax.tree.map(lambda a: a.reshape(*scene.shape, *a.shape[1:]), found)
