"""The intersection routine and the sequential trace, compared with closed forms and the reference
trace."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.snell import trace_snell

from drt_jax import Status, load_lens
from drt_jax.lens.forms import FORMS, Shape
from drt_jax.lens.surface import domain, surface_sag
from drt_jax.rays import fermat, meet, snell

from ..lens.test_surface import SHAPES
from .systems import COLOURS, DISTANCE, corners, freeform, lens_with, meridional, scene_system

CONICS = ("plane", "sphere", "ellipsoid", "paraboloid", "hyperboloid")
GROUPS = {"conics": CONICS} | {
    form: [n for n in SHAPES if SHAPES[n][0] == form and n not in CONICS] for form in FORMS
}
STEPS = 10.0 ** -np.arange(1.0, 7.5, 0.5)


def stacked(names):
    """Shapes of one form, for broadcasting against (shape, ray)."""
    most = max(len(SHAPES[n][3]) for n in names)
    rows = [np.pad(SHAPES[n][3], (0, most - len(SHAPES[n][3]))) for n in names]
    c, k = (np.array([SHAPES[n][i] for n in names])[:, None] for i in (1, 2))
    return Shape(c, k, np.array(rows).T[..., None])


def lines(count, rays=8):
    """Lines (shape, ray) some mm in front of a vertex, alternately forwards and backwards;
    directions of any length."""
    generator = np.random.default_rng(0)
    shape = (count, rays)
    p = [generator.uniform(-6, 6, shape), generator.uniform(-6, 6, shape)]
    p = (*p, generator.uniform(-8, 8, shape))
    d = [generator.uniform(-0.4, 0.4, shape), generator.uniform(-0.4, 0.4, shape)]
    sign = np.where(np.arange(rays) % 2, -1.0, 1.0) * np.ones(shape)
    scale = generator.uniform(0.3, 3, shape)
    d = (*(scale * a for a in d), scale * sign)
    return p, d


class Met(NamedTuple):
    """length, slope, bend: (places, shape, ray), length of a line to a surface, and its first and
    second derivative along a path of the arguments. met: (shape, ray). miss: (shape, ray), distance
    of the point from the surface, mm, if the surface exists there: exists."""

    length: np.ndarray
    slope: np.ndarray
    bend: np.ndarray
    met: np.ndarray
    miss: np.ndarray
    exists: np.ndarray


@functools.partial(jax.jit, static_argnums=0)
def along_a_way(form, p, d, shape, way, places):
    """All results for a form, in one program."""
    going, side = jnp.ones(p[0].shape, bool), jnp.sign(d[-1])

    def at(h):
        moved = jax.tree.map(lambda a, v: a + h * v, (p, d, shape), way)
        return meet.reach(form, *moved, going, side, None)[0]

    def slope(h):
        value, first = jax.jvp(at, (h,), (jnp.ones_like(h),))
        return first, value

    def both(h):
        first, second, value = jax.jvp(slope, (h,), (jnp.ones_like(h),), has_aux=True)
        return value, first, second

    length, met = meet.reach(form, p, d, shape, going, side, None)
    *across, z = (a + length * b for a, b in zip(p, d, strict=True))
    miss = surface_sag(across, shape, form) - z
    return Met(*jax.vmap(both)(places), met, miss, domain(across, shape, form))


@pytest.fixture(scope="module", params=GROUPS)
def case(request):
    """Names of shapes, their arguments, and the results along a random path from these."""
    names = GROUPS[request.param]
    shape, (p, d) = stacked(names), lines(len(names))
    generator = np.random.default_rng(2)
    sizes = [0.3 * np.ones_like(a) for a in (*p, *d)]
    # Of the size of what is there; a plane may bend by 1e-3 per mm.
    units = (1e-3, 0.1, 0.0)
    sizes += [np.where(a == 0, u, 0.1 * np.abs(a)) for a, u in zip(shape, units, strict=True)]
    way = [size * generator.uniform(-1, 1, size.shape) for size in sizes]
    way = tuple(way[:3]), tuple(way[3:6]), Shape(*way[6:])
    places = np.concatenate([[0.0], STEPS, -STEPS])
    found = along_a_way(SHAPES[names[0]][0], p, d, shape, way, places)
    return names, (p, d, shape), jax.tree.map(np.asarray, found)


def test_rays_meet_the_surface(case):
    *_, found = case
    assert np.all(found.met) and np.all(found.exists)
    np.testing.assert_allclose(found.miss, 0, atol=2e-14)


@pytest.mark.parametrize("case", ["conics"], indirect=True)
def test_conics_against_the_roots_of_their_equation(case):
    """Of the two points of a conic on a line, the one on the sheet of the vertex, where 1 - (1 + k)
    c z is positive, which the line crosses from the side on which its vertex plane lies."""
    names, (p, d, shape), found = case
    for i in range(len(names)):
        c, k = shape.curvature[i, 0], shape.conic[i, 0]
        for q in range(p[0].shape[1]):
            (x, y, z), (u, v, w) = ([a[i, q] for a in vector] for vector in (p, d))
            square = c * (u * u + v * v + (1 + k) * w * w)
            linear = 2 * (c * (x * u + y * v + (1 + k) * z * w) - w)
            constant = c * (x * x + y * y + (1 + k) * z * z) - 2 * z
            roots = np.roots([square, linear, constant] if square else [linear, constant])
            upper = 1 - (1 + k) * c * (z + roots * w)
            rate = w * upper - c * (u * (x + roots * u) + v * (y + roots * v))
            (s,) = roots[(upper > 0) & (rate * w > 0)]
            np.testing.assert_allclose(found.length[0, i, q], s, rtol=1e-12)


def test_derivatives_of_the_length(case):
    """First and second derivatives compared with central differences, whose error is of second
    order in the step until rounding; the smallest differences are 1e-9."""
    *_, found = case
    count = len(STEPS)
    for function, derivative in ((found.length, found.slope), (found.slope, found.bend)):
        plus, minus = function[1 : 1 + count], function[1 + count :]
        error = np.abs((plus - minus) / (2 * STEPS[:, None, None]) - derivative[0])
        scale = 1 + np.abs(derivative[0])
        assert np.all(np.min(error / scale, axis=0) < 1e-9)
        worst = np.max(error / scale, axis=(1, 2))
        clear = np.cumprod(worst > 1e-8).astype(bool)
        assert np.sum(clear) >= 3
        slope = np.polyfit(np.log(STEPS[clear][-4:]), np.log(worst[clear][-4:]), 1)[0]
        assert 1.9 < slope < 2.1


def test_lines_that_meet_nothing():
    """Lines that miss a sphere of R = 10, pass beyond its rim, or run along a plane."""
    reach = jax.jit(meet.reach, static_argnums=0)
    shape = Shape(np.array([0.1, 0.1, 0.0]), np.zeros(3), np.zeros((0, 3)))
    p = tuple(np.array(a) for a in ([0.0, 0.0, 0.0], [10.5, 9.9999, 1.0], [-5.0, -5.0, -5.0]))
    d = tuple(np.array(a) for a in ([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 1.0, 0.0]))
    for terms in (0, 1):
        wider = shape._replace(coefficients=np.zeros((terms, 3)))
        length, met = reach("asphere", p, d, wider, np.ones(3, bool), np.ones(3), None)
        assert np.all(np.isfinite(length)) and not np.any(met[:2])


shoot = jax.jit(snell.shoot)
yardstick = jax.jit(jax.vmap(trace_snell, (None, None, 0, 0)))


def launches(rays=20):
    """Random points on the vertex plane of the first surface, the same for two wavelengths."""
    points = np.random.default_rng(0).uniform(-4, 4, (2, 1, rays))
    return tuple(jnp.asarray(np.broadcast_to(points, (2, 2, rays))))


@pytest.mark.slow
@pytest.mark.parametrize("lens", [lens_with("between", True), freeform()], ids=["mirror", "forms"])
@pytest.mark.parametrize("distance", [DISTANCE, np.inf])
def test_a_trace_against_the_yardstick(lens, distance):
    """Hits within 1e-12 mm; and the change of the direction of a segment by rounding of the
    hits."""
    system, launch = scene_system(lens, distance), launches()
    trace = shoot(system, launch)
    trace = trace._replace(hits=snell.split_stop(system, trace.hits)[0])
    assert np.all(trace.status == Status.OK)
    points, source = corners(system, trace.hits)
    start = np.stack([*map(np.asarray, launch), np.zeros(launch[0].shape)], axis=-1)
    direction = -source if np.isinf(distance) else start - source
    direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
    direction = np.broadcast_to(direction, start.shape)
    begin = start - 5 * direction
    rows = [*lens.active, lens.count]
    for k, colour in enumerate(COLOURS):
        hits, ok = yardstick(lens, jnp.asarray(colour, float), begin[k], direction[k])
        assert np.all(ok)
        wanted = np.moveaxis(np.asarray(hits), 1, 0)[rows]
        np.testing.assert_allclose(points[:, k], wanted, rtol=0, atol=1e-12)
    wide = np.sqrt(np.sum(np.square(trace.hits), axis=0))
    length = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    wanted = np.max(np.maximum(wide[1:], wide[:-1]) / length, axis=0)
    np.testing.assert_allclose(trace.rounding_angle, wanted, rtol=1e-12)


@pytest.mark.parametrize("stop", ["in front", "active"])
def test_the_stop_of_a_ray(stop):
    """The trace to the stop crosses it at the same point as the whole trace, and as the label of
    the ray."""

    @jax.jit
    def both(system, launch):
        hits, there = snell.split_stop(system, snell.shoot(system, launch).hits)
        label = fermat.label(fermat.geometry(hits, system), system)
        return snell.shoot_to_stop(system, launch), label, there

    (crossing, status), label, there = both(scene_system(lens_with(stop, True)), launches())
    assert np.all(status == Status.OK)
    np.testing.assert_allclose(crossing, label, rtol=0, atol=1e-12)
    np.testing.assert_allclose(crossing, there, rtol=0, atol=1e-12)


def test_status():
    """The first failure of a ray: a plane glass surface beyond the critical angle; a curved surface
    that is missed; surfaces that cross, so that the second lies behind the ray. All numbers are
    finite."""
    faces = [
        {"radius": "inf", "thickness": 60.0, "index": 1.5, "semi_diameter": 5.0, "stop": True},
        {"radius": -50, "thickness": 50.0},
    ]
    heights = jnp.asarray([[0.0, 32.0, 34.0, 49.0, 51.0]])
    lens = load_lens({"surfaces": faces})
    flat = shoot(meridional(lens, [0.55]), (heights,)).status[0]
    # sin(critical) = 1 / 1.5: at 33.3 mm of R = 50; the sphere ends at 50 mm.
    assert flat.tolist() == [Status.OK, Status.OK, Status.TIR, Status.TIR, Status.MISSED]
    faces[0] |= {"radius": 20, "thickness": 2.0, "semi_diameter": 1.0}
    faces[1]["radius"] = 50  # crosses the first face 11.5 mm from the axis
    crossed = shoot(meridional(load_lens({"surfaces": faces}), [0.55]), (heights / 2,))
    where = [Status.OK, Status.CROSSED, Status.CROSSED, Status.MISSED, Status.MISSED]
    assert crossed.status[0].tolist() == where
    assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(crossed))
