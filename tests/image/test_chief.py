"""Chief rays over the field, compared with closed forms, the complex step on an independent trace,
and numbers of other programs; derivatives by lens numbers."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, load_lens
from drt_jax.image import chief
from drt_jax.lens.scene import checked_scene, field_of_height

from .. import oracle
from ..known import check_slopes

WAVES = (0.6, 0.53, 0.48)
FIELDS = np.array([[0.0, 0.0], [0.0, 0.1], [0.06, 0.08], [-0.1, -0.2]])
R, L = 10.0, 23.0
# A ball of n = 1.5 with the stop at its centre: every chief ray goes straight.
BALL = {
    "surfaces": [
        {"radius": R, "index": 1.5, "thickness": R},
        {"curvature": 0, "index": 1.5, "thickness": R, "semi_diameter": 0.1, "stop": True},
        {"radius": -R, "thickness": L - R},
    ]
}
# Two menisci about a stop, at equal distances of object and sensor.
SYMMETRIC = {
    "surfaces": [
        {"radius": 12.0, "index": 1.6, "thickness": 2.0},
        {"radius": 14.0, "thickness": 5.0},
        {"curvature": 0, "thickness": 5.0, "semi_diameter": 0.5, "stop": True},
        {"radius": -14.0, "index": 1.6, "thickness": 2.0},
        {"radius": -12.0, "thickness": 150.0},
    ]
}
COOKE = load_lens("cooke_triplet")


def moved(lens):
    """A tilted and decentred lens without any symmetry."""
    rows = lens.count + 1
    shift = 0.2 * np.sin(np.arange(2 * rows)).reshape(rows, 2)
    tilt = 0.02 * np.cos(np.arange(3 * rows)).reshape(rows, 3)
    return dataclasses.replace(lens, decentre=jnp.asarray(shift), tilt=jnp.asarray(tilt))


@pytest.mark.slow
def test_a_ball_with_the_stop_at_its_centre():
    """Chief rays are straight, so that y = L tan(field). Both foci are at the distance n R / (2 (n
    - 1)) from the centre, on a sphere about it. The angle on the sensor is that of the field."""
    lens, angles = load_lens(BALL), np.array([0.0, 0.2, 0.5, 1.0])
    found = drt_jax.distortion(lens, Scene.radians(angles, np.inf, WAVES))
    np.testing.assert_allclose(found.relative, 0, atol=1e-13)
    np.testing.assert_allclose(found.focal_length, L, rtol=1e-13)
    np.testing.assert_allclose(found.real[:, 1, 1], L * np.tan(angles), rtol=1e-13, atol=1e-13)
    curved = drt_jax.field_curvature(lens, Scene.radians(angles, np.inf, WAVES))
    focal = 1.5 * R / (2 * 0.5)
    for foci in curved:
        wanted = np.tile((focal * np.cos(angles) - L)[:, None], 3)
        np.testing.assert_allclose(foci, wanted, rtol=1e-12)
    found = drt_jax.chief_ray_angle(lens, Scene.radians(angles, np.inf, WAVES))
    np.testing.assert_allclose(found, np.tile(angles[:, None], 3), rtol=1e-13, atol=1e-15)
    np.testing.assert_allclose(
        drt_jax.lateral_colour(lens, Scene.radians(angles, np.inf, WAVES)), 0, atol=1e-13
    )
    # f-theta: how far L tan(field) is from L field, at any azimuth
    for fields in (angles, np.stack([0 * angles, angles], 1), np.stack([angles, 0 * angles], 1)):
        found = drt_jax.distortion(lens, Scene.radians(fields, np.inf, WAVES), "angle").relative[
            1:, 0
        ]
        np.testing.assert_allclose(found, np.tan(angles[1:]) / angles[1:] - 1, rtol=1e-11)


@pytest.mark.slow
def test_calibrated_focal_lengths():
    """By least squares over the fields, or given."""
    lens, angles = load_lens(BALL), np.array([0.1, 0.3, 0.5])
    found = drt_jax.distortion(lens, Scene.radians(angles, np.inf, WAVES), "angle", "fitted")
    fitted = L * np.tan(angles) @ angles / (angles @ angles)
    np.testing.assert_allclose(found.focal_length, fitted, rtol=1e-13)
    wanted = L * np.tan(angles) / (fitted * angles) - 1
    np.testing.assert_allclose(found.relative[:, 0], wanted, rtol=1e-10)
    found = drt_jax.distortion(lens, Scene.radians(angles, np.inf, WAVES), focal_length=20.0)
    np.testing.assert_allclose(found.relative, L / 20 - 1, rtol=1e-12)
    np.testing.assert_allclose(found.ideal[:, 0, 1], 20 * np.tan(angles), rtol=1e-13)


@pytest.mark.slow
def test_a_symmetric_lens_at_unit_magnification_has_no_distortion_and_no_lateral_colour():
    lens = load_lens(SYMMETRIC)
    angles = field_of_height(jnp.array([0.0, 20.0, 60.0]), 150.0)
    found = drt_jax.distortion(lens, Scene.radians(angles, 150.0, 0.55))
    np.testing.assert_allclose(found.relative, 0, atol=1e-12)
    np.testing.assert_allclose(found.real[:, 0, 1], [0, -20, -60], rtol=1e-12, atol=1e-12)
    assert abs(drt_jax.distortion(lens, Scene.radians(angles, np.inf, 0.55)).relative[-1, 0]) > 5e-4


@pytest.mark.slow
@pytest.mark.parametrize("lens", [COOKE, moved(COOKE)], ids=["centred", "moved"])
@pytest.mark.parametrize("distance", [np.inf, 900.0])
def test_foci_and_heights_by_the_complex_step(lens, distance):
    """On an independent trace, h + s m as a function of the stop point is singular at both foci; at
    the tangential one its kernel is closer to the direction of the field."""
    found = drt_jax.field_curvature(lens, Scene.radians(FIELDS, distance, WAVES))
    bent = drt_jax.distortion(lens, Scene.radians(FIELDS, distance, WAVES))
    for k, field in enumerate(FIELDS):
        scene = oracle.Scene.of(lens, field, distance, WAVES)
        start, centre = oracle._aimed(scene, np.zeros((2, 1))), np.zeros((2, 1))
        columns = []
        for axis in range(2):
            step = 1j * oracle.STEP * np.eye(2)[axis][:, None]
            rays = oracle.trace(scene, *oracle.aim(scene, centre + step, start))
            last, end = (np.stack(np.broadcast_arrays(*hit))[..., 0] for hit in rays.hits[-2:])
            own = np.stack(np.broadcast_arrays(*rays.own[-1]))[..., 0]
            line = end - last
            for turn, angle in enumerate(np.asarray(scene.values["tilt"])[-1]):
                line = np.stack(oracle._rotate(line, turn, -angle))
            slope = line[:2] / line[2]
            columns.append(np.imag(np.concatenate([own[:2], slope])) / oracle.STEP)
        h, m = np.moveaxis(np.array(columns), 0, 1)[:2], np.moveaxis(np.array(columns), 0, 1)[2:]
        np.testing.assert_allclose(bent.real[k], np.real(own[:2]).T, rtol=0, atol=1e-11)
        for w in range(3):
            values, vectors = np.linalg.eig(-np.linalg.solve(m[..., w], h[..., w]))
            toward = np.tan(field) if np.any(field) else np.array([0.0, 1.0])
            order = np.argsort(-np.abs(toward @ vectors))
            tangential, sagittal = np.real(values)[order]
            if np.any(field) or lens.tilt is not None:
                np.testing.assert_allclose(found.tangential[k, w], tangential, rtol=1e-9, atol=1e-9)
                np.testing.assert_allclose(found.sagittal[k, w], sagittal, rtol=1e-9, atol=1e-9)
            else:
                np.testing.assert_allclose(found.tangential[k, w], values, rtol=1e-9)


@pytest.mark.slow
def test_small_fields_by_petzval():
    """(3 sagittal - tangential) / 2 is the sag of the Petzval surface (Welford, ch. 8), to second
    order in the field."""
    focus = drt_jax.first_order(COOKE, np.inf, WAVES[1]).image_distance[0]
    lens = dataclasses.replace(COOKE, sensor=focus)
    first = drt_jax.first_order(lens, np.inf, WAVES[1])
    for field in (1e-2, 2e-2):
        tangential, sagittal = drt_jax.field_curvature(lens, Scene.radians(field, np.inf, WAVES))
        sag = (first.focal_length * field) ** 2 / (2 * first.petzval_radius)
        np.testing.assert_allclose((3 * sagittal[1] - tangential[1]) / 2, sag, rtol=100 * field**2)


@pytest.mark.slow
def test_on_the_axis_both_foci_are_the_paraxial_focus():
    found = drt_jax.field_curvature(COOKE, Scene.radians([0.0], 900.0, WAVES))
    wanted = drt_jax.first_order(COOKE, 900.0, WAVES).image_distance - COOKE.sensor
    for foci in found:
        np.testing.assert_allclose(foci[0], wanted, rtol=1e-10)


@jax.jit
def slopes(lens, fields):
    """All analyses from one bundle: ((merit, results), gradient of the merit by the lens)."""
    scene = Scene.radians(fields, np.inf, WAVES)

    def total(lens):
        rays = chief._chief_rays(lens, checked_scene(lens, scene).with_axis())
        traced = lambda _, seen: jax.tree.map(lambda a: a[-len(seen.field) :], rays)  # noqa: E731
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(chief, "_chief_rays", traced)
            foci = drt_jax.field_curvature(lens, scene)
            bent = drt_jax.distortion(lens, scene, "angle")
            colour = drt_jax.lateral_colour(lens, scene)
            angle = drt_jax.chief_ray_angle(lens, scene)
        parts = *foci, 1e2 * bent.relative, foci.tangential * bent.relative, 1e2 * colour, angle
        weights = map(
            np.random.default_rng(0).normal, [0.0] * 6, [1.0] * 6, [a.shape for a in parts]
        )
        merit = sum(jnp.sum(w * jnp.where(jnp.isfinite(a), a, 0)) for w, a in zip(weights, parts))
        return merit, (*foci, bent.relative, bent.real, colour, angle)

    return jax.value_and_grad(total, has_aux=True)(lens)


@pytest.mark.slow
def test_derivatives_by_lens_numbers():
    """Reverse mode compared with central differences."""
    fields = jnp.array([[0.05, 0.2], [0.0, 0.1], [-0.1, 0.0]])
    steps = {"curvature": 1e-7, "thickness": 1e-5, "sensor": 1e-5}
    check_slopes(lambda lens: slopes(lens, fields), COOKE, steps, 2e-6)


@pytest.mark.slow
def test_a_field_without_a_chief_ray_is_infinite_and_spoils_no_other():
    """A field of 2 rad is light from behind."""
    (_, found), slope = slopes(COOKE, jnp.array([[0.0, 0.1], [0.0, 1.55], [0.0, 2.0]]))
    for part in found:
        assert np.all(np.isfinite(part[0])) and np.all(np.isposinf(part[2]))
        assert not np.any(np.isnan(part))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slope))


@pytest.mark.slow
def test_the_distortion_focal_length_of_opticstudio():
    """Double Gauss 28 degree field, 0.5876 um, without ray aiming: the height of the chief ray at
    Hy = 1e-4 of 14 degrees gives 99.3320630 mm ("Distortion Focal Length", Zemax Community, 2022),
    as in the listing of the distortion plot."""
    lens = drt_jax.with_paraxial_pupil(load_lens("double_gauss"), 0.5876)
    lens = dataclasses.replace(lens, sensor=lens.vertices[-2] + 57.314537905)
    found = drt_jax.distortion(lens, Scene.radians(np.radians(14.0), np.inf, 0.5876))
    np.testing.assert_allclose(found.focal_length, 99.3320630, rtol=1e-9)


@pytest.mark.slow
def test_a_chief_ray_in_a_stop_at_the_first_vertex_is_found():
    """For a bundle of this ray alone, the steps of the search were 0, and the ray was not found."""
    lens = load_lens("phone")
    wanted = drt_jax.trace_rays(lens, Scene.point(0.05, np.inf, 0.53), [[0.0, 0.0], [0.0, 1.0]])
    point = drt_jax.image_point(lens, Scene.point(0.05, np.inf, 0.53))
    np.testing.assert_allclose(point[0], wanted.points[0, 0, -1, :2], rtol=0, atol=1e-13)
    found = drt_jax.distortion(lens, Scene.radians([0.05], np.inf, 0.53))
    np.testing.assert_allclose(found.real[0], point, rtol=0, atol=1e-13)


def test_clear_errors():
    call = drt_jax.field_curvature
    for fields in (np.zeros((2, 3)), np.zeros((0, 2)), np.zeros((1, 1, 2))):
        with pytest.raises(ValueError, match=r"fields: expected \(F,\) or \(F, 2\)|fields: "):
            Scene.radians(fields, np.inf, 0.55)
    with pytest.raises(ValueError, match="Scene.degrees takes degrees"):
        Scene.radians([0.0, 14.0], np.inf, 0.55)
    with pytest.raises(ValueError, match=r"scene: expected a Scene, such as Scene.degrees"):
        call(COOKE, 0.2)
    with pytest.raises(ValueError, match="mapping: expected one of tangent, angle, got 'f-theta'"):
        drt_jax.distortion(COOKE, Scene.radians([0.1], np.inf, 0.55), "f-theta")
    with pytest.raises(ValueError, match="focal_length: expected mm, None or 'fitted'"):
        drt_jax.distortion(COOKE, Scene.radians([0.1], np.inf, 0.55), focal_length="best")
    with pytest.raises(ValueError, match=r"focal_length: expected \(\) or \(3,\), got \(2,\)"):
        drt_jax.distortion(COOKE, Scene.radians([0.1], np.inf, WAVES), focal_length=[50.0, 51.0])
    with pytest.raises(ValueError, match="reference: expected an index of the wavelengths, got 3"):
        drt_jax.lateral_colour(COOKE, Scene.radians([0.1], np.inf, WAVES), 3)
