"""What the arms of a joint design share: lens, camera, image model of the evaluation, steps."""

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
from drt_jax.devices import shared
from drt_jax.learn.data import Patches
from drt_jax.learn.field import FieldImager, ObjectPoints, draw_points, make_field_step
from drt_jax.rays.solve import solve_aimed

from . import _common
from ._sharing import mesh_of
from .runs.config import ConfigError

# Fields of least squares: rings of equal area, and the edge with a small weight, so that limits
# hold there; depths, and the order of the pupil rule.
_RINGS, _EDGE, _DEPTHS, _ORDER = 4, 0.05, 5, 6
# Largest side of the spectra behind filters, pixels; most Jacobians of least squares on their
# error.
_SIDE, _JACOBIANS = 64, 60
# Largest fraction of light outside of a kernel for the spoilt lens.
_LOST = 0.2
# Number of lenses as built from which training draws, and their seed; the evaluation uses the next
# seed. Number of lenses as built for least squares. Order of the pupil rule for these and for the
# metric of ray steps.
_BUILDS, SEED = 4096, 1
_FEW, _COARSE = 48, 4
# Golden angle, radians.
_TURN = math.pi * (3 - math.sqrt(5))


class Arm(NamedTuple):
    """One way to design lens and network.

    title: its name in tables and figures.
    begins: lens at the start, see `Setup.finished`.
    moves: part of the lens that is trained: "all" variables, the "sensor", or "nothing".
    steps: optimiser of the lens: "adam", "cosine" (Adam, with rates that fall as a cosine), or
        "rays" (`design.RaySteps`).
    frozen: True to keep the network that the arm `spots` has trained.
    as_built: True for a lens with errors of its own in each step.
    longer: factor of the number of steps.
    """

    title: str
    begins: str
    moves: str = "all"
    steps: str = "adam"
    frozen: bool = False
    as_built: bool = False
    longer: int = 1


ARMS = {
    "focus": Arm("(a) focus and network", "spoilt", "sensor"),
    "spots": Arm("(b) least squares on spots, then network", "spots", "nothing"),
    "longer": Arm("(b) with twice the steps", "spots", "nothing", longer=2),
    "stopped": Arm("(b) with its best stop", "stopped", "nothing"),
    "freed": Arm("(b) with its best stop and all variables", "freed", "nothing"),
    "mtf": Arm("(c) least squares on MTF, then network", "mtf", "nothing"),
    "joint": Arm("(d) jointly from the spoilt lens, Adam", "spoilt"),
    "rays": Arm("(d) with steps of rays", "spoilt", steps="rays"),
    "joint_from_spots": Arm("(e) jointly from (b), Adam", "spots"),
    "cosine_from_spots": Arm("(e) with Adam, rates as a cosine", "spots", steps="cosine"),
    "rays_from_spots": Arm("(e) with steps of rays", "spots", steps="rays"),
    "rays_from_mtf": Arm("(e) from (c), with steps of rays", "mtf", steps="rays"),
    "frozen": Arm("(f) lens of (b) through its frozen network", "spots", frozen=True),
    "filter": Arm("(g) least squares on the filter's error, then network", "filter", "nothing"),
    "rays_from_filter": Arm("(h) jointly from (g), steps of rays", "filter", steps="rays"),
    "built_network": Arm("(b) with lenses as built", "spots", "nothing", as_built=True),
    "built_spots": Arm(
        "(i) least squares on spots of lenses as built, then network", "built", "nothing",
        as_built=True
    ),
    "tolerant": Arm(
        "(e) with steps of rays and lenses as built", "spots", steps="rays", as_built=True
    ),
    "tolerant_from_built": Arm(
        "(j) jointly from (i), steps of rays and lenses as built", "built", steps="rays",
        as_built=True
    ),
}  # fmt: skip
# For each optimised lens the lens that its least squares start from.
_BEFORE = {"spots": "spoilt", "mtf": "spots", "built": "spots", "stopped": "spots"}
_BEFORE |= {"freed": "stopped"}


class Setup:
    """What all arms of a run share.

    variables: of the lens, with open apertures.
    spots: problem of spots.
    limits: problem whose limits hold in training.
    spoilt: (N,), vector of the spoilt lens.
    patches: training and test patches.
    pixels: side of a pixel, mm, and of a kernel, pixels.
    noise: standard deviation of read noise, and of shot noise if there is any.
    mesh: devices that share a batch; None for one.
    """

    def __init__(self, config: Any, patches: Patches) -> None:
        self.config, self.patches = config, patches
        self._steps: dict[tuple, tuple[Callable, Callable]] = {}
        lens = design.open_apertures(drt_jax.load_lens(config.lens))
        if config.model_glass:
            try:
                lens = drt_jax.with_model_glass(lens, config.model_glass)
            except ValueError as error:
                raise ConfigError(f"model_glass: {error}") from error
        self.noise = (config.noise, config.shot)[: 1 + bool(config.shot)]
        self.waves = np.array(config.wavelengths_um)
        self.pixels = 1e-3 * config.camera.pixel_um, config.camera.kernel
        self.field = math.radians(config.field_deg)
        self.depths = tuple(1e3 * d for d in config.depth_m)
        self.variables = self._variables(lens, free=True)
        self.spots = self._problem(self.variables, "spot")
        # Edges and thicknesses ask for rays of the rim alone, and are least in the middle or at the
        # edge of the field.
        of_rays = any("fields" in design.OPERANDS[o.kind].names for o in config.limits)
        few = {} if of_rays else {"order": 2, "ends": True}
        self.limits = self._problem(self.variables, **few) if config.limits else self.spots
        self._metric = self._problem(self.variables, "spot", order=_COARSE)
        spoil = config.spoil
        errors = spoil.per_cent, spoil.off_mm, spoil.seed
        vector = design.as_built_starts(self.variables, 1, *errors)[0]
        self.spoilt = jnp.clip(vector, self.variables.low, self.variables.high)
        self._finished = {"spoilt": self.spoilt}
        self._begin, self.restore = learn.red_net(**dataclasses.asdict(config.network))
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
        if config.taps:
            self._power = learn.power_of(patches.train, min(_SIDE, patches.train.shape[1]))
            options = *self.pixels, self.model.kind, self.model.cells
            kernels = lambda lens, rays: design.psf(lens, rays, *options)  # noqa: E731
            error = design.filter_error(kernels, self._axis, np.array(self.noise), self._power)
            self.filtered = self._problem(self.variables, design.Operand(error))
            taps = jnp.zeros((config.taps, config.taps, 3, 3), jnp.float32)
            self._begin, self.restore = learn.filtered((self._begin, self.restore), taps)
        if config.tolerances:
            radius = self.spots.beam_radius(lens)
            self.built = design.PerturbedLens.from_lens(lens, radius, config.tolerances)

    def _variables(
        self, lens: Lens, held: tuple[str, ...] = (), stop: float = 1.0, free: bool = False
    ) -> design.Variables:
        """Variables of a lens but for those of the kinds `held`. stop: factor of the diameter of
        the entrance pupil, where it is solved for. free: True for the stop as a variable, where
        `stops` says so."""
        config, solves = self.config, []
        vary = [v for v in config.variables if v.kind not in held]
        free = free and bool(config.stops)
        for solve in config.solves:
            waves = (config.wavelengths_um[1],)
            own = dataclasses.replace(solve, distance=self.depths[1], wavelengths=waves)
            is_pupil = own.kind == "entrance_pupil"
            if not (free and is_pupil):
                solves.append(own.with_value(own.value * stop) if is_pupil else own)
        if free:
            own = float(lens.semi_diameter[lens.stop])
            vary.append(design.Vary("semi_diameter", (lens.stop,), (), 0.05 * own, 2 * own))
        return design.Variables.from_lens(lens, vary, config.ties, solves)

    def _problem(
        self, variables: design.Variables, *operands: Any, order: int = _ORDER, ends: bool = False
    ) -> design.Problem:
        """A problem of operands and limits over field and depth. ends: True for the middle and the
        edge of the field alone."""
        near, far = (1 / d for d in self.depths)
        parts = np.unique(np.linspace(near, far, 1 if near == far else _DEPTHS))
        distances = [1 / p if p > 0 else math.inf for p in parts]
        rings = np.append(np.sqrt((np.arange(_RINGS) + 0.5) / _RINGS), 1.0)
        rings, weights = ([0.0, 1.0], None) if ends else (rings, [1.0] * _RINGS + [_EDGE])
        fields = np.arctan(np.tan(self.field) * np.asarray(rings))
        scene = Scene.grid(fields, distances, self.waves, field_weights=weights)
        both = (*operands, *self.config.limits)
        return design.Problem.from_variables(variables, both, scene, order)

    def finished(self, name: str, once: Callable[[str, Callable[[], list]], list]) -> Array:
        """The vector of a lens at the start of an arm: "spoilt", or a result of least squares: on
        "spots", on "mtf", on spots of lenses as "built", on spots with the best stop ("stopped":
        the stop with the smallest error of the filter), the same with all variables ("freed"), and
        on the error of the "filter".
        once: function that keeps a result, see `Run.once`."""
        if name not in self._finished:
            best = "freed" if self.config.stops else "spots"
            before = self.finished(_BEFORE.get(name, best), once)

            def finish() -> list[float]:
                print(f"least squares: {name}", flush=True)
                return self._finish(name, self.variables.lens_of(before)).tolist()

            self._finished[name] = jnp.asarray(once(f"finish {name}", finish))
        return self._finished[name]

    def _finish(self, name: str, lens: Lens) -> Array:
        """The vector of a lens after least squares, see `finished`."""
        held = () if name == "freed" else self.config.held
        if name == "filter":
            return self._best(self.filtered, lens, _JACOBIANS)
        if name in ("spots", "mtf", "built"):
            aims: list[Any] = ["spot"]
            if name == "mtf":
                aims = [design.Operand("mtf", target=1.0, at=self.config.mtf_at)]
            if name == "built":
                some = design.draw_perturbations(self.built, _FEW, SEED + 2)
                spots = design.spots_as_built(self.built, some, self._refocused, _COARSE)
                aims = [design.Operand(spots)]
            return self._best(self._problem(self._variables(lens, held), *aims), lens)
        found = [self.stopped(lens, held, stop) for stop in self.config.stops]
        reached = [self.filter_db(vector) for vector in found]
        for stop, db in zip(self.config.stops, reached):
            print(f"stop {stop:g}: {db:.2f} dB behind the filter")
        return found[int(np.argmax(reached))]

    def _best(self, problem: design.Problem, lens: Lens, steps: int = 100) -> Array:
        """The vector of a lens after least squares on a problem."""
        found = design.optimise(problem, problem.variables.vector(lens), steps)
        return self.variables.vector(problem.variables.lens_of(found.vector))

    def stopped(self, lens: Lens, held: tuple[str, ...], stop: float) -> Array:
        """The vector of a lens after least squares on spots, with a factor of its entrance
        pupil."""
        return self._best(self._problem(self._variables(lens, held, stop), "spot"), lens)

    @functools.cached_property
    def rates(self) -> Array:
        """Adam's rate of each variable: at the spoilt lens it changes the spots by as much as all
        others, `train.optics_rate`, root mean square over rays, fields and depths."""
        tried = self.spots.with_solver(solve_aimed)
        search = take_step(tried, init_problem(tried, self.spoilt))
        rows = search.residuals.size - search.evaluation.constraints.size
        views = len(tried.fields) * len(tried.distances)
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
            warnings.filterwarnings("ignore", "size: ")  # light outside is checked below
            try:
                model = drt_jax.converge(drt_jax.psf, *given, "rays", self.config.camera.tolerance)
                if self.config.camera.kind == "waves":
                    model = dataclasses.replace(model, kind="waves", cells=self.config.judge.cells)
            except ValueError as error:
                raise ConfigError(f"field_deg: {error}") from error
            worst = float(np.max(drt_jax.psf(*given, sampling=model).outside))
        lost = f"{100 * worst:.0f} % of the light of the spoilt lens falls outside a kernel"
        remedy = "give a larger one, larger pixels, or spoil the lens less"
        _common.require(worst <= _LOST, f"camera.kernel: {lost} of {size} pixels: {remedy}")
        return model

    def lens_of(self, vector: Array, deviations: Array | None = None) -> Lens:
        """The lens of a vector, as designed or with deviations."""
        if deviations is None:
            return self.variables.lens_of(vector)
        around = self.built.around(self.variables.lens_of(vector))
        return self._refocused(around.lens, around.lens_of(deviations))

    def _refocused(self, lens: Lens, built: Lens) -> Lens:
        """A lens as built, with the sensor at its own paraxial focus if that is asked for."""
        if not self.config.refocus:
            return built
        both = (drt_jax.first_order(one, jnp.inf, self.waves[1]) for one in (lens, built))
        ideal, own = (first.back_focal_distance[0] for first in both)
        return dataclasses.replace(built, sensor=built.sensor + own - ideal)

    def _psfs(self, optics: Any, seen: ObjectPoints, waves: Any, model: Any) -> drt_jax.results.Psf:
        lens = self.lens_of(optics["lens"], seen.deviations)
        scene = Scene.radians(seen.fields, seen.distances, waves)
        return drt_jax.psf(lens, scene, *self.pixels, sampling=model)

    def points(self, optics: Any, seen: ObjectPoints) -> tuple[Array, Array]:
        """Kernels and light of points, by the model of training."""
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
        """The object points of the evaluation: rings of equal area at all depths."""
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
        """(init, step). stays: True if the lens is not trained; the others as in `Arm`."""
        setting, mesh = self.config.train, self.mesh
        rates: dict[str, Any] = {"network": setting.network_rate, "optics": 0.0}
        if self.config.taps:
            rates["network"] = {"taps": setting.taps_rate, "network": setting.network_rate}
        if steps == "rays":
            size = design.cosine(1e-3 * setting.rays_um, setting.batches)
            rates["optics"] = design.RaySteps(self._metric, self.limits, size)
        elif not stays:
            falls = design.cosine(1.0, setting.batches, 1)
            lens: Any = self.rates
            if steps == "cosine":
                lens = lambda k: self.rates * falls(k.astype(self.rates.dtype))  # noqa: E731
            rates["optics"] = {"lens": lens, "moves": 0.0}

        # A lens or network that is not trained needs neither derivatives nor limits.
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
        return make_field_step(imager, rates, draw, 0, hold)

    def start(self, arm: Arm, seed: int, vector: Array, weights: Any) -> dict[str, Any]:
        """The parameters of an arm at the start, from the vector of its lens and, for a frozen
        network, its weights."""
        optics = {"lens": vector}
        if arm.steps != "rays":
            moves = [arm.moves != "sensor" or name == "sensor" for name in self.variables.names]
            optics["moves"] = jnp.asarray(np.array(moves, float))
        network = weights if arm.frozen else self._begin(jax.random.key(seed))
        if self.config.taps and not arm.frozen:
            network |= {"taps": self._taps(optics)}
        return {"optics": optics, "network": network}

    @functools.cached_property
    def _taps(self) -> Callable[[Any], Array]:
        """The taps of the best filter of a lens, over the field and all depths."""
        seen = draw_points(jax.random.key(0), _RINGS * _DEPTHS, self.field, self.depths)

        def taps(optics: Any) -> Array:
            kernels, light = self.points(optics, seen)
            grain = learn.noise_of(np.array(self.noise), light)
            found = learn.wiener(kernels, grain, self._power, self.config.taps)
            return found.taps.astype(jnp.float32)

        return jax.jit(taps)

    def filter_db(self, vector: Array) -> float | None:
        """PSNR after the best filter, from its closed-form error, dB; None without a filter."""
        error = float(self.filtered.merit(vector)) if self.config.taps else None
        return error and -10 * math.log10(error / len(self.waves))

    def spot_um(self, vector: Array) -> float:
        """RMS radius of the spots of all fields and depths, um."""
        views = len(self.spots.fields) * len(self.spots.distances)
        return 1e3 * math.sqrt(float(self.spots.merit(vector)) / views)
