"""How a photograph is rendered: the choice of fields, kernels and tiles for a tolerance."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from ..lens.lens import Lens
from ..lens.paraxial import first_order
from ..lens.scene import NEAREST, Scene
from ..numerics import Numbers, known_values
from .beam_psf import Kind, Sampling
from .fields import image_points
from .grid_method import check_pixel, grid_method
from .sensor_maps import RenderMethod, chosen

WAVELENGTHS = (0.6, 0.53, 0.48)
# Fields that are tried in `_angles`, in units of the field of a pinhole camera at the edge of the
# picture.
_TRIED = np.linspace(0, 2, 81)
# Largest tangent of a field, that of 85 degrees.
_WIDEST = 11.4


def render_method(
    lens: Lens,
    shape: tuple[int, int],
    distance: Numbers,
    pixel: Numbers,
    wavelengths: Numbers = WAVELENGTHS,
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
    known = known_values((lens, distance, pixel, wavelengths))
    if known is None:
        raise ValueError(
            "inside jax.jit or jax.vmap fields and rays cannot be chosen: call "
            "drt_jax.converge(drt_jax.render, ...) outside and pass it on, sampling=..."
        )
    with jax.core.eval_context():
        lens, distance, pixel, wavelengths = known
        check_pixel(pixel)
        if len(shape) != 2 or min(shape) < 1:
            raise ValueError(f"shape: expected the height and width of a picture, got {shape}")
        waves = lens.checked_wavelengths(wavelengths).reshape(-1)
        focal = float(np.mean(np.asarray(first_order(lens, jnp.inf, waves).effective_focal_length)))
        if not 0 < abs(focal) < np.inf:
            raise ValueError("lens: without a focal length it makes no picture")
        far = layer_distances(distance, shape, layers)
        side = float(np.asarray(pixel))
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
    lens: Lens,
    shape: tuple[int, int],
    far: np.ndarray,
    pixel: float,
    focal: float,
    wavelengths: Any,
) -> np.ndarray:
    """Largest fields (2,), radians along x and y, whose image points lie at the edges of the
    picture, or as far outside as chief rays exist and image heights rise with the field."""
    half = np.array([shape[1], shape[0]]) / 2 * pixel
    corners = np.array([[x, y] for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y]) * half
    tangents = corners[:, None] * _TRIED[None, :, None] / abs(focal)
    points = image_points(lens, tangents.reshape(-1, 2), far[[0, -1]], wavelengths)
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
