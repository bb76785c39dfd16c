"""Off-axis conic mirrors, used from one focus to the other, compared with the definition of a
conic."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Scene, Status, load_lens, trace_rays

SOURCE, FAR = np.array([0.0, 0.0, -50.0]), 100.0
PUPIL = np.array([[0, 0], [0, 1], [0, -1], [0.6, -0.3], [-1, 0]], float)
Z = np.array([0.0, 0.0, 1.0])


def turned(degrees):
    """Direction of the chief ray behind the mirror."""
    return np.array([0.0, np.sin(np.radians(degrees)), np.cos(np.radians(degrees))])


def tilt(axis):
    """Tilt that rotates z to an axis in the y, z plane, degrees."""
    return [float(np.degrees(np.arctan2(-axis[1], axis[2]))), 0.0, 0.0]


def mirror(vertex, opening, radius, conic, sensor, leaving, semi, flipped):
    """A stop at z = 0, a conic mirror, and a sensor perpendicular to the chief ray. opening: unit
    vector from the vertex into the conic."""
    axis, radius = (-opening, -radius) if flipped else (opening, radius)
    rows = [
        {"radius": "inf", "semi_diameter": semi, "stop": True, "thickness": float(vertex[2])},
        {
            "radius": float(radius),
            "conic": float(conic),
            "mirror": True,
            "decentre": [0.0, float(vertex[1])],
            "tilt": tilt(axis),
        },
    ]
    place = {"sensor": float(sensor[2]), "sensor_decentre": [0.0, float(sensor[1])]}
    return load_lens({"surfaces": rows, "sensor_tilt": tilt(leaving), **place})


def from_focus(turn, q, semi, flipped=False):
    """The lens; and the exact hits of its rays on the mirror (Q, 3), directions behind it and paths
    to the sensor, which is 250 mm behind the mirror."""
    leaving, hit = turned(turn), SOURCE + FAR * Z
    d = np.concatenate([semi * PUPIL, np.full((len(PUPIL), 1), 50.0)], axis=1)
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    if np.isinf(q):
        focal, opening = FAR * (1 - leaving[2]) / 2, leaving
        vertex, radius, conic = SOURCE - focal * leaving, 2 * focal, -1.0
        points = SOURCE + (2 * focal / (1 - d @ leaving))[:, None] * d
        behind = np.broadcast_to(leaving, d.shape)
    else:
        other, total = hit + q * leaving, FAR + q
        line = other - SOURCE
        apart = np.linalg.norm(line)
        # Semi-axis and eccentricity; the vertex lies beside F1, or on its far side from F2.
        a, e = abs(total) / 2, apart / abs(total)
        near = total < 0 or q > 0  # the sheet about F1; else that about F2
        centre, axis = (SOURCE + other) / 2, line / apart
        vertex = centre - axis * a if near else centre + axis * a
        opening = axis * (-1 if near and q < 0 else 1)
        radius, conic = a * abs(1 - e**2), -(e**2)
        points = SOURCE + ((total**2 - apart**2) / (2 * (total - d @ line)))[:, None] * d
        behind = np.sign(q) * (other - points)
        behind /= np.linalg.norm(behind, axis=1, keepdims=True)
    sensor = hit + 250.0 * leaving
    lens = mirror(vertex, opening, radius, conic, sensor, leaving, semi, flipped)
    rest = ((sensor - points) @ leaving) / (behind @ leaving)
    path = np.linalg.norm(points - SOURCE, axis=1) + rest - 50.0
    return lens, points, behind, path


CASES = {
    **{f"paraboloid {turn}": (turn, np.inf, 2.5) for turn in (30, 60, 88, 90, 92, 120, 150)},
    **{f"ellipsoid {turn}": (turn, 200.0, 2.5) for turn in (30, 90, 150)},
    **{f"hyperboloid, convex {turn}": (turn, -60.0, 2.5) for turn in (30, 90, 150)},
    **{f"hyperboloid, concave {turn}": (turn, -300.0, 2.5) for turn in (30, 90, 150)},
    **{f"grazing by {turn / 2}": (turn, 300.0, 0.2 * turn) for turn in (0.2, 2, 10)},
}


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_rays_from_a_focus(name, flipped):
    lens, points, behind, path = from_focus(*CASES[name], flipped)
    rays = trace_rays(lens, Scene.point(0.0, 50.0, (0.55,)), PUPIL)
    np.testing.assert_array_equal(rays.status, Status.OK)
    np.testing.assert_allclose(rays.points[0, :, 1], points, atol=1e-10)
    np.testing.assert_allclose(rays.directions[0, :, -1], behind, atol=1e-12)
    np.testing.assert_allclose(rays.path[0], path, atol=1e-10)


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("turn", [30, 60, 90, 120, 150])
def test_a_beam_to_the_focus(turn, flipped):
    """Collimated light along the axis of a paraboloid meets in its focus."""
    leaving = turned(turn)
    focus, focal = 50.0 * Z + FAR * leaving, FAR * (1 - leaving[2]) / 2
    lens = mirror(focus + focal * Z, -Z, 2 * focal, -1.0, focus, leaving, 2.5, flipped)
    rays = trace_rays(lens, Scene.point(0.0, np.inf, (0.55,)), PUPIL)
    np.testing.assert_array_equal(rays.status, Status.OK)
    np.testing.assert_allclose(rays.points[0, :, -1], np.tile(focus, (5, 1)), atol=1e-12)
    np.testing.assert_allclose(np.ptp(np.asarray(rays.path)), 0, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paraboloid 90", "ellipsoid 150"])
def test_derivatives_of_hits_by_the_tilt_of_the_mirror(name):
    """Compared with central differences of traced rays, in both modes."""
    lens, *_ = from_focus(*CASES[name], True)

    def hits(angle):
        moved = dataclasses.replace(lens, tilt=lens.tilt.at[1, 0].add(angle))
        return trace_rays(moved, Scene.point(0.0, 50.0, (0.55,)), PUPIL).points[0, :, -1, 1:]

    wanted = (hits(1e-5) - hits(-1e-5)) / 2e-5
    for mode in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(mode(hits)(jnp.zeros(())), wanted, rtol=1e-7, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("turn", [90.0, -90.0])
def test_a_lens_behind_a_fold_mirror_may_have_its_axis_either_way(turn):
    """A plano-convex lens 10 mm behind a mirror at 45 degrees: rays reach the sensor."""
    rows = [
        {"radius": "inf", "stop": True, "semi_diameter": 2.0, "thickness": 20.0},
        {"radius": "inf", "mirror": True, "tilt": [45.0, 0, 0], "thickness": 0.0},
        {"radius": "inf", "index": 1.5, "decentre": [0, 10.0], "tilt": [turn, 0, 0]},
        {"radius": 50 * turn / 90, "decentre": [0, 14.0], "tilt": [turn, 0, 0]},
    ]
    rows[2]["thickness"] = 0.0
    place = {"sensor": 20.0, "sensor_decentre": [0, 114.0], "sensor_tilt": [turn, 0, 0]}
    rays = trace_rays(
        load_lens({"surfaces": rows, **place}), Scene.point(0.0, np.inf, (0.55,)), PUPIL
    )
    np.testing.assert_array_equal(rays.status, Status.OK)
    np.testing.assert_allclose(rays.points[0, :, -1, 1:], [[114.0, 20.0]] * 5, atol=0.01)
