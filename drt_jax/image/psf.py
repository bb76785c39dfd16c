"""The point spread function (PSF) on the pixels, by one of three models.

"gaussian" uses the moments of the rays, as in the paper; "rays" the light of all rays; "waves" adds
diffraction. "auto" takes the first of these whose kernel is within the tolerance of "waves". The
degree of the polynomials and the number of cells follow from a tolerance, outside of `jax.jit`;
what `converge` makes is accepted anywhere.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, ONCE, jit
from ..inputs import require, require_one_of, require_tolerance, warn
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..numerics import Numbers, known_values, real_array
from ..pupil.rules import require_fit, rule_rays, symmetry_of
from ..rays.known import Known
from .beam import Beam, BeamRule, beam_rule, trace_beam
from .beam_psf import Kind, Psf, Sampling, psf_of_beam
from .converged import at_sensor, find_rule
from .kernel import Pixels, check_pixels
from .refined import STEP, beams_of, refine, require_known
from .rounding import below_double, check_dtype, hit_rounding, path_rounding
from .wave_psf import period
from .zernike import zernike

# What a tolerance bounds.
Of = Literal["kernel", "gradient"]
# Default tolerance: the sum of the absolute errors of a kernel's pixels.
_TOLERANCE = 1e-2
# Polynomial degrees to try, first of a coarse, then of a fine trace; cells of a grid to try.
_DEGREES = (4, 6, 8, 10, 12, 14, 16), (20, 24)
_CELLS = (32, 48, 64, 96, 128, 192, 256, 384, 512, 768)
# Fraction of the light outside of a kernel above which a warning is given.
_LOST = 0.01
_UM = 1e3  # per mm
_LINES = 64  # at least so many frequencies up to Nyquist


def psf(
    lens: Lens,
    scene: Scene,
    pixel: Numbers,
    size: int = 21,
    kind: Kind | Literal["auto"] = "auto",
    sampling: float | Sampling | None = None,
    centre: Numbers | None = None,
    defocus: Numbers = 0.0,
) -> Psf:
    """The point spread functions of object points on `size` x `size` pixels, see `Psf`.

    lens, scene: the lens, and object points with their wavelengths. Several points are traced one
        after the other, with one sampling; also in reverse mode only the rays of one are in memory.
    pixel: side of a pixel, mm.
    size: number of pixels along a side of the kernel.
    kind: "gaussian", "rays", "waves", or "auto": the cheapest of these within the tolerance of
        "waves".
    sampling: a tolerance, the bound of the sum of the absolute errors of a kernel's pixels; or a
        `Sampling`, which has its own kind and is needed inside `jax.jit` and `jax.vmap`. None: 1e-2
        or what the dtype allows, of which it warns.
    centre: (2,), mm, centre of the kernel on the sensor; by default the mean of the centroids of
        the wavelengths.
    defocus: (), mm by which the sensor is moved back. This needs no new ray trace.

    Returns a `Psf`, with the points of the scene as first axes. The stop is filled uniformly with
    light. Differentiable in all numbers, in every mode. With a `Sampling`, warns outside of
    `jax.jit` if more than 1 % of the light of one of several points falls outside of its kernel,
    with a size for which less does. ValueError as in `lens.scene.checked_scene`, for a pixel that
    is not above 0, if no ray arrives, and for a field whose symmetry the sampling does not have:
    one for fields along y traces half a pupil. Inside `jax.jit`, where the field is not known, the
    kernel of such a field is 0.
    """
    scene, dtype = checked_scene(lens, scene), lens.curvature.dtype
    made = isinstance(sampling, Sampling)
    pixels = check_pixels(pixel, size, dtype)
    if not isinstance(sampling, Sampling):
        sampling = converged_psf(lens, scene, pixel, size, kind, sampling)
    elif kind not in ("auto", sampling.kind):
        raise ValueError(f"kind: the sampling is of the kind {sampling.kind!r}, got {kind!r}")
    if centre is not None:
        pixels = dataclasses.replace(pixels, centre=real_array("centre", centre, dtype))
        if (shape := jnp.shape(pixels.centre)) != (2,):
            raise ValueError(f"centre: expected x and y in mm, got shape {shape}")
    step = real_array("defocus", defocus, dtype)
    require_fit(sampling.rule.rule.symmetry, scene.field)
    how = dataclasses.replace(sampling, errors={})  # numbers that no program needs
    known = rule_rays(lens, scene, how.rule.rule)
    found = _psf(lens, scene, how, pixels, step, known)
    if made and scene.shape:
        warn_of_loss(lens, scene, found.outside, pixels, how)
    return found


@functools.partial(jit, wanted=LARGE)
def _psf(
    lens: Lens, scene: Scene, how: Sampling, pixels: Pixels, defocus: Array, known: Known
) -> Psf:
    """`psf` of checked arguments, of one object point after the other."""

    def one(point: tuple[tuple[Array, Array], Known]) -> Psf:
        place, known = point
        beam = trace_beam(lens, scene.at(*place), how.rule, known).refocused(defocus)
        return psf_of_beam(lens, beam, scene.wavelengths, pixels, how.kind, how.cells)

    if not scene.shape:
        return one(((scene.field, scene.distance), known))
    found = jax.lax.map(jax.checkpoint(one), (scene.flat(), known))
    return jax.tree.map(lambda a: a.reshape(*scene.shape, *a.shape[1:]), found)


def converged_psf(
    lens: Lens,
    scene: Scene,
    pixel: Numbers,
    size: int = 21,
    kind: Kind | Literal["auto"] = "auto",
    tolerance: float | None = None,
    norm: int = 1,
    of: Of = "kernel",
) -> Sampling:
    """A sampling whose kernels are accurate to a tolerance, for `psf`.

    lens, scene: the lens, and object points with their wavelengths. The sampling is valid for all.
    pixel: side of a pixel, mm.
    size: number of pixels along a side of the kernels.
    kind: "gaussian", "rays", "waves", or "auto": the cheapest of these within the tolerance of
        "waves"; `Sampling.errors` then gives the differences of the other kinds.
    tolerance: bound of the sum of the absolute errors of a kernel's pixels; None as in `psf`.
    norm: 1; or 2, to bound the root of the sum of the squared errors, which is the error of a
        white-noise picture.
    of: "kernel": the tolerance bounds the kernel alone; the relative error of its derivatives was
        up to five times as large. "gradient": a fifth of the tolerance is used, so that it holds
        for both.

    All numbers must be known; ValueError inside a trace, and for a tolerance that the dtype does
    not allow, as float32 for waves from a large lens. Warns if no degree or no grid that is tried
    meets the tolerance, and if more than 1 % of the light falls outside of the kernel, with a size
    for which less does.
    """
    require_one_of("of", of, get_args(Of))
    asked = tolerance is not None
    bound = require_tolerance(tolerance if asked else _TOLERANCE)
    bound = bound / 5 if of == "gradient" else bound
    found, view = chosen_psf(lens, scene, pixel, size, kind, bound, norm)
    check_dtype(lens, "kernels", view.rounded, bound, "", asked)
    outside = np.stack([one.outside for one in view.psfs(found.kind, found.cells)])
    _warn(outside, view.beams.__getitem__, view.wavelengths, view.pixels, found.kind)
    return found


def chosen_psf(
    lens: Lens, scene: Scene, pixel: Numbers, size: int, kind: Kind | Literal["auto"],
    tolerance: float, norm: int = 1
) -> tuple[Sampling, "_View"]:  # fmt: skip
    """`converged_psf` without its warning of light outside of the kernels, and without regard to
    whether the dtype allows the tolerance: the search ends at the accuracy that rounding allows.

    Returns the sampling, and the `_View` with the beams that it was chosen for and the error from
    rounding.
    """
    require_one_of("kind", kind, (*get_args(Kind), "auto"))
    require_tolerance(tolerance)
    require(norm in (1, 2), f"norm: expected 1 or 2, got {norm!r}")
    known = require_known((lens, scene, pixel), "the cost of a kernel", "psf")
    with jax.core.eval_context():
        lens, scene, pixel = known
        scene = checked_scene(lens, scene)
        pixels = check_pixels(pixel, size, lens.curvature.dtype)
        scenes, waves = scene.each(), scene.wavelengths
        base = find_rule(lens, scene, min(tolerance, 1e-3), at_sensor, False).rule
        symmetry = symmetry_of(lens, scene.field)
        rule_of = functools.partial(beam_rule, symmetry=symmetry, clipped=base)
        rounded = {"hits": hit_rounding(lens)}
        if kind in ("waves", "auto"):
            paths = path_rounding(lens, scenes, True) if below_double(lens) else 0.0
            rounded["phase"] = 4 * np.pi * paths

        def fits() -> Iterator[tuple[int, list[Beam]]]:
            """Degrees of polynomials, with beams that have enough rays for them."""
            for degrees in _DEGREES:
                beams = [beams_of(lens, one, rule_of(degrees[-1])) for one in scenes]
                yield from ((degree, beams) for degree in degrees)

        def misfit(fit: tuple[int, list[Beam]]) -> float:
            """Error of the fit of the worst beam and wavelength."""
            degree, beams = fit
            pairs = ((beam, w) for beam in beams for w in range(waves.size))
            return max(_misfit(b, waves, w, pixels.side, rounded, degree) for b, w in pairs)

        # Half of the tolerance is for the error of the fit, the rest for the grid of cells.
        ((degree, beams),), error = refine(fits(), misfit, tolerance / 2, together=1)
        if error > tolerance / 2:
            warn(
                f"polynomials of degree {degree} reproduce the rays to {error:.1e} only, not to "
                f"half of {tolerance:.1e}"
            )
        beams = [dataclasses.replace(b, degree=degree, azimuths=degree) for b in beams]
        view = _View(lens, waves, beams, pixels, norm)
        worst = max(rounded.get("phase", 0.0), view.hit_error(kind))
        view = dataclasses.replace(view, rounded=worst)
        left = max(tolerance - error, tolerance / 2)
        return view.sampling(kind, rule_of(degree), left), view


# Each number of cells needs its own compiled program, which runs once for each beam.
_kernels = jit(psf_of_beam, ONCE, static_argnames=("kind", "cells"))
_refocused = jax.jit(Beam.refocused)


@dataclasses.dataclass(frozen=True)
class _View:
    """The beams of object points, and the pixels of their kernels. All numbers are known.

    lens: the lens.
    wavelengths: (W,), um.
    beams: of the object points.
    pixels: those of the kernels.
    norm: as in `converged_psf`.
    rounded: error of a kernel from rounding.
    """

    lens: Lens
    wavelengths: Array
    beams: Sequence[Beam]
    pixels: Pixels
    norm: int
    rounded: float = 0.0

    def psfs(self, kind: Kind, cells: int) -> list[Psf]:
        """The `Psf` of each point by a model."""
        run = functools.partial(_kernels, kind=kind, cells=cells)
        return [run(self.lens, beam, self.wavelengths, self.pixels) for beam in self.beams]

    def kernels(self, kind: Kind, cells: int) -> np.ndarray:
        """Kernels of all points and wavelengths, (P W, size, size)."""
        return np.concatenate([np.asarray(one.kernel) for one in self.psfs(kind, cells)])

    def hit_error(self, kind: Kind | Literal["auto"]) -> float:
        """Estimated error of the kernels from rounding of hits; that of waves follows from the
        paths instead. It is measured by a defocus that moves the rays at the rim of the pupil by
        the rounding of hits: rounding / NA. In float32 at pixels of the Airy radius it gave 0.02
        for an error of 0.006 of a microscope objective, and 3e-4 for 4e-5 where the spot is
        large."""
        if kind == "waves" or not below_double(self.lens):
            return 0.0
        trial: tuple[Kind, int] = ("gaussian", 0) if kind == "gaussian" else ("rays", _CELLS[0])
        cones = [float(np.max(one.solid_angle)) for one in self.psfs(*trial)]
        steps = [hit_rounding(self.lens) * np.sqrt(np.pi / a) if a > 0 else 0.0 for a in cones]
        beams = [_refocused(b, b.index.dtype.type(step)) for b, step in zip(self.beams, steps)]
        moved = dataclasses.replace(self, beams=beams)
        return difference(moved.kernels(*trial), self.kernels(*trial), self.norm)

    def sampling(self, kind: Kind | Literal["auto"], rule: BeamRule, tolerance: float) -> Sampling:
        """The sampling of a kind or, for "auto", of the first kind that is within the tolerance of
        "waves"."""
        if kind != "auto":
            return Sampling(kind, rule, self.cells(kind, tolerance))
        kinds: tuple[Kind, ...] = get_args(Kind)
        cells = [self.cells(one, tolerance) for one in kinds]
        *others, waves = map(self.kernels, kinds, cells)
        apart = [difference(one, waves, self.norm) for one in others]
        best = next((k for k, error in enumerate(apart) if error <= tolerance), len(apart))
        return Sampling(kinds[best], rule, cells[best], dict[str, float](zip(kinds, apart)))

    def cells(self, kind: Kind, tolerance: float) -> int:
        """The smallest number of cells for which the kernels are within the tolerance."""
        if kind == "gaussian":
            return 0
        first = _CELLS[0] if kind == "rays" else max(map(self._fewest, self.beams))
        tried = [n for n in _CELLS if n >= first] or [_CELLS[-1]]
        trials = ((n, self.kernels(kind, n)) for n in tried)
        change = lambda old, new: difference(old[1], new[1], self.norm) / STEP  # noqa: E731
        bound = max(tolerance, self.rounded)
        (*_, (cells, _)), error = refine(trials, change, bound)
        if error > bound:
            warn(
                f"{kind} of {cells} x {cells} cells have converged to {error:.1e} only, not to "
                f"{tolerance:.1e}: the spot may be too large; take a larger tolerance"
            )
        return cells

    def _fewest(self, beam: Beam) -> int:
        """The fewest cells for which no periodic copy of the spot overlaps the kernel."""
        hits = np.asarray(beam.hits[:, -1])
        middle = np.mean(hits[:, np.asarray(beam.known)], axis=-1)
        reach = np.max(np.where(np.asarray(beam.known), np.abs(hits - middle[:, None, None]), 0))
        width = self.pixels.size * float(self.pixels.side)
        needed = max(width, width / 2 + 1.1 * float(reach))
        return int(np.max(np.ceil(needed / np.asarray(period(beam, self.wavelengths, 1)))))


def difference(a: np.ndarray, b: np.ndarray, norm: int = 1) -> float:
    """Largest difference of kernels (..., size, size): of the sums of the absolute differences
    of their pixels or, with `norm` 2, of the roots of the sums of the squares."""
    total = np.sum(np.abs(a - b) ** norm, axis=(-2, -1))
    return float(np.max(total ** (1 / norm)))


def warn_of_loss(
    lens: Lens, scene: Scene, outside: Array, pixels: Pixels, sampling: Sampling
) -> None:
    """Warns if more than `_LOST` of the light of an object point falls outside of its kernel, and
    names a size for which less does. Only where all numbers are known.

    lens, scene: the lens, and the object points (...) with their wavelengths.
    outside: (..., W), fractions of the light outside.
    pixels, sampling: of the kernels.
    """
    known = known_values((lens, scene, outside, pixels))
    if known is not None:
        with jax.core.eval_context():
            lens, scene, outside, pixels = known
            beam = lambda k: beams_of(lens, scene.each()[k], sampling.rule)  # noqa: E731
            _warn(np.asarray(outside), beam, scene.wavelengths, pixels, sampling.kind)


def _warn(
    outside: np.ndarray, beams: Callable[[int], Beam], wavelengths: Array, pixels: Pixels,
    kind: Kind
) -> None:  # fmt: skip
    """`warn_of_loss` of known numbers.

    beams: function that returns the beam of a point by its index.

    For each share p of `_LOST` that diffraction may lose, the radius that is needed is the sum of
    two: within the first, rays have all but _LOST - p of the light; beyond the second, a round
    pupil diffracts p. That is 2 / (pi v) = p at v = 2 pi NA r / wavelength, so r = 2 / (pi^2 p)
    wavelength / (2 NA), and wavelength / (2 NA) is a `period`.
    """
    lost = np.max(outside, axis=-1).ravel()
    if np.max(lost) <= _LOST:
        return
    beam, size = beams(int(np.argmax(lost))), pixels.size
    hits, weights = np.asarray(beam.hits[:, -1], float), np.asarray(beam.weights, float)
    share = weights / np.maximum(np.sum(weights, axis=-1, keepdims=True), np.finfo(float).tiny)
    centre = np.mean(np.sum(share * hits, axis=-1), axis=-1)
    away = np.max(np.abs(hits - centre[:, None, None]), axis=0)
    # Shares of the loss for diffraction, and the radius that they need, times the share.
    parts, waves = np.linspace(0.05, 0.95, 19) * _LOST, kind == "waves"
    spread = 2 / np.pi**2 * waves * np.max(np.asarray(period(beam, wavelengths, 1)), axis=0)
    reach = np.zeros((len(away), len(parts)))
    for k, (far, light) in enumerate(zip(away, share)):
        order = np.argsort(far)
        last = np.searchsorted(np.cumsum(light[order]), 1 - _LOST + parts)
        reach[k] = far[order][np.minimum(last, len(far) - 1)] + spread[k] / parts
    needed = np.min(np.max(reach, axis=0)) / float(np.asarray(pixels.side))
    more = max(2 * int(np.ceil(needed)) + 1, size + 2)
    warn(
        f"size: {100 * np.max(lost):.2g} % of the light falls outside a kernel of {size} x {size} "
        f"pixels; {more} x {more} hold 99 %"
    )


def _misfit(
    beam: Beam, wavelengths: Array, index: int, pixel: Array, rounded: dict[str, float], degree: int
) -> float:
    """Error, beyond rounding, of polynomials of a degree fitted to the rays of one wavelength:
    relative to the spot or, for the phase, in radians. There are more rays than terms.

    index: of the wavelength.
    rounded: rounding of hits, mm, and of phases, radians.
    """
    cosines, waves = beam.on_sphere()
    rows = jax.tree.map(np.asarray, (beam.weights, beam.known, waves, beam.hits[:, -1]))
    weight, known, path, hits = (a[..., index, :] for a in rows)
    share = np.where(known, np.abs(weight), 0) / np.sum(np.abs(weight))
    middle = np.sum(share * hits, axis=-1, keepdims=True)
    spread = np.sqrt(np.sum(share * (hits - middle) ** 2))
    points, directions = (np.asarray(a[:, index]) for a in (beam.points, cosines))
    error = _residual(points, hits - middle, share, degree) - 2 * rounded["hits"]
    error /= max(float(spread), float(pixel))
    if "phase" not in rounded:
        return error
    # The error of the wave field is the phase error, and that of the intensity twice as large: 4 pi
    # in place of 2 pi. The tilt towards the centroid is removed, as in `Beam.over_directions`.
    path = path + float(beam.index[index]) * np.sum(np.float64(middle) * directions, axis=0)
    phase = path[None] * (4 * np.pi * _UM / float(wavelengths[index]))
    return max(error, _residual(directions, phase, share, degree) - 2 * rounded["phase"])


def _residual(points: np.ndarray, values: np.ndarray, share: np.ndarray, degree: int) -> float:
    """RMS residual of a fit of polynomials of a degree.

    points: (2, Q).
    values: (D, Q).
    share: (Q,), normalised light.
    degree: of the polynomials.
    """
    centre = np.sum(share * points, axis=-1, keepdims=True)
    scale = 2 * np.sqrt(np.sum(share * (points - centre) ** 2, axis=-1, keepdims=True))
    basis = np.asarray(zernike(jnp.asarray((points - centre) / scale), degree))
    matrix, right = (np.float64(a * np.sqrt(share)).T for a in (basis, values))
    found = np.linalg.lstsq(matrix, right, rcond=None)[0]
    return float(np.sqrt(np.sum((matrix @ found - right) ** 2)))


class GaussianError(NamedTuple):
    """Differences of Gaussian kernels from those of waves for object points (...), each for the
    worst wavelength.

    misplaced: (...), sum of the absolute differences of all pixels: 0 to 2.
    contrast: (...), largest difference of the MTF of both kernels up to the pixels' Nyquist
        frequency.
    outside: (...), fraction of the light that falls outside of the kernel of waves.
    """

    misplaced: np.ndarray
    contrast: np.ndarray
    outside: np.ndarray


def gaussian_error(
    lens: Lens, scene: Scene, pixel: Numbers, size: int = 21, tolerance: float = 1e-2
) -> GaussianError:
    """Differences between the Gaussian kernels of the moments and the kernels with diffraction.

    lens, scene: the lens, and object points with their wavelengths.
    pixel: side of a pixel, mm.
    size: number of pixels along a side of a kernel.
    tolerance: of the kernels of waves, as in `psf`.

    All numbers must be known. ValueError inside a trace, and as of `psf`.
    """
    known = known_values((lens, scene, pixel))
    require(known is not None, "gaussian_error compares known numbers: call it outside of jax.jit")
    lens, scene, pixel = known
    fine, view = chosen_psf(lens, scene, pixel, size, "waves", tolerance)
    check_dtype(lens, "kernels", view.rounded, tolerance, "")
    models = Sampling("gaussian", fine.rule, 0), fine
    found = []
    for point in checked_scene(lens, scene).each():
        blur, light = (psf(lens, point, pixel, size, sampling=model) for model in models)
        a, b = np.asarray(blur.kernel), np.asarray(light.kernel)
        found.append((difference(a, b), _contrast(a, b), np.max(np.asarray(light.outside))))
    return GaussianError(*np.array(found).T.reshape(3, *scene.shape))


def _contrast(a: np.ndarray, b: np.ndarray) -> float:
    """Largest difference of the MTFs of two sets of kernels (W, size, size)."""
    count = max(2 * _LINES, 2 * a.shape[-1])
    spectra = [np.abs(np.fft.rfft2(k, (count, count))) for k in (a, b)]
    first, second = (s / np.maximum(s[:, :1, :1], 1e-300) for s in spectra)
    return float(np.max(np.abs(first - second)))
