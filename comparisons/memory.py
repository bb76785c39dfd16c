"""Memory of the gradient of a loss over the whole field, beside Optiland's torch tracer.

`python -m comparisons.memory` sums the RMS spots of 21 fields, 3 wavelengths and 32 hexapolar rings
of rays of the Double Gauss, 199,647 rays, and differentiates by all curvatures, thicknesses and the
sensor. Each way runs in a process of its own and prints a line: how far the resident memory rises
above that of the same process after a trace of one ring, seconds of a later call, and the sum.
"""

import subprocess
import sys
import time

import numpy as np

RINGS, FIELDS, WAVES, MOST = 32, 21, (0.6, 0.53, 0.48), 14.0
WAYS = ("ours, field by field", "ours, all at once", "optiland")


def _peak() -> float:
    """Peak of the resident memory so far, MB."""
    with open("/proc/self/status") as file:
        line = next(line for line in file if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1e3


def _ours(rings: int, at_once: bool):
    import jax
    import jax.numpy as jnp

    import drt_jax

    jax.config.update("jax_enable_x64", True)
    lens = drt_jax.load_lens("double_gauss")
    points, weights = drt_jax.pupil.hexapolar(rings)
    rule = drt_jax.Pattern(points, weights, "none")
    fields = jnp.radians(jnp.linspace(0, MOST, FIELDS))

    def spot(lens, field):
        moments = drt_jax.psf_moments(lens, drt_jax.Scene.point(field, jnp.inf, WAVES), rule)
        return jnp.sum(jnp.sqrt(jnp.trace(moments.covariance, axis1=1, axis2=2)))

    def loss(lens):
        if at_once:
            return jnp.sum(jax.vmap(lambda field: spot(lens, field))(fields))
        one = jax.checkpoint(lambda field: spot(lens, field))
        return jnp.sum(jax.lax.map(one, fields))

    step = jax.jit(jax.value_and_grad(loss))
    return lambda: float(jax.block_until_ready(step(lens))[0])


def _optiland(rings: int):
    import torch
    from experiments._peers import Lens, _optiland_system
    from optiland import backend

    import drt_jax

    backend.set_backend("torch")
    backend.set_precision("float64")
    backend.grad_mode.enable()
    lens, systems = drt_jax.load_lens("double_gauss"), []
    for field in np.radians(np.linspace(0, MOST, FIELDS)):
        numbers = Lens(lens, float(field), np.inf, WAVES)
        for index, wave in zip(numbers.index.T, WAVES):
            systems.append((_optiland_system(numbers, index, wave), wave, float(field)))

    def call():
        total = 0.0
        for optic, wave, field in systems:
            hits = optic.trace(0, 1 if field else 0, wave, rings, "hexapolar")
            total = total + torch.sqrt(hits.x.var(unbiased=False) + hits.y.var(unbiased=False))
        total.backward()
        return float(total.detach())

    return call


def _measure(way: str) -> None:
    make = {
        "optiland": _optiland,
        "ours, field by field": lambda rings: _ours(rings, False),
        "ours, all at once": lambda rings: _ours(rings, True),
    }[way]
    make(1)()
    before, call = _peak(), make(RINGS)
    call()
    rise = _peak() - before
    started = time.perf_counter()
    value = call()
    print(
        f"{way}: {rise:.0f} MB, {time.perf_counter() - started:.2f} s, {value:.6f} mm", flush=True
    )


if __name__ == "__main__":
    if len(sys.argv) > 1:
        _measure(sys.argv[1])
    else:
        for one in WAYS:
            subprocess.run([sys.executable, "-m", "comparisons.memory", one], check=False)
