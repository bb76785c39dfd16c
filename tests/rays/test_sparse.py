"""Flagged rays in the lanes of their bundle."""

import jax
import jax.numpy as jnp
import numpy as np

from drt_jax.rays.find import Lanes

FLAGGED = np.array([[0, 1, 0, 1, 1, 0, 0], [0, 0, 0, 0, 0, 0, 1], [0, 0, 0, 0, 0, 0, 0]], bool)
VALUES = 10 * np.arange(3)[:, None] + np.arange(7)


def test_the_first_flagged_rays_have_lanes():
    """Of seven lanes, two rays have three each; if one ray or none is flagged, the last one fills
    the others."""
    lanes = Lanes(jnp.asarray(FLAGGED), 3)
    own = lanes.of_rays(jnp.asarray(VALUES))
    assert np.array_equal(own, [[1, 3], [16, 16], [26, 26]])
    served = FLAGGED & (np.arange(7) != 4)
    assert np.array_equal(lanes.served, served)
    wide = lanes.spread(own[..., None])
    assert np.array_equal(wide[0], [1, 1, 1, 3, 3, 3, 3])
    each = lanes.spread(own[..., None] + 100 * jnp.arange(3)[None, None])
    assert np.array_equal(each[0], [1, 101, 201, 3, 103, 203, 203])


@jax.jit
def first_multiple(flagged, values):
    """For each flagged ray, the first of 24 numbers in a row that its value divides, found in
    rounds of 3 lanes for as many rays at a time as fit; -1 for none."""

    def step(state):
        left, found = state
        lanes = Lanes(left > 0, 3)
        own, tried = lanes.of_rays((values, 8 - left))
        number = 50 + 3 * tried[..., None] + jnp.arange(3, dtype=jnp.int32)[None, None]
        value, number = lanes.spread((own[..., None], number))
        lane, good = lanes.best((number % value == 0).astype(jnp.int32))
        found = jnp.where(good, jnp.take_along_axis(number, lane, axis=1), found)
        return jnp.where(good, 0, left - lanes.served.astype(jnp.int32)), found

    start = jnp.where(flagged, 8, 0).astype(jnp.int32), jnp.full_like(values, -1)
    return jax.lax.while_loop(lambda state: jnp.any(state[0] > 0), step, start)[1]


def test_a_search_in_rounds():
    """Each flagged ray gets all of its rounds, independent of the others."""
    generator = np.random.default_rng(1)
    flagged = generator.uniform(size=(4, 11)) < 0.6
    values = generator.integers(2, 60, flagged.shape)
    found = first_multiple(jnp.asarray(flagged), jnp.asarray(values, jnp.int32))
    for flag, value, mine in zip(flagged.ravel(), values.ravel(), np.asarray(found).ravel()):
        wanted = next((n for n in range(50, 74) if n % value == 0), -1)
        assert mine == (wanted if flag else -1)
