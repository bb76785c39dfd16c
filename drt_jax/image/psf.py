"""The point spread function (PSF) on the pixels, by one of three models.

"gaussian" uses the moments of the rays, as in the paper; "rays" the light of all rays; "waves" adds
diffraction. "auto" takes the first of these whose kernel is within the tolerance of "waves".
`converged_psf` chooses the number of rays and cells from a tolerance, outside of `jax.jit`. The
model that it returns is a value that `psf` accepts anywhere.
"""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, points_arrays, scene_of
from ..numerics import Numbers, known_values, real_array
from ..pupil.rules import require_fit
from .beam import BeamRule, trace_beam
from .beam_psf import Kind, Psf, PsfModel, psf_of_beam
from .kernel import check_pixels
from .psf_model import LOST, TOLERANCE, converged_psf, traced, warn_of_loss


def psf(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    pixel: Numbers,
    size: int = 21,
    model: Kind | Literal["auto"] | PsfModel = "auto",
    tolerance: float | None = None,
    centre: Numbers | None = None,
    defocus: Numbers = 0.0,
) -> Psf:
    """The point spread function of an object point on `size` x `size` pixels, see `Psf`.

    lens: the lens.
    field, distance, wavelengths: as in `psf_moments`; wavelengths (W,).
    pixel: side of a pixel, mm.
    size: number of pixels along a side of the kernel.
    model: a name, or a model from `converged_psf`, which is needed inside `jax.jit` and `jax.vmap`.
    tolerance: only with a name: bound of the sum of the absolute errors of a kernel's pixels, 1e-2
        by default.
    centre: (2,), mm, centre of the kernel on the sensor; by default the mean of the centroids of
        the wavelengths.
    defocus: (), mm by which the sensor is moved back. This needs no new ray trace.

    The stop is filled uniformly with light. Differentiable in all numbers, in every mode.
    ValueError as in `scene_of`, for a pixel that is not above 0, if no ray arrives, and for a field
    whose symmetry the model does not have: a model for fields along y traces half a pupil. Inside
    `jax.jit`, where the field is not known, the kernel of such a field is 0.
    """
    scene = scene_of(lens, field, distance, wavelengths)
    pixel_, size = check_pixels(pixel, size, lens.curvature.dtype)
    if isinstance(model, str):
        accuracy = TOLERANCE if tolerance is None else tolerance
        model = converged_psf(lens, field, distance, wavelengths, pixel, size, model, accuracy)
    elif tolerance is not None:
        raise ValueError("tolerance and model: a model that is made has its own precision")
    dtype = lens.curvature.dtype
    middle = None if centre is None else real_array("centre", centre, dtype)
    if middle is not None and middle.shape != (2,):
        raise ValueError(f"centre: expected x and y in mm, got shape {middle.shape}")
    step = real_array("defocus", defocus, dtype)
    rule, kind, cells = model.rule, model.kind, model.cells
    require_fit(rule.rule.symmetry, scene.field)
    return _psf(lens, scene, rule, pixel_, middle, step, size, kind, cells)


@functools.partial(jit, wanted=LARGE, static_argnames=("size", "kind", "cells"))
def _psf(
    lens: Lens,
    scene: Scene,
    rule: BeamRule,
    pixel: Array,
    centre: Array | None,
    defocus: Array,
    size: int,
    kind: Kind,
    cells: int,
) -> Psf:
    """`psf` of checked arguments."""
    beam = trace_beam(lens, scene, rule).refocused(defocus)
    return psf_of_beam(lens, scene.wavelengths, beam, pixel, centre, size, kind, cells)


def psfs(
    lens: Lens,
    fields: Numbers,
    distances: Numbers,
    wavelengths: Numbers,
    pixel: Numbers,
    size: int,
    model: PsfModel,
) -> Psf:
    """`psf` of B object points, one after the other.

    lens: the lens.
    fields: (B, 2), radians.
    distances: (B,), mm, or one.
    wavelengths, pixel, size: as in `psf`.
    model: one model from `converged_psf` for all points.

    Returns a `Psf` whose leaves have B as first axis; a point without light has the throughput 0.
    For use in `jax.jit`; outside of it, warns if more than 1 % of the light of a point falls
    outside of its kernel, with a size for which less does. The gradient traces each point again, so
    only the rays of one point are in memory. ValueError for other shapes, and as in `psf` for
    fields whose symmetry the model does not have.
    """
    dtype = lens.curvature.dtype
    angles, far = points_arrays(fields, distances, dtype)
    require_fit(model.rule.rule.symmetry, angles)
    side, size = check_pixels(pixel, size, dtype)
    settings = side, None, jnp.zeros((), dtype), size, model.kind, model.cells

    def one(point: tuple[Array, Array]) -> Psf:
        return _psf(lens, scene_of(lens, *point, wavelengths), model.rule, *settings)

    found = jax.lax.map(jax.checkpoint(one), (angles, far))
    known = known_values((lens, angles, far, wavelengths, pixel, found.outside))
    if known is not None:
        lens, angles, far, wavelengths, pixel, outside = known
        lost = np.max(np.asarray(outside), axis=-1)
        k = int(np.argmax(lost))
        if lost[k] > LOST:
            with jax.core.eval_context():
                scene = scene_of(lens, angles[k], far[k], wavelengths)
                beam = traced(lens, scene, model.rule)
            warn_of_loss(float(lost[k]), scene, beam, pixel, size, model.kind, 3)
    return found
