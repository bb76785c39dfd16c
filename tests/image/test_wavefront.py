"""Optical path differences: closed forms, Snell's oracle, finite differences, failed rays.

CODE V's printed digits are in test_reference_cases.py.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.snell import trace_snell

import drt_jax
from drt_jax import Scene, Status, load_lens, pupil, rms_wavefront, wavefront
from drt_jax.image import wavefront as module
from drt_jax.lens.scene import checked_scene
from drt_jax.rays.known import Known

from ..known import search

WAVE = 0.55
HEIGHTS = np.stack([np.zeros(5), np.linspace(-1, 1, 5)], axis=1)
POINTS = np.array([[0.0, 0.0], [0.0, 1.0], [0.5, -0.6], [0.9, 0.0], [-0.4, 0.7]])


def ellipsoid(gap):
    """n = 1.5, R = 10, k = -1/n^2: focus at 30 mm, for any aperture; the stop is `gap` in front of
    it. The front focus is 20 mm in front of the vertex."""
    surfaces = [
        {"curvature": 0, "thickness": gap, "semi_diameter": 6.0, "stop": True},
        {"radius": 10, "conic": -1 / 1.5**2, "index": 1.5, "thickness": 30.0},
    ]
    return load_lens({"surfaces": surfaces})


def paraboloid(gap):
    """A mirror of f = 50 with the stop `gap` in front of it (the front focus is at 50)."""
    surfaces = [
        {"curvature": 0, "thickness": gap, "semi_diameter": 20.0, "stop": True},
        {"radius": -100, "conic": -1, "mirror": True, "thickness": -50.0},
    ]
    return load_lens({"surfaces": surfaces})


# name: lens, index and focal distance of its image space
PERFECT = {"ellipsoid": (ellipsoid, 1.5, 30.0), "paraboloid": (paraboloid, 1.0, 50.0)}


@pytest.mark.slow
@pytest.mark.parametrize("name", PERFECT)
def test_defocus_of_a_perfect_image(name):
    """The exit pupil is in front of, behind and infinitely far from the sensor.

    A ray at the angle u passes the focus F. The sphere of the radius R about C, which is d behind F
    along the light, intersects it at d cos u -+ sqrt(R^2 - d^2 sin^2 u) from F: OPD = n (d - R - d
    cos u +- sqrt(...)), for infinite R n d (1 - cos u). In focus it is 0. The tolerance is 1e-9
    waves, some 1e-15 of the path.
    """
    make, n, focal = PERFECT[name]
    front = focal / n  # where a stop is imaged to infinity
    for gap in (front / 4, front, 3 * front):
        focused = make(gap)
        # Rays along the axis meet the mirror or lens at their height on the stop.
        y = float(focused.semi_diameter[0]) * HEIGHTS[:, 1]
        sag = np.asarray(drt_jax.sag(focused, 1, 0.0, y))
        distance = focal * int(focused.senses[-1]) - sag
        cosine = np.abs(distance) / np.hypot(distance, y)
        # Newton's formula: the stop at x before the front focus is imaged f f' / x behind F.
        x = gap - front
        for move in (0.0, -0.3, 0.4):
            lens = dataclasses.replace(focused, sensor=focused.sensor + move)
            wave = wavefront(lens, Scene.point(0.0, np.inf, [WAVE]), HEIGHTS)
            assert np.all(wave.status == Status.OK)
            d = int(lens.senses[-1]) * (float(lens.sensor) - gap) - focal
            if abs(x) < 1e-9:
                wanted = n * d * (1 - cosine)
            else:
                radius = d - front * focal / x
                root = np.sign(radius) * np.sqrt(radius**2 - d**2 * (1 - cosine**2))
                wanted = n * (d - radius - d * cosine + root)
            np.testing.assert_allclose(wave.opd[0], wanted / (WAVE * 1e-3), atol=1e-9)


def searched(lens, scene, points):
    """The rays that `wavefront` traces; the chief ray is the first."""
    return search(lens, scene, tuple(jnp.append(0.0, p) for p in points.T))


def of_known(found):
    """`wavefront` of rays that are known: (lens, scene, points) -> Wavefront."""

    def trace(lens, scene, points):
        points = jnp.concatenate([jnp.zeros((1, 2)), points])
        return module._wavefront.__wrapped__(lens, scene, points, None, Known(found))

    return trace


@pytest.mark.slow
def test_off_axis_against_snell():
    """Paths are summed along the rays of the sequential trace from a plane wave, and the sphere is
    intersected by its quadratic equation, in NumPy: 3e-9 waves of 300,000, a relative error of
    1e-14."""
    lens = load_lens("double_gauss")
    field, wavelengths = np.radians(10.0), (0.6, 0.48)
    scene = checked_scene(lens, Scene.point(field, np.inf, wavelengths))
    found = searched(lens, scene, POINTS)
    wave = jax.jit(of_known(found))(lens, scene, jnp.asarray(POINTS))
    first = [h[0, :, 1:] for h in found.hits]  # without the chief ray
    first = np.stack([*first, drt_jax.sag(lens, 0, *first)], axis=-1)
    d = np.array([0.0, np.sin(field), np.cos(field)])
    snell = jax.jit(jax.vmap(trace_snell, (None, None, 0, None)))
    pupil_z = (
        lens.vertices[-2]
        + drt_jax.first_order(lens, jnp.inf, jnp.array(wavelengths)).exit_pupil.position
    )
    for k, wavelength in enumerate(wavelengths):
        index = np.asarray(lens.index(jnp.array([wavelength])))[:, 0]
        start = first[k] - 9 * d
        hits = np.asarray(snell(lens, jnp.asarray(wavelength, float), start, jnp.asarray(d))[0])
        length = np.linalg.norm(np.diff(hits, axis=1), axis=2)
        path = 9 + start @ d + length @ index[1:]
        leaving = (hits[:, -1] - hits[:, -2]) / length[:, -1:]
        chief, e = leaving[0], hits[:, -1] - hits[0, -1]
        radius = (float(lens.sensor) - float(pupil_z[k])) / chief[2]
        along = np.sum(e * leaving, axis=1)
        back = along + np.sqrt(along**2 + radius**2 - np.sum(e**2, axis=1))
        to_sphere = path - back
        wanted = (to_sphere[0] - to_sphere) / (wavelength * 1e-3)
        np.testing.assert_allclose(wave.opd[k], wanted, atol=3e-9)
        np.testing.assert_allclose(wave.image[k], hits[0, -1, :2], atol=1e-11)
    assert wave.opd[0, 0] == 0 and np.max(np.abs(wave.opd)) > 1


@pytest.mark.slow
def test_a_tilted_sensor_through_the_focus_changes_nothing():
    """All rays of the ellipsoid meet in one point, which the sensor contains for any tilt."""
    surfaces = [
        {"curvature": 0, "thickness": 5.0, "semi_diameter": 6.0, "stop": True},
        {"radius": 10, "conic": -1 / 1.5**2, "index": 1.5, "thickness": 30.0},
    ]
    lens = load_lens({"surfaces": surfaces, "sensor_tilt": [5.0, -8.0, 20.0]})
    wave = wavefront(lens, Scene.point(0.0, np.inf, [WAVE]), POINTS)
    np.testing.assert_allclose(wave.opd, 0, atol=1e-9)


@pytest.mark.slow
def test_gradients_in_both_modes_and_on_axis():
    """Reverse and forward mode agree to rounding, and with central differences to 1e-6; all are
    finite, also on axis, where field and errors are 0."""
    lens = load_lens("cooke_triplet")
    way = dataclasses.replace(
        jax.tree.map(jnp.zeros_like, lens),
        curvature=jnp.linspace(1, 2, lens.count + 1).at[-1].set(0) * 1e-7,
        thickness=jnp.linspace(2, 1, lens.count - 1) * 1e-5,
        sensor=jnp.array(2e-5),
    )

    @jax.jit
    def both(lens, field, found):
        trace = of_known(found)

        def merit(lens, field):
            wave = trace(
                lens, checked_scene(lens, Scene.point(field, 5000.0, [WAVE])), jnp.asarray(POINTS)
            )
            return jnp.sum(wave.opd * jnp.array([[3.0, 1.0, -2.0, 1.5, 0.5]]))

        value, gradient = jax.value_and_grad(merit, (0, 1))(lens, field)
        moving = way, jnp.asarray(1e-6)
        return value, gradient, jax.jvp(merit, (lens, field), moving)[1]

    def at(lens, field):
        found = searched(lens, checked_scene(lens, Scene.point(field, 5000.0, [WAVE])), POINTS)
        return both(lens, jnp.asarray(field), found)

    for field in (0.15, 0.0):
        _, gradient, tangent = at(lens, field)
        moved = [jax.tree.map(lambda a, b, s=s: a + s * b, lens, way) for s in (-1, 1)]
        low, high = (at(m, field + s * 1e-6)[0] for m, s in zip(moved, (-1, 1)))
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
        pairs = zip(jax.tree.leaves(gradient[0]), jax.tree.leaves(way), strict=True)
        reverse = sum(np.sum(np.asarray(a) * b) for a, b in pairs) + gradient[1] * 1e-6
        np.testing.assert_allclose(reverse, tangent, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(reverse, (high - low) / 2, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
def test_failed_rays_have_a_status_and_change_no_other():
    lens = load_lens("singlet")
    steep = dataclasses.replace(lens, semi_diameter=jnp.array([24.0, 15.0, jnp.inf, jnp.inf]))
    heights = np.stack([np.zeros(9), np.linspace(-1, 1, 9)], axis=1)
    scene = checked_scene(steep, Scene.point(0.0, np.inf, [WAVE]))

    @jax.jit
    def opd(lens, found):
        trace = of_known(found)

        def total(lens):
            wave = trace(lens, scene, jnp.asarray(heights))
            return jnp.sum(wave.opd**2), wave

        return jax.grad(total, has_aux=True)(lens)

    gradient, wave = opd(steep, searched(steep, scene, heights))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    status = np.asarray(wave.status[0])
    # At 24 mm the sphere is 5.9 mm deep, and the glass 4 mm thick.
    assert status[0] == Status.CROSSED and status[4] == Status.OK
    assert np.any(status == Status.CLIPPED)
    assert np.all(np.asarray(wave.opd)[0, status != Status.OK] == 0)
    weights = np.where(status == Status.OK, 1.0, 7.0)
    good = np.asarray(wave.opd)[0, status == Status.OK]
    np.testing.assert_allclose(rms_wavefront(wave, weights), np.std(good), rtol=1e-12)


@pytest.mark.slow
def test_failed_chief_ray():
    """Light of a near object point inside n = 1.5 is totally reflected at the plane behind the stop
    at its centre, but not lower on the stop. Without a chief ray there is no reference sphere."""
    glass, air = {"curvature": 0, "index": 1.5}, {"curvature": 0, "index": 1.0}
    stop = glass | {"thickness": 10.0, "semi_diameter": 8.0, "stop": True}
    surfaces = [stop, air | {"thickness": 30.0}]
    lens = load_lens({"object": {"index": 1.5}, "surfaces": surfaces})
    points = np.array([[0.0, -1.0], [0.0, -0.9], [0.0, 0.0]])
    scene = checked_scene(lens, Scene.point(np.radians(43.0), 20.0, [WAVE]))
    found = searched(lens, scene, points)
    assert found.status[0].tolist() == [Status.TIR, Status.OK, Status.OK, Status.TIR]
    wave = jax.jit(of_known(found))(lens, scene, jnp.asarray(points))
    assert np.all(wave.status == Status.TIR) and np.all(wave.opd == 0)
    assert np.all(wave.image == 0)


def test_rms_of_pure_defocus():
    """W = a r^2 over the disc has the standard deviation a / sqrt(12)."""
    points, weights = pupil.disc(4, 5)
    opd = 0.7 * jnp.sum(jnp.asarray(points) ** 2, axis=-1)[None]
    wave = drt_jax.results.Wavefront(opd, jnp.zeros(opd.shape, jnp.int32), jnp.zeros((1, 2)))
    np.testing.assert_allclose(rms_wavefront(wave, weights), 0.7 / np.sqrt(12), rtol=1e-12)
