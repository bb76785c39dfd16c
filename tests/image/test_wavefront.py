"""Optical path differences: closed forms, Snell's oracle, finite differences, failed rays.

CODE V's printed digits are in test_reference_cases.py.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Status, load_lens, trace_snell
from drt_jax.pupil import rules as pupil
from drt_jax.image import wavefront

WAVE = 0.55
HEIGHTS = np.stack([np.zeros(5), np.linspace(-1, 1, 5)], axis=1)
POINTS = np.array([[0.0, 0.0], [0.0, 1.0], [0.5, -0.6], [0.9, 0.0], [-0.4, 0.7]])


def ellipsoid(gap):
    """n = 1.5, R = 10, k = -1/n^2: focus at 30 mm, for any aperture; the stop `gap` before it.
    Its front focus is 20 mm before the vertex."""
    surfaces = [
        {"curvature": 0, "thickness": gap, "semi_diameter": 6.0, "stop": True},
        {"radius": 10, "conic": -1 / 1.5**2, "index": 1.5, "thickness": 30.0},
    ]
    return load_lens({"surfaces": surfaces})


def paraboloid(gap):
    """Mirror of f = 50, the stop `gap` before it (its front focus is at 50)."""
    surfaces = [
        {"curvature": 0, "thickness": gap, "semi_diameter": 20.0, "stop": True},
        {"radius": -100, "conic": -1, "mirror": True, "thickness": -50.0},
    ]
    return load_lens({"surfaces": surfaces})


# name: lens, index and focal distance of its image space
PERFECT = {"ellipsoid": (ellipsoid, 1.5, 30.0), "paraboloid": (paraboloid, 1.0, 50.0)}


@pytest.mark.parametrize("name", PERFECT)
def test_defocus_of_a_perfect_image(name):
    """Exit pupil before, behind and infinitely far from the sensor. A ray at the angle u leaves
    the focus F; the sphere of radius R round C, d beyond F along the light, is met by it at
    d cos u -+ sqrt(R^2 - d^2 sin^2 u) from F: OPD = n (d - R - d cos u +- sqrt(...)), for
    R infinite n d (1 - cos u). In focus 0. Tolerance 1e-9 waves, some 1e-15 of the path."""
    make, n, focal = PERFECT[name]
    front = focal / n  # where a stop is imaged to infinity
    lenses = []
    for gap in (front / 4, front, 3 * front):
        lens = make(gap)
        lenses += [dataclasses.replace(lens, sensor=lens.sensor + d) for d in (0.0, -0.3, 0.4)]
    stack = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lenses)
    waves, hits = jax.jit(
        jax.vmap(
            lambda lens: (
                wavefront(lens, 0.0, np.inf, [WAVE], HEIGHTS),
                drt_jax.trace_rays(lens, 0.0, np.inf, [WAVE], HEIGHTS).points[0],
            )
        )
    )(stack)
    assert np.all(waves.status == Status.OK)
    for k, lens in enumerate(lenses):
        gap, sense = float(lens.thickness[0]), int(lens.senses[-1])
        d = sense * (float(lens.sensor) - gap) - focal
        # Newton's formula: the stop at x before the front focus is imaged f f' / x behind F.
        x = gap - front
        step = np.asarray(hits[k, :, 2] - hits[k, :, 1])
        cosine = np.abs(step[:, 2]) / np.linalg.norm(step, axis=1)
        if abs(x) < 1e-9:
            wanted = n * d * (1 - cosine)
        else:
            radius = d - front * focal / x
            root = np.sign(radius) * np.sqrt(radius**2 - d**2 * (1 - cosine**2))
            wanted = n * (d - radius - d * cosine + root)
        np.testing.assert_allclose(waves.opd[k, 0], wanted / (WAVE * 1e-3), atol=1e-9)


def test_off_axis_against_snell():
    """Paths summed up along the rays of the sequential trace from a plane wave, and the sphere
    met by solving its quadratic equation, in NumPy: 3e-9 waves of 300,000, 1e-14 of them."""
    lens = load_lens("double_gauss")
    field, wavelengths = np.radians(10.0), (0.6, 0.48)
    wave = wavefront(lens, field, np.inf, wavelengths, POINTS)
    rays = drt_jax.trace_rays(lens, field, np.inf, wavelengths, POINTS)
    d = jnp.array([0.0, np.sin(field), np.cos(field)])
    snell = jax.jit(jax.vmap(trace_snell, (None, None, 0, None)))
    pupil_z = lens.vertices[-1] + drt_jax.exit_pupil(lens, jnp.array(wavelengths)).position
    for k, wavelength in enumerate(wavelengths):
        index = np.asarray(lens.index(jnp.array([wavelength])))[:, 0]
        start = rays.points[k, :, 0] - 9 * d
        hits = np.asarray(snell(lens, wavelength, start, d)[0])
        length = np.linalg.norm(np.diff(hits, axis=1), axis=2)
        path = 9 + start @ d + length @ index[1:]
        leaving = (hits[:, -1] - hits[:, -2]) / length[:, -1:]
        chief, e = leaving[0], hits[:, -1] - hits[0, -1]
        radius = (lens.sensor - pupil_z[k]) / chief[2]
        along = np.sum(e * leaving, axis=1)
        back = along + np.sqrt(along**2 + radius**2 - np.sum(e**2, axis=1))
        to_sphere = path - back
        wanted = (to_sphere[0] - to_sphere) / (wavelength * 1e-3)
        np.testing.assert_allclose(wave.opd[k], wanted, atol=3e-9)
        np.testing.assert_allclose(wave.image[k], hits[0, -1, :2], atol=1e-11)
    assert wave.opd[0, 0] == 0 and np.max(np.abs(wave.opd)) > 1


def test_a_tilted_sensor_through_the_focus_changes_nothing():
    """All rays of the ellipsoid meet in one point, which the sensor contains however it leans."""
    surfaces = [
        {"curvature": 0, "thickness": 5.0, "semi_diameter": 6.0, "stop": True},
        {"radius": 10, "conic": -1 / 1.5**2, "index": 1.5, "thickness": 30.0},
    ]
    lens = load_lens({"surfaces": surfaces, "sensor_tilt": [5.0, -8.0, 20.0]})
    wave = wavefront(lens, 0.0, np.inf, [WAVE], POINTS)
    np.testing.assert_allclose(wave.opd, 0, atol=1e-9)


def test_gradients_in_both_modes_and_on_axis():
    """Reverse and forward mode agree to rounding, and with central differences to 1e-6; all
    finite, also on axis, where rays and errors vanish."""
    lens = load_lens("cooke_triplet")

    def merit(lens, field, forward):
        wave = wavefront(lens, field, 5000.0, [WAVE], POINTS, forward)
        return jnp.sum(wave.opd * jnp.array([3.0, 1.0, -2.0, 1.5, 0.5]))

    way = dataclasses.replace(
        jax.tree.map(jnp.zeros_like, lens),
        curvature=jnp.linspace(1, 2, 6) * 1e-7,
        thickness=jnp.linspace(2, 1, 5) * 1e-5,
        sensor=jnp.array(2e-5),
    )

    @jax.jit
    def all_three(field):
        gradient = jax.grad(merit, (0, 1))(lens, field, False)
        _, tangent = jax.jvp(lambda s, f: merit(s, f, True), (lens, field), (way, 1e-6))
        moved = [jax.tree.map(lambda a, b: a + s * b, lens, way) for s in (-1, 1)]
        low, high = (merit(m, field + s * 1e-6, False) for m, s in zip(moved, (-1, 1)))
        return gradient, tangent, (high - low) / 2

    for field in (0.15, 0.0):
        gradient, tangent, difference = all_three(field)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
        pairs = zip(jax.tree.leaves(gradient[0]), jax.tree.leaves(way))
        reverse = sum(np.sum(np.asarray(a) * b) for a, b in pairs) + gradient[1] * 1e-6
        np.testing.assert_allclose(reverse, tangent, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(reverse, difference, rtol=1e-6, atol=1e-8)


def test_failed_rays_have_a_status_and_change_no_other():
    lens = load_lens("singlet")
    steep = dataclasses.replace(lens, semi_diameter=jnp.array([24.0, 15.0, jnp.inf]))
    heights = np.stack([np.zeros(9), np.linspace(-1, 1, 9)], axis=1)

    def opd(lens):
        wave = wavefront(lens, 0.0, np.inf, [WAVE], heights)
        return jnp.sum(wave.opd**2), wave

    gradient, wave = jax.jit(jax.grad(opd, has_aux=True))(steep)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    status = np.asarray(wave.status[0])
    assert status[0] == Status.MISSED and status[4] == Status.OK
    assert np.any(status == Status.CLIPPED)
    assert np.all(wave.opd[0, status != Status.OK] == 0)
    weights = np.where(status == Status.OK, 1.0, 7.0)
    good = np.asarray(wave.opd[0, status == Status.OK])
    np.testing.assert_allclose(drt_jax.rms_wavefront(wave, weights), np.std(good), rtol=1e-12)


def test_failed_chief_ray():
    """Light of a near object point inside n = 1.5: at the centre of the stop it is too steep for
    the plane behind it, lower it is not. Without a chief ray there is no reference sphere."""
    glass, air = {"curvature": 0, "index": 1.5}, {"curvature": 0, "index": 1.0}
    stop = glass | {"thickness": 10.0, "semi_diameter": 8.0, "stop": True}
    surfaces = [stop, air | {"thickness": 30.0}]
    lens = load_lens({"object": {"index": 1.5}, "surfaces": surfaces})
    points = [[0.0, -1.0], [0.0, -0.9], [0.0, 0.0]]
    rays = drt_jax.trace_rays(lens, np.radians(43.0), 20.0, [WAVE], points)
    assert rays.status[0].tolist() == [Status.OK, Status.OK, Status.TIR]
    wave = wavefront(lens, np.radians(43.0), 20.0, [WAVE], points)
    assert np.all(wave.status == Status.TIR) and np.all(wave.opd == 0)
    assert np.all(wave.image == 0)


def test_rms_of_pure_defocus():
    """W = a r^2 over the disc has the standard deviation a / sqrt(12)."""
    points, weights = pupil.disc(4, 5)
    opd = 0.7 * jnp.sum(jnp.asarray(points) ** 2, axis=0)[None]
    wave = drt_jax.Wavefront(opd, jnp.zeros(opd.shape, jnp.int32), jnp.zeros((1, 2)))
    np.testing.assert_allclose(drt_jax.rms_wavefront(wave, weights), 0.7 / np.sqrt(12), rtol=1e-12)
