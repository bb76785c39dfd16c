"""What is drawn lies where the rays are."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from drt_jax import load_lens
from drt_jax.show import layout as drawing

FOLDED = {
    "surfaces": [
        {"radius": "inf", "semi_diameter": 8, "stop": True, "thickness": 10},
        {"radius": 60, "thickness": 5, "glass": "N-BK7", "semi_diameter": 12},
        {"radius": -200, "thickness": 30, "semi_diameter": 12},
        {"radius": "inf", "mirror": True, "tilt": [45, 0, 0], "semi_diameter": 18},
    ],
    "sensor": 45.0,
    "sensor_decentre": [0, 60],
    "sensor_tilt": [90, 0, 0],
}


def test_a_folded_lens():
    lens = load_lens(FOLDED)
    drawn = drawing.draw(lens, [0.0, 0.05])
    assert len(drawn.glass) == 1 and len(drawn.mirrors) == 1 and len(drawn.stop) == 2
    np.testing.assert_allclose(drawn.glass[0][0], drawn.glass[0][-1])  # a closed outline
    np.testing.assert_allclose(drawn.mirrors[0][:, 0] - 45, drawn.mirrors[0][:, 1], atol=1e-12)
    np.testing.assert_allclose(drawn.sensor[:, 1], 60, atol=1e-12)
    for fan in drawn.rays:
        assert len(fan) == 7
        for path in fan:
            mirror, end = path[-2], path[-1]
            np.testing.assert_allclose(mirror[0] - 45, mirror[1], atol=1e-12)
            np.testing.assert_allclose(end[1], 60, atol=1e-12)
            low, high = np.sort(drawn.sensor[:, 0])
            assert low < end[0] < high


def test_a_lens_without_apertures_is_drawn_to_its_rays():
    lens = load_lens("singlet")
    semi = jnp.full_like(lens.semi_diameter, jnp.inf).at[0].set(5.0)
    drawn = drawing.draw(dataclasses.replace(lens, semi_diameter=semi))
    assert 5 < np.max(drawn.glass[0][:, 1]) < 8
