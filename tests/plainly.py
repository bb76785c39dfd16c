"""The main calls of the library as on another kind of device: without the options that were chosen
for CPUs. Run by test_devices.py with JAX_ENABLE_X64 on and off; prints numbers as JSON."""

import json
import sys

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Scene, design, learn
from drt_jax.learn import train

# No option of XLA, no convolution of ours, no grouping of small products.
jax.default_backend = lambda: "other"
jax.lax.platform_dependent = lambda *arrays, default, **others: default(*arrays)
RGB = (0.6, 0.53, 0.48)


def numbers():
    lens = drt_jax.load_lens("cooke_triplet")
    rule = drt_jax.converge(drt_jax.psf_moments, lens, Scene.point(0.2, 1e4, RGB), 1e-2)

    def spot(lens):
        found = drt_jax.psf_moments(lens, Scene.point(0.2, 1e4, RGB), sampling=rule)
        return 1e3 * jnp.mean(jnp.sqrt(jnp.trace(found.covariance, axis1=1, axis2=2)))

    value, slopes = jax.jit(jax.value_and_grad(spot))(lens)
    yield "spot, um", value
    yield "its slope by the sensor", slopes.sensor
    yield "and by a curvature", slopes.curvature[2]
    rays = drt_jax.trace_rays(lens, Scene.point(0.2, jnp.inf, 0.53), [[0.0, 0.7], [0.5, -0.5]])
    yield "hit, mm", rays.points[0, 0, -1, 1]
    yield "rays that pass", jnp.sum(rays.status == 0)
    model = drt_jax.converge(drt_jax.psf, lens, Scene.point(0.2, 1e4, RGB), 0.02, 9, "rays", 0.1)
    yield (
        "brightest pixel",
        jnp.max(drt_jax.psf(lens, Scene.point(0.2, 1e4, RGB), 0.02, 9, sampling=model).kernel),
    )
    perturbed = design.PerturbedLens.from_lens(
        lens, lens.semi_diameter[:-1], [design.Tolerance("decentre", 0.05)]
    )
    problem = design.Problem.from_variables(
        design.Variables.from_lens(perturbed.lens, ["sensor"]),
        ["spot"],
        Scene.radians([0.2], jnp.inf, RGB),
        4,
    )
    built = design.monte_carlo(
        problem, perturbed, design.draw_perturbations(perturbed, 60, 0), "focus"
    )
    yield "lenses as built, um", 1e3 * np.mean(built.spot)
    weights, restore = learn.red_net(layers=1, channels=32)
    blur = learn.moments_model(lens, ("sensor",), Scene.point(0.0, (1e4, 1e4), RGB), 1e-2)[1]
    imager = train.make_imager(blur, restore, train.Camera(kernel=5))
    init, step = train.make_step(imager, {"optics": 1e-3, "network": 1e-3}, (1e4, 1e4), 0)
    network = weights(jax.random.key(0))
    state = init({"optics": {"sensor": lens.sensor}, "network": network})
    scenes = np.random.default_rng(0).integers(0, 255, (2, 36, 36, 3), np.uint8)
    for k in range(3):
        state, metrics = step(state, scenes, np.float32(0), np.int32(k))
    yield "loss", metrics["loss"]
    yield "sensor, mm", state[0]["optics"]["sensor"]


json.dump({name: float(value) for name, value in numbers()}, sys.stdout)
