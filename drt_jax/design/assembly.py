"""How lenses are assembled: what is adjusted in each lens as built, and what is measured of it.

Where the sensor alone is adjusted, the rays of one trace tell the best adjustment, see
`compensation`. Others need rays of every adjusted lens; a few damped Gauss-Newton steps within
their limits find them.
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
from ..numerics import leaves, safe_sqrt
from . import least_squares
from .compensation import AsBuilt, Compensator, check, compensated
from .field_rays import FieldRays
from .operands import Operand, OperandFunction, OperandName
from .parts import with_arrays
from .perturbed import PerturbedLens, Tolerance
from .problem import Problem, trace_fields
from .values import OPERANDS, kind_of

_COUNTED = ("fields", "wavelengths", "distances")
_STEPS = 5  # of Gauss and Newton: an evaluation, and four trials


@leaves("criterion", "merit", "parts", "held")
@dataclasses.dataclass(frozen=True)
class Assembly:
    """How lenses are assembled, and what is measured of them.

    compensator: what is adjusted in each lens. "none"; "focus", the distance of the sensor; "focus
        and tilt", also its tilts about x and y; or tolerances, each of which names parts and the
        largest adjustment in both directions: Tolerance("thickness", 0.3, (4,)) is a spacer,
        Tolerance("shift", 0.1, (1,)) an element that is centred, Tolerance("sensor", 1) the focus.
    criterion: the figure of merit: an operand, its name, or a function of a lens and its
        `FieldRays`. Its value is the mean of the values of the operand; for residuals such as
        "spot" and "path_difference" the root of the mean square over the views. Good is what is
        near the target of the operand.
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
        """An assembly that is given, or the usual one with a compensator that is given."""
        return given if isinstance(given, Assembly) else cls(given)

    def placed(self, problem: Problem, lens: Lens, beam_radius: Array | None = None) -> "Assembly":
        """The assembly of a lens, with arrays in place of numbers.

        beam_radius: as in `PerturbedLens`; None to trace it, if it is needed.

        ValueError, which names the argument, for a compensator that is unknown, that the lens does
        not have or the fields do not determine; for an operand that does not fit; and for a pupil
        rule with more symmetry than the lens.
        """
        kind: Any = self.compensator
        parts: Any = self.parts
        if parts is None and not isinstance(kind, str):
            known = all(isinstance(one, Tolerance) for one in kind)
            names = ", ".join(get_args(Compensator))
            require(known, f"compensator: expected {names} or a list of Tolerance, got {kind}")
            radius = problem.beam_radius(lens) if beam_radius is None else beam_radius
            parts = PerturbedLens.from_lens(lens, radius, kind)
            kind, lens = "none", parts.lens
        check(problem, lens, kind)
        counts = {name: len(getattr(problem, name)) for name in _COUNTED}
        operands: dict[str, Any] = {}
        for name in ("criterion", "merit"):
            operand = _operand(getattr(self, name))
            operand.check(lens, counts)
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

    def adjusted(self, lens: Lens, moves: Array) -> Lens:
        """A lens with adjustments (C,), in the units of `AsBuilt.moves`."""
        if self.parts is not None:
            return self.parts.around(lens).lens_of(moves / self.parts.sizes)
        if len(moves):
            lens = dataclasses.replace(lens, sensor=lens.sensor + moves[0])
        if len(moves) > 1:
            lens = with_arrays(lens, ["tilt"])
            tilt = lens.tilt.at[-1, :2].add(jnp.stack([moves[1], -moves[2]]))  # type: ignore[union-attr]
            lens = dataclasses.replace(lens, tilt=tilt)
        return lens

    def moves(self, problem: Problem, lens: Lens) -> Array:
        """The best adjustments (C,) of a lens."""
        parts = self.parts
        if parts is None and self.sensor == "none":
            return jnp.zeros(0, lens.curvature.dtype)
        if parts is None:
            return compensated(lens, trace_fields(problem, lens), self.sensor)[0].moves
        count, dtype = len(parts.deviations), lens.curvature.dtype

        def evaluate(part: Array) -> least_squares.Evaluation:
            own = self.adjusted(lens, part * parts.sizes)
            rays = trace_fields(problem, own)
            failed = jnp.sum(~rays.arrives, dtype=jnp.int32)
            # A step that loses rays is not taken, see `least_squares.step`.
            return least_squares.Evaluation(
                self.pull(own, rays), jnp.zeros(0, dtype), failed.astype(dtype), failed
            )

        def step(search: least_squares.Search, _: None) -> tuple[least_squares.Search, None]:
            return least_squares.step(evaluate, search, -one, one), None

        one = jnp.ones(count, dtype)
        start = least_squares.init(evaluate, jnp.zeros(count, dtype))
        return jax.lax.scan(step, start, length=_STEPS)[0].vector * parts.sizes

    def free(self, moves: Array) -> Array:
        """Mask (C,) of the adjustments that are not at their limits."""
        return jnp.ones(len(moves), bool) if self.parts is None else abs(moves) < self.parts.sizes

    def built(self, problem: Problem, lens: Lens) -> AsBuilt:
        """A lens after compensation. Call `placed` before."""
        if self.plain:
            return compensated(lens, trace_fields(problem, lens), self.sensor)[0]
        moves = self.moves(problem, lens) if self.held is None else self.held
        lens = self.adjusted(lens, moves)
        rays = trace_fields(problem, lens)
        squares = compensated(lens, rays, "none")[0].squares
        from_above = self.of_squares | (self.figure.target <= 0)
        away = jnp.where(from_above, jnp.inf, -jnp.inf).astype(squares.dtype)
        value = self.value(self.measure(lens, rays)[1])
        valid = jnp.all(jnp.isfinite(squares)) & jnp.isfinite(value)
        return AsBuilt(squares, moves, jnp.where(valid, value, away))


Given: TypeAlias = Assembly | Compensator | Sequence[Tolerance]


def _operand(given: Operand | OperandName | OperandFunction) -> Operand:
    """An operand, or that of a name or function; the target of waves is 1."""
    if isinstance(given, Operand):
        return given
    of_waves = given in OPERANDS and kind_of(given).of_waves
    return Operand(given, target=float(of_waves))


def as_built(problem: Problem, lens: Lens, compensator: Given) -> AsBuilt:
    """Evaluates a lens at the fields of a problem after compensation.

    Works in `jit`, `vmap` and under differentiation; with tolerances or an `Assembly` of them as
    compensator, the lens must be known, and nothing is differentiated.

    problem: gives the fields, wavelengths and pupil rule.
    lens: the lens as built.
    compensator: "none", "focus" (the distance of the sensor), "focus and tilt" (also its tilts
        about x and y), tolerances, or an `Assembly`, which describes them.

    ValueError as in `Assembly.placed`.
    """
    return Assembly.of(compensator).placed(problem, lens).built(problem, lens)
