"""Apertures of other shapes, and obscurations, compared with areas, geometry and sums of many
rays."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import (
    Clipped,
    Gauss,
    Pattern,
    Scene,
    Soft,
    Status,
    focus_moments,
    load_lens,
    trace_rays,
)

GREEN = (0.55,)
R = 2.0


def beam(**keys):
    """A plane wave passes a stop and continues: the spot is the aperture."""
    stop = {"radius": "inf", "semi_diameter": R, "stop": True, **keys}
    return load_lens(
        {"surfaces": [{"radius": "inf", "thickness": 2.0, "index": 1.5}, stop], "sensor": 4.0}
    )


# Area, mean and variances of each shape.
CLEAR = {
    "rectangle": ({"rectangle": [1.0, 0.7], "centre": [0.2, 0.5]}, 2.8, [1 / 3, 0.49 / 3]),
    "slit": ({"rectangle": [1.0, 0.01], "centre": [0.2, 0.5]}, 0.04, [1 / 3, 1e-4 / 3]),
    "ellipse": ({"ellipse": [1.5, 0.02], "centre": [0.1, -0.2]}, 0.03 * np.pi, [0.5625, 1e-4]),
    "circle": ({"circle": 0.6, "centre": [0.3, -0.2]}, 0.36 * np.pi, [0.09, 0.09]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CLEAR)
def test_light_and_spot_of_a_clear_aperture(name):
    aperture, area, variances = CLEAR[name]
    # One program for all: of the other shapes there are wide ones.
    wide = {"rectangle": [9.0, 9.0]}, {"ellipse": [9.0, 9.0]}, {"circle": 9.0}
    lens = beam(aperture=[aperture if {*w} < {*aperture} else w for w in wide])
    found = focus_moments(lens, Scene.point(0.0, jnp.inf, GREEN), sampling=Clipped(16, "none"))
    np.testing.assert_allclose(found.throughput, area / (np.pi * R**2), rtol=1e-12)
    np.testing.assert_allclose(found.mean[0], aperture["centre"], atol=1e-11)
    np.testing.assert_allclose(found.spread[0, 0], [*variances, 0], rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_light_past_a_ring_and_a_bar():
    """A central obscuration and a bar across: area and variances of the disc minus those of both,
    plus those of their overlap; integrals over x in closed form or by a dense rule."""
    hole, bar = 0.66, 0.04
    lens = beam(obscuration=[{"circle": hole}, {"rectangle": [bar, 3.0]}])
    found = focus_moments(lens, Scene.point(0.0, jnp.inf, GREEN), sampling=Clipped(12, "bilateral"))
    nodes, weights = np.polynomial.legendre.leggauss(40)

    def part(radius, wide):  # |x| < wide inside of a circle: area and integrals of x^2 and y^2
        t = np.arcsin(min(wide / radius, 1)) * nodes  # x = radius sin t
        x, y = radius * np.sin(t), radius * np.cos(t)
        step = np.arcsin(min(wide / radius, 1)) * weights * y * 2 * y
        return np.array([step.sum(), step @ x**2, step @ y**2 / 3])

    area, *squares = part(R, R) - part(hole, hole) - part(R, bar) + part(hole, bar)
    np.testing.assert_allclose(found.throughput, area / (np.pi * R**2), rtol=1e-11)
    np.testing.assert_allclose(found.spread[0, 0], np.array(squares) / area, rtol=1e-10)


@pytest.mark.slow
def test_no_light_passes_an_obscuration_that_hides_the_stop():
    lens = beam(obscuration=[{"circle": 2.5}, {"rectangle": [0.1, 0.1]}])
    with pytest.raises(ValueError, match="no ray at"):
        focus_moments(lens, Scene.point(0.0, jnp.inf, GREEN), sampling=Clipped(12, "bilateral"))


# An ellipse in front of the lens, a bar and a disc on a stop behind it that bends no light.
CUT = {
    "surfaces": [
        {
            "radius": "inf",
            "thickness": 6.0,
            "aperture": {"ellipse": [2.5, 1.4], "centre": [0, 0.4]},
        },
        {"radius": 12.0, "conic": -0.5, "thickness": 2.0, "index": 1.5},
        {"radius": "inf", "thickness": 3.0, "semi_diameter": R, "stop": True}
        | {"obscuration": [{"rectangle": [0.5, 0.3], "centre": [0, 0.8]}, {"circle": 0.4}]},
        {"radius": -30.0},
    ],
    "sensor": 20.0,
}


def blur(lens, field=0.08):
    found = focus_moments(
        lens, Scene.point(field, jnp.inf, GREEN), sampling=Clipped(12, "bilateral")
    )
    spot = found.at(lens.sensor)
    return jnp.concatenate([spot.throughput, spot.mean[0, 1:], jnp.diagonal(spot.covariance[0])])


@pytest.fixture(scope="module")
def cut():
    return load_lens(CUT)


@pytest.mark.slow
def test_the_status_of_rays(cut):
    points = np.random.default_rng(1).uniform(-1, 1, (400, 2))
    rays = trace_rays(cut, Scene.point((0.05, 0.08), 300.0, GREEN), points)
    x, y = np.moveaxis(np.asarray(rays.points[0, :, :, :2]), -1, 0)
    before = (x[:, 0] / 2.5) ** 2 + ((y[:, 0] - 0.4) / 1.4) ** 2 <= 1
    bar = (np.abs(x[:, 2]) < 0.5) & (np.abs(y[:, 2] - 0.8) < 0.3)
    open_ = before & ~bar & (np.hypot(x[:, 2], y[:, 2]) > 0.4)
    assert 50 < np.sum(open_) < 350 and np.any(before & bar)
    np.testing.assert_array_equal(rays.status[0], np.where(open_, Status.OK, Status.CLIPPED))


@pytest.mark.slow
def test_agrees_with_many_rays_that_drop_out(cut):
    side = (np.arange(400) + 0.5) / 200 - 1
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    grid = grid[np.sum(grid**2, axis=1) <= 1]
    rays = trace_rays(cut, Scene.point(0.08, jnp.inf, GREEN), grid)
    hits = np.asarray(rays.points[0, :, -1, :2])[np.asarray(rays.status[0]) == 0]
    share, height, *spread = blur(cut)
    np.testing.assert_allclose(share, len(hits) / len(grid), rtol=2e-3)
    np.testing.assert_allclose(spread, hits.var(axis=0), rtol=3e-3)
    np.testing.assert_allclose(height, hits.mean(axis=0)[1], atol=1e-3)


@pytest.mark.slow
def test_derivatives_by_sizes_and_centres(cut):
    """Forward and reverse mode, in jit and vmap, compared with fourth-order differences."""
    many = jax.jit(jax.vmap(blur))
    of = lambda apertures: blur(dataclasses.replace(cut, apertures=apertures))  # noqa: E731
    change = jax.tree.map(lambda a: jnp.cos(jnp.arange(a.size)).reshape(a.shape), cut.apertures)
    forward = jax.jit(lambda a: jax.jvp(of, (a,), (change,))[1])(cut.apertures)
    slopes = jax.jit(jax.jacrev(of))(cut.apertures)
    both = zip(jax.tree.leaves(slopes), jax.tree.leaves(change), strict=True)
    total = sum(jnp.tensordot(a, b, axes=2) for a, b in both)
    np.testing.assert_allclose(forward, total, rtol=1e-9)
    h = 1e-3
    for leaf, places in (
        ("half", [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0)]),
        ("centre", [(0, 1), (1, 1)]),
    ):
        value = getattr(cut.apertures, leaf)
        lenses = [
            dataclasses.replace(
                cut, apertures=dataclasses.replace(cut.apertures, **{leaf: value.at[k].add(s * h)})
            )
            for k in places
            for s in (-2, -1, 1, 2)
        ]
        stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lenses)
        f = np.asarray(many(stacked)).reshape(len(places), 4, -1)
        difference = (f[:, 0] - 8 * f[:, 1] + 8 * f[:, 2] - f[:, 3]) / (12 * h)
        ours = np.stack([np.asarray(getattr(slopes, leaf))[:, *k] for k in places])
        assert np.all(np.max(np.abs(ours), axis=1) > 1e-3)
        np.testing.assert_allclose(ours, difference, rtol=1e-6, atol=1e-8)
    assert np.all(np.asarray(slopes.half)[:, 2, 1] == 0)  # a circle has one size


@pytest.mark.slow
def test_a_telescope_with_a_hole():
    """On axis and at 5 arc minutes: throughput, focal length, and the spot compared with a rule on
    the known ring. The error decreases with the order as on a disc."""
    lens = load_lens("hubble")
    np.testing.assert_allclose(drt_jax.focal_length(lens, GREEN), 57600, rtol=1e-5)
    assert drt_jax.pupil.symmetry_of(lens, 0.0) == "rotational"
    nodes, weights = np.polynomial.legendre.leggauss(12)
    square = 0.33**2 + (1 - 0.33**2) * (nodes + 1) / 2
    angle = 2 * np.pi * np.arange(24) / 24
    points = np.sqrt(square) * np.stack([np.cos(angle), np.sin(angle)])[..., None]
    share = np.broadcast_to(weights / 2 / 24, (24, 12))
    ring = Pattern(points.reshape(2, -1).T, share.ravel())
    whole = dataclasses.replace(lens, apertures=None)
    for field in (0.0, np.radians(5 / 60)):
        wanted = drt_jax.psf_moments(whole, Scene.point(field, jnp.inf, GREEN), sampling=ring)
        for order, error in ((4, 1e-6), (6, 1e-8)):
            rule = Clipped(order, "bilateral", 10)
            found = drt_jax.psf_moments(lens, Scene.point(field, jnp.inf, GREEN), sampling=rule)
            np.testing.assert_allclose(found.throughput, 1 - 0.33**2, rtol=1e-12)
            size = np.trace(wanted.covariance[0]) + 1e-8  # 0.1 um: the spot on axis is smaller
            np.testing.assert_allclose(found.covariance, wanted.covariance, atol=error * size)
            np.testing.assert_allclose(found.mean, wanted.mean, atol=1e-9)


@pytest.mark.slow
def test_a_rule_does_not_step_over_an_obscuration():
    lens = beam(obscuration={"circle": 0.05})
    assert isinstance(
        drt_jax.converge(drt_jax.psf_moments, lens, Scene.point(0.0, 1e4, GREEN), 1e-3), Clipped
    )
    share = focus_moments(
        lens, Scene.point(0.0, 1e4, GREEN), sampling=Gauss(2, "rotational")
    ).throughput
    np.testing.assert_allclose(share, 1)


@pytest.mark.slow
def test_soft_edges_tend_to_hard_ones():
    lens = beam(obscuration={"rectangle": [0.5, 0.4]}, aperture={"ellipse": [1.2, 0.9]})
    share = jax.jit(
        lambda w: (
            focus_moments(
                lens, Scene.point(0.0, jnp.inf, GREEN), sampling=Soft(40, "bilateral", w)
            ).throughput
        )
    )
    errors = [abs(float(share(w)[0]) - (0.27 - 0.2 / np.pi)) for w in (0.05, 0.02)]
    assert max(errors) < 1e-3


def test_symmetry():
    def of(field=0.0, **aperture):
        return drt_jax.pupil.symmetry_of(beam(obscuration=aperture), field)

    assert of(circle=1.0) == "rotational" and of(circle=1.0, centre=[0, 0]) == "bilateral"
    assert of(rectangle=[1.0, 1.0]) == of(ellipse=[1.0, 0.5], centre=[0, 1]) == "bilateral"
    assert of(circle=1.0, centre=[0.1, 0]) == "none"
    with pytest.raises(ValueError, match="symmetry"):
        jax.jit(lambda lens: jnp.zeros(len(drt_jax.pupil.symmetry_of(lens, 0.0))))(
            beam(aperture=CLEAR["slit"][0])
        )


def inside_of(corners, radius):
    """Area and integrals of x and y of the part of a polygon (N, 2) inside a circle, by Green's
    theorem along its sides and along the arcs between them. The sides are cut where they cross the
    circle."""
    total, nodes, weights = np.zeros(3), *np.polynomial.legendre.leggauss(40)
    for a, b in zip(corners, np.roll(corners, -1, axis=0)):
        d = b - a
        roots = np.roots([d @ d, 2 * a @ d, a @ a - radius**2])
        cuts = [t for t in np.real(roots) if np.all(np.isreal(roots)) and 0 < t < 1]
        ends = np.array([a + t * d for t in (0, *sorted(cuts), 1)])
        for p, q in itertools.pairwise(ends):
            if np.hypot(*(p + q)) < 2 * radius:  # a triangle from the centre
                area = np.array([p[0] * q[1] - p[1] * q[0]]) / 2
                total += np.append(area, area * (p + q) / 3)
                continue
            start, end = np.arctan2(*p[::-1]), np.arctan2(*q[::-1])
            half = ((end - start + np.pi) % (2 * np.pi) - np.pi) / 2
            angle = start + half * (1 + nodes)
            lines = np.stack(
                [0 * angle + 1 / 2, radius / 3 * np.cos(angle), radius / 3 * np.sin(angle)]
            )
            total += lines @ weights * half * radius**2
    return total


def seen_through(corners):
    """Throughput and mean position on the stop, behind an L with a triangle in it."""
    outer, inner = (inside_of(c, R) for c in corners)
    total = outer - inner
    return np.append(total[0] / (np.pi * R**2), total[1:] / total[0])


@pytest.mark.slow
def test_polygons_whole_and_with_inward_corners():
    """A decentred L that the rim clips, and a triangle across the line between its pieces:
    throughput, mean, and their derivatives by all corners, compared with differences of closed
    forms."""
    shift = np.array([0.1, -0.2])
    outer = np.array([[-1.5, -1.0], [2.6, -1.2], [2.5, 0.2], [0.1, 0.0], [0.0, 2.2], [-1.4, 1.9]])
    inner = np.array([[-0.9, -0.6], [0.7, -0.8], [-0.9, 0.7]])
    lens = beam(
        aperture={"polygon": outer.tolist(), "centre": shift.tolist()},
        obscuration={"polygon": inner.tolist(), "centre": shift.tolist()},
    )
    rule = Clipped(10, drt_jax.pupil.symmetry_of(lens, 0.0))

    @jax.jit
    def found(corners):
        own = dataclasses.replace(lens.apertures, corners=corners)
        moved = dataclasses.replace(lens, apertures=own)
        points, weights = drt_jax.pupil.pupil_points(moved, Scene.point(0.0, jnp.inf, GREEN), rule)
        share = jnp.sum(weights[0])
        return jnp.append(share, weights[0] @ points[0] * R / share)

    known = [outer + shift, inner + shift]
    corners = lens.apertures.corners
    way = np.random.default_rng(0).normal(size=(2, 6, 2))
    value, slope = jax.jit(lambda c: jax.jvp(found, (c,), (jnp.asarray(way),)))(corners)
    np.testing.assert_allclose(value, seen_through(known), rtol=1e-9)

    def at(step):
        return seen_through([c + step * w[: len(c)] for c, w in zip(known, way)])

    np.testing.assert_allclose(slope, (at(1e-5) - at(-1e-5)) / 2e-5, rtol=1e-6, atol=1e-8)
