"""The sequential trace, which is the reference of all comparisons, compared with closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from experiments._families import draw
from experiments.snell import trace_snell

from drt_jax import load_lens

trace = jax.jit(jax.vmap(trace_snell, (None, None, 0, None)))
WAVE = jnp.asarray(0.55)
ALONG = jnp.array([0.0, 0.0, 1.0])
HEIGHTS = jnp.array([[0.0, 0.0, -5.0], [0.0, 1.5, -5.0], [1.0, -0.5, -5.0]])


def test_paraboloid_and_ellipsoid_are_stigmatic():
    """Parallel rays meet in the focus of a paraboloid, and in that of an ellipsoid of glass with k
    = -1/n^2, n R / (n - 1) behind its vertex."""
    mirror = {"radius": -40.0, "conic": -1.0, "mirror": True, "stop": True, "semi_diameter": 5.0}
    glass = {"radius": 20.0, "conic": -1 / 2.25, "index": 1.5, "stop": True, "semi_diameter": 5.0}
    for surface, focus in ((mirror, -20.0), (glass, 60.0)):
        lens = load_lens({"surfaces": [surface], "sensor": focus})
        hits, ok = trace(lens, WAVE, HEIGHTS, ALONG)
        assert np.all(ok)
        np.testing.assert_allclose(hits[:, -1], np.tile([0, 0, focus], (3, 1)), atol=1e-13)


def test_a_surface_that_bends_no_light_is_on_the_line_and_changes_nothing():
    """A stop plane in front of, at and behind the first vertex, with oblique rays."""
    direction = jnp.array([0.1, 0.3, 1.0]) / jnp.sqrt(1.1)
    found = []
    for gap in (0.6, 0.0, -0.4):
        surfaces = [
            {"radius": "inf", "thickness": gap, "stop": True, "semi_diameter": 2.0},
            {"radius": 8.0, "thickness": 3.0, "index": 1.5, "semi_diameter": 4.0},
            {"radius": -9.0, "thickness": 10.0, "semi_diameter": 4.0},
        ]
        lens = load_lens({"surfaces": surfaces})
        start = HEIGHTS + jnp.array([[0.0, 0.0, gap]])
        hits, ok = trace(lens, WAVE, start, direction)
        assert np.all(ok)
        at_stop = start + direction[None] * (-start[:, 2:] / direction[2])
        np.testing.assert_allclose(hits[:, 0], at_stop, atol=1e-14)
        found.append(np.asarray(hits[:, 1:]) - [0, 0, gap])
    np.testing.assert_allclose(found[1], found[0], atol=1e-13)
    np.testing.assert_allclose(found[2], found[0], atol=1e-13)


def test_light_does_not_go_backwards_between_surfaces_that_bend_it():
    surfaces = [
        {"radius": 8.0, "thickness": 3.0, "index": 1.5, "stop": True, "semi_diameter": 3.0},
        {"radius": -9.0, "thickness": 10.0},
    ]
    lens = load_lens({"surfaces": surfaces})
    crossed = dataclasses.replace(lens, thickness=-lens.thickness)
    for each, forwards in ((lens, True), (crossed, False)):
        assert np.all(trace(each, WAVE, HEIGHTS, ALONG)[1] == forwards)


def test_an_asphere_whose_conic_is_missed():
    """A paraboloid with a term in r^2 that makes it flatter is the flatter paraboloid. An oblique
    ray meets it, but misses the steep one."""
    plane = {"radius": "inf", "thickness": 1.0, "stop": True, "semi_diameter": 3.0}
    steep = {"radius": 1 / 0.15, "conic": -1.0, "index": 1.5}
    flat = steep | {"radius": 1 / 0.03}
    direction = jnp.array([0.0, 0.9777, 0.21]) / jnp.hypot(0.9777, 0.21)
    start = jnp.array([[0.1, 1.84, 1.0]]) - 3 * direction[None]
    trials = []
    for surface in (steep | {"coefficients": {2: -0.06}}, flat, steep):
        lens = load_lens({"surfaces": [plane, surface], "sensor": 4.0})
        trials.append(trace(lens, WAVE, start, direction))
    assert np.all(trials[0][1]) and np.all(trials[1][1]) and not np.any(trials[2][1])
    np.testing.assert_allclose(trials[0][0], trials[1][0], atol=1e-13)


def _point_source(lens, distance, pupil):
    """Rays of a point source on the axis through points of a stop in the first plane."""
    stop = jnp.append(lens.semi_diameter[0] * pupil, 0.0)
    step = stop / distance + ALONG
    size = jnp.linalg.norm(step)
    return trace_snell(lens, WAVE, stop, step / size, size * distance)


sources = jax.jit(jax.vmap(jax.vmap(_point_source, (None, None, 0))))


def test_conics_far_off_axis_image_their_foci():
    """The families "turned" and "foci" of `experiments.stability`, mirrors that turn the beam by 30
    to 150 degrees. The chief ray meets the middle of the sensor, and all rays do if the sensor is
    at a focus. A ray from the focus of a paraboloid has the length R / (1 - cosine), where R is the
    vertex radius and cosine that of the angle between the ray and the direction in which all rays
    leave."""
    for name in ("turned", "foci"):
        for scenes in draw(name, 300, 5, ((1, False), (2, False))):
            hits, ok = (np.asarray(a) for a in sources(scenes.lens, scenes.distance, scenes.pupil))
            assert np.mean(ok) > 0.99 and np.all(ok[:, 0])
            sensor = np.column_stack([scenes.lens.decentre[:, -1], scenes.lens.sensor])
            miss = hits[:, :, -1] - sensor[:, None]
            far = np.max(np.where(ok, np.linalg.norm(miss, axis=-1), 0), axis=1)
            assert np.max(np.linalg.norm(miss[:, 0], axis=-1)) < 1e-8
            assert np.mean(far < 1e-8) > 0.25
            if name == "foci" or scenes.lens.count > 2:
                continue
            from_focus = np.isfinite(scenes.distance)
            way = hits[from_focus][:, :, 1] + scenes.distance[from_focus, None, None] * [0, 0, 1]
            length = np.linalg.norm(way, axis=-1)
            leaving = (hits[:, :1, 2] - hits[:, :1, 1])[from_focus]
            leaving = leaving / np.linalg.norm(leaving, axis=-1, keepdims=True)
            radius = 1 / np.abs(scenes.lens.curvature[from_focus, 1])[:, None]
            expected = radius / (1 - np.sum(way * leaving, -1) / length)
            good = ok[from_focus]
            np.testing.assert_allclose(length[good], expected[good], rtol=1e-10)
