"""How lenses are assembled: the compensators of each lens as built, and its criterion.

If only the sensor is adjusted, the best adjustment follows from the rays of one trace, see
`compensation`. Other adjustments change the rays, so that every trial is a trace; a few damped
Gauss-Newton steps within their limits find the best ones.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeAlias, cast, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..lens.lens import Lens
from ..numerics import leaves, safe_sqrt, tensordot
from . import least_squares
from .compensation import (
    COUNTS,
    AsBuilt,
    Compensator,
    check,
    compensated,
    normal_equations,
    solved,
)
from .configurations import AnyProblem, over, problems_of, shares_of
from .field_rays import FieldRays
from .operands import Operand, OperandFunction, OperandName
from .parts import with_arrays
from .perturbed import PerturbedLens, Tolerance
from .problem import Problem, trace_fields
from .values import OPERANDS, kind_of

_STEPS = 5  # of Gauss and Newton: an evaluation, and four trials


@leaves("criterion", "merit", "parts", "held")
@dataclasses.dataclass(frozen=True)
class Assembly:
    """How lenses are assembled: what is adjusted in each lens, and which criterion is measured.

    compensator: what is adjusted in each lens. "none"; "focus", the distance of the sensor; "focus
        and tilt", also its tilts about x and y; or tolerances, each of which names parts and the
        largest adjustment in both directions: Tolerance("thickness", 0.3, (4,)) is a spacer,
        Tolerance("decentre", 0.1, (1,)) an element that is centred, Tolerance("sensor", 1) focus.
        If there are several configurations, each has its own focus (and tilt); "common focus" and
        the adjustments of tolerances without `own` are the same in all.
    criterion: the figure of merit: an operand, its name, or a function of a lens and its
        `FieldRays`. Its value is the mean of the values of the operand; for residuals such as
        "spot" and "path_difference" the root of the mean square over the views. The mean over
        several configurations uses their weights. A lens is better if the value is nearer to the
        target of the operand.
    merit: operand whose squares the adjustments of tolerances minimise. "focus" and "focus and
        tilt" minimise spots.

    Filled in by `placed`:
    parts: the adjustments, instead of tolerances.
    held: (C,), moves in place of the best ones, in the units of `AsBuilt.moves`; None to search.
    """

    compensator: Compensator | Sequence[Tolerance] = "focus"
    criterion: Operand | OperandName | OperandFunction = "spot"
    merit: Operand | OperandName | OperandFunction = "spot"
    parts: PerturbedLens | None = None
    held: Array | None = None

    @classmethod
    def of(cls, given: "Assembly | Compensator | Sequence[Tolerance]") -> "Assembly":
        """An assembly: the argument itself, or one with this compensator and default criterion."""
        return given if isinstance(given, Assembly) else cls(given)

    def placed(
        self, problem: AnyProblem, lenses: Sequence[Lens], beam_radius: Array | None = None
    ) -> "Assembly":
        """The assembly of a lens, with arrays in place of numbers.

        lenses: the lens of each configuration.
        beam_radius: as in `PerturbedLens`; None to trace it, if it is needed.

        ValueError, which names the argument, for a compensator that is unknown, that the lens does
        not have or the fields do not determine; for an operand that does not fit; for a pupil
        rule with more symmetry than the lens; and for other counts of lenses and configurations.
        """
        problems, own = problems_of(problem), len(lenses)
        what = f"problem: has {len(problems)} configurations, the lens {own}; give Configurations"
        remedy = "from_problems([...]), and PerturbedLens.from_lens of as many lenses"
        require(own == len(problems), f"{what}.{remedy}")
        kind: Any = self.compensator
        parts: Any = self.parts
        if parts is None and not isinstance(kind, str):
            known = all(isinstance(one, Tolerance) for one in kind)
            names = ", ".join(get_args(Compensator))
            require(known, f"compensator: expected {names} or a list of Tolerance, got {kind}")
            if beam_radius is None:
                radii = [one.beam_radius(lens) for one, lens in zip(problems, lenses)]
                beam_radius = jnp.max(jnp.stack(radii), axis=0)
            parts = PerturbedLens.from_lens(lenses, beam_radius, kind)
            kind, lenses = "none", parts.lenses
        operands: dict[str, Any] = {}
        for one, lens in zip(problems, lenses):
            check(one, lens, kind)
            for name in ("criterion", "merit"):
                operand = _operand(getattr(self, name))
                operand.check(lens, one.counts)
                operands[name] = operand.placed(lens)
        return dataclasses.replace(self, compensator=kind, parts=parts, **operands)

    @property
    def of_squares(self) -> bool:
        """True for a criterion that is a root of a mean square."""
        return kind_of(self.figure.kind).squared != ""

    @property
    def sensor(self) -> Compensator:
        """What is adjusted of the sensor by the rays of one trace."""
        return cast(Compensator, self.compensator) if isinstance(self.compensator, str) else "none"

    @property
    def plain(self) -> bool:
        """True for the spots of all views after "focus" or the like, without a second trace."""
        one = self.figure
        whole = not (one.fields or one.distances or one.wavelengths) and one.vignetting
        return one.kind == "spot" and whole and self.parts is None and self.held is None

    @property
    def figure(self) -> Operand:
        """The operand of the criterion."""
        return _operand(self.criterion)

    def loss(self, value: Array | np.ndarray) -> Array:
        """Distance of values of the criterion from its target; larger is worse."""
        return jnp.abs(value - (0 if self.of_squares else self.figure.target))

    def measure(self, lens: Lens, rays: FieldRays) -> tuple[Array, Array]:
        """The residuals (M,) of the criterion and the sum () of their squares, a mean square over
        the views; or no residuals, and the mean of its values.
        """
        operand = self.figure
        values = operand.values(lens, rays)
        if not self.of_squares:
            return values[:0], jnp.mean(values)
        residuals = values / len(rays.views(operand.fields, operand.distances)) ** 0.5
        return residuals, jnp.sum(residuals**2)

    def pull(self, lens: Lens, rays: FieldRays) -> Array:
        """The residuals (M,) whose squares adjustments minimise."""
        return _operand(self.merit).residuals(lens, rays)

    def value(self, measure: Array | np.ndarray) -> Array:
        """The criterion of a measure, whose root is taken if it is a mean square."""
        return safe_sqrt(jnp.maximum(measure, 0)) if self.of_squares else jnp.asarray(measure)

    def of_each(self, moves: Array, count: int) -> list[Array]:
        """Splits adjustments of the sensor (C,) into a part for each of `count` configurations."""
        if self.sensor == "common focus":
            return [moves] * count
        return [*moves.reshape(count, COUNTS[self.sensor])]

    def adjusted(self, lenses: Sequence[Lens], moves: Array) -> list[Lens]:
        """The lens of each configuration with adjustments (C,), in the units of `AsBuilt.moves`."""
        if self.parts is not None:
            return self.parts.around(*lenses).lenses_of(moves / self.parts.sizes)
        return [*map(_focused, lenses, self.of_each(moves, len(lenses)))]

    def moves(self, problem: AnyProblem, lenses: Sequence[Lens]) -> Array:
        """The best adjustments (C,) of a lens, whose configurations are given."""
        parts = self.parts
        if parts is None and self.sensor == "none":
            return jnp.zeros(0, lenses[0].curvature.dtype)
        if parts is None:
            return self._focus(problem, lenses, over(problem, trace_fields, lenses))
        count, dtype = len(parts.deviations), parts.sizes.dtype
        roots = jnp.sqrt(shares_of(problem))

        def pulls(problem: Problem, lens: Lens) -> tuple[Array, Array]:
            rays = trace_fields(problem, lens)
            return self.pull(lens, rays), jnp.sum(~rays.arrives, dtype=jnp.int32)

        def evaluate(part: Array) -> least_squares.Evaluation:
            each = over(problem, pulls, self.adjusted(lenses, part * parts.sizes))
            residuals, failed = zip(*each, strict=True)
            scaled = [root * own for root, own in zip(roots, residuals, strict=True)]
            lost = sum(failed[1:], failed[0])
            # A step that loses rays is not taken, see `least_squares.step`.
            return least_squares.Evaluation(
                jnp.concatenate(scaled), jnp.zeros(0, dtype), lost.astype(dtype), lost
            )

        def step(search: least_squares.Search, _: None) -> tuple[least_squares.Search, None]:
            return least_squares.step(evaluate, search, -one, one), None

        one = jnp.ones(count, dtype)
        start = least_squares.init(evaluate, jnp.zeros(count, dtype))
        return jax.lax.scan(step, start, length=_STEPS)[0].vector * parts.sizes

    def _focus(
        self, problem: AnyProblem, lenses: Sequence[Lens], rays: Sequence[FieldRays]
    ) -> Array:
        """The best adjustments (C,) of the sensor, by the rays of each configuration."""
        pairs = zip(lenses, rays, strict=True)
        equations = [normal_equations(lens, own, self.sensor) for lens, own in pairs]
        if self.sensor != "common focus":
            return jnp.concatenate([solved(*own) for own in equations])
        matrices, rights = zip(*equations, strict=True)
        shares = shares_of(problem)
        return solved(*(tensordot(shares, jnp.stack(a), 1) for a in (matrices, rights)))

    def free(self, moves: Array) -> Array:
        """Mask (C,) of the adjustments that are not at their limits."""
        return jnp.ones(len(moves), bool) if self.parts is None else abs(moves) < self.parts.sizes

    def built(self, problem: AnyProblem, lenses: Sequence[Lens]) -> AsBuilt:
        """A lens after compensation, whose configurations are given. Call `placed` before."""
        if self.plain:
            rays = over(problem, trace_fields, lenses)
            moves = self._focus(problem, lenses, rays)
            parts = zip(lenses, rays, self.of_each(moves, len(lenses)), strict=True)
            each = [compensated(lens, own, self.sensor, m)[0] for lens, own, m in parts]
            return self._joined(problem, moves, [(one.squares, one.value) for one in each])
        moves = self.moves(problem, lenses) if self.held is None else self.held
        return self._joined(problem, moves, over(problem, self._one, self.adjusted(lenses, moves)))

    def _one(self, problem: Problem, lens: Lens) -> tuple[Array, Array]:
        """Squares (V,) and criterion () of one configuration of an adjusted lens."""
        rays = trace_fields(problem, lens)
        squares = compensated(lens, rays, "none")[0].squares
        from_above = self.of_squares | (self.figure.target <= 0)
        away = jnp.where(from_above, jnp.inf, -jnp.inf).astype(squares.dtype)
        value = self.value(self.measure(lens, rays)[1])
        valid = jnp.all(jnp.isfinite(squares)) & jnp.isfinite(value)
        return squares, jnp.where(valid, value, away)

    def _joined(
        self, problem: AnyProblem, moves: Array, each: Sequence[tuple[Array, Array]]
    ) -> AsBuilt:
        """The result of squares (V,) and criterion () of each configuration."""
        squares, values = zip(*each)
        value = values[0]
        if len(values) > 1:
            power = 2 if self.of_squares else 1
            value = self.value(mean_of(problem, jnp.stack(values) ** power))
        return AsBuilt(jnp.concatenate(squares), moves, value, jnp.stack(values))


Given: TypeAlias = Assembly | Compensator | Sequence[Tolerance]


def mean_of(problem: AnyProblem, each: Array) -> Array:
    """Weighted mean () over the configurations of numbers (C,). A number of weight 0 may be inf."""
    shares = shares_of(problem)
    return jnp.sum(jnp.where(shares > 0, shares * each, 0))


def _focused(lens: Lens, moves: Array) -> Lens:
    """A lens whose sensor is adjusted by (0,), (1,) or (3,), as in `AsBuilt.moves`."""
    if len(moves):
        lens = dataclasses.replace(lens, sensor=lens.sensor + moves[0])
    if len(moves) > 1:
        lens = with_arrays(lens, ["tilt"])
        tilt = lens.tilt.at[-1, :2].add(jnp.stack([moves[1], -moves[2]]))  # type: ignore[union-attr]
        lens = dataclasses.replace(lens, tilt=tilt)
    return lens


def _operand(given: Operand | OperandName | OperandFunction) -> Operand:
    """The operand itself, or an operand for a name or function; diffraction gets the target 1."""
    if isinstance(given, Operand):
        return given
    of_waves = given in OPERANDS and kind_of(given).of_waves
    return Operand(given, target=float(of_waves))


def as_built(problem: AnyProblem, lens: Lens | Sequence[Lens], compensator: Given) -> AsBuilt:
    """Evaluates a lens at the fields of a problem after compensation.

    Works in `jit`, `vmap` and under differentiation; with tolerances or an `Assembly` of them as
    compensator, the lens must be known, and nothing is differentiated.

    problem: gives the fields, wavelengths and pupil rule; or `Configurations`, for several.
    lens: the lens as built; for several configurations a sequence of lenses.
    compensator: "none", "focus" (the distance of the sensor), "focus and tilt" (also its tilts
        about x and y), "common focus" of all configurations, tolerances, or an `Assembly`, which
        describes them.

    ValueError as in `Assembly.placed`.
    """
    lenses = [lens] if isinstance(lens, Lens) else [*lens]
    return Assembly.of(compensator).placed(problem, lenses).built(problem, lenses)
