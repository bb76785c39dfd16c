"""Maps of the sensor: for each point its source in the ideal picture, its light, and its kernel.

They are sampled at a few sensor positions, interpolated from the kernel grid; `render` interpolates
between them. The kernels vary over the picture in one of two ways. Either all kernels are
combinations of the kernels at a few positions (a basis), or the kernels within a tile are blended
from those at its four corners. A picture of few pixels or with a small blur favours the basis, a
large picture the corners; `chosen` takes what costs less for a tolerance.

In both, the kernel of a pixel is sum_r shares_r kernel_r. The R kernels are the same for all pixels
of a tile; the shares are the pixel's own. So a tile costs one FFT, and one inverse FFT for each
kernel.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import warn
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import Numbers, brief, einsum, matmul, safe_divide, safe_sqrt
from .fields import GridMethod, KernelGrid, kernel_grid
from .interpolate import at_point, lagrange
from .kernel import Pixels
from .psf import warn_of_loss

# Numbers of nodes along each axis from which positions, and kernels or light, are interpolated; and
# the steps of Newton's method.
SMOOTH, LOCAL = 6, 4
_NEWTON = 6
# Sides of the squares that are transformed: sizes with fast FFTs.
_SIDES = (16, 32, 48, 64, 96, 128, 192, 256, 384, 512)
# Side of the FFTs with a basis of kernels, unless the kernels are large.
_FFT_SIDE = 256
# Largest number of kernels in a basis.
_MAX_KERNELS = 40
# A kernel counts as linearly dependent if its residual is below this many machine epsilons.
_ROUNDINGS = 8


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class RenderMethod:
    """How a picture is rendered, made by `converge(render, ...)`.

    grid: fields, distances and rays of the kernels.
    focal: (), mm, focal length of the pinhole camera that sees the ideal picture.
    places: (R,), int32, indices of those positions of `controls`, row by row, whose kernels form
        the basis; empty: the kernels are blended from those at the corners of tiles.
    shape: height and width of the picture, pixels.
    tile: height and width of its tiles, pixels.
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
    """Maps of the sensor for D distances and C colours.

    sources: (D, C, My, Mx, 2), x and y in pixels of the ideal picture, at equidistant positions of
        the sensor.
    light: (D, C, My, Mx), solid angle there relative to that on the axis.
    kernels: (D, C, R, K, K), an orthonormal basis; or, without `shares`, (D, C, Cy, Cx, K, K), G at
        the corners of tiles.
    shares: (D, C, R, My, Mx), coefficients: G at a position is the sum of the kernels times their
        shares there; or None.
    """

    sources: Array
    light: Array
    kernels: Array
    shares: Array | None


def sensor_maps(lens: Lens, method: RenderMethod, wavelengths: Numbers) -> Maps:
    """Maps of the sensor: the part of `render` that depends on the lens.

    lens: the lens.
    method: from `render_method`.
    wavelengths: (C,), um.
    """
    return _maps(kernel_grid(lens, wavelengths, method.grid), method)


def controls(method: RenderMethod) -> tuple[np.ndarray, np.ndarray]:
    """Positions (My,), (Mx,) of the maps on the sensor, pixels."""
    margin = method.grid.size // 2 + 1
    found = []
    for count, half in zip(method.shape, method.grid.half, strict=True):
        number = max(2 * SMOOTH, 4 * half + 1)
        found.append(np.linspace(-margin, count - 1 + margin, number))
    return found[0], found[1]


def tiles_of(method: RenderMethod) -> tuple[int, int]:
    """Number of tiles down and across the picture; the last ones may extend beyond it."""
    (height, width), (down, across) = method.shape, method.tile
    return -(-height // down), -(-width // across)


@functools.partial(jit, wanted=LARGE)
def _maps(grid: KernelGrid, method: RenderMethod) -> Maps:
    """`sensor_maps` from a grid of kernels."""
    colours, far = grid.solid_angle.shape[-1], len(grid.vergences)
    few = len(method.places) > 0
    y, x = (np.arange(n + 1) * t for n, t in zip(tiles_of(method), method.tile, strict=True))

    def one(index: Array) -> tuple[Array, Array, Array, Array | None]:
        plane = _plane(grid, method, index // colours, index % colours)
        g = _kernels_at(plane, method, controls(method) if few else (y, x))
        kernels, shares = _parts(g, method.places) if few else (g, None)
        return *_sources(plane, method), kernels, shares

    # One distance and colour after the other, because the kernels of all positions take much
    # memory.
    found = jax.lax.map(jax.checkpoint(one), jnp.arange(far * colours, dtype=jnp.int32))
    return Maps(*jax.tree.map(lambda a: a.reshape(far, colours, *a.shape[1:]), found))


def _parts(g: Array, places: Array) -> tuple[Array, Array]:
    """Basis and coefficients of kernels that vary over the sensor.

    g: (My, Mx, K, K), kernels G at all positions.
    places: (R,), int32, positions whose kernels span the basis.

    Returns an orthonormal basis (R, K, K), by Gram-Schmidt with a second pass, and the shares
    (R, My, Mx), the projections of G. The shares s are then corrected so that the sum of each
    kernel is exact and its centroid nearly: with the moments m = (K x sum, x, y) of the basis,
    s += (m_G - s m) (1 + m^T m)^-1 m^T, then s is scaled to the exact sum.
    """
    down, across, size = g.shape[:3]
    rows = g.reshape(down * across, size * size)
    basis = jnp.zeros((len(places), rows.shape[1]), rows.dtype)
    for k in range(len(places)):
        row = rows[places[k]]
        rest = row - matmul(matmul(basis, row), basis)
        rest = rest - matmul(matmul(basis, rest), basis)
        length, whole = (safe_sqrt(jnp.sum(a * a)) for a in (rest, row))
        independent = length > _ROUNDINGS * jnp.finfo(rows.dtype).eps * whole
        basis = basis.at[k].set(jnp.where(independent, safe_divide(rest, length[None]), 0))
    shares = matmul(rows, basis.T)
    # Correct the sum and the first moments, in pixels: they decide where a point is imaged, and the
    # change of the moments over the picture decides how much light it brings.
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
    """The method with those positions, or those tiles, that cost least for a tolerance. The numbers
    are known.

    lens, method: the lens and a method without tiles.
    wavelengths: (C,), um.
    tolerance: of G: the root of the sum of the squared errors of its pixels, which is the RMS error
        of a picture of white noise of variance 1.

    Warns if kernels truncate light, and if the error exceeds the tolerance.
    """
    grid = kernel_grid(lens, wavelengths, method.grid)
    y, x = (np.arange(-n, n + 1) * float(grid.step) for n in grid.half)
    fields = np.arctan(np.stack(np.meshgrid(x, y), -1))
    nodes = Scene.grid(fields.reshape(-1, 2), method.grid.distances, wavelengths)
    pixels = Pixels(method.grid.pixel, method.grid.size)
    warn_of_loss(lens, nodes, grid.outside, pixels, method.grid.sampling)
    places: list[int] = []
    blend = left = 0.0
    for distance in range(len(grid.vergences)):
        for colour in range(grid.solid_angle.shape[-1]):
            g = np.asarray(_kernels_of(grid, method, distance, colour), float)
            blend = max(blend, _blend_error(g, controls(method)))
            left = max(left, _greedy(g.reshape(-1, method.grid.size**2), places, tolerance))
    size = method.grid.size
    wide = next((n for n in _SIDES if n >= max(2 * size, _FFT_SIDE)), 3 * size)
    # Each option: cost as transformed values for each pixel, error, side of a tile, positions.
    ways = [(len(places) * (wide / (wide - size + 1)) ** 2, left, wide - size + 1, places or [0])]
    for side in _SIDES:
        if (tile := side - size + 1) >= side / 2:
            ways.append((4 * (side / tile) ** 2, blend * tile**2, tile, []))
    good = [way for way in ways if way[1] <= tolerance]
    _, error, tile, picked = min(good) if good else min(ways, key=lambda way: way[1])
    if error > tolerance:
        warn(
            f"the blur varies so much that kernels are interpolated to {error:.1e} only, not to "
            f"{tolerance:.1e}: take a larger tolerance"
        )
    # Equal tiles, so that the last ones end about where the picture does.
    down, across = (-(-n // -(-n // tile)) for n in method.shape)
    return dataclasses.replace(method, places=jnp.asarray(picked, jnp.int32), tile=(down, across))


def _blend_error(g: np.ndarray, places: tuple[np.ndarray, np.ndarray]) -> float:
    """Error of G in the middle of a tile, if it is blended from the corners, divided by the square
    of the side of the tile, 1/pixels^2. For nodes at the distance h it is
    |(G_-1 + G_1) / 2 - G_0| / (2 h)^2, along y plus along x.

    g: (My, Mx, K, K), G at equidistant positions.
    places: these positions along y and x, pixels.
    """
    total = 0.0
    for axis, nodes in enumerate(places):
        parts = np.moveaxis(g, axis, 0)
        bent = (parts[:-2] + parts[2:]) / 2 - parts[1:-1]
        total += np.max(np.linalg.norm(bent, axis=(-2, -1))) / (nodes[2] - nodes[0]) ** 2
    return float(total)


def _greedy(rows: np.ndarray, places: list[int], tolerance: float) -> float:
    """Greedy basis: extends `places` until the kernels there span all kernels to a tolerance, by
    pivoted Gram-Schmidt. Each step adds the kernel with the largest residual.

    rows: (M, K^2), kernels at all positions.
    places: indices, extended in place; they may hold those that other colours or distances need.
    tolerance: bound of the norm of a residual.

    Returns the largest residual; above the tolerance if `_MAX_KERNELS` do not suffice.
    """
    basis = 0
    while True:
        # First remove the kernels that are already in `places`, then add the largest residual.
        errors = np.linalg.norm(rows, axis=1)
        if basis == len(places):
            if np.max(errors) <= tolerance or len(places) == _MAX_KERNELS:
                return float(np.max(errors))
            places.append(int(np.argmax(errors)))
        row = rows[places[basis]]
        length = np.linalg.norm(row)
        unit = row / length if length > 0 else row
        rows = rows - np.outer(rows @ unit, unit)
        basis += 1


@functools.partial(jit, wanted=LARGE)
def _kernels_of(grid: KernelGrid, method: RenderMethod, distance: Array, colour: Array) -> Array:
    """G (My, Mx, K, K) of one distance and colour at the positions of the maps."""
    return _kernels_at(_plane(grid, method, distance, colour), method, controls(method))


class _Plane(NamedTuple):
    """A kernel grid at one distance and colour. On the sensor, lengths are in units of step x focal
    length, so that the image point of a node is near its own indices, counted from the axis.

    points: (Ny, Nx, 2), image points of the nodes.
    light, outside, kernels: (Ny, Nx, ...), as in `KernelGrid`.
    pixel: (), side of a pixel.
    """

    points: Array
    light: Array
    outside: Array
    kernels: Array
    pixel: Array

    @property
    def half(self) -> Array:
        """Number of nodes on each side of the axis, along x and y."""
        down, across = self.light.shape
        return jnp.array([across // 2, down // 2], self.pixel.dtype)


def _plane(grid: KernelGrid, method: RenderMethod, distance: Array, colour: Array) -> _Plane:
    """The plane of one distance and colour, given by their indices."""
    unit = grid.step * method.focal
    arrays = grid.points, grid.solid_angle, grid.outside, grid.kernels
    points, light, outside, kernels = (a[distance][:, :, colour] for a in arrays)
    return _Plane(points / unit, light, outside, kernels, method.grid.pixel / unit)


def _places(plane: _Plane, method: RenderMethod, where: tuple[np.ndarray, np.ndarray]) -> Array:
    """Points (My, Mx, 2) of the sensor at positions in pixels along y and x."""
    middle = (np.array(method.shape) - 1) / 2
    places = np.stack(np.meshgrid(where[1] - middle[1], where[0] - middle[0]), -1)
    return jnp.asarray(places, plane.pixel.dtype) * plane.pixel


def _sources(plane: _Plane, method: RenderMethod) -> tuple[Array, Array]:
    """Sources (My, Mx, 2), pixels of the ideal picture, and relative light (My, Mx)."""
    half = plane.half
    axis = plane.light[method.grid.half[0], method.grid.half[1]]
    middle = jnp.asarray((np.array(method.shape[::-1]) - 1) / 2, half.dtype)

    def one(place: Array) -> tuple[Array, Array]:
        source, _ = _source(plane, place)
        return source / plane.pixel + middle, at_point(plane.light, source + half, LOCAL)

    sources, level = jax.vmap(jax.vmap(one))(_places(plane, method, controls(method)))
    return sources, jnp.maximum(level, 0) / jnp.where(axis > 0, axis, 1)


def _kernels_at(plane: _Plane, method: RenderMethod, where: tuple[np.ndarray, np.ndarray]) -> Array:
    """G (My, Mx, K, K) at given positions."""
    row = jax.vmap(functools.partial(_sensor_kernel, plane))
    # Row by row, to save memory.
    return jax.lax.map(jax.checkpoint(row), _places(plane, method, where))


def _source(plane: _Plane, wanted: Array) -> tuple[Array, Array]:
    """Source of a sensor point (2,), by Newton's method on the interpolated image points.

    Returns the source u (2,), in nodes from the axis, and its Jacobian du / d(sensor point),
    (2, 2).
    """
    half = plane.half

    def image(u: Array) -> Array:
        return at_point(plane.points, u + half, SMOOTH)

    def inverse(u: Array) -> Array:
        (a, b), (c, d) = jax.jacfwd(image)(u)
        size = a * d - b * c
        return safe_divide(jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]), size[None, None])

    def step(u: Array, _: None) -> tuple[Array, None]:
        return jnp.clip(u - matmul(inverse(u), image(u) - wanted), -half - 1, half + 1), None

    u, _ = jax.lax.scan(step, jnp.clip(wanted, -half, half), length=_NEWTON)
    return u, inverse(u)


def _sensor_kernel(plane: _Plane, point: Array) -> Array:
    """Kernel G (K, K) as seen from a sensor point (2,). Element k is the light that reaches the
    point p from the source of p - k: the kernel of that source at k, times its solid angle.

    The source of p - k is linearised, u - (du / dp) k, and the kernel is interpolated there. G is
    normalised to the sum 1 - outside.
    """
    (down, across, size, _), half = plane.kernels.shape, plane.half
    u, slope = _source(plane, point)
    k = np.arange(size) - size // 2
    shift = jnp.asarray(np.stack(np.meshgrid(k, k), -1), u.dtype) * plane.pixel
    moved = (u + half).reshape(1, 1, 2) - einsum("ab,yxb->yxa", slope, shift)
    # Up to half a step beyond the nodes, where light from outside of the picture comes from.
    places = jnp.clip(moved, -0.5, 2 * half.reshape(1, 1, 2) + 0.5)
    row, wy = lagrange(places[..., 1], down, LOCAL)
    column, wx = lagrange(places[..., 0], across, LOCAL)
    values = (plane.kernels * plane.light[..., None, None]).reshape(down * across, size * size)
    own = jnp.arange(size * size, dtype=jnp.int32).reshape(size, size)
    total = jnp.zeros((size, size), u.dtype)
    for i in range(wy.shape[-1]):
        for j in range(wx.shape[-1]):
            taken = values[(row + i) * across + column + j, own]
            total = total + wy[..., i] * wx[..., j] * taken
    kept = 1 - at_point(plane.outside, jnp.clip(u + half, 0, 2 * half), LOCAL)
    return safe_divide(total, jnp.sum(total, keepdims=True)) * kept


def blur_row(
    light: Array, kernels: Array, shares: Array, across: Array, tile: tuple[int, int]
) -> Array:
    """Blurs a row of n tiles.

    light: (C, height + K - 1, n width + K - 1), the tiles with a margin of context.
    kernels: (n, C, R, K, K) for each tile, or (1, ...) for all tiles; a pixel collects kernel[k] of
        the light k pixels before it, as in a convolution.
    shares: (C, R, height, M) or (1, ...), weight of each kernel in each row of pixels, at M nodes
        along the row.
    across: (n width, M), matrix that interpolates the shares from the nodes to pixels.
    tile: height and width of a tile, pixels.

    Returns (C, height, n width).
    """
    size, channels = kernels.shape[-1], len(light)
    (height, width), count = tile, len(across) // tile[1]
    ends = height + size - 1, width + size - 1
    sides = tuple(next((s for s in _SIDES if s >= end), end) for end in ends)
    tiles = jnp.stack([light[:, :, j * width : j * width + ends[1]] for j in range(count)])
    spectra = jnp.fft.rfft2(tiles, sides)  # (n, C, ...)

    def added(total: Array, pair: tuple[Array, Array]) -> tuple[Array, None]:
        """Adds the light blurred with one kernel, times its shares."""
        kernel, share = pair
        blurred = jnp.fft.irfft2(spectra * jnp.fft.rfft2(kernel, sides), sides)
        inside = blurred[..., size - 1 : ends[0], size - 1 : ends[1]]
        each = einsum("cym,xm->cyx", share, across)
        return total + each * jnp.moveaxis(inside, 0, 2).reshape(total.shape), None

    start = jnp.zeros((channels, height, count * width), light.dtype)
    return jax.lax.scan(added, start, (jnp.moveaxis(kernels, 2, 0), jnp.moveaxis(shares, 1, 0)))[0]
