"""The choice of a PSF model from a tolerance: its polynomials and the cells of its grid."""

import dataclasses
import functools
import warnings
from typing import Literal, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, ONCE, jit
from ..inputs import require_one_of
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import Numbers, known_values
from ..pupil.clipped import Clipped
from ..pupil.rules import symmetry_of
from .beam import Beam, BeamRule, beam_rule, trace_beam
from .beam_psf import Kind, Psf, PsfModel, psf_of_beam
from .converged import at_sensor, converge, scenes_of
from .kernel import check_pixels
from .rounding import hit_rounding, path_rounding, rough, tell
from .wave_psf import period
from .zernike import zernike

# What a tolerance bounds.
Of = Literal["kernel", "gradient"]
# Default tolerance: the sum of the absolute errors of a kernel's pixels.
TOLERANCE = 1e-2
# Polynomial degrees to try, first of a coarse, then of a fine trace; cells of a grid to try.
_DEGREES = (4, 6, 8, 10, 12, 14, 16), (20, 24)
_CELLS = (32, 48, 64, 96, 128, 192, 256, 384, 512, 768)
# The error falls with the square of the number of cells, and a step is 4/3 or more: the kernels of
# more cells are off by at most their change over this.
_STEP = 0.75
# Light beside a kernel that is told of.
LOST = 0.01
_UM = 1e3  # per mm


def converged_psf(
    lens: Lens,
    field: Numbers,
    distance: Numbers,
    wavelengths: Numbers,
    pixel: Numbers,
    size: int = 21,
    model: Kind | Literal["auto"] = "auto",
    tolerance: float = TOLERANCE,
    norm: int = 1,
    of: Of = "kernel",
) -> PsfModel:
    """A PSF model whose kernels are within `tolerance`, the sum of the absolute errors of the
    pixels; with `norm` 2 the root of the sum of their squares: the error of a white-noise picture.

    field: angle along y, or (x, y), in radians, or many pairs (F, 2). distance: mm, one or (Z,).
    Other arguments as in `psf`; all are known numbers. The model is valid for every field at every
    distance. "auto" takes the cheapest model within the tolerance of "waves", and `errors` gives
    the differences of the others.
    of: "kernel": the tolerance bounds the kernel alone; the relative error of its derivatives was
        up to five times as large. "gradient": a fifth of it is kept, so that it holds for both.

    Warns if no degree or no grid that is tried meets the tolerance; if rounding does not, as in
    float32 of waves from a large lens, where the search ends at what rounding allows; and if more
    than 1 % of the light falls beside the kernel, with a size for which less does. ValueError
    inside a trace.
    """
    seen = field, distance, wavelengths
    require_one_of("of", of, get_args(Of))
    exact = tolerance / 5 if of == "gradient" else tolerance
    found, view = chosen_psf(lens, seen, pixel, size, model, exact, norm)
    view.tell_of_loss(found)
    return found


def chosen_psf(
    lens: Lens, seen: tuple[Numbers, Numbers, Numbers], pixel: Numbers, size: int,
    model: Kind | Literal["auto"], tolerance: float, norm: int = 1
) -> tuple[PsfModel, "_View"]:  # fmt: skip
    """`converged_psf` of field, distance and wavelengths `seen`, silent on light beside the
    kernel, and what tells of it."""
    _check_asked(model, tolerance, norm)
    known = known_values((lens, seen, pixel))
    if known is None:
        raise ValueError(
            "inside jax.jit or jax.vmap the cost of a kernel cannot follow from a tolerance: make "
            "the model outside and pass it on, model=drt_jax.converged_psf(...)"
        )
    with jax.core.eval_context():
        lens, seen, pixel = known
        side, size = check_pixels(pixel, size, lens.curvature.dtype)
        scenes = scenes_of(lens, *seen)
        base = converge(scenes_of, lens, seen, min(tolerance, 1e-3), at_sensor, False).rule
        clipped = base if isinstance(base, Clipped) else None
        symmetry = symmetry_of(lens, seen[0])
        rounded = {"hits": hit_rounding(lens)}
        if model in ("waves", "auto"):
            paths = path_rounding(lens, scenes, True) if rough(lens) else 0.0
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
        worst = max(rounded.get("phase", 0.0), view.hit_error(model))
        tell(lens, "kernels", worst, tolerance, "", 3)
        view = dataclasses.replace(view, rounded=worst)
        if model != "auto":
            return PsfModel(model, rule, view.cells(model, tolerance)), view
        return _cheapest(view, rule, tolerance), view


def _check_asked(model: str, tolerance: float, norm: int) -> None:
    require_one_of("model", model, (*get_args(Kind), "auto"))
    if not 0 < tolerance < 1:
        raise ValueError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}")
    if norm not in (1, 2):
        raise ValueError(f"norm: expected 1 or 2, got {norm!r}")


@functools.partial(jit, wanted=LARGE)
def traced(lens: Lens, scene: Scene, rule: BeamRule) -> Beam:
    """`trace_beam`, compiled."""
    return trace_beam(lens, scene, rule)


# Each number of cells needs its own compiled program, which runs once per scene.
_kernels = jit(psf_of_beam, ONCE, static_argnames=("size", "kind", "cells"))
_refocused = jax.jit(Beam.refocused)


@dataclasses.dataclass(frozen=True)
class _View:
    """The beams of scenes, and the pixels of the kernels. All numbers are known. rounded: what
    rounding adds to the error of a kernel."""

    lens: Lens
    scenes: tuple[Scene, ...]
    beams: tuple[Beam, ...]
    pixel: Array
    size: int
    norm: int
    rounded: float = 0.0

    def made(self, kind: Kind, cells: int) -> list[Psf]:
        """What a model makes of each scene."""
        named = {"size": self.size, "kind": kind, "cells": cells}
        return [
            _kernels(self.lens, scene.wavelengths, beam, self.pixel, None, **named)
            for scene, beam in zip(self.scenes, self.beams)
        ]

    def kernels(self, kind: Kind, cells: int) -> np.ndarray:
        """Kernels of all scenes and wavelengths, (scenes W, size, size)."""
        return np.concatenate([np.asarray(one.kernel) for one in self.made(kind, cells)])

    def hit_error(self, model: Kind | Literal["auto"]) -> float:
        """What rounding of hits adds to the error of kernels; those of waves follow from paths. It
        is measured by a defocus that moves rays at the rim of the pupil as far. Sums of errors in
        float32 at Airy's radius: 0.02 for 0.006 of a microscope objective, 3e-4 for 4e-5 where
        the spot is large."""
        if model == "waves" or not rough(self.lens):
            return 0.0
        given: tuple[Kind, int] = ("gaussian", 0) if model == "gaussian" else ("rays", _CELLS[0])
        cones = [float(np.max(one.solid_angle)) for one in self.made(*given)]
        steps = [hit_rounding(self.lens) * np.sqrt(np.pi / a) if a > 0 else 0.0 for a in cones]
        beams = [_refocused(b, b.index.dtype.type(step)) for b, step in zip(self.beams, steps)]
        moved = dataclasses.replace(self, beams=tuple(beams))
        return difference(moved.kernels(*given), self.kernels(*given), self.norm)

    def tell_of_loss(self, model: PsfModel) -> None:
        """Warns of light beside the kernels of a model."""
        lost = [float(jnp.max(one.outside)) for one in self.made(model.kind, model.cells)]
        k = int(np.argmax(lost))
        tell_of_loss(lost[k], self.scenes[k], self.beams[k], self.pixel, self.size, model.kind, 4)

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
        """The fewest cells for which no periodic copy of spot or window overlaps the window."""
        hits = np.asarray(beam.hits[:, -1])
        middle = np.mean(hits[:, np.asarray(beam.known)], axis=-1)
        reach = np.max(np.where(np.asarray(beam.known), np.abs(hits - middle[:, None, None]), 0))
        width = self.size * float(self.pixel)
        needed = max(width, width / 2 + 1.1 * float(reach))
        return int(np.max(np.ceil(needed / np.asarray(period(beam, scene.wavelengths, 1)))))


def difference(a: np.ndarray, b: np.ndarray, norm: int = 1) -> float:
    """The largest difference of kernels (..., size, size): the sum of the absolute differences of
    their pixels or, with `norm` 2, the root of the sum of the squares."""
    total = np.sum(np.abs(a - b) ** norm, axis=(-2, -1))
    return float(np.max(total ** (1 / norm)))


def tell_of_loss(
    lost: float, scene: Scene, beam: Beam, pixel: Numbers, size: int, kind: Kind, level: int
) -> None:
    """Warns if more than `LOST` of the light falls beside a kernel, with a size for which less
    does. scene, beam: where most is lost."""
    if lost <= LOST:
        return
    hits, weights = np.asarray(beam.hits[:, -1], float), np.asarray(beam.weights, float)
    share = weights / np.maximum(np.sum(weights, axis=-1, keepdims=True), np.finfo(float).tiny)
    centre = np.mean(np.sum(share * hits, axis=-1), axis=-1)
    away = np.max(np.abs(hits - centre[:, None, None]), axis=0)
    # Some of the light that is lost stays with rays that end farther out, a part is diffracted
    # farther from all others: from a round pupil 2 / (pi v) at v = 2 pi NA r / wavelength, and
    # wavelength / (2 NA) is a `period`.
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
    """The lowest degree whose polynomials fit the rays, and the error of the fit beyond rounding,
    relative to the spot or, for the phase, in radians. There are more rays than terms. rounded: of
    hits, mm, and of phases, radians."""
    pairs = [(b, s, w) for b, s in zip(beams, scenes) for w in range(s.wavelengths.size)]
    for degree in degrees:
        error = max(_misfit(b, s, w, pixel, rounded, degree) for b, s, w in pairs)
        if error <= tolerance:
            break
    return degree, error


def _misfit(
    beam: Beam, scene: Scene, wavelength: int, pixel: Array, rounded: dict[str, float], degree: int
) -> float:
    """The error of the fit at one wavelength, see `_degree`."""
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
    # The error of the wave field is the phase error; it counts twice. Without the tilt towards the
    # middle of the light, as in `Beam.over_directions`.
    path = path + float(beam.index[wavelength]) * np.sum(np.float64(middle) * directions, axis=0)
    phase = path[None] * (4 * np.pi * _UM / float(scene.wavelengths[wavelength]))
    return max(error, _residual(directions, phase, weight, degree) - 2 * rounded["phase"])


def _mean(hits: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return cast(np.ndarray, np.sum(weight**2 * hits, axis=-1, keepdims=True))


def _residual(points: np.ndarray, values: np.ndarray, weight: np.ndarray, degree: int) -> float:
    """RMS residual of a fit of polynomials of a degree to values (D, Q) at points (2, Q); `weight`
    (Q,) is the square root of the light."""
    centre = _mean(points, weight)
    scale = 2 * np.sqrt(np.sum(weight**2 * (points - centre) ** 2, axis=-1, keepdims=True))
    basis = np.asarray(zernike(jnp.asarray((points - centre) / scale), degree))
    matrix, right = (np.float64(a * weight).T for a in (basis, values))
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return float(np.sqrt(np.sum((matrix @ found - right) ** 2)))


def _cheapest(view: _View, rule: BeamRule, tolerance: float) -> PsfModel:
    """The first model, from cheap to exact, that is within the tolerance of "waves"."""
    ladder: list[tuple[Kind, int]] = [
        (kind, view.cells(kind, tolerance)) for kind in get_args(Kind)
    ]
    kernels = [view.kernels(*one) for one in ladder]
    errors: dict[str, float]
    pairs = zip(ladder[:-1], kernels)
    errors = {kind: difference(k, kernels[-1], view.norm) for (kind, _), k in pairs}
    kind, cells = next(one for one in ladder if errors.get(one[0], 0.0) <= tolerance)
    return PsfModel(kind, rule, cells, errors)
