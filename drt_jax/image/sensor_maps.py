"""What a sensor sees through a lens: the source of each of its points, its light, its kernel.

Of few places of the sensor, from a grid of fields; `render` interpolates between them. The kernels
of all places are nearly sums of those of a few: of the places that `chosen_places` finds.
"""

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..numerics import Numbers, safe_divide, safe_sqrt
from .fields import GridMethod, KernelGrid, kernel_grid, warn_of_loss
from .interpolate import at_point, lagrange

# Nodes that a place, and a kernel or its light, are interpolated from along each axis.
SMOOTH, LOCAL = 6, 4
_NEWTON = 6
# The most kernels that a picture is blurred with.
_MOST = 40
# Kernels that differ by fewer roundings are the same.
_ALIKE = 8


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RenderMethod:
    """How a picture is rendered: what `render_method` chose, to be passed on.

    grid: fields, distances and rays of the kernels. focal: () mm, of the pinhole that sees the
    ideal picture. places: (R,), of those in `controls`, row by row, whose kernels stand for all.
    shape: of the picture, tile: of its tiles, height and width.
    """

    grid: GridMethod
    focal: Array
    places: Array
    shape: tuple[int, int] = dataclasses.field(metadata={"static": True})
    tile: tuple[int, int] = dataclasses.field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Maps:
    """What the sensor sees from D distances in C colours.

    sources: (D, C, My, Mx, 2), pixels x and y of the ideal picture, at equidistant places of the
        sensor. light: (D, C, My, Mx), solid angle there relative to the axis.
    kernels: (D, C, R, K, K), orthonormal. shares: (D, C, R, My, Mx): G at a place is the sum of
        the kernels times their shares there.
    """

    sources: Array
    light: Array
    kernels: Array
    shares: Array


def sensor_maps(lens: Lens, method: RenderMethod, wavelengths: Numbers) -> Maps:
    """What the sensor sees; the part of `render` that depends on the lens."""
    grid = kernel_grid(lens, method.grid, wavelengths)
    return _maps(grid, method)


def controls(method: RenderMethod) -> tuple[np.ndarray, np.ndarray]:
    """Places (My,), (Mx,) of the maps, pixels of the sensor."""
    margin = method.grid.size // 2 + 1
    found = []
    for count, half in zip(method.shape, method.grid.half, strict=True):
        number = max(2 * SMOOTH, 4 * half + 1)
        found.append(np.linspace(-margin, count - 1 + margin, number))
    return found[0], found[1]


def tiles_of(method: RenderMethod) -> tuple[int, int]:
    (height, width), (down, across) = method.shape, method.tile
    return -(-height // down), -(-width // across)


@functools.partial(jit, wanted=LARGE)
def _maps(grid: KernelGrid, method: RenderMethod) -> Maps:
    colours, far = grid.solid_angle.shape[-1], len(grid.vergences)

    def one(index: Array) -> tuple[Array, ...]:
        sources, light, seen = _view(grid, method, index // colours, index % colours)
        return sources, light, *_parts(seen, method.places)

    # One after the other: the kernels of all places at once take room.
    found = jax.lax.map(jax.checkpoint(one), jnp.arange(far * colours, dtype=jnp.int32))
    return Maps(*(a.reshape(far, colours, *a.shape[1:]) for a in found))


def _parts(seen: Array, places: Array) -> tuple[Array, Array]:
    """Kernels (R, K, K) and shares (R, My, Mx) of G (My, Mx, K, K): an orthonormal basis of the
    kernels of `places`, and G projected on it, each scaled so that its sum stays."""
    down, across, size = seen.shape[:3]
    rows = seen.reshape(down * across, size * size)
    basis = jnp.zeros((len(places), rows.shape[1]), rows.dtype)
    for k in range(len(places)):
        row = rows[places[k]]
        rest = row - (basis @ row) @ basis
        rest = rest - (basis @ rest) @ basis
        length, whole = (safe_sqrt(jnp.sum(a * a)) for a in (rest, row))
        there = length > _ALIKE * jnp.finfo(rows.dtype).eps * whole
        basis = basis.at[k].set(jnp.where(there, safe_divide(rest, length[None]), 0))
    shares = rows @ basis.T
    sums = jnp.sum(rows, axis=1), shares @ jnp.sum(basis, axis=1)
    shares = shares * safe_divide(*sums)[:, None]
    return basis.reshape(-1, size, size), shares.T.reshape(-1, down, across)


def chosen_places(
    lens: Lens, method: RenderMethod, wavelengths: Numbers, tolerance: float
) -> np.ndarray:
    """Places (R,) whose kernels give back those of all places, at all distances, but for
    `tolerance`: the root of the sum of the squared errors of a kernel's pixels, which is what a
    picture of white noise of variance 1 is off. Known numbers. Warns of light beside the kernels,
    and of too many."""
    grid = kernel_grid(lens, method.grid, wavelengths)
    warn_of_loss(lens, method.grid, grid, wavelengths)
    chosen: list[int] = []
    left = 0.0
    for distance in range(len(grid.vergences)):
        for colour in range(grid.solid_angle.shape[-1]):
            seen = np.asarray(_seen_of(grid, method, distance, colour), float)
            rows = seen.reshape(-1, method.grid.size**2)
            basis: list[np.ndarray] = []
            while True:
                # Those that others needed first, then the place that is worst off.
                errors = np.linalg.norm(rows, axis=1)
                if len(basis) == len(chosen):
                    if np.max(errors) <= tolerance or len(chosen) == _MOST:
                        left = max(left, float(np.max(errors)))
                        break
                    chosen.append(int(np.argmax(errors)))
                row = rows[chosen[len(basis)]]
                length = np.linalg.norm(row)
                basis.append(row / length if length > 0 else row)
                rows = rows - np.outer(rows @ basis[-1], basis[-1])
    if left > tolerance:
        warnings.warn(
            f"{_MOST} kernels give back those of the picture to {left:.1e} only, not to "
            f"{tolerance:.1e}: take larger pixels or a larger tolerance",
            stacklevel=3,
        )
    return np.array(chosen or [0])


@functools.partial(jit, wanted=LARGE)
def _seen_of(grid: KernelGrid, method: RenderMethod, distance: Array, colour: Array) -> Array:
    return _view(grid, method, distance, colour)[2]


def _view(
    grid: KernelGrid, method: RenderMethod, distance: Array, colour: Array
) -> tuple[Array, Array, Array]:
    """Sources (My, Mx, 2), light (My, Mx) and G (My, Mx, K, K) of one distance and colour."""
    step, pixel = grid.step, method.grid.pixel
    table, light, outside, kernels = (
        a[distance][:, :, colour]
        for a in (grid.points, grid.solid_angle, grid.outside, grid.kernels)
    )
    dtype, middle = step.dtype, (np.array(method.shape) - 1) / 2
    half = jnp.asarray(method.grid.half[::-1], dtype)
    axis = light[method.grid.half[0], method.grid.half[1]]
    unit = step * method.focal
    table = table / unit  # so that it is about the node's own place
    down, across = controls(method)
    places = np.stack(np.meshgrid(across - middle[1], down - middle[0]), -1)
    wanted = jnp.asarray(places, dtype) * pixel
    nodes = jax.vmap(jax.vmap(lambda p: _source(method, table, p / unit)[0]))(wanted)
    sources = nodes * (unit / pixel) + jnp.asarray(middle[::-1], dtype).reshape(1, 1, 2)
    level = jax.vmap(jax.vmap(lambda u: at_point(light, u + half, LOCAL)))(nodes)
    seen = functools.partial(_seen, method, step, table, light, outside, kernels)
    turned = jax.lax.map(jax.checkpoint(jax.vmap(seen)), wanted)  # all at once take room
    return sources, jnp.maximum(level, 0) / jnp.where(axis > 0, axis, 1), turned


def _source(method: RenderMethod, table: Array, wanted: Array) -> tuple[Array, Array]:
    """The place (2,), in nodes from the axis, whose image point is `wanted` (2,), and how it
    moves with that (2, 2): Newton's method on the interpolated points, table (Ny, Nx, 2)."""
    half = jnp.asarray(method.grid.half[::-1], table.dtype)

    def image(u: Array) -> Array:
        return at_point(table, u + half, SMOOTH)

    def inverse(u: Array) -> Array:
        (a, b), (c, d) = jax.jacfwd(image)(u)
        size = a * d - b * c
        return safe_divide(jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]), size[None, None])

    u = jnp.clip(wanted, -half, half)
    for _ in range(_NEWTON):
        u = jnp.clip(u - inverse(u) @ (image(u) - wanted), -half - 1, half + 1)
    return u, inverse(u)


def _seen(
    method: RenderMethod,
    step: Array,
    table: Array,
    light: Array,
    outside: Array,
    kernels: Array,
    corner: Array,
) -> Array:
    """G (K, K) of a sensor point (2,), mm: at k the kernel of the source of the point k before it,
    times the light there."""
    size = method.grid.size
    unit = step * method.focal
    u, slope = _source(method, table, corner / unit)
    k = np.arange(size) - size // 2
    shift = jnp.asarray(np.stack(np.meshgrid(k, k), -1), u.dtype) * (method.grid.pixel / unit)
    half = jnp.asarray(method.grid.half[::-1], u.dtype)
    end = 2 * half
    moved = (u + half).reshape(1, 1, 2) - jnp.einsum("ab,yxb->yxa", slope, shift)
    # Half a step beyond the nodes, where light from outside of the picture comes from.
    places = jnp.clip(moved, -0.5, end.reshape(1, 1, 2) + 0.5)
    down, across = table.shape[:2]
    (row, wy), (column, wx) = (
        lagrange(places[..., 1], down, LOCAL),
        lagrange(places[..., 0], across, LOCAL),
    )
    values = (kernels * light[..., None, None]).reshape(down * across, size * size)
    own = jnp.arange(size * size, dtype=jnp.int32).reshape(size, size)
    total = jnp.zeros((size, size), u.dtype)
    for i in range(wy.shape[-1]):
        for j in range(wx.shape[-1]):
            taken = values[(row + i) * across + column + j, own]
            total = total + wy[..., i] * wx[..., j] * taken
    kept = 1 - at_point(outside, jnp.clip(u + half, 0, end), LOCAL)
    return safe_divide(total, jnp.sum(total, keepdims=True)) * kept
