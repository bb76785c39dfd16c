"""What float32, JAX's default, cannot hold: measured, and told where numbers are known.

Analyses of waves need path differences to a thousandth of a wave. Paths are taken relative to one
in the middle of the beam before lengths are summed (`rays.fermat.optical_path`), so that float32
keeps them in a camera, though not in a telescope of metres. How far they are off is measured by the
arithmetic itself: paths are stationary, so that hits which differ in their last digits have the
same path but for its rounding. Inside of a trace no number is known and nothing can be told; the
values stay finite.
"""

import dataclasses
import functools
import warnings
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..lens.lens import Lens
from ..lens.paraxial import numerical_aperture
from ..lens.scene import Scene
from ..numerics import Numbers, known_values
from ..rays.solve import solve_aimed
from ..rays.status import Status
from ..rays.trace import aims, path_of

# The precision of float64 is below this, that of float32 above.
_DOUBLE = 1e-12
# RMS error of path differences, waves, up to which analyses are silent: 6e-3 of a Strehl ratio.
_WAVES = 1e-3
# Error of a focus, in parts of the depth of focus, that is borne in silence.
_FOCUS = 0.02
# Rays of the measurement, as many on the rim of the stop as at half of its radius, and last digits
# by which their hits differ.
_RAYS, _DIGITS = 16, 8


def rough(lens: Lens) -> bool:
    """Whether the numbers of a lens are coarser than float64."""
    return float(jnp.finfo(lens.curvature.dtype).eps) > _DOUBLE


def tell(lens: Lens, what: str, wrong: float, allowed: float, unit: str, level: int) -> None:
    """Warns if the dtype of a lens, coarser than float64, makes something wrong by more than is
    allowed. level: as of `warnings.warn`, where 1 is the caller of this function."""
    if rough(lens) and wrong > allowed:
        warnings.warn(
            f"in {lens.curvature.dtype} {what} may be wrong by {wrong:.0e}{unit}, more than "
            f'{allowed:.0e}: jax.config.update("jax_enable_x64", True) before the lens is loaded',
            stacklevel=level + 1,
        )


def hit_rounding(lens: Lens) -> float:
    """Error of hits by rounding, mm, which is relative to the length of the lens. Measured in
    float32 over 54 scenes of bundled lenses: an eighth of this in the median, at most 0.93 of it;
    more for Hubble, 6 m long with a spot of 10 nm."""
    return 2 * float(jnp.finfo(lens.curvature.dtype).eps) * abs(float(lens.sensor))


def tell_of_focus(lens: Lens, distance: Numbers, wavelengths: Numbers, level: int = 3) -> None:
    """Warns if rounding moves a focus by more than `_FOCUS` of the depth of focus, wavelength over
    NA^2, where it is known: by the error of hits over NA. Foci of spots of the bundled lenses were
    off by a fifth of this in the median, at most by 0.97 of it."""
    known = known_values((lens, distance, wavelengths)) if rough(lens) else None
    if known is None:
        return
    with jax.core.eval_context():
        lens, distance, wavelengths = known
        # From mm to waves in um.
        waves = lens.checked_wavelengths(wavelengths)
        per_um = numerical_aperture(lens, distance, waves) / waves
        moved = 1e3 * hit_rounding(lens) * float(jnp.max(per_um))
    tell(lens, "the focus", moved, _FOCUS, " of its depth", level)


def tell_of_paths(
    lens: Lens, axis: Scene, fields: Array | None = None, level: int = 3, of_beams: bool = False
) -> None:
    """Warns if rounding makes path differences wrong by more than `_WAVES`, where it is known.
    axis: the scene, or that of the axis for `fields` (F, 2), radians. of_beams: see
    `path_rounding`."""
    known = known_values((lens, axis, fields)) if rough(lens) else None
    if known is None:
        return
    lens, axis, fields = known
    with jax.core.eval_context():
        angles = [axis.field] if fields is None else fields
        scenes = [dataclasses.replace(axis, field=angle) for angle in angles]
        error = path_rounding(lens, scenes, of_beams)
    tell(lens, "path differences", error, _WAVES, " waves RMS", level)


def path_rounding(lens: Lens, scenes: Sequence[Scene], of_beams: bool = False) -> float:
    """RMS error of path differences by rounding, waves: the largest of all scenes and wavelengths.
    Known numbers. of_beams: also by that of hits on the sensor, with which `image.beam` refers
    paths to the middle of the spot; it grows with the height of the image and the slant."""
    # From mm to waves in um.
    parts = [1e3 * np.asarray(_noise(lens, s)) / np.asarray(s.wavelengths) for s in scenes]
    return max(float(np.max(np.hypot(p[0], p[1]) if of_beams else p[0])) for p in parts)


@functools.partial(jit, wanted=LARGE)
def _noise(lens: Lens, scene: Scene) -> Array:
    """Of the paths, mm, of hits that differ in their last digits, the RMS difference by (2, W): all
    but the sensor's; the sensor's alone, as far as rounding changes those."""
    angle = 2 * np.pi * np.arange(_RAYS) * (3 / _RAYS)
    radius = np.where(np.arange(_RAYS) % 2, 0.98, 0.5)
    points = tuple(jnp.asarray(radius * f(angle), lens.curvature.dtype) for f in (np.cos, np.sin))
    system, target = aims(lens, scene, points)
    found = solve_aimed(system, target)
    good = found.status == Status.OK
    turn = np.random.default_rng(0).integers(-_DIGITS, _DIGITS + 1, (2, *found.hits[0].shape))
    last = np.arange(turn.shape[1])[:, None, None] == turn.shape[1] - 1
    eps = float(jnp.finfo(lens.curvature.dtype).eps)

    def noise(turn: np.ndarray) -> Array:
        hits = tuple(h * (1 + jnp.asarray(eps * t, h.dtype)) for h, t in zip(found.hits, turn))
        change = path_of(found._replace(hits=hits), system) - path_of(found, system)
        spread = jnp.std(change, axis=-1, where=good)
        return jnp.where(jnp.any(good, axis=-1), spread, 0)

    # The path is stationary but for hits on the sensor. Rounding changes those by 0.22 digits RMS.
    digits = np.sqrt(_DIGITS * (_DIGITS + 1) / 3).item()
    parts = noise(np.where(last, 0, turn)) / np.sqrt(2).item(), noise(np.where(last, turn, 0))
    return jnp.stack([parts[0], parts[1] * (0.22 / digits)])
