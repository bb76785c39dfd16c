"""The point spread function on the pixels, by the model that a scene needs.

A ladder of three: "gaussian", with the moments of the rays, as in the paper; "rays", the light of
all rays; "waves", with diffraction. "auto" takes the first whose kernel is within a tolerance of
that of the waves. How many rays and cells a model takes follows from the tolerance, outside of
`jax.jit`: `converged_psf` makes the model, a value that `psf` then takes anywhere.
"""

import functools
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, scene_of
from ..numerics import Numbers, real_array
from .beam import BeamRule, trace_beam
from .beam_psf import Kind, Psf, PsfModel, psf_of_beam
from .kernel import check_pixels
from .psf_model import TOLERANCE, converged_psf


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
    """The point spread function on `size` x `size` pixels, see `Psf`.

    field, distance, wavelengths (W,): as of `psf_moments`. pixel: the side of a pixel, mm.
    model: a name or, inside `jax.jit` and `jax.vmap`, what `converged_psf` made.
    tolerance: of a model that is named: sum of the absolute errors of a kernel's pixels, 1e-2 by
        default.
    centre: (2,) mm on the sensor; by default the mean of the wavelengths' centroids.
    defocus: () mm by which the sensor stands behind its place: no ray is traced for it.

    Light fills the stop evenly. Differentiable in all numbers, in every mode. ValueError as of
    `scene_of`, for a pixel that is not above 0, and where no ray arrives.
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
    """`psf` of B object points, one after the other: each leaf with B as its first axis.

    fields: (B, 2), radians. distances: (B,), mm, or one. wavelengths, pixel, size: as of `psf`.
    model: from `converged_psf`, for all points.

    For `jax.jit`; the gradient traces each point again and keeps the rays of one point at a time.
    ValueError for other shapes; a point without light has the throughput 0.
    """
    dtype = lens.curvature.dtype
    angles = real_array("fields", fields, dtype)
    far = real_array("distances", distances, dtype)
    if angles.ndim != 2 or angles.shape[1] != 2 or far.shape not in ((), angles.shape[:1]):
        raise ValueError(
            f"fields, distances: expected (B, 2) and (B,), got {angles.shape} and {far.shape}"
        )
    side, size = check_pixels(pixel, size, dtype)
    given = side, None, jnp.zeros((), dtype), size, model.kind, model.cells

    def one(point: tuple[Array, Array]) -> Psf:
        return _psf(lens, scene_of(lens, *point, wavelengths), model.rule, *given)

    return jax.lax.map(jax.checkpoint(one), (angles, jnp.broadcast_to(far, angles.shape[:1])))
