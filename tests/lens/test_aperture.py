"""Depths inside of apertures, compared with geometry."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax import load_lens
from drt_jax.lens.aperture import Apertures, depths
from drt_jax.lens.clearance import clearance, clipping_surface

HALF = jnp.array([[2.0, 9.0], [3.0, 0.8], [1.5, 0.4]])
CENTRE = jnp.array([[0.3, -0.2], [0.5, 0.1], [-1.0, 2.0]])


def three(centre):
    kinds = ("circle", "ellipse", "rectangle")
    return Apertures(HALF, centre, surfaces=(0, 2, 1), kinds=kinds, blocks=(False, True, False))


def test_depth_is_the_distance_from_the_edge():
    """For points close to the edge; for an ellipse the distance is that of the nearest of many
    points on it."""
    angle = np.linspace(0, 2 * np.pi, 200001)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    side = np.linspace(-1, 1, 20001)
    one = np.ones_like(side)
    box = np.concatenate([[side, one], [side, -one], [one, side], [-one, side]], axis=1)
    around = [
        np.asarray(h)[:, None] * c + np.asarray(m)[:, None]
        for h, c, m in zip(HALF.at[0, 1].set(2.0), (circle, circle, box), CENTRE, strict=True)
    ]
    generator = np.random.default_rng(0)
    hits, wanted = np.zeros((2, 3, 60)), np.zeros((3, 60))
    for k, (surface, edge) in enumerate(zip((0, 2, 1), around, strict=True)):
        middle = np.asarray(CENTRE[k])[:, None]
        share = 1 + 1e-3 * generator.uniform(-1, 1, 60)
        point = middle + share * (edge[:, generator.integers(0, edge.shape[1], 60)] - middle)
        far = np.array([np.min(np.hypot(*(edge - p[:, None]))) for p in point.T])
        hits[:, surface], wanted[k] = point, far * np.sign(1 - share)
    found = depths(three(CENTRE), tuple(jnp.asarray(hits)))
    np.testing.assert_allclose(found, wanted, atol=2e-5)


def test_on_the_meridian_and_in_the_middle():
    hits = jnp.broadcast_to(jnp.array([[-0.3, 0.0, 2.5]]), (3, 3))
    both = three(None)
    np.testing.assert_allclose(depths(both, (hits,))[0], [1.7, 2.0, -0.5])
    slope = jax.jacrev(lambda h: depths(both, (0 * h, h)))(hits)
    assert np.all(np.isfinite(slope))


def test_clearance_of_all_edges():
    """Circles of semi-diameters except the stop's, then other apertures; obscurations from
    outside."""
    lens = load_lens("cooke_triplet")
    extra = Apertures(
        jnp.array([[4.0, 0.0], [1.0, 2.0]]), surfaces=(1, 0), kinds=("circle", "rectangle"),
        blocks=(False, True),
    )  # fmt: skip
    semi = jnp.full_like(lens.semi_diameter, jnp.inf).at[2].set(3.0).at[lens.stop].set(1.0)
    lens = dataclasses.replace(lens, semi_diameter=semi, apertures=extra)
    y = jnp.array([0.5, 2.6, 3.5, 4.5])
    hits = tuple(jnp.broadcast_to(a, (lens.count + 1, 4)) for a in (0 * y, y))
    found = np.asarray(clearance(lens, hits))
    assert found.shape == (lens.count + 3, 4)
    np.testing.assert_allclose(found[2], 3 - y)
    np.testing.assert_allclose(found[-2:], [4 - y, [-1, 0.6, 1.5, 2.5]])
    assert np.all(np.isinf(np.delete(found, [2, -2, -1], axis=0)))
    np.testing.assert_array_equal(clipping_surface(lens, hits), [0, 2, 2, 1])
