"""Kernels over the whole field and over depth: a small grid of object points, made once.

The nodes are equidistant in the tangents of the field, along x and y, and in 1 / distance. Where a
lens has an axis, an eighth of them is traced; mirroring and exchange of x and y, which are exact on
pixels, give the others.
"""

import dataclasses
import functools
import warnings
from typing import Any, Literal, cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import scene_of, vergence_of
from ..numerics import Numbers, concrete, known_values, real_array
from ..pupil.rules import Gauss, PupilRule, Symmetry, symmetry_of
from ..rays.solve import solve_aimed
from ..rays.status import Status
from ..rays.trace import trace_bundle
from .interpolate import lagrange
from .moments import moments
from .psf import Kind, PsfModel, converged_psf, psf
from .spot import Moments

# Sides of kernels that are tried, pixels.
_SIZES = (9, 13, 17, 21, 25, 33, 41, 49, 65, 97, 129)
# Standard deviations of the blur that a kernel reaches to each side.
_REACH = 4.5
# The part of the light beside a kernel from which a picture is worth a warning.
_LOST = 1e-2
# Sum of the absolute errors of a kernel's pixels.
_TOLERANCE = 5e-3
# The order of the rule that finds where light arrives.
_LOOK = 8
# Nodes that interpolation takes a kernel from, along each axis.
_ORDER = 4


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GridMethod:
    """How the kernels over the field are made: what `grid_method` chose, to be passed on.

    step: (), between nodes, tangent of the field. distances: (D,) mm, equidistant in 1 / distance.
    pixel: (), mm. model: of the kernels, see `converged_psf`.
    nearest: (D, U), the traced node with light that is nearest to each.
    half: nodes on either side of the axis, y and x. size: of a kernel, pixels. symmetry: of the
    lens. together: see `grid_method`.
    """

    step: Array
    distances: Array
    pixel: Array
    model: PsfModel
    nearest: Array
    half: tuple[int, int] = dataclasses.field(metadata={"static": True})
    size: int = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    together: bool = dataclasses.field(default=False, metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class KernelGrid:
    """What a lens makes of points at D distances, Ny x Nx fields and W wavelengths.

    step: (), between nodes, tangent of the field; the middle node is the axis.
    vergences: (D,) 1/mm, of the objects.
    points: (D, Ny, Nx, W, 2) mm, the centroids on the sensor: the middles of the kernels.
    solid_angle: (D, Ny, Nx, W), of the light on the sensor, in direction cosines: irradiance =
        radiance x solid_angle.
    outside: (D, Ny, Nx, W), the part of the light that falls beside a kernel.
    kernels: (D, Ny, Nx, W, K, K) [y, x], adding up to 1 - outside; 0 where no light arrives.
    """

    step: Array
    vergences: Array
    points: Array
    solid_angle: Array
    outside: Array
    kernels: Array

    @property
    def half(self) -> tuple[int, int]:
        """Nodes on either side of the axis, y and x."""
        return self.kernels.shape[1] // 2, self.kernels.shape[2] // 2


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
    """Choose how `kernel_grid` makes its kernels; all numbers are known.

    fields: the largest angles (2,) along x and y, radians.
    distances: (D,) mm, of which 1 / distance is equidistant, rising or falling; inf allowed.
    wavelengths: (W,) um. pixel: mm.
    size: side of a kernel in pixels, odd; by default wide enough for 4.5 standard deviations.
    nodes: on one side of the axis along the longer side, 2 or more.
    model, tolerance, norm: of the kernels, as of `converged_psf`; a name is made into a model for
        all fields.
    together: all colours about the mean of their centroids, so that kernels hold the lateral colour
        (of patches); else each about its own.

    ValueError inside a trace, for numbers that make no sense, and where no light arrives at all.
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
        tangents = _unique(half, symmetry)[0] * step
        found = _look(lens, tangents, far, wavelengths)
        arrives = np.all(np.asarray(found.throughput) > 0, axis=-1)
        if not np.any(arrives):
            raise ValueError("fields: no light of any of them reaches the sensor")
        if size is None:
            need = _reach(found, arrives, pixel)
            size = next((n for n in _SIZES if n >= need), _SIZES[-1])
        if isinstance(model, str):
            scene = lens, *_some(tangents, far, arrives), wavelengths
            model = converged_psf(*scene, pixel, size, model, tolerance, norm)
        array = lambda a: jnp.asarray(a, dtype)  # noqa: E731
        nearest = jnp.asarray(_nearest(tangents, arrives), jnp.int32)
        return GridMethod(
            array(step), array(far), array(pixel), model, nearest, half, size, symmetry, together
        )


def check_pixel(pixel: Numbers) -> None:
    """ValueError for a known side of a pixel that is not above 0 mm."""
    if concrete(pixel):
        side = np.asarray(pixel, float)
        if side.ndim or not 0 < side < np.inf:
            raise ValueError(f"pixel: must be above 0 mm, got {pixel!r}")


def _widest(fields: Any) -> np.ndarray:
    """The largest tangents (2,) of known fields."""
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
    """The side of kernels that are wide enough for spots (D, U, W), where light arrives (D, U)."""
    sigma = np.sqrt(np.diagonal(np.asarray(found.covariance), 0, -2, -1))[arrives]
    return int(np.ceil(_REACH * np.max(sigma) / float(np.asarray(pixel)))) * 2 + 1


def warn_of_loss(lens: Lens, method: GridMethod, grid: KernelGrid, wavelengths: Any) -> None:
    """A warning if kernels are too small for the blur: what share is lost and the size that would
    do. Known numbers."""
    lost = np.max(np.asarray(grid.outside), initial=0.0)
    if lost > _LOST:
        tangents = _unique(method.half, method.symmetry)[0] * float(method.step)
        found = _look(lens, tangents, np.asarray(method.distances), wavelengths)
        need = _reach(found, np.all(np.asarray(found.throughput) > 0, axis=-1), method.pixel)
        remedy = f"give {need}" if need > method.size else "give more, or larger pixels"
        warnings.warn(
            f"size: {100 * lost:.2g} % of the light of a point falls beside a kernel of "
            f"{method.size} x {method.size} pixels: {remedy}",
            stacklevel=3,
        )


def _unique(half: tuple[int, int], symmetry: Symmetry) -> tuple[np.ndarray, ...]:
    """Nodes (U, 2), x and y in steps, that are traced; which of them (Ny, Nx) each node of the grid
    is, and whether x and y are exchanged there."""
    y, x = np.meshgrid(*(np.arange(-n, n + 1) for n in half), indexing="ij")
    exchanged = np.zeros(x.shape, bool)
    if symmetry != "none":
        x = np.abs(x)
    if symmetry == "rotational":
        y = np.abs(y)
        exchanged = x > y
        x, y = np.minimum(x, y), np.maximum(x, y)
    places = np.stack([x, y], axis=-1).reshape(-1, 2)
    nodes, index = np.unique(places, axis=0, return_inverse=True)
    return nodes, index.reshape(x.shape), exchanged


def _nearest(tangents: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """For each node (U, 2), at each distance, the nearest that is `lit` (D, U)."""
    apart = np.sum((tangents[:, None] - tangents[None]) ** 2, axis=-1)
    return np.argmin(np.where(lit[:, None], apart[None], np.inf), axis=-1)


@functools.partial(jit, wanted=LARGE)
def _chief(lens: Lens, tangents: Array, distances: Array, wavelengths: Array) -> Array:
    def one(distance: Array, tangent: Array) -> Array:
        scene = scene_of(lens, jnp.arctan(tangent), distance, wavelengths)
        centre = jnp.zeros(1, lens.curvature.dtype)
        bundle = trace_bundle(lens, scene, (centre, centre), solve_aimed)
        whole = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
        hits = jnp.concatenate([h[-1] for h in bundle.hits], axis=-1)
        return jnp.where(whole, hits, jnp.inf)

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(distances, tangents)


def image_points(lens: Lens, tangents: Any, distances: Any, wavelengths: Any) -> np.ndarray:
    """Where the chief rays of fields (U, 2), tangents, meet the sensor from distances (D,) mm:
    (D, U, W, 2) mm; inf where they fail. Known numbers."""
    dtype = lens.curvature.dtype
    waves = jnp.atleast_1d(real_array("wavelengths", wavelengths, dtype))
    return np.asarray(
        _chief(lens, jnp.asarray(tangents, dtype), jnp.asarray(distances, dtype), waves)
    )


@functools.partial(jit, wanted=LARGE)
def _spots(
    lens: Lens, tangents: Array, distances: Array, wavelengths: Array, rule: PupilRule
) -> Moments:
    def one(distance: Array, tangent: Array) -> Moments:
        scene = scene_of(lens, jnp.arctan(tangent), distance, wavelengths)
        return moments(lens, scene, rule, solve_aimed).at(lens.sensor)

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(distances, tangents)


def _look(lens: Lens, tangents: np.ndarray, far: np.ndarray, wavelengths: Any) -> Moments:
    """Spots of all fields (U, 2), tangents, from all distances: where light arrives."""
    dtype = lens.curvature.dtype
    waves = jnp.atleast_1d(real_array("wavelengths", wavelengths, dtype))
    rule = Gauss(_LOOK, "none")
    return _spots(lens, jnp.asarray(tangents, dtype), jnp.asarray(far, dtype), waves, rule)


def _some(tangents: np.ndarray, far: np.ndarray, arrives: np.ndarray) -> tuple[Any, Any]:
    """Fields (F, 2), radians, and distances for which a model of kernels is chosen: the farthest of
    which light arrives, one between, and the axis."""
    every = np.all(arrives, axis=0)
    lit = tangents[every if np.any(every) else np.any(arrives, axis=0)]
    order = lit[np.argsort(np.sum(lit**2, axis=1))]
    some = order[[-1, len(order) // 2, 0]]
    # Turned a little out of the planes in which half of a pupil would do.
    angles = np.arctan(some + 1e-6 * max(np.max(np.abs(some)), 1e-3))
    return angles, np.unique([far[0], far[-1]])


def kernel_grid(lens: Lens, method: GridMethod, wavelengths: Numbers) -> KernelGrid:
    """The kernels of a lens over field and depth. Differentiable in the lens; inside `jax.jit`,
    too. `wavelengths` (W,), um."""
    waves = jnp.atleast_1d(lens.checked_wavelengths(wavelengths))
    return _kernel_grid(lens, method, waves)


@functools.partial(jit, wanted=LARGE)
def _kernel_grid(lens: Lens, method: GridMethod, wavelengths: Array) -> KernelGrid:
    nodes, index, exchanged = _unique(method.half, method.symmetry)
    tangents = jnp.asarray(nodes, method.step.dtype) * method.step

    def one(given: tuple[Array, Array]) -> tuple[Array, ...]:
        return _record(lens, method, given[1], given[0], wavelengths)

    # One after the other: the rays of a kernel are many, and all at once would not fit the cache.
    pairs = (len(method.distances), len(nodes))
    every = (
        jnp.repeat(method.distances, pairs[1]),
        jnp.tile(tangents, (pairs[0], 1)),
    )
    found = jax.lax.map(jax.checkpoint(one), every)
    found = tuple(a.reshape(*pairs, *a.shape[1:]) for a in found)
    points, solid_angle, outside, kernels = found
    # Beyond the light a point lies as much too near or far as the nearest that there is.
    finite = jnp.isfinite(points)
    points = jnp.where(finite, points, 0)
    near = jnp.take_along_axis(points, method.nearest[:, :, None, None], axis=1)
    squared = jnp.sum(tangents**2, axis=-1)[method.nearest]
    along = jnp.sum(near * tangents[method.nearest][:, :, None], axis=-1)
    ratio = along / jnp.where(squared > 0, squared, 1)[..., None]
    guess = ratio[..., None] * tangents[None, :, None]
    is_there = method.nearest == jnp.arange(len(nodes), dtype=jnp.int32)[None]
    points = jnp.where(is_there[:, :, None, None] & finite, points, guess)

    def placed(values: Array) -> Array:
        return values[:, index]

    swap = jnp.asarray(exchanged)
    points, kernels = placed(points), placed(kernels)
    points = jnp.where(swap[None, ..., None, None], points[..., ::-1], points)
    kernels = jnp.where(swap[None, ..., None, None, None], jnp.swapaxes(kernels, -1, -2), kernels)
    y, x = (np.arange(-n, n + 1) < 0 for n in method.half)
    if method.symmetry != "none":
        left = jnp.asarray(np.broadcast_to(x[None], exchanged.shape))[None, ..., None]
        points = points * jnp.where(left[..., None], jnp.array([-1.0, 1], points.dtype), 1)
        kernels = jnp.where(left[..., None, None], kernels[..., ::-1], kernels)
    if method.symmetry == "rotational":
        below = jnp.asarray(np.broadcast_to(y[:, None], exchanged.shape))[None, ..., None]
        points = points * jnp.where(below[..., None], jnp.array([1.0, -1], points.dtype), 1)
        kernels = jnp.where(below[..., None, None], kernels[..., ::-1, :], kernels)
    vergences = jax.vmap(vergence_of)(method.distances)
    return KernelGrid(method.step, vergences, points, placed(solid_angle), placed(outside), kernels)


def _record(
    lens: Lens, method: GridMethod, tangent: Array, distance: Array, wavelengths: Array
) -> tuple[Array, ...]:
    """Point (W, 2), solid angle, share outside (W,) and kernel (W, K, K) of an object point."""
    # About a centroid: off the middle, a point smaller than a pixel would be rounded.

    def some(waves: Array) -> tuple[Array, ...]:
        field = jnp.arctan(tangent)
        found = psf(lens, field, distance, waves, method.pixel, method.size, method.model)
        arrives = found.throughput > 0
        centre = jnp.where(arrives[:, None], found.centre[None], jnp.inf)
        return centre, found.solid_angle, found.outside, found.kernel

    if method.together:
        return some(wavelengths)
    return jax.tree.map(lambda a: a[:, 0], jax.vmap(some)(wavelengths[:, None]))


def kernels_at(grid: KernelGrid, fields: Numbers, distances: Numbers) -> Array:
    """Kernels (B, W, K, K) of B object points, interpolated.

    fields: (B, 2) angles along x and y, radians, within the grid; beyond it the kernels at its edge
        go on. distances: (B,) mm, or one; inf allowed.

    In field by polynomials through the four nearest nodes along each axis, in 1 / distance through
    as many of its nodes. Differentiable in the grid, the fields and the distances. ValueError for
    other shapes.
    """
    dtype = grid.kernels.dtype
    angles = real_array("fields", fields, dtype)
    far = real_array("distances", distances, dtype)
    if angles.ndim != 2 or angles.shape[1] != 2 or far.shape not in ((), angles.shape[:1]):
        raise ValueError(
            f"fields, distances: expected (B, 2) and (B,), got {angles.shape} and {far.shape}"
        )
    far = jnp.broadcast_to(far, angles.shape[:1])
    return jax.vmap(_kernel_at, (None, 0, 0))(grid, jnp.tan(angles), vergence_of(far))


def _kernel_at(grid: KernelGrid, tangent: Array, vergence: Array) -> Array:
    count, vergences = grid.kernels.shape[0], grid.vergences
    spacing = (vergences[-1] - vergences[0]) / max(count - 1, 1)
    depth = (vergence - vergences[0]) / jnp.where(spacing != 0, spacing, 1)
    places = [depth, *(tangent[k] / grid.step + n for k, n in zip((1, 0), grid.half))]
    table = grid.kernels
    parts = [
        lagrange(jnp.clip(place, 0, n - 1), n, _ORDER)
        for place, n in zip(places, table.shape[:3], strict=True)
    ]
    sizes = [weights.shape[0] for _, weights in parts]
    starts = [first for first, _ in parts] + [jnp.zeros((), jnp.int32)] * 3
    near = jax.lax.dynamic_slice(table, starts, (*sizes, *table.shape[3:]))
    return jnp.einsum("dyxwij,d,y,x->wij", near, *(weights for _, weights in parts))
