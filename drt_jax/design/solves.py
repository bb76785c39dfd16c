"""Solves: numbers of a lens that follow from the others, so that a condition holds exactly."""

import copy
import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..image.moments import moments
from ..inputs import shown
from ..lens.lens import Lens
from ..lens.paraxial import entrance_pupil, marginal_ray, paraxial_system, trace_ray
from ..lens.scene import scene_of, vergence_of
from ..numerics import concrete, leaves, safe_divide
from ..pupil.rules import Gauss
from ..rays.solve import solve_aimed
from .field_rays import symmetry_by_structure
from .kinds import KINDS, back_distance, step_of

# In the order in which they are applied: none moves what one before it keeps, see `fix_solves`.
_Name = Literal[
    "focal_length",
    "effective_focal_length",
    "entrance_pupil",
    "f_number",
    "image_angle",
    "paraxial_focus",
    "best_focus",
]
# Compiled where numbers are known, part of the caller's program in a trace.
_program = functools.partial(jax.jit, inline=True)
# Newton steps: every condition is linear in the number that meets it, the second mends rounding.
_STEPS = 2
_ORDER = 6  # of the rule of the best focus
# Relative tolerance of a solve; also the least relative change of what it keeps by a typical step
# of the number that follows.
_TOLERANCE = 1e-9
_NO_SURFACE = 5000  # prescriptions have at most so many, settings no negative numbers


@leaves("value", "fields", "distance", "wavelengths")
@dataclasses.dataclass(frozen=True)
class Solve:
    """A condition and the number that is given up for it.

    kind: "focal_length" in image space or "effective_focal_length" in air, in mm, or "image_angle",
        the paraxial slope of the marginal ray behind the lens, negative where light converges: the
        curvature of `surface` follows. "paraxial_focus",
        or "best_focus" where the spots of `fields`, each wavelength about its own centroid, are
        smallest (the root of their mean square): the distance of the sensor behind the last vertex
        follows. "entrance_pupil", its diameter in mm, or "f_number", the working one: the
        semi-diameter of the stop follows.
    value: to keep; 0: that of the lens at the start; of a focus, mm from there to the sensor.
    surface: whose curvature follows, from 0.
    fields: of the best focus, radians along y.
    distance: to the object, mm; of a focus, image_angle and f_number.
    wavelengths: um; a condition is one of their mean.

    A pytree: kind and surface are static; in a problem numbers are arrays.
    """

    kind: _Name
    value: float = 0.0
    surface: int = _NO_SURFACE
    fields: tuple[float, ...] = (0.0,)
    distance: float = math.inf
    wavelengths: tuple[float, ...] = (0.5875618,)

    def __post_init__(self) -> None:
        if self.kind not in get_args(_Name):
            known = ", ".join(get_args(_Name))
            raise ValueError(f"solves: unknown kind {shown(self.kind)}; known: {known}")
        if not math.isfinite(self.value):
            raise ValueError(f"solves: {self.kind}: value: must be finite, got {self.value:g}")
        if self.aperture and self.value < 0:
            raise ValueError(
                f"solves: {self.kind}: value: must be above 0, or 0 to keep that of the start, "
                f"got {self.value:g}"
            )
        for name in ("fields", "wavelengths"):
            numbers = tuple(float(number) for number in np.ravel(getattr(self, name)))
            if not numbers:
                raise ValueError(f"solves: {self.kind}: {name}: none; give one or leave it out")
            object.__setattr__(self, name, numbers)

    @property
    def focuses(self) -> bool:
        """Whether the sensor follows."""
        return self.kind in ("paraxial_focus", "best_focus")

    @property
    def aperture(self) -> bool:
        """Whether the stop follows."""
        return self.kind in ("entrance_pupil", "f_number")

    def place(self, lens: Lens) -> tuple[str, int, int]:
        """Kind, row and term of the number that follows.

        ValueError if there is none, or if it does not determine the condition.
        """
        if self.focuses:
            return "sensor", 0, 0
        if self.aperture:
            return "semi_diameter", lens.stop, 0
        active = ", ".join(map(str, lens.active))
        if self.surface not in lens.active:
            raise ValueError(
                f"solves: {self.kind}: its curvature follows: give surface, one of {active}"
            )
        if self.kind == "image_angle" and self.surface < lens.stop:
            raise ValueError(
                f"solves: image_angle: surface {self.surface} lies before the stop, which is "
                f"number {lens.stop}; give one at it or behind, of {active}"
            )
        return "curvature", self.surface, 0

    def placed(self, lens: Lens) -> "Solve":
        """The solve of a problem: numbers as arrays of the lens' dtype, None for a field on the
        axis, which needs fewer rays."""
        own = copy.copy(self)
        if concrete(self.fields):
            fields = tuple(field or None for field in self.fields)
            object.__setattr__(own, "fields", fields)
        return jax.tree.map(lambda number: jnp.asarray(number, lens.curvature.dtype), own)

    def fixed(self, lens: Lens) -> "Solve":
        """The solve with the value that it keeps. ValueError where that is none, or where the
        number that follows does not change it."""
        kind, row, term = self.place(lens)
        if self.focuses:
            if not float(_focus(lens, self.placed(lens))[1]) > 0:
                raise ValueError(
                    f"solves: {self.kind}: there is none: the light behind the lens is parallel, "
                    "or none arrives; leave it out, or begin with another lens"
                )
            return self
        condition, solve = _CONDITIONS[self.kind], self
        if self.value == 0:
            now = condition.value(float(_measure(lens, self)))
            if now == 0 or not math.isfinite(now):
                raise ValueError(f"solves: {self.kind}: the lens has none to keep; give its value")
            solve = dataclasses.replace(self, value=now)
        wanted = condition.value(float(solve.value))
        missed = float(_measure(solve.apply(lens), solve)) / wanted
        change = float(solve.rate(lens, solve)) * step_of(lens, kind, row, term)
        weak = not abs(change) > _TOLERANCE * abs(wanted)
        if weak or not abs(missed - 1) < _TOLERANCE:
            raise ValueError(
                f"solves: {self.kind}: no {kind} of surface {row} gives {solve.value:g}; "
                "is the beam in focus there? give another surface"
            )
        return solve

    @_program
    def rate(self, lens: Lens, other: "Solve") -> Array:
        """By how much what this one keeps changes with the number that follows from another."""
        number, with_number = _number(lens, other)
        measure = _CONDITIONS[self.kind].measure
        one = jnp.ones_like(number)
        return jax.jvp(lambda n: measure(with_number(n), self), (number,), (one,))[1]

    def apply(self, lens: Lens) -> Lens:
        """The lens with the number that meets the condition; unchanged where none does."""
        with_number, own = _number(lens, self)[1], self.placed(lens)
        return with_number(_focus(lens, own)[0] if self.focuses else _met(lens, own))


def fix_solves(lens: Lens, solves: Sequence[Solve]) -> tuple[tuple[Solve, ...], Lens]:
    """The solves with what they keep, in the order in which all hold, numbers as arrays; and the
    lens of which they do. ValueError as of `Solve.fixed`, and where one changes what another keeps.
    """
    found: list[Solve] = []
    for solve in sorted(solves, key=lambda solve: get_args(_Name).index(solve.kind)):
        for other in found:
            if float(other.rate(lens, solve)) != 0:
                raise ValueError(
                    f"solves: {other.kind} and {solve.kind}: the second changes what the first "
                    "keeps; leave one out"
                )
        found.append(solve.fixed(lens))
        lens = found[-1].apply(lens)
    return tuple(solve.placed(lens) for solve in found), lens


@_program
def _measure(lens: Lens, solve: Solve) -> Array:
    return _CONDITIONS[solve.kind].measure(lens, solve)


@_program
def _met(lens: Lens, solve: Solve) -> Array:
    """The number () that meets a condition, by Newton's method."""
    number, with_number = _number(lens, solve)
    condition = _CONDITIONS[solve.kind]

    def miss(number: Array) -> Array:
        return condition.measure(with_number(number), solve) - condition.value(solve.value)

    for _ in range(_STEPS):
        missed, rate = jax.jvp(miss, (number,), (jnp.ones_like(number),))
        number = number - safe_divide(missed, rate)
    return number


def _number(lens: Lens, solve: Solve) -> tuple[Array, Callable[[Array], Lens]]:
    """The number () that follows, and the lens with another."""
    kind, row, term = solve.place(lens)
    array = KINDS[kind].read(lens)

    def with_number(number: Array) -> Lens:
        return KINDS[kind].write(lens, array.at[row, term].set(number))

    return array[row, term], with_number


class _Condition(NamedTuple):
    """measure: linear in the number that follows. value: what it is to be for what is kept, and
    back."""

    measure: Callable[[Lens, Solve], Array]
    value: Callable[[Any], Any]


def _wavelengths(lens: Lens, solve: Solve) -> Array:
    return jnp.stack([jnp.asarray(wave, lens.curvature.dtype) for wave in solve.wavelengths])


def _power(lens: Lens, solve: Solve) -> Array:
    """1 / focal length, in image space or in air."""
    system = paraxial_system(lens, _wavelengths(lens, solve))
    slope = trace_ray(system, 1.0, 0.0).behind[-1]
    return -jnp.mean(slope if solve.kind == "focal_length" else system.index[-1] * slope)


def _slope(lens: Lens, solve: Solve) -> Array:
    """Of the marginal ray behind the lens."""
    vergence = vergence_of(jnp.asarray(solve.distance, lens.curvature.dtype))
    return jnp.mean(
        marginal_ray(paraxial_system(lens, _wavelengths(lens, solve)), vergence).behind[-1]
    )


def _pupil(lens: Lens, solve: Solve) -> Array:
    """Diameter of the entrance pupil."""
    return 2 * jnp.mean(entrance_pupil(lens, _wavelengths(lens, solve)).semi_diameter)


def _inverse(value: Any) -> Any:
    if isinstance(value, float):
        return 1 / value if value else math.inf
    return safe_divide(jnp.ones_like(value), value)


def _itself(value: Any) -> Any:
    return value


_CONDITIONS = {
    "focal_length": _Condition(_power, _inverse),
    "effective_focal_length": _Condition(_power, _inverse),
    "image_angle": _Condition(_slope, _itself),
    "entrance_pupil": _Condition(_pupil, _itself),
    "f_number": _Condition(lambda lens, solve: 2 * jnp.abs(_slope(lens, solve)), _inverse),
}


@_program
def _focus(lens: Lens, solve: Solve) -> tuple[Array, Array]:
    """The distance () from the last vertex to `solve.value` mm behind the focus, mm, and how
    sharp the focus is, 0 where there is none."""
    waves = _wavelengths(lens, solve)
    if solve.kind == "paraxial_focus":
        vergence = vergence_of(jnp.asarray(solve.distance, lens.curvature.dtype))
        ray = trace_ray(paraxial_system(lens, waves), 1.0, vergence)
        back = jnp.mean(safe_divide(-ray.height[-1], ray.behind[-1]))
        return back + solve.value, jnp.min(jnp.abs(ray.behind[-1]))
    spreads = []
    for field in solve.fields:
        scene = scene_of(lens, 0.0 if field is None else field, solve.distance, waves)
        rule = Gauss(_ORDER, symmetry_by_structure(lens, field is None))
        spread = moments(lens, scene, rule, solve_aimed).spread
        spreads.append(jnp.mean(jnp.sum(spread[..., :2], axis=-1), axis=-1))
    _, linear, square = jnp.mean(jnp.stack(spreads), axis=0)
    return back_distance(lens) - safe_divide(linear, 2 * square) + solve.value, square
