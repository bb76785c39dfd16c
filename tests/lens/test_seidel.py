"""Third-order aberrations compared with real rays near the axis and closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, load_lens, trace_rays

from .test_paraxial import CASSEGRAIN, GREEN, IMMERSED, exit_, image_height, third_order

# The stop is a plane behind the mirror, a label of the light that comes to it.
MANGIN = {
    "surfaces": [
        {"radius": -150, "conic": 0.4, "index": 1.5, "thickness": 12.8},
        {
            "radius": "inf",
            "index": 1.5,
            "semi_diameter": 20.0,
            "stop": True,
            "thickness": -0.8,
        },
        {"radius": -200, "coefficients": {4: 2e-8}, "mirror": True, "thickness": -12.0},
        {"radius": -150, "conic": 0.4, "thickness": -80.0},
    ]
}
THIRD = {
    "double_gauss": ("double_gauss", 2000.0),
    "immersed": (IMMERSED, 200.0),
    "cassegrain": (CASSEGRAIN, np.inf),
    "mangin": (MANGIN, np.inf),
}


LONG = ("immersed", "mangin")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in THIRD]
)
def test_third_order_is_what_real_rays_show_near_the_axis(name):
    """Errors of real rays in the paraxial image plane, divided by t^3, where t scales aperture and
    field. Without their term of t^2 they are the polynomial of the Seidel sums. The remaining error
    is proportional to t^4, 1e-4."""
    source, distance = THIRD[name]
    lens = load_lens(source)
    sums = third_order(lens, Scene.point(0.1, distance, GREEN)).total
    plane = drt_jax.first_order(lens, distance, GREEN).image_distance[0]
    lens = dataclasses.replace(lens, sensor=plane)
    ideal = image_height(lens, 0.1, distance, GREEN)[0]
    pupil = np.array([[0.0, 0], [0, 1], [0, -1], [1, 0]])

    @jax.jit
    def errors(t, field):
        angle = jnp.arctan(jnp.tan(0.1) * t * field)
        rays = trace_rays(lens, Scene.point(angle, distance, GREEN), t * pupil)
        return (rays.points[0, :, -1, :2] - jnp.array([[0, t * field * ideal]])) / t**3

    def limit(field):
        a, b = errors(0.1, field), errors(0.05, field)
        return (4 * b - a) / 3

    axial, off = limit(0.0), limit(1.0)
    sa, tco, tas, sas, _, dst = (a[0] for a in sums[:6])
    wanted = jnp.array([dst, sa + tco + tas + dst, -sa + tco - tas + dst, sa + sas])
    size = np.max(np.abs(wanted))
    np.testing.assert_allclose(axial[1], [0, sa], atol=1e-3 * size)
    ours = [*off[:3, 1], off[3, 0]]
    np.testing.assert_allclose(ours, wanted, atol=1e-3 * size)


def test_third_order_of_stigmatic_surfaces_and_of_the_mirror():
    """The Cassegrain of paraboloid and hyperboloid has no spherical aberration, nor has either
    surface alone. In Petzval's sum the mirrors have opposite signs."""
    parts = third_order(load_lens(CASSEGRAIN), Scene.point(0.01, np.inf, GREEN))
    np.testing.assert_allclose(parts.spherical[0], 0, atol=1e-15)
    # k of the secondary for magnification 4: -((m + 1) / (m - 1))^2 = -25/9, not -4
    first, second = CASSEGRAIN["surfaces"]
    best = {"surfaces": [first, second | {"conic": -25 / 9}]}
    total = third_order(load_lens(best), Scene.point(0.01, np.inf, GREEN)).total
    np.testing.assert_allclose(total.spherical, 0, atol=1e-14)
    assert abs(parts.total.spherical[0]) > 1e-3
    np.testing.assert_allclose(parts.petzval_curvature[:, 0], [2 / 1000, -6 / 1000])
    np.testing.assert_allclose(total.axial_colour, 0)


def test_third_order_knows_the_stop_by_its_images_only():
    """A stop in front of a lens, compared with its exit pupil as a stop that is listed behind the
    lens."""
    lens = [
        {"radius": 30, "glass": "N-BK7", "thickness": 4.0},
        {"radius": -70, "conic": -0.5, "coefficients": {4: 1e-6}},
    ]

    def stop(pupil):
        return {"radius": "inf", "semi_diameter": float(pupil.semi_diameter[0]), "stop": True}

    size = drt_jax.results.Pupil(np.zeros(1), np.array([3.0]))
    for gap in (6.0, 0.0, -1.5):
        front = [stop(size) | {"thickness": gap}, *lens]
        front = load_lens({"surfaces": front, "sensor": 60.0})
        image = exit_(front, GREEN)
        behind = [lens[0], lens[1] | {"thickness": float(image.position[0])}, stop(image)]
        behind = load_lens({"surfaces": behind, "sensor": 60.0})
        a = third_order(front, Scene.point(0.1, jnp.inf, GREEN))
        b = third_order(behind, Scene.point(0.1, jnp.inf, GREEN))
        for ours, wanted in zip(a, b, strict=True):
            np.testing.assert_allclose(ours[1:], wanted[:-1], rtol=1e-10, atol=1e-14)
            np.testing.assert_array_equal([ours[0], wanted[-1]], 0)


def test_third_order_needs_an_axis():
    entry = {
        "form": "toroid",
        "radius": 50,
        "radius_x": 40,
        "index": 1.5,
        "stop": True,
        "semi_diameter": 3.0,
        "thickness": 90.0,
    }
    with pytest.raises(ValueError, match="of the form toroid"):
        drt_jax.third_order(load_lens({"surfaces": [entry]}), Scene.point(0.1, np.inf, GREEN))


@pytest.mark.slow
def test_third_order_is_that_of_a_centred_lens():
    """A known tilt raises an error; inside a trace the result is infinite. Arrays of zeros are no
    tilt."""
    lens = load_lens("singlet")
    for name, still in (("tilt", np.zeros((4, 3))), ("decentre", np.zeros((4, 2)))):
        moved = still.copy()
        moved[1, 0] = 1e-3

        def spherical(moves, name=name):
            given = dataclasses.replace(lens, **{name: jnp.asarray(moves)})
            return drt_jax.third_order(given, Scene.point(0.1, np.inf, GREEN)).spherical

        with pytest.raises(ValueError, match="no theory for tilted or decentred surfaces"):
            spherical(moved)
        traced = jax.jit(spherical)
        np.testing.assert_array_equal(traced(moved), np.inf)
        usual = drt_jax.third_order(lens, Scene.point(0.1, np.inf, GREEN)).spherical
        np.testing.assert_allclose(traced(still), usual, rtol=1e-13)
        np.testing.assert_allclose(spherical(still), usual, rtol=1e-13)
