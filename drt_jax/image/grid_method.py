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
from ..lens.scene import Scene, checked_scene
from ..numerics import Numbers, concrete, known_values, real_array
from ..pupil.rules import Gauss, PupilRule, symmetry_of
from ..rays.solve import solve_aimed
from .beam_psf import Kind, Sampling
from .fields import GridMethod, KernelGrid, unique_nodes
from .moments import moments
from .psf import chosen_psf
from .spot import Moments

# Numbers of pixels along a side of a kernel to choose from.
_SIZES = (9, 13, 17, 21, 25, 33, 41, 49, 65, 97, 129)
# Half the side of a kernel, in standard deviations of the blur.
_REACH = 4.5
# Fraction of the light outside of a kernel above which a warning is given.
_MAX_OUTSIDE = 1e-2
# Default tolerance: the sum of the absolute errors of a kernel's pixels.
_TOLERANCE = 5e-3
# Order of the rule that tests for which fields light arrives.
_TEST_ORDER = 8


def grid_method(
    lens: Lens,
    scene: Scene,
    pixel: Numbers,
    size: int | None = None,
    nodes: int = 8,
    kind: Kind | Literal["auto"] = "rays",
    sampling: float | Sampling = _TOLERANCE,
    together: bool = False,
    norm: int = 1,
) -> GridMethod:
    """Chooses the settings of `kernel_grid`. All arguments are known numbers.

    lens: the lens.
    scene: its largest angles along x and y are those of the grid; its distances, as of
        `Scene.grid`, are equidistant in 1 / distance, rising or falling.
    pixel: side of a pixel, mm.
    size: number of pixels along a side of a kernel, odd; by default it extends to 4.5 standard
        deviations of the blur on each side.
    nodes: number of nodes from the axis to the largest angle, 2 or more.
    kind, sampling: as in `psf`, one for all fields; norm: as in `converged_psf`.
    together: True centres the kernels of all wavelengths on the mean of their centroids, so that
        they contain the lateral colour (for patches); False centres each kernel on its own
        centroid.

    Returns a `GridMethod`. ValueError inside a trace, for invalid numbers, and if no light arrives
    from any field.
    """
    known = known_values((lens, scene, pixel))
    if known is None:
        raise ValueError(
            "the choice of fields and rays follows from known numbers: call "
            "drt_jax.converge(drt_jax.kernel_grid, ...) outside of jax.jit and jax.vmap, and pass "
            "on what it returns"
        )
    with jax.core.eval_context():
        lens, scene, pixel = known
        scene = checked_scene(lens, scene)
        check_pixel(pixel)
        _check_counts(size, nodes)
        dtype = lens.curvature.dtype
        far, wide = np.ravel(np.asarray(scene.distance, float)), _widest(scene)
        step = float(np.max(wide)) / nodes
        across, down = (max(2, int(np.ceil(a / step - 1e-9))) for a in wide)
        half = down, across
        symmetry = symmetry_of(lens, 0.0)
        tangents = unique_nodes(half, symmetry)[0] * step
        found = _spots_at(lens, tangents, far, scene.wavelengths)
        arrives = np.all(np.asarray(found.throughput) > 0, axis=-1)
        if not np.any(arrives):
            raise ValueError("fields: no light of any of them reaches the sensor")
        if size is None:
            need = _reach(found, arrives, pixel)
            size = next((n for n in _SIZES if n >= need), _SIZES[-1])
        if not isinstance(sampling, Sampling):
            where = Scene.grid(*_extremes(tangents, far, arrives), scene.wavelengths)
            # No warning here of light outside of the kernels: `warn_of_loss` gives it for all
            # nodes.
            sampling = chosen_psf(lens, where, pixel, size, kind, sampling, norm)[0]
        array = lambda a: jnp.asarray(a, dtype)  # noqa: E731
        nearest = jnp.asarray(_nearest(tangents, arrives), jnp.int32)
        return GridMethod(
            array(step), array(far), array(pixel), sampling, nearest, half, size, symmetry, together
        )


def check_pixel(pixel: Numbers) -> None:
    """ValueError if the side of a pixel is known and is not above 0 mm."""
    if concrete(pixel):
        side = np.asarray(pixel, float)
        if side.ndim or not 0 < side < np.inf:
            raise ValueError(f"pixel: must be above 0 mm, got {pixel!r}")


def _widest(scene: Scene) -> np.ndarray:
    """Tangents (2,) of the largest field angles along x and y. ValueError unless one is above 0."""
    angles = np.asarray(scene.field, float).reshape(-1, 2)
    wide = np.tan(np.max(np.abs(angles), axis=0))
    if not np.max(wide) > 0:
        raise ValueError("fields: expected one beside the axis")
    return cast(np.ndarray, wide)


def _check_counts(size: Any, nodes: Any) -> None:
    """ValueError for an even kernel size or fewer than 2 nodes."""
    whole = isinstance(size, int | np.integer) and size > 0 and size % 2
    if size is not None and not whole:
        raise ValueError(f"size: expected an odd number of pixels, got {size!r}")
    if not isinstance(nodes, int | np.integer) or nodes < 2:
        raise ValueError(f"nodes: expected a whole number from 2 on, got {nodes!r}")


def _reach(found: Moments, arrives: np.ndarray, pixel: Any) -> int:
    """Number of pixels along the side of a kernel that is wide enough for all spots (D, U, W)
    with light (D, U)."""
    sigma = np.sqrt(np.diagonal(np.asarray(found.covariance), 0, -2, -1))[arrives]
    return int(np.ceil(_REACH * np.max(sigma) / float(np.asarray(pixel)))) * 2 + 1


def warn_of_loss(lens: Lens, method: GridMethod, grid: KernelGrid, wavelengths: Any) -> None:
    """Warns if kernels are too small for the blur, with the fraction of the light outside and the
    size that is needed. The numbers are known.

    lens, method: the lens and the settings of the kernels.
    grid: the kernels.
    wavelengths: (W,), um.
    """
    lost = np.max(np.asarray(grid.outside), initial=0.0)
    if lost > _MAX_OUTSIDE:
        tangents = unique_nodes(method.half, method.symmetry)[0] * float(method.step)
        found = _spots_at(lens, tangents, np.asarray(method.distances), wavelengths)
        need = _reach(found, np.all(np.asarray(found.throughput) > 0, axis=-1), method.pixel)
        remedy = f"give {need}" if need > method.size else "give more, or larger pixels"
        warnings.warn(
            f"size: {100 * lost:.2g} % of the light of a point falls beside a kernel of "
            f"{method.size} x {method.size} pixels: {remedy}",
            stacklevel=3,
        )


def _nearest(tangents: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Index (D, U) of the node with light that is nearest to each node (U, 2). lit: (D, U),
    bool, nodes with light."""
    squared = np.sum((tangents[:, None] - tangents[None]) ** 2, axis=-1)
    return np.argmin(np.where(lit[:, None], squared[None], np.inf), axis=-1)


@functools.partial(jit, wanted=LARGE)
def _spots(
    lens: Lens, tangents: Array, distances: Array, wavelengths: Array, rule: PupilRule
) -> Moments:
    """`_spots_at` of arrays."""

    def one(distance: Array, tangent: Array) -> Moments:
        scene = Scene(jnp.arctan(tangent), distance, wavelengths)
        return moments(lens, scene, rule, solve_aimed).at(lens.sensor)

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(distances, tangents)


def _spots_at(lens: Lens, tangents: np.ndarray, far: np.ndarray, wavelengths: Any) -> Moments:
    """`Moments` (D, U, ...) of fields with the tangents (U, 2) at all distances, which show
    where light arrives."""
    dtype = lens.curvature.dtype
    waves = jnp.atleast_1d(real_array("wavelengths", wavelengths, dtype))
    rule = Gauss(_TEST_ORDER, "none")
    return _spots(lens, jnp.asarray(tangents, dtype), jnp.asarray(far, dtype), waves, rule)


def _extremes(tangents: np.ndarray, far: np.ndarray, arrives: np.ndarray) -> tuple[Any, Any]:
    """Fields (F, 2), radians, and distances for the choice of a PSF model: the farthest field
    with light, a middle one and the axis; the first and the last distance."""
    always = np.all(arrives, axis=0)
    lit = tangents[always if np.any(always) else np.any(arrives, axis=0)]
    order = lit[np.argsort(np.sum(lit**2, axis=1))]
    chosen = order[[-1, len(order) // 2, 0]]
    # Shift the fields slightly off the planes of symmetry, where the rule would trace half a pupil
    # only.
    angles = np.arctan(chosen + 1e-6 * max(np.max(np.abs(chosen)), 1e-3))
    return angles, np.unique([far[0], far[-1]])
