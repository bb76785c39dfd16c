"""Operands: what a design is judged by, as vectors of residuals and limits."""

import dataclasses
import math
from typing import Literal

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import shown
from ..lens.lens import Lens
from ..numerics import safe_sqrt
from .kinds import whole_numbers
from .seen import Seen
from .values import OPERANDS, Which

# What an operand may name.
_NUMBERS = ("fields", "wavelengths", "distances", "surfaces")

# As the keys of `OPERANDS`, which a test compares.
OperandKind = Literal[
    "spot", "spot_of_colours", "spot_chief", "rms_spot", "centroid", "path_difference",
    "rms_wavefront", "focal_length", "effective_focal_length", "back_focal_distance",
    "entrance_pupil", "f_number", "magnification", "total_track", "length", "back_distance",
    "distortion", "lateral_colour", "chief_ray_angle", "numerical_aperture",
    "relative_illumination", "throughput", "glass_centre", "glass_edge", "air_centre",
    "air_edge", "glass_map", "incidence_angle"
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Operand:
    """One thing that is wanted of a lens: a target, or limits that are kept.

    kind: one of `OPERANDS`; what each is, in which unit, stands at the top of values.py.
    target: of the values. low, high: limits instead of a target; kept exactly in the end.
    weight: the residual is weight times the difference, in the units of the values; 0: the operand
        is off.
    fields, wavelengths, distances, surfaces: which of the problem's, or of the lens', from 0;
        empty: all.
    vignetting: of spots and wavefronts, False counts the rays that clear apertures clip as if they
        passed, so that cutting light gains nothing.
    """

    kind: OperandKind
    target: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    weight: float = 1.0
    fields: tuple[int, ...] = ()
    wavelengths: tuple[int, ...] = ()
    distances: tuple[int, ...] = ()
    surfaces: tuple[int, ...] = ()
    vignetting: bool = True

    def __post_init__(self) -> None:
        if self.kind not in OPERANDS:
            some = ", ".join(OPERANDS)
            raise ValueError(f"operands: unknown kind {shown(self.kind)}; known: {some}")
        what, known = f"operands: {self.kind}", OPERANDS[self.kind]
        for name in _NUMBERS:
            numbers = whole_numbers(f"{what}: {name}", getattr(self, name))
            object.__setattr__(self, name, numbers)
            if numbers and name not in known.names:
                some = " and ".join(known.names) or "nothing"
                raise ValueError(f"{what}: {name}: it has none; leave them out, it knows {some}")
        if self.low == self.high:
            raise ValueError(f"{what}: low and high are both {self.low:g}; give it as the target")
        if not self.low < self.high:
            raise ValueError(
                f"{what}: low {self.low:g} is not below high {self.high:g}; exchange them"
            )
        if not 0 <= self.weight < math.inf:
            raise ValueError(
                f"{what}: weight: must be above 0, or 0 to leave it out, got {self.weight:g}"
            )
        if not self.vignetting and not known.of_spots:
            some = ", ".join(kind for kind, value in OPERANDS.items() if value.of_spots)
            raise ValueError(f"{what}: vignetting: is of {some}; leave it out")
        if not math.isfinite(self.target):
            raise ValueError(f"{what}: target: must be finite, got {self.target:g}")
        if self.target and self.limits:
            raise ValueError(f"{what}: has a target and limits; make two operands of it")
        if known.squared and (self.target or self.limits):
            raise ValueError(f"{what}: takes no target and no limits; use {known.squared} for them")

    @property
    def limits(self) -> bool:
        """Whether it is limits that are kept, not a target."""
        return math.isfinite(self.low) or math.isfinite(self.high)

    def check(self, lens: Lens, counts: dict[str, int]) -> None:
        """ValueError for what it names and neither the lens nor the problem has, whose counts are
        by "fields", "wavelengths" and "distances"."""
        what = f"operands: {self.kind}"
        places = OPERANDS[self.kind].places
        there = {name: list(range(count)) for name, count in counts.items()}
        there["surfaces"] = [] if places is None else places(lens)
        for name in _NUMBERS:
            for k in getattr(self, name):
                if k not in there[name]:
                    some = ", ".join(map(str, there[name])) or "none"
                    raise ValueError(f"{what}: {name}: no number {k}; there are {some}")
        if places is not None and not there["surfaces"]:
            raise ValueError(f"{what}: the lens has no surface with one; leave it out")
        if self.kind == "lateral_colour" and len(self.wavelengths or there["wavelengths"]) < 2:
            raise ValueError(f"{what}: wavelengths: needs two or more; leave it out")

    def placed(self, lens: Lens) -> "Operand":
        """The operand with the surfaces named that follow from numbers of the lens."""
        if self.kind != "glass_map" or self.surfaces:
            return self
        places = OPERANDS[self.kind].places
        return dataclasses.replace(self, surfaces=tuple(places(lens)) if places else ())

    def values(self, seen: Seen) -> Array:
        """The values (K,) of a lens, of which the target is taken or which the limits bound."""
        return jnp.ravel(self._values(seen))

    def _values(self, seen: Seen) -> Array:
        which = Which(self.fields, self.wavelengths, self.distances, self.surfaces, self.vignetting)
        return OPERANDS[self.kind].function(which, seen)

    def residuals(self, seen: Seen, field_weights: Array | None = None) -> Array:
        """(K,), the squares of which add up in the merit; none for limits. field_weights: (F,), of
        the squares; None: 1."""
        if self.limits:
            return jnp.zeros(0, seen.lens.curvature.dtype)
        values, axes = self._values(seen), OPERANDS[self.kind].axes
        found = self.weight * (values - self.target)
        if field_weights is not None and "fields" in axes:
            roots = safe_sqrt(field_weights)[np.array(self.fields or range(seen.fields))]
            roots = jnp.tile(roots, len(self.distances or range(seen.distances)))
            inner = len(axes) - 1 - axes.index("fields")
            shape = (-1, *(1,) * inner)
            found = found * jnp.broadcast_to(jnp.reshape(roots, shape), found.shape)
        return jnp.ravel(found)

    def excess(self, seen: Seen) -> Array:
        """By how much each value is beyond each limit, times the weight, negative within; none for
        a target."""
        if not self.limits:
            return jnp.zeros(0, seen.lens.curvature.dtype)
        values = self.values(seen)
        sides = [self.low - values] * math.isfinite(self.low)
        sides += [values - self.high] * math.isfinite(self.high)
        return self.weight * jnp.concatenate(sides)
