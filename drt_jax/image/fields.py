"""PSF kernels over the whole field and over depth, computed once on a small grid of object points.

The nodes are equidistant in the tangents of the field angles along x and y, and in 1 / distance.
For a rotationally symmetric lens only an eighth of the nodes is traced. Mirroring, and swapping x
and y, give the others; both are exact on pixels.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, vergence_of
from ..numerics import Numbers, brief, einsum, real_array
from ..pupil.rules import Symmetry
from ..rays.solve import solve_aimed
from ..rays.status import reaches_sensor
from ..rays.trace import trace_bundle
from .beam_psf import Sampling
from .interpolate import lagrange
from .psf import psf

# Number of nodes along each axis from which a kernel is interpolated.
_ORDER = 4


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class GridMethod:
    """Settings of the kernels over the field, made by `converge(kernel_grid, ...)`.

    step: (), spacing of the nodes, tangent of the field angle.
    distances: (D,), mm, equidistant in 1 / distance.
    pixel: (), side of a pixel, mm.
    sampling: of the kernels.
    nearest: (D, U), int32, for each traced node the index of the nearest traced node with light.
    half: number of nodes on each side of the axis, along y and x.
    size: number of pixels along a side of a kernel.
    symmetry: of the lens.
    together: see `grid_method`.
    """

    step: Array
    distances: Array
    pixel: Array
    sampling: Sampling
    nearest: Array
    half: tuple[int, int] = dataclasses.field(metadata={"static": True})
    size: int = dataclasses.field(metadata={"static": True})
    symmetry: Symmetry = dataclasses.field(metadata={"static": True})
    together: bool = dataclasses.field(default=False, metadata={"static": True})
    __repr__ = brief


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class KernelGrid:
    """PSF kernels of a lens at D distances, Ny x Nx fields and W wavelengths.

    step: (), spacing of the nodes, tangent of the field angle; the middle node is the axis.
    vergences: (D,), 1/mm, of the objects.
    points: (D, Ny, Nx, W, 2), mm, centres of the kernels on the sensor: the centroids of the light.
    solid_angle: (D, Ny, Nx, W), solid angle of the light on the sensor, as an area in direction
        cosines: irradiance = radiance x solid_angle.
    outside: (D, Ny, Nx, W), fraction of the light that falls outside of a kernel.
    kernels: (D, Ny, Nx, W, K, K) [y, x], with the sum 1 - outside; 0 where no light arrives.
    """

    step: Array
    vergences: Array
    points: Array
    solid_angle: Array
    outside: Array
    kernels: Array

    @property
    def half(self) -> tuple[int, int]:
        """Number of nodes on each side of the axis, along y and x."""
        return self.kernels.shape[1] // 2, self.kernels.shape[2] // 2

    def at(self, scene: Scene) -> Array:
        """Kernels of object points, interpolated.

        scene: the points; outside of the grid the kernels of its edge apply. Its wavelengths do
            not count: they are those of the grid.

        Returns (..., W, K, K). Interpolation uses polynomials through the four nearest nodes along
        x, y and 1 / distance, or through all nodes if there are fewer. Differentiable in the grid,
        the fields and the distances.
        """
        fields, far = (a.astype(self.kernels.dtype) for a in scene.flat())
        found = jax.vmap(_kernel_at, (None, 0, 0))(self, jnp.tan(fields), vergence_of(far))
        return found.reshape(*scene.shape, *found.shape[1:])


def unique_nodes(half: tuple[int, int], symmetry: Symmetry) -> tuple[np.ndarray, ...]:
    """Nodes that must be traced, and how they give all nodes of the grid.

    half: number of nodes on each side of the axis, along y and x.
    symmetry: of the lens.

    Returns the traced nodes (U, 2), x and y in steps; and for each node of the grid (Ny, Nx) the
    index of its traced node, and whether x and y are swapped there.
    """
    y, x = np.meshgrid(*(np.arange(-n, n + 1) for n in half), indexing="ij")
    swapped = np.zeros(x.shape, bool)
    if symmetry != "none":
        x = np.abs(x)
    if symmetry == "rotational":
        y = np.abs(y)
        swapped = x > y
        x, y = np.minimum(x, y), np.maximum(x, y)
    places = np.stack([x, y], axis=-1).reshape(-1, 2)
    nodes, index = np.unique(places, axis=0, return_inverse=True)
    return nodes, index.reshape(x.shape), swapped


@functools.partial(jit, wanted=LARGE)
def _chief(lens: Lens, tangents: Array, distances: Array, wavelengths: Array) -> Array:
    """`image_points` of arrays."""

    def one(distance: Array, tangent: Array) -> Array:
        scene = Scene(jnp.arctan(tangent), distance, wavelengths)
        centre = jnp.zeros(1, lens.curvature.dtype)
        bundle = trace_bundle(lens, scene, (centre, centre), solve_aimed)
        whole = reaches_sensor(bundle.status)
        hits = jnp.concatenate([h[-1] for h in bundle.hits], axis=-1)
        return jnp.where(whole, hits, jnp.inf)

    return jax.vmap(jax.vmap(one, (None, 0)), (0, None))(distances, tangents)


def image_points(lens: Lens, tangents: Any, distances: Any, wavelengths: Any) -> np.ndarray:
    """Points where chief rays meet the sensor.

    lens: the lens.
    tangents: (U, 2), tangents of the field angles.
    distances: (D,), mm.
    wavelengths: (W,), um.

    Returns (D, U, W, 2), mm, as a NumPy array; inf where a chief ray fails. The numbers must be
    known.
    """
    dtype = lens.curvature.dtype
    waves = jnp.atleast_1d(real_array("wavelengths", wavelengths, dtype))
    return np.asarray(
        _chief(lens, jnp.asarray(tangents, dtype), jnp.asarray(distances, dtype), waves)
    )


def kernel_grid(lens: Lens, wavelengths: Numbers, sampling: GridMethod) -> KernelGrid:
    """The PSF kernels of a lens over field and depth.

    lens: the lens.
    wavelengths: (W,), um.
    sampling: fields, distances and rays, which `converge(kernel_grid, ...)` chooses.

    Returns a `KernelGrid`. Works inside `jax.jit`; differentiable in the lens.
    """
    waves = jnp.atleast_1d(lens.checked_wavelengths(wavelengths))
    return _kernel_grid(lens, sampling, waves)


@functools.partial(jit, wanted=LARGE)
def _kernel_grid(lens: Lens, method: GridMethod, wavelengths: Array) -> KernelGrid:
    """`kernel_grid` of arrays: traces the unique nodes, then mirrors and swaps them."""
    nodes, index, swapped = unique_nodes(method.half, method.symmetry)
    tangents = jnp.asarray(nodes, method.step.dtype) * method.step

    def one(pair: tuple[Array, Array]) -> tuple[Array, ...]:
        return _kernel_of(lens, method, pair[1], pair[0], wavelengths)

    # One object point at a time: the rays of all kernels together would not fit into the cache.
    pairs = (len(method.distances), len(nodes))
    every = (
        jnp.repeat(method.distances, pairs[1]),
        jnp.tile(tangents, (pairs[0], 1)),
    )
    found = jax.lax.map(jax.checkpoint(one), every)
    found = tuple(a.reshape(*pairs, *a.shape[1:]) for a in found)
    points, solid_angle, outside, kernels = found
    # A node without light gets an extrapolated image point: its tangent times the ratio of image
    # point to tangent of the nearest node with light.
    finite = jnp.isfinite(points)
    points = jnp.where(finite, points, 0)
    near = jnp.take_along_axis(points, method.nearest[:, :, None, None], axis=1)
    squared = jnp.sum(tangents**2, axis=-1)[method.nearest]
    along = jnp.sum(near * tangents[method.nearest][:, :, None], axis=-1)
    ratio = along / jnp.where(squared > 0, squared, 1)[..., None]
    guess = ratio[..., None] * tangents[None, :, None]
    has_light = method.nearest == jnp.arange(len(nodes), dtype=jnp.int32)[None]
    points = jnp.where(has_light[:, :, None, None] & finite, points, guess)

    def full(values: Array) -> Array:
        return values[:, index]

    swap = jnp.asarray(swapped)
    points, kernels = full(points), full(kernels)
    points = jnp.where(swap[None, ..., None, None], points[..., ::-1], points)
    kernels = jnp.where(swap[None, ..., None, None, None], jnp.swapaxes(kernels, -1, -2), kernels)
    y, x = (np.arange(-n, n + 1) < 0 for n in method.half)
    if method.symmetry != "none":
        left = jnp.asarray(np.broadcast_to(x[None], swapped.shape))[None, ..., None]
        points = points * jnp.where(left[..., None], jnp.array([-1.0, 1], points.dtype), 1)
        kernels = jnp.where(left[..., None, None], kernels[..., ::-1], kernels)
    if method.symmetry == "rotational":
        below = jnp.asarray(np.broadcast_to(y[:, None], swapped.shape))[None, ..., None]
        points = points * jnp.where(below[..., None], jnp.array([1.0, -1], points.dtype), 1)
        kernels = jnp.where(below[..., None, None], kernels[..., ::-1, :], kernels)
    vergences = jax.vmap(vergence_of)(method.distances)
    return KernelGrid(method.step, vergences, points, full(solid_angle), full(outside), kernels)


def _kernel_of(
    lens: Lens, method: GridMethod, tangent: Array, distance: Array, wavelengths: Array
) -> tuple[Array, ...]:
    """Centre (W, 2), mm, solid angle (W,), outside (W,), and kernel (W, K, K) of one object
    point."""
    # Each kernel is centred on the centroid of its light: rounding would spoil a spot smaller than
    # a pixel that is far off centre.

    def traced(waves: Array) -> tuple[Array, ...]:
        scene = Scene(jnp.arctan(tangent), distance, waves)
        found = psf(lens, scene, method.pixel, method.size, sampling=method.sampling)
        arrives = found.throughput > 0
        centre = jnp.where(arrives[:, None], found.centre[None], jnp.inf)
        return centre, found.solid_angle, found.outside, found.kernel

    if method.together:
        return traced(wavelengths)
    return jax.tree.map(lambda a: a[:, 0], jax.vmap(traced)(wavelengths[:, None]))


def _kernel_at(grid: KernelGrid, tangent: Array, vergence: Array) -> Array:
    """Kernel (W, K, K) at one field, given by its tangents (2,), and one vergence, 1/mm."""
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
    return einsum("dyxwij,d,y,x->wij", near, *(weights for _, weights in parts))
