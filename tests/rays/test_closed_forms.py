"""Stigmatic surfaces and closed forms (C18, C19, P11 of the reference cases), to 1e-12."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, Status, load_lens, trace_rays

from .traced import behind_stop, directions, on_y

INF = np.inf
HEIGHTS = np.linspace(-1, 1, 7)
STIGMATIC = {
    # name: surfaces behind the stop plane up to the focus, its semi-diameter, its distance
    "ellipsoid": (
        [{"radius": 10, "conic": -1 / 1.5**2, "index": 1.5, "thickness": 30.0}],
        6.0,
        5.0,
    ),
    "hyperboloid": (
        [
            {"radius": INF, "index": 1.5, "thickness": 5.0},
            {"radius": -25, "conic": -(1.5**2), "thickness": 50.0},
        ],
        12.0,
        5.0,
    ),
    "paraboloid": (
        [{"radius": -100, "conic": -1, "mirror": True, "thickness": -50.0}],
        40.0,
        60.0,
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("gap", [1, 0, -0.1])
@pytest.mark.parametrize("name", STIGMATIC)
def test_c18_stigmatic_surfaces(name, gap):
    """All rays meet in the focus, and their errors depend neither on the pupil coordinates nor on
    the position of the stop, which may touch or cross the surface."""
    surfaces, aperture, far = STIGMATIC[name]
    lens = behind_stop(surfaces, gap * far, aperture)

    def errors(lens, pupil):
        return trace_rays(lens, Scene.point(0.0, INF, [0.55]), pupil).points[0, :, -1, :2]

    value, slope = jax.jit(lambda lens, p: (errors(lens, p), jax.jacrev(errors, 1)(lens, p)))(
        lens, on_y(*HEIGHTS)
    )
    np.testing.assert_allclose(value, 0, atol=1e-12)
    np.testing.assert_allclose(slope, 0, atol=1e-12)


@pytest.mark.slow
def test_c18_aplanatic_point():
    """Object in n = 1.5 at R (1 + 1/n): virtual image 25 mm in front of the vertex, sine ratio
    1.5."""
    tangents = np.tan(np.radians([5.0, 20.0, -20.0]))
    lens = behind_stop(
        [{"radius": -10, "index": 1.0, "thickness": 5.0}], 5.0, 1.0, object={"index": 1.5}
    )
    distance = 50 / 3 - 5  # to the stop plane

    def image(pupil):
        points = trace_rays(lens, Scene.point(0.0, distance, [0.55]), pupil).points[0]
        step = points[:, 2] - points[:, 1]
        at = points[:, 2, :2] + step[:, :2] / step[:, 2:] * (5 - 25 - points[:, 2, 2:])
        return at, points

    pupil = on_y(*(tangents * distance))
    at, points = image(pupil)
    np.testing.assert_allclose(at, 0, atol=1e-12)
    slope = jax.jit(jax.jacrev(lambda p: image(p)[0]))(pupil)
    np.testing.assert_allclose(slope, 0, atol=1e-12)
    sines = directions(np.asarray(points))[:, :, 1]
    np.testing.assert_allclose(sines[:, 0], np.sin(np.arctan(tangents)), atol=1e-12)
    np.testing.assert_allclose(sines[:, 0] / sines[:, 1], 1.5, atol=1e-12)


@pytest.mark.slow
def test_c19_plane_parallel_plate():
    """10 mm of n = 1.5 shift a ray at 30 degrees by 3.8762756430420553 mm."""
    plate = [{"radius": INF, "index": 1.5, "thickness": 10.0}, {"radius": INF, "thickness": 20.0}]
    lens = behind_stop(plate, 10.0, 5.0)
    ray = trace_rays(lens, Scene.point(np.pi / 6, INF, [0.55]), on_y(0.2)).points[0, 0]
    straight = ray[0, 1] + np.tan(np.pi / 6) * 40.0
    shift = (straight - ray[-1, 1]) / np.tan(np.pi / 6)
    np.testing.assert_allclose(shift, 3.8762756430420553, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(
    "front, back, thickness, wanted", [(5, -5, 10, 7.5), (50, -50, 10, 51.72413793103448)]
)
def test_c19_ball_lens_and_thick_lens(front, back, thickness, wanted):
    """n D / (4 (n - 1)) and the lensmaker's formula; and Fermat rays close to the axis."""
    lens = behind_stop(
        [{"radius": front, "index": 1.5, "thickness": thickness}, {"radius": back, "thickness": 9}],
        1.0,
        1.0,
    )
    ours = drt_jax.focal_length(lens, jnp.array([0.55]))
    np.testing.assert_allclose(ours, wanted, atol=1e-12)
    points = np.asarray(trace_rays(lens, Scene.point(0.0, INF, [0.55]), on_y(1e-4)).points[0])
    slope = directions(points)[0, -1, 1]
    np.testing.assert_allclose(-1e-4 / slope, wanted, rtol=1e-7)


@pytest.mark.slow
def test_c19_critical_angle():
    """A plane from n = 1.5 into air reflects totally from 41.810314895778596 degrees on."""
    lens = behind_stop(
        [{"radius": INF, "index": 1.0, "thickness": 5.0}], 5.0, 1.0, object={"index": 1.5}
    )
    critical = np.radians(41.810314895778596)
    for angle, wanted in ((critical - 1e-6, Status.OK), (critical + 1e-6, Status.TIR)):
        rays = trace_rays(lens, Scene.point(angle, INF, [0.55]), on_y(0.0))
        assert rays.status.item() == wanted


@pytest.mark.parametrize("gap", [None, 60.0, 0.0, -3.0])
def test_p11_defocused_paraboloid(cases, gap):
    """Variances to 1e-12, and their derivative by the defocus, for a stop on the mirror, or a plane
    in front of it, through it (the rim lies 2 mm in front of the vertex) or behind it."""
    mirror = {"radius": -100, "conic": -1, "mirror": True}
    if gap is None:
        lens = load_lens(
            {"surfaces": [mirror | {"stop": True, "semi_diameter": 20.0}], "sensor": -50.0}
        )
    else:
        lens = behind_stop([mirror | {"thickness": -50.0}], gap, 20.0)

    def variance(defocus):
        moved = dataclasses.replace(lens, sensor=lens.sensor - defocus)
        spot = drt_jax.psf_moments(
            moved, Scene.point(0.0, INF, [0.55]), sampling=drt_jax.Gauss(14, "rotational")
        )
        return spot.covariance[0, 1, 1]

    both = jax.jit(jax.value_and_grad(variance))
    for text, wanted in cases["P11"]["reference"]["variance_per_axis"].items():
        defocus = float(text.split("=")[1])
        ours, slope = both(defocus)
        np.testing.assert_allclose(ours, wanted, rtol=1e-12)
        np.testing.assert_allclose(slope, 2 * wanted / defocus, rtol=1e-11)
