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
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import Lens, Status
from drt_jax.learn import network
from drt_jax.show import plot
from drt_jax.pupil import rules as pupil
from drt_jax.learn import train
from drt_jax.learn.adam import adam, apply_updates
from drt_jax.runs.folder import Run

from . import _common, _peers, _work
from ._reference import reference

_COLUMNS = (
    "ours_s",
    "peer_s",
    "ratio",
    "ours_error",
    "peer_error",
    "compile_s",
    "peak_mb",
    "kernels",
)
_TURN = 0.05
_FIRST = """
import time; start = time.perf_counter()
import jax; jax.config.update("jax_enable_x64", True)
import drt_jax
lens = drt_jax.load_lens({lens!r})
sigma = lambda lens: drt_jax.psf_moments(lens, {field}, {distance}, [0.53])[1][0, 1, 1] ** 0.5
jax.block_until_ready(jax.value_and_grad(sigma)(lens))
print(time.perf_counter() - start)
"""


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/benchmark.yaml.

    repeats: timed calls of each program (fewer where they take long). rays: those a peer samples
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
        for name in self.tasks:
            known = ", ".join(TASKS)
            _common.require(name in TASKS, f"tasks: unknown {name!r}; known: {known}")


@dataclasses.dataclass(frozen=True)
class Ours:
    """A compiled program of ours: what it is called with no more, and what compiling took."""

    call: Callable
    compile_s: float
    peak_mb: float
    kernels: int


def compiled(function: Callable, *arguments, **options) -> Ours:
    """`function` compiled for its arguments, tracing included; the memory it will hold, and how many
    kernels it consists of (those in a loop once)."""
    return loaded(jax.jit(function, **options), *arguments)


def loaded(function: Callable, *arguments) -> Ours:
    """The same of a jitted function. Arguments that it donates, it is given as copies."""
    start = time.perf_counter()
    lowered = function.lower(*arguments)
    program = lowered.compile()
    seconds = time.perf_counter() - start
    memory = program.memory_analysis()
    held = memory.temp_size_in_bytes + memory.output_size_in_bytes
    text = program.as_text()
    kernels = len(re.findall(r" (?:fusion|dot|convolution|custom-call)\(", text))
    donated = [info.donated for info in jax.tree.leaves(lowered.args_info)]

    def call():
        leaves, structure = jax.tree.flatten(arguments)
        given = [jnp.array(a) if gone else a for a, gone in zip(leaves, donated)]
        return jax.block_until_ready(program(*jax.tree.unflatten(structure, given)))

    return Ours(call, seconds, held / 2**20, kernels)


def alternate(calls: list[Callable], repeats: int) -> list[float]:
    """Median seconds of each call, made in turns after one that does not count; those that take
    over a second are made three times.

    A turn lasts at least `_TURN` s and its first call does not count either: the threads of another
    program go on spinning for a while, and would be counted against this one.
    """
    times: list[list[float]] = [[] for _ in calls]
    for call in calls:
        call()
    for k in range(repeats):
        for call, taken in zip(calls, times):
            if k >= 3 and np.median(taken) > 1:
                continue
            call()
            began = time.perf_counter()
            while (start := time.perf_counter()) - began < _TURN:
                call()
                taken.append(time.perf_counter() - start)
    return [float(np.median(taken)) for taken in times]


def rows_of(
    task: str, ours: Ours, error: float, peers: dict[str, tuple], repeats: int
) -> list[dict]:
    """Rows of one task: `peers` by name, (call, error) or why there is none."""
    ready = {name: peer for name, peer in peers.items() if not isinstance(peer, str)}
    seconds, *others = alternate([ours.call, *(call for call, _ in ready.values())], repeats)
    base = {"task": task, "ours_s": seconds, "ours_error": error}
    base |= {"compile_s": ours.compile_s, "peak_mb": ours.peak_mb, "kernels": ours.kernels}
    found = dict(zip(ready, others))
    rows = []
    for name, peer in peers.items():
        row = {**base, "peer": name, "peer_s": None, "ratio": None, "peer_error": None, "note": ""}
        if name in found:
            row |= {"peer_s": found[name], "ratio": found[name] / seconds, "peer_error": peer[1]}
        else:
            row["note"] = peer
        rows.append(row)
    return rows or [
        {**base, "peer": "", "peer_s": None, "ratio": None, "peer_error": None, "note": ""}
    ]


def _parts(lens: Lens) -> dict:
    return {"curvature": lens.curvature, "thickness": lens.thickness, "sensor": lens.sensor}


def sigma_of(lens: Lens, field: float, distance: float, order) -> Callable:
    """sigma (W,) in mm of changed `parts` of the lens, at wavelengths (W,)."""

    def sigma(parts, wavelengths):
        changed = dataclasses.replace(lens, **parts)
        covariance = drt_jax.psf_moments(changed, field, distance, wavelengths, order=order)[1]
        return jnp.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])

    return sigma


def _slope_error(slopes: np.ndarray, truth: list, count: int) -> float:
    """Norm of the error over that of the truth, the worse of curvatures and distances."""
    exact = np.array([moments.gradient[0] for moments in truth])
    slopes, worst = np.asarray(slopes, float), 0.0
    for group in (slice(0, count), slice(count, None)):
        known = np.isfinite(slopes[:, group])
        wrong = np.where(known, slopes[:, group] - exact[:, group], 0)
        worst = max(
            worst, np.linalg.norm(wrong) / np.linalg.norm(np.where(known, exact[:, group], 0))
        )
    return float(worst)


def _from_gaps(slopes: np.ndarray, count: int) -> np.ndarray:
    """Derivatives by curvatures and gaps as those by curvatures, thicknesses and the sensor."""
    gaps = slopes[:, count:]
    return np.concatenate([slopes[:, :count], gaps[:, :-1] - gaps[:, -1:], gaps[:, -1:]], axis=1)


def spot_tasks(config: Config, axial: bool, gradient: bool) -> list[dict]:
    """sigma at all wavelengths, or it and its Jacobian, on axis or at the field."""
    lens, distance = drt_jax.load_lens(config.lens), 1e3 * config.distance_m
    waves = jnp.asarray(config.wavelengths_um)
    field = 0.0 if axial else math.radians(config.field_deg)
    # On axis in focus the digits of the gradient cost no more; see docs/performance.md.
    order = drt_jax.pupil_order(lens, field, distance, waves, 1e-9 if axial else 1e-6)
    sigma, count = sigma_of(lens, field, distance, order), lens.curvature.size
    truth = reference(lens, field, distance, config.wavelengths_um)
    exact = np.array([moments.sigma for moments in truth])

    def jacobian(parts):
        values, back = jax.vjp(lambda parts: sigma(parts, waves), parts)
        return values, jax.vmap(lambda row: back(row)[0])(jnp.eye(waves.size))

    def error(values, slopes=None):
        worst = float(np.max(np.abs(np.asarray(values) / exact - 1)))
        return worst if slopes is None else max(worst, _slope_error(slopes, truth, count))

    if gradient:
        ours = compiled(jacobian, _parts(lens))
        values, slopes = ours.call()
        slopes = np.concatenate(
            [slopes["curvature"], slopes["thickness"], slopes["sensor"][:, None]], axis=1
        )
        own = error(values, slopes)
    else:
        ours = compiled(lambda parts: sigma(parts, waves), _parts(lens))
        own = error(ours.call())
    peers: dict[str, tuple | str] = {}
    numbers = _peers.Lens(lens, field, distance, config.wavelengths_um)
    for name in ("optiland", "batoid"):
        try:
            value, slope, version = _peers.spot(name, numbers, config.rays)
        except _peers.Missing as missing:
            peers[name] = str(missing)
            continue
        if gradient:
            values, slopes = slope()
            wrong = error(values, _from_gaps(slopes, count))
        else:
            wrong = error(value())
        peers[f"{name} {version}"] = (slope if gradient else value, wrong)
    where = "on axis" if axial else f"{config.field_deg:g} degrees"
    task = f"sigma{' and Jacobian' if gradient else ''}, {where}"
    return rows_of(task, ours, own, peers, config.repeats)


def bundle_task(config: Config) -> list[dict]:
    """Skew rays through random points of the stop, one wavelength, to the sensor."""
    lens, distance = drt_jax.load_lens(config.lens), 1e3 * config.distance_m
    waves, field = jnp.asarray(config.wavelengths_um[:1]), math.radians(config.field_deg)
    points = jnp.asarray(pupil.random_disc(config.bundle, config.seed)[0].T)

    def trace(points):
        rays = drt_jax.trace_rays(lens, field, distance, waves, points)
        return rays.points[0, :, -1, :2], rays.status[0]

    ours = compiled(trace, points)
    hits, status = ours.call()
    _common.require(bool(jnp.all(status == Status.OK)), "lens: rays of the bundle fail")
    few = drt_jax.trace_rays(lens, field, distance, waves, points[:1000])
    again, ok = jax.vmap(drt_jax.trace_snell, (None, None, 0, 0))(
        lens, waves[0], few.points[0, :, 0], few.directions[0, :, 0]
    )
    _common.require(bool(jnp.all(ok)), "lens: rays of the bundle fail")
    own = float(jnp.max(jnp.abs(again[:, -1, :2] - hits[:1000])))
    peers: dict[str, tuple | str] = {}
    try:
        rays = jax.jit(drt_jax.trace_rays)(lens, field, distance, waves, points)
        start = np.asarray(rays.points[0, :, 0] - 15 * rays.directions[0, :, 0])
        numbers = _peers.Lens(lens, field, distance, config.wavelengths_um[:1])
        call, version = _peers.batoid_rays(numbers, start, np.asarray(rays.directions[0, :, 0]))
        wrong = float(np.max(np.abs(call() - np.asarray(hits))))
        peers[f"batoid {version}, launched at our first hits"] = (call, wrong)
    except _peers.Missing as missing:
        peers["batoid"] = str(missing)
    rows = rows_of(f"{config.bundle} skew rays", ours, own, peers, config.repeats)
    devices = os.cpu_count() or 1
    shared = _work.spread_over_devices(
        config.lens,
        field,
        distance,
        config.wavelengths_um[0],
        config.bundle,
        config.seed,
        config.repeats,
        devices,
    )
    peer = rows[0]["peer_s"]
    rows.append(
        {
            **rows[0],
            "task": f"{config.bundle} skew rays, {devices} CPU devices",
            "ours_s": shared,
            "ratio": peer and peer / shared,
            "compile_s": None,
            "peak_mb": None,
            "kernels": None,
        }
    )

    back = compiled(
        jax.grad(lambda lens: jnp.mean(_squares(lens, field, distance, waves, points))), lens
    )
    rows.append(
        {
            **rows[0],
            "task": f"{config.bundle} skew rays and their gradient",
            "peer": "",
            "ours_s": alternate([back.call], 3)[0],
            "peer_s": None,
            "ratio": None,
            "peer_error": None,
            "ours_error": None,
            "compile_s": back.compile_s,
            "peak_mb": back.peak_mb,
            "kernels": back.kernels,
            "note": "",
        }
    )
    for row in rows:
        row["ours_rays_per_s"] = config.bundle / row["ours_s"]
        if row["peak_mb"] is not None:
            row["bytes_per_ray"] = row["peak_mb"] * 2**20 / config.bundle
    return rows


def _squares(lens, field, distance, waves, points):
    rays = drt_jax.trace_rays(lens, field, distance, waves, points)
    return rays.points[0, :, -1, :2] ** 2


def network_task(config: Config) -> list[dict]:
    """One Adam step of optics and network; the network alone; all before it, there and back."""
    rng = np.random.default_rng(config.seed)
    lens, distance = drt_jax.load_lens(config.lens), 1e3 * config.distance_m
    init, apply = network.red_net()
    weights = init(jax.random.key(config.seed))
    camera, rates = train.Camera(), {"optics": 1e-3, "network": 1e-3}
    values, blur = drt_jax.moments_model(
        lens, ("sensor",), 0.0, (distance, distance), config.wavelengths_um
    )
    side = config.patch + camera.kernel - 1
    scenes = rng.integers(0, 256, (config.batch, side, side, 3)).astype(np.uint8)
    start, step = train.make_step(
        train.make_imager(blur, apply, camera), rates, (distance, distance), config.seed
    )
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
    peers: dict[str, tuple | str] = {}
    try:
        call, version = _peers.network_step(config.batch, config.patch, 1e-3)
        peers[f"torch {version}, network alone, channels last"] = (call, None)
    except _peers.Missing as missing:
        peers["torch"] = str(missing)
    peers["ours, network alone"] = (only.call, None)
    sensor = train.make_imager(blur, None, camera)

    def front(values, scenes, noise, key):
        def image(values):
            return sensor({"optics": values}, scenes, distance, noise, key)[1]

        value, back = jax.vjp(image, values)
        return value, back(truth)

    key = jax.random.key(config.seed)
    rest = compiled(front, values, jnp.asarray(scenes), np.float32(0.01), key, **options)
    peers["ours, optics, noise and sensor layer alone"] = (rest.call, None)
    task = f"joint step with RED-Net, {config.batch} of {config.patch}x{config.patch}"
    return rows_of(task, joint, None, peers, min(config.repeats, 9))


def first_task(config: Config) -> list[dict]:
    """A new process: import, load a lens, trace, gradient; and the same once more, with the
    compiled programs kept in a folder."""
    rows = []
    for field, where in (
        (0.0, "on axis"),
        (math.radians(config.field_deg), f"{config.field_deg:g} degrees"),
    ):
        code = _FIRST.format(lens=config.lens, field=field, distance=1e3 * config.distance_m)
        with tempfile.TemporaryDirectory() as folder:
            kept = {
                "JAX_COMPILATION_CACHE_DIR": folder,
                "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            }
            _in_a_new_process(code, kept)
            for more, extra in (("", {}), (", programs kept", kept)):
                times = [_in_a_new_process(code, extra) for _ in range(3)]
                rows.append(
                    {
                        "task": f"first sigma and gradient in a new process, {where}{more}",
                        "peer": "",
                        "ours_s": float(np.median(times)),
                        "peer_s": None,
                        "ratio": None,
                        "ours_error": None,
                        "peer_error": None,
                        "compile_s": None,
                        "peak_mb": None,
                        "kernels": None,
                        "note": "",
                    }
                )
    return rows


def _in_a_new_process(code: str, environment: dict[str, str]) -> float:
    clean = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=clean | environment
    )
    _common.require(done.returncode == 0, f"lens: a new process failed: {done.stderr[-500:]}")
    return float(done.stdout.split()[-1])


TASKS = {
    "axial": lambda config: spot_tasks(config, True, False),
    "axial_jacobian": lambda config: spot_tasks(config, True, True),
    "field": lambda config: spot_tasks(config, False, False),
    "field_jacobian": lambda config: spot_tasks(config, False, True),
    "bundle": bundle_task,
    "network": network_task,
    "first": first_task,
}


def run(config: Config, run: Run) -> None:
    """Run the tasks one by one, print the table, draw run time against error."""
    # Programs kept from another run would hide what compiling takes.
    jax.config.update("jax_enable_compilation_cache", False)
    rows: list[dict] = []
    names = config.tasks or tuple(TASKS)
    with tqdm(names, unit="task", dynamic_ncols=True) as bar:
        for name in bar:
            bar.set_description(name)
            found = TASKS[name](config)
            for k, row in enumerate(found):
                columns = {c: np.array([float(row[c])]) for c in _COLUMNS if row[c] is not None}
                run.log(name, k, columns)
            rows += found
    lens, distance = drt_jax.load_lens(config.lens), 1e3 * config.distance_m
    results = {"rows": rows, "counts": _work.counts(lens, distance, config.wavelengths_um)}
    if config.growth:
        results["work"] = _work.growth(lens, math.radians(config.field_deg), distance, 5)
    path = run.finish({**results, "seconds": run.seconds})
    header = (
        "task",
        "ours ms",
        "peer",
        "peer ms",
        "ratio",
        "our error",
        "its error",
        "compile s",
        "MB",
    )

    def number(value, scale=1.0, form=".3g"):
        return "" if value is None else format(scale * value, form)

    print(
        _common.table(
            header,
            [
                (
                    r["task"],
                    number(r["ours_s"], 1e3),
                    r["peer"] if not r["note"] else r["note"],
                    number(r["peer_s"], 1e3),
                    number(r["ratio"]),
                    number(r["ours_error"], form=".1e"),
                    number(r["peer_error"], form=".1e"),
                    number(r["compile_s"]),
                    number(r["peak_mb"]),
                )
                for r in rows
            ],
        )
    )
    for name, count in results["counts"].items():
        print(f"{name}: rays are solved for {count} times in a training step")
    print(f"results in {path}")
    if config.growth:
        figure, axes = plot.new(1, 1, 5.5, 4)
        plot.growth(axes, results["work"])
        figure.savefig(run.figures / "work.png")
        print(f"figure {run.figures / 'work.png'}")
    tasks = list(dict.fromkeys(r["task"] for r in rows if r["task"].startswith("sigma")))
    if tasks:
        across = min(2, len(tasks))
        figure, axes = plot.new(-(-len(tasks) // across), across, 4.5, 3.2)
        for axis, task in zip(np.ravel(axes), tasks):
            some = [r for r in rows if r["task"] == task]
            marks = {"drt_jax": [(1e3 * some[0]["ours_s"], some[0]["ours_error"])]}
            marks |= {
                r["peer"]: [(1e3 * r["peer_s"], r["peer_error"])] for r in some if r["peer_s"]
            }
            plot.programs(axis, marks, task)
        figure.savefig(run.figures / "peers.png")
        print(f"figure {run.figures / 'peers.png'}")


def main(argv: list[str] | None = None) -> None:
    """Command line."""
    _common.main("benchmark", Config, _COLUMNS, run, argv)


if __name__ == "__main__":
    main()
