"""The pairs of calls of `skips`: the same result with a skip and without it, and the error of each.

The reference is a trace by Snell's law (`_reference`), exact sums or, for kernels, very many rays.
"""

import dataclasses
import math
import time
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Clipped, Lens, Pattern, Scene, design, learn, pupil
from drt_jax.compilation import LARGE, known_options
from drt_jax.image.moments import moments
from drt_jax.lens.lens import Labels
from drt_jax.pupil import PupilRule, pupil_points
from drt_jax.rays.solve import solve, solve_aimed

from . import _reference, _work
from ._reference import relative_error, sigmas

_SEEDS = 8  # seeds of random rays; their error is the root mean square over these
_POSITIONS = 21  # number of positions of the sensor, and of the object


class Way(NamedTuple):
    """One of two ways to compute a result.

    words: description of the call.
    call: function without arguments, or None if its `seconds` are known.
    error: error of the result.
    rays: number of rays that a call traces, or None if the number is not meaningful.
    compile_s: seconds of compilation, or None.
    once_s: seconds of the preparation before the first call, with compiled programs; None for none.
    seconds: seconds of a call.
    """

    words: str
    call: Callable[[], Any] | None
    error: float
    rays: int | None = None
    compile_s: float | None = None
    once_s: float | None = None
    seconds: float | None = None


class View(NamedTuple):
    """An object point of the run.

    lens, scene: the lens and the point.
    rule: pupil rule converged to the tolerance of the run.
    once_s: seconds to find the rule.
    truth: reference, moments of an independent trace.
    """

    lens: Lens
    scene: Scene
    rule: PupilRule
    once_s: float
    truth: _reference.Moments

    def rays(self, rule: PupilRule) -> int:
        """Number of rays of a rule in all wavelengths."""
        return pupil_points(self.lens, self.scene, rule)[1].size

    def error(self, found: Any) -> float:
        """Relative error of the spot radius of moments."""
        return relative_error(self.truth, sigmas(found))


def once(make: Callable, *given: Any) -> tuple[Any, float]:
    """The result of a preparation, and its time, s, with compiled programs."""
    make(*given)
    began = time.perf_counter()
    return jax.block_until_ready(make(*given)), time.perf_counter() - began


def program(
    words: str, error: Callable[[Any], float], function: Callable, *given: Any, **known: Any
) -> Way:
    """A way that consists of one compiled program.

    words: description. error: function of the result. function, given: what is compiled, and its
    arguments. known: further fields of `Way`.
    """
    jax.clear_caches()  # no way shall use a trace that another has cached
    options = known_options(LARGE)  # the options that the package uses
    call, measured = _work.compiled(jax.jit(function, compiler_options=options), *given)
    return Way(words, call, error(call()), compile_s=measured["compile_s"], **known)


@cache
def view(config: Any, on_axis: bool) -> View:
    """The object point on the axis or at the field of the settings."""
    lens, distance = drt_jax.load_lens(config.lens), 1e3 * config.distance_m
    field = 0.0 if on_axis else math.radians(config.field_deg)
    scene = Scene.point(field, distance, config.wavelengths_um)
    rule, seconds = once(drt_jax.converge, drt_jax.psf_moments, lens, scene, config.to)
    truth = _reference.reference(lens, field, distance, config.wavelengths_um)
    return View(lens, scene, rule, seconds, truth)


def ordered(rule: PupilRule, order: int) -> PupilRule:
    """A rule of the same kind and another order."""
    size = {"size": 0} if isinstance(rule, Clipped) else {}  # its own
    return dataclasses.replace(rule, order=order, **size)


def spot(at: View, words: str, rule: PupilRule, **known: Any) -> Way:
    """Moments of the spot by a rule."""

    def found(lens: Lens) -> Any:
        return drt_jax.psf_moments(lens, at.scene, rule)

    return program(words, at.error, found, at.lens, rays=at.rays(rule), **known)


@cache
def converged(config: Any, on_axis: bool) -> Way:
    """Moments of the spot by the rule converged to the tolerance, which several rows use."""
    at = view(config, on_axis)
    return spot(at, f"{_kind(at.rule)} of converge", at.rule, once_s=at.once_s)


def symmetry(config: Any, on_axis: bool) -> list[Way]:
    """The spot from a part of the pupil, by symmetry, and from the whole pupil."""
    at = view(config, on_axis)
    whole = dataclasses.replace(at.rule, symmetry="none")
    words = f"{_kind(at.rule)}, {at.rule.symmetry}"
    part = converged(config, on_axis)._replace(words=words, once_s=None)
    return [part, spot(at, f"{_kind(whole)}, none", whole)]


def _kind(rule: PupilRule) -> str:
    """The name of a rule."""
    return f"{type(rule).__name__}({int(rule.order)})"


def order(config: Any) -> list[Way]:
    """The order for a tolerance, found before, and an order that suffices for many lenses."""
    at = view(config, False)
    generous = ordered(at.rule, config.generous)
    return [converged(config, False), spot(at, f"{_kind(generous)}, to be safe", generous)]


def found_anew(config: Any) -> list[Way]:
    """The order found in each call, outside of `jit`."""
    at = view(config, False)
    samplings = config.to, ordered(at.rule, config.generous)
    names = f"psf_moments to {config.to:g}", f"{_kind(samplings[1])}, to be safe"
    calls = [partial(drt_jax.psf_moments, at.lens, at.scene, how) for how in samplings]
    return [Way(name, call, at.error(call())) for name, call in zip(names, calls)]


def quadrature(config: Any) -> list[Way]:
    """Gauss nodes, and random rays."""
    at = view(config, False)
    points, weights = pupil.random_disc(config.random, 0)

    def found(points: Array) -> Any:
        return drt_jax.psf_moments(at.lens, at.scene, Pattern(points, weights))

    seeds = (pupil.random_disc(config.random, seed)[0] for seed in range(_SEEDS))
    errors = [at.error(jax.jit(found)(jnp.asarray(some))) for some in seeds]
    error = float(np.sqrt(np.mean(np.square(errors))))
    rays = config.random * len(config.wavelengths_um)
    by_chance = program("random_disc", lambda _: error, found, jnp.asarray(points), rays=rays)
    return [converged(config, False), by_chance]


def with_planes(lens: Lens, count: int) -> Lens:
    """The lens with `count` dummy planes in front of the sensor, which change no ray."""
    step = (lens.sensor - lens.vertices[lens.count - 1]) / (count + 1)
    for _ in range(count):
        lens = design.with_dummy(lens, lens.count - 1, step)
    return lens


def all_traced(lens: Lens) -> Lens:
    """The lens with all surfaces traced, because the medium behind each surface has another name.
    The indices do not change."""
    names = (f"{name} {k}" if k else name for k, name in enumerate(lens.glasses))
    return dataclasses.replace(lens, labels=Labels(lens.name, tuple(names)))


def dead(config: Any) -> list[Way]:
    """Surfaces between equal media left out, or traced."""
    at = view(config, False)
    lens = with_planes(at.lens, config.planes)
    pair = at._replace(lens=lens), at._replace(lens=all_traced(lens))
    words = [f"{len(some.lens.active)} of {lens.count} traced" for some in pair]
    return [spot(some, name, at.rule) for some, name in zip(pair, words)]


def aimed(config: Any) -> list[Way]:
    """Rays by aiming alone, or with the search for missing rays."""
    at = view(config, False)

    def by(solver: Callable) -> Way:
        def found(lens: Lens) -> Any:
            return moments(lens, at.scene, at.rule, solver).at(lens.sensor)

        return program(solver.__name__, at.error, found, at.lens, rays=at.rays(at.rule))

    return [by(solve_aimed), by(solve)]


def derivatives(config: Any, forward: bool) -> list[Way]:
    """The derivative of a spot radius by one thickness alone, or by all numbers of the lens."""
    at = view(config, False)
    k = min(at.lens.stop, at.lens.count - 2)
    exact = at.truth.gradient[0, 0, at.lens.count + k]

    def error(found: Array) -> float:
        return abs(float(found) / exact - 1)

    def radius(lens: Lens) -> Array:
        return sigmas(drt_jax.psf_moments(lens, at.scene, at.rule))[0]

    def changed(value: Array, lens: Lens) -> Array:
        return radius(dataclasses.replace(lens, thickness=lens.thickness.at[k].set(value)))

    def one(lens: Lens) -> Array:
        value = lens.thickness[k]
        if forward:
            return jax.jvp(partial(changed, lens=lens), (value,), (jnp.ones_like(value),))[1]
        return jax.grad(changed)(value, lens)

    def every(lens: Lens) -> Array:
        if forward:
            still = jax.tree.map(jnp.zeros_like, lens)
            moving = dataclasses.replace(still, thickness=still.thickness.at[k].set(1))
            return jax.jvp(radius, (lens,), (moving,))[1]
        return jax.grad(radius)(lens).thickness[k]

    ways = {"by one thickness": one, "by the whole lens": every}
    return [program(name, error, way, at.lens) for name, way in ways.items()]


reverse, forward = (partial(derivatives, forward=way) for way in (False, True))


def sensors(config: Any) -> list[Way]:
    """The spot at many sensor positions: polynomials from one trace, or a trace for each."""
    at = view(config, False)
    reach = 20 * float(at.truth.sigma[0])
    places = at.lens.sensor + jnp.linspace(-reach, reach, _POSITIONS)
    moved = [dataclasses.replace(at.lens, sensor=places[k]) for k in (0, -1)]
    true = [_true(config, lens, 1e3 * config.distance_m) for lens in moved]
    given = drt_jax.focus_moments, at.lens, at.scene, config.to
    rule, seconds = once(drt_jax.converge, *given)
    rays = at.rays(rule)

    def error(found: Array) -> float:
        return _worst(found[jnp.array([0, -1])], true)

    def polynomials(lens: Lens, places: Array) -> Array:
        focus = drt_jax.focus_moments(lens, at.scene, rule)
        return jax.vmap(lambda place: sigmas(focus.at(place)))(places)

    def traced(lens: Lens, places: Array) -> Array:
        def one(place: Array) -> Array:
            moved = dataclasses.replace(lens, sensor=place)
            return sigmas(drt_jax.psf_moments(moved, at.scene, rule))

        return jax.vmap(one)(places)

    given = at.lens, places
    return [
        program("focus_moments(...).at", error, polynomials, *given, rays=rays, once_s=seconds),
        program("psf_moments for each", error, traced, *given, rays=_POSITIONS * rays),
    ]


def _true(config: Any, lens: Lens, distance: float) -> float:
    """Spot radius at the first wavelength and the field of the settings, by the independent trace,
    mm."""
    waves = config.wavelengths_um[:1]
    found = _reference.reference(lens, math.radians(config.field_deg), distance, waves)
    return float(found.sigma[0])


def _worst(found: Array, true: list[float]) -> float:
    """Largest relative error of spot radii (N, W) at the first wavelength."""
    return float(np.max(np.abs(np.asarray(found)[:, 0] / np.array(true) - 1)))


def depths(config: Any) -> list[Way]:
    """The spot of objects at many distances: polynomials in 1 / distance, or a trace for each."""
    at = view(config, False)
    ends = [1e3 * distance for distance in config.depths_m]
    far = 1 / np.linspace(1 / ends[0], 1 / ends[1], _POSITIONS)
    scene = Scene.point(math.radians(config.field_deg), ends, config.wavelengths_um)
    true = [_true(config, at.lens, distance) for distance in far[[0, 1]]]
    (values, blur), seconds = once(learn.moments_model, at.lens, ("sensor",), scene, config.to)
    rule = drt_jax.converge(drt_jax.psf_moments, at.lens, scene, config.to)

    def error(found: Array) -> float:
        return _worst(found[:2], true)

    def polynomials(values: dict[str, Array], far: Array) -> Array:
        return jax.vmap(lambda distance: sigmas(blur(values, distance)))(far)

    def traced(lens: Lens, far: Array) -> Array:
        def one(distance: Array) -> Array:
            scene = at.scene.at(at.scene.field, distance)
            return sigmas(drt_jax.psf_moments(lens, scene, rule))

        return jax.vmap(one)(far)

    rays, far = _POSITIONS * at.rays(rule), jnp.asarray(far)
    return [
        program("learn.moments_model", error, polynomials, values, far, rays=0, once_s=seconds),
        program("psf_moments for each", error, traced, at.lens, far, rays=rays),
    ]
