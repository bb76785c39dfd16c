"""Solves: numbers of a lens that are computed from the others, so that a condition holds
exactly.
"""

import copy
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..image.moments import moments
from ..image.rounding import warn_of_focus
from ..inputs import require, require_one_of
from ..lens.lens import Lens
from ..lens.paraxial import entrance_pupil, marginal_ray, paraxial_system, trace_ray
from ..lens.scene import Scene, checked_scene, vergence_of
from ..numerics import concrete, leaves, program, safe_divide
from ..pupil.rules import Gauss
from ..rays.solve import solve_aimed
from .field_rays import symmetry_by_structure
from .media import back_distance
from .parts import Place, number_at, step_of

# In the order of application. No solve changes the condition of an earlier one, see `fix_solves`.
_Name = Literal[
    "focal_length", "effective_focal_length", "entrance_pupil", "f_number", "image_angle",
    "paraxial_focus", "best_focus"
]  # fmt: skip
# Number of Newton steps. Every condition is linear in the solved number, so that one step solves
# it; the second step removes rounding errors.
_STEPS = 2
_ORDER = 6  # of the rule of the best focus
# Relative tolerance of a solve, and smallest relative change of a condition by a typical change of
# the solved number.
_TOLERANCE = 1e-9
_NO_SURFACE = 5000  # larger than any number of a surface; settings have no negative numbers


@leaves("value", "fields", "distance", "wavelengths")
@dataclasses.dataclass(frozen=True)
class Solve:
    """A condition, and the number of the lens that is solved for it.

    A solve is a pytree: kind and surface are static. In a problem, numbers are arrays.

    kind: one of the following.
        Solved by the curvature of `surface`: "focal_length" in image space, mm;
        "effective_focal_length" in air, mm; "image_angle", the paraxial slope of the marginal ray
        behind the lens, negative for converging light.
        Solved by the distance of the sensor from the last vertex: "paraxial_focus"; "best_focus",
        of the smallest mean square spots of `fields`, each wavelength about its own centroid.
        Solved by the semi-diameter of the stop: "entrance_pupil", its diameter, mm; "f_number", the
        working f-number.
    value: value of the condition; 0 for the value of the lens at the start. For a focus, the
        distance from the focus to the sensor, mm.
    surface: number of the surface whose curvature is solved, from 0.
    fields: fields of the best focus along y, radians.
    distance: distance of the object, mm, for a focus, image_angle and f_number.
    wavelengths: um; the condition holds for the mean over them.
    """

    kind: _Name
    value: float = 0.0
    surface: int = _NO_SURFACE
    fields: tuple[float, ...] = (0.0,)
    distance: float = math.inf
    wavelengths: tuple[float, ...] = (0.5875618,)

    def __post_init__(self) -> None:
        require_one_of("solves: kind", self.kind, get_args(_Name))
        what = f"solves: {self.kind}"
        finite = math.isfinite(self.value)
        require(finite, f"{what}: value: must be finite, got {self.value:g}")
        least = f"must be above 0, or 0 for that of the start, got {self.value:g}"
        require(self.value >= 0 or not self.aperture, f"{what}: value: {least}")
        for name in ("fields", "wavelengths"):
            numbers = tuple(float(number) for number in np.ravel(getattr(self, name)))
            require(numbers, f"{what}: {name}: none; give one or leave it out")
            object.__setattr__(self, name, numbers)

    @property
    def focuses(self) -> bool:
        """True if the distance of the sensor is solved."""
        return self.kind in ("paraxial_focus", "best_focus")

    @property
    def aperture(self) -> bool:
        """True if the semi-diameter of the stop is solved."""
        return self.kind in ("entrance_pupil", "f_number")

    def place(self, lens: Lens) -> Place:
        """The place of the solved number.

        ValueError if the lens has no such number, or if the condition does not depend on it.
        """
        if self.focuses:
            return Place("sensor", 0, 0)
        if self.aperture:
            return Place("semi_diameter", lens.stop, 0)
        active = ", ".join(map(str, lens.active))
        what = f"solves: {self.kind}: its curvature follows: give surface, one of {active}"
        require(self.surface in lens.active, what)
        what = f"{self.surface} lies before the stop, which is number {lens.stop}"
        what = f"solves: image_angle: surface {what}; give the stop or a surface behind it"
        behind = self.kind != "image_angle" or self.surface >= lens.stop
        require(behind, f"{what}, of {active}")
        return Place("curvature", self.surface, 0)

    def with_value(self, value: Array | float) -> "Solve":
        """The solve with another value, which may be an array."""
        own = copy.copy(self)
        object.__setattr__(own, "value", value)
        return own

    def placed(self, lens: Lens) -> "Solve":
        """The solve for a problem: its numbers are arrays in the dtype of the lens.

        The axial field becomes None, because it needs fewer rays.
        """
        own = copy.copy(self)
        if concrete(self.fields):
            fields = tuple(field or None for field in self.fields)
            object.__setattr__(own, "fields", fields)
        return jax.tree.map(lambda number: jnp.asarray(number, lens.curvature.dtype), own)

    def fixed(self, lens: Lens) -> "Solve":
        """The solve with its value filled in.

        ValueError if the lens has no such value, or if the solved number does not change it.
        """
        what, place = f"solves: {self.kind}", self.place(lens)
        if self.focuses:
            converges = float(_focus(lens, self.placed(lens))[1]) > 0
            what = f"{what}: there is no focus: the light behind the lens is parallel, or absent"
            require(converges, f"{what}; leave it out, or start from another lens")
            scene = Scene.point(0.0, self.distance, self.wavelengths)
            warn_of_focus(lens, checked_scene(lens, scene))
            return self
        solve = self
        if self.value == 0:
            current = self.converted(float(_measure(lens, self)))
            known = current != 0 and math.isfinite(current)
            require(known, f"{what}: the lens has no such value to keep; give one")
            solve = dataclasses.replace(self, value=current)
        target = self.converted(float(solve.value))
        ratio = float(_measure(solve.apply(lens), solve)) / target
        change = float(solve.rate(lens, solve)) * step_of(lens, place)
        meets = abs(change) > _TOLERANCE * abs(target) and abs(ratio - 1) < _TOLERANCE
        what = f"{what}: no {place.kind} of surface {place.row} gives {solve.value:g}"
        require(meets, f"{what}; is the beam in focus there? give another surface")
        return solve

    def converted(self, value: Any) -> Any:
        """A value of the condition as a measure, or a measure as a value: itself or 1 / value."""
        if self.kind not in _INVERSE:
            return value
        if isinstance(value, float):
            return 1 / value if value else math.inf
        return safe_divide(jnp.ones_like(value), value)

    @program
    def rate(self, lens: Lens, other: "Solve") -> Array:
        """Derivative () of this condition by the solved number of another solve."""
        number, with_number = number_at(lens, other.place(lens))
        one = jnp.ones_like(number)
        return jax.jvp(lambda n: _measure(with_number(n), self), (number,), (one,))[1]

    def apply(self, lens: Lens) -> Lens:
        """The lens with the solved number; unchanged if no number meets the condition."""
        with_number, own = number_at(lens, self.place(lens))[1], self.placed(lens)
        return with_number(_focus(lens, own)[0] if self.focuses else _met(lens, own))


def fix_solves(lens: Lens, solves: Sequence[Solve]) -> tuple[tuple[Solve, ...], Lens]:
    """The solves with their values filled in, and the lens that meets them.

    Returns the solves in the order of application, with numbers as arrays; and the lens. ValueError
    as in `Solve.fixed`, and if one solve changes the condition of an earlier one.
    """
    found: list[Solve] = []
    for solve in sorted(solves, key=lambda solve: get_args(_Name).index(solve.kind)):
        for other in found:
            what = f"solves: {other.kind} and {solve.kind}: the second changes what the first keeps"
            require(float(other.rate(lens, solve)) == 0, f"{what}; leave one out")
        found.append(solve.fixed(lens))
        lens = found[-1].apply(lens)
    return tuple(solve.placed(lens) for solve in found), lens


@program
def _measure(lens: Lens, solve: Solve) -> Array:
    """The measure () of a condition, see `_MEASURES`."""
    return _MEASURES[solve.kind](lens, solve)


@program
def _met(lens: Lens, solve: Solve) -> Array:
    """The solved number (), by Newton's method on measure - value = 0."""
    number, with_number = number_at(lens, solve.place(lens))

    def miss(number: Array) -> Array:
        return _measure(with_number(number), solve) - solve.converted(solve.value)

    for _ in range(_STEPS):
        missed, rate = jax.jvp(miss, (number,), (jnp.ones_like(number),))
        number = number - safe_divide(missed, rate)
    return number


def _wavelengths(lens: Lens, solve: Solve) -> Array:
    """The wavelengths of a solve, (W,), um, in the dtype of the lens."""
    return jnp.stack([jnp.asarray(wave, lens.curvature.dtype) for wave in solve.wavelengths])


def _power(lens: Lens, solve: Solve) -> Array:
    """1 / focal length, in image space or in air, 1/mm; mean over wavelengths."""
    system = paraxial_system(lens, _wavelengths(lens, solve))
    slope = trace_ray(system, 1.0, 0.0).behind[-1]
    return -jnp.mean(slope if solve.kind == "focal_length" else system.index[-1] * slope)


def _slope(lens: Lens, solve: Solve) -> Array:
    """Paraxial slope of the marginal ray behind the lens; mean over wavelengths."""
    vergence = vergence_of(jnp.asarray(solve.distance, lens.curvature.dtype))
    system = paraxial_system(lens, _wavelengths(lens, solve))
    return jnp.mean(marginal_ray(system, vergence).behind[-1])


def _pupil(lens: Lens, solve: Solve) -> Array:
    """Diameter of the entrance pupil, mm; mean over wavelengths."""
    return 2 * jnp.mean(entrance_pupil(lens, _wavelengths(lens, solve)).semi_diameter)


# Functions of the lens and the solve, linear in the solved number: the value of a condition, or, of
# those in `_INVERSE`, 1 / value.
_MEASURES: dict[str, Callable[[Lens, Solve], Array]] = {
    "focal_length": _power,
    "effective_focal_length": _power,
    "image_angle": _slope,
    "entrance_pupil": _pupil,
    "f_number": lambda lens, solve: 2 * jnp.abs(_slope(lens, solve)),
}
_INVERSE = "focal_length", "effective_focal_length", "f_number"


@program
def _focus(lens: Lens, solve: Solve) -> tuple[Array, Array]:
    """The focus, for the mean over wavelengths.

    The mean square spot is a quadratic function of the shift t of the sensor, a + b t + c t^2, with
    its minimum at t = -b / (2 c).

    Returns the distance () from the last vertex to `solve.value` mm behind the focus, mm; and a
    measure of the convergence, 0 where there is no focus: the slope of the paraxial ray, or c.
    """
    waves = _wavelengths(lens, solve)
    if solve.kind == "paraxial_focus":
        vergence = vergence_of(jnp.asarray(solve.distance, lens.curvature.dtype))
        ray = trace_ray(paraxial_system(lens, waves), 1.0, vergence)
        back = jnp.mean(safe_divide(-ray.height[-1], ray.behind[-1]))
        return back + solve.value, jnp.min(jnp.abs(ray.behind[-1]))
    spreads = []
    for field in solve.fields:
        point = Scene.point(0.0 if field is None else field, solve.distance, waves)
        scene = checked_scene(lens, point)
        rule = Gauss(_ORDER, symmetry_by_structure(lens, field is None))
        spread = moments(lens, scene, rule, solve_aimed).spread
        spreads.append(jnp.mean(jnp.sum(spread[..., :2], axis=-1), axis=-1))
    _, linear, square = jnp.mean(jnp.stack(spreads), axis=0)
    return back_distance(lens) - safe_divide(linear, 2 * square) + solve.value, square
