"""Rounding errors of float32, JAX's default: estimates, and warnings where numbers are known.

Analyses of waves need path differences to a thousandth of a wave. Paths are computed relative to
one in the middle of the beam before lengths are summed (`rays.fermat.optical_path`), so float32 is
accurate enough for a camera, though not for a telescope of metres. The error is measured with the
arithmetic itself: paths are stationary, so hits that differ in their last digits have equal paths
except for rounding. Inside of a trace no number is known, so no warning can be given; the values
stay finite.
"""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require, warn
from ..lens.lens import Lens
from ..lens.paraxial import first_order
from ..lens.scene import Scene
from ..numerics import known_values
from ..rays.solve import solve_aimed
from ..rays.status import Status
from ..rays.trace import aims, path_of

# The machine epsilon of float64 is below this, that of float32 above.
_DOUBLE = 1e-12
# RMS error of path differences, waves, up to which no warning is given: 6e-3 of a Strehl ratio.
_WAVES = 1e-3
# Error of a focus, in units of the depth of focus, up to which no warning is given.
_FOCUS = 0.02
# Number of rays of the measurement, half of them near the rim of the stop (0.98) and half at half
# of its radius; and the largest number of machine epsilons by which their hits are changed.
_RAYS, _DIGITS = 16, 8


def below_double(lens: Lens) -> bool:
    """Whether the dtype of a lens is less precise than float64."""
    return float(jnp.finfo(lens.curvature.dtype).eps) > _DOUBLE


def check_dtype(
    lens: Lens, what: str, wrong: float, allowed: float, unit: str, asked: bool = False
) -> None:
    """Warns if the dtype of a lens is less precise than float64 and an error exceeds what is
    allowed; ValueError instead if that was asked for.

    what: name of the quantity, for the message.
    wrong, allowed: estimated error and bound.
    unit: text behind the number in the message.
    asked: True if `allowed` is a tolerance that the caller gave.
    """
    if below_double(lens) and wrong > allowed:
        message = (
            f"in {lens.curvature.dtype} {what} may be wrong by {wrong:.0e}{unit}, more than "
            f'{allowed:.0e}: jax.config.update("jax_enable_x64", True) before the lens is loaded'
        )
        require(not asked, f"sampling: {message}, or leave the tolerance out and take that error")
        warn(message)


def hit_rounding(lens: Lens) -> float:
    """Estimated error of hits from rounding, mm: 2 eps times the length of the lens. Measured in
    float32 over 54 scenes of bundled lenses, the error was an eighth of this in the median and
    at most 0.93 of it; more for Hubble, which is 6 m long with a spot of 10 nm."""
    return 2 * float(jnp.finfo(lens.curvature.dtype).eps) * abs(float(lens.sensor))


def warn_of_focus(lens: Lens, scene: Scene) -> None:
    """Warns if rounding moves a focus by more than `_FOCUS` of the depth of focus,
    wavelength / NA^2, if the numbers are known. The estimate is the rounding of hits over NA. The
    foci of spots of the bundled lenses were off by a fifth of this in the median, and by at most
    0.97 of it.
    """
    known = known_values((lens, scene)) if below_double(lens) else None
    if known is None:
        return
    lens, scene = known
    with jax.core.eval_context():
        waves = jnp.asarray(scene.wavelengths)
        apertures = (
            first_order(lens, far, waves).numerical_aperture for far in np.unique(scene.distance)
        )
        # From mm to waves in um.
        worst = max(float(jnp.max(aperture / waves)) for aperture in apertures)
        moved = 1e3 * hit_rounding(lens) * worst
    check_dtype(lens, "the focus", moved, _FOCUS, " of its depth")


def warn_of_paths(
    lens: Lens, scene: Scene, of_beams: bool = False, tolerance: float | None = None
) -> None:
    """Warns if rounding makes path differences wrong by more than `_WAVES`, if the numbers are
    known; with a tolerance, ValueError if that makes a contrast wrong by more. A path that is wrong
    by e waves turns a wave by 2 pi e radians, which changes a contrast by at most that.

    of_beams: as in `path_rounding`.
    """
    known = known_values((lens, scene)) if below_double(lens) else None
    if known is None:
        return
    lens, scene = known
    with jax.core.eval_context():
        error = path_rounding(lens, scene.each(), of_beams)
    if tolerance is None:
        check_dtype(lens, "path differences", error, _WAVES, " waves RMS")
    else:
        check_dtype(lens, "contrast", 2 * np.pi * error, tolerance, "", True)


def path_rounding(lens: Lens, scenes: Sequence[Scene], of_beams: bool = False) -> float:
    """RMS error of path differences from rounding, waves: the largest of all scenes and
    wavelengths. The numbers are known.

    of_beams: True to add the error from rounding of the hits on the sensor, with which `image.beam`
        refers paths to the centroid of the spot. It grows with the image height and the angle of
        incidence.
    """
    # From mm to waves in um.
    parts = [1e3 * np.asarray(_noise(lens, s)) / np.asarray(s.wavelengths) for s in scenes]
    return max(float(np.max(np.hypot(p[0], p[1]) if of_beams else p[0])) for p in parts)


@functools.partial(jit, wanted=LARGE)
def _noise(lens: Lens, scene: Scene) -> Array:
    """RMS differences, mm, (2, W), of the paths of two sets of hits that differ in their last
    digits: first for changes of all hits but those on the sensor, then for changes on the sensor
    alone, of the size of its rounding."""
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
        """RMS over the rays (W,) of the change of the path when hits change by `turn` epsilons."""
        hits = tuple(h * (1 + jnp.asarray(eps * t, h.dtype)) for h, t in zip(found.hits, turn))
        change = path_of(found._replace(hits=hits), system) - path_of(found, system)
        spread = jnp.std(change, axis=-1, where=good)
        return jnp.where(jnp.any(good, axis=-1), spread, 0)

    # The path is stationary in all hits but those on the sensor. The first part is the difference
    # of two roundings, hence sqrt(2). The RMS of a uniform integer from -n to n is sqrt(n (n + 1) /
    # 3); rounding changes hits on the sensor by 0.22 epsilons RMS.
    digits = np.sqrt(_DIGITS * (_DIGITS + 1) / 3).item()
    parts = noise(np.where(last, 0, turn)) / np.sqrt(2).item(), noise(np.where(last, turn, 0))
    return jnp.stack([parts[0], parts[1] * (0.22 / digits)])
