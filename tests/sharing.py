"""Work divided among eight devices, compared with one device: run by test_devices.py in a process
with virtual devices; prints the largest differences as JSON."""

import dataclasses
import json
import sys

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax import Scene, design, devices, learn
from drt_jax.learn import field, train

jax.config.update("jax_enable_x64", True)
LENS = "singlet"
COLOURS = (0.6, 0.53, 0.48)


def apart(one, other):
    """Largest difference of the arrays of two trees, relative to the largest number of each."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return max(
        float(np.max(np.abs(a - b)) / max(np.max(np.abs(a)), 1e-30))
        for a, b in ((np.asarray(a, float), np.asarray(b, float)) for a, b in pairs)
    )


def problem_of(lens):
    variables = design.Variables.from_lens(lens, [design.Vary("curvature"), "sensor"])
    fields = np.radians([0.0, 1.0])
    return design.Problem.from_variables(
        variables, ["spot"], Scene.radians(fields, jnp.inf, (0.5876,)), 3
    )


def monte_carlo(mesh):
    lens = drt_jax.load_lens(LENS)
    problem, sizes = (
        problem_of(lens),
        [design.Tolerance("decentre", 0.02), design.Tolerance("radius", 0.2)],
    )
    perturbed = design.PerturbedLens.from_lens(lens, problem.beam_radius(lens), sizes)
    problem = problem_of(perturbed.lens)
    rows = design.draw_perturbations(perturbed, 430, 0)  # eight tiles of 50, and some more
    return design.monte_carlo(problem, perturbed, rows, "focus", mesh=mesh)


def starts(mesh):
    problem = problem_of(drt_jax.load_lens(LENS))
    vectors = design.normal_starts(problem.variables, 40, 1.0)
    return design.many_starts(problem, vectors, (3, 3), mesh=mesh).merits


def kernels(mesh):
    lens = drt_jax.load_lens(LENS)
    fields = np.radians(np.stack([np.linspace(0, 1, 16), np.linspace(0, 2, 16)], axis=-1))
    model = drt_jax.converge(
        drt_jax.psf, lens, Scene.grid(fields[::5], jnp.inf, COLOURS), 0.01, 11, "rays", 0.05
    )

    def grid(lens, fields):
        return drt_jax.psf(
            lens, Scene.radians(fields, jnp.inf, COLOURS), 0.01, 11, sampling=model
        ).kernel

    return jax.jit(devices.shared(grid, mesh, 1))(lens, fields)


def rays(mesh):
    lens = drt_jax.load_lens(LENS)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (64, 2))

    def hits(lens, points):
        found = drt_jax.trace_rays(lens, Scene.point(0.1, jnp.inf, COLOURS), points)
        return jnp.moveaxis(found.points[..., -1, :2], 1, 0)  # (Q, W, 2): rays first

    return jax.jit(devices.shared(hits, mesh, 1))(lens, points)


def training(mesh):
    """Losses, and the state after some steps."""
    weights, restore = learn.red_net(layers=2, channels=32)
    lens = drt_jax.load_lens(LENS)
    blur = learn.moments_model(lens, ("sensor",), Scene.point(0.0, (25e3, 25e3), COLOURS), 1e-3)[1]
    camera = train.Camera(kernel=9)
    imager = train.make_imager(blur, devices.shared(restore, mesh, 1), camera)
    init, step = train.make_step(imager, {"optics": 1e-3, "network": 1e-3}, (25e3, 25e3), 0)
    start = {"optics": {"sensor": lens.sensor}, "network": weights(jax.random.key(0))}
    state, losses = devices.copied(mesh, init(start)), []
    images = np.random.default_rng(0).integers(0, 255, (5, 8, 40, 40, 3), np.uint8)
    for k, scenes in enumerate(images):
        scenes = devices.split(mesh, scenes)
        state, metrics = step(state, scenes, np.float32(0.01), np.int32(k))
        losses.append(float(metrics["loss"]))
    if mesh is not None:  # each device has its part of the images and all of the weights
        assert {part.data.shape for part in scenes.addressable_shards} == {(1, 40, 40, 3)}
        assert all(leaf.is_fully_replicated for leaf in jax.tree.leaves(state))
    return np.array(losses), devices.gathered(state)


def joint_training(mesh):
    """Losses and states of lens and network over the field."""
    lens, pixel = drt_jax.load_lens(LENS), 0.02
    field_of = np.array([[0.01, 0.01]])
    model = drt_jax.converge(
        drt_jax.psf, lens, Scene.radians(field_of, 5e3, COLOURS), pixel, 9, "gaussian", 0.05
    )
    weights, restore = learn.red_net(layers=1, channels=32)
    images = np.random.default_rng(0).integers(0, 255, (3, 8, 40, 40, 3), np.uint8)

    def points(optics, seen):
        moved = dataclasses.replace(lens, sensor=optics["sensor"])
        found = drt_jax.psf(moved, Scene.radians(*seen[:2], COLOURS), pixel, 9, sampling=model)
        return found.kernel, jnp.ones((4, 3))

    convolve = devices.shared(learn.convolve_each, mesh)
    camera = field.FieldImager(points, devices.shared(restore, mesh, 1), convolve)
    rates = {"optics": 1e-2, "network": 1e-3}
    draw = lambda key: field.draw_points(key, 4, 0.02, (5e3, jnp.inf))  # noqa: E731
    init, step = field.make_field_step(camera, rates, draw, 0)
    start = {"optics": {"sensor": lens.sensor}, "network": weights(jax.random.key(0))}
    state, losses = devices.copied(mesh, init(start)), []
    for k, scenes in enumerate(images):
        scenes = devices.split(mesh, scenes)
        state, metrics = step(state, scenes, np.float32(0.01), np.int32(k))
        losses.append(float(metrics["loss"]))
    return np.array(losses), devices.gathered(state[0])


if __name__ == "__main__":
    jobs = monte_carlo, starts, kernels, rays, training, joint_training
    jobs = {job.__name__: job for job in jobs}
    found = {name: apart(jobs[name](None), jobs[name](devices.device_mesh(8))) for name in jobs}
    json.dump(found, sys.stdout)
