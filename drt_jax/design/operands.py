"""Operands of a merit function: residuals for targets, constraints for limits."""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, require_one_of, whole_numbers
from ..lens.lens import Lens
from ..numerics import concrete, leaves, safe_sqrt
from .field_rays import FieldRays
from .values import OPERANDS, kind_of

# Operands of OpticStudio and CODE V in small letters, by what they are here.
_KNOWN_AS = {
    "effective_focal_length": "effl effx effy efl efx efy", "back_focal_distance": "bfl",
    "back_distance": "imd", "entrance_pupil": "epdi epd", "f_number": "wfno isfn fno",
    "magnification": "pmag red", "total_track": "totr", "length": "tthi oal",
    "spot": "trac trcx trcy", "spot_chief": "trar trax tray rsch rsrh",
    "rms_spot": "rsce rsre spd spo", "rms_wavefront": "rwce rwre rwch rwrh",
    "path_difference": "opdc opdm opdx", "centroid": "cenx ceny",
    "mtf": "mtfa mtft mtfs gmta gmtt gmts", "strehl": "strh", "encircled_energy": "denc genc",
    "distortion": "dist dimx disg diy dix", "lateral_colour": "lacl", "chief_ray_angle": "rang",
    "incidence_angle": "raid", "numerical_aperture": "isna", "relative_illumination": "reli",
    "glass_centre": "mncg mxcg mnct mxct mnt mxt", "glass_edge": "mneg mxeg mnet mxet mne",
    "air_centre": "mnca mxca mna", "air_edge": "mnea mxea mae",
}  # fmt: skip
_ELSEWHERE = {word: kind for kind, words in _KNOWN_AS.items() for word in words.split()}
# Arguments of an operand that select values by their numbers.
_NUMBERS = ("fields", "wavelengths", "distances", "surfaces")
_NEEDED = "missing; give the frequency of an mtf in cycles/mm, the radius of encircled_energy in mm"

# The keys of `OPERANDS`; a test compares them.
OperandName = Literal[
    "spot", "spot_of_colours", "spot_chief", "rms_spot", "centroid", "path_difference",
    "rms_wavefront", "focal_length", "effective_focal_length", "back_focal_distance",
    "entrance_pupil", "f_number", "magnification", "total_track", "length", "back_distance",
    "distortion", "lateral_colour", "chief_ray_angle", "numerical_aperture",
    "relative_illumination", "throughput", "mtf", "strehl", "encircled_energy", "glass_centre",
    "glass_edge", "air_centre", "air_edge", "glass_map", "incidence_angle"
]  # fmt: skip
OperandFunction = Callable[[Lens, FieldRays], Array]


@leaves("target", "low", "high", "weight", "at")
@dataclasses.dataclass(frozen=True)
class Operand:
    """One operand of a merit function: a target, or limits that are met exactly.

    An operand is a pytree: target, limits, weight and `at` are leaves. In a problem, a limit that
    is not given is None.

    kind: one of `OPERANDS` (values.py describes their meaning and units), or a function of a lens
        and its `FieldRays` that returns an array.
    target: target of the values, in their unit.
    low, high: limits instead of a target, in the unit of the values.
    weight: factor of the difference from the target, or of the violation of a limit; 0 turns the
        operand off.
    fields, wavelengths, distances, surfaces: indices of the selected ones in the problem or lens,
        from 0; () for all.
    vignetting: for spots, wavefronts and functions. False counts clipped rays as if they passed, so
        that clipping light does not lower the merit.
    at: of an mtf, the frequency on the sensor, cycles/mm; of encircled_energy, the radius, mm.
    """

    kind: OperandName | OperandFunction
    target: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    weight: float = 1.0
    fields: tuple[int, ...] = ()
    wavelengths: tuple[int, ...] = ()
    distances: tuple[int, ...] = ()
    surfaces: tuple[int, ...] = ()
    vignetting: bool = True
    at: float | None = None

    def __post_init__(self) -> None:
        if not callable(self.kind):
            require_one_of("operands: kind", self.kind, OPERANDS, _ELSEWHERE)
        what, known = f"operands: {self.name}", kind_of(self.kind)
        for name in _NUMBERS:
            numbers = whole_numbers(f"{what}: {name}", getattr(self, name))
            object.__setattr__(self, name, numbers)
            if numbers and name not in known.names:
                only = f", only on {' and '.join(known.names)}" if known.names else ""
                raise ValueError(f"{what}: does not depend on {name}{only}; remove {name}")
        low = -math.inf if self.low is None else self.low
        high = math.inf if self.high is None else self.high
        if (self.at is None) == bool(known.at):
            reason = _NEEDED if known.at else "only mtf and encircled_energy have it; leave it out"
            raise ValueError(f"{what}: at: {reason}")
        if not concrete((low, high, self.weight, self.target, self.at)):
            return
        if self.at is not None and not 0 < self.at < math.inf:
            raise ValueError(f"{what}: at: must be above 0 and finite, got {self.at:g}")
        if known.of_waves and not (self.target or self.limits):
            raise ValueError(f"{what}: target: 0 means no light; give 1 for the best, or limits")
        require(low != high, f"{what}: low and high are both {low:g}; give it as the target")
        require(low < high, f"{what}: low {low:g} is not below high {high:g}; exchange them")
        size = f"must be above 0, or 0 to leave it out, got {self.weight:g}"
        require(0 <= self.weight < math.inf, f"{what}: weight: {size}")
        if not self.vignetting and not (known.of_spots or callable(self.kind)):
            some = ", ".join(kind for kind, value in OPERANDS.items() if value.of_spots)
            raise ValueError(f"{what}: vignetting: only for {some}; leave it out")
        require(math.isfinite(self.target), f"{what}: target: must be finite, got {self.target:g}")
        if self.target and self.limits:
            raise ValueError(f"{what}: has a target and limits; make two operands of it")
        if known.squared and (self.target or self.limits):
            raise ValueError(f"{what}: takes no target and no limits; use {known.squared} for them")

    @property
    def name(self) -> str:
        """The kind, or the name of the function."""
        return self.kind if isinstance(self.kind, str) else self.kind.__name__

    def described(self) -> str:
        """The operand as a line: its limits or its target, in its unit, and its weight."""
        ends = [f"{side} {float(getattr(self, side)):.6g}" for side in self.sides]
        asked = ", ".join(ends) or f"target {float(self.target):.6g}"
        return f"{self.name}: {asked}, weight {float(self.weight):.4g}"

    @property
    def sides(self) -> list[Literal["low", "high"]]:
        """The limits that are given, "low" before "high"."""
        return [side for side in ("low", "high") if _is_limit(getattr(self, side))]

    @property
    def limits(self) -> bool:
        """True for limits, False for a target."""
        return bool(self.sides)

    def check(self, lens: Lens, counts: dict[str, int]) -> None:
        """Raises ValueError for a number that the lens or the problem does not have.

        counts: numbers of "fields", "wavelengths" and "distances" of the problem.
        """
        what = f"operands: {self.name}"
        places = kind_of(self.kind).places
        numbers = {name: list(range(count)) for name, count in counts.items()}
        numbers["surfaces"] = [] if places is None else places(lens)
        for name in _NUMBERS:
            for k in getattr(self, name):
                if k not in numbers[name]:
                    some = ", ".join(map(str, numbers[name])) or "none"
                    raise ValueError(f"{what}: {name}: no number {k}; there are {some}")
        if places is not None and not numbers["surfaces"]:
            raise ValueError(f"{what}: the lens has no surface with one; leave it out")
        none = "an afocal lens has no image height; leave it out, see drt_jax.distortion"
        require(not (self.kind == "distortion" and lens.afocal), f"{what}: {none}")
        if self.kind == "lateral_colour" and len(self.wavelengths or numbers["wavelengths"]) < 2:
            raise ValueError(f"{what}: wavelengths: needs two or more; leave it out")

    def placed(self, lens: Lens) -> "Operand":
        """The operand for a problem.

        Its numbers become arrays in the dtype of the lens. Surfaces are filled in where they depend
        on numbers of the lens.
        """
        surfaces, places = self.surfaces, kind_of(self.kind).places
        if self.kind == "glass_map" and not surfaces and places:
            surfaces = tuple(places(lens))
        placed = dataclasses.replace(self, surfaces=surfaces)
        for name in ("target", "low", "high", "weight", "at"):
            number = getattr(self, name)
            given = name not in ("low", "high", "at") or _is_limit(number)
            array = jnp.asarray(number, lens.curvature.dtype) if given else None
            object.__setattr__(placed, name, array)
        return placed

    def values(self, lens: Lens, rays: FieldRays) -> Array:
        """The values (K,) of a lens, which are compared with the target or the limits."""
        return jnp.ravel(self._values(lens, rays))

    def _values(self, lens: Lens, rays: FieldRays) -> Array:
        """The values in the shape of the kind, with the selected fields, distances, wavelengths and
        surfaces.
        """
        kind = kind_of(self.kind)
        if not self.vignetting:
            rays = rays.unvignetted()
        if kind.of_all_views:
            return kind.function(lens, rays)[rays.views(self.fields, self.distances)]
        waves = self.wavelengths
        if "middle" in kind.axes and not waves:
            waves = (rays.scene.reference(None),)
        arguments = () if self.at is None else (self.at,)
        values = kind.function(lens, rays.select(self.fields, self.distances, waves), *arguments)
        places = kind.rows or kind.places
        if not self.surfaces or places is None:
            return values
        return values[np.array([k for k, i in enumerate(places(lens)) if i in self.surfaces])]

    def residuals(self, lens: Lens, rays: FieldRays, field_weights: Array | None = None) -> Array:
        """Residuals (K,): weight times (value - target); (0,) for limits.

        field_weights: (F,), factors of the squares of the residuals of each field; None for 1. They
            do not apply to a user's function.
        """
        if self.limits:
            return jnp.zeros(0, lens.curvature.dtype)
        values, axes = self._values(lens, rays), kind_of(self.kind).axes
        found = self.weight * (values - self.target)
        if field_weights is not None and "fields" in axes:
            roots = safe_sqrt(field_weights)[np.array(self.fields or range(rays.fields))]
            roots = jnp.tile(roots, len(self.distances or range(rays.distances)))
            inner = len(axes) - 1 - axes.index("fields")
            shape = (-1, *(1,) * inner)
            found = found * jnp.broadcast_to(jnp.reshape(roots, shape), found.shape)
        return jnp.ravel(found)

    def constraints(self, lens: Lens, rays: FieldRays) -> Array:
        """Violations of the limits times the weight, negative where a limit is met; (0,) for a
        target.
        """
        if not self.limits:
            return jnp.zeros(0, lens.curvature.dtype)
        values = self.values(lens, rays)
        parts = {"low": lambda: self.low - values, "high": lambda: values - self.high}
        return self.weight * jnp.concatenate([parts[side]() for side in self.sides])


def _is_limit(number: Any) -> bool:
    """True for a limit that is given: an array, or a finite number."""
    return number is not None and not (isinstance(number, float | int) and math.isinf(number))
