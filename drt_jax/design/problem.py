"""A design problem: variables, and what is wanted of the lens from all its fields."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.paraxial import marginal_ray, paraxial_system
from ..lens.scene import distance_array, fields_array, vergence_of
from ..numerics import Numbers, concrete
from ..pupil.clipped import Clipped
from ..pupil.rules import Gauss, PupilRule
from ..rays.solve import Solver, solve, solve_aimed
from .failures import failures
from .field_rays import (
    FieldRays,
    beam_radius,
    symmetry_by_structure,
    trace_views,
)
from .gaps import gaps
from .least_squares import Evaluation
from .limits import Limit, limits_of
from .operands import Operand, OperandFunction, OperandName
from .values import OPERANDS, kind_of
from .variables import Variables

# A ray that fails counts as one that misses by so many semi-diameters of the stop, and more.
_FAILED = 4.0
# A limit that is as far exceeded, to a part, by numbers that differ by up to so many scales, is one
# that no variable moves.
_BESIDE, _STILL = 0.3, 1e-9
# The stop is at least so wide, as part of the light's width on any surface.
_SLIMMEST = 0.1


def _check_operands(
    operands: Sequence[Operand],
    lens: Lens,
    fields: int,
    wavelengths: int,
    distances: np.ndarray,
    rule: PupilRule,
) -> None:
    """ValueError for operands that do not fit the lens, the scene or the rule. fields, wavelengths:
    how many; distances: (Z,), mm."""
    if not operands:
        raise ValueError("operands: none; a merit needs at least one, such as spot")
    counts = {"fields": fields, "wavelengths": wavelengths, "distances": len(distances)}
    for operand in operands:
        operand.check(lens, counts)
        named = distances[np.array(operand.distances or range(len(distances)))]
        if operand.kind == "magnification" and np.any(np.isinf(named)):
            raise ValueError("operands: magnification: the object is at infinity")
        if not operand.vignetting and isinstance(rule, Clipped):
            raise ValueError(
                f"operands: {operand.name}: vignetting: Clipped traces only what passes; take "
                "Gauss or Soft"
            )
    if not any(operand.weight for operand in operands):
        raise ValueError("operands: all have the weight 0; a merit needs at least one")


def _weights(what: str, given: Numbers, count: int) -> np.ndarray:
    """Weights (count,), 1 on the average. ValueError for what they are not."""
    found = np.asarray(given, float)
    good = found.shape == (count,) and np.all(np.isfinite(found) & (found >= 0))
    if not good or not np.any(found):
        raise ValueError(f"{what}: expected {count} numbers of 0 or above, not all 0")
    return found / found.mean()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Problem:
    """What is varied, and what is asked of the lens. Whatever is a number is a leaf: another one
    compiles nothing.

    variables: see there.
    fields: (F, 2), angles in radians. distances: (Z,), of the object in mm; every field is seen
        from every distance. wavelengths: (W,) in um.
    wavelength_weights: (W,), of their light, adding up to 1.
    rule: of the pupil; the same for all fields.
    operands: what is asked, as `Operand.placed` has it.
    field_weights: (F,), of the squares of the residuals of each field, 1 on the average; None: 1.

    Static:
    solver: how rays are found: by the full search, so that no ray counts as failed that exists.
        `optimise`, `many_starts` and `monte_carlo` try with `solve_aimed`, the smaller program, and
        ask the full search where that misses a ray.
    """

    variables: Variables
    fields: Array
    distances: Array
    wavelengths: Array
    wavelength_weights: Array
    rule: PupilRule
    operands: tuple[Operand, ...]
    solver: Solver = dataclasses.field(metadata={"static": True}, default=solve)
    field_weights: Array | None = None

    @classmethod
    def from_variables(
        cls,
        variables: Variables,
        operands: Sequence[Operand | OperandName | OperandFunction],
        fields: Numbers = 0.0,
        wavelengths: Numbers = 0.5875618,
        distances: Numbers = np.inf,
        rule: PupilRule | int = 6,
        wavelength_weights: Numbers | None = None,
        field_weights: Numbers | None = None,
    ) -> "Problem":
        """The problem of some variables.

        operands: at least one that is not off; a word or a function is one of a weight of 1.
        fields: (F,) along y or (F, 2), in radians. wavelengths: (W,) or one, um. distances: (Z,) or
        one, mm. rule: of the pupil, or the order of a Gauss rule. wavelength_weights: (W,),
        field_weights: (F,), of any sum; None: equal. Limits hold for all fields, whatever their
        weights.

        ValueError, which names the argument, for what fits neither lens nor problem, and for a
        limit that the lens exceeds and no variable moves (of edges, which need rays, `optimise`
        says so).
        """
        lens = variables.lens
        asked = tuple(o if isinstance(o, Operand) else Operand(o) for o in operands)
        dtype = lens.curvature.dtype
        angles = fields_array(fields, dtype)
        far = jnp.stack([distance_array(d, dtype) for d in np.ravel(np.asarray(distances, float))])
        waves = lens.checked_wavelengths(wavelengths)
        if isinstance(rule, int):
            across = not np.any(np.asarray(angles)[:, 0])
            symmetry = symmetry_by_structure(lens, not np.any(np.asarray(angles)))
            rule = Gauss(rule, symmetry if across else "none")
        _check_operands(asked, lens, len(angles), len(waves), np.asarray(far), rule)
        on = tuple(operand.placed(lens) for operand in asked if operand.weight)
        equal = np.ones(len(waves)) if wavelength_weights is None else wavelength_weights
        share = _weights("wavelength_weights", equal, len(waves)) / len(waves)
        made = cls(variables, angles, far, waves, jnp.asarray(share, dtype), rule, on)
        if field_weights is not None:
            own = jnp.asarray(_weights("field_weights", field_weights, len(angles)), dtype)
            made = dataclasses.replace(made, field_weights=own)
        made._refuse_fixed()
        return made

    def with_order(self, order: int) -> "Problem":
        """The problem with a Gauss rule of another order."""
        return dataclasses.replace(self, rule=Gauss(order, self.rule.symmetry))

    def views(self) -> FieldRays:
        """All fields at all distances, without rays."""
        return FieldRays(
            jnp.tile(self.fields, (len(self.distances), 1)),
            jnp.repeat(self.distances, len(self.fields)),
            self.wavelengths,
            self.wavelength_weights,
            len(self.fields),
            len(self.distances),
            self.rule.symmetry,
        )

    @property
    def traces(self) -> bool:
        """Whether any operand needs rays."""
        return any(kind_of(operand.kind).traced for operand in self.operands)

    def evaluate(self, vector: Array) -> Evaluation:
        """What operands say of a vector (N,) of the variables. Differentiable, in `jit` and `vmap`
        too."""
        lens = self.variables.lens_of(vector)
        rays = _rays(self, lens)
        parts = [operand.residuals(lens, rays, self.field_weights) for operand in self.operands]
        if self.traces:
            parts.append(self._failures(lens, rays))
        residuals = jnp.concatenate(parts)
        constraints = self._constraints(lens, rays)
        radius = beam_radius(lens, rays) if self.traces else jnp.zeros(lens.count, vector.dtype)
        both = [gaps(lens, radius, glass) for glass in (True, False)]
        overlap = sum(jnp.sum(jnp.maximum(-part, 0)) for pair in both for part in pair)
        # A stop at a focus of the light would make any lens perfect: all rays are one.
        system = paraxial_system(lens, self.wavelengths)
        marginal = marginal_ray(system, vergence_of(self.distances[0])).height
        slim = _SLIMMEST * jnp.max(jnp.abs(marginal)) - jnp.abs(system.aperture)
        overlap = overlap + jnp.maximum(slim, 0)
        finite = jnp.all(jnp.isfinite(residuals)) & jnp.all(jnp.isfinite(constraints))
        overlap = jnp.where(finite & jnp.isfinite(overlap), overlap, jnp.inf)
        failed = jnp.sum(~rays.arrives, dtype=jnp.int32) if self.traces else jnp.int32(0)
        return Evaluation(residuals, constraints, jax.lax.stop_gradient(overlap), failed)

    def _failures(self, lens: Lens, rays: FieldRays) -> Array:
        """A residual for each ray: 0 for one that arrives, else the root of its part of the light
        times a miss of several beams."""
        size = _FAILED * jax.lax.stop_gradient(lens.semi_diameter[lens.stop])
        weights = [o.weight * kind_of(o.kind).per_mm for o in self.operands if not o.limits]
        weight = jnp.max(jnp.stack(weights)) if weights else 1.0
        return jnp.ravel(weight * size * failures(lens, rays))

    def _constraints(self, lens: Lens, rays: FieldRays) -> Array:
        return jnp.concatenate([operand.constraints(lens, rays) for operand in self.operands])

    def limits(self, constraints: Numbers) -> list[Limit]:
        """The limits by name, in the order of `Evaluation.constraints` (L,)."""
        counts = {"fields": len(self.fields), "distances": len(self.distances)}
        counts |= {"wavelengths": len(self.wavelengths)}
        counts |= {"xy": 2 if self.rule.symmetry == "none" else 1}
        lens, sizes = self.variables.lens, [0] * len(self.operands)
        if any(callable(operand.kind) for operand in self.operands):
            sizes = [a.size for a in jax.eval_shape(_constraints_of_each, self, lens)]
        return limits_of(self.operands, lens, counts, sizes, np.asarray(constraints))

    def elsewhere(self, vector: Array) -> Array:
        """A vector (N,) beside another, within the bounds, of which no number is the same."""
        low, high = self.variables.low, self.variables.high
        move = _BESIDE * jnp.cos(1 + 2 * jnp.arange(vector.size, dtype=vector.dtype))
        move = jnp.where((vector + move < low) | (vector + move > high), -move, move)
        return jnp.clip(vector + move, low, high)

    def refuse_fixed(self, constraints: Numbers, beside: Numbers) -> None:
        """ValueError, which names it, for a limit that is exceeded (L,) and by as much beside.
        Not of rays: those that fail have no derivative until they pass."""
        one, two = np.asarray(constraints), np.asarray(beside)
        for limit, there in zip(self.limits(one), self.limits(two)):
            if limit.kind not in OPERANDS or "fields" in OPERANDS[limit.kind].names:
                continue
            still = abs(there.excess - limit.excess) <= _STILL * (abs(limit.bound) + limit.excess)
            if limit.excess > 0 and still:
                raise ValueError(
                    f"operands: {limit}, and no variable moves it; leave this limit out, widen it, "
                    "or vary what it depends on"
                )

    @jax.jit
    def _exceeded(self, vector: Array) -> Array:
        """Of limits that need no rays: by how much they are exceeded."""
        return self._constraints(self.variables.lens_of(vector), self.views())

    def _refuse_fixed(self) -> None:
        """The same for the limits that need no rays."""
        some = tuple(o for o in self.operands if o.limits and not kind_of(o.kind).traced)
        if some and concrete(self):
            part = dataclasses.replace(self, operands=some)
            start = self.variables.start
            part.refuse_fixed(part._exceeded(start), part._exceeded(self.elsewhere(start)))

    @jax.jit
    def beam_radius(self, lens: Lens) -> Array:
        """How far from the axis the light meets each surface (S,) of a lens, mm."""
        return beam_radius(lens, trace_fields(self, lens))

    @jax.jit
    def failed(self, vector: Array) -> Array:
        """How many rays fail, (), int32; see `Evaluation`."""
        return self.evaluate(vector).failed

    @jax.jit
    def merit(self, vector: Array) -> Array:
        """Sum () of the squares of the residuals; limits are not in it."""
        return jnp.sum(self.evaluate(vector).residuals ** 2)


@jax.jit
def trace_fields(problem: Problem, lens: Lens) -> FieldRays:
    """The rays of a lens from all fields and distances of a problem. Differentiable, in `jit` and
    `vmap` too."""
    return trace_views(lens, problem.views(), problem.rule, problem.solver)


def _rays(problem: Problem, lens: Lens) -> FieldRays:
    """The rays of a lens, as far as operands need them."""
    views = problem.views()
    return trace_views(lens, views, problem.rule, problem.solver) if problem.traces else views


def _constraints_of_each(problem: Problem, lens: Lens) -> list[Array]:
    rays = _rays(problem, lens)
    return [operand.constraints(lens, rays) for operand in problem.operands]


def quick(problem: Problem) -> Problem:
    """The problem with the smaller program: rays are aimed, not searched for."""
    return dataclasses.replace(problem, solver=solve_aimed)
