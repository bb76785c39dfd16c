"""Our run time beside that of other programs doing the same work in the same run.

Calls alternate, and their medians are compared. Errors are relative: of the RMS spot radius sigma,
or the worse of sigma and its derivatives by curvatures and thicknesses, against an integral over a
sequential trace by Snell's law. Peers are an extra, `pip install -e '.[peers]'`; a missing one has
a row that says so. Writes results.json, whose `rows` hold `task`, `ours_s`, `peer`, `peer_s`,
`ratio` (theirs by ours), `ours_error`, `peer_error`, `compile_s`, `peak_mb` and `kernels` (ours);
beside them `counts`, what a training step traces, and `work`, how run time grows with rays,
surfaces and wavelengths. Draws run time against error, and the growth.
"""

import dataclasses
import functools
import math
import os
import pathlib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Lens, Status, pupil, show
from drt_jax.learn import network, train
from drt_jax.learn.adam import adam, apply_updates
from drt_jax.runs.folder import Run

from . import _command, _common, _peers, _work
from ._reference import Moments, reference
from ._work import Row, compiled, loaded, rows_of
from .snell import trace_snell

_COLUMNS = ("ours_s", "peer_s", "ratio", "ours_error", "peer_error", *_work.MEASURED)


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/benchmark.yaml.

    repeats: timed turns of each program (fewer where they take long). rays: those a peer samples
    a pupil with. bundle: rays of the task of many rays. batch, patch: of the network's step.
    tasks: the names of those to run, empty for all. growth: whether to measure how run time grows
    with the scene. seed: of the rays and images.
    """

    lens: str = "double_gauss"
    distance_m: float = 25.0
    field_deg: float = 10.0
    wavelengths_um: tuple[float, ...] = (0.6, 0.53, 0.48)
    repeats: int = 15
    rays: int = 256
    bundle: int = 262144
    batch: int = 16
    patch: int = 64
    tasks: tuple[str, ...] = ()
    growth: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        _common.require(self.repeats >= 1, "repeats: must be at least 1")
        _common.require(self.rays >= 7, "rays: must be at least 7, one hexapolar ring")
        _common.require(self.bundle >= 1, "bundle: must be at least 1")
        _common.require(0 < self.distance_m < math.inf, "distance_m: must be positive and finite")
        _common.require_known("tasks", self.tasks, TASKS)

    @property
    def scene(self) -> tuple[Lens, float, float]:
        """The lens, the field in radians, the distance in mm."""
        lens = drt_jax.load_lens(self.lens)
        return lens, math.radians(self.field_deg), 1e3 * self.distance_m

    @property
    def where(self) -> str:
        """The field in words."""
        return f"{self.field_deg:g} degrees"


def _parts(lens: Lens) -> dict:
    return {"curvature": lens.curvature, "thickness": lens.thickness, "sensor": lens.sensor}


def spot_error(truth: list[Moments], count: int, values: Any, slopes: Any = None) -> float:
    """The worst relative error of sigmas (W,), and of their derivatives (W, P) if they are given:
    norm over norm, the worse of those by `count` curvatures and by distances, those known."""
    exact = np.array([moments.sigma for moments in truth])
    worst = float(np.max(np.abs(np.asarray(values) / exact - 1)))
    if slopes is None:
        return worst
    exact = np.array([moments.gradient[0] for moments in truth])
    slopes = np.asarray(slopes, float)
    for group in (slice(0, count), slice(count, None)):
        known = np.isfinite(slopes[:, group])
        wrong = np.where(known, slopes[:, group] - exact[:, group], 0)
        size = np.linalg.norm(np.where(known, exact[:, group], 0))
        worst = max(worst, float(np.linalg.norm(wrong) / size))
    return worst


def spot_tasks(config: Config, axial: bool, gradient: bool) -> list[Row]:
    """sigma at all wavelengths, or it and its Jacobian, on axis or at the field."""
    lens, field, distance = config.scene
    field, waves = 0.0 if axial else field, jnp.asarray(config.wavelengths_um)
    # On axis in focus the digits of the gradient cost no more; see docs/performance.md.
    rule = drt_jax.converged_rule(lens, field, distance, waves, 1e-9 if axial else 1e-6)
    truth, count = reference(lens, field, distance, config.wavelengths_um), lens.count

    def sigma(parts):
        changed = dataclasses.replace(lens, **parts)
        covariance = drt_jax.psf_moments(changed, field, distance, waves, rule=rule)[1]
        return jnp.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])

    def jacobian(parts):
        values, back = jax.vjp(sigma, parts)
        return values, jax.vmap(lambda row: back(row)[0])(jnp.eye(waves.size))

    ours = compiled(jacobian if gradient else sigma, _parts(lens))
    if gradient:
        values, found = ours.call()
        distances = found["thickness"], found["sensor"][:, None]
        slopes = np.concatenate([found["curvature"][:, :count], *distances], axis=1)
        error = spot_error(truth, count, values, slopes)
    else:
        error = spot_error(truth, count, ours.call())
    numbers, peers = _peers.Lens(lens, field, distance, config.wavelengths_um), {}
    for name in ("optiland", "batoid"):
        try:
            value, slope, version = _peers.spot(name, numbers, config.rays)
        except _peers.Missing as missing:
            peers[name] = str(missing)
            continue
        call = slope if gradient else value
        found = call() if gradient else (call(),)
        peers[f"{name} {version}"] = (call, spot_error(truth, count, *found))
    where = "on axis" if axial else config.where
    task = f"sigma{' and Jacobian' if gradient else ''}, {where}"
    return rows_of(task, ours, error, peers, config.repeats)


def bundle_task(config: Config) -> list[Row]:
    """Skew rays through random points of the stop, one wavelength, to the sensor."""
    lens, field, distance = config.scene
    waves = jnp.asarray(config.wavelengths_um[:1])
    points = jnp.asarray(pupil.random_disc(config.bundle, config.seed)[0].T)

    def trace(points, lens=lens):
        rays = drt_jax.trace_rays(lens, field, distance, waves, points)
        return rays.points[0, :, -1, :2], rays.status[0]

    ours = compiled(trace, points)
    hits, status = ours.call()
    _common.require(bool(jnp.all(status == Status.OK)), "lens: rays of the bundle fail")
    rays = jax.jit(drt_jax.trace_rays)(lens, field, distance, waves, points)
    first, direction = rays.points[0, :, 0], rays.directions[0, :, 0]
    again, ok = jax.vmap(trace_snell, (None, None, 0, 0))(
        lens, waves[0], first[:1000], direction[:1000]
    )
    _common.require(bool(jnp.all(ok)), "lens: rays of the bundle fail")
    error = float(jnp.max(jnp.abs(again[:, -1, :2] - hits[:1000])))
    peers: dict[str, tuple | str] = {}
    try:
        numbers = _peers.Lens(lens, field, distance, config.wavelengths_um[:1])
        start, along = (np.asarray(a) for a in (first - 15 * direction, direction))
        call, version = _peers.batoid_rays(numbers, start, along)
        wrong = float(np.max(np.abs(call() - np.asarray(hits))))
        peers[f"batoid {version}, launched at our first hits"] = (call, wrong)
    except _peers.Missing as missing:
        peers["batoid"] = str(missing)
    task = f"{config.bundle} skew rays"
    rows = rows_of(task, ours, error, peers, config.repeats)
    devices = os.cpu_count() or 1
    shared = _work.spread_over_devices(config, devices)
    peer = {key: rows[0][key] for key in ("peer", "peer_s", "peer_error", "note", "ours_error")}
    peer["ratio"] = peer["peer_s"] and peer["peer_s"] / shared
    rows.append(_work.row(f"{task}, {devices} CPU devices", shared, **peer))
    square = compiled(jax.grad(lambda lens: jnp.mean(trace(points, lens)[0] ** 2)), lens)
    back = _common.medians([square.call], 3)[0]
    rows.append(_work.row(f"{task} and their gradient", back, **square.measured))
    for row in rows:
        row["ours_rays_per_s"] = config.bundle / row["ours_s"]
        if row["peak_mb"] is not None:
            row["bytes_per_ray"] = row["peak_mb"] * 2**20 / config.bundle
    return rows


def network_task(config: Config) -> list[Row]:
    """One Adam step of optics and network; the network alone; all before it, there and back."""
    rng = np.random.default_rng(config.seed)
    lens, _, distance = config.scene
    init, apply = network.red_net()
    weights = init(jax.random.key(config.seed))
    camera, rates = train.Camera(), {"optics": 1e-3, "network": 1e-3}
    depths = distance, distance
    values, blur = drt_jax.moments_model(lens, ("sensor",), 0.0, depths, config.wavelengths_um)
    side = config.patch + camera.kernel - 1
    scenes = rng.integers(0, 256, (config.batch, side, side, 3)).astype(np.uint8)
    imager = train.make_imager(blur, apply, camera)
    start, step = train.make_step(imager, rates, depths, config.seed)
    state = start({"optics": values, "network": weights})
    joint = loaded(step, state, scenes, np.float32(0.01), np.int32(0))
    shape = (config.batch, config.patch, config.patch, 3)
    images, truth = (jnp.asarray(rng.random(shape), jnp.float32) for _ in range(2))
    begin, update = adam(rates)

    def alone(parameters, moments, images, truth):
        def loss(parameters):
            return jnp.mean(jnp.abs(apply(parameters["network"], images) - truth))

        updates, moments = update(jax.grad(loss)(parameters), moments)
        return apply_updates(parameters, updates), moments

    parameters, options = {"network": weights}, {"compiler_options": train.compiler_options()}
    only = compiled(alone, parameters, begin(parameters), images, truth, **options)
    sensor = train.make_imager(blur, None, camera)

    def front(values, scenes, noise, key):
        def image(values):
            return sensor({"optics": values}, scenes, distance, noise, key)[1]

        value, back = jax.vjp(image, values)
        return value, back(truth)

    key = jax.random.key(config.seed)
    rest = compiled(front, values, jnp.asarray(scenes), np.float32(0.01), key, **options)
    peers: dict[str, tuple | str] = {}
    try:
        call, version = _peers.network_step(config.batch, config.patch, 1e-3)
        peers[f"torch {version}, network alone, channels last"] = (call, None)
    except _peers.Missing as missing:
        peers["torch"] = str(missing)
    peers["ours, network alone"] = (only.call, None)
    peers["ours, optics, noise and sensor layer alone"] = (rest.call, None)
    task = f"joint step with RED-Net, {config.batch} of {config.patch}x{config.patch}"
    return rows_of(task, joint, None, peers, min(config.repeats, 9))


def first_task(config: Config) -> list[Row]:
    """A new process: import, load a lens, trace, gradient; and the same once more, with the
    compiled programs kept in a folder."""
    lens, (_, field, distance) = config.lens, config.scene
    rows = []
    for angle, where in ((0.0, "on axis"), (field, config.where)):
        task = f"first sigma and gradient in a new process, {where}"
        anew, kept = _work.first_seconds(lens, angle, distance)
        rows += [_work.row(task, anew), _work.row(f"{task}, programs kept", kept)]
    return rows


TASKS = {
    "axial": lambda config: spot_tasks(config, True, False),
    "axial_jacobian": lambda config: spot_tasks(config, True, True),
    "field": lambda config: spot_tasks(config, False, False),
    "field_jacobian": lambda config: spot_tasks(config, False, True),
    "bundle": bundle_task,
    "network": network_task,
    "first": first_task,
}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Run the tasks one by one."""
    # Programs kept from another run would hide what compiling takes.
    jax.config.update("jax_enable_compilation_cache", False)
    rows: list[Row] = []
    with tqdm(config.tasks or TASKS, unit="task", dynamic_ncols=True) as bar:
        for name in bar:
            bar.set_description(name)
            found = TASKS[name](config)
            for k, row in enumerate(found):
                columns = {c: np.array([float(row[c])]) for c in _COLUMNS if row[c] is not None}
                run.log(name, k, columns)
            rows += found
    lens, field, distance = config.scene
    results = {"rows": rows, "counts": _work.counts(lens, distance, config.wavelengths_um)}
    if config.growth:
        results["work"] = _work.growth(lens, field, distance, 5)
    return results | {"seconds": run.seconds}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Every task beside its peers, and the rays of a training step."""

    def error(value: float | None) -> str:
        return "" if value is None else f"{value:.0e}"

    lines, before = [], None
    for row in results["rows"]:
        ours = (row["task"], _common.duration(row["ours_s"]), error(row["ours_error"]))
        ours += (_common.duration(row["compile_s"]),)
        peer = _common.duration(row["peer_s"]), error(row["peer_error"])
        ratio = row["ratio"] and f"{row['ratio']:.3g}"
        same, before = row["task"] == before, row["task"]
        lines.append((*(("",) * 4 if same else ours), row["note"] or row["peer"], *peer, ratio))
    header = "work", "drt_jax", "error", "to compile", "peer", "its time", "error", "ratio"
    counts = "what a training step trains", "solves for rays"
    return {
        "benchmark": _common.table(header, lines),
        "benchmark, counts": _common.table(counts, results["counts"].items()),
    }


def report(results: dict[str, Any], figures: pathlib.Path) -> str:
    """Draw run time against error, and how it grows."""
    if "work" in results:
        figure, axes = show.new(1, 1, 5.5, 4)
        show.growth(axes, results["work"])
        figure.savefig(figures / "work.png")
    spots = [row for row in results["rows"] if row["task"].startswith("sigma")]
    if spots:
        tasks = _common.grouped(spots, "task")
        across = min(2, len(tasks))
        figure, axes = show.new(-(-len(tasks) // across), across, 4.5, 3.2)
        for axis, ((task,), rows) in zip(np.ravel(axes), tasks.items()):
            marks = {"drt_jax": [(1e3 * rows[0]["ours_s"], rows[0]["ours_error"])]}
            peers = [row for row in rows if row["peer_s"]]
            marks |= {row["peer"]: [(1e3 * row["peer_s"], row["peer_error"])] for row in peers}
            show.programs(axis, marks, task)
        figure.savefig(figures / "peers.png")
    return "\n\n".join(tables(results).values())


main = functools.partial(_command.main, "benchmark", Config, _COLUMNS, run, report)

if __name__ == "__main__":
    main()
