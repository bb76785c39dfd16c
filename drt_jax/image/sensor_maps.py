"""What a sensor sees through a lens: the source of each of its points, its light, its kernel.

Of few places of the sensor, from a grid of fields; `render` interpolates between them.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..numerics import Numbers, safe_divide
from .fields import GridMethod, KernelGrid, kernel_grid
from .interpolate import at_point, lagrange

# Nodes that a place, and a kernel or its light, are interpolated from along each axis.
SMOOTH, LOCAL = 6, 4
_NEWTON = 6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RenderMethod:
    """How a picture is rendered: what `render_method` chose, to be passed on.

    grid: fields, distances and rays of the kernels. focal: () mm, of the pinhole that sees the
    ideal picture. shape: of the picture, tile: of its tiles, height and width.
    """

    grid: GridMethod
    focal: Array
    shape: tuple[int, int] = dataclasses.field(metadata={"static": True})
    tile: tuple[int, int] = dataclasses.field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Maps:
    """What the sensor sees from D distances in C colours.

    sources: (D, C, My, Mx, 2), pixels x and y of the ideal picture, at equidistant places of the
        sensor. light: (D, C, My, Mx), solid angle there relative to the axis.
    kernels: (D, Cy, Cx, C, K, K), G at the corners of the tiles.
    """

    sources: Array
    light: Array
    kernels: Array


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
    return jax.vmap(functools.partial(_maps_of, method, grid.step))(
        grid.points, grid.solid_angle, grid.outside, grid.kernels
    )


def _maps_of(
    method: RenderMethod, step: Array, points: Array, light: Array, outside: Array, kernels: Array
) -> Maps:
    """Of one distance; the arguments are those of a `KernelGrid`, (Ny, Nx, ...)."""
    dtype, pixel = step.dtype, method.grid.pixel
    middle = (np.array(method.shape) - 1) / 2
    half = jnp.asarray(method.grid.half[::-1], dtype)
    axis = light[method.grid.half[0], method.grid.half[1]]  # (C,)
    scale = method.focal / pixel
    place = functools.partial(_source, method)

    def over(y: np.ndarray, x: np.ndarray) -> Array:
        across, down = np.meshgrid(x - middle[1], y - middle[0])
        return jnp.asarray(np.stack([across, down], -1), dtype) * pixel

    def colour(points: Array, light: Array, outside: Array, kernels: Array, axis: Array):
        table = points / (step * method.focal)  # so that it is about the node's own place
        find = lambda p: place(table, p / (step * method.focal))[0]  # noqa: E731
        nodes = jax.vmap(jax.vmap(find))(over(*controls(method)))
        sources = nodes * step * scale + jnp.asarray(middle[::-1], dtype).reshape(1, 1, 2)
        level = jax.vmap(jax.vmap(lambda u: at_point(light, u + half, LOCAL)))(nodes)
        corners = over(*(np.arange(n + 1) * t for n, t in zip(tiles_of(method), method.tile)))
        turned = functools.partial(_seen, method, step, table, light, outside, kernels)
        seen = jax.lax.map(jax.checkpoint(jax.vmap(turned)), corners)  # all at once take room
        return sources, jnp.maximum(level, 0) / jnp.where(axis > 0, axis, 1), seen

    moved = [jnp.moveaxis(a, 2, 0) for a in (points, light, outside, kernels)]
    sources, level, seen = jax.vmap(colour)(moved[0], moved[1], moved[2], moved[3], axis)
    return Maps(sources, level, jnp.moveaxis(seen, 0, 2))


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
    places = jnp.clip(moved, 0, end.reshape(1, 1, 2))
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
