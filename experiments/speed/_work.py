"""What `benchmark` counts: the work in a training step, and how run time grows with a scene."""

import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Lens
from drt_jax.pupil import rules as pupil
from drt_jax.learn import train

_SPREAD = """
import sys, time
import jax; jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", {devices})
import numpy as np
import drt_jax
from drt_jax.pupil import rules as pupil
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
times = []
for _ in range({repeats}):
    start = time.perf_counter()
    jax.block_until_ready(trace(points))
    times.append(time.perf_counter() - start)
print(np.median(times))
"""


def median_seconds(call, repeats: int) -> float:
    """Median of `repeats` calls after one that does not count."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def spread_over_devices(
    lens: str,
    field: float,
    distance: float,
    wave: float,
    count: int,
    seed: int,
    repeats: int,
    devices: int,
) -> float:
    """Seconds to trace `count` rays shared among so many CPU devices, in a process of its own:
    JAX fixes their number when it starts."""
    code = _SPREAD.format(**locals())
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"a process with {devices} devices failed: {done.stderr[-500:]}")
    return float(done.stdout.split()[-1])


def counts(lens: Lens, distance: float, wavelengths: tuple[float, ...]) -> dict[str, int]:
    """How many times a training step solves for rays, by what is trained: occurrences of
    `solve_rays` in the jaxpr of a step."""
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
        imager = train.make_imager(blur, None, train.Camera(), forward=len(trained) == 1)
        init, step = train.make_step(imager, {"optics": 1e-3}, depths, 0)
        state = init({"optics": values})
        program = step.trace(state, scenes, np.float32(0), np.int32(0)).jaxpr
        found[name] = str(program).count("name=solve_rays")
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

        program = jax.jit(trace).lower(points).compile()
        if jnp.any(program(points)[1] != drt_jax.Status.OK):
            raise RuntimeError(f"{lens.name}: rays of the measurement fail")
        return median_seconds(lambda: jax.block_until_ready(program(points)), repeats)

    green = jnp.array([0.53])
    found: dict[str, list] = {"rays": [], "surfaces": [], "wavelengths": []}
    for rays in (256, 1024, 4096, 16384, 65536, 262144):
        found["rays"].append((rays, seconds(lens, rays, green)))
    for count in (3, 10, 30, 100, 300, 1000, 3000):
        found["surfaces"].append((count, seconds(_plates(count), 256, green, 0.001)))
    for waves in (1, 3, 10, 30, 100, 300, 1000):
        found["wavelengths"].append((waves, seconds(lens, 64, jnp.linspace(0.45, 0.65, waves))))
    return found
