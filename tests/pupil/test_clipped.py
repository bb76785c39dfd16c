"""The pupil that clear apertures leave, compared with geometry and sums of many rays."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Clipped, Gauss, Scene, Soft, focus_moments, load_lens, psf_moments, trace_rays
from drt_jax.pupil import hexapolar

from ..known import freed

GREEN = (0.53,)
FAR = 25000.0


def clipped(front, rear):
    """The Double Gauss with smaller front and rear apertures."""
    lens = load_lens("double_gauss")
    semi = lens.semi_diameter.at[0].set(front).at[10].set(rear)
    return freed(dataclasses.replace(lens, semi_diameter=semi))


# Field (radians along y, or x and y) and clear apertures; what is left of the pupil is round, has
# one corner a side or two, and lies anywhere.
SCENES = {
    "on axis": (0.0, clipped(12.0, 21.0)),
    "front": (np.radians(10), clipped(22.0, 21.6)),
    "front and rear": (np.radians(14), clipped(22.0, 14.5)),
    "any direction": ((0.1, 0.17), clipped(22.0, 16.0)),
}


def found(name, order):
    field, lens = SCENES[name]
    rule = Clipped(order, drt_jax.pupil.symmetry_of(lens, field))
    return focus_moments(lens, Scene.point(field, FAR, GREEN), sampling=rule)


@pytest.mark.slow
def test_overlap_of_two_discs():
    """The overlap of two shifted discs: area, centroid and second moments in closed form, here from
    a dense integral over y of the chord (with a substitution that makes it smooth)."""
    lens = load_lens(
        {
            "surfaces": [
                {"radius": "inf", "semi_diameter": 1.0, "thickness": 20.0, "index": 1.5},
                {"radius": "inf", "semi_diameter": 1.0, "stop": True},
            ],
            "sensor": 21.0,
        }
    )
    tilt = np.arcsin(1.5 * np.sin(np.arctan(0.7 / 20)))  # in the glass: 0.7 mm over 20 mm
    moments = focus_moments(
        lens, Scene.point(tilt, jnp.inf, [0.55]), sampling=Clipped(10, "bilateral")
    )
    half = 0.35  # the front aperture, seen from the stop, lies 0.7 above it
    angle = np.arccos(half)
    area = 2 * (angle - half * np.sin(angle))
    np.testing.assert_allclose(moments.throughput, area / np.pi, rtol=1e-12)
    # y about the middle of the overlap; chord of the lower or the upper disc
    nodes, weights = np.polynomial.legendre.leggauss(60)
    edge = 1 - half
    t = np.pi / 4 * (nodes + 1)  # y = edge sin t: the square root at the tip becomes smooth
    y = edge * np.sin(t)
    chord = 2 * np.sqrt(1 - (half + y) ** 2) * edge * np.cos(t) * np.pi / 4 * weights
    yy = 2 * np.sum(chord * y**2) / area
    xx = 2 * np.sum(chord * (1 - (half + y) ** 2) / 3) / area
    # On the stop; the light then goes on as a plane wave, so that the moments stay.
    spot = moments.at(lens.sensor)
    mean, spread = spot.mean, np.diagonal(spot.covariance, 0, 1, 2)
    np.testing.assert_allclose(spread[0], [xx, yy], rtol=1e-11)
    np.testing.assert_allclose(mean[0, 1] - np.tan(tilt) * 1.0, half, rtol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_converges_like_an_open_pupil(name):
    exact = found(name, 20)
    assert np.min(exact.throughput) > 0.3 and np.max(exact.throughput) < 0.95
    size = np.sum(np.asarray(exact.spread)[0, :, :2], axis=-1)
    for order, error in ((8, 1e-5), (12, 1e-9)):
        ours = found(name, order)
        change = np.abs(ours.spread[0] - exact.spread[0]) / size[:, None]
        assert np.max(change) < error
        np.testing.assert_allclose(ours.throughput, exact.throughput, rtol=1e-8)
        np.testing.assert_allclose(ours.mean, exact.mean, atol=error * np.sqrt(size.max()) + 1e-13)


@pytest.mark.slow
def test_agrees_with_many_rays_that_drop_out():
    """A grid of 300 x 300 rays without those that are clipped: they agree within the error of the
    grid."""
    field, lens = SCENES["front and rear"]
    side = np.linspace(-1, 1, 301)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    grid = grid[np.sum(grid**2, axis=1) <= 1]
    rays = trace_rays(lens, Scene.point(field, FAR, GREEN), grid)
    hits = np.asarray(rays.points[0, :, -1, :2])[np.asarray(rays.status[0]) == 0]
    moments = found("front and rear", 12)
    spot = moments.at(lens.sensor)
    mean, spread = spot.mean, np.diagonal(spot.covariance, 0, 1, 2)
    np.testing.assert_allclose(moments.throughput[0], len(hits) / len(grid), rtol=2e-3)
    np.testing.assert_allclose(spread[0], hits.var(axis=0), rtol=3e-3)
    np.testing.assert_allclose(mean[0], hits.mean(axis=0), atol=2e-3 * np.sqrt(spread.max()))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["on axis", pytest.param("front and rear", marks=pytest.mark.slow)]
)
def test_gradients_follow_the_boundary(name):
    """Compared with fourth-order differences of the value, also by the semi-diameters."""
    field, lens = SCENES[name]
    weights = jnp.array([1.0, 0.3, 0.3, 0.7])
    rule = Clipped(10, drt_jax.pupil.symmetry_of(lens, field))

    @jax.jit
    def blur(lens):
        moments = drt_jax.psf_moments(lens, Scene.point(field, FAR, GREEN), sampling=rule)
        mean, covariance = moments.mean, moments.covariance
        return 1e3 * covariance.ravel() @ weights + mean[0, 1]

    gradient = jax.jit(jax.grad(blur))(lens)
    for leaf, k in (
        ("curvature", 2),
        ("thickness", 4),
        ("semi_diameter", 0),
        ("semi_diameter", 10),
        ("semi_diameter", 5),
    ):
        value = getattr(lens, leaf)
        h = 1e-4 * max(abs(float(value[k])), 1e-2)
        away = lambda s: dataclasses.replace(lens, **{leaf: value.at[k].add(s)})  # noqa: E731
        f = [float(blur(away(s * h))) for s in (-2, -1, 1, 2)]
        difference = (f[0] - 8 * f[1] + 8 * f[2] - f[3]) / (12 * h)
        np.testing.assert_allclose(getattr(gradient, leaf)[k], difference, rtol=1e-6, atol=1e-10)


@pytest.mark.slow
def test_the_rule_that_a_clipped_scene_needs():
    field, lens = SCENES["on axis"]
    assert isinstance(
        drt_jax.converge(drt_jax.psf_moments, lens, Scene.point(field, FAR, GREEN), 1e-4), Clipped
    )


@pytest.mark.slow
def test_one_rule_for_a_clipped_field_and_the_axis():
    """It is a clipped rule, also for the field without clipping."""
    field, lens = SCENES["front"]
    rule = drt_jax.converge(
        drt_jax.psf_moments, lens, Scene.grid([[0.0, 0.0], [0.0, field]], FAR, GREEN), 1e-4
    )
    assert isinstance(rule, Clipped)
    for angle in (0.0, field):
        ours, exact = (
            psf_moments(lens, Scene.point(angle, FAR, GREEN), sampling=r) for r in (rule, 1e-6)
        )
        np.testing.assert_allclose(ours.covariance, exact.covariance, rtol=2e-4, atol=1e-12)


@pytest.mark.slow
def test_soft_edge_tends_to_the_hard_one_and_has_gradients():
    @jax.jit
    def passed(lens, width):
        rule = Soft(40, "rotational", width)
        return focus_moments(lens, Scene.point(0.0, FAR, GREEN), sampling=rule).throughput[0]

    lens, h = clipped(12.0, 21.0), 1e-4
    hard = found("on axis", 10).throughput[0]
    errors = [abs(float(passed(lens, width) - hard)) for width in (1.0, 0.5, 0.25)]
    assert errors[2] < errors[1] / 2 < errors[0] / 4 and errors[2] < 0.01
    slope = jax.jit(jax.grad(passed))(lens, 0.5).semi_diameter
    moved = [clipped(12.0 + s, 21.0) for s in (h, -h)]
    difference = (passed(moved[0], 0.5) - passed(moved[1], 0.5)) / (2 * h)
    np.testing.assert_allclose(slope[0], difference, rtol=1e-6)
    with pytest.raises(ValueError, match="width: expected a number above 0 mm, got 0"):
        Soft(4, "bilateral", 0.0)


@pytest.mark.slow
def test_a_pupil_that_paraxial_optics_does_not_find():
    """A fisheye at 85 degrees, whose paraxial entrance pupil is far from the real one: all rays
    start from the nearest ray of a fan, and the rule finds the unvignetted stop."""
    lens, field, green = load_lens("fisheye_8mm"), np.radians(85.0), (0.55,)
    ours = psf_moments(lens, Scene.point(field, jnp.inf, green), sampling=Clipped(10, "bilateral"))
    theirs = psf_moments(lens, Scene.point(field, jnp.inf, green), sampling=Gauss(14, "bilateral"))
    np.testing.assert_allclose(ours.throughput, 1, rtol=1e-12)
    np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-6, atol=1e-12)
    rays = trace_rays(lens, Scene.point(field, jnp.inf, green), hexapolar(8)[0])
    assert np.all(rays.status == 0) and rays.newton_steps < 20


@pytest.mark.slow
def test_gradients_in_float32_are_those_in_float64():
    """In reverse mode, where the tangents of missing corners are unbounded. With optimised machine
    code, in which these were infinite."""

    def variance(lens):
        rule = Clipped(6, "bilateral")
        return psf_moments(lens, Scene.point(0.1, jnp.inf, GREEN), sampling=rule).covariance[
            0, 1, 1
        ]

    optimised = {"xla_backend_optimization_level": 3}
    gradient = jax.jit(jax.grad(variance), compiler_options=optimised)
    lens = freed(load_lens("singlet"))
    for semi in (3.0, 4.9, 5.1, 7.0):
        double = dataclasses.replace(lens, semi_diameter=lens.semi_diameter.at[1].set(semi))
        single = jax.tree.map(lambda a: a.astype(jnp.float32), double)
        wanted, found = gradient(double), gradient(single)
        for name in ("curvature", "thickness", "semi_diameter", "sensor"):
            ours, exact = np.asarray(getattr(found, name)), np.asarray(getattr(wanted, name))
            assert ours.dtype == np.float32
            np.testing.assert_allclose(ours, exact, rtol=0, atol=2e-4 * np.max(np.abs(exact)))
