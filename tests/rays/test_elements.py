"""Elements that move together, and rotations of the axis, compared with moves that have a known
effect."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Gauss, Scene, focus_moments, load_lens, psf_moments, trace_rays, wavefront

INF = float("inf")
PUPIL = np.array([[0, 0], [0.5, 0], [-0.3, 0.8], [0.1, -0.9]])
# A pivot or a position without symmetry.
MOVE = {"tilt": [0.4, -0.3, 0.2], "shift": [0.05, -0.02, 0.03], "pivot": 1.7}
SURFACES = [
    {"radius": 61.5, "thickness": 6.0, "glass": "N-BK7", "semi_diameter": 8.0, "stop": True},
    {"radius": -44.6, "thickness": 2.5, "glass": "SF5"},
    {"radius": -129.9, "thickness": 30.0},
    {"radius": 80.0, "conic": -0.5, "thickness": 3.0, "glass": "N-BK7"},
    {"radius": -300.0, "thickness": 35.0},
]


def lens_with(*elements, surfaces=SURFACES):
    return load_lens({"surfaces": surfaces, "elements": list(elements)})


def rotation(degrees):
    """Rotation about x, then the rotated y, then the rotated z."""
    (cx, cy, cz), (sx, sy, sz) = (f(np.radians(degrees)) for f in (np.cos, np.sin))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return about_x @ about_y @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])


@pytest.mark.slow
def test_one_surface_about_its_vertex_is_its_own_tilt_and_decentre():
    tilt, shift = [0.3, -0.5, 0.2], [0.1, 0.2]
    group = lens_with({"surfaces": [3, 3], "tilt": tilt, "shift": [*shift, 0.0]})
    rows = [dict(row) for row in SURFACES]
    rows[3] |= {"tilt": tilt, "decentre": shift}
    ours = trace_rays(group, Scene.point(0.05, INF, 0.55), PUPIL)
    theirs = trace_rays(load_lens({"surfaces": rows}), Scene.point(0.05, INF, 0.55), PUPIL)
    np.testing.assert_allclose(ours.points, theirs.points, atol=1e-12)
    np.testing.assert_allclose(ours.path, theirs.path, atol=1e-11)


@pytest.mark.slow
def test_the_whole_lens_turned_is_the_light_turned():
    turned = lens_with({"surfaces": [0, "sensor"]} | MOVE)
    back = rotation(MOVE["tilt"]).T
    field = (0.02, 0.06)
    direction = back @ [np.tan(field[0]), np.tan(field[1]), 1]
    ours = trace_rays(turned, Scene.point(field, INF, 0.55), PUPIL)
    theirs = trace_rays(
        lens_with(), Scene.point(np.arctan(direction[:2] / direction[2]), INF, 0.55), PUPIL
    )
    pivot = np.array([0, 0, MOVE["pivot"]])
    own = (np.asarray(ours.points) - pivot - MOVE["shift"]) @ back.T + pivot
    np.testing.assert_allclose(own, theirs.points, atol=1e-11)


@pytest.mark.slow
def test_a_tilted_plate_shifts_a_beam():
    plane = {"radius": INF, "thickness": 20.0}
    rows = [plane | {"stop": True, "semi_diameter": 2.0}, plane | {"index": 1.5}, plane]
    angle = 25.0
    lens = lens_with({"surfaces": [1, 2], "tilt": [angle, 0, 0], "pivot": 7.0}, surfaces=rows)
    rays = trace_rays(lens, Scene.point(0.0, INF, 0.55), PUPIL)
    sine, cosine = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    moved = 20.0 * sine * (1 - cosine / np.sqrt(1.5**2 - sine**2))
    shift = np.asarray(rays.points[0, :, -1] - rays.points[0, :, 0])
    np.testing.assert_allclose(abs(shift[:, 1]), moved, rtol=1e-13)
    np.testing.assert_allclose(shift[:, 0], 0, atol=1e-14)
    np.testing.assert_allclose(rays.directions[0, :, -1, 2], 1, rtol=1e-14)


@pytest.mark.slow
def test_a_sphere_turns_about_its_centre_without_effect():
    about = lens_with({"surfaces": [2, 2], "pivot": -129.9, "tilt": [2.0, 1.0, 0.0]})
    ours = trace_rays(about, Scene.point(0.05, INF, 0.55), PUPIL)
    theirs = trace_rays(lens_with(), Scene.point(0.05, INF, 0.55), PUPIL)
    np.testing.assert_allclose(ours.points, theirs.points, atol=1e-11)


@pytest.mark.slow
def test_a_folding_mirror_changes_no_image():
    """A mirror at 45 degrees rotates the axis of all that follows by 90 degrees; light then runs
    against the axis."""
    rows = [dict(row) for row in SURFACES]
    rows[4]["thickness"] = 15.0
    rows.append({"radius": INF, "mirror": True, "thickness": -20.0, "tilt": [45.0, 0, 0]})
    folded = lens_with(
        {"surfaces": [6, "sensor"], "about": 5, "tilt": [90.0, 0, 0]},
        surfaces=[*rows, {"radius": INF, "thickness": -1e-3}],
    )
    ours = trace_rays(folded, Scene.point((0.02, 0.05), INF, 0.55), PUPIL)
    plain = [dict(row) for row in SURFACES]
    plain[4]["thickness"] = 35.0 + 1e-3
    theirs = trace_rays(lens_with(surfaces=plain), Scene.point((0.02, 0.05), INF, 0.55), PUPIL)
    image, straight = (np.asarray(rays.points[0, :, -1]) for rays in (ours, theirs))
    z = 6 + 2.5 + 30 + 3 + 15
    np.testing.assert_allclose(image[:, 0], straight[:, 0], atol=1e-12)
    np.testing.assert_allclose(image[:, 2] - z, straight[:, 1], atol=1e-11)
    np.testing.assert_allclose(image[:, 1], 20.001, rtol=1e-13)
    np.testing.assert_allclose(ours.path, theirs.path, rtol=1e-13)


def spectrometer(order):
    """A Czerny-Turner spectrometer with three coordinate breaks and their inverses, as in N.
    Hagen's lens file czt_spect.zmx, with decentres and tilts that its program solved for the chief
    ray."""
    offset, arm = 60.0, 166.3611490362
    grating = {"form": "linear", "order": order, "coefficients": {"y": 600.0}}
    mirror = {"radius": -400.0, "mirror": True}
    rows = [
        mirror | {"thickness": -arm},
        {"radius": INF, "mirror": True, "thickness": arm, "phase": grating},
        mirror | {"thickness": -219.2420801015},
    ]
    rows[1] |= {"stop": True, "semi_diameter": 25.0}
    elements = [
        {"surfaces": [0, 0], "shift": [0, offset, 0]},
        {"surfaces": [1, "sensor"], "shift": [0, 50.26320621216, 0], "tilt": [-10.0, 0, 0]},
        {"surfaces": [2, "sensor"], "about": 1, "tilt": [10.0, 0, 0]},
        {"surfaces": [2, "sensor"], "shift": [0, 51.97568581932 - offset, 0]},
        {"surfaces": ["sensor", "sensor"], "shift": [0, 58.61257294038, 0]},
    ]
    return lens_with(*elements, surfaces=rows)


def test_coordinate_breaks_lie_where_another_program_puts_them():
    z, across, turned = spectrometer(1).places
    np.testing.assert_allclose(across[:, 1], [60, 50.26320621, 42.23889203, 100.8514650], atol=1e-7)
    np.testing.assert_allclose(z, [0, -166.361149, 0, -219.2420802], atol=1e-6)
    np.testing.assert_allclose(turned[1, 1], [0, 0.9848077530, 0.1736481777], atol=1e-10)
    np.testing.assert_allclose(turned[2:], np.stack([np.eye(3)] * 2), atol=1e-15)


@pytest.mark.slow
def test_the_chief_ray_of_a_grating_spectrometer_goes_where_another_program_found_it():
    """The program solved the decentres for the chief ray at 550 nm to 13 digits."""
    rays = trace_rays(
        spectrometer(-1), Scene.point(0.0, 181.3611490362, (0.45, 0.55, 0.65)), [[0.0, 0.0]]
    )
    assert np.all(rays.status == 0)
    point, toward = np.asarray(rays.points[1, 0]), np.asarray(rays.directions[1, 0])
    # It followed the chief ray to the vertex planes of the mirrors, at z = 0.
    heights = [point[k, 1] - point[k, 2] * toward[k, 1] / toward[k, 2] for k in (2, 3)]
    steps = 50.26320621216, 51.97568581932, -60 + 58.61257294038
    np.testing.assert_allclose(heights, np.cumsum(steps)[1:], rtol=1e-12)
    sensor = np.asarray(rays.points[:, 0, 3, 1])
    assert abs(sensor[0] - sensor[2]) > 20  # mm between 450 and 650 nm


# Elements that contain the sensor: the sensor alone, as a tilt; about another surface and a pivot;
# with a surface, and tilted itself; about itself, inside an element about another surface.
HELD = {
    "alone": [{"surfaces": ["sensor", "sensor"], "tilt": [10.0, 0, 0]}],
    "about a surface": [
        {"surfaces": ["sensor", "sensor"], "about": 1} | MOVE | {"tilt": [9, -6, 3]}
    ],
    "with a surface": [
        {"surfaces": [4, "sensor"]} | MOVE | {"tilt": [4, 5, 0]},
        {"surfaces": ["sensor", "sensor"], "about": "sensor", "pivot": 3.0, "tilt": [3, -7, 0]},
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("name", HELD)
def test_a_held_sensor_moves_as_its_elements_turn_it(name):
    """The polynomials in the sensor position, compared with the lens whose sensor is really
    moved."""
    lens = lens_with(*HELD[name])
    if name == "with a surface":
        lens = dataclasses.replace(
            lens, tilt=jnp.zeros((6, 3)).at[-1].set(jnp.array([0.1, 0.2, 1]))
        )

    def focus(sensor):
        moved = dataclasses.replace(lens, sensor=jnp.asarray(sensor))
        return focus_moments(moved, Scene.point((0.02, 0.06), INF, 0.55), sampling=Gauss(4, "none"))

    ours = focus(lens.sensor).at(lens.sensor + 1.5)
    wanted = focus(lens.sensor + 1.5).at(lens.sensor + 1.5)
    np.testing.assert_allclose(ours.mean, wanted.mean, atol=1e-12)
    np.testing.assert_allclose(ours.covariance, wanted.covariance, rtol=1e-12, atol=1e-15)


@pytest.mark.slow
def test_a_sensor_turned_by_an_element_is_one_that_is_tilted():
    lens = lens_with(*HELD["alone"])
    tilted = load_lens({"surfaces": SURFACES, "sensor_tilt": [10.0, 0, 0]})
    ours, theirs = (
        focus_moments(a, Scene.point(0.06, INF, 0.55), sampling=Gauss(4, "none"))
        for a in (lens, tilted)
    )
    np.testing.assert_allclose(ours.slope, theirs.slope, atol=1e-14)
    np.testing.assert_allclose(ours.spread, theirs.spread, rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(
        wavefront(lens, Scene.point(0.06, INF, 0.55), PUPIL).opd,
        wavefront(tilted, Scene.point(0.06, INF, 0.55), PUPIL).opd,
        atol=1e-9,
    )


def test_elements_that_move_with_the_sensor_have_no_polynomials():
    """Surfaces that are rotated about the sensor move with it."""
    turned = lens_with({"surfaces": [3, 4], "about": "sensor", "tilt": [1.0, 0, 0]})
    with pytest.raises(ValueError, match=r"elements\[0\]: .* about the sensor"):
        focus_moments(turned, Scene.point(0.0, INF, 0.55), sampling=Gauss(2, "none"))


@pytest.mark.slow
def test_derivatives_by_every_move():
    """Of centroid and covariance, compared with differences; also about a centred lens."""
    for move in (MOVE, {}):
        lens = lens_with({"surfaces": [2, "sensor"]}, {"surfaces": [3, 4]} | move)

        def outputs(elements, lens=lens):
            found = psf_moments(
                dataclasses.replace(lens, elements=elements),
                Scene.point(0.05, INF, 0.55),
                sampling=Gauss(4, "none"),
            )
            return jnp.concatenate([found.mean.ravel(), found.covariance.ravel()])

        forward = jax.jit(jax.jacfwd(outputs))(lens.elements)
        reverse = jax.jit(jax.jacrev(outputs))(lens.elements)
        value, step = jax.jit(outputs), 1e-4
        for name in ("shift", "tilt", "pivot"):
            old = getattr(lens.elements, name)
            ours, theirs = getattr(forward, name), getattr(reverse, name)
            np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-12)
            for k in np.ndindex(old.shape):
                sides = [
                    value(dataclasses.replace(lens.elements, **{name: old.at[k].add(s)}))
                    for s in (step, -step)
                ]
                change = (sides[0] - sides[1]) / (2 * step)
                np.testing.assert_allclose(ours[:, *k], change, rtol=1e-5, atol=3e-8)


@pytest.mark.parametrize(
    ("element", "message"),
    [
        ({"surfaces": [1]}, r"elements\[0\].surfaces: expected \[first, last\], got \[1\]"),
        ({"surfaces": [2, 1]}, r"elements\[0\].surfaces: expected \[first, last\]"),
        ({"surfaces": [2, 9]}, r"elements\[0\].surfaces: .* 0 to 4, or sensor; got 9"),
        ({"surfaces": [2, 3], "about": 7}, r"elements\[0\].about: .* 0 to 4, or sensor; got 7"),
        ({"surfaces": [2, 3], "tilt": [1]}, r"elements\[0\].tilt: expected a list of 3 numbers"),
        ({"surfaces": [2, 3], "turn": 1}, r"elements\[0\]: unknown key 'turn'"),
    ],
)
def test_bad_elements_are_named(element, message):
    with pytest.raises(ValueError, match=message):
        lens_with(element)


def test_elements_that_cut_into_one_another():
    with pytest.raises(ValueError, match=r"elements\[1\].surfaces: cuts into elements\[0\]"):
        lens_with({"surfaces": [1, 3]}, {"surfaces": [2, 4]})
    nested = lens_with({"surfaces": [2, 3]}, {"surfaces": [1, "sensor"]})
    assert nested.elements.spans == ((1, 5), (2, 3))
