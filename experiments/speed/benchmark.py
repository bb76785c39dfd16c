"""Run time of this and other programs for the same work in the same run.

Calls alternate, and their medians are compared. Spots are curves: each program is swept over its
own samplings, and also gets our nodes. Errors are relative, of the RMS spot radius sigma, or the
larger of those of sigma and of its derivatives by curvatures and thicknesses at fixed stop points.
The reference is an integral over a sequential trace by Snell's law. Optiland's derivatives keep the
launch of our rays fixed, and rays through the paraxial pupil differ from rays through the stop.
These derivatives are correct, but of other quantities; they differ by 0.2 and 3 %. Other programs
are an extra, `pip install -e '.[peers]'`; the row of a missing one names it.

Writes results.json:

- `curves`: `task`, `program`, `sampling`, `size` (rays per wavelength), `error`, `quartiles_s`,
  `repeats`; `missing`: the reasons why programs have no curve;
- `rows`: `task`, `ours_s`, `peer`, `peer_s`, `ratio` (theirs / ours), `ours_error`, `peer_error`,
  `compile_s`, `peak_mb` and `kernels` (ours);
- `profile`: `lens`, `field_deg`, `reference_error`, `program`, `error` (the smallest), `first_s`
  (preparation and first calls of all samplings), `quartiles_s` for each tolerance, and `why` there
  is none; `left_out`: lenses without a reference;
- `counts`: solves for rays in a training step;
- `work`: run time over numbers of rays, surfaces and wavelengths;
- `machines`: the machines on which it ran.

Draws run time over error, the profile, and the growth of run time.
"""

import dataclasses
import functools
import math
import os
import pathlib
import sys
from collections.abc import Callable
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Lens, Scene, Status, learn, pupil
from drt_jax.compilation import NETWORK, known_options
from drt_jax.learn import network, train

from . import _command, _common, _curves, _peers, _plots, _profile, _waves, _work
from ._common import not_empty, within
from ._reference import (
    Moments,
    changed,
    flatten,
    gradient_error,
    reference,
    relative_error,
    sigmas,
)
from ._work import Row, compiled, peer, rows_of
from .runs.folder import Run
from .snell import trace_snell


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/benchmark.yaml.

    repeats: number of timed turns of each program (fewer for long ones).
    rays: numbers of rays of the patterns of other programs.
    orders: orders of quadratures, ours and those of other programs.
    bundle: number of rays of the task with many rays.
    batch, patch: number of patches in a step of the network, and their side, pixels.
    disturbed: number of disturbed lenses.
    tasks: names of the tasks to run; empty for all.
    growth: True to measure how run time grows with the scene.
    """

    lens: str = "double_gauss"
    distance_m: Annotated[float, within(1e-3, 1e9)] = 25.0
    field_deg: Annotated[float, within(0, 89.9)] = 10.0
    wavelengths_um: Annotated[tuple[float, ...], within(1e-4, 1e6)] = (0.6, 0.53, 0.48)
    repeats: Annotated[int, within(1, 1e4)] = 15
    rays: Annotated[tuple[int, ...], not_empty, within(7, 1e6)] = (64, 512, 4096)
    orders: Annotated[tuple[int, ...], not_empty, within(1, 40)] = (1, 2, 3, 4, 6)
    bundle: Annotated[int, within(1, 1e8)] = 262144
    batch: Annotated[int, within(1, 4096)] = 16
    patch: Annotated[int, within(7, 4096)] = 64
    tasks: tuple[str, ...] = ()
    growth: bool = True
    disturbed: Annotated[int, within(1, 1e4)] = 32
    waves: _waves.Waves = _waves.Waves()
    profile: _profile.Profile = _profile.Profile()
    seed: int = 0

    def __post_init__(self) -> None:
        _common.require_known("tasks", self.tasks, TASKS)

    @property
    def scene(self) -> tuple[Lens, float, float]:
        """Lens, field (radians) and distance (mm)."""
        return drt_jax.load_lens(self.lens), math.radians(self.field_deg), 1e3 * self.distance_m

    @property
    def bundle_trace(self) -> tuple[Callable, Array]:
        """Function that traces many rays at one wavelength, and their stop points."""
        points = jnp.asarray(pupil.random_disc(self.bundle, self.seed)[0])
        waves = jnp.asarray(self.wavelengths_um[:1])
        return functools.partial(_work.hits, *self.scene, waves), points


def spot_error(truth: Moments, count: int, values: Any, slopes: Any = None) -> float:
    """Largest relative error of sigma (W,) and, if given, of its finite derivatives (W, P), see
    `gradient_error`."""
    worst = relative_error(truth, values)
    if slopes is None:
        return worst
    slopes = np.asarray(slopes, float)
    wrong = gradient_error(truth.gradient[:, 0], slopes, count, np.isfinite(slopes))
    return max(worst, wrong)


def swept(
    config: Config, task: str, lens: Lens, variants: Array, ours: Callable, theirs: Callable,
    error: Callable,
) -> dict[str, Any]:  # fmt: skip
    """Curves of sigma at the first wavelength, and the reasons why programs have none.

    variants: (V, P), numbers of the lens for other programs, see `_peers.Lens`.
    ours: function that compiles a call from a function of numbers (P,) that returns sigma.
    theirs: function that makes the call of another program, see `_curves.of_spots`.
    error: function that returns the error of the result of a call.
    """
    _, field, distance = config.scene
    waves, tries = config.wavelengths_um[:1], []
    scene = Scene.point(field, distance, waves)
    for order in config.orders:
        rule = drt_jax.Gauss(order, "bilateral" if field else "rotational")

        def sigma(values: Array) -> Array:
            return sigmas(drt_jax.psf_moments(changed(lens, values), scene, rule))

        call = ours(sigma)
        rays = pupil.pupil_points(lens, scene, rule)[1].shape[-1]
        tries.append(_curves.Try(_curves.OURS, _curves.NODES, rays, call, error(call())))
    numbers = _peers.Lens(lens, field, distance, waves, variants)
    samplings = _curves.samplings(lens, scene, config.rays, config.orders, variants)
    ways = _curves.of_spots(numbers, samplings, theirs)
    return _curves.rows_of(task, tries, ways, error, config.repeats)


def spot_curves(config: Config, gradient: bool) -> dict[str, Any]:
    """Curves of sigma, or of it and its Jacobian."""
    lens, *given = config.scene
    truth = reference(lens, *given, config.wavelengths_um[:1])
    wrong = functools.partial(spot_error, truth, lens.count)
    lens = dataclasses.replace(lens, curved=(lens.stop,))  # derivatives by every curvature

    def error(found: Any) -> float:
        return wrong(*found) if gradient else wrong(found)

    def ours(sigma: Callable) -> Callable:
        def jacobian(values: Array) -> tuple[Array, Array]:
            found, back = jax.vjp(sigma, values)
            return found, jax.vmap(lambda row: back(row)[0])(jnp.eye(found.size))

        return compiled(jacobian if gradient else sigma, flatten(lens))[0]

    def theirs(spots: _peers.Spots, *given: Any) -> Callable:
        return (spots.gradient if gradient else spots.sigma)(*given)

    task = "sigma and its Jacobian" if gradient else "sigma"
    return swept(config, task, lens, _peers.shifted(lens), ours, theirs, error)


def disturbed_curves(config: Config) -> dict[str, Any]:
    """Curves of sigma of many disturbed lenses, (V, 1). The standard deviations are 0.1 % for
    curvatures and 0.02 mm for distances. The lenses of other programs are made before the time is
    measured."""
    lens, *given = config.scene
    values = flatten(lens)
    sizes = jnp.concatenate([1e-3 * values[: lens.count], jnp.full(lens.count, 0.02)])
    draw = np.random.default_rng(config.seed).normal(size=(config.disturbed, len(values)))
    values = values + sizes * draw
    given = *given, config.wavelengths_um[:1]
    truth = [reference(changed(lens, row), *given, slopes=False) for row in values]

    def error(found: Any) -> float:
        return max(map(relative_error, truth, np.asarray(found)))

    def ours(sigma: Callable) -> Callable:
        return compiled(jax.vmap(sigma), values)[0]

    few = dataclasses.replace(config, rays=config.rays[:2])
    task = f"sigma of {config.disturbed} disturbed lenses"
    return swept(few, task, lens, values, ours, _peers.of_all, error)


def waves_curves(config: Config, of: Callable) -> dict[str, Any]:
    """Curves of `_waves.kernels` or `_waves.contrasts` at the first wavelength."""
    lens, field, _ = config.scene
    at = _waves.focused(lens, field, config.wavelengths_um[0], config.waves)
    return of(at, config.waves, config.repeats)


def bundle_task(config: Config) -> list[Row]:
    """Skew rays through random points of the stop, one wavelength, to the sensor.

    The error is the largest difference from a sequential trace of the first 1000 rays. batoid
    traces the same rays from a plane in front of their first hits. Further rows are for several CPU
    devices, for float32, and for the gradient.
    """
    lens, field, distance = config.scene
    waves = jnp.asarray(config.wavelengths_um[:1])
    trace, points = config.bundle_trace
    ours = compiled(trace, points)
    spot, status = (found[0] for found in ours[0]())
    _common.require(bool(jnp.all(status == Status.OK)), "lens: rays of the bundle fail")
    rays = jax.jit(drt_jax.trace_rays)(lens, Scene.point(field, distance, waves), points)
    first, direction = rays.points[0, :, 0], rays.directions[0, :, 0]
    snell = jax.vmap(trace_snell, (None, None, 0, 0))
    again, ok = snell(lens, waves[0], first[:1000], direction[:1000])
    _common.require(bool(jnp.all(ok)), "lens: rays of the bundle fail")
    error = float(jnp.max(jnp.abs(again[:, -1, :2] - spot[:1000])))

    def batoid():
        numbers = _peers.Lens(lens, field, distance, config.wavelengths_um[:1])
        start, along = (np.asarray(a) for a in (first - 15 * direction, direction))
        call = _peers.batoid_rays(numbers, start, along)
        return call, float(np.max(np.abs(call() - np.asarray(spot))))

    peers = peer("batoid", batoid, ", launched at our first hits")
    task = f"{config.bundle} skew rays"
    rows = rows_of(task, ours, error, peers, config.repeats)
    if jax.default_backend() == "cpu":
        devices = os.cpu_count() or 1
        (shared,) = _work.in_a_new_process(_work.SPREAD.format(config=config, devices=devices), {})
        same = {key: rows[0][key] for key in ("peer", "peer_s", "peer_error", "note", "ours_error")}
        same["ratio"] = same["peer_s"] and same["peer_s"] / shared
        rows.append(_work.row(f"{task}, {devices} CPU devices", shared, **same))

    single, *rest = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (lens, waves, points))
    call, measured = compiled(functools.partial(_work.hits, single, field, distance), *rest)
    off = float(jnp.max(jnp.abs(call()[0] - spot)))
    seconds = _common.medians([call], config.repeats)[0]
    rows.append(_work.row(f"{task}, float32", seconds, ours_error=off, **measured))

    def square(lens):
        return jnp.mean(_work.hits(lens, field, distance, waves, points)[0] ** 2)

    call, measured = compiled(jax.grad(square), lens)
    back = _common.medians([call], 3)[0]
    rows.append(_work.row(f"{task} and their gradient", back, **measured))
    for row in rows:
        row["ours_rays_per_s"] = config.bundle / row["ours_s"]
        for who in ("ours", "peer"):  # surfaces, the stop among them, and the sensor
            seconds = row[f"{who}_s"]
            row[f"{who}_surfaces_per_s"] = seconds and config.bundle * (lens.count + 1) / seconds
        if row["peak_mb"] is not None:
            row["bytes_per_ray"] = row["peak_mb"] * 2**20 / config.bundle
    return rows


def network_task(config: Config) -> list[Row]:
    """One Adam step of optics and network; one of the network alone; and the forward and backward
    pass of optics and sensor layer alone."""
    rng = np.random.default_rng(config.seed)
    lens, _, distance = config.scene
    init, apply = network.red_net()
    weights = init(jax.random.key(config.seed))
    camera, rates = train.Camera(), {"optics": 1e-3, "network": 1e-3}
    depths = distance, distance
    scene = Scene.point(0.0, depths, config.wavelengths_um)
    values, blur = learn.moments_model(lens, ("sensor",), scene)
    side = config.patch + camera.kernel - 1
    scenes = rng.integers(0, 256, (config.batch, side, side, 3)).astype(np.uint8)

    def adam_step(imager, parameters):
        start, step = train.make_step(imager, rates, depths, config.seed)
        return compiled(step, start(parameters), scenes, np.float32(0.01), np.int32(0))

    imager = train.make_imager(blur, apply, camera)
    joint = adam_step(imager, {"optics": values, "network": weights})
    shape = (config.batch, config.patch, config.patch, 3)
    images, truth = (jnp.asarray(rng.random(shape), jnp.float32) for _ in range(2))

    def network_alone(parameters, *_, last):
        return truth, images, last(apply, parameters["network"], images, truth), jnp.zeros(3)

    only, _ = adam_step(network_alone, {"optics": {}, "network": weights})
    sensor = train.make_imager(blur, None, camera)

    def front(values, scenes, noise, key):
        def image(values):
            return sensor({"optics": values}, scenes, distance, noise, key)[1]

        value, back = jax.vjp(image, values)
        return value, back(truth)

    key = jax.random.key(config.seed)
    front = jax.jit(front, compiler_options=known_options(NETWORK))
    rest, _ = compiled(front, values, jnp.asarray(scenes), np.float32(0.01), key)

    def torch():
        return _peers.network_step(config.batch, config.patch, 1e-3), None

    peers = peer("torch", torch, ", network alone, channels last")
    peers["ours, network alone"] = (only, None)
    peers["ours, optics, noise and sensor layer alone"] = (rest, None)
    task = f"joint step with RED-Net, {config.batch} of {config.patch}x{config.patch}"
    return rows_of(task, joint, None, peers, min(config.repeats, 9))


def first_task(config: Config) -> list[Row]:
    """A new process that imports the package, loads a lens, traces it and computes a gradient;
    without and with saved programs."""
    _, field, distance = config.scene
    rows = []
    for angle, where in ((0.0, "on axis"), (field, f"{config.field_deg:g} degrees")):
        task = f"first sigma and gradient in a new process, {where}"
        seconds = _work.first_gradients(config.lens, angle, distance)[:, 1].tolist()
        for name, own in zip((task, f"{task}, programs kept"), seconds):
            rows.append(_work.row(name, own))
    return rows


# Tasks, as functions of `Config`; "profile" has a job for each lens.
TASKS = {
    "spot": lambda config: spot_curves(config, False),
    "gradient": lambda config: spot_curves(config, True),
    "disturbed": disturbed_curves,
    "kernel": lambda config: waves_curves(config, _waves.kernels),
    "contrast": lambda config: waves_curves(config, _waves.contrasts),
    "bundle": bundle_task,
    "network": network_task,
    "first": first_task,
    "profile": None,
}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Runs the tasks one by one."""
    # Programs saved by another run would hide the time of compilation.
    jax.config.update("jax_enable_compilation_cache", False)
    names = config.tasks or tuple(TASKS)
    jobs = {name: functools.partial(job, config) for name in names if (job := TASKS[name])}
    jobs |= _profile.jobs(config.profile) if "profile" in names else {}
    found = _common.measured(run, "job", jobs)
    results: dict[str, Any] = {"rows": [], "curves": [], "missing": {}}
    results |= {"profile": [], "left_out": []}
    for part in found:  # rows, or curves with what is missing
        for key, some in (part if isinstance(part, dict) else {"rows": part}).items():
            results[key] = results[key] | some if key == "missing" else results[key] + some
    lens, field, distance = config.scene
    results |= {"counts": _work.counts(lens, distance, config.wavelengths_um)}
    if config.growth:
        results["work"] = _work.growth(lens, field, distance, 5)
    return results | {"seconds": run.seconds}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of the tasks with peers, and of the solves of a training step."""

    def error(value: float | None) -> str:
        return "" if value is None else f"{value:.0e}"

    lines, before = [], None
    for row in results["rows"]:
        keys = "ours_s", "compile_s", "peer_s"
        seconds, compiling, theirs = (_common.duration(row[key]) for key in keys)
        ours = row["task"], seconds, error(row["ours_error"]), compiling
        peer = row["note"] or row["peer"], theirs, error(row["peer_error"])
        ratio = row["ratio"] and f"{row['ratio']:.3g}"
        lines.append((*(("",) * 4 if row["task"] == before else ours), *peer, ratio))
        before = row["task"]
    header = "work", "drt_jax", "error", "to compile", "peer", "its time", "error", "ratio"
    machine = [(_common.one_machine(results),)]
    rates = []
    for row in results["rows"]:
        if "ours_surfaces_per_s" in row:
            both = (row[f"{who}_surfaces_per_s"] for who in ("ours", "peer"))
            rates.append((row["task"], *(f"{rate / 1e6:.3g}" if rate else "" for rate in both)))
    found = {"benchmark, machine": _common.table(("machine of this run",), machine)}
    if results["curves"]:
        found["benchmark, curves"] = _curves.summary(results["curves"])
    if results["profile"]:
        found["benchmark, profile"] = _profile.summary(results["profile"])
        found["benchmark, unsolved"] = _profile.reasons(results["profile"])
    if results["left_out"]:
        found["benchmark, left out"] = _profile.not_compared(results["left_out"])
    if results["rows"]:
        columns = "work", "drt_jax, 1e6 rays x surfaces / s", "batoid"
        found["benchmark, rates"] = _common.table(columns, rates)
        found["benchmark"] = _common.table(header, lines)
        columns = "what a training step trains", "solves for rays"
        found["benchmark, counts"] = _common.table(columns, results["counts"].items())
    return found


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws run time against error, and its growth."""
    if "work" in results:
        with _plots.picture(figures / "work.png", 5.5, 4) as (ax,):
            _plots.growth(ax, results["work"])
    if results.get("curves"):
        tasks = _common.grouped(results["curves"], "task")
        with _plots.picture(figures / "peers.png", 6.5, 5.6, len(tasks)) as axes:
            for ax, ((task,), rows) in zip(axes, tasks.items()):
                _plots.programs(ax, _common.grouped(rows, "program", "sampling"), task)
    if results.get("profile"):
        with _plots.picture(figures / "profile.png", 4.3, 4.0, len(_profile.TOLERANCES), 3) as axes:
            for k, (ax, tolerance) in enumerate(zip(axes, _profile.TOLERANCES)):
                _plots.shares_solved(ax, _profile.ratios(results["profile"], k), tolerance)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
