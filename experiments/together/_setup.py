"""What the arms of a joint design share: lens, camera, the model that judges, training steps."""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Lens, Scene, design, learn
from drt_jax.design.optimum import init_problem, take_step
from drt_jax.design.problem import quick
from drt_jax.devices import shared
from drt_jax.learn.data import Patches
from drt_jax.learn.field import (
    FieldImager,
    ObjectPoints,
    draw_points,
    make_damped_step,
    make_field_step,
)

from . import _common
from ._sharing import mesh_of
from .runs.config import ConfigError

# Relative fields of least squares, and the order of its pupil rule.
_FIELDS, _ORDER = np.array([0.0, 0.7, 1.0]), 6
# Light outside of a kernel that the spoilt lens may have.
_LOST = 0.2
# Lenses as built that training draws from, and their seed; the judge takes another.
_BUILDS, SEED = 4096, 1
# Golden angle, radians.
_TURN = math.pi * (3 - math.sqrt(5))


class Arm(NamedTuple):
    """One way to design lens and network.

    title: its name in tables and figures.
    begins: lens at the start: "spoilt", or finished by least squares on "spots" or "mtf".
    moves: what training changes of the lens: "all" variables, the "sensor", or "nothing".
    steps: of the lens: "adam", "rays" (`design.RaySteps`) or "damped" (least squares on pixels).
    frozen: True for the network that the arm `spots` has trained, which stays.
    as_built: True for a lens with errors of its own in each step.
    """

    title: str
    begins: str
    moves: str = "all"
    steps: str = "adam"
    frozen: bool = False
    as_built: bool = False


ARMS = {
    "focus": Arm("(a) focus and network", "spoilt", "sensor"),
    "spots": Arm("(b) least squares on spots, then network", "spots", "nothing"),
    "mtf": Arm("(c) least squares on MTF, then network", "mtf", "nothing"),
    "joint": Arm("(d) jointly from the spoilt lens", "spoilt"),
    "joint_from_spots": Arm("(e) jointly from (b)", "spots"),
    "frozen": Arm("(f) lens of (b) through its frozen network", "spots", frozen=True),
    "damped": Arm("(d) with least-squares steps of the lens", "spoilt", steps="damped"),
    "rays": Arm("(d) with steps of rays", "spoilt", steps="rays"),
    "rays_from_spots": Arm("(e) with steps of rays", "spots", steps="rays"),
    "tolerant": Arm("(e) with lenses as built", "spots", as_built=True),
}


class Setup:
    """What all arms of a run share.

    variables: of the lens, with open apertures.
    spots, sharp: problems of least squares, on spots and on MTF.
    limits: problem whose limits hold in training.
    spoilt: (N,), vector of the spoilt lens.
    patches: training and test patches.
    pixels: side of a pixel, mm, and of a kernel, pixels.
    mesh: devices that share a batch; None for one.
    """

    def __init__(self, config: Any, patches: Patches) -> None:
        self.config, self.patches = config, patches
        self._steps: dict[tuple, tuple[Callable, Callable]] = {}
        lens = design.open_apertures(drt_jax.load_lens(config.lens))
        self.variables = self._variables(lens)
        self.waves = np.array(config.wavelengths_um)
        self.pixels = 1e-3 * config.camera.pixel_um, config.camera.kernel
        self.field = math.radians(config.field_deg)
        self.depths = tuple(1e3 * d for d in config.depth_m)
        contrast = design.Operand("mtf", target=1.0, at=config.mtf_at)
        limits = tuple(config.limits)
        self.spots, self.sharp = (self._problem((o, *limits)) for o in ("spot", contrast))
        self.limits = self._problem(limits or ("spot",))
        spoil = config.spoil
        errors = spoil.per_cent, spoil.off_mm, spoil.seed
        vector = design.as_built_starts(self.variables, 1, *errors)[0]
        self.spoilt = jnp.clip(vector, self.variables.low, self.variables.high)
        self.init, self.restore = learn.red_net(**dataclasses.asdict(config.network))
        self.mesh = mesh_of(config.devices)
        self.model = self._model()
        axis = Scene.point(0.0, self.depths[1], self.waves)
        self._axis = drt_jax.psf(lens, axis, *self.pixels, sampling=self.model).solid_angle
        # With n cells a kernel of waves repeats after n times half a wavelength over the aperture.
        fringe = 5e-4 * self.waves / np.sqrt(np.asarray(self._axis) / np.pi)
        pixel, size = self.pixels
        least = math.ceil(1.1 * size * pixel / np.min(fringe))
        room = f"camera.kernel: {size} pixels of {config.camera.pixel_um:g} um"
        remedy = f"{room} need {least} cells of waves: raise judge.cells or give a smaller kernel"
        _common.require(config.judge.cells >= least, remedy)
        if config.tolerances:
            radius = self.spots.beam_radius(lens)
            self.built = design.PerturbedLens.from_lens(lens, radius, config.tolerances)
            self._whole = self._variables(self.built.lens)

    def _variables(self, lens: Lens) -> design.Variables:
        config, middle = self.config, (self.config.wavelengths_um[1],)
        solves = [
            dataclasses.replace(s, distance=1e3 * config.depth_m[1], wavelengths=middle)
            for s in config.solves
        ]
        return design.Variables.from_lens(lens, config.variables, config.ties, solves)

    def _problem(self, operands: tuple) -> design.Problem:
        near, far = (1 / d for d in self.depths)
        parts = np.unique(np.linspace(near, far, 1 if near == far else 3))
        distances = [1 / p if p > 0 else math.inf for p in parts]
        fields = _FIELDS * self.field
        return design.Problem.from_variables(
            self.variables, operands, Scene.grid(fields, distances, self.waves), _ORDER
        )

    @functools.cached_property
    def rates(self) -> Array:
        """Adam's rate of each variable: at the spoilt lens it changes the spots by as much as all
        others, `train.optics_rate`, root mean square over rays, fields and depths."""
        tried = quick(self.spots)
        search = take_step(tried, init_problem(tried, self.spoilt))
        rows = search.residuals.size - search.evaluation.constraints.size
        views = len(self.spots.fields) * len(self.spots.distances)
        slopes = jnp.sqrt(jnp.sum(search.jacobian[:rows] ** 2, axis=0) / views)
        slopes = jnp.maximum(slopes, 1e-3 * jnp.max(slopes))
        return 1e-3 * self.config.train.optics_rate / slopes

    def _model(self) -> drt_jax.Sampling:
        """The model of kernels, chosen for the spoilt lens. ConfigError for kernels that are too
        small for its blur, and for fields of which no light arrives."""
        lens, size = self.variables.lens_of(self.spoilt), self.pixels[1]
        fields = np.array([[1e-4, 1e-4], [0.5, 0.5], [0.0, 1.0]]) * self.field
        given = lens, Scene.grid(fields, sorted(set(self.depths)), self.waves), *self.pixels
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "size: ")  # light beside kernels is judged below
            try:
                tolerance = self.config.camera.tolerance
                model = drt_jax.converge(drt_jax.psf, *given, "rays", tolerance)
            except ValueError as error:
                raise ConfigError(f"field_deg: {error}") from error
            worst = float(np.max(drt_jax.psf(*given, sampling=model).outside))
        lost = f"{100 * worst:.0f} % of the light of the spoilt lens falls beside a kernel"
        remedy = "give a larger one, larger pixels, or spoil the lens less"
        _common.require(worst <= _LOST, f"camera.kernel: {lost} of {size} pixels: {remedy}")
        return model

    def lens_of(self, vector: Array, deviations: Array | None = None) -> Lens:
        """The lens of a vector, as designed or with deviations."""
        if deviations is None:
            return self.variables.lens_of(vector)
        lens = self._whole.lens_of(vector)
        built = dataclasses.replace(self.built, lens=lens).lens_of(deviations)
        if not self.config.refocus:
            return built
        focus = [
            drt_jax.first_order(one, jnp.inf, self.waves[1]).back_focal_distance[0]
            for one in (lens, built)
        ]
        return dataclasses.replace(built, sensor=built.sensor + focus[1] - focus[0])

    def _psfs(self, optics: Any, seen: ObjectPoints, waves: Any, model: Any) -> drt_jax.results.Psf:
        lens = self.lens_of(optics["lens"], seen.deviations)
        scene = Scene.radians(seen.fields, seen.distances, waves)
        return drt_jax.psf(lens, scene, *self.pixels, sampling=model)

    def points(self, optics: Any, seen: ObjectPoints) -> tuple[Array, Array]:
        """Kernels and light of points, by rays."""
        found = self._psfs(optics, seen, self.waves, self.model)
        return found.kernel, found.solid_angle / self._axis[None]

    def judged_points(self, optics: Any, seen: ObjectPoints) -> tuple[Array, Array]:
        """Kernels and light of points, by waves of several wavelengths a channel."""
        judge = self.config.judge
        off = np.linspace(-0.5, 0.5, judge.waves) if judge.waves > 1 else np.zeros(1)
        waves = (self.waves[:, None] + judge.width_um * off).ravel()
        model = dataclasses.replace(self.model, kind="waves", cells=judge.cells)
        found = self._psfs(optics, seen, waves, model)
        shape = len(seen.fields), 3, judge.waves
        light = found.solid_angle.reshape(shape)
        kernel = found.kernel.reshape(*shape, *found.kernel.shape[2:])
        mean = jnp.sum(light[..., None, None] * kernel, axis=2)
        total = jnp.sum(light, axis=2)
        part = jnp.where(total > 0, total, 1)[..., None, None]
        return mean / part, total / judge.waves / self._axis[None]

    @functools.cached_property
    def judged(self) -> ObjectPoints:
        """The points of the judge: rings of equal area at all depths."""
        judge = self.config.judge
        ring = (np.arange(judge.rings) + 0.5) / judge.rings
        angle = _TURN * np.arange(judge.rings)
        tangents = np.tan(self.field) * np.sqrt(ring)[:, None]
        tangents = tangents * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        near, far = (1 / d for d in self.depths)
        vergences = near + (far - near) * (np.arange(judge.depths) + 0.5) / judge.depths
        distances = np.array([1 / v if v > 0 else math.inf for v in vergences])
        fields = np.tile(np.arctan(tangents), (judge.depths, 1))
        return ObjectPoints(jnp.asarray(fields), jnp.asarray(distances.repeat(judge.rings)))

    def step(self, arm: Arm) -> tuple[Callable, Callable]:
        """(init, step) of an arm; arms that differ in numbers alone share a program."""
        kind = arm.moves == "nothing", arm.steps, arm.frozen, arm.as_built
        if kind not in self._steps:
            self._steps[kind] = self._step(*kind)
        return self._steps[kind]

    def _step(
        self, stays: bool, steps: str, frozen: bool, as_built: bool
    ) -> tuple[Callable, Callable]:
        """(init, step); stays: True for a lens that stays, the others as in `Arm`."""
        setting, mesh = self.config.train, self.mesh
        rates: dict[str, Any] = {"network": setting.network_rate, "optics": 0.0}
        if steps == "damped":
            rates["optics"] = setting.damped_rate
        elif steps == "rays":
            size = design.cosine(1e-3 * setting.rays_um, setting.batches)
            rates["optics"] = design.RaySteps(self.spots, self.limits, size)
        elif not stays:
            rates["optics"] = {"lens": self.rates, "moves": 0.0}

        # Neither derivatives nor limits of a lens or a network that stays.
        def points(optics: Any, seen: ObjectPoints) -> tuple[Array, Array]:
            return self.points(jax.lax.stop_gradient(optics) if stays else optics, seen)

        def restored(weights: Any, image: Array) -> Array:
            return self.restore(jax.lax.stop_gradient(weights) if frozen else weights, image)

        def draw(key: Array) -> ObjectPoints:
            seen = draw_points(key, setting.points, self.field, self.depths)
            if not as_built:
                return seen
            table = jnp.asarray(design.draw_perturbations(self.built, _BUILDS, SEED))
            own = jax.random.randint(jax.random.fold_in(key, 1), (), 0, _BUILDS)
            return seen._replace(deviations=table[own])

        def hold(before: Any, after: Any) -> Any:
            if stays:
                return before
            vector = jnp.where(before.get("moves", True), after["lens"], before["lens"])
            return before | {"lens": design.within_limits(self.limits, before["lens"], vector)}

        imager = FieldImager(points, shared(restored, mesh, 1), shared(learn.convolve_each, mesh))
        make = make_damped_step if steps == "damped" else make_field_step
        return make(imager, rates, draw, 0, hold)

    def start(self, arm: Arm, seed: int, vector: Array, weights: Any) -> dict[str, Any]:
        """The parameters of an arm at the start, from the vector of its lens and, for a frozen
        network, its weights."""
        optics = {"lens": vector}
        if arm.steps == "adam":
            moves = [arm.moves != "sensor" or name == "sensor" for name in self.variables.names]
            optics["moves"] = jnp.asarray(np.array(moves, float))
        network = weights if arm.frozen else self.init(jax.random.key(seed))
        return {"optics": optics, "network": network}

    def spot_um(self, vector: Array) -> float:
        """RMS radius of the spots of all fields and depths, um."""
        views = len(self.spots.fields) * len(self.spots.distances)
        return 1e3 * math.sqrt(float(self.spots.merit(vector)) / views)
