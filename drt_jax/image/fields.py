"""PSF kernels over the whole field and over depth, computed once on a small grid of object points;
and the choice of this grid.

The nodes are equidistant in the tangents of the field angles along x and y, and in 1 / distance.
For a rotationally symmetric lens only an eighth of the nodes is traced. Mirroring, and swapping x
and y, give the others; both are exact on pixels.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points, vergence_of
from ..numerics import Numbers, brief, einsum
from ..pupil.rules import Gauss, Symmetry, symmetry_of
from ..rays.solve import solve_aimed
from .beam_psf import Kind, Sampling
from .interpolate import lagrange
from .kernel import check_pixels
from .moments import moments
from .psf import chosen_psf, psf
from .refined import require_known
from .rounding import check_dtype
from .spot import Moments

# Number of nodes along each axis from which a kernel is interpolated.
_ORDER = 4
# Numbers of pixels along a side of a kernel to choose from.
_SIZES = (9, 13, 17, 21, 25, 33, 41, 49, 65, 97, 129)
# Half the side of a kernel, in standard deviations of the blur.
_REACH = 4.5
# Default tolerance: the sum of the absolute errors of a kernel's pixels.
_TOLERANCE = 5e-3
# Order of the rule that tests for which fields light arrives.
_TEST_ORDER = 8
# For each symmetry: how an image point (..., 2), and how a kernel [y, x], follows from another.
_TURNS: tuple[tuple[Callable, Callable], ...] = (
    (lambda point: point[..., ::-1], lambda kernel: jnp.swapaxes(kernel, -1, -2)),
    (lambda p: jnp.stack([-p[..., 0], p[..., 1]], -1), lambda kernel: kernel[..., ::-1]),
    (lambda p: jnp.stack([p[..., 0], -p[..., 1]], -1), lambda kernel: kernel[..., ::-1, :]),
)


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

    Returns the traced nodes (U, 2), x and y in steps; and for each node of the grid the index
    (Ny, Nx) of its traced node, and (3, Ny, Nx) whether its x and y are swapped, its x is mirrored
    and its y is mirrored, in this order, see `_TURNS`.
    """
    y, x = np.meshgrid(*(np.arange(-n, n + 1) for n in half), indexing="ij")
    turned = np.zeros((3, *x.shape), bool)
    if symmetry != "none":
        turned[1], x = x < 0, np.abs(x)
    if symmetry == "rotational":
        turned[2], y = y < 0, np.abs(y)
        turned[0] = x > y
        x, y = np.minimum(x, y), np.maximum(x, y)
    places = np.stack([x, y], axis=-1).reshape(-1, 2)
    nodes, index = np.unique(places, axis=0, return_inverse=True)
    return nodes, index.reshape(x.shape), turned


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
    """`kernel_grid` of arrays. Only the unique nodes are traced; every node of the grid is then a
    copy of one of them, whose x and y are swapped or mirrored, see `unique_nodes`."""
    nodes, index, turned = unique_nodes(method.half, method.symmetry)
    tangents = jnp.asarray(nodes, method.step.dtype) * method.step

    def traced(waves: Array) -> tuple[Array, ...]:
        """Centres (D, U, W, 2), mm, solid angles, light outside and kernels of all nodes."""
        scene = Scene.grid(jnp.arctan(tangents), method.distances, waves)
        found = psf(lens, scene, method.pixel, method.size, sampling=method.sampling)
        arrives = (found.throughput > 0)[..., None]
        centre = jnp.where(arrives, found.centre[..., None, :], jnp.inf)
        return centre, found.solid_angle, found.outside, found.kernel

    if method.together:
        points, *others = traced(wavelengths)
    else:
        # Each kernel is centred on the centroid of its light: rounding would spoil a spot smaller
        # than a pixel that is far off centre.
        each = jax.vmap(traced, out_axes=2)(wavelengths[:, None])
        points, *others = (a[:, :, :, 0] for a in each)
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

    points, solid_angle, outside, kernels = (a[:, index] for a in (points, *others))
    for here, (turned_point, turned_kernel) in zip(turned, _TURNS):
        here = np.expand_dims(here, (0, 3, 4))
        points = jnp.where(here, turned_point(points), points)
        kernels = jnp.where(here[..., None], turned_kernel(kernels), kernels)
    vergences = jax.vmap(vergence_of)(method.distances)
    return KernelGrid(method.step, vergences, points, solid_angle, outside, kernels)


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
    scene: its largest angles along x and y are the extent of the grid; its distances, as of
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
    known = require_known((lens, scene, pixel), "the choice of fields", "kernel_grid")
    with jax.core.eval_context():
        lens, scene, pixel = known
        scene = checked_scene(lens, scene)
        pixel = check_pixels(pixel, 1, lens.curvature.dtype).side
        whole = isinstance(size, int | np.integer) and size > 0 and size % 2
        require(size is None or whole, f"size: expected an odd number of pixels, got {size!r}")
        enough = isinstance(nodes, int | np.integer) and nodes >= 2
        require(enough, f"nodes: expected a whole number from 2 on, got {nodes!r}")
        far = np.ravel(np.asarray(scene.distance, float))
        wide = np.tan(np.max(np.abs(np.asarray(scene.field, float).reshape(-1, 2)), axis=0))
        require(np.max(wide) > 0, "fields: expected one beside the axis")
        step = float(np.max(wide)) / nodes
        across, down = (max(2, int(np.ceil(a / step - 1e-9))) for a in wide)
        half = down, across
        symmetry = symmetry_of(lens, 0.0)
        tangents = unique_nodes(half, symmetry)[0] * step
        grid = Scene.grid(np.arctan(tangents), far, scene.wavelengths)
        found = _spots(lens, checked_scene(lens, grid))
        arrives = np.all(np.asarray(found.throughput) > 0, axis=-1)
        require(np.any(arrives), "fields: no light of any of them reaches the sensor")
        if size is None:
            sigma = np.sqrt(np.diagonal(np.asarray(found.covariance), 0, -2, -1))[arrives]
            need = 2 * int(np.ceil(_REACH * np.max(sigma) / float(pixel))) + 1
            size = next((n for n in _SIZES if n >= need), _SIZES[-1])
        if not isinstance(sampling, Sampling):
            where = Scene.grid(*_extremes(tangents, far, arrives), scene.wavelengths)
            # No warning here of light outside of these kernels: the nodes may lose more.
            bound = sampling
            sampling, view = chosen_psf(lens, where, pixel, size, kind, bound, norm)
            check_dtype(lens, "kernels", view.rounded, bound, "")
        # For each node, the nearest one with light.
        squared = np.sum((tangents[:, None] - tangents[None]) ** 2, axis=-1)
        nearest = np.argmin(np.where(arrives[:, None], squared[None], np.inf), axis=-1)
        step_, far_ = (jnp.asarray(a, lens.curvature.dtype) for a in (step, far))
        near = jnp.asarray(nearest, jnp.int32)
        return GridMethod(step_, far_, pixel, sampling, near, half, size, symmetry, together)


@functools.partial(jit, wanted=LARGE)
def _spots(lens: Lens, scene: Scene) -> Moments:
    """`Moments` of object points, which show where light arrives."""
    rule = Gauss(_TEST_ORDER, "none")
    one = lambda point: moments(lens, point, rule, solve_aimed).at(lens.sensor)  # noqa: E731
    return over_points(one, scene)


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
