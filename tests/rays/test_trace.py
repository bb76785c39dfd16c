"""Traced rays against Snell's law; other programs' digits are in test_reference_cases.py."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Status, load_lens, trace_rays, trace_snell
from drt_jax.pupil import rules as pupil
from drt_jax.lens.surface import Shape

from .conftest import LENSES, RGB


def entering(points, field, distance):
    """Directions of the rays that reach the first surface at `points` (Q, 3)."""
    tangent = np.tan(field)
    if np.isinf(distance):
        direction = np.broadcast_to([0, tangent, 1], points.shape)
    else:
        direction = points - np.array([0, -tangent * distance, -distance])
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


snell = jax.jit(jax.vmap(trace_snell, (None, None, 0, 0)))


def against_snell(lens, rays, field, distance, wavelengths):
    """Largest distance in mm between our hits and those of the sequential trace."""
    worst = 0.0
    for k, wavelength in enumerate(wavelengths):
        good = np.asarray(rays.status[k]) == Status.OK
        points = np.asarray(rays.points[k])[good]
        direction = entering(points[:, 0], field, distance)
        hits, ok = snell(lens, wavelength, points[:, 0] - 5 * direction, direction)
        assert np.all(ok)
        worst = max(worst, float(np.max(np.abs(hits - points))))
    return worst


@pytest.mark.parametrize("distance", [np.inf, 25000.0, 400.0])
@pytest.mark.parametrize("name", LENSES)
def test_hits_agree_with_snell_to_1e_11_mm(name, distance):
    lens = load_lens(name)
    points = pupil.half_disc(4, 5)[0].T
    for degrees in (0.0, 5.0, 10.0):
        rays = trace_rays(lens, np.radians(degrees), distance, RGB, points)
        assert np.all(rays.status == Status.OK)
        assert against_snell(lens, rays, np.radians(degrees), distance, RGB) < 1e-11


def asphere(tmp_path):
    path = tmp_path / "asphere.yaml"
    path.write_text(
        """
        surfaces:
          - {radius: 30, conic: -0.8, coefficients: {4: 2.0e-6, 6: -4.0e-9}, thickness: 6,
             index: 1.7}
          - {radius: -200, coefficients: {2: 1.0e-4, 4: 1.0e-5}, thickness: 3}
          - {radius: inf, thickness: 3, semi_diameter: 6, stop: true}
          - {radius: -40, conic: 2.0, coefficients: {4: -1.0e-5}, thickness: 2, glass: SF10}
          - {curvature: 0.001}
        sensor: 60
        """
    )
    return load_lens(path)


def test_aspheres_agree_with_snell(tmp_path):
    lens = asphere(tmp_path)
    points = pupil.half_disc(4, 5)[0].T
    for degrees in (0.0, 12.0):
        rays = trace_rays(lens, np.radians(degrees), 300.0, RGB, points)
        assert np.all(rays.status == Status.OK)
        assert against_snell(lens, rays, np.radians(degrees), 300.0, RGB) < 1e-11


@pytest.mark.parametrize("name", ["double_gauss", "cooke_triplet"])
def test_float32_hits_within_a_tenth_of_a_micrometre(name):
    """Also for an object 25 m away, off axis, where other tracers lose 24 um in float32."""
    lens = load_lens(name)
    single = jax.tree.map(lambda a: a.astype(jnp.float32), lens)
    points = pupil.half_disc(4, 5)[0].T
    for distance in (np.inf, 25000.0):
        exact = trace_rays(lens, 0.17, distance, RGB, points)
        rays = trace_rays(single, 0.17, distance, RGB, points)
        assert rays.points.dtype == jnp.float32 and np.all(rays.status == Status.OK)
        assert np.max(np.abs(rays.points - np.asarray(exact.points, np.float32))) < 1e-4


def test_distance_is_continuous_to_infinity():
    lens = load_lens("double_gauss")
    point = [[0.3, 0.8]]

    def hit(vergence):
        return trace_rays(lens, 0.1, 1 / vergence, [0.55], point).points[0, 0, -1]

    slope = jax.jacobian(hit)(1e-9)
    for distance in (1e9, 1e7, 1e6):
        predicted = hit(1e-12) + slope / distance
        np.testing.assert_allclose(hit(1 / distance), predicted, atol=3e6 / distance**2 + 1e-9)
    np.testing.assert_allclose(
        trace_rays(lens, 0.1, jnp.inf, [0.55], point).points[0, 0, -1], hit(1e-12), atol=1e-7
    )


def with_dummy(lens, gap, curvature):
    """`lens` with a surface of the given curvature halfway across a gap, doing nothing."""
    i = gap + 1
    half = lens.thickness[gap] / 2

    def insert(array, value):
        return jnp.concatenate([array[:i], jnp.full_like(array[:1], value), array[i:]])

    return dataclasses.replace(
        lens,
        curvature=insert(lens.curvature, curvature),
        conic=insert(lens.conic, 0.0),
        coefficients=jnp.insert(lens.coefficients, i, 0.0, axis=0),
        forms=(),
        mirrors=(),
        semi_diameter=insert(lens.semi_diameter, jnp.inf),
        thickness=jnp.concatenate(
            [lens.thickness[:gap], jnp.stack([half, half]), lens.thickness[gap + 1 :]]
        ),
        dispersion=jax.tree.map(lambda a: jnp.insert(a, i, a[i], axis=0), lens.dispersion),
        glasses=lens.glasses[:i] + (lens.glasses[i],) + lens.glasses[i:],
        stop=lens.stop + (i <= lens.stop),
    )


@pytest.mark.parametrize("gap, curvature", [(2, 0.01), (7, 0.0)])
def test_a_surface_that_does_nothing_drops_out(gap, curvature):
    lens = load_lens("double_gauss")
    padded = with_dummy(lens, gap, curvature)
    points = pupil.half_disc(3, 4)[0].T
    wanted = trace_rays(lens, 0.15, 25000.0, RGB, points)
    rays = trace_rays(padded, 0.15, 25000.0, RGB, points)
    assert rays.newton_steps == wanted.newton_steps
    real = [k for k in range(13) if k != gap + 1]
    np.testing.assert_allclose(rays.points[:, :, jnp.array(real)], wanted.points, atol=1e-13)
    before, dummy, after = (rays.points[:, :, gap + k] for k in range(3))
    assert np.max(np.abs(np.cross(dummy - before, after - dummy))) < 1e-12  # on the ray ...
    sphere = dummy - jnp.array([0.0, 0.0, float(padded.vertices[gap + 1])])
    shape = Shape(jnp.array(curvature), jnp.array(0.0), jnp.zeros(0))
    sag = drt_jax.lens.surface.sag(jnp.moveaxis(sphere[..., :2], -1, 0), shape)
    np.testing.assert_allclose(sphere[..., 2], sag, atol=1e-12)  # ... and on the surface


def test_a_clear_aperture_clips_and_changes_no_other_ray():
    lens = load_lens("double_gauss")
    heights = np.stack([np.zeros(5), np.linspace(-1, 1, 5)], axis=1)
    free = trace_rays(lens, 0.0, 25000.0, [0.55], heights)
    narrow = dataclasses.replace(lens, semi_diameter=lens.semi_diameter.at[0].set(10.0))
    rays = trace_rays(narrow, 0.0, 25000.0, [0.55], heights)
    assert rays.status[0].tolist() == [Status.CLIPPED, 0, 0, 0, Status.CLIPPED]
    np.testing.assert_array_equal(rays.points, free.points)


def test_failed_rays_carry_a_status_and_no_nan():
    lens = load_lens("singlet")
    steep = dataclasses.replace(lens, semi_diameter=jnp.array([80.0, jnp.inf, jnp.inf]))
    heights = np.stack([np.zeros(9), np.linspace(-1, 1, 9)], axis=1)
    rays = trace_rays(steep, 0.0, jnp.inf, [0.55], heights)
    status = np.asarray(rays.status[0])
    assert status[4] == Status.OK and status[0] == Status.MISSED
    assert np.all(np.isfinite(rays.points)) and np.all(rays.points[0, status > 0] == 0)
    alone = trace_rays(steep, 0.0, jnp.inf, [0.55], heights[4:5])
    np.testing.assert_array_equal(rays.points[:, 4], alone.points[:, 0])


def test_bad_field_shape():
    with pytest.raises(ValueError, match="one angle or two"):
        trace_rays(load_lens("singlet"), [0.0, 0.1, 0.2], jnp.inf, [0.55], [[0.0, 0.0]])


def test_directions_and_paraxial_launch():
    """A lens whose stop is its first surface: its entrance pupil is the stop itself, so that
    aiming at it paraxially finds the same rays; directions are those between the points."""
    lens = load_lens("singlet")
    pupil_points = jnp.array([[0.0, 0.0], [0.3, -0.8], [-0.5, 0.5]])
    for distance in (jnp.inf, 400.0):
        rays = trace_rays(lens, 0.1, distance, [0.55], pupil_points)
        start, direction = drt_jax.launch_paraxial(lens, 0.1, distance, 0.55, pupil_points)
        np.testing.assert_allclose(direction, rays.directions[0, :, 0], atol=1e-14)
        hits, ok = snell(lens, 0.55, start, direction)
        assert np.all(ok)
        np.testing.assert_allclose(hits, rays.points[0], atol=1e-11)
        steps = np.diff(np.asarray(rays.points[0]), axis=1)
        steps /= np.linalg.norm(steps, axis=-1, keepdims=True)
        np.testing.assert_allclose(rays.directions[0, :, 1:], steps, atol=1e-13)


def test_a_scene_of_constants_inside_jit():
    lens, points = load_lens("singlet"), jnp.array([[0.0, 0.3], [0.0, 0.9]])
    inside = jax.jit(lambda: trace_rays(lens, 0.0, 1e3, jnp.array([0.53]), points).points)()
    np.testing.assert_allclose(
        inside, trace_rays(lens, 0.0, 1e3, jnp.array([0.53]), points).points, rtol=0, atol=1e-12
    )
