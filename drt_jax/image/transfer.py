"""Optical transfer functions: the autocorrelation of the pupil function of a beam, in direction
cosines.

A grating of f cycles/mm on the sensor is formed by pairs of directions that differ by s = f
wavelength / n. Its contrast is Hopkins' formula with the real pupil (Goodman, Introduction to
Fourier Optics, ch. 6):

    OTF(f) = integral of P(d + s / 2) conj(P(d - s / 2)) over directions d / integral of |P|^2,

where P is the amplitude in direction cosines on the sensor. The grid of d covers the overlap of
both pupils, however small it is, so the function is accurate up to its cut-off. In the limit of
short wavelengths it is the mean of exp(-2 pi i f.x) over rays.
"""

import functools
from typing import Literal, NamedTuple, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require, require_one_of, require_tolerance
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..numerics import Numbers, einsum, real_array, safe_divide, safe_sqrt
from ..pupil.rules import PupilRule
from .beam import Beam, BeamRule, beam_rule, means
from .beam_psf import DEGREE, Sampling
from .cover import cover
from .refined import TOLERANCE, beams_of, to_tolerance
from .rounding import warn_of_paths
from .spot import normalised
from .spots import light_rule
from .wave_psf import pupil_function, shared_part

Model = Literal["waves", "rays"]
_UM = 1e3  # per mm


class Transfer(NamedTuple):
    """Transfer functions at N frequencies, for all wavelengths together.

    frequencies: (N,), cycles/mm on the sensor.
    otf: complex, (..., 2, N) or, through focus, (..., Z, 2, N); 1 at frequency 0. Index 0 of the
        axis of 2 is a grating across the y axis of the sensor (tangential, for a field along y),
        index 1 one across its x axis (sagittal). The phase refers to the centroid of the light.
    limit: the same for waves without aberrations in the same pupil.

    All are 0 where no light arrives.
    """

    frequencies: Array
    otf: Array
    limit: Array

    @property
    def mtf(self) -> Array:
        """Modulus of the otf."""
        return jnp.abs(self.otf)


def transfer(
    lens: Lens,
    scene: Scene,
    frequencies: Numbers,
    kind: Model | None = None,
    focus: Numbers = 0.0,
    sampling: float | PupilRule | Sampling | None = None,
) -> Transfer:
    """Optical transfer functions over frequency, field and focus, see `Transfer`.

    lens, scene: the lens, and object points with their wavelengths. The weight of a wavelength is
        multiplied by the throughput, so vignetted wavelengths count less.
    frequencies: (N,), cycles/mm.
    kind: "waves" (diffraction, the default) or "rays" (geometric).
    focus: (), mm by which the sensor is moved back; or (Z,), through focus: arrays are then
        (..., Z, 2, N), and no more rays are traced.
    sampling: a tolerance, the absolute error of the contrast, to which the cells of the pupil grid
        are chosen; None: 1e-3, or what the dtype allows; a pupil rule, whose symmetry and kind
        (`Gauss` or `Clipped`) are taken, with cells for 1e-3, or 128 of them inside `jit` and
        `vmap`; or a `Sampling`, for all of it.

    Differentiable in every mode. For waves, warns of float32 as `wavefront` does. ValueError as of
    `lens.scene.checked_scene`, without a rule inside a trace, and for a tolerance that is not
    between 0 and 1, or that the dtype does not allow. Warns if the tolerance is not met.
    """
    scene, plan = checked_scene(lens, scene), planned(lens, scene, kind, sampling)
    values, steps = places_of(lens, "frequencies", frequencies, focus)
    beams = beams_of(lens, scene, plan.rule)
    run = functools.partial(_transfer, model=plan.kind)
    known = lens, beams, (scene.wavelengths, values, scene.spectrum), steps
    otf, limit = to_tolerance(run, known, plan.cells, plan.tolerance, lambda *_: 0)
    return Transfer(values, otf, limit)


class Plan(NamedTuple):
    """A sampling in full.

    kind: "waves" or "rays".
    rule: rays and polynomials of the beams.
    cells: number of cells along a side of the pupil grid; None for as many as the tolerance needs.
    tolerance: absolute error.
    """

    kind: Model
    rule: BeamRule
    cells: int | None
    tolerance: float


def planned(
    lens: Lens, scene: Scene, kind: Model | None, sampling: float | PupilRule | Sampling | None
) -> Plan:
    """The `Plan` of a sampling, see `transfer`; for waves, warns of float32.

    scene: a scene that fits the lens.
    """
    own = sampling if isinstance(sampling, Sampling) else None
    if own is not None and kind not in (None, own.kind):
        raise ValueError(f"kind: the sampling is of the kind {own.kind!r}, got {kind!r}")
    model = cast(Model, kind or ("waves" if own is None else own.kind))
    require_one_of("kind", model, get_args(Model))
    asked = None
    if not (sampling is None or isinstance(sampling, PupilRule | Sampling)):
        asked = require_tolerance(sampling)
    if model == "waves":
        warn_of_paths(lens, scene, True, asked)
    if isinstance(sampling, Sampling):
        return Plan(model, sampling.rule, sampling.cells, TOLERANCE)
    rule, tolerance = sampling, asked or TOLERANCE
    if not isinstance(rule, PupilRule):
        rule = light_rule(lens, scene)
    return Plan(model, beam_rule(DEGREE, rule.symmetry, rule), None, tolerance)


def places_of(lens: Lens, name: str, places: Numbers, focus: Numbers) -> tuple[Array, Array]:
    """Frequencies or radii (N,), with their name for messages, and focus () or (Z,), as arrays."""
    dtype = lens.curvature.dtype
    values, steps = real_array(name, places, dtype), real_array("focus", focus, dtype)
    require(values.ndim == 1, f"{name}: expected (N,), got shape {values.shape}")
    require(steps.ndim <= 1, f"focus: expected one number or (Z,), got shape {steps.shape}")
    return values, steps


def strehl(lens: Lens, scene: Scene, sampling: float | PupilRule | Sampling | None = None) -> Array:
    """Strehl ratio: the irradiance at the centre of the image of a point, relative to that without
    aberrations in the same pupil: `|integral of P|^2 / (integral of |P|)^2` over direction cosines.

    lens, scene: as in `transfer`.
    sampling: as there, for waves; a tolerance is the absolute error of the ratio.

    Returns (..., W); 0 where no light arrives. The centre is the point where the wavefront has no
    tilt in the least-squares sense over the pupil: the peak, if the wavefront error is a quarter of
    a wave or less.
    """
    scene = checked_scene(lens, scene)
    plan = planned(lens, scene, "waves", sampling)
    arrays = lens, beams_of(lens, scene, plan.rule), scene.wavelengths
    return to_tolerance(_strehl, arrays, plan.cells, plan.tolerance, lambda *_: 0)


@functools.partial(jit, wanted=LARGE, static_argnames="cells")
def _strehl(lens: Lens, beams: Beam, wavelengths: Array, cells: int) -> Array:
    """`strehl` of beams (...), for a number of cells."""
    return beams.map(lambda beam: strehl_of(lens, beam, wavelengths, cells))


def strehl_of(lens: Lens, beam: Beam, wavelengths: Array, cells: int) -> Array:
    """Strehl ratio (W,) of one beam, see `strehl`."""
    lit = beam.throughput > 0
    low, high = beam.directions_extent()
    pupil = pupil_function(lens, beam, wavelengths, cells)
    density, inside, phase, turn, off = pupil((low + high) / 2, (high - low) / cells)
    size, phase = safe_sqrt(density) * inside, phase + jnp.sum(turn * off, axis=0)
    share = normalised(size, (1, 2))
    mean = lambda a: jnp.sum(share * a, axis=(1, 2), keepdims=True)  # noqa: E731
    # Remove the mean and the tilt by least squares: the normal equations of a x + b y.
    side = np.arange(cells) - (cells - 1) / 2
    places = off + jnp.asarray(np.stack(np.meshgrid(side, side)), phase.dtype)[:, None]
    x, y, phase = (a - mean(a) for a in (*places, phase))
    xx, xy, yy, xp, yp = map(mean, (x * x, x * y, y * y, x * phase, y * phase))
    det = xx * yy - xy**2
    slopes = safe_divide(yy * xp - xy * yp, det), safe_divide(xx * yp - xy * xp, det)
    phase = phase - slopes[0] * x - slopes[1] * y
    total = jnp.sum(_mean_wave(share, phase, turn - jnp.stack(slopes), inside), axis=(1, 2))
    return jnp.where(lit, total.real**2 + total.imag**2, 0)


@functools.partial(jit, wanted=LARGE, static_argnames=("model", "cells"))
def _transfer(
    lens: Lens, beams: Beam, asked: tuple[Array, Array, Array], focus: Array, model: Model,
    cells: int
) -> tuple[Array, Array]:  # fmt: skip
    """`transfer` of beams (...), for a number of cells: otf and limit.

    asked: wavelengths (W,), frequencies (N,) and spectrum (W,).
    """
    return beams.map(lambda beam: transfer_of(lens, beam, *asked, model, cells), focus)


def centre_of(beam: Beam, spectrum: Array) -> tuple[Array, Array]:
    """Fraction (W,) of the light on the sensor in each wavelength, and the centroid (2,), mm, of
    all.

    spectrum: (W,), weights of the wavelengths in the light that fills the stop.
    """
    share = normalised(spectrum * beam.throughput)
    centre = einsum("w,dw->d", share, means(beam.hits[:, -1], beam.weights))
    return share, centre


def transfer_of(
    lens: Lens,
    beam: Beam,
    wavelengths: Array,
    frequencies: Array,
    spectrum: Array,
    model: Model,
    cells: int,
) -> tuple[Array, Array]:
    """Transfer function and limit (2, N) of one beam, see `Transfer`."""
    share, centre = centre_of(beam, spectrum)
    of = _of_rays if model == "rays" else _of_waves
    found = of(lens, beam, wavelengths, frequencies, centre, cells)
    otf, limit = (einsum("w,wkn->kn", share.astype(a.dtype), a) for a in found)
    return otf, limit


def _phasor(size: Array, phase: Array) -> Array:
    """size exp(i phase)."""
    return jax.lax.complex(size * jnp.cos(phase), size * jnp.sin(phase))


def _mean_wave(size: Array, phase: Array, turn: Array, inside: Array) -> Array:
    """Means of a wave, size exp(i phase), over cells (..., N, N).

    size: amplitude.
    phase: at the centroid of the light of the cell, radians.
    turn: (2, ..., N, N), change of the phase over a cell along x and y.
    inside: fraction of the cell that light fills.

    A phase that is linear over the width w (in cells) gives the factor sinc(turn w / (2 pi)) along
    each axis, a second derivative b the mean phase b w^2 / 24. Where cells are too coarse for the
    wave, the mean is small, so that no false contrast appears.
    """
    x, y = jnp.sinc(turn * inside[None] / (2 * jnp.pi))
    bends = (jnp.asarray(jnp.gradient(turn[k], axis=a)) for k, a in enumerate((-1, -2)))
    return _phasor(size * x * y, phase + inside**2 * sum(bends) / 24)


def _of_rays(
    lens: Lens, beam: Beam, wavelengths: Array, frequencies: Array, centre: Array, cells: int
) -> tuple[Array, Array]:
    """Geometric transfer function (W, 2, N): the mean of exp(-2 pi i f.x) over the hits x of all
    cells of the stop; and its limit, which is 1."""
    side = (np.arange(cells) - (cells - 1) / 2) * (2 / cells)
    low, high = beam.extent()
    functions, middle, half = beam.over_stop(), (low + high) / 2, (high - low) / 2
    start, step = (middle - functions.centre) / functions.scale, half / functions.scale
    values, *slopes = functions.on_grid(start, step, side, slice(2))
    places = jnp.asarray(np.stack(np.meshgrid(side, side)), values.dtype)[:, None]
    stop = middle[..., None, None] + half[..., None, None] * places
    axes = middle, half * (2 / cells)
    inside, off = cover(lens, beam, stop, values[2:], beam.points, axes)
    weight = normalised(inside, (1, 2))
    # Change of the hits over a cell, [along, component].
    unit = (step * (2 / cells))[:, None, :, None, None]
    change = jnp.stack(slopes) * unit
    hits = values[:2] + jnp.sum(change * off[:, None], axis=0)
    inside, weight = (jnp.broadcast_to(a, hits.shape) for a in (inside, weight))
    hits = (hits - centre[:, None, None, None])[::-1]  # y first
    change = change[:, ::-1]

    def at(frequency: Array) -> Array:
        turn = -2 * jnp.pi * frequency
        waves = _mean_wave(weight, turn * hits, turn * change, inside)
        return jnp.sum(waves, axis=(2, 3))

    otf = jnp.moveaxis(jax.lax.map(at, frequencies), (0, 1, 2), (2, 1, 0))
    return otf, jnp.ones(otf.shape, hits.dtype)


def _of_waves(
    lens: Lens, beam: Beam, wavelengths: Array, frequencies: Array, centre: Array, cells: int
) -> tuple[Array, Array]:
    """Diffraction transfer function and its limit, (W, 2, N) each, see the module docstring.

    For each shear s the grid covers the overlap of the two pupils, which are shifted by s / 2 and
    -s / 2: their extent less |s|. The integrals are divided by that without shear. The factor
    exp(2 pi i f.centre) refers the phase to the centroid of the light.
    """
    pupil = pupil_function(lens, beam, wavelengths, cells)
    low, high = beam.directions_extent()
    middle = (low + high) / 2

    def sheared(shear: Array) -> tuple[Array, Array]:
        """The integrals (W,) of P conj(P) and of |P| |P| over the overlap of two pupils that are
        shifted by `shear` (2, W)."""
        step = jnp.maximum(high - low - jnp.abs(shear), 0) / cells
        # A loop, so that `pupil` is compiled once.
        centres = middle[None] + jnp.stack([shear, -shear]) / 2
        both = jax.lax.map(lambda centre: pupil(centre, step), centres)
        first, second = (jax.tree.map(lambda a: a[k], both) for k in range(2))
        inside = shared_part(first, second)
        light = safe_sqrt(first.light * second.light) * inside
        light = light * (step[0] * step[1])[:, None, None]
        # Phases are taken at the centroid of the light of that pupil whose edge cuts more of the
        # cell.
        off = jnp.where(first.inside < second.inside, first.middle, second.middle)
        turn = first.turn - second.turn
        phase = first.phase - second.phase + jnp.sum(turn * off, axis=0)
        turned = _mean_wave(light, phase, turn, inside)
        return jnp.sum(turned, axis=(1, 2)), jnp.sum(light, axis=(1, 2))

    # One loop, so that `sheared` is compiled once: first no shear, which gives all the light; then
    # the shears of all frequencies along y; then those along x.
    shear = frequencies[:, None] * (wavelengths / (_UM * beam.index))[None]
    none = jnp.zeros_like(shear)
    shears = jnp.zeros_like(low)[None], jnp.stack([none, shear], 1), jnp.stack([shear, none], 1)
    otf, light = jax.lax.map(sheared, jnp.concatenate(shears))
    back = 2 * jnp.pi * centre[::-1, None] * frequencies[None]
    turned = otf[1:].reshape(*back.shape, -1) * _phasor(jnp.ones_like(back), back)[..., None]
    whole = jnp.broadcast_to(light[0], turned.shape)
    otf = safe_divide(turned, whole.astype(turned.dtype))
    light = safe_divide(light[1:].reshape(whole.shape), whole)
    return jnp.moveaxis(otf, -1, 0), jnp.moveaxis(light, -1, 0)
