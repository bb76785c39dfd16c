"""The point spread function on the pixels, by the model that a scene needs.

A ladder of three: "gaussian", with the moments of the rays, as in the paper; "rays", the light of
all rays; "waves", with diffraction. "auto" takes the first whose kernel is within a tolerance of
that of the waves. How many rays and cells a model takes follows from the tolerance, outside of
`jax.jit`: `converged_psf` makes the model, a value that `psf` then takes anywhere.
"""

import dataclasses
import functools
import itertools
import warnings
from typing import Literal, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, ONCE, jit
from ..lens.lens import Lens
from ..lens.scene import Scene, field_array, scene_of
from ..numerics import Numbers, known_values, real_array
from ..pupil.clipped import Clipped
from ..pupil.rules import symmetry_of
from .beam import Beam, BeamRule, beam_rule, centroid_and_variances, trace_beam
from .converged import converged_rule
from .kernel import check_pixels, gaussian_shares
from .ray_psf import ray_kernel
from .wave_psf import period, wave_kernel
from .zernike import zernike

Kind = Literal["gaussian", "rays", "waves"]
_TOLERANCE = 1e-2
# Degrees of the polynomials and cells of the grids that are tried.
_DEGREES = (4, 6, 8, 10, 12, 14, 16), (20, 24)
_CELLS = (32, 48, 64, 96, 128, 192, 256, 384, 512, 768)
_UM = 1e3  # per mm


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Psf:
    """What pixels collect of the light of an object point, for W wavelengths.

    kernel: (W, size, size), [wavelength, y, x]: adds to 1 - outside.
    outside: (W,), the part of the light on the sensor that falls beside the kernel.
    centre: (2,) mm, where the middle of the kernel lies on the sensor.
    throughput: (W,), the part of the light through the stop that reaches the sensor.
    solid_angle: (W,), area of the cone of light on the sensor in direction cosines: irradiance is
        radiance times this; its ratio to the axis is the relative illumination.
    """

    kernel: Array
    outside: Array
    centre: Array
    throughput: Array
    solid_angle: Array


@functools.partial(
    jax.tree_util.register_dataclass,
    data_fields=("rule", "errors"),
    meta_fields=("kind", "cells"),
)
@dataclasses.dataclass(frozen=True)
class PsfModel:
    """How kernels are made, see `converged_psf`.

    kind: "gaussian", "rays" or "waves". rule: of the rays. cells: of the grid of the pupil,
    along a side; 0 for a Gaussian. errors: for "auto", by kind, how far its kernel is from that of
    the waves, of the worst wavelength: what the tolerance is for.
    """

    kind: Kind
    rule: BeamRule
    cells: int
    errors: dict[str, float] = dataclasses.field(default_factory=dict)


def psf(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    pixel: Numbers,
    size: int = 21,
    model: Kind | Literal["auto"] | PsfModel = "auto",
    tolerance: float | None = None,
    centre: Numbers | None = None,
    defocus: Numbers = 0.0,
) -> Psf:
    """The point spread function on `size` x `size` pixels, see `Psf`.

    field, distance, wavelengths (W,): as of `psf_moments`. pixel: the side of a pixel, mm.
    model: a name or, inside `jax.jit` and `jax.vmap`, what `converged_psf` made.
    tolerance: of a model that is named: sum of the absolute errors of a kernel's pixels, 1e-2 by
        default.
    centre: (2,) mm on the sensor; by default the mean of the wavelengths' centroids.
    defocus: () mm by which the sensor stands behind its place: no ray is traced for it.

    Light fills the stop evenly. Differentiable in all numbers, in every mode. ValueError as of
    `scene_of`, for a pixel that is not above 0, and where no ray arrives.
    """
    scene = scene_of(lens, field, distance, wavelengths)
    pixel_, size = check_pixels(pixel, size, lens.curvature.dtype)
    if isinstance(model, str):
        accuracy = _TOLERANCE if tolerance is None else tolerance
        model = converged_psf(lens, field, distance, wavelengths, pixel, size, model, accuracy)
    elif tolerance is not None:
        raise ValueError("tolerance and model: a model that is made has its own precision")
    dtype = lens.curvature.dtype
    middle = None if centre is None else real_array("centre", centre, dtype)
    if middle is not None and middle.shape != (2,):
        raise ValueError(f"centre: expected x and y in mm, got shape {middle.shape}")
    step = real_array("defocus", defocus, dtype)
    rule, kind, cells = model.rule, model.kind, model.cells
    return _psf(lens, scene, rule, pixel_, middle, step, size, kind, cells)


@functools.partial(jit, wanted=LARGE, static_argnames=("size", "kind", "cells"))
def _psf(
    lens: Lens,
    scene: Scene,
    rule: BeamRule,
    pixel: Array,
    centre: Array | None,
    defocus: Array,
    size: int,
    kind: Kind,
    cells: int,
) -> Psf:
    beam = trace_beam(lens, scene, rule).refocused(defocus)
    return psf_of_beam(lens, scene, beam, pixel, centre, size, kind, cells)


def psf_of_beam(
    lens: Lens,
    scene: Scene,
    beam: Beam,
    pixel: Array,
    centre: Array | None,
    size: int,
    kind: Kind,
    cells: int,
) -> Psf:
    """`psf` of a beam. scene: its wavelengths. pixel: (), mm. centre: (2,) mm or None."""
    mean, (xx, xy, yy) = centroid_and_variances(beam.hits[:, -1], beam.weights)
    if centre is None:
        centre = jnp.mean(mean, axis=-1)
    total = beam.throughput[:, None, None]
    if kind == "gaussian":
        covariance = jnp.stack([jnp.stack([xx, xy], -1), jnp.stack([xy, yy], -1)], -2)
        kernel = gaussian_shares((mean - centre[:, None]).T, covariance, pixel, size)
        kernel = jnp.where(total > 0, kernel, 0)
    else:
        if kind == "rays":
            kernel = ray_kernel(lens, beam, centre, pixel, size, cells)
        else:
            kernel = wave_kernel(lens, beam, scene.wavelengths, centre, pixel, size, cells)
        kernel = jnp.where(total > 0, kernel / jnp.where(total > 0, total, 1), 0)
    outside = jnp.where(beam.throughput > 0, 1 - jnp.sum(kernel, axis=(1, 2)), 0)
    return Psf(kernel, outside, centre, beam.throughput, beam.solid_angle())


def converged_psf(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    pixel: Numbers,
    size: int = 21,
    model: Kind | Literal["auto"] = "auto",
    tolerance: float = _TOLERANCE,
    norm: int = 1,
) -> PsfModel:
    """The model whose kernels are within `tolerance`, the sum of the absolute errors of the pixels;
    with `norm` 2 the root of the sum of their squares, by which a picture of white noise is off.

    field: angle along y, or (x, y), in radians, or many pairs (F, 2). distance: mm, one or (Z,).
    Other arguments as of `psf`; all are known numbers. The model serves every field at every
    distance. With "auto" it is the cheapest within the tolerance of the waves, and `errors` says
    how far the others are. Warns where no polynomials or no grid in reach meets the tolerance.
    ValueError inside a trace.
    """
    _check_asked(model, tolerance, norm)
    known = known_values((lens, field, distance, wavelengths, pixel))
    if known is None:
        raise ValueError(
            "inside jax.jit or jax.vmap the cost of a kernel cannot follow from a tolerance: make "
            "the model outside and pass it on, model=drt_jax.converged_psf(...)"
        )
    with jax.core.eval_context():
        lens, field, distance, wavelengths, pixel = known
        dtype = lens.curvature.dtype
        side, size = check_pixels(pixel, size, dtype)
        fields = field_array(field, dtype)
        distances = real_array("distance", distance, dtype)
        pairs = itertools.product(
            fields if fields.ndim == 2 else [fields], distances if distances.ndim else [distances]
        )
        scenes = [scene_of(lens, one, far, wavelengths) for one, far in pairs]
        base = converged_rule(lens, field, distance, wavelengths, min(tolerance, 1e-3))
        clipped = base if isinstance(base, Clipped) else None
        symmetry = symmetry_of(lens, field)
        for degrees in _DEGREES:
            whole = beam_rule(degrees[-1], symmetry, clipped)
            beams = [_traced(lens, scene, whole) for scene in scenes]
            degree, error = _degree(beams, scenes, side, model != "gaussian", degrees, tolerance)
            if error <= tolerance:
                break
        else:
            warnings.warn(
                f"polynomials of degree {degree} give back the rays to {error:.1e} only, not to "
                f"{tolerance:.1e}",
                stacklevel=2,
            )
        rule = beam_rule(degree, symmetry, clipped)
        beams = [dataclasses.replace(b, degree=degree, azimuths=degree) for b in beams]
        view = _View(lens, tuple(scenes), tuple(beams), side, size, norm)
        if model != "auto":
            return PsfModel(model, rule, view.cells(model, tolerance))
        return _cheapest(view, rule, tolerance)


def _check_asked(model: str, tolerance: float, norm: int) -> None:
    if model not in (names := (*get_args(Kind), "auto")):
        raise ValueError(f"model: expected one of {', '.join(names)}, got {model!r}")
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}")
    if norm not in (1, 2):
        raise ValueError(f"norm: expected 1 or 2, got {norm!r}")


@functools.partial(jit, wanted=LARGE)
def _traced(lens: Lens, scene: Scene, rule: BeamRule) -> Beam:
    return trace_beam(lens, scene, rule)


# Each number of cells is a program, which runs once a scene.
_kernels = jit(psf_of_beam, ONCE, static_argnames=("size", "kind", "cells"))


@dataclasses.dataclass(frozen=True)
class _View:
    """Beams of scenes on pixels; all numbers are known."""

    lens: Lens
    scenes: tuple[Scene, ...]
    beams: tuple[Beam, ...]
    pixel: Array
    size: int
    norm: int

    def kernels(self, kind: Kind, cells: int) -> np.ndarray:
        """Those of all scenes and wavelengths, (scenes W, size, size)."""
        made = (
            _kernels(
                self.lens, scene, beam, self.pixel, None, size=self.size, kind=kind, cells=cells
            )
            for scene, beam in zip(self.scenes, self.beams)
        )
        return np.concatenate([np.asarray(one.kernel) for one in made])

    def cells(self, kind: Kind, tolerance: float) -> int:
        """The fewest cells of a model whose kernels are within the tolerance."""
        if kind == "gaussian":
            return 0
        first = _CELLS[0] if kind == "rays" else max(map(self._fewest, self.scenes, self.beams))
        tried = [n for n in _CELLS if n >= first] or [_CELLS[-1]]
        before = None
        for cells in tried:
            now = self.kernels(kind, cells)
            change = np.inf if before is None else difference(now, before, self.norm)
            # The error falls with the square of the number of cells, which grows by 4/3 at least.
            if change <= 0.75 * tolerance:
                return cells
            before = now
        warnings.warn(
            f"{kind} of {cells} x {cells} cells have converged to {change:.1e} only, not to "
            f"{tolerance:.1e}: the spot may be too large; take a larger tolerance",
            stacklevel=4,
        )
        return cells

    def _fewest(self, scene: Scene, beam: Beam) -> int:
        """So many that neither the spot nor the window comes again within the window."""
        hits = np.asarray(beam.hits[:, -1])
        middle = np.mean(hits[:, np.asarray(beam.known)], axis=-1)
        reach = np.max(np.where(np.asarray(beam.known), np.abs(hits - middle[:, None, None]), 0))
        width = self.size * float(self.pixel)
        needed = max(width, width / 2 + 1.1 * float(reach))
        return int(np.max(np.ceil(needed / np.asarray(period(beam, scene.wavelengths, 1)))))


def difference(a: np.ndarray, b: np.ndarray, norm: int = 1) -> float:
    """Sum of the absolute differences of kernels (..., size, size), or with `norm` 2 the root of
    the sum of their squares; the largest of them."""
    total = np.sum(np.abs(a - b) ** norm, axis=(-2, -1))
    return float(np.max(total ** (1 / norm)))


def _degree(
    beams: list[Beam],
    scenes: list[Scene],
    pixel: Array,
    pictures: bool,
    degrees: tuple[int, ...],
    tolerance: float,
) -> tuple[int, float]:
    """The lowest degree whose polynomials give back the rays, which are more than its terms, and to
    what part of the spot, or of a wave's radian."""
    pairs = [(b, s, w) for b, s in zip(beams, scenes) for w in range(s.wavelengths.size)]
    for degree in degrees:
        error = max(_misfit(b, s, w, pixel, pictures, degree) for b, s, w in pairs)
        if error <= tolerance:
            break
    return degree, error


def _misfit(
    beam: Beam, scene: Scene, wavelength: int, pixel: Array, pictures: bool, degree: int
) -> float:
    """The error of one wavelength's polynomials, see `_degree`."""
    row = jax.tree.map(np.asarray, (beam.weights, beam.known, beam.path, beam.hits[:, -1]))
    weight, known, path, hits = (a[..., wavelength, :] for a in row)
    weight = np.sqrt(np.where(known, np.abs(weight), 0) / np.sum(np.abs(weight)))
    spread = np.sqrt(np.sum((weight * (hits - _mean(hits, weight))) ** 2))
    points, directions = (np.asarray(a[:2, wavelength]) for a in (beam.points, beam.direction))
    error = _residual(points, hits, weight, degree) / max(float(spread), float(pixel))
    if not pictures:
        return error
    # Twice the error of the field, which is that of the phase.
    phase = path[None] * (4 * np.pi * _UM / float(scene.wavelengths[wavelength]))
    return max(error, _residual(directions, phase, weight, degree))


def _mean(hits: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return cast(np.ndarray, np.sum(weight**2 * hits, axis=-1, keepdims=True))


def _residual(points: np.ndarray, values: np.ndarray, weight: np.ndarray, degree: int) -> float:
    """Root mean square of what polynomials of a degree leave of values (D, Q) at points (2, Q);
    `weight` (Q,) is the root of the light."""
    centre = _mean(points, weight)
    scale = 2 * np.sqrt(np.sum(weight**2 * (points - centre) ** 2, axis=-1, keepdims=True))
    basis = np.asarray(zernike(jnp.asarray((points - centre) / scale), degree))
    matrix, right = (basis * weight).T, (values * weight).T
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return float(np.sqrt(np.sum((matrix @ found - right) ** 2)))


def _cheapest(view: _View, rule: BeamRule, tolerance: float) -> PsfModel:
    """The first of the ladder within the tolerance of the waves."""
    ladder: list[tuple[Kind, int]] = [
        (kind, view.cells(kind, tolerance)) for kind in get_args(Kind)
    ]
    kernels = [view.kernels(*one) for one in ladder]
    errors: dict[str, float]
    pairs = zip(ladder[:-1], kernels)
    errors = {kind: difference(k, kernels[-1], view.norm) for (kind, _), k in pairs}
    kind, cells = next(one for one in ladder if errors.get(one[0], 0.0) <= tolerance)
    return PsfModel(kind, rule, cells, errors)
