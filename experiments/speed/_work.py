"""Tools of `benchmark`: compiled programs, rows, other processes, scenes of growing size."""

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Lens, Scene, learn, pupil
from drt_jax.devices import device_mesh, shared, split
from drt_jax.image.sensor import convolve, convolve_taps
from drt_jax.learn import train

from . import _common

Row = dict[str, Any]
# Measurements of `compiled`.
MEASURED = ("compile_s", "peak_mb", "kernels")

_FIRST = """
import time; start = time.perf_counter()
import jax; jax.config.update("jax_enable_x64", True)
import drt_jax
lens = drt_jax.load_lens({lens!r})
scene = drt_jax.Scene.point({field}, {distance}, [0.53])
sigma = lambda lens: drt_jax.psf_moments(lens, scene).covariance[0, 1, 1] ** 0.5
found, slopes = jax.block_until_ready(jax.value_and_grad(sigma)(lens))
print(float(found), time.perf_counter() - start)
"""
SPREAD = """
import jax; jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", {devices})
from experiments import _work
from experiments._profile import LensFields, Profile
from experiments._waves import Waves
from experiments.benchmark import Config
print(_work.bundle_seconds({config!r}))
"""


def hits(lens: Lens, field: Any, distance: Any, waves: Array, points: Array) -> tuple[Array, Array]:
    """Hits (W, Q, 2) on the sensor, mm, and status (W, Q) of rays through points (Q, 2)."""
    rays = drt_jax.trace_rays(lens, Scene.point(field, distance, waves), points)
    return rays.points[:, :, -1, :2], rays.status


def compiled(function: Callable, *arguments: Any) -> tuple[Callable, dict[str, float]]:
    """Compiles a function, jitted or not, for its arguments.

    Returns a call without arguments, and the numbers of MEASURED: seconds of compilation with
    tracing, MiB of memory, and number of kernels (a kernel in a loop counts once). Donated
    arguments are copied for each call.
    """
    function = function if hasattr(function, "lower") else jax.jit(function)
    start = time.perf_counter()
    lowered = function.lower(*arguments)
    program = lowered.compile()
    seconds = time.perf_counter() - start
    memory = program.memory_analysis()
    size = memory.temp_size_in_bytes + memory.output_size_in_bytes
    kernels = len(re.findall(r" (?:fusion|dot|convolution|custom-call)\(", program.as_text()))
    donated = [info.donated for info in jax.tree.leaves(lowered.args_info)]

    def call():
        leaves, structure = jax.tree.flatten(arguments)
        leaves = [jnp.array(a) if gone else a for a, gone in zip(leaves, donated)]
        return jax.block_until_ready(program(*jax.tree.unflatten(structure, leaves)))

    return call, dict(zip(MEASURED, (seconds, size / 2**20, kernels)))


def peer(name: str, make: Callable[[], tuple], how: str = "") -> dict[str, tuple | str]:
    """(call, error) by name and version of a peer; or the reason why there is none, by its name."""
    try:
        return {f"{name} {version(name)}{how}": make()}
    except ImportError as missing:
        return {name: f"{missing.name} is not installed: pip install -e '.[peers]'"}
    except (ValueError, RuntimeError) as failure:
        return {name: str(failure)[:80]}


def row(task: str, seconds: float, **known: Any) -> Row:
    """A row of results.json; unknown values are None."""
    unknown = dict.fromkeys(("ours_error", *MEASURED, "peer_s", "ratio", "peer_error"))
    return {"task": task, "ours_s": seconds, "peer": "", "note": ""} | unknown | known


def rows_of(
    task: str, ours: tuple, error: float | None, peers: dict[str, tuple | str], repeats: int
) -> list[Row]:
    """Rows of one task. ours: result of `compiled`. error: our error. peers: results of `peer`."""
    call, measured = ours
    ready = {name: peer for name, peer in peers.items() if not isinstance(peer, str)}
    seconds, *theirs = _common.medians([call, *(other for other, _ in ready.values())], repeats)
    times = dict(zip(ready, theirs))
    rows = []
    for name, peer in peers.items():
        known: Row = {"note": peer}
        if name in ready:
            ratio = times[name] / seconds
            known = {"peer_s": times[name], "ratio": ratio, "peer_error": ready[name][1]}
        rows.append(row(task, seconds, ours_error=error, peer=name, **measured, **known))
    return rows


def in_a_new_process(code: str, environment: dict[str, str]) -> list[float]:
    """Runs Python code in a new process, without a compilation cache unless `environment` sets one.
    Returns the numbers in its last line of output."""
    clean = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    options = {"env": clean | environment, "cwd": _common.ROOT}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, **options)
    _common.require(done.returncode == 0, f"lens: a new process failed: {done.stderr[-500:]}")
    return [float(word) for word in done.stdout.splitlines()[-1].split()]


def first_gradients(lens: str, field: float, distance: float) -> np.ndarray:
    """Results of a new process that computes a spot with its gradient: RMS height of the spot in y,
    mm, and seconds since its start; without and with saved programs, (2, 2)."""
    code = _FIRST.format(lens=lens, field=field, distance=distance)
    with tempfile.TemporaryDirectory() as folder:
        cache = {"JAX_COMPILATION_CACHE_DIR": folder}
        cache["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
        in_a_new_process(code, cache)
        found = [[in_a_new_process(code, extra) for _ in range(3)] for extra in ({}, cache)]
    return np.median(found, axis=1)


def bundle_seconds(config: Any) -> float:
    """Seconds to trace the bundle of `benchmark` on all devices of this process, see SPREAD."""
    mesh = device_mesh(jax.device_count())
    trace, points = config.bundle_trace
    rays_first = shared(lambda points: [found[0] for found in trace(points)], mesh)
    call = partial(jax.jit(rays_first), split(mesh, points))
    assert not np.any(np.asarray(call()[1]))
    return _common.medians([call], config.repeats)[0]


def counts(lens: Lens, distance: float, wavelengths: tuple[float, ...]) -> dict[str, int]:
    """Number of solves for rays in a training step, by the trained numbers. It is the number of
    occurrences of `attach` (`rays.solve`) in the jaxpr of the step."""
    near, far = distance / 2, distance
    cases = {
        "sensor trained, one depth": (("sensor",), (far, far)),
        "sensor trained, random depth": (("sensor",), (near, far)),
        "curvatures and sensor trained, one depth": (("curvature", "sensor"), (far, far)),
    }
    found = {}
    scenes = jnp.zeros((1, 32 + 20, 32 + 20, 3), jnp.uint8)
    for name, (trained, depths) in cases.items():
        values, blur = learn.moments_model(lens, trained, Scene.point(0.0, depths, wavelengths))
        kind = convolve_taps if len(trained) == 1 else convolve
        imager = train.make_imager(blur, None, train.Camera(), kind)
        init, step = train.make_step(imager, {"optics": 1e-3}, depths, 0)
        step = step.trace(init({"optics": values}), scenes, np.float32(0), np.int32(0))
        found[name] = str(step.jaxpr).count("name=attach")
    return found


def _plates(count: int) -> Lens:
    """Thin, weak lenses with `count` surfaces, the stop in the middle."""
    plate = {"thickness": 0.1, "semi_diameter": 50.0}
    surfaces = [
        {"radius": 1e5 * (-1) ** i, "index": 1.0 if i % 2 else 1.5} | plate for i in range(count)
    ]
    surfaces[-1]["index"] = 1.0
    surfaces[count // 2] |= {"stop": True, "semi_diameter": 5.0}
    return drt_jax.load_lens({"name": f"{count} surfaces", "surfaces": surfaces})


def growth(lens: Lens, field: float, distance: float, repeats: int) -> dict[str, list]:
    """Times of a trace for numbers of rays, surfaces and wavelengths over three decades: lists of
    (number, seconds)."""

    def seconds(lens, rays, waves, angle=field):
        points = jnp.asarray(pupil.random_disc(rays, 0)[0])
        call, _ = compiled(partial(hits, lens, angle, distance, waves), points)
        if jnp.any(call()[1] != drt_jax.Status.OK):
            raise RuntimeError(f"{lens.name}: rays of the measurement fail")
        return _common.medians([call], repeats)[0]

    green, surfaces = jnp.array([0.53]), (3, 10, 30, 100, 300, 1000, 3000)
    waves = {n: jnp.linspace(0.45, 0.65, n) for n in (1, 3, 10, 30, 100, 300, 1000)}
    return {
        "rays": [(n, seconds(lens, n, green)) for n in (256, 1024, 4096, 16384, 65536, 262144)],
        "surfaces": [(n, seconds(_plates(n), 256, green, 0.001)) for n in surfaces],
        "wavelengths": [(n, seconds(lens, 64, some)) for n, some in waves.items()],
    }
