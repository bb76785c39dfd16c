"""A design problem: variables, and what is wanted of the lens from all its fields."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.paraxial import marginal_ray, paraxial_system
from ..lens.scene import Scene, distance_array, field_array, vergence_of
from ..numerics import Numbers, concrete
from ..pupil.clipped import Clipped
from ..pupil.rules import Gauss, PupilRule
from ..rays.solve import Solver, solve, solve_aimed
from .gaps import gaps
from .limits import Limit, limits_of
from .operands import Operand, OperandKind
from .seen import Seen, symmetry_by_structure
from .values import OPERANDS
from .variables import Variables

# A ray that fails counts as one that misses by so many semi-diameters of the stop, and more.
_FAILED = 4.0
# A limit that is as far exceeded, to a part, by numbers that differ by up to so many scales, is one
# that no variable moves.
_BESIDE, _STILL = 0.3, 1e-9
# The stop is at least so wide, as part of the light's width on any surface.
_SLIMMEST = 0.1


class Judged(NamedTuple):
    """A lens judged.

    residuals: (M,), whose squares add up to the merit.
    excess: (L,), by how much values are beyond their limits, times their weights.
    broken: (), by how much surfaces overlap within the light, mm; inf where anything is not finite.
    failed: (), int32, how many rays fail.
    """

    residuals: Array
    excess: Array
    broken: Array
    failed: Array


def _check_pairs(angles: Array) -> None:
    if angles.ndim != 2 or angles.shape[1] != 2:
        raise ValueError(f"fields: expected (F,) or (F, 2), got shape {angles.shape}")


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
    """What is varied, and what is wanted.

    variables: see there.
    fields: (F, 2), angles in radians. distances: (Z,), of the object in mm; every field is seen
        from every distance. wavelengths: (W,) in um.
    colour_weights: (W,), of their light, adding up to 1.
    rule: of the pupil; the same for all fields.
    field_weights: (F,), of the squares of the residuals of each field, 1 on the average; None: 1.

    Static:
    operands: what is wanted.
    solver: how rays are found: by the full search, so that no ray counts as failed that exists.
        `optimise`, `many_starts` and `monte_carlo` try with `solve_aimed`, the smaller program, and
        ask the full search where that misses a ray.
    """

    variables: Variables
    fields: Array
    distances: Array
    wavelengths: Array
    colour_weights: Array
    rule: PupilRule
    operands: tuple[Operand, ...] = dataclasses.field(metadata={"static": True})
    solver: Solver = dataclasses.field(metadata={"static": True}, default=solve)
    field_weights: Array | None = None

    @classmethod
    def of(
        cls,
        variables: Variables,
        operands: Sequence[Operand | OperandKind],
        fields: Numbers = 0.0,
        wavelengths: Numbers = 0.5875618,
        distances: Numbers = np.inf,
        rule: PupilRule | int = 6,
        colour_weights: Numbers | None = None,
        field_weights: Numbers | None = None,
    ) -> "Problem":
        """The problem of some variables.

        operands: at least one that is not off; a word is one of a weight of 1. fields: (F,) along y
        or (F, 2), in radians. wavelengths: (W,) or one, um. distances: (Z,) or one, mm. rule: of
        the pupil, or the order of a Gauss rule. colour_weights: (W,), field_weights: (F,), of any
        sum; None: equal. Limits hold for all fields, whatever their weights.

        ValueError, which names the argument, for what fits neither lens nor problem, and for a
        limit that the lens exceeds and no variable moves (of edges, which need rays, `optimise`
        says so).
        """
        lens = variables.lens
        wanted = tuple(Operand(o) if isinstance(o, str) else o for o in operands)
        if not wanted:
            raise ValueError("operands: none; a merit needs at least one, such as spot")
        dtype = lens.curvature.dtype
        angles = jnp.atleast_1d(field_array(fields, dtype))
        if angles.ndim == 1:
            angles = jnp.stack([jnp.zeros_like(angles), angles], axis=-1)
        _check_pairs(angles)
        far = jnp.stack([distance_array(d, dtype) for d in np.ravel(np.asarray(distances, float))])
        colours = lens.colours(wavelengths)
        if isinstance(rule, int):
            across = not np.any(np.asarray(angles)[:, 0])
            symmetry = symmetry_by_structure(lens, not np.any(np.asarray(angles)))
            rule = Gauss(rule, symmetry if across else "disc")
        counts = {"fields": len(angles), "wavelengths": len(colours), "distances": len(far)}
        for operand in wanted:
            operand.check(lens, counts)
            named = np.asarray(far)[np.array(operand.distances or range(len(far)))]
            if operand.kind == "magnification" and np.any(np.isinf(named)):
                raise ValueError("operands: magnification: the object is at infinity")
            if not operand.vignetting and isinstance(rule, Clipped):
                raise ValueError(
                    f"operands: {operand.kind}: vignetting: Clipped traces only what passes; take "
                    "Gauss or Soft"
                )
        if not any(operand.weight for operand in wanted):
            raise ValueError("operands: all have the weight 0; a merit needs at least one")
        on = tuple(operand.placed(lens) for operand in wanted if operand.weight)
        equal = np.ones(len(colours)) if colour_weights is None else colour_weights
        share = _weights("colour_weights", equal, len(colours)) / len(colours)
        made = cls(variables, angles, far, colours, jnp.asarray(share, dtype), rule, on)
        if field_weights is not None:
            own = jnp.asarray(_weights("field_weights", field_weights, len(angles)), dtype)
            made = dataclasses.replace(made, field_weights=own)
        made._refuse_fixed()
        return made

    def with_order(self, order: int) -> "Problem":
        """The problem with a Gauss rule of another order."""
        return dataclasses.replace(self, rule=Gauss(order, self.rule.symmetry))

    def seen(self, lens: Lens) -> Seen:
        """The lens from all fields and distances."""
        views = Scene(
            jnp.tile(self.fields, (len(self.distances), 1)),
            jnp.repeat(self.distances, len(self.fields)),
            self.wavelengths,
        )
        return Seen(lens, views, self.rule, self.solver, self.colour_weights, len(self.fields))

    @property
    def traces(self) -> bool:
        """Whether any operand needs rays."""
        return any(OPERANDS[operand.kind].traced for operand in self.operands)

    def judge(self, vector: Array) -> Judged:
        """A vector (N,) of the variables judged; see `Judged`. Differentiable, in `jit` and `vmap`
        too."""
        lens = self.variables.lens_of(vector)
        seen = self.seen(lens)
        parts = [operand.residuals(seen, self.field_weights) for operand in self.operands]
        if self.traces:
            parts.append(self._failures(seen))
        residuals = jnp.concatenate(parts)
        excess = jnp.concatenate([operand.excess(seen) for operand in self.operands])
        extents = seen.extents if self.traces else jnp.zeros(lens.count, vector.dtype)
        both = [gaps(lens, extents, glass) for glass in (True, False)]
        overlap = sum(jnp.sum(jnp.maximum(-part, 0)) for pair in both for part in pair)
        # A stop at a focus of the light would make any lens perfect: all rays are one.
        system = paraxial_system(lens, self.wavelengths)
        marginal = marginal_ray(system, vergence_of(self.distances[0])).height
        slim = _SLIMMEST * jnp.max(jnp.abs(marginal)) - jnp.abs(system.aperture)
        overlap = overlap + jnp.maximum(slim, 0)
        finite = jnp.all(jnp.isfinite(residuals)) & jnp.all(jnp.isfinite(excess))
        broken = jnp.where(finite & jnp.isfinite(overlap), overlap, jnp.inf)
        failed = jnp.sum(~seen.rays.whole, dtype=jnp.int32) if self.traces else jnp.int32(0)
        return Judged(residuals, excess, jax.lax.stop_gradient(broken), failed)

    def _failures(self, seen: Seen) -> Array:
        """A residual for each ray: 0 for one that passes, else the root of its share of the light
        times a miss of several beams."""
        size = _FAILED * jax.lax.stop_gradient(seen.lens.semi_diameter[seen.lens.stop])
        wanted = [o.weight * OPERANDS[o.kind].per_mm for o in self.operands if not o.limits]
        weight = max(wanted, default=1.0)
        return jnp.ravel(weight * size * seen.failures)

    def limits(self, excess: Numbers) -> list[Limit]:
        """The limits by name, in the order of `Judged.excess` (L,)."""
        counts = {"fields": len(self.fields), "distances": len(self.distances)}
        counts |= {"wavelengths": len(self.wavelengths)}
        counts |= {"xy": 2 if self.rule.symmetry == "disc" else 1}
        return limits_of(self.operands, self.variables.lens, counts, np.asarray(excess))

    def elsewhere(self, vector: Array) -> Array:
        """A vector (N,) beside another, within the bounds, of which no number is the same."""
        low, high = self.variables.low, self.variables.high
        move = _BESIDE * jnp.cos(1 + 2 * jnp.arange(vector.size, dtype=vector.dtype))
        move = jnp.where((vector + move < low) | (vector + move > high), -move, move)
        return jnp.clip(vector + move, low, high)

    def refuse_fixed(self, excess: Numbers, beside: Numbers) -> None:
        """ValueError, which names it, for a limit that is exceeded (L,) and by as much beside.
        Not of rays: those that fail have no derivative until they pass."""
        one, two = np.asarray(excess), np.asarray(beside)
        for limit, there in zip(self.limits(one), self.limits(two)):
            if "fields" in OPERANDS[limit.kind].names:
                continue
            still = abs(there.excess - limit.excess) <= _STILL * (abs(limit.bound) + limit.excess)
            if limit.excess > 0 and still:
                raise ValueError(
                    f"operands: {limit}, and no variable moves it; leave this limit out, widen it, "
                    "or vary what it depends on"
                )

    @jax.jit
    def _excess(self, vector: Array) -> Array:
        """Of limits that need no rays: by how much they are exceeded."""
        seen = self.seen(self.variables.lens_of(vector))
        return jnp.concatenate([operand.excess(seen) for operand in self.operands])

    def _refuse_fixed(self) -> None:
        """The same for the limits that need no rays."""
        some = tuple(o for o in self.operands if o.limits and not OPERANDS[o.kind].traced)
        if some and concrete(self):
            part = dataclasses.replace(self, operands=some)
            start = self.variables.start
            part.refuse_fixed(part._excess(start), part._excess(self.elsewhere(start)))

    @jax.jit
    def extents(self, lens: Lens) -> Array:
        """How far from the axis the light meets each surface (S,) of a lens; see `Seen.extents`."""
        return self.seen(lens).extents

    @jax.jit
    def failed(self, vector: Array) -> Array:
        """How many rays fail, (), int32; see `Judged`."""
        return self.judge(vector).failed

    @jax.jit
    def merit(self, vector: Array) -> Array:
        """Sum () of the squares of the residuals; limits are not in it."""
        return jnp.sum(self.judge(vector).residuals ** 2)


def quick(problem: Problem) -> Problem:
    """The problem with the smaller program: rays are aimed, not searched for."""
    return dataclasses.replace(problem, solver=solve_aimed)
