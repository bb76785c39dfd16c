"""Tolerances: what errors of the parts do to the spots, by derivatives and by Monte Carlo.

The measure of a lens is the mean over its fields of the squared RMS radius of the polychromatic
spot, after the compensators have done their best. Spots are quadratic in where the sensor is, so
that this is a small linear system, solved for every lens.
"""

import concurrent.futures
import os
from collections.abc import Callable
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..numerics import safe_divide
from ..rays.status import Status
from .perturbed import Perturbed
from .problem import Problem
from .seen import EXTRAS, Seen

Compensator = Literal["none", "focus", "focus and tilt"]
_TILE = 50  # lenses of a tile, in one program on one core
_STEPS = {"none": 0, "focus": 1, "focus and tilt": 3}


class Made(NamedTuple):
    """A lens as it is made, after compensation.

    squares: (F,), squared RMS radii of the spots, mm^2; inf where no light passes. moves: (C,), of
    the compensators: mm of the sensor, then its tilts about -x and y, radians. whole: (), whether all
    rays passed.
    """

    squares: Array
    moves: Array
    whole: Array


def _spots(seen: Seen) -> tuple[Array, Array, Array]:
    """Distances from the centroid and how they grow with the sensor's distance, (2, V, W Q) each in
    mm and without unit, times the root of the light; and centroids (2, V), mm."""
    rays, waves = seen.rays, seen.colour_weights[:, None]
    light = (rays.light * waves)[..., EXTRAS:]
    good = (rays.bundle.status == Status.OK)[..., EXTRAS:] & (light > 0)
    light = jnp.where(good, light, 0)
    arrival = [a[..., EXTRAS:] for a in rays.bundle.arrival]
    both = [h[:, -1, :, EXTRAS:] for h in rays.bundle.hits]
    both += [safe_divide(a, arrival[-1]) for a in arrival[:-1]]
    total = jnp.sum(light, axis=(1, 2))
    values = jnp.stack([jnp.where(good, b, 0) for b in both])
    weight = safe_divide(light, jnp.broadcast_to(total[:, None, None], light.shape))
    mean = jnp.sum(weight * values, axis=(2, 3))
    apart = (values - mean[..., None, None]) * jnp.sqrt(jnp.where(good, weight, 1))
    apart = jnp.where(good, apart, 0).reshape(4, len(light), -1)
    return apart[:2], apart[2:], mean[:2]


def made(problem: Problem, lens: Lens, compensator: Compensator) -> tuple[Made, Array]:
    """A lens after compensation, and its residuals (2, V, W Q): distances from the centroids, whose
    squares add up to those of the RMS radii."""
    seen = problem.seen(lens)
    apart, growth, centre = _spots(seen)
    count = _STEPS[compensator]
    # The sensor moves by d + a x + b y where a spot is.
    levers = jnp.stack([jnp.ones_like(centre[0]), centre[1], centre[0]])[:count]
    linear = jnp.sum(apart * growth, axis=(0, 2))
    square = jnp.sum(growth**2, axis=(0, 2))
    matrix = (levers * square) @ levers.T
    moves = -jnp.linalg.solve(matrix, levers @ linear) if count else jnp.zeros(0)
    apart = apart + growth * (moves @ levers if count else 0 * square)[:, None]
    passed = jnp.all(seen.rays.passed > 0, axis=1)
    squares = jnp.where(passed, jnp.sum(apart**2, axis=(0, 2)), jnp.inf)
    return Made(squares, moves, jnp.all(seen.rays.whole[..., EXTRAS:])), apart


class Predicted(NamedTuple):
    """The measure q = mean squared RMS radius as a function of errors in parts of their largest.

    nominal: (), q without errors. gradient: (P,). gauss: (P, P), of the second derivatives the part
    that follows from first derivatives of rays. hessian: (P, P), all of them.
    """

    nominal: Array
    gradient: Array
    gauss: Array
    hessian: Array

    def at(self, off: Array, order: Literal["rays", "second"]) -> Array:
        """q (K,) of errors (K, P), from the first derivatives of the rays or from the second
        derivatives of q."""
        matrix = self.gauss if order == "rays" else self.hessian
        return self.nominal + off @ self.gradient + jnp.sum(off * (off @ matrix), axis=-1) / 2


def _measure(problem: Problem, perturbed: Perturbed, off: Array, compensator: Compensator) -> tuple:
    found, apart = made(problem, perturbed.lens_of(off), compensator)
    return jnp.mean(found.squares), apart / jnp.sqrt(len(found.squares))


def predict(problem: Problem, perturbed: Perturbed, compensator: Compensator) -> Predicted:
    """What first and second derivatives say, each exact."""
    return _predict(problem, perturbed, compensator)


def _predict_all(problem: Problem, perturbed: Perturbed, compensator: Compensator) -> Predicted:
    zero = jnp.zeros(len(perturbed.errors), perturbed.extents.dtype)
    units = jnp.eye(len(zero), dtype=zero.dtype)

    def rays(off: Array) -> Array:
        return _measure(problem, perturbed, off, compensator)[1]

    apart, push = jax.linearize(rays, zero)
    moved = jax.lax.map(push, units).reshape(len(zero), -1)
    gradient = 2 * moved @ apart.ravel()

    def slope(off: Array) -> Array:
        return jax.grad(lambda off: _measure(problem, perturbed, off, compensator)[0])(off)

    hessian = jax.lax.map(lambda unit: jax.jvp(slope, (zero,), (unit,))[1], units)
    return Predicted(jnp.sum(apart**2), gradient, 2 * moved @ moved.T, hessian)


_predict = jax.jit(_predict_all, static_argnums=2)


def draw_errors(perturbed: Perturbed, count: int, seed: int, normal: bool = False) -> np.ndarray:
    """Errors (count, P) in parts of their largest: uniform, or normal with a standard deviation of
    a half, cut off at 1. Those in x and y of one part lie within a circle."""
    rng = np.random.default_rng(seed)
    shape = count, len(perturbed.errors)
    if not normal:
        off = rng.uniform(-1, 1, shape)
    else:
        off = rng.normal(0, 0.5, shape)
        while np.any(beyond := np.abs(off) > 1):
            off[beyond] = rng.normal(0, 0.5, int(beyond.sum()))
    return off


def monte_carlo(
    problem: Problem,
    perturbed: Perturbed,
    off: np.ndarray,
    compensator: Compensator,
    report: Callable[[int], None] = lambda done: None,
    threads: int | None = None,
) -> Made:
    """The lenses of errors (K, P), as many as `off` has rows, traced; arrays with a first axis (K,).
    report: called with how many are done."""
    count = len(off)
    tiles = [off[k : k + _TILE] for k in range(0, count, _TILE)]

    def run(rows: np.ndarray) -> Made:
        whole = np.resize(rows, (_TILE, rows.shape[1]))
        found = _many(problem, perturbed, jnp.asarray(whole), compensator)
        return jax.tree.map(lambda a: np.asarray(a)[: len(rows)], found)

    parts = []
    with concurrent.futures.ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        for part in pool.map(run, tiles):
            parts.append(part)
            report(sum(len(p.whole) for p in parts))
    return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def _many_of(problem: Problem, perturbed: Perturbed, off: Array, compensator: Compensator) -> Made:
    return jax.vmap(lambda one: made(problem, perturbed.lens_of(one), compensator)[0])(off)


_many = jax.jit(_many_of, static_argnums=3)
