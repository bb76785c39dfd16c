"""Breathing and magnification over focus, compared with a thin lens."""

import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import first_order, load_lens
from drt_jax.design import configured, focusing

# A thin lens of the focal length 100 mm, at the stop.
THIN = {
    "surfaces": [
        {"radius": 50.0, "thickness": 1e-6, "nd": 1.5, "vd": 60.0, "semi_diameter": 0.005,
         "stop": True},
        {"radius": np.inf, "thickness": 100.0, "semi_diameter": 0.005},
    ]
}  # fmt: skip


def test_a_thin_lens_breathes_by_the_closed_form():
    """A lens that is in focus at the magnification m is f (1 - m) in front of the sensor:
    tan(angle) = height / (f (1 - m))."""
    m = np.array([0.0, -0.1, -0.5])
    lenses = configured(load_lens(THIN), {"sensor": 100 * (1 - m)})
    distances = [np.inf, *(100 * (1 - 1 / m[1:]))]
    found = focusing(lenses, distances, 0.001, 0.5875618)
    np.testing.assert_allclose(found.magnification, m, atol=1e-7)
    np.testing.assert_allclose(np.tan(found.angle), 1e-5 / (1 - m), rtol=1e-6)
    np.testing.assert_allclose(found.breathing, 1 / (1 - m) - 1, atol=1e-6)
    np.testing.assert_allclose(found.focal_length, 100, rtol=1e-6)


def test_the_angle_is_that_from_the_entrance_pupil():
    """For the object point of a real lens that is imaged from -m h to h, the tangent is m h divided
    by the distance to the entrance pupil."""
    lens, distance, height = load_lens("cooke_triplet"), 300.0, 1e-3
    found = focusing([lens, lens], [distance, 1e8], height, 0.55)
    first = first_order(lens, distance, jnp.array([0.55]))
    # This object is out of focus in the plane of the sensor, where the chief ray has the height h.
    exit_to_sensor = lens.sensor - jnp.sum(lens.thickness) - first.exit_pupil.position[0]
    focus = first.image_distance[0] - jnp.sum(lens.thickness) - first.exit_pupil.position[0]
    sharp = height * focus / exit_to_sensor
    away = distance + first.entrance_pupil.position[0]
    wanted = jnp.abs(sharp / first.magnification[0]) / away
    np.testing.assert_allclose(np.tan(found.angle[0]), wanted, rtol=1e-5)
    again = focusing([lens], [np.inf], height, 0.55)
    np.testing.assert_allclose(found.angle[1], again.angle[0], rtol=1e-5)


def test_what_is_not_there():
    lens = load_lens("cooke_triplet")
    beyond = focusing([lens], [np.inf], 1e4, 0.55)
    assert np.isinf(beyond.angle[0]) and np.isinf(beyond.breathing[0])
    with pytest.raises(ValueError, match="distances: 2 for 1 lenses"):
        focusing([lens], [np.inf, 9.0], 1.0, 0.55)
