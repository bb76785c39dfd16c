"""Kernels of the three models compared with independent sums: histograms of traced rays, direct
sums of plane waves, closed forms; and their derivatives compared with differences."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import j1

import drt_jax
from drt_jax import Sampling, Scene
from drt_jax.compilation import jit
from drt_jax.image import psf as module
from drt_jax.image.beam import beam_rule, centroid_and_variances, trace_beam
from drt_jax.image.beam_psf import ray_spots
from drt_jax.image.psf import difference
from drt_jax.lens.scene import checked_scene
from drt_jax.pupil import patterns

from ..known import check_slopes

WAVES = (0.6, 0.48)
PIXEL, SIZE = 4.4e-3, 21
FAR = 25e3
RULE = beam_rule(14, "bilateral")
RAYS, WAVE_MODEL = Sampling("rays", RULE, 64), Sampling("waves", RULE, 128)


@pytest.fixture(scope="module")
def double_gauss():
    return drt_jax.load_lens("double_gauss"), Scene.degrees(14.0, FAR, WAVES)


FIELD = np.radians(14.0)


def histogram(rays, weights, centre, size=SIZE):
    """Fractions (W, size, size) of the light of weighted hits (W, Q, 2) in the pixels."""
    edges = (np.arange(size + 1) - size / 2) * PIXEL
    return np.stack(
        [
            np.histogram2d(p[:, 1] - centre[1], p[:, 0] - centre[0], [edges, edges], weights=w)[0]
            for p, w in zip(rays, weights)
        ]
    )


def traced(lens, field, points):
    found = drt_jax.trace_rays(lens, Scene.point(field, FAR, WAVES), points)
    return np.asarray(found.points[:, :, -1, :2]), np.asarray(found.status) == 0


@pytest.mark.slow
def test_rays_are_the_histogram_of_traced_rays(double_gauss):
    lens = double_gauss[0]
    found = drt_jax.psf(*double_gauss, PIXEL, SIZE, sampling=RAYS)
    points, weights = patterns.sobol_disc(1 << 15)
    hits, good = traced(lens, FIELD, points)
    assert np.all(good)
    # 32,768 points in some 200 pixels: the error of each pixel is about 1 %.
    truth = histogram(hits, np.stack([weights, weights]), np.asarray(found.centre))
    assert difference(np.asarray(found.kernel), truth) < 2.5e-2


COOKE = drt_jax.load_lens("cooke_triplet")
RIM = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(6.5))
CUT = beam_rule(12, "bilateral", drt_jax.Clipped(8, "bilateral"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("field", "rule"), [(0.0, beam_rule(12, "rotational")), (0.3, CUT)], ids=["axis", "clipped"]
)
def test_sums_and_moments(field, rule):
    """For a model with more rays than it needs: its moments are those of the rays."""
    scene = RIM, Scene.point(field, FAR, WAVES)
    moments = drt_jax.psf_moments(*scene, sampling=rule.rule)
    sigma = float(jnp.sqrt(jnp.max(jnp.diagonal(moments.covariance, 0, 1, 2))))

    @jax.jit
    def spots(lens):
        beam = trace_beam(lens, checked_scene(lens, scene[1]), rule)
        hits, width, light = ray_spots(lens, beam, 48)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "trace_beam", lambda *_: beam)
            patch.setattr(module, "_psf", module._psf.__wrapped__)
            model = Sampling("rays", rule, 48)
            kernel = drt_jax.psf(lens, scene[1], sigma / 6, 161, sampling=model)
        return centroid_and_variances(hits, light), width, light, kernel

    (mean, variances), width, light, kernel = spots(RIM)
    np.testing.assert_allclose(mean.T, moments.mean, rtol=0, atol=1e-6 * sigma)
    for k, i, j in ((0, 0, 0), (1, 0, 1), (2, 1, 1)):
        own = np.sum(np.asarray(light * width[i] ** 2), -1) / np.sum(np.asarray(light), -1) / 7
        found = np.asarray(variances[k]) + own * (i == j)
        wanted = np.asarray(moments.covariance)[:, i, j]
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6 * sigma**2)
    np.testing.assert_allclose(jnp.sum(kernel.kernel, (1, 2)) + kernel.outside, 1, atol=1e-12)
    assert np.all(np.abs(np.asarray(kernel.outside)) < 1e-9)
    np.testing.assert_allclose(kernel.throughput, moments.throughput, rtol=1e-6)
    assert (field == 0) == bool(np.all(np.asarray(moments.throughput) > 1 - 1e-9))


@pytest.mark.slow
def test_no_light_comes_from_beside_a_narrow_pupil():
    """A corner of the camera lens, where 29 % of the light passes: far from the rays, polynomials
    of degree 12 seem to pass all apertures again. Compared with a histogram of 19,000 rays."""
    lens, field, pixel = drt_jax.load_lens("camera_50mm"), np.array([0.3, 0.3]), 0.02
    scene = lens, Scene.point(field, np.inf, (0.53,))
    rule = beam_rule(12, "none", drt_jax.Clipped(6, "none"))
    found = drt_jax.psf(*scene, pixel, SIZE, sampling=Sampling("rays", rule, 96))
    points, _ = patterns.sobol_disc(1 << 16)
    # This optimisation takes no longer to compile, and the code runs five times faster.
    often = {"xla_backend_optimization_level": 1}

    def traced(points):
        rays = drt_jax.trace_rays(*scene, points)
        return rays.status[0], rays.points[0, :, -1, :2]

    status, hits = map(np.asarray, jit(traced, often)(jnp.asarray(points)))
    good = status == 0
    place = (hits[good] - np.asarray(found.centre)) / pixel
    edges = np.arange(SIZE + 1) - SIZE / 2
    truth = np.histogram2d(place[:, 1], place[:, 0], [edges, edges])[0] / np.sum(good)
    np.testing.assert_allclose(found.throughput[0], np.mean(good), atol=3e-3)
    np.testing.assert_allclose(found.outside[0], 1 - np.sum(truth), atol=5e-3)
    assert np.sum(np.abs(np.asarray(found.kernel)[0] - truth)) < 0.04


@pytest.mark.slow
def test_waves_are_the_sum_of_plane_waves(double_gauss):
    lens, field = double_gauss[0], FIELD
    found = drt_jax.psf(*double_gauss, PIXEL, SIZE, sampling=WAVE_MODEL)
    # One plane wave for each ray of a fine Gauss rule; path differences to the sphere at infinity.
    points, weights = patterns.disc(40, 100)
    rays = drt_jax.trace_rays(lens, Scene.point(field, FAR, WAVES), points)
    for w, wavelength in enumerate(WAVES):
        wave = 2 * np.pi / (wavelength * 1e-3)
        hits = np.asarray(rays.points[w, :, -1, :2])
        d = np.asarray(rays.directions[w, :, -1, :2])
        path = np.asarray(rays.path[w]) - np.sum(d * hits, -1)
        area = _area(lens, field, wavelength, points)
        amplitude = np.sqrt(weights * np.pi * weights * area) * np.exp(1j * wave * path)
        nodes, node_weights = np.polynomial.legendre.leggauss(8)
        pixels = (np.arange(SIZE)[:, None] - (SIZE - 1) / 2 + nodes / 2) * PIXEL
        across, down = (
            np.exp(1j * wave * np.outer(pixels.ravel() + c, part))
            for c, part in zip(np.asarray(found.centre), d.T)
        )
        light = np.abs((down * amplitude) @ across.T) ** 2
        light = light.reshape(SIZE, 8, SIZE, 8) * node_weights[:, None, None] * node_weights / 4
        truth = light.sum((1, 3)) * (PIXEL / (wavelength * 1e-3)) ** 2
        assert np.abs(truth - np.asarray(found.kernel[w])).sum() < 3e-3


def _area(lens, field, wavelength, points):
    """|d(l, m) / d(x, y)| at points of the stop, by differences."""
    step = 1e-4
    moved = [
        drt_jax.trace_rays(lens, Scene.point(field, FAR, wavelength), points + np.array(s) * step)
        for s in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    right, left, up, down = (np.asarray(r.directions[0, :, -1, :2]) for r in moved)
    (a, b), (c, d) = ((right - left).T / (2 * step), (up - down).T / (2 * step))
    return np.abs(a * d - b * c)


def paraboloid(semi_diameter=1.0, sensor=50.0):
    """A mirror without aberrations for an object at infinity, f/25."""
    surface = {"radius": -100.0, "conic": -1.0, "mirror": True, "thickness": -sensor}
    surface |= {"stop": True, "semi_diameter": semi_diameter}
    return drt_jax.load_lens({"surfaces": [surface]})


def mirror_kernel(kind, lens, wavelength, pixel):
    """A kernel of 21 x 21 pixels; one program for each model."""
    model = Sampling(kind, beam_rule(10, "rotational"), 192)
    return np.asarray(
        drt_jax.psf(lens, Scene.point(0.0, np.inf, wavelength), pixel, SIZE, sampling=model).kernel[
            0
        ]
    )


@pytest.mark.slow
def test_waves_of_a_perfect_mirror_are_airys_pattern():
    pixel, wavelength = 2e-3, 0.5
    found = mirror_kernel("waves", paraboloid(), wavelength, pixel)
    nodes, weights = np.polynomial.legendre.leggauss(4)
    place = (np.arange(SIZE)[:, None] - SIZE // 2 + nodes / 2).ravel() * pixel
    x = np.pi * np.hypot(*np.meshgrid(place, place)) / (wavelength * 1e-3 * 25)
    airy = np.pi / 4 * (2 * j1(x) / x) ** 2 * (pixel / (wavelength * 1e-3 * 25)) ** 2
    airy = np.einsum("yixj,i,j->yx", airy.reshape(SIZE, 4, SIZE, 4), weights / 2, weights / 2)
    # The rest is the difference of tangents and sines at f/25.
    assert np.abs(found - airy).max() < 1e-3 * airy.max()
    assert abs(np.sum(found) - np.sum(airy)) < 1e-3


@pytest.mark.slow
def test_waves_come_to_rays_when_they_are_short():
    # A defocused disc; without glass, so that the rays do not depend on the wavelength.
    lens = paraboloid(sensor=55.0)
    rays = mirror_kernel("rays", lens, 0.5, 0.02)
    apart = [difference(rays, mirror_kernel("waves", lens, w, 0.02)) for w in (2.0, 0.5, 0.125)]
    assert apart[0] > 1.5 * apart[1] > 3 * apart[2]
    assert apart[2] < 0.2


@jax.jit
def slopes(lens, field, defocus):
    """All models from one beam: ((merit, kernels), gradient of the merit by lens and defocus)."""
    rule, draw = beam_rule(8, "bilateral"), np.random.default_rng(0)

    def merit(lens, defocus):
        beam = trace_beam(lens, checked_scene(lens, Scene.point(field, FAR, WAVES)), rule)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "trace_beam", lambda *_: beam)
            patch.setattr(module, "_psf", module._psf.__wrapped__)
            scene = lens, Scene.point(field, FAR, WAVES), PIXEL, SIZE
            place = {"centre": (0.0, 24.57), "defocus": defocus}
            found = [
                drt_jax.psf(*scene, sampling=Sampling(kind, rule, 48), **place)
                for kind in ("gaussian", "rays", "waves")
            ]
        sums = [jnp.sum(draw.normal(size=(2, SIZE, SIZE)) * one.kernel) for one in found]
        return sum(sums) + found[0].solid_angle[0], found

    return jax.value_and_grad(merit, (0, 1), has_aux=True)(lens, defocus)


@pytest.mark.slow
def test_derivatives_are_those_of_the_kernel(double_gauss):
    lens, field = double_gauss[0], jnp.array([0.0, FIELD])

    def of_lens(lens):
        found, gradient = slopes(lens, field, jnp.asarray(0.0))
        return found, gradient[0]

    check_slopes(of_lens, lens, {"curvature": 1e-9, "thickness": 1e-6, "sensor": 1e-6}, 2e-5)
    step = 1e-5
    focus = [slopes(lens, field, jnp.asarray(s * step))[0][0] for s in (-2, -1, 1, 2)]
    slope = (8 * (focus[2] - focus[1]) - (focus[3] - focus[0])) / (12 * step)
    gradient = slopes(lens, field, jnp.asarray(0.0))[1]
    np.testing.assert_allclose(gradient[1], slope, rtol=2e-5)


@pytest.mark.slow
def test_without_light_a_kernel_is_dark_and_its_slopes_are_nothing(double_gauss):
    (_, found), gradient = slopes(double_gauss[0], jnp.array([0.0, 1.4]), jnp.asarray(0.0))
    for one in found:
        parts = one.kernel, one.outside, one.throughput, one.solid_angle
        assert all(np.all(np.asarray(part) == 0) for part in parts)
    assert all(np.all(np.asarray(leaf) == 0) for leaf in jax.tree.leaves(gradient))


@pytest.mark.slow
def test_defocus_is_the_sensor_moved(double_gauss):
    lens, scene = double_gauss
    moved = dataclasses.replace(lens, sensor=lens.sensor + 0.05)
    one = drt_jax.psf(lens, scene, PIXEL, SIZE, sampling=WAVE_MODEL, defocus=0.05)
    two = drt_jax.psf(moved, scene, PIXEL, SIZE, sampling=WAVE_MODEL)
    np.testing.assert_allclose(one.centre, two.centre, atol=1e-12)
    np.testing.assert_allclose(one.kernel, two.kernel, atol=1e-9)


@pytest.mark.slow
def test_auto_says_how_good_the_gaussian_is(double_gauss):
    beside = "of the light falls outside a kernel of 21 x 21 pixels"
    with pytest.warns(UserWarning, match=beside) as said:
        model = drt_jax.converge(drt_jax.psf, *double_gauss, PIXEL, SIZE, "auto", 0.2)
    assert {one.filename for one in said} == {__file__}
    # Here the Gaussian differs from the waves by more than half of the light.
    assert 0.3 < model.errors["gaussian"] < 2
    assert model.kind != "gaussian"
    assert set(model.errors) == {"gaussian", "rays"}
    # Compared with finer waves, it keeps its tolerance.
    pair = (drt_jax.psf(*double_gauss, PIXEL, SIZE, sampling=m).kernel for m in (model, WAVE_MODEL))
    assert difference(*map(np.asarray, pair)) < 0.25


@pytest.mark.slow
def test_a_model_serves_inside_jit_and_vmap(double_gauss):
    lens, far, waves = double_gauss[0], FAR, WAVES
    fields = jnp.radians(jnp.array([[0.0, 5.0], [0.0, 12.0]]))
    model = RAYS

    @jax.jit
    def kernels(fields):
        return jax.vmap(
            lambda f: (
                drt_jax.psf(lens, Scene.point(f, far, waves), PIXEL, SIZE, sampling=model).kernel
            )
        )(fields)

    alone = drt_jax.psf(
        lens, Scene.point(fields[1], far, waves), PIXEL, SIZE, sampling=model
    ).kernel
    np.testing.assert_allclose(kernels(fields)[1], alone, atol=1e-12)
    with pytest.raises(ValueError, match="make the sampling outside"):
        jax.jit(lambda f: drt_jax.psf(lens, Scene.point(f, far, waves), PIXEL).kernel)(fields[0])
    # It is made for fields along y: at others, half of the pupil does not represent the whole.
    beside = jnp.radians(jnp.array([4.0, 3.0]))
    assert not np.any(kernels(jnp.stack([beside, fields[0]]))[0])
    several = Scene.radians(beside[None], far, waves)
    for call in (drt_jax.psf, lambda *a, **k: jax.jit(lambda: drt_jax.psf(*a, **k))()):
        with pytest.raises(ValueError, match="the rule is made for fields along y"):
            call(lens, several, PIXEL, SIZE, sampling=model)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixel": 0.0}, "pixel: must be above 0"),
        ({"size": 0}, "size: expected"),
        ({"kind": "airy", "sampling": 1e-2}, "kind: expected one of gaussian, rays, waves, auto"),
        ({"kind": "gaussian", "sampling": 2.0}, "sampling: expected a tolerance"),
        ({"kind": "gaussian"}, "kind: the sampling is of the kind 'rays', got 'gaussian'"),
        ({"centre": (0.0, 0.0, 0.0)}, "centre: expected x and y"),
    ],
)
def test_what_is_no_kernel_is_refused(double_gauss, change, message):
    named = {"pixel": PIXEL, "size": SIZE, "sampling": RAYS} | change
    with pytest.raises(ValueError, match=message):
        drt_jax.psf(*double_gauss, **named)


@pytest.mark.slow
def test_the_norm_of_a_tolerance(double_gauss):
    """The root of the sum of squares is smaller than the sum."""
    scene = *double_gauss, PIXEL, SIZE, "rays", 2e-2
    assert (
        drt_jax.converge(drt_jax.psf, *scene, 2).cells < drt_jax.converge(drt_jax.psf, *scene).cells
    )
    with pytest.raises(ValueError, match="norm: expected 1 or 2, got 3"):
        drt_jax.converge(drt_jax.psf, *scene, 3)


@pytest.mark.slow
def test_no_program_takes_several_matrices_to_lapack_at_once():
    """LAPACK's loop over matrices waits for XLA's threads inside one of them: two such loops never
    end."""
    lens, rule = drt_jax.load_lens("singlet"), beam_rule(4, "bilateral")
    model = drt_jax.Sampling("waves", rule, 8)

    def light(lens, field):
        found = drt_jax.psf(lens, Scene.point(field, FAR, WAVES), PIXEL, 3, sampling=model)
        return jnp.sum(found.kernel**2) + jnp.sum(found.solid_angle)

    fields = jnp.array([0.01, 0.02])
    many = jax.jit(jax.vmap(jax.value_and_grad(light), (None, 0)))
    text = many.lower(lens, fields).compile().as_text()
    calls = [line for line in text.splitlines() if re.search('target="(lapack|blas)_', line)]
    shapes = [re.search(r"f64\[([\d,]+)\]", line).group(1) for line in calls]
    assert shapes and all(s.count(",") < 2 or s.startswith("1,") for s in shapes), shapes
