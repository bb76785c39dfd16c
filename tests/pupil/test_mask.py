"""Masks in the stop: means over their pixels, throughput and moments of rays, and kernels by waves,
compared with sums over fine grids in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Gauss, Mask, Masked, Pattern, Sampling, Scene, load_lens, psf, psf_moments
from drt_jax.image.beam import beam_rule
from drt_jax.lens.scene import checked_scene
from drt_jax.pupil import square_grid

RNG = np.random.default_rng(0)
CODE = RNG.integers(0, 2, (8, 8)) * RNG.uniform(0.3, 1, (8, 8))  # [y, x]
GREEN, F, R = 0.55, 100.0, 4.0


def lens_of(phase=None, **more):
    """A stop alone, with or without the phase of a plate that focuses at F."""
    series = np.array([-1 / (2 * F), 1 / (8 * F**3), -1 / (16 * F**5)]) * 1e3 / GREEN
    stop = {"radius": "inf", "semi_diameter": R, "stop": True}
    stop |= {"phase": {"coefficients": dict(zip((2, 4, 6), series.tolist()))}} if phase else {}
    return load_lens({"surfaces": [stop], "sensor": F})


def test_means_over_boxes():
    """For boxes up to the size of a pixel, also across the edges of the plate, compared with many
    points."""
    at, half = RNG.uniform(-1.1, 1.1, (2, 1, 50)), RNG.uniform(0, 0.5 / 4, (2, 1, 50))
    table = RNG.uniform(size=(4, 4)) + 1j * RNG.uniform(size=(4, 4))
    side = (np.arange(2000) + 0.5) / 1000 - 1
    found = Mask.means(jnp.asarray(table), jnp.asarray(at), jnp.asarray(half))[0]
    for k in range(50):
        means = []
        for axis in (0, 1):  # the part of the box in each pixel, per axis
            x = (at[axis, 0, k] + half[axis, 0, k] * side + 1) * 2
            means.append([np.mean(np.floor(x) == i) for i in range(4)])
        np.testing.assert_allclose(found[k], means[1] @ table @ means[0], atol=3e-3)
    point = Mask.means(jnp.asarray(table), jnp.array([[[0.3]], [[-0.6]]]), jnp.zeros((2, 1, 1)))
    assert point[0, 0] == table[0, 2]
    for eps in (0.0, 2e-16, -2e-16):  # a ray on the rim, by rounding beside it
        rim = jnp.array([[[1, -1, 0.1, 0.1]], [[0.1, 0.1, 1, -1]]]) * (1 + eps)
        found = Mask.means(jnp.asarray(table), rim, jnp.zeros((2, 1, 4)))[0]
        np.testing.assert_array_equal(found, [table[2, 3], table[2, 0], table[3, 2], table[0, 2]])


def test_what_a_mask_cannot_be_is_refused():
    model = Sampling("rays", beam_rule(4, "rotational"), 32)
    flat = jnp.ones((4, 4))
    with pytest.raises(ValueError, match=r"expected an amplitude \(N, M\) or \(W, N, M\)"):
        model.masked(Mask(jnp.ones(4)))
    with pytest.raises(ValueError, match=r"got \(4, 4\) and \(4, 3\)"):
        model.masked(Mask(flat, flat[:, :3]))
    with pytest.raises(ValueError, match='a mask with a path in the kind "rays"'):
        model.masked(Mask(flat, flat))
    with pytest.raises(ValueError, match='a mask in the kind "gaussian"'):
        Sampling("gaussian", model.rule, 0).masked(Mask(flat))
    assert model.masked(Mask(flat)).cells == 32 and model.masked(Mask(flat), 99).cells == 99
    lens, scene = lens_of(), checked_scene(lens_of(), Scene.point(0.0, jnp.inf, [GREEN]))
    with pytest.raises(ValueError, match='of the symmetry "none"'):
        Masked(Gauss(3, "bilateral"), Mask(flat)).points(lens, scene)
    with pytest.raises(ValueError, match="a path acts on waves alone"):
        Masked(Gauss(3, "none"), Mask(flat, flat)).points(lens, scene)


@pytest.mark.slow
def test_light_and_middle_of_the_rays_of_a_mask():
    side = 256  # of the sum in NumPy; the rays are those of 64
    lens, mask = lens_of(), Mask(jnp.asarray(CODE))
    rule = Masked(Pattern(*square_grid(64), "none"), mask)
    found = psf_moments(lens, Scene.point(0.0, jnp.inf, [GREEN]), sampling=rule)
    line = (np.arange(side) + 0.5) / side * 2 - 1
    inside = line**2 + line[:, None] ** 2 < 1
    light = inside * np.kron(CODE**2, np.ones((side // 8, side // 8)))
    np.testing.assert_allclose(found.throughput, light.sum() / inside.sum(), rtol=5e-3)
    middle = R * np.array([light.sum(0) @ line, light.sum(1) @ line]) / light.sum()
    np.testing.assert_allclose(found.mean[0], middle, atol=5e-3 * R)


def fraunhofer(mask, pixel, size):
    """Light in the pixels from the plane waves of all directions of a perfect lens."""
    fine, sub = 1024, 6
    most = R / np.hypot(R, F)
    line = ((np.arange(fine) + 0.5) / fine * 2 - 1) * most
    cosine = np.sqrt(1 - line**2 - line[:, None] ** 2)
    on_stop = [-d / cosine * F / R for d in np.meshgrid(line, line)]
    across, down = (np.clip((s + 1) * 4, 0, 7).astype(int) for s in on_stop)
    wave = np.asarray(mask.amplitude) * np.exp(2e3j * np.pi / GREEN * np.asarray(mask.path))
    field = wave[down, across] * (on_stop[0] ** 2 + on_stop[1] ** 2 < 1) / cosine**2
    place = (np.arange(size * sub) - (size * sub - 1) / 2) * pixel / sub
    turn = np.exp(2e3j * np.pi / GREEN * np.outer(place, line))
    light = (
        np.abs(turn @ field @ turn.T) ** 2 * (pixel / sub * (line[1] - line[0]) * 1e3 / GREEN) ** 2
    )
    return light.reshape(size, sub, size, sub).sum((1, 3)) / np.sum(np.abs(field) ** 2)


@pytest.mark.slow
def test_kernel_by_waves_of_a_coded_phase_plate():
    """Random amplitudes and paths, in `jit`: the kernel agrees with Fraunhofer's sum, the
    throughput with the pixels on the disc, and the derivatives by both with differences."""
    lens, pixel, size = lens_of(phase=True), 0.004, 31
    model = Sampling("waves", beam_rule(8, "rotational"), 32)
    mask = Mask(jnp.asarray(CODE), jnp.asarray(RNG.uniform(0, 3e-4, (8, 8))))
    weights = jnp.asarray(RNG.uniform(size=(size, size)))

    def found(mask):
        made = model.masked(mask, 128)
        one = psf(
            lens, Scene.point(0.0, jnp.inf, [GREEN]), pixel, size, sampling=made, centre=(0.0, 0.0)
        )
        return jnp.sum(weights * one.kernel[0]), (one.kernel[0], one.throughput[0])

    program = jax.jit(jax.value_and_grad(found, has_aux=True))
    (_, (kernel, light)), slope = program(mask)
    wanted = fraunhofer(mask, pixel, size)
    assert np.sum(np.abs(kernel - wanted)) < 6e-3
    line = (np.arange(512) + 0.5) / 256 - 1
    inside = line**2 + line[:, None] ** 2 < 1
    exact = np.sum(inside * np.kron(CODE**2, np.ones((64, 64)))) / inside.sum()
    np.testing.assert_allclose(light, exact, rtol=1e-4)
    way = Mask(jnp.asarray(RNG.normal(size=(8, 8))), jnp.asarray(1e-4 * RNG.normal(size=(8, 8))))
    ends = [program(jax.tree.map(lambda a, b: a + s * b, mask, way))[0][0] for s in (-1e-5, 1e-5)]
    along = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(slope), jax.tree.leaves(way)))
    np.testing.assert_allclose(along, (ends[1] - ends[0]) / 2e-5, rtol=1e-6)
