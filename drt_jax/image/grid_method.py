"""The choice of nodes, PSF model and kernel size for the kernels over the field."""

import functools
import warnings
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import scene_of
from ..numerics import Numbers, concrete, known_values, real_array
from ..pupil.rules import Gauss, PupilRule, symmetry_of
from ..rays.solve import solve_aimed
from .beam_psf import Kind, PsfModel
from .fields import GridMethod, KernelGrid, unique_nodes
from .moments import moments
from .psf_model import chosen_psf
from .spot import Moments

# Kernel sides to try, pixels.
_SIZES = (9, 13, 17, 21, 25, 33, 41, 49, 65, 97, 129)
# Half the side of a kernel, in standard deviations of the blur.
_REACH = 4.5
# Warn if a larger fraction of the light falls outside a kernel.
_LOST = 1e-2
# Default tolerance: the sum of the absolute errors of a kernel's pixels.
_TOLERANCE = 5e-3
# Order of the rule that tests from which fields light arrives.
_LOOK = 8


def grid_method(
    lens: Lens,
    fields: Numbers,
    distances: Numbers,
    wavelengths: Numbers,
    pixel: Numbers,
    size: int | None = None,
    nodes: int = 8,
    model: Kind | Literal["auto"] | PsfModel = "rays",
    tolerance: float = _TOLERANCE,
    together: bool = False,
    norm: int = 1,
) -> GridMethod:
    """Choose the settings of `kernel_grid`. All arguments are known numbers.

    fields: the largest angles (2,) along x and y, radians.
    distances: (D,) mm, inf allowed; 1 / distance is equidistant, rising or falling.
    wavelengths: (W,) um. pixel: side of a pixel, mm.
    size: side of a kernel, pixels, odd; the default reaches 4.5 standard deviations to each side.
    nodes: number of nodes from the axis to the largest angle, 2 or more.
    model, tolerance, norm: as in `converged_psf`; a name is converged to one model for all fields.
    together: True centres the kernels of all wavelengths on the mean of their centroids, so that
        they contain the lateral colour (for patches); False centres each on its own centroid.

    ValueError inside a trace, for invalid numbers, and if no light arrives from any field.
    """
    known = known_values((lens, fields, distances, wavelengths, pixel))
    if known is None:
        raise ValueError(
            "the choice of fields and rays follows from known numbers: call grid_method outside of "
            "jax.jit and jax.vmap, and pass on what it returns"
        )
    with jax.core.eval_context():
        lens, fields, distances, wavelengths, pixel = known
        check_pixel(pixel)
        _check_counts(size, nodes)
        dtype = lens.curvature.dtype
        far = np.atleast_1d(np.asarray(distances, float))
        wide = _widest(fields)
        step = float(np.max(wide)) / nodes
        across, down = (max(2, int(np.ceil(a / step - 1e-9))) for a in wide)
        half = down, across
        symmetry = symmetry_of(lens, 0.0)
        tangents = unique_nodes(half, symmetry)[0] * step
        found = _look(lens, tangents, far, wavelengths)
        arrives = np.all(np.asarray(found.throughput) > 0, axis=-1)
        if not np.any(arrives):
            raise ValueError("fields: no light of any of them reaches the sensor")
        if size is None:
            need = _reach(found, arrives, pixel)
            size = next((n for n in _SIZES if n >= need), _SIZES[-1])
        if isinstance(model, str):
            seen = *_some(tangents, far, arrives), wavelengths
            # `warn_of_loss` speaks of light beside the kernels, of all nodes.
            model = chosen_psf(lens, seen, pixel, size, model, tolerance, norm)[0]
        array = lambda a: jnp.asarray(a, dtype)  # noqa: E731
        nearest = jnp.asarray(_nearest(tangents, arrives), jnp.int32)
        return GridMethod(
            array(step), array(far), array(pixel), model, nearest, half, size, symmetry, together
        )


def check_pixel(pixel: Numbers) -> None:
    """ValueError if the side of a pixel is known and is not above 0 mm."""
    if concrete(pixel):
        side = np.asarray(pixel, float)
        if side.ndim or not 0 < side < np.inf:
            raise ValueError(f"pixel: must be above 0 mm, got {pixel!r}")


def _widest(fields: Any) -> np.ndarray:
    """Tangents (2,) of the largest field angles along x and y. Known numbers."""
    wide = np.tan(np.abs(np.asarray(fields, float)))
    if wide.shape != (2,) or not np.all(np.isfinite(wide)) or not np.max(wide) > 0:
        raise ValueError(f"fields: expected two angles, one above 0, got {fields!r}")
    return cast(np.ndarray, wide)


def _check_counts(size: Any, nodes: Any) -> None:
    whole = isinstance(size, int | np.integer) and size > 0 and size % 2
    if size is not None and not whole:
        raise ValueError(f"size: expected an odd number of pixels, got {size!r}")
    if not isinstance(nodes, int | np.integer) or nodes < 2:
        raise ValueError(f"nodes: expected a whole number from 2 on, got {nodes!r}")


def _reach(found: Moments, arrives: np.ndarray, pixel: Any) -> int:
    """The kernel side, pixels, that is wide enough for the spots (D, U, W) with light (D, U)."""
    sigma = np.sqrt(np.diagonal(np.asarray(found.covariance), 0, -2, -1))[arrives]
    return int(np.ceil(_REACH * np.max(sigma) / float(np.asarray(pixel)))) * 2 + 1


def warn_of_loss(lens: Lens, method: GridMethod, grid: KernelGrid, wavelengths: Any) -> None:
    """Warn if kernels are too small for the blur. The warning gives the lost fraction of the light
    and the size that is needed. Known numbers."""
    lost = np.max(np.asarray(grid.outside), initial=0.0)
    if lost > _LOST:
        tangents = unique_nodes(method.half, method.symmetry)[0] * float(method.step)
        found = _look(lens, tangents, np.asarray(method.distances), wavelengths)
        need = _reach(found, np.all(np.asarray(found.throughput) > 0, axis=-1), method.pixel)
        remedy = f"give {need}" if need > method.size else "give more, or larger pixels"
        warnings.warn(
            f"size: {100 * lost:.2g} % of the light of a point falls beside a kernel of "
            f"{method.size} x {method.size} pixels: {remedy}",
            stacklevel=3,
        )


def _nearest(tangents: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """For each node (U, 2) and distance, the index of the nearest node with light, `lit` (D, U)."""
    apart = np.sum((tangents[:, None] - tangents[None]) ** 2, axis=-1)
    return np.argmin(np.where(lit[:, None], apart[None], np.inf), axis=-1)


@functools.partial(jit, wanted=LARGE)
def _spots(
    lens: Lens, tangents: Array, distances: Array, wavelengths: Array, rule: PupilRule
) -> Moments:
    def one(distance: Array, tangent: Array) -> Moments:
        scene = scene_of(lens, jnp.arctan(tangent), distance, wavelengths)
        return moments(lens, scene, rule, solve_aimed).at(lens.sensor)

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(distances, tangents)


def _look(lens: Lens, tangents: np.ndarray, far: np.ndarray, wavelengths: Any) -> Moments:
    """Spots of all fields (U, 2), tangents, at all distances; they show where light arrives."""
    dtype = lens.curvature.dtype
    waves = jnp.atleast_1d(real_array("wavelengths", wavelengths, dtype))
    rule = Gauss(_LOOK, "none")
    return _spots(lens, jnp.asarray(tangents, dtype), jnp.asarray(far, dtype), waves, rule)


def _some(tangents: np.ndarray, far: np.ndarray, arrives: np.ndarray) -> tuple[Any, Any]:
    """Fields (F, 2), radians, and distances for the choice of a PSF model: the farthest field with
    light, a middle one and the axis; the first and the last distance."""
    every = np.all(arrives, axis=0)
    lit = tangents[every if np.any(every) else np.any(arrives, axis=0)]
    order = lit[np.argsort(np.sum(lit**2, axis=1))]
    some = order[[-1, len(order) // 2, 0]]
    # A small shift off the symmetry planes, where the rule would use half a pupil only.
    angles = np.arctan(some + 1e-6 * max(np.max(np.abs(some)), 1e-3))
    return angles, np.unique([far[0], far[-1]])
