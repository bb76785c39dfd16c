"""Where neighbouring surfaces cross, light ends as at a clear aperture: compared with closed forms
and an integral over a trace by Snell's law."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.snell import trace_snell

import drt_jax
from drt_jax import Clipped, Scene, focus_moments, load_lens
from drt_jax.lens.order import may_cross

GREEN = (0.55,)


def wide(semi):
    """A plano-convex lens without rims behind a stop of `semi` mm: its surfaces cross in a
    circle."""
    lens = load_lens("singlet")
    return dataclasses.replace(lens, semi_diameter=jnp.array([semi, jnp.inf, jnp.inf, jnp.inf]))


def light(lens, field, rule):
    """The fraction of the light on the stop that passes."""
    return focus_moments(lens, Scene.point(field, jnp.inf, GREEN), sampling=rule).throughput[0]


@pytest.mark.slow
def test_on_axis():
    """The circle has r^2 = 2 R t - t^2; its derivatives by curvature and thickness."""
    lens = wide(25.0)
    c, t = float(lens.curvature[1]), float(lens.thickness[1])
    passed, gradient = jax.value_and_grad(light)(lens, 0.0, Clipped(4, "rotational"))
    np.testing.assert_allclose(passed, (2 * t / c - t**2) / 625, rtol=1e-12)
    np.testing.assert_allclose(gradient.curvature[1], -2 * t / c**2 / 625, rtol=1e-10)
    np.testing.assert_allclose(gradient.thickness[1], (2 / c - 2 * t) / 625, rtol=1e-10)


def overlap(stop, field, curvature, thickness):
    """The part of a stop that the circle leaves at an angle: the overlap of two discs."""
    r = np.sqrt(2 * thickness / curvature - thickness**2)
    d = np.tan(field) * (2.0 + thickness)
    x = (d**2 + stop**2 - r**2) / (2 * d)  # of the chord
    area = stop**2 * np.arccos(x / stop) - x * np.sqrt(stop**2 - x**2)
    area += r**2 * np.arccos((d - x) / r) - (d - x) * np.sqrt(r**2 - (d - x) ** 2)
    return area / (np.pi * stop**2)


@pytest.mark.slow
def test_off_axis():
    """Two overlapping circles; derivatives by a complex step, in every mode, also the second
    ones."""
    lens, field = wide(18.0), 0.6
    rule = drt_jax.converge(drt_jax.psf_moments, lens, Scene.point(field, jnp.inf, GREEN), 1e-6)
    assert rule.order <= 8
    given = (18.0, field, float(lens.curvature[1]), float(lens.thickness[1]))
    wanted = overlap(*given)
    assert 0.5 < wanted < 0.95

    @jax.jit
    def shares(stop, field, curvature, thickness):
        moved = dataclasses.replace(
            lens,
            semi_diameter=lens.semi_diameter.at[0].set(stop),
            curvature=lens.curvature.at[1].set(curvature),
            thickness=lens.thickness.at[1].set(thickness),
        )
        return light(moved, field, rule)

    every = range(4)
    np.testing.assert_allclose(shares(*given), wanted, rtol=1e-9)
    exact = [
        np.imag(overlap(*(a + 1e-30j * (j == k) for j, a in enumerate(given)))) / 1e-30
        for k in every
    ]
    for mode in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(jax.jit(mode(shares, every))(*given), exact, rtol=1e-7)
    second = jax.jit(jax.grad(lambda t: jax.grad(shares, 3)(*given[:3], t)))(given[3])
    h = 1e-4
    far = [overlap(*given[:3], given[3] + s * h) for s in (-1, 0, 1)]
    np.testing.assert_allclose(second, (far[0] - 2 * far[1] + far[2]) / h**2, rtol=1e-5)


@jax.jit
def integral(lens, field):
    """Throughput and spot size of a beam that ends where rays begin to fail, in polar coordinates
    on a plane in front of the lens; its edge is found by bisection."""
    direction = jnp.stack([0 * field, jnp.sin(field), jnp.cos(field)])
    angle = 2 * np.pi * np.arange(64) / 64
    toward = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=1)

    def trace(toward, radius):
        start = jnp.append(radius * toward, -5.0) - jnp.array([0.0, 1.3, 0.0])
        hits, good = trace_snell(lens, jnp.asarray(GREEN[0]), start, direction)
        return hits[:, :2], good

    def edge(toward):
        def narrow(_, ends):
            middle = (ends[0] + ends[1]) / 2
            good = trace(toward, middle)[1]
            return jnp.where(good, middle, ends[0]), jnp.where(good, ends[1], middle)

        return jax.lax.fori_loop(0, 52, narrow, (0.0, 12.0))[0]

    def node(point):
        radius = jnp.linalg.norm(point)
        hits, _ = trace(point / radius, radius)
        return hits[lens.stop], hits[-1]

    t, weight = np.polynomial.legendre.leggauss(24)
    radius = jax.vmap(edge)(toward)[:, None] * jnp.asarray(1 + t)[None] / 2
    points = radius[..., None] * toward[:, None]
    turn, spot = jax.vmap(jax.vmap(jax.jacfwd(node, has_aux=True)))(points)
    area = (
        abs(jnp.linalg.det(turn)) * radius**2 / jnp.asarray(1 + t)[None] * jnp.asarray(weight)[None]
    )
    area = area * (2 * np.pi / 64)
    mean = jnp.tensordot(area, spot, 2) / jnp.sum(area)
    square = jnp.sum((spot - mean[None, None]) ** 2, axis=-1)
    share = jnp.sum(area) / (np.pi * lens.semi_diameter[lens.stop] ** 2)
    return jnp.stack([share, jnp.sqrt(jnp.sum(area * square) / jnp.sum(area))])


@pytest.mark.slow
def test_a_thin_gap_inside_of_a_lens():
    """The air between two lenses ends 7 mm off the axis: throughput and spot of a wider beam at a
    field, and their derivatives by the gap."""
    surfaces = [
        {"radius": 30.0, "thickness": 6.0, "index": 1.6, "semi_diameter": 4.0},
        {"radius": 60.0, "thickness": 0.3, "semi_diameter": 4.0},
        {"radius": 200.0, "thickness": 2.0, "index": 1.7, "semi_diameter": 4.0},
        {"radius": 60.0, "thickness": 4.0, "semi_diameter": 4.0},
        {"radius": "inf", "semi_diameter": 12.0, "stop": True},
    ]
    lens, field = load_lens({"surfaces": surfaces, "sensor": 60.0}), 0.1
    semi = jnp.full(6, jnp.inf).at[4].set(12.0)
    lens = dataclasses.replace(lens, semi_diameter=semi)
    rule = drt_jax.converge(drt_jax.psf_moments, lens, Scene.point(field, jnp.inf, GREEN), 1e-6)
    assert rule.order <= 8

    def moved(gap):
        return dataclasses.replace(lens, thickness=lens.thickness.at[1].set(gap))

    @jax.jit
    def ours(gap):
        found = drt_jax.psf_moments(moved(gap), Scene.point(field, jnp.inf, GREEN), sampling=rule)
        return jnp.stack([found.throughput[0], jnp.sqrt(jnp.trace(found.covariance[0]))])

    h = 1e-3
    wanted = integral(moved(0.3), field)
    assert 0.2 < wanted[0] < 0.6
    np.testing.assert_allclose(ours(0.3), wanted, rtol=1e-6)
    f = [integral(moved(0.3 + s * h), field) for s in (-2, -1, 1, 2)]
    difference = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)
    np.testing.assert_allclose(jax.jit(jax.jacrev(ours))(0.3), difference, rtol=1e-5)


def test_crossings_are_sought_only_where_there_may_be_some():
    """Not in camera lenses with rims on all surfaces, which halves the time of the search."""
    assert not any(may_cross(load_lens(n)) for n in ("camera_50mm", "phone", "double_gauss"))
    assert may_cross(wide(25.0))
    tilted = dataclasses.replace(load_lens("singlet"), tilt=jnp.zeros((4, 3)).at[1, 0].set(0.01))
    assert may_cross(tilted)
