"""A lens as built after its sensor has been adjusted, and its spots.

The distance o of a ray from the centroid changes linearly with the shift t of the sensor at the
spot, o + g t, where g is the slope of the ray less the mean slope. So the mean squared RMS radius
is quadratic in the compensation, and the normal equations of a small linear least-squares problem
give the best one.
"""

from typing import Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require, require_one_of
from ..lens.lens import Lens
from ..numerics import concrete, matmul
from .field_rays import EXTRAS, FieldRays, symmetry_by_structure
from .problem import Problem

# What is adjusted in every lens: the distance of the sensor, in each configuration or once for all,
# or also its tilts about x and y in each.
Compensator = Literal["none", "focus", "common focus", "focus and tilt"]
COUNTS = {"none": 0, "focus": 1, "common focus": 1, "focus and tilt": 3}
_SYMMETRIES = ("rotational", "bilateral", "none")  # by the traced part of the pupil, smallest first


class AsBuilt(NamedTuple):
    """A lens as built, after compensation.

    squares: (V,), squared RMS radii of the spots, mm^2; inf where rays fail or no light passes.
        Several configurations are concatenated.
    moves: (C,), compensation: the shift of the sensor, mm, then its tilts about x and -y, radians,
        of each configuration; or the adjustments of an `Assembly` in the units of its tolerances.
    value: (), the criterion, see `Assembly`: by default the spot, the root of the mean of the
        squares, mm. If rays fail, it is infinite, with the sign that leads away from the target.
    each: (Z,), the criterion of each configuration.
    """

    squares: Array
    moves: Array
    value: Array
    each: Array

    @property
    def spot(self) -> Array:
        """The square root of q, (), mm."""
        return jnp.sqrt(jnp.mean(self.squares, axis=-1))


def _with_levers(
    lens: Lens, rays: FieldRays, compensator: Compensator
) -> tuple[Array, Array, Array]:
    """Distances (D, V, W Q) of rays from the centroid of their view, mm, and their derivatives g by
    the shift of the sensor, both times the root of the weight of the ray; and how far the sensor
    moves at each spot for each adjustment, the levers (L, V).

    At a spot (x, y) the sensor moves by d n + a y + b x along its normal, where d is the change of
    `Lens.sensor`, n the normal component of the motion of the sensor, and a, b are the tilts.
    """
    each = map(rays.spread, (rays.bundle.sensor, rays.bundle.slopes))
    (offsets, means), (growth, _) = ((a.reshape(*a.shape[:2], -1), mean) for a, mean in each)
    y, motion = means[-1][:, 0, 0], lens.sensor_motion
    x = means[0][:, 0, 0] if len(means) == 2 else jnp.zeros_like(y)
    normal = jnp.ones_like(x) if motion is None else jnp.broadcast_to(motion[2], x.shape)
    return offsets, growth, jnp.stack([normal, y, x])[: COUNTS[compensator]]


def normal_equations(lens: Lens, rays: FieldRays, compensator: Compensator) -> tuple[Array, Array]:
    """Matrix (L, L) and right side (L,) whose solution is the best compensation of a lens.

    With the distances o and their derivatives g of all rays, and the shift of the sensor t_v =
    sum_k m_k l_kv at the spot of view v (levers l: 1, y and x of the centroid), the compensation m
    solves (sum g^2 l l^T) m = -sum o g l.
    """
    offsets, growth, levers = _with_levers(lens, rays, compensator)
    square = jnp.sum(growth**2, axis=(0, 2))
    matrix = matmul(levers * square[None], levers.T)
    return matrix, -matmul(levers, jnp.sum(offsets * growth, axis=(0, 2)))


def solved(matrix: Array, right: Array) -> Array:
    """The solution (L,) of normal equations; the right side, which is 0, if there is no light."""
    if not len(right):
        return right
    lit = matrix[0, 0] > 0
    return jnp.linalg.solve(jnp.where(lit, matrix, jnp.eye(len(right), dtype=right.dtype)), right)


def compensated(
    lens: Lens, rays: FieldRays, compensator: Compensator, moves: Array | None = None
) -> tuple[AsBuilt, Array]:
    """A lens with traced rays after compensation, and its residuals. Call `check` before.

    moves: (L,), compensation; None for that of `normal_equations`.

    Returns the result, and the residuals (D, V, W Q): distances from the centroids, mm, whose
    squares add up to the squared RMS radii.
    """
    if moves is None:
        moves = solved(*normal_equations(lens, rays, compensator))
    offsets, growth, levers = _with_levers(lens, rays, compensator)
    offsets = offsets + growth * matmul(moves, levers)[None, :, None]
    light = rays.weights[..., EXTRAS:] > 0
    failed = jnp.any(light & ~rays.arrives[..., EXTRAS:], axis=(1, 2))
    valid = ~failed & jnp.all(rays.throughput > 0, axis=1)
    squares = jnp.where(valid, jnp.sum(offsets**2, axis=(0, 2)), jnp.inf)
    value = jnp.sqrt(jnp.mean(squares))
    return AsBuilt(squares, moves, value, value[None]), offsets


def check(problem: Problem, lens: Lens, compensator: str) -> None:
    """Raises the ValueErrors of `Assembly.placed` that concern the sensor and the pupil rule."""
    require_one_of("compensator", compensator, get_args(Compensator))
    has, needs = problem.rule.symmetry, symmetry_by_structure(lens, axial=True)
    what = f'rule: "{has}" leaves out part of the pupil, but deviations break the symmetry'
    remedy = f'use one of symmetry "{needs}", such as Gauss(6, "{needs}")'
    require(_SYMMETRIES.index(has) >= _SYMMETRIES.index(needs), f"{what}; {remedy}")
    if compensator == "focus and tilt" and concrete(problem.fields):
        tangents = np.tan(np.asarray(problem.fields, float))
        spread = np.linalg.matrix_rank(np.c_[np.ones(len(tangents)), tangents]) == 3
        what = "compensator: focus and tilt: the fields lie on a line, so that the tilt about this"
        require(spread, f"{what} line is undetermined; add a field off the line")
