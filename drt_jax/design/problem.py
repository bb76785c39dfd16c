"""A design problem: variables, a scene and operands."""

import collections
import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..image.rounding import warn_of_paths
from ..inputs import require, shown
from ..lens.lens import Lens
from ..lens.paraxial import marginal_ray, paraxial_system
from ..lens.scene import Scene, checked_scene, vergence_of
from ..numerics import Numbers, concrete
from ..pupil.clipped import Clipped
from ..pupil.rules import Gauss, PupilRule
from ..rays.solve import Solver, solve
from .failures import failures
from .field_rays import FieldRays, beam_radius, symmetry_by_structure, trace_views
from .least_squares import Evaluation
from .limits import Limit, limits_of, refuse_fixed
from .media import gaps
from .operands import Operand, OperandFunction, OperandName
from .values import kind_of
from .variables import Variables
from .waves import degree_of

_OF_PATHS = "path_difference", "rms_wavefront"
# Smallest penalty of a failed ray: it counts as a miss by this many semi-diameters of the stop.
_FAILED = 4.0
# Smallest height of the marginal ray at the stop, relative to its largest height on any surface.
_SLIMMEST = 0.1


def weights_of(what: str, given: Numbers, count: int) -> np.ndarray:
    """Weights (count,) with the mean 1. ValueError, which begins with `what`, for a wrong shape or
    value.
    """
    found = np.asarray(given, float)
    valid = found.shape == (count,) and np.all(np.isfinite(found) & (found >= 0))
    require(valid and np.any(found), f"{what}: expected {count} numbers of 0 or above, not all 0")
    return found / found.mean()


def _axes(scene: Scene) -> tuple[Array, Array, Array]:
    """Fields (F, 2), distances (Z,) and wavelengths (W,) of a scene with every field at every
    distance. ValueError for other points."""
    field, far = scene.field, scene.distance
    is_grid = far.ndim == 2 and far.shape[1] == 1 == field.ndim - 1
    what = "scene: a problem has every field at every distance: take Scene.grid(fields, distances)"
    require(not far.ndim or field.ndim == 1 or is_grid, what)
    return field.reshape(-1, 2), far.reshape(-1), scene.wavelengths


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Problem:
    """A design problem. All numbers are leaves, so that a change of a number compiles nothing.

    variables: the variables of the lens.
    fields: (F, 2), radians.
    distances: (Z,), distances of the object, mm; every field is traced at every distance.
    wavelengths: (W,), um.
    wavelength_weights: (W,), with the sum 1.
    rule: pupil rule of all fields.
    operands: operands as `Operand.placed` returns them.
    field_weights: (F,), factors of the squares of the residuals of each field, with the mean 1;
        None for 1.

    Static:
    solver: ray solver. The default, a full search, finds every ray that exists. `optimise`,
        `many_starts` and `monte_carlo` first use `solve_aimed`, which is a smaller program, and the
        full search only where that misses a ray.
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
        variables: Variables | Sequence[Variables],
        operands: Sequence[Operand | OperandName | OperandFunction],
        scene: Scene | None = None,
        sampling: PupilRule | int = 6,
    ) -> "Problem":
        """Makes a problem.

        variables: variables of a lens, or several sets of variables of one lens, see
            `Variables.joined`.
        operands: operands, at least one with a weight above 0; a name or a function stands for an
            operand of weight 1.
        scene: fields at one distance, or every field at every distance, as of `Scene.grid`, with
            wavelengths and weights; by default a point on the axis at infinity, in the d line.
            Limits do not depend on the weights.
        sampling: pupil rule of all fields, or the order of a Gauss rule.

        ValueError, which names the argument, if an argument does not fit the lens or the problem,
        and for a limit that the lens violates and that no variable changes. (For limits that need
        rays, `optimise` raises it.) With operands of waves and wavefronts, warns of float32 as
        `wavefront` does.
        """
        variables = Variables.joined(variables)
        lens = variables.lens
        asked = tuple(o if isinstance(o, Operand) else Operand(o) for o in operands)
        dtype = lens.curvature.dtype
        scene = checked_scene(lens, Scene.point() if scene is None else scene)
        angles, far, waves = _axes(scene)
        rule = sampling
        if isinstance(rule, int):
            across = not np.any(np.asarray(angles)[:, 0])
            symmetry = symmetry_by_structure(lens, not np.any(np.asarray(angles)))
            rule = Gauss(rule, symmetry if across else "none")
        if isinstance(rule, Clipped):  # trace no rays of weight 0
            rule = dataclasses.replace(rule, order=int(rule.order), size=0)
        share = weights_of("wavelength_weights", scene.spectrum, len(waves)) / len(waves)
        weights = scene.field_weights
        if weights is not None:
            weights = jnp.asarray(weights_of("field_weights", weights, len(angles)), dtype)
        numbers = angles, far, waves, jnp.asarray(share, dtype)
        problem = cls(variables, *numbers, rule, asked, field_weights=weights)
        problem._check_operands()
        # Warn if float32 rounds the path differences of these operands too much.
        of_beams = any(kind_of(o.kind).of_waves for o in asked)
        if of_beams or any(o.kind in _OF_PATHS for o in asked):
            warn_of_paths(lens, scene, of_beams=of_beams)
        on = tuple(operand.placed(lens) for operand in asked if operand.weight)
        problem = dataclasses.replace(problem, operands=on)
        problem._refuse_fixed()
        return problem

    def _check_operands(self) -> None:
        """Raises ValueError for operands that do not fit the lens, the scene or the rule."""
        require(self.operands, "operands: none; a merit needs at least one, such as spot")
        distances, rule = np.asarray(self.distances), self.rule
        for operand in self.operands:
            what = f"operands: {operand.name}"
            operand.check(self.variables.lens, self.counts)
            named = distances[np.array(operand.distances or range(len(distances)))]
            near = operand.kind != "magnification" or np.all(np.isfinite(named))
            require(near, f"{what}: the object is at infinity")
            whole = operand.vignetting or not isinstance(rule, Clipped)
            remedy = "Clipped traces only what passes; take Gauss or Soft"
            require(whole, f"{what}: vignetting: {remedy}")
            fits = not kind_of(operand.kind).of_waves or degree_of(rule) >= 2
            needs = "needs Gauss or Soft of the order 2 or more, or Clipped of the order 3 or more"
            require(fits, f"{what}: rule: {needs}; got {shown(rule)}")
        weighs = any(operand.weight for operand in self.operands)
        require(weighs, "operands: all have the weight 0; a merit needs at least one")

    @property
    def counts(self) -> dict[str, int]:
        """Numbers of fields, wavelengths and distances."""
        return {name: len(getattr(self, name)) for name in ("fields", "wavelengths", "distances")}

    def __str__(self) -> str:
        """About ten lines: variables, rays and operands."""
        if not concrete(self):
            return repr(self)
        across, up = np.degrees(np.asarray(self.fields)).T
        fields = ", ".join(f"({x:.4g}, {y:.4g})" if x else f"{y:.4g}" for x, y in zip(across, up))
        waves = ", ".join(f"{wave:.4g}" for wave in np.asarray(self.wavelengths))
        far = ", ".join(f"{distance:.6g}" for distance in np.asarray(self.distances))
        lines = [f"  {operand.described()}" for operand in self.operands]
        more = [f"  and {len(lines) - 6} more operands"] if len(lines) > 6 else []
        kinds = collections.Counter(place.kind for place in self.variables.places)
        varied = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
        first = [
            f"{self.variables.lens.name or 'lens'}: variables: {varied}",
            f"  fields {fields} degrees; object at {far} mm; wavelengths {waves} um",
            f"  rays of {self.rule}; {len(lines)} operands:",
        ]
        return "\n".join([*first, *lines[:6], *more])

    def with_solver(self, solver: Solver) -> "Problem":
        """The problem with another ray solver; with `solve_aimed` it is a smaller program, without
        the full ray search.
        """
        return dataclasses.replace(self, solver=solver)

    def with_order(self, order: int) -> "Problem":
        """The problem with a Gauss rule of another order."""
        return dataclasses.replace(self, rule=Gauss(order, self.rule.symmetry))

    def views(self) -> FieldRays:
        """All fields at all distances, without rays."""
        fields, distances = len(self.fields), len(self.distances)
        field, distance = jnp.tile(self.fields, (distances, 1)), jnp.repeat(self.distances, fields)
        scene = Scene(field, distance, self.wavelengths, self.wavelength_weights)
        return FieldRays(scene, self.rule, fields, distances)

    @property
    def traces(self) -> bool:
        """Whether any operand needs rays."""
        return any(kind_of(operand.kind).traced for operand in self.operands)

    def evaluate(self, vector: Array) -> Evaluation:
        """Residuals, constraints, overlap and number of failed rays at a vector of the variables.

        Works in `jit`, `vmap` and under differentiation.

        vector: (N,).
        """
        lens = self.variables.lens_of(vector)
        rays = self._rays(lens)
        parts = [operand.residuals(lens, rays, self.field_weights) for operand in self.operands]
        if self.traces:  # failed rays count in the unit of the operand with the largest weight
            size = _FAILED * jax.lax.stop_gradient(lens.semi_diameter[lens.stop])
            weights = [o.weight * kind_of(o.kind).per_mm for o in self.operands if not o.limits]
            weight = jnp.max(jnp.stack(weights)) if weights else 1.0
            parts.append(jnp.ravel(weight * size * failures(lens, rays)))
        residuals = jnp.concatenate(parts)
        constraints = jnp.concatenate(self._constraints(lens, rays))
        radius = beam_radius(lens, rays) if self.traces else jnp.zeros(lens.count, vector.dtype)
        both = [gaps(lens, radius, glass) for glass in (True, False)]
        overlap = sum(jnp.sum(jnp.maximum(-part, 0)) for pair in both for part in pair)
        # Reject a stop at a focus of the beam: all rays coincide there, and any lens seems perfect.
        system = paraxial_system(lens, self.wavelengths)
        marginal = marginal_ray(system, vergence_of(self.distances[0])).height
        slim = _SLIMMEST * jnp.max(jnp.abs(marginal)) - jnp.abs(system.aperture)
        overlap = overlap + jnp.maximum(slim, 0)
        finite = jnp.all(jnp.isfinite(residuals)) & jnp.all(jnp.isfinite(constraints))
        overlap = jnp.where(finite & jnp.isfinite(overlap), overlap, jnp.inf)
        failed = jnp.sum(~rays.arrives, dtype=jnp.int32) if self.traces else jnp.int32(0)
        return Evaluation(residuals, constraints, jax.lax.stop_gradient(overlap), failed)

    def _rays(self, lens: Lens) -> FieldRays:
        """The views of a lens, with rays if any operand needs them."""
        return trace_views(lens, self.views(), self.solver) if self.traces else self.views()

    def _constraints(self, lens: Lens, rays: FieldRays) -> list[Array]:
        """The constraints of each operand, (L,) in all."""
        return [operand.constraints(lens, rays) for operand in self.operands]

    def limits(self, constraints: Numbers) -> list[Limit]:
        """The limits by name, in the order of `Evaluation.constraints`.

        constraints: (L,), constraints of an evaluation.
        """
        counts = self.counts | {"xy": 2 if self.rule.symmetry == "none" else 1}
        lens, sizes = self.variables.lens, [0] * len(self.operands)
        if any(callable(operand.kind) for operand in self.operands):
            each = jax.eval_shape(lambda lens: self._constraints(lens, self._rays(lens)), lens)
            sizes = [a.size for a in each]
        return limits_of(self.operands, lens, counts, sizes, np.asarray(constraints))

    def _refuse_fixed(self) -> None:
        """Calls `refuse_fixed` for limits that need no rays."""
        without_rays = tuple(o for o in self.operands if o.limits and not kind_of(o.kind).traced)
        if without_rays and concrete(self):
            part, start = dataclasses.replace(self, operands=without_rays), self.variables.start
            excess = _exceeded(part, start)
            if np.any(excess > 0):
                refuse_fixed(part.limits, excess, _exceeded_slopes(part, start))

    @jax.jit
    def beam_radius(self, lens: Lens) -> Array:
        """Radius of the beam footprint on each surface of a lens (S,), mm."""
        return beam_radius(lens, trace_fields(self, lens))

    @jax.jit
    def failed(self, vector: Array) -> Array:
        """Number of failed rays, (), int32."""
        return self.evaluate(vector).failed

    @jax.jit
    def merit(self, vector: Array) -> Array:
        """Sum of the squares of the residuals, (); limits do not contribute."""
        return jnp.sum(self.evaluate(vector).residuals ** 2)


@jax.jit
def trace_fields(problem: Problem, lens: Lens) -> FieldRays:
    """Traces the rays of a lens from all fields and distances of a problem.

    Differentiable, also in `jit` and `vmap`.

    problem: gives the fields, distances, wavelengths and pupil rule.
    lens: the lens.
    """
    return trace_views(lens, problem.views(), problem.solver)


@jax.jit
def _exceeded(problem: Problem, vector: Array) -> Array:
    """Constraints (L,) of a problem without rays, at a vector (N,)."""
    lens = problem.variables.lens_of(vector)
    return jnp.concatenate(problem._constraints(lens, problem.views()))


_exceeded_slopes = jax.jit(jax.jacfwd(_exceeded, argnums=1))


def open_apertures(lens: Lens) -> Lens:
    """The lens with infinite semi-diameters, except for the stop, which keeps its own.

    lens: the lens. Its `apertures` are not changed.
    """
    return with_apertures(lens, jnp.full_like(lens.semi_diameter, jnp.inf))


def fit_apertures(problem: Problem, lens: Lens, margin: float = 0.01) -> Lens:
    """The lens with semi-diameters that just pass the rays of all fields of a problem.

    The stop keeps its own semi-diameter.

    problem: the problem whose rays must pass.
    lens: a lens with open apertures, see `open_apertures`.
    margin: relative increase of the semi-diameters.
    """
    return with_apertures(lens, jnp.append((1 + margin) * problem.beam_radius(lens), jnp.inf))


def with_apertures(lens: Lens, semi_diameter: Array) -> Lens:
    """The lens with other semi-diameters (S + 1,), except for the stop."""
    own = lens.semi_diameter[lens.stop]
    return dataclasses.replace(lens, semi_diameter=semi_diameter.at[lens.stop].set(own))
