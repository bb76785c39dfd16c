"""What a sensor sees through a lens: the source of each of its points, its light, its kernel.

Of few places of the sensor, from a grid of fields; `render` interpolates between them. Kernels
vary in one of two ways. Those of all places are nearly sums of those of a few places; or a tile
blends those of its four corners. Few pixels or a small blur ask for the first, large pictures for
the second; `chosen` takes what costs less for a tolerance.
"""

import dataclasses
import functools
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..numerics import Numbers, brief, einsum, matmul, safe_divide, safe_sqrt
from .blur import SIDES
from .fields import GridMethod, KernelGrid, kernel_grid
from .grid_method import warn_of_loss
from .interpolate import at_point, lagrange

# Nodes that a place, and a kernel or its light, are interpolated from along each axis.
SMOOTH, LOCAL = 6, 4
_NEWTON = 6
# The side of the squares that are transformed with kernels of places, unless these are large.
_SIDE = 256
# The most kernels that a picture is blurred with.
_MOST = 40
# Kernels that differ by fewer roundings are the same.
_ALIKE = 8


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RenderMethod:
    """How a picture is rendered: what `render_method` chose, to be passed on.

    grid: fields, distances and rays of the kernels.
    focal: () mm, of the pinhole that sees the ideal picture.
    places: (R,), of those in `controls`, row by row, whose kernels stand for all; none: those at
        the corners of tiles do.
    shape: of the picture, height and width.
    tile: of its tiles, height and width.
    """

    grid: GridMethod
    focal: Array
    places: Array
    shape: tuple[int, int] = dataclasses.field(metadata={"static": True})
    tile: tuple[int, int] = dataclasses.field(metadata={"static": True})
    __repr__ = brief


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Maps:
    """What the sensor sees from D distances in C colours.

    sources: (D, C, My, Mx, 2), pixels x and y of the ideal picture, at equidistant places of the
        sensor. light: (D, C, My, Mx), solid angle there relative to the axis.
    kernels: (D, C, R, K, K), orthonormal. shares: (D, C, R, My, Mx): G at a place is the sum of
        the kernels times their shares there. Or (D, C, Cy, Cx, K, K), G at the corners of tiles,
        and None.
    """

    sources: Array
    light: Array
    kernels: Array
    shares: Array | None


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
    """The number of tiles down and across the picture; the last of each may reach beyond it."""
    (height, width), (down, across) = method.shape, method.tile
    return -(-height // down), -(-width // across)


@functools.partial(jit, wanted=LARGE)
def _maps(grid: KernelGrid, method: RenderMethod) -> Maps:
    colours, far = grid.solid_angle.shape[-1], len(grid.vergences)
    few = len(method.places) > 0
    y, x = (np.arange(n + 1) * t for n, t in zip(tiles_of(method), method.tile, strict=True))
    where = controls(method) if few else (y, x)

    def one(index: Array) -> tuple[Array, Array, Array, Array | None]:
        part = index // colours, index % colours
        seen = _seen_at(grid, method, *part, where)
        kernels, shares = _parts(seen, method.places) if few else (seen, None)
        return *_lit(grid, method, *part), kernels, shares

    # One after the other: the kernels of all places at once take room.
    found = jax.lax.map(jax.checkpoint(one), jnp.arange(far * colours, dtype=jnp.int32))
    return Maps(*jax.tree.map(lambda a: a.reshape(far, colours, *a.shape[1:]), found))


def _parts(seen: Array, places: Array) -> tuple[Array, Array]:
    """Kernels (R, K, K) and shares (R, My, Mx) of G (My, Mx, K, K): an orthonormal basis of the
    kernels of `places`, and G projected on it so that its sum stays and its centroid nearly."""
    down, across, size = seen.shape[:3]
    rows = seen.reshape(down * across, size * size)
    basis = jnp.zeros((len(places), rows.shape[1]), rows.dtype)
    for k in range(len(places)):
        row = rows[places[k]]
        rest = row - matmul(matmul(basis, row), basis)
        rest = rest - matmul(matmul(basis, rest), basis)
        length, whole = (safe_sqrt(jnp.sum(a * a)) for a in (rest, row))
        there = length > _ALIKE * jnp.finfo(rows.dtype).eps * whole
        basis = basis.at[k].set(jnp.where(there, safe_divide(rest, length[None]), 0))
    shares = matmul(rows, basis.T)
    # Shares change a little, so that the sum and the first moments, in pixels, stay: they decide
    # where a point lands, and how moments vary over the picture what light it brings.
    side = np.arange(size) - size // 2
    x, y = (np.ravel(a) for a in np.meshgrid(side, side))
    moments = jnp.asarray(np.stack([np.full_like(x, size), x, y], -1), rows.dtype)
    own = matmul(basis, moments)
    missing = matmul(rows, moments) - matmul(shares, own)
    square = jnp.eye(3, dtype=own.dtype) + matmul(own.T, own)
    shares = shares + matmul(missing, jnp.linalg.solve(square, own.T))
    sums = jnp.sum(rows, axis=1), matmul(shares, jnp.sum(basis, axis=1))
    shares = shares * safe_divide(*sums)[:, None]
    return basis.reshape(-1, size, size), shares.T.reshape(-1, down, across)


def chosen(
    lens: Lens, method: RenderMethod, wavelengths: Numbers, tolerance: float
) -> RenderMethod:
    """The method with the places, or the tiles, that cost least for a `tolerance` of G: the root of
    the sum of the squared errors of its pixels, which is what a picture of white noise of variance
    1 is off. Known numbers. Warns of light beside the kernels, and of an error that is larger."""
    grid = kernel_grid(lens, method.grid, wavelengths)
    warn_of_loss(lens, method.grid, grid, wavelengths)
    places: list[int] = []
    bent = left = 0.0
    for distance in range(len(grid.vergences)):
        for colour in range(grid.solid_angle.shape[-1]):
            seen = np.asarray(_seen_of(grid, method, distance, colour), float)
            bent = max(bent, _bent(seen, controls(method)))
            left = max(left, _choose(seen.reshape(-1, method.grid.size**2), places, tolerance))
    size = method.grid.size
    wide = next((n for n in SIDES if n >= max(2 * size, _SIDE)), 3 * size)
    # Transforms for each pixel, error, side of a tile, places.
    ways = [(len(places) * (wide / (wide - size + 1)) ** 2, left, wide - size + 1, places or [0])]
    for side in SIDES:
        if (tile := side - size + 1) >= side / 2:
            ways.append((4 * (side / tile) ** 2, bent * tile**2, tile, []))
    good = [way for way in ways if way[1] <= tolerance]
    _, error, tile, taken = min(good) if good else min(ways, key=lambda way: way[1])
    if error > tolerance:
        warnings.warn(
            f"the blur varies so much that kernels are interpolated to {error:.1e} only, not to "
            f"{tolerance:.1e}: take a larger tolerance",
            stacklevel=3,
        )
    # Equal tiles, the last of which end where the picture does.
    down, across = (-(-n // -(-n // tile)) for n in method.shape)
    return dataclasses.replace(method, places=jnp.asarray(taken, jnp.int32), tile=(down, across))


def _bent(seen: np.ndarray, places: tuple[np.ndarray, np.ndarray]) -> float:
    """The error of G in the middle of a tile, blended of that in its corners, over the square of
    the side, 1/pixels^2; seen: (My, Mx, K, K) at equidistant places."""
    total = 0.0
    for axis, nodes in enumerate(places):
        parts = np.moveaxis(seen, axis, 0)
        bent = (parts[:-2] + parts[2:]) / 2 - parts[1:-1]
        total += np.max(np.linalg.norm(bent, axis=(-2, -1))) / (nodes[2] - nodes[0]) ** 2
    return float(total)


def _choose(rows: np.ndarray, places: list[int], tolerance: float) -> float:
    """Adds to `places` those that the kernels of all, (M, K^2), need; the error that is left."""
    basis = 0
    while True:
        # Those that others needed first, then the place that is worst off.
        errors = np.linalg.norm(rows, axis=1)
        if basis == len(places):
            if np.max(errors) <= tolerance or len(places) == _MOST:
                return float(np.max(errors))
            places.append(int(np.argmax(errors)))
        row = rows[places[basis]]
        length = np.linalg.norm(row)
        unit = row / length if length > 0 else row
        rows = rows - np.outer(rows @ unit, unit)
        basis += 1


@functools.partial(jit, wanted=LARGE)
def _seen_of(grid: KernelGrid, method: RenderMethod, distance: Array, colour: Array) -> Array:
    return _seen_at(grid, method, distance, colour, controls(method))


def _table(grid: KernelGrid, method: RenderMethod, distance: Array, colour: Array) -> Array:
    """The image points of one distance and colour, so that each is about its node's own place."""
    return grid.points[distance][:, :, colour] / (grid.step * method.focal)


def _wanted(method: RenderMethod, where: tuple[np.ndarray, np.ndarray], dtype: Any) -> Array:
    """Places (My, Mx, 2) mm on the sensor, of pixels along y and x."""
    middle = (np.array(method.shape) - 1) / 2
    places = np.stack(np.meshgrid(where[1] - middle[1], where[0] - middle[0]), -1)
    return jnp.asarray(places, dtype) * method.grid.pixel


def _lit(
    grid: KernelGrid, method: RenderMethod, distance: Array, colour: Array
) -> tuple[Array, Array]:
    """Sources (My, Mx, 2) and light (My, Mx) of one distance and colour."""
    unit, dtype = grid.step * method.focal, grid.step.dtype
    table = _table(grid, method, distance, colour)
    light = grid.solid_angle[distance][:, :, colour]
    half = jnp.asarray(method.grid.half[::-1], dtype)
    axis = light[method.grid.half[0], method.grid.half[1]]
    middle = (np.array(method.shape) - 1) / 2
    wanted = _wanted(method, controls(method), dtype)
    nodes = jax.vmap(jax.vmap(lambda p: _source(method, table, p / unit)[0]))(wanted)
    sources = nodes * (unit / method.grid.pixel)
    sources = sources + jnp.asarray(middle[::-1], dtype).reshape(1, 1, 2)
    level = jax.vmap(jax.vmap(lambda u: at_point(light, u + half, LOCAL)))(nodes)
    return sources, jnp.maximum(level, 0) / jnp.where(axis > 0, axis, 1)


def _seen_at(
    grid: KernelGrid,
    method: RenderMethod,
    distance: Array,
    colour: Array,
    where: tuple[np.ndarray, np.ndarray],
) -> Array:
    """G (My, Mx, K, K) of one distance and colour."""
    light, outside, kernels = (
        a[distance][:, :, colour] for a in (grid.solid_angle, grid.outside, grid.kernels)
    )
    table = _table(grid, method, distance, colour)
    seen = functools.partial(_seen, method, grid.step, table, light, outside, kernels)
    wanted = _wanted(method, where, grid.step.dtype)
    return jax.lax.map(jax.checkpoint(jax.vmap(seen)), wanted)  # all at once take room


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

    def step(u: Array, _: None) -> tuple[Array, None]:
        return jnp.clip(u - matmul(inverse(u), image(u) - wanted), -half - 1, half + 1), None

    u, _ = jax.lax.scan(step, jnp.clip(wanted, -half, half), length=_NEWTON)
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
    moved = (u + half).reshape(1, 1, 2) - einsum("ab,yxb->yxa", slope, shift)
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
