"""The choice of a PSF model from a tolerance: the degree of its polynomials and the cells of its
grid."""

import dataclasses
import functools
import warnings
from typing import Literal, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, ONCE, jit
from ..inputs import require_one_of, require_tolerance
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..numerics import Numbers, known_values
from ..pupil.clipped import Clipped
from ..pupil.rules import symmetry_of
from .beam import Beam, BeamRule, beam_rule, trace_beam
from .beam_psf import Kind, Psf, Sampling, psf_of_beam
from .converged import at_sensor, find_rule
from .kernel import check_pixels
from .rounding import below_double, hit_rounding, path_rounding, warn_dtype
from .wave_psf import period
from .zernike import zernike

# What a tolerance bounds.
Of = Literal["kernel", "gradient"]
# Default tolerance: the sum of the absolute errors of a kernel's pixels.
TOLERANCE = 1e-2
# Polynomial degrees to try, first of a coarse, then of a fine trace; cells of a grid to try.
_DEGREES = (4, 6, 8, 10, 12, 14, 16), (20, 24)
_CELLS = (32, 48, 64, 96, 128, 192, 256, 384, 512, 768)
# The error falls with the square of the number of cells n, and n rises by a factor of 4/3 or more
# from one trial to the next. So the error of the finer kernels is at most their change divided by
# (4/3)^2 - 1 > 0.75.
_STEP = 0.75
# Fraction of the light outside of a kernel above which a warning is given.
LOST = 0.01
_UM = 1e3  # per mm


def converged_psf(
    lens: Lens,
    scene: Scene,
    pixel: Numbers,
    size: int = 21,
    kind: Kind | Literal["auto"] = "auto",
    tolerance: float = TOLERANCE,
    norm: int = 1,
    of: Of = "kernel",
) -> Sampling:
    """A sampling whose kernels are accurate to a tolerance, for `psf`.

    lens, scene: the lens, and object points with their wavelengths. The sampling is valid for all.
    pixel: side of a pixel, mm.
    size: number of pixels along a side of the kernels.
    kind: "gaussian", "rays", "waves", or "auto": the cheapest of these within the tolerance of
        "waves"; `Sampling.errors` then gives the differences of the other kinds.
    tolerance: bound of the sum of the absolute errors of a kernel's pixels.
    norm: 1; or 2, to bound the root of the sum of the squared errors, which is the error of a
        white-noise picture.
    of: "kernel": the tolerance bounds the kernel alone; the relative error of its derivatives was
        up to five times as large. "gradient": a fifth of the tolerance is used, so that it holds
        for both.

    All numbers must be known; ValueError inside a trace. Warns if no degree or no grid that is
    tried meets the tolerance; if rounding does not allow it, as in float32 for waves from a large
    lens, where the search ends at the accuracy that rounding allows; and if more than 1 % of the
    light falls outside of the kernel, with a size for which less does.
    """
    require_one_of("of", of, get_args(Of))
    bound = tolerance / 5 if of == "gradient" else tolerance
    found, view = chosen_psf(lens, scene, pixel, size, kind, bound, norm)
    view.warn_of_loss(found)
    return found


def chosen_psf(
    lens: Lens, scene: Scene, pixel: Numbers, size: int, kind: Kind | Literal["auto"],
    tolerance: float, norm: int = 1
) -> tuple[Sampling, "_View"]:  # fmt: skip
    """`converged_psf` without its warning of light outside of the kernels.

    Returns the sampling, and the `_View` that can give this warning.
    """
    _check_asked(kind, tolerance, norm)
    known = known_values((lens, scene, pixel))
    if known is None:
        raise ValueError(
            "inside jax.jit or jax.vmap the cost of a kernel cannot follow from a tolerance: make "
            "the sampling outside and pass it on, sampling=drt_jax.converge(drt_jax.psf, ...)"
        )
    with jax.core.eval_context():
        lens, scene, pixel = known
        scene = checked_scene(lens, scene)
        side, size = check_pixels(pixel, size, lens.curvature.dtype)
        scenes = scene.each()
        base = find_rule(lens, scene, min(tolerance, 1e-3), at_sensor, False).rule
        clipped = base if isinstance(base, Clipped) else None
        symmetry = symmetry_of(lens, scene.field)
        rounded = {"hits": hit_rounding(lens)}
        if kind in ("waves", "auto"):
            paths = path_rounding(lens, scenes, True) if below_double(lens) else 0.0
            rounded["phase"] = 4 * np.pi * paths
        for degrees in _DEGREES:
            whole = beam_rule(degrees[-1], symmetry, clipped)
            beams = [traced(lens, scene, whole) for scene in scenes]
            degree, error = _degree(beams, scenes, side, rounded, degrees, tolerance)
            if error <= tolerance:
                break
        else:
            warnings.warn(
                f"polynomials of degree {degree} give back the rays to {error:.1e} only, not to "
                f"{tolerance:.1e}",
                stacklevel=3,
            )
        rule = beam_rule(degree, symmetry, clipped)
        beams = [dataclasses.replace(b, degree=degree, azimuths=degree) for b in beams]
        view = _View(lens, tuple(scenes), tuple(beams), side, size, norm)
        worst = max(rounded.get("phase", 0.0), view.hit_error(kind))
        warn_dtype(lens, "kernels", worst, tolerance, "", 3)
        view = dataclasses.replace(view, rounded=worst)
        if kind != "auto":
            return Sampling(kind, rule, view.cells(kind, tolerance)), view
        return _cheapest(view, rule, tolerance), view


def _check_asked(kind: str, tolerance: float, norm: int) -> None:
    """ValueError for an unknown kind, a tolerance that is not between 0 and 1, or another norm."""
    require_one_of("kind", kind, (*get_args(Kind), "auto"))
    require_tolerance(tolerance)
    if norm not in (1, 2):
        raise ValueError(f"norm: expected 1 or 2, got {norm!r}")


@functools.partial(jit, wanted=LARGE)
def traced(lens: Lens, scene: Scene, rule: BeamRule) -> Beam:
    """`trace_beam`, compiled."""
    return trace_beam(lens, scene, rule)


# Each number of cells needs its own compiled program, which runs once for each scene.
_kernels = jit(psf_of_beam, ONCE, static_argnames=("size", "kind", "cells"))
_refocused = jax.jit(Beam.refocused)


@dataclasses.dataclass(frozen=True)
class _View:
    """The beams of scenes, and the pixels of the kernels. All numbers are known.

    lens, scenes, beams: the lens, its scenes and their beams.
    pixel: (), mm.
    size: number of pixels along a side of the kernels.
    norm: as in `converged_psf`.
    rounded: error of a kernel from rounding.
    """

    lens: Lens
    scenes: tuple[Scene, ...]
    beams: tuple[Beam, ...]
    pixel: Array
    size: int
    norm: int
    rounded: float = 0.0

    def psfs(self, kind: Kind, cells: int) -> list[Psf]:
        """The `Psf` of each scene by a model."""
        named = {"size": self.size, "kind": kind, "cells": cells}
        return [
            _kernels(self.lens, scene.wavelengths, beam, self.pixel, None, **named)
            for scene, beam in zip(self.scenes, self.beams)
        ]

    def kernels(self, kind: Kind, cells: int) -> np.ndarray:
        """Kernels of all scenes and wavelengths, (scenes x W, size, size)."""
        return np.concatenate([np.asarray(one.kernel) for one in self.psfs(kind, cells)])

    def hit_error(self, model: Kind | Literal["auto"]) -> float:
        """Estimated error of the kernels from rounding of hits; that of waves follows from the
        paths instead. It is measured by a defocus that moves the rays at the rim of the pupil by
        the rounding of hits: rounding / NA. In float32 at pixels of the Airy radius it gave 0.02
        for an error of 0.006 of a microscope objective, and 3e-4 for 4e-5 where the spot is
        large."""
        if model == "waves" or not below_double(self.lens):
            return 0.0
        trial: tuple[Kind, int] = ("gaussian", 0) if model == "gaussian" else ("rays", _CELLS[0])
        cones = [float(np.max(one.solid_angle)) for one in self.psfs(*trial)]
        steps = [hit_rounding(self.lens) * np.sqrt(np.pi / a) if a > 0 else 0.0 for a in cones]
        beams = [_refocused(b, b.index.dtype.type(step)) for b, step in zip(self.beams, steps)]
        moved = dataclasses.replace(self, beams=tuple(beams))
        return difference(moved.kernels(*trial), self.kernels(*trial), self.norm)

    def warn_of_loss(self, model: Sampling) -> None:
        """Warns of light outside of the kernels of a model, for the scene with most of it."""
        lost = [float(jnp.max(one.outside)) for one in self.psfs(model.kind, model.cells)]
        k = int(np.argmax(lost))
        warn_of_loss(lost[k], self.scenes[k], self.beams[k], self.pixel, self.size, model.kind, 4)

    def cells(self, kind: Kind, tolerance: float) -> int:
        """The smallest number of cells for which the kernels are within the tolerance."""
        if kind == "gaussian":
            return 0
        first = _CELLS[0] if kind == "rays" else max(map(self._fewest, self.scenes, self.beams))
        tried = [n for n in _CELLS if n >= first] or [_CELLS[-1]]
        before = None
        for cells in tried:
            now = self.kernels(kind, cells)
            change = np.inf if before is None else difference(now, before, self.norm)
            if change <= _STEP * max(tolerance, self.rounded):
                return cells
            before = now
        warnings.warn(
            f"{kind} of {cells} x {cells} cells have converged to {change / _STEP:.1e} only, not "
            f"to {tolerance:.1e}: the spot may be too large; take a larger tolerance",
            stacklevel=4,
        )
        return cells

    def _fewest(self, scene: Scene, beam: Beam) -> int:
        """The fewest cells for which no periodic copy of the spot overlaps the kernel."""
        hits = np.asarray(beam.hits[:, -1])
        middle = np.mean(hits[:, np.asarray(beam.known)], axis=-1)
        reach = np.max(np.where(np.asarray(beam.known), np.abs(hits - middle[:, None, None]), 0))
        width = self.size * float(self.pixel)
        needed = max(width, width / 2 + 1.1 * float(reach))
        return int(np.max(np.ceil(needed / np.asarray(period(beam, scene.wavelengths, 1)))))


def difference(a: np.ndarray, b: np.ndarray, norm: int = 1) -> float:
    """Largest difference of kernels (..., size, size): of the sums of the absolute differences
    of their pixels or, with `norm` 2, of the roots of the sums of the squares."""
    total = np.sum(np.abs(a - b) ** norm, axis=(-2, -1))
    return float(np.max(total ** (1 / norm)))


def warn_of_loss(
    lost: float, scene: Scene, beam: Beam, pixel: Numbers, size: int, kind: Kind, level: int
) -> None:
    """Warns if more than `LOST` of the light falls outside of a kernel, and names a size for which
    less does.

    lost: fraction of the light outside.
    scene, beam: those for which it is largest.
    pixel, size, kind: of the kernel.
    level: as of `warnings.warn`.

    For each share p of `LOST` that diffraction may lose, the radius that is needed is the sum of
    two: within the first, rays have all but LOST - p of the light; beyond the second, a round pupil
    diffracts p. That is 2 / (pi v) = p at v = 2 pi NA r / wavelength, so r = 2 / (pi^2 p)
    wavelength / (2 NA), and wavelength / (2 NA) is a `period`.
    """
    if lost <= LOST:
        return
    hits, weights = np.asarray(beam.hits[:, -1], float), np.asarray(beam.weights, float)
    share = weights / np.maximum(np.sum(weights, axis=-1, keepdims=True), np.finfo(float).tiny)
    centre = np.mean(np.sum(share * hits, axis=-1), axis=-1)
    away = np.max(np.abs(hits - centre[:, None, None]), axis=0)
    # Shares of the loss for diffraction, and the radius that they need, times the share.
    parts, waves = np.linspace(0.05, 0.95, 19) * LOST, kind == "waves"
    spread = 2 / np.pi**2 * waves * np.max(np.asarray(period(beam, scene.wavelengths, 1)), axis=0)
    reach = np.zeros((len(away), len(parts)))
    for k, (far, light) in enumerate(zip(away, share)):
        order = np.argsort(far)
        last = np.searchsorted(np.cumsum(light[order]), 1 - LOST + parts)
        reach[k] = far[order][np.minimum(last, len(far) - 1)] + spread[k] / parts
    needed = np.min(np.max(reach, axis=0)) / float(np.asarray(pixel))
    more = max(2 * int(np.ceil(needed)) + 1, size + 2)
    warnings.warn(
        f"size: {100 * lost:.2g} % of the light falls beside a kernel of {size} x {size} pixels; "
        f"{more} x {more} hold 99 %",
        stacklevel=level,
    )


def _degree(
    beams: list[Beam], scenes: list[Scene], pixel: Array, rounded: dict[str, float],
    degrees: tuple[int, ...], tolerance: float
) -> tuple[int, float]:  # fmt: skip
    """The lowest degree whose polynomials fit the rays, and the error of the fit beyond rounding:
    relative to the spot or, for the phase, in radians. There are more rays than terms.

    rounded: rounding of hits, mm, and of phases, radians.
    """
    pairs = [(b, s, w) for b, s in zip(beams, scenes) for w in range(s.wavelengths.size)]
    for degree in degrees:
        error = max(_misfit(b, s, w, pixel, rounded, degree) for b, s, w in pairs)
        if error <= tolerance:
            break
    return degree, error


def _misfit(
    beam: Beam, scene: Scene, wavelength: int, pixel: Array, rounded: dict[str, float], degree: int
) -> float:
    """Error of the fit of one beam at one wavelength, see `_degree`."""
    cosines, waves = beam.on_sphere()
    rows = jax.tree.map(np.asarray, (beam.weights, beam.known, waves, beam.hits[:, -1]))
    weight, known, path, hits = (a[..., wavelength, :] for a in rows)
    weight = np.sqrt(np.where(known, np.abs(weight), 0) / np.sum(np.abs(weight)))
    middle = _mean(hits, weight)
    spread = np.sqrt(np.sum((weight * (hits - middle)) ** 2))
    points, directions = (np.asarray(a[:, wavelength]) for a in (beam.points, cosines))
    error = _residual(points, hits - middle, weight, degree) - 2 * rounded["hits"]
    error /= max(float(spread), float(pixel))
    if "phase" not in rounded:
        return error
    # The error of the wave field is the phase error, and that of the intensity twice as large: 4 pi
    # in place of 2 pi. The tilt towards the centroid is removed, as in `Beam.over_directions`.
    path = path + float(beam.index[wavelength]) * np.sum(np.float64(middle) * directions, axis=0)
    phase = path[None] * (4 * np.pi * _UM / float(scene.wavelengths[wavelength]))
    return max(error, _residual(directions, phase, weight, degree) - 2 * rounded["phase"])


def _mean(hits: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Weighted mean (D, 1) of hits (D, Q); `weight` (Q,) is the square root of the normalised
    light."""
    return cast(np.ndarray, np.sum(weight**2 * hits, axis=-1, keepdims=True))


def _residual(points: np.ndarray, values: np.ndarray, weight: np.ndarray, degree: int) -> float:
    """RMS residual of a fit of polynomials of a degree.

    points: (2, Q).
    values: (D, Q).
    weight: (Q,), square root of the normalised light.
    degree: of the polynomials.
    """
    centre = _mean(points, weight)
    scale = 2 * np.sqrt(np.sum(weight**2 * (points - centre) ** 2, axis=-1, keepdims=True))
    basis = np.asarray(zernike(jnp.asarray((points - centre) / scale), degree))
    matrix, right = (np.float64(a * weight).T for a in (basis, values))
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return float(np.sqrt(np.sum((matrix @ found - right) ** 2)))


def _cheapest(view: _View, rule: BeamRule, tolerance: float) -> Sampling:
    """The first of "gaussian", "rays" and "waves" that is within the tolerance of "waves"."""
    ladder: list[tuple[Kind, int]] = [
        (kind, view.cells(kind, tolerance)) for kind in get_args(Kind)
    ]
    kernels = [view.kernels(*one) for one in ladder]
    errors: dict[str, float]
    pairs = zip(ladder[:-1], kernels)
    errors = {kind: difference(k, kernels[-1], view.norm) for (kind, _), k in pairs}
    kind, cells = next(one for one in ladder if errors.get(one[0], 0.0) <= tolerance)
    return Sampling(kind, rule, cells, errors)
