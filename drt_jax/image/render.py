"""The photograph that a lens takes of an ideal picture.

Radiance is constant along a ray. So a point p of the sensor collects the mean radiance over its
cone of light, times the solid angle of the cone in direction cosines:

    irradiance(p) = solid_angle(p) sum_k G(k; p) radiance(source of p - k).

The source of a point is the field whose centroid lies there, for each colour separately. G is the
kernel as seen from the sensor: its element k is the element k of the kernel of the source of p - k,
weighted with the light of that source. G has the sum 1, less the light outside of the kernel, so
that a uniform scene stays uniform except for the solid angle. G is a sum of a few kernels with
coefficients that vary over the picture, see `sensor_maps`.
"""

import functools
from collections.abc import Callable, Iterable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require, require_tolerance
from ..lens.lens import Lens
from ..lens.paraxial import first_order
from ..lens.scene import NEAREST, Scene, checked_scene, over_points, vergence_of
from ..numerics import Numbers, concrete, einsum, safe_divide, safe_sqrt
from ..rays.solve import solve_aimed
from ..rays.trace import trace_bundle
from .beam_psf import Kind, Sampling
from .fields import grid_method
from .interpolate import basis, cubic
from .kernel import check_pixels
from .refined import require_known
from .sensor_maps import (
    LOCAL,
    SMOOTH,
    Maps,
    RenderMethod,
    blur_row,
    chosen,
    controls,
    sensor_maps,
    tiles_of,
)

_WAVELENGTHS = (0.6, 0.53, 0.48)
# Fields that are tried in `_angles`, in units of the field of a pinhole camera at the edge of the
# picture.
_TRIED = np.linspace(0, 2, 81)
# Largest tangent of a field, that of 85 degrees.
_WIDEST = 11.4


@functools.partial(jit, wanted=LARGE, static_argnames="lit")
def _strip(maps: Maps, method: RenderMethod, picture: Array, row: Array, lit: bool) -> Array:
    """A row of tiles of one distance.

    The picture is warped to the sensor, by cubic convolution at the interpolated sources, blurred
    with the kernels of the tiles, and multiplied with the relative light.

    maps: maps of one distance.
    method: from `render_method`.
    picture: (H, W, C), in the dtype of `maps`.
    row: index of the row of tiles.
    lit: True to multiply with the relative light.

    Returns (height, n width, C), channels last.
    """
    (tile, wide), margin, dtype = method.tile, method.grid.size // 2, picture.dtype
    starts = (row * tile).astype(dtype), jnp.zeros((), dtype)
    lengths = tile, tiles_of(method)[1] * wide
    places, local = [], []
    for start, length, nodes in zip(starts, lengths, controls(method), strict=True):
        pixels = start + jnp.arange(-margin, length + margin, dtype=dtype)
        first, gap, count = float(nodes[0]), float(nodes[1] - nodes[0]), len(nodes)
        place = (pixels - first) / gap
        places.append(basis(place, count, SMOOTH))
        local.append(basis(place[margin : length + margin], count, LOCAL))

    def between(values: Array, where: list[Array]) -> Array:
        """Values at the positions of the maps, interpolated to pixels."""
        return einsum("ym,cmn,xn->cyx", where[0], values, where[1])

    x, y = (between(maps.sources[..., k], places) for k in (0, 1))
    warped = cubic(picture, y, x)
    if maps.shares is None:
        kernels, shares, across = _corners(maps.kernels, method, row)
    else:
        kernels, across = maps.kernels[None], local[1]
        shares = einsum("ym,crmn->cryn", local[0], maps.shares)
    blurred = blur_row(warped, kernels, shares, across, method.tile)
    if lit:
        blurred = blurred * between(maps.light, local)
    return jnp.moveaxis(blurred, 0, -1)


def _corners(kernels: Array, method: RenderMethod, row: Array) -> tuple[Array, Array, Array]:
    """Arguments of `blur_row` for a row of n tiles whose kernels are blended from the corners.

    kernels: (C, Cy, Cx, K, K), at the corners of all tiles.

    Returns the kernels (n, C, 4, K, K) of the corners of each tile, their shares (1, 4, height, 2),
    which are linear ramps, and the matrix (n width, 2) that interpolates along the row.
    """
    count, dtype = tiles_of(method)[1], kernels.dtype
    near = jax.lax.dynamic_slice_in_dim(kernels, row, 2, axis=1)
    four = [near[:, d, a : a + count] for d in (0, 1) for a in (0, 1)]
    ramps = [np.arange(n) / n for n in method.tile]
    down, across = (np.stack([1 - ramp, ramp], -1) for ramp in ramps)
    shares = np.stack([down[:, d, None] * np.eye(2)[a] for d in (0, 1) for a in (0, 1)])
    matrix = np.tile(across, (count, 1))
    moved = jnp.moveaxis(jnp.stack(four), (0, 2), (2, 0))
    return moved, jnp.asarray(shares[None], dtype), jnp.asarray(matrix, dtype)


def render(
    lens: Lens,
    image: Array,
    distance: Numbers,
    pixel: Numbers,
    wavelengths: Numbers = _WAVELENGTHS,
    sampling: RenderMethod | float = 1e-3,
    progress: Callable[[Iterable], Iterable] = iter,
) -> Array:
    """The picture that a lens forms of an ideal picture on its sensor, with distortion, lateral
    colour, blur that varies over the field, vignetting and relative illumination.

    lens: the lens.
    image: (H, W, C), linear radiance of C wavelengths, floating-point numbers; (H, W) is used for
        all colours. It is what a pinhole camera with the lens's effective focal length f sees: f
        tan(field), centred on the axis, at the sensor's pixels, with rows along y and columns along
        x of the sensor. (On a sensor pictures stand upside down, as this one does for an upright
        scene.) Outside of the picture its edge pixels continue.
    distance: mm, inf allowed; or a depth map (H, W) of the picture, which is rendered in layers,
        see `composed`.
    pixel: side of a pixel, mm.
    wavelengths: (C,), um.
    sampling: a tolerance of the kernels, see `converge`; or what `converge(render, ...)`
        returns for this distance and pixel, which is needed inside `jax.jit` and `jax.vmap`.
    progress: wraps the loop over rows of tiles (such as tqdm), where all numbers are known.

    Returns (H, W, C) in the dtype of `image`: the irradiance relative to that on the axis, 1 where
    a picture of 1 meets the axis. Light outside of the kernels is lost. Each colour is resampled by
    cubic convolution, which is of third order in the distortion. Differentiable in the lens and the
    image, in every mode. ValueError for other shapes and dtypes, for pictures that are not finite,
    and as of `converge`.
    """
    count = len(lens.checked_wavelengths(wavelengths).reshape(-1))
    picture = _picture(image, count)
    if isinstance(sampling, RenderMethod):
        method = sampling
    else:
        shape, to = (picture.shape[0], picture.shape[1]), require_tolerance(sampling)
        method = render_method(lens, shape, distance, pixel, wavelengths, tolerance=to)
    if picture.shape[:2] != method.shape:
        raise ValueError(f"image: the method is for {method.shape}, got {picture.shape[:2]}")
    _check_method(method, distance, pixel)
    maps = sensor_maps(lens, method, wavelengths)
    maps = jax.tree.map(lambda a: a.astype(picture.dtype), maps)
    if jnp.ndim(jnp.asarray(distance)) == 0:
        return _whole(maps, method, picture, progress)
    return composed(maps, method, picture, jnp.asarray(distance), progress)


def render_method(
    lens: Lens,
    shape: tuple[int, int],
    distance: Numbers,
    pixel: Numbers,
    wavelengths: Numbers = _WAVELENGTHS,
    size: int | None = None,
    nodes: int = 16,
    layers: int = 8,
    kind: Kind | Literal["auto"] = "rays",
    tolerance: float = 1e-3,
    sampling: Sampling | None = None,
) -> RenderMethod:
    """Chooses how `render` works. All arguments are known numbers.

    lens: the lens.
    shape: height and width of the picture, pixels.
    distance: mm; one, or a depth map (H, W), which is divided into `layers` distances, equidistant
        in 1 / distance.
    pixel: side of a pixel, mm.
    wavelengths: (C,), um.
    size: number of pixels along a side of a kernel, odd; by default wide enough for 4.5 standard
        deviations of the blur.
    nodes: number of fields on one side of the axis, along the longer side of the picture, see
        `grid_method`.
    layers: number of distances for a depth map.
    kind: of the kernels, as in `psf`.
    tolerance: of the kernels, and of their interpolation between the nodes of the grid: the root of
        the sum of the squared errors of a kernel's pixels. This is the RMS error of a picture of
        white noise of variance 1.
    sampling: of the kernels, instead of `kind` and `tolerance`.

    Returns a `RenderMethod`. Warns of light outside of kernels that are too small. ValueError
    inside a trace, for invalid numbers, and where no light arrives.
    """
    known = require_known((lens, distance, pixel, wavelengths), "the choice of fields", "render")
    with jax.core.eval_context():
        lens, distance, pixel, wavelengths = known
        if len(shape) != 2 or min(shape) < 1:
            raise ValueError(f"shape: expected the height and width of a picture, got {shape}")
        side = float(check_pixels(pixel, 1, lens.curvature.dtype).side)
        waves = lens.checked_wavelengths(wavelengths).reshape(-1)
        focal = float(np.mean(np.asarray(first_order(lens, jnp.inf, waves).effective_focal_length)))
        require(0 < abs(focal) < np.inf, "lens: has no focal length, so it forms no image")
        far = layer_distances(distance, shape, layers)
        angles = _angles(lens, shape, far, side, focal, waves)
        given = lens, Scene.grid(angles[None], far, waves), side, size, nodes, kind
        grid = grid_method(*given, sampling or tolerance, norm=2)
        both = (shape[0], shape[1])
        length = jnp.asarray(focal, lens.curvature.dtype)
        method = RenderMethod(grid, length, jnp.zeros(0, jnp.int32), both, both)
        return chosen(lens, method, waves, tolerance)


def layer_distances(distance: Numbers, shape: tuple[int, int], layers: int) -> np.ndarray:
    """Distances (D,), mm, of the layers of a known distance or depth map, the nearest first."""
    far = np.asarray(distance, float)
    if far.ndim and far.shape != tuple(shape):
        raise ValueError(
            f"distance: expected one number or a depth map of {shape[0]} x {shape[1]} pixels, as "
            f"the picture, got {' x '.join(map(str, far.shape))}"
        )
    if not np.all(far >= NEAREST):
        raise ValueError(
            "distance: must be above 0 mm everywhere, inf for infinity, and nowhere below "
            f"{NEAREST:g} mm; got {np.min(far):g}"
        )
    ends = 1 / np.min(far), 1 / np.max(far)
    if ends[0] == ends[1]:
        return np.ravel(far)[:1]
    with np.errstate(divide="ignore"):
        return 1 / np.linspace(*ends, max(layers, 2))


def _angles(
    lens: Lens, shape: tuple[int, int], far: np.ndarray, pixel: float, focal: float, waves: Array
) -> np.ndarray:
    """Largest fields (2,), radians along x and y, whose image points lie at the edges of the
    picture, or as far outside as chief rays exist and image heights rise with the field."""
    half = np.array([shape[1], shape[0]]) / 2 * pixel
    corners = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]) * half
    tangents = corners[:, None] * _TRIED[None, :, None] / abs(focal)
    scene = Scene.grid(np.arctan(tangents).reshape(-1, 2), far[[0, -1]], waves)
    points = np.asarray(_chief_points(lens, checked_scene(lens, scene)))
    points = points.reshape(2, *tangents.shape[:2], -1, 2)
    exists = np.isfinite(points)
    units = corners / np.sum(corners**2, axis=1, keepdims=True)
    radii = np.sum(np.where(exists, points, 0) * units[None, :, None, None], axis=-1)
    radii = np.where(np.all(exists, axis=-1), np.abs(radii), np.nan)
    farthest = 1.0
    for ray in np.moveaxis(radii, 2, -1).reshape(-1, len(_TRIED)):
        rising = np.concatenate([[True], np.diff(ray) > 0])  # also False for a NaN
        end = len(ray) if np.all(rising) else int(np.argmin(rising))
        reached = np.flatnonzero(ray[:end] >= 1)
        farthest = max(farthest, _TRIED[reached[0] if len(reached) else end - 1])
    return np.arctan(np.minimum(half / abs(focal) * farthest, _WIDEST))


@functools.partial(jit, wanted=LARGE)
def _chief_points(lens: Lens, scene: Scene) -> Array:
    """Points (..., W, 2), mm, where chief rays meet the sensor; inf where one fails. No search."""

    def one(point: Scene) -> Array:
        centre = jnp.zeros(1, lens.curvature.dtype)
        bundle = trace_bundle(lens, point, (centre, centre), solve_aimed)
        return jnp.where(bundle.arrives, jnp.concatenate(bundle.sensor, axis=-1), jnp.inf)

    return over_points(one, scene)


def _check_method(method: RenderMethod, distance: Numbers, pixel: Numbers) -> None:
    """ValueError if known numbers are not those that the method was made for."""
    if concrete(distance):
        layer_distances(distance, method.shape, 2)
    pairs = {"pixel": (pixel, method.grid.pixel), "distance": (distance, method.grid.distances)}
    for name, (given, own) in pairs.items():
        if not concrete((given, own)) or np.ndim(np.asarray(given)):
            continue
        known = np.asarray(own)
        if known.size > 1 or not np.isclose(np.asarray(given, known.dtype), known, 1e-5, 0).all():
            raise ValueError(f"{name}: the method is for {own} mm, got {given}; make one for it")


def _picture(image: Array, channels: int) -> Array:
    """The picture as a checked array (H, W, C)."""
    shape, dtype = np.shape(image), jnp.result_type(image)
    if not jnp.issubdtype(dtype, jnp.floating):
        raise ValueError(f"image: linear floating numbers are expected, not {dtype}")
    if len(shape) == 2:
        image = jnp.broadcast_to(jnp.asarray(image)[..., None], (*shape, channels))
    elif len(shape) != 3 or shape[2] != channels:
        raise ValueError(f"image: expected (H, W, {channels}) or (H, W), got {shape}")
    if concrete(image) and not np.all(np.isfinite(np.asarray(image))):
        raise ValueError("image: must be finite everywhere")
    return image


def _whole(
    maps: Maps, method: RenderMethod, picture: Array, progress: Callable, layer: int = 0,
    lit: bool = True
) -> Any:  # fmt: skip
    """All rows of tiles of a picture (H, W, C), see `_strip`. layer: index of the distance."""
    (height, width), tile, rows = method.shape, method.tile[0], tiles_of(method)[0]
    picture = jnp.asarray(picture)
    colours = picture.shape[-1]
    one = jax.tree.map(lambda a: a[layer], maps)
    if not concrete((maps, picture, method)):
        strip = jax.checkpoint(lambda row: _strip(one, method, picture, row, lit=lit))
        found = jax.lax.map(strip, jnp.arange(rows, dtype=jnp.int32))
        return found.reshape(rows * tile, -1, colours)[:height, :width]
    result = np.empty((height, width, colours), picture.dtype)
    for row in progress(range(rows)):
        part = _strip(one, method, picture, jnp.asarray(row, jnp.int32), lit=lit)
        inside = slice(row * tile, min((row + 1) * tile, height))
        result[inside] = np.asarray(part)[: height - row * tile, :width]
    return result


def composed(
    maps: Maps, method: RenderMethod, picture: Array, depth: Array, progress: Callable = iter
) -> Any:
    """The picture of a scene with a depth map, in layers, the nearest first.

    maps: maps of all layers.
    method: from `render_method`.
    picture: (H, W, C).
    depth: (H, W), mm.
    progress: as in `render`.

    A pixel belongs to the layer that is nearest to it in 1 / distance. Behind nearer layers, where
    nobody knows what is hidden, each layer is extrapolated by `spread`. A layer is blurred with its
    own kernels, and so is its mask, which is 1 where the layer is. The result is

        sum_k open_k blurred_k / sum_k open_k mask_k,
        open_k = product over nearer layers j of (1 - mask_j),

    with the masks blurred and, in the denominator, without the relative light. So a uniform scene
    stays uniform at any depth, except for the relative light. The product of masks treats the
    layers as if light met them independently of where it crosses the pupil. A slope shows steps
    where the blur of neighbouring layers differs.
    """
    vergences = np.asarray(jax.vmap(vergence_of)(method.grid.distances)).tolist()
    at = vergence_of(depth)
    away = jnp.stack([jnp.abs(at - v) for v in vergences])
    label = jnp.argmin(away, axis=0)
    dtype = picture.dtype
    total = cover = jnp.zeros_like(picture)
    open_ = jnp.ones_like(picture)
    for layer in range(len(vergences)):
        own = (label == layer)[..., None].astype(dtype)
        known = (label >= layer)[..., None].astype(dtype)
        share = spread(own, known)
        filled = spread(picture * own, own) * share
        part = _whole(maps, method, filled, progress, layer)
        mask = jnp.broadcast_to(share, picture.shape)
        covered = _whole(maps, method, mask, progress, layer, lit=False)
        total = total + open_ * part
        cover = cover + open_ * covered
        open_ = open_ * (1 - covered)
    return safe_divide(total, cover)


def spread(values: Array, known: Array) -> Array:
    """Inpainting: fills unknown pixels with a local mean of known ones.

    values: (H, W, C), 0 where unknown.
    known: (H, W, 1), weight of each pixel, 0 where unknown.

    The mean is that of the known pixels among the 3 x 3 around; where there is none, of pixels that
    are 2, 4, 8, ... times as large.
    """
    height, width = known.shape[:2]
    zero = jnp.zeros((), values.dtype)

    def neighbours(a: Array) -> Array:
        """Sum over the 3 x 3 pixels around each pixel."""
        return jax.lax.reduce_window(a, zero, jax.lax.add, (3, 3, 1), (1, 1, 1), "SAME")

    def halved(a: Array) -> Array:
        """Mean over blocks of 2 x 2 pixels."""
        a = jnp.pad(a, ((0, height % 2), (0, width % 2), (0, 0)))
        return a.reshape(-(-height // 2), 2, -(-width // 2), 2, -1).mean(axis=(1, 3))

    share = neighbours(known)
    near = safe_divide(neighbours(values), share)
    if max(height, width) > 3:
        far = spread(halved(values), halved(known))
        across = jnp.repeat(jnp.repeat(far, 2, axis=0), 2, axis=1)[:height, :width]
        near = jnp.where(share > 0, near, across)
    return jnp.where(known > 0, safe_divide(values, known), near)


def sensor_noise(image: Array, key: Array, full_well: Numbers, read_noise: Numbers) -> Array:
    """An image with the noise of a sensor, in the units of the image, not clipped.

    image: (...), 1 for a full pixel.
    key: a PRNG key.
    full_well: number of electrons of a full pixel.
    read_noise: standard deviation, electrons.

    Shot noise is a Gaussian whose variance is the number of electrons, which is accurate to a few
    per cent from some 20 electrons on. Differentiable in the image.
    """
    dtype = image.dtype
    full, read = (jnp.asarray(a, dtype) for a in (full_well, read_noise))
    variance = jnp.maximum(image, 0) * full + read**2
    white = jax.random.normal(key, image.shape, dtype)
    return image + safe_sqrt(variance) * white / full
