"""Ray fans, and foci by wavelength."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, load_lens

from ..known import check_slopes

COOKE = load_lens("cooke_triplet")
WAVES = (0.6, 0.53, 0.48)
# P01: a biconvex singlet behind a stop that touches it, OpticStudio 25.1.1 through ZOSPy's tests.
P01 = {
    "surfaces": [
        {"curvature": 0, "thickness": 0.0, "semi_diameter": 1.0, "stop": True},
        {"radius": 20.0, "index": 1.5, "thickness": 1.0},
        {"radius": -20.0, "thickness": 19.792},
    ]
}
FAN_UM = [
    *(0.0, 0.19400674618204328, 0.36404714601789845, 0.48612071234632737, 0.5361585659867663),
    *(0.4899889631108656, 0.3233024888489311, 0.011616802834235607, -0.4697591802775847),
    *(-1.1457617956227573, -2.041609942697864),
]


@pytest.mark.slow
def test_the_fan_that_opticstudio_prints():
    """To its last digit; odd in Py, and the same along x."""
    found = drt_jax.ray_fans(load_lens(P01), Scene.radians([0.0], np.inf, 0.543), 21)
    assert found.pupil.shape == (21,) and found.tangential.shape == (1, 1, 21, 2)
    wanted = np.array([*(-a for a in FAN_UM[:0:-1]), *FAN_UM])
    np.testing.assert_allclose(1e3 * found.tangential[0, 0, :, 1], wanted, rtol=0, atol=1e-10)
    np.testing.assert_allclose(1e3 * found.sagittal[0, 0, :, 0], wanted, rtol=0, atol=1e-10)
    np.testing.assert_allclose(found.tangential[..., 0], 0, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("fields", [[0.0, 0.2], [[0.05, 0.2], [-0.1, 0.1]]])
def test_fans_are_rays_and_wavefronts(fields):
    found = drt_jax.ray_fans(COOKE, Scene.radians(fields, 900.0, WAVES), 5, reference=0)
    heights = np.linspace(-1, 1, 5)
    fans = {"tangential": [0, 1], "sagittal": [1, 0]}
    for k, field in enumerate(fields):
        chief = np.asarray(drt_jax.image_point(COOKE, Scene.point(field, 900.0, WAVES))[0])
        for name, way in fans.items():
            pupil = np.outer(heights, way)
            rays = drt_jax.trace_rays(COOKE, Scene.point(field, 900.0, WAVES), pupil)
            wave = drt_jax.wavefront(COOKE, Scene.point(field, 900.0, WAVES), pupil)
            good = np.asarray(rays.status) == 0
            points = np.asarray(rays.points)[:, :, -1, :2]
            hits = np.where(good[..., None], points - chief, np.inf)
            paths = np.where(good, wave.opd, np.inf)
            np.testing.assert_allclose(getattr(found, name)[k], hits, rtol=0, atol=1e-12)
            np.testing.assert_allclose(getattr(found, f"{name}_path")[k], paths, atol=1e-7)


@pytest.mark.slow
def test_foci_of_rays_by_colour():
    """The rays of the triplet cross the axis where those of `trace_rays` do; rays close to the axis
    at the paraxial focus."""
    found = drt_jax.axial_colour(COOKE, Scene.point(0.0, np.inf, WAVES), [1e-3, 0.7, 1.0])
    wanted = drt_jax.first_order(COOKE, np.inf, WAVES).image_distance - COOKE.sensor
    np.testing.assert_allclose(found.paraxial, wanted, rtol=1e-12)
    np.testing.assert_allclose(found.real[:, 0], wanted, atol=1e-4)
    rays = drt_jax.trace_rays(COOKE, Scene.point(0.0, np.inf, WAVES), [[0.0, 0.7], [0.0, 1.0]])
    y, slope = rays.points[..., -1, 1], rays.directions[..., -1, 1] / rays.directions[..., -1, 2]
    np.testing.assert_allclose(found.real[:, 1:], -y / slope, rtol=1e-9)


@pytest.mark.slow
def test_derivatives_and_failed_rays():
    """Rays beyond the edge of a surface are infinite, and have derivatives of 0; the derivatives of
    others agree with differences."""
    lens = dataclasses.replace(COOKE, semi_diameter=COOKE.semi_diameter.at[0].set(5.0))

    @jax.jit
    def both(lens):
        def total(lens):
            found = drt_jax.ray_fans(lens, Scene.radians(jnp.array([0.1, 0.3]), np.inf, WAVES), 9)
            parts = [1e2 * found.tangential, 1e2 * found.sagittal, found.sagittal_path]
            kept = (jnp.where(jnp.isfinite(a), a, 0) for a in parts)
            return sum(jnp.sum(a**2) for a in kept), found

        return jax.value_and_grad(total, has_aux=True)(lens)

    (_, found), slopes = both(lens)
    assert np.any(np.isposinf(found.tangential)) and not np.any(np.isnan(found.tangential))
    assert np.array_equal(np.isinf(found.tangential[..., 1]), np.isinf(found.tangential_path))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))
    check_slopes(both, lens, {"curvature": 1e-8, "thickness": 1e-6}, 1e-5)


@pytest.mark.slow
def test_clear_errors():
    for count in (1, 2.5, "5"):
        with pytest.raises(ValueError, match="count: expected at least 2, a whole number"):
            drt_jax.ray_fans(COOKE, Scene.radians([0.0], np.inf, 0.55), count)
    with pytest.raises(ValueError, match="reference: expected an index"):
        drt_jax.ray_fans(COOKE, Scene.radians([0.0], np.inf, WAVES), 5, reference=-4)
    with pytest.raises(ValueError, match=r"heights: expected \(N,\)"):
        drt_jax.axial_colour(COOKE, Scene.point(0.0, np.inf, 0.55), 1.0)
