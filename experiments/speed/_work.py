"""What `benchmark` measures with: compiled programs, rows, other processes, growing scenes."""

import dataclasses
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Lens, pupil
from drt_jax.image.sensor import convolve, convolve_taps
from drt_jax.learn import train

from . import _common

Row = dict[str, Any]
# What is known of a program that was compiled, see `Ours`.
MEASURED = ("compile_s", "peak_mb", "kernels")

_FIRST = """
import time; start = time.perf_counter()
import jax; jax.config.update("jax_enable_x64", True)
import drt_jax
lens = drt_jax.load_lens({lens!r})
sigma = lambda lens: drt_jax.psf_moments(lens, {field}, {distance}, [0.53])[1][0, 1, 1] ** 0.5
jax.block_until_ready(jax.value_and_grad(sigma)(lens))
print(time.perf_counter() - start)
"""
_SPREAD = """
import jax; jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", {devices})
import numpy as np
import drt_jax
from drt_jax import pupil
from experiments._common import medians
from jax.sharding import AxisType, NamedSharding, PartitionSpec
lens = drt_jax.load_lens({lens!r})
def trace(points):
    rays = drt_jax.trace_rays(lens, {field}, {distance}, [{wave}], points)
    return rays.points[0, :, -1, :2], rays.status[0]
mesh = jax.make_mesh(({devices},), ("rays",), axis_types=(AxisType.Auto,))
rays = PartitionSpec("rays")
trace = jax.jit(jax.shard_map(trace, mesh=mesh, in_specs=rays, out_specs=rays, check_vma=False))
points = jax.device_put(pupil.random_disc({count}, {seed})[0].T, NamedSharding(mesh, rays))
assert not np.any(np.asarray(trace(points)[1]))
print(medians([lambda: trace(points)], {repeats})[0])
"""


@dataclasses.dataclass(frozen=True)
class Ours:
    """A compiled program of ours.

    call: what it is called with no more.
    measured: seconds that compiling took, MiB that it holds, and of how many kernels it consists
        (those in a loop once).
    """

    call: Callable
    measured: dict[str, float]


def compiled(function: Callable, *arguments: Any, **options: Any) -> Ours:
    """`function` compiled for its arguments, tracing included."""
    return loaded(jax.jit(function, **options), *arguments)


def loaded(function: Callable, *arguments: Any) -> Ours:
    """The same of a jitted function. Arguments that it donates, it is given as copies."""
    start = time.perf_counter()
    lowered = function.lower(*arguments)
    program = lowered.compile()
    seconds = time.perf_counter() - start
    memory = program.memory_analysis()
    held = memory.temp_size_in_bytes + memory.output_size_in_bytes
    kernels = len(re.findall(r" (?:fusion|dot|convolution|custom-call)\(", program.as_text()))
    donated = [info.donated for info in jax.tree.leaves(lowered.args_info)]

    def call():
        leaves, structure = jax.tree.flatten(arguments)
        given = [jnp.array(a) if gone else a for a, gone in zip(leaves, donated)]
        return jax.block_until_ready(program(*jax.tree.unflatten(structure, given)))

    return Ours(call, dict(zip(MEASURED, (seconds, held / 2**20, kernels))))


def row(task: str, seconds: float, **known: Any) -> Row:
    """A row of results.json; what is not known is None."""
    unknown = dict.fromkeys(("ours_error", *MEASURED, "peer_s", "ratio", "peer_error"))
    return {"task": task, "ours_s": seconds, "peer": "", "note": ""} | unknown | known


def rows_of(
    task: str, ours: Ours, error: float | None, peers: dict[str, tuple | str], repeats: int
) -> list[Row]:
    """Rows of one task: `peers` by name, (call, error) or why there is none."""
    ready = {name: peer for name, peer in peers.items() if not isinstance(peer, str)}
    calls = [ours.call, *(call for call, _ in ready.values())]
    seconds, *others = _common.medians(calls, repeats)
    found, rows = dict(zip(ready, others)), []
    for name, peer in peers.items():
        if name in found:
            ratio = found[name] / seconds
            known = {"peer_s": found[name], "ratio": ratio, "peer_error": peer[1]}
        else:
            known = {"note": peer}
        rows.append(row(task, seconds, ours_error=error, peer=name, **ours.measured, **known))
    return rows


def in_a_new_process(code: str, environment: dict[str, str]) -> float:
    """The number that Python code prints last, run without a cache but for `environment`."""
    clean = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=clean | environment,
        cwd=_common.ROOT,
    )
    _common.require(done.returncode == 0, f"lens: a new process failed: {done.stderr[-500:]}")
    return float(done.stdout.split()[-1])


def first_seconds(lens: str, field: float, distance: float) -> list[float]:
    """Seconds from the start of a process to a first gradient: anew, and with programs kept."""
    code = _FIRST.format(lens=lens, field=field, distance=distance)
    with tempfile.TemporaryDirectory() as folder:
        kept = {
            "JAX_COMPILATION_CACHE_DIR": folder,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        in_a_new_process(code, kept)
        times = [[in_a_new_process(code, extra) for _ in range(3)] for extra in ({}, kept)]
    return [float(np.median(some)) for some in times]


def spread_over_devices(config: Any, devices: int) -> float:
    """Seconds to trace the bundle of `benchmark` shared among so many CPU devices, in a process of
    its own: JAX fixes their number when it starts."""
    _, field, distance = config.scene
    code = _SPREAD.format(
        lens=config.lens,
        field=field,
        distance=distance,
        wave=config.wavelengths_um[0],
        count=config.bundle,
        seed=config.seed,
        repeats=config.repeats,
        devices=devices,
    )
    return in_a_new_process(code, {})


def counts(lens: Lens, distance: float, wavelengths: tuple[float, ...]) -> dict[str, int]:
    """How many times a training step solves for rays, by what is trained: occurrences of
    `attach` (`rays.solve`) in the jaxpr of a step."""
    near, far = distance / 2, distance
    cases = {
        "sensor trained, one depth": (("sensor",), (far, far)),
        "sensor trained, random depth": (("sensor",), (near, far)),
        "curvatures and sensor trained, one depth": (("curvature", "sensor"), (far, far)),
    }
    found = {}
    scenes = jnp.zeros((1, 32 + 20, 32 + 20, 3), jnp.uint8)
    for name, (trained, depths) in cases.items():
        values, blur = drt_jax.moments_model(lens, trained, 0.0, depths, wavelengths)
        kind = convolve_taps if len(trained) == 1 else convolve
        imager = train.make_imager(blur, None, train.Camera(), kind)
        init, step = train.make_step(imager, {"optics": 1e-3}, depths, 0)
        state = init({"optics": values})
        program = step.trace(state, scenes, np.float32(0), np.int32(0)).jaxpr
        found[name] = str(program).count("name=attach")
    return found


def _plates(count: int) -> Lens:
    """`count` surfaces of thin, weak lenses, the stop in the middle."""
    surfaces = [
        {
            "radius": 1e5 * (-1) ** i,
            "thickness": 0.1,
            "index": 1.0 if i % 2 else 1.5,
            "semi_diameter": 50.0,
        }
        for i in range(count)
    ]
    surfaces[-1]["index"] = 1.0
    surfaces[count // 2] |= {"stop": True, "semi_diameter": 5.0}
    return drt_jax.load_lens({"name": f"{count} surfaces", "surfaces": surfaces})


def growth(lens: Lens, field: float, distance: float, repeats: int) -> dict[str, list]:
    """Seconds of a trace over three decades of rays, surfaces and wavelengths: lists of
    (number, seconds)."""

    def seconds(lens, rays, waves, angle=field):
        points = jnp.asarray(pupil.random_disc(rays, 0)[0].T)

        def trace(points):
            traced = drt_jax.trace_rays(lens, angle, distance, waves, points)
            return traced.points[:, :, -1], traced.status

        program = compiled(trace, points)
        if jnp.any(program.call()[1] != drt_jax.Status.OK):
            raise RuntimeError(f"{lens.name}: rays of the measurement fail")
        return _common.medians([program.call], repeats)[0]

    green = jnp.array([0.53])
    decades = [(n, jnp.linspace(0.45, 0.65, n)) for n in (1, 3, 10, 30, 100, 300, 1000)]
    return {
        "rays": [(n, seconds(lens, n, green)) for n in (256, 1024, 4096, 16384, 65536, 262144)],
        "surfaces": [
            (n, seconds(_plates(n), 256, green, 0.001)) for n in (3, 10, 30, 100, 300, 1000, 3000)
        ],
        "wavelengths": [(n, seconds(lens, 64, waves)) for n, waves in decades],
    }
