"""Traced rays compared with Snell's law; digits of other programs are in
test_reference_cases.py."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from experiments.snell import trace_snell

from drt_jax import Scene, Status, first_order, load_lens, pupil, sag, trace_rays
from drt_jax.lens.forms import FORMS
from drt_jax.lens.lens import Labels
from drt_jax.lens.scene import checked_scene
from drt_jax.rays.rays import _trace
from drt_jax.rays.trace import trace_bundle

from ..conftest import LENSES, RGB, assert_close
from ..known import known, search

POINTS = pupil.half_disc(4, 5)[0]
SINGLET = load_lens("singlet")
# Twenty rays at three wavelengths in all tests of one lens: one program.
HEIGHTS = np.stack([np.zeros(20), np.linspace(-1, 1, 20)], axis=1)


def launch_paraxial(lens, field, distance, wavelength, points):
    """Rays aimed at the paraxial entrance pupil, as design programs do without ray aiming: points
    (Q, 3) on the first vertex plane and unit directions, for points (Q, 2) of the pupil."""
    image = first_order(lens, jnp.inf, jnp.array([wavelength])).entrance_pupil
    place, v, slope = image.position[0], 1 / distance, jnp.tan(field)
    height = jnp.broadcast_to(place, (len(points), 1))
    target = jnp.concatenate([image.semi_diameter[0] * points, height], axis=1)
    # From the object point (0, -slope, -1) / v; the scale v keeps it finite.
    direction = v * target + jnp.array([0.0, slope, 1.0])[None]
    start = target - direction * (place / direction[:, 2:])
    return start, direction / jnp.linalg.norm(direction, axis=1, keepdims=True)


LARGER = ("double_gauss_addon", "cooke_triplet", "asphere")


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
        points = np.asarray(rays.points[k])
        direction = entering(points[:, 0], field, distance)
        start = points[:, 0] - 5 * direction
        hits, ok = snell(lens, jnp.asarray(wavelength, float), start, direction)
        assert np.all(ok)
        worst = max(worst, float(np.max(np.abs(hits - points))))
    return worst


def asphere():
    """Aspheres of many orders on both sides of the stop."""
    surfaces = [
        {"radius": 30, "conic": -0.8, "coefficients": {4: 2e-6, 6: -4e-9}, "thickness": 6},
        {"radius": -200, "coefficients": {2: 1e-4, 4: 1e-5}, "thickness": 3},
        {"radius": "inf", "thickness": 3, "semi_diameter": 6, "stop": True},
        {"radius": -40, "conic": 2.0, "coefficients": {4: -1e-5}, "thickness": 2, "glass": "SF10"},
        {"curvature": 0.001},
    ]
    surfaces[0]["index"] = 1.7
    return load_lens({"surfaces": surfaces, "sensor": 60.0})


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n in LARGER else n for n in (*LENSES, "asphere")],
)
def test_hits_agree_with_snell_to_1e_11_mm(name):
    lens = asphere() if name == "asphere" else load_lens(name)
    for distance in (np.inf, 25000.0, 400.0):
        for degrees in (0.0, 5.0, 10.0):
            field = np.radians(degrees)
            rays = trace_rays(lens, Scene.point(field, distance, RGB), POINTS)
            assert np.all(rays.status == Status.OK)
            assert against_snell(lens, rays, field, distance, RGB) < 1e-11


# Terms of a form, and how much of which power of r, or of x and y, each is, in units of the radius
# of the norm: the closed forms of Forbes (2007) and Noll (1976).
FORBES = {0: {2: 1.0, 4: -1.0}, 1: {2: 13 / 19**0.5, 4: -29 / 19**0.5, 6: 16 / 19**0.5}}
NOLL = {
    2: {"x1y0": 2.0},
    5: {"x1y1": 2 * 6**0.5},
    6: {"x2y0": 6**0.5, "x0y2": -(6**0.5)},
    8: {"x3y0": 3 * 8**0.5, "x1y2": 3 * 8**0.5, "x1y0": -2 * 8**0.5},
}
SIZES = {"qbfs": {0: 0.03, 1: -0.02}, "zernike": {2: 0.004, 5: 0.01, 6: -0.02, 8: 0.01}}


@pytest.mark.slow
def test_forms_that_equal_others_have_the_same_gradients():
    """Flat surfaces of Forbes and of Zernike terms, also as even asphere and XY polynomial."""
    radius, rows, others, parts = 9.0, [], [], []
    for form, other, terms in (("qbfs", "asphere", FORBES), ("zernike", "polynomial_xy", NOLL)):
        powers = FORMS[other].powers[:12]
        part = np.zeros((len(terms), 12))
        for i, powers_of_term in enumerate(terms.values()):
            for power, size in powers_of_term.items():
                degree = power if form == "qbfs" else int(power[1]) + int(power[3])
                part[i, powers.index(power)] = size / radius**degree
        same = dict(zip(powers, list(SIZES[form].values()) @ part))
        rows.append({"form": form, "norm_radius": radius, "coefficients": SIZES[form]})
        others.append({"form": other, "coefficients": same})
        parts.append(part)
    front = {"radius": 40, "thickness": 5, "index": 1.5, "semi_diameter": 6, "stop": True}
    media = ({"thickness": 3}, {"index": 1.7, "thickness": 4}, {"radius": -90, "thickness": 60})
    lens, other = (
        load_lens({"surfaces": [front, *({"radius": "inf"} | a | b for a, b in zip(media, forms))]})
        for forms in ([*rows, {}], [*others, {}])
    )
    points, scene = (
        tuple(POINTS.T),
        checked_scene(lens, Scene.point(jnp.array([0.05, 0.1]), 500.0, RGB[:1])),
    )
    found = search(lens, scene, points)
    assert np.all(found.status == Status.OK)

    def value(lens):
        return jnp.sum(jnp.sin(jnp.stack(trace_bundle(lens, scene, points, known(found)).hits)))

    ours, theirs = (jax.jit(jax.grad(value))(a) for a in (lens, other))
    for i, (form, part) in enumerate(zip(SIZES, parts), start=1):
        x, y = (a[i] for a in found.hits)
        np.testing.assert_allclose(sag(lens, i, x, y), sag(other, i, x, y), atol=1e-15)
        columns = [1 + FORMS[form].powers.index(term) for term in SIZES[form]]
        by_terms = ours.coefficients[i][np.array(columns)]
        np.testing.assert_allclose(by_terms, part @ theirs.coefficients[i], rtol=1e-9)
    for name in ("curvature", "conic", "thickness", "semi_diameter", "sensor"):
        assert_close(getattr(ours, name), getattr(theirs, name), 1e-9)


@pytest.mark.slow
def test_float32_hits_within_a_tenth_of_a_micrometre():
    """Also for an object at 25 m, off axis, where other tracers have errors of 24 um in float32."""
    lens = load_lens("double_gauss")
    single = jax.tree.map(lambda a: a.astype(jnp.float32), lens)
    for distance in (np.inf, 25000.0):
        exact = trace_rays(lens, Scene.point(0.17, distance, RGB), POINTS)
        rays = trace_rays(single, Scene.point(0.17, distance, RGB), POINTS)
        assert rays.points.dtype == jnp.float32 and np.all(rays.status == Status.OK)
        assert np.max(np.abs(rays.points - np.asarray(exact.points, np.float32))) < 1e-4


def test_distance_is_continuous_to_infinity():
    lens = load_lens("double_gauss")

    def hits(distance):
        return np.asarray(
            trace_rays(lens, Scene.point(0.1, distance, RGB), POINTS).points[:, :, -1]
        )

    near, far = hits(1e9), hits(np.inf)
    slope = (hits(1e5) - far) * 1e5  # by 1/distance, to 1e-4 of it
    for distance in (1e9, 1e8, 1e7, 1e6):
        predicted = far + slope / distance
        np.testing.assert_allclose(hits(distance), predicted, rtol=0, atol=2 / distance + 1e-11)
    np.testing.assert_allclose(near, far, rtol=0, atol=1e-5)


def with_dummy(lens, gap, curvature):
    """`lens` with a surface of the given curvature in the middle of a gap, which bends no light."""
    i = gap + 1
    half = lens.thickness[gap] / 2

    def insert(array, value):
        return jnp.concatenate([array[:i], jnp.full_like(array[:1], value), array[i:]])

    dispersion = jax.tree.map(lambda a: jnp.insert(a, i, a[i], axis=0), lens.dispersion)
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
        dispersion=dispersion,
        labels=Labels("", (*lens.glasses[:i], lens.glasses[i], *lens.glasses[i:])),
        stop=lens.stop + (i <= lens.stop),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "gap, curvature", [(2, 0.01), pytest.param(7, 0.0, marks=pytest.mark.slow)]
)
def test_a_surface_that_does_nothing_drops_out(gap, curvature):
    lens = load_lens("double_gauss")
    padded = with_dummy(lens, gap, curvature)
    wanted = trace_rays(lens, Scene.point(0.15, 25000.0, RGB), POINTS)
    rays = trace_rays(padded, Scene.point(0.15, 25000.0, RGB), POINTS)
    assert rays.newton_steps == wanted.newton_steps
    real = [k for k in range(13) if k != gap + 1]
    points = np.asarray(rays.points)
    np.testing.assert_allclose(points[:, :, real], wanted.points, atol=1e-13)
    before, dummy, after = (points[:, :, gap + k] for k in range(3))
    assert np.max(np.abs(np.cross(dummy - before, after - dummy))) < 1e-12  # on the ray ...
    x, y, z = np.moveaxis(dummy, -1, 0)
    height = sag(padded, gap + 1, x, y)
    wanted = z - float(padded.vertices[gap + 1])
    np.testing.assert_allclose(height, wanted, atol=1e-12)  # ... and on the surface


def singlet(**changes):
    """The singlet with other rows; its last is the sensor."""
    return dataclasses.replace(SINGLET, **{k: jnp.asarray(v, float) for k, v in changes.items()})


def test_a_clear_aperture_clips_and_changes_no_other_ray():
    free = trace_rays(SINGLET, Scene.point(0.0, 25000.0, RGB), HEIGHTS)
    narrow = singlet(semi_diameter=[5.0, 4.0, 12.5, np.inf])
    rays = trace_rays(narrow, Scene.point(0.0, 25000.0, RGB), HEIGHTS)
    clipped = np.abs(np.asarray(free.points[:, :, 1, 1])) > 4
    assert 0 < np.sum(clipped) < 60
    np.testing.assert_array_equal(rays.status, np.where(clipped, Status.CLIPPED, Status.OK))
    np.testing.assert_array_equal(rays.points, free.points)


def test_failed_rays_carry_a_status_and_no_nan():
    steep = singlet(semi_diameter=[80.0, np.inf, np.inf, np.inf])
    rays = trace_rays(steep, Scene.point(0.0, jnp.inf, RGB), HEIGHTS)
    status = np.asarray(rays.status)
    assert np.all(status[:, 9:11] == Status.OK) and np.all(status[:, 0] == Status.MISSED)
    for a in (rays.points, rays.directions, rays.path):
        assert np.all(np.isfinite(a)) and np.all(np.asarray(a)[status > 0] == 0)


@pytest.mark.slow
def test_failed_rays_change_no_gradient():
    """Rays that miss the exit surface or are totally reflected there, or whose wavelength is
    outside the range of the glass, together with rays that arrive; by the usual call, in reverse
    mode."""
    bent = singlet(
        curvature=[0.0, 0.0, -0.02, 0.0],
        thickness=[2.0, 60.0],
        semi_diameter=[80.0, np.inf, np.inf, np.inf],
        sensor=150.0,
    )

    @jax.jit
    def gradient(lens, colours, weights):
        def total(lens):
            rays = trace_rays(lens, Scene.point(0.0, jnp.inf, colours), HEIGHTS)
            height = jnp.sum(rays.points[..., 1] ** 2, axis=-1)
            return jnp.sum(weights * (height + rays.path)), rays.status

        return jax.grad(total, has_aux=True)(lens)

    slopes, status = gradient(bent, jnp.array([0.6, 0.1, 0.48]), np.ones((3, 20)))
    status = np.asarray(status)
    assert np.all(status[1] == Status.NO_INDEX)
    assert {Status.OK, Status.MISSED, Status.TIR} == set(status[[0, 2]].ravel().tolist())
    weights = np.where(status == Status.OK, 1.0, 0.0)
    wanted, _ = gradient(bent, jnp.array([0.6, 0.5, 0.48]), weights)
    assert all(np.all(np.isfinite(a)) for a in jax.tree.leaves(slopes))
    assert_close(slopes, wanted, 1e-12)


def test_bad_requests():
    with pytest.raises(ValueError, match="one angle or two"):
        trace_rays(SINGLET, Scene.point([0.0, 0.1, 0.2], jnp.inf, RGB), HEIGHTS)
    with pytest.raises(ValueError, match="distance: expected one number"):
        trace_rays(SINGLET, Scene.point(0.0, [[1.0, 2.0]], RGB), HEIGHTS)
    with pytest.raises(ValueError, match="N-BK7"):
        trace_rays(SINGLET, Scene.point(0.0, jnp.inf, [0.1]), HEIGHTS)


def test_directions_and_paraxial_launch():
    """A lens whose stop is its first surface: its entrance pupil is the stop, so that rays aimed at
    it paraxially are the same; directions are those between the points."""
    for distance in (jnp.inf, 400.0):
        rays = trace_rays(SINGLET, Scene.point(0.1, distance, RGB), HEIGHTS)
        start, direction = launch_paraxial(SINGLET, 0.1, distance, RGB[0], jnp.asarray(HEIGHTS))
        np.testing.assert_allclose(direction, rays.directions[0, :, 0], atol=1e-14)
        hits, ok = snell(SINGLET, jnp.asarray(RGB[0], float), start, direction)
        assert np.all(ok)
        np.testing.assert_allclose(hits, rays.points[0], atol=1e-11)
        steps = np.diff(np.asarray(rays.points[0]), axis=1)
        steps /= np.linalg.norm(steps, axis=-1, keepdims=True)
        np.testing.assert_allclose(rays.directions[0, :, 1:], steps, atol=1e-13)


@pytest.mark.slow
def test_bundles_of_nearly_as_many_rays_share_a_program():
    """Outside of `jit`, also in eager derivatives: each ray is the same in any bundle."""

    def arrive(field, count):
        return trace_rays(SINGLET, Scene.point(field, jnp.inf, RGB), HEIGHTS[:count]).points[
            :, :, -1, 1
        ]

    many, programs = arrive(0.1, 20), _trace.program()._cache_size()
    for count in (17, 18, 19):
        assert_close(arrive(0.1, count), many[:, :count], 1e-13)
    assert _trace.program()._cache_size() <= programs + 1  # 18 rays, and 20
    few, slopes = jax.jvp(lambda field: arrive(field, 19), (0.1,), (1.0,))
    _, inside = jax.jit(lambda f: jax.jvp(lambda f: arrive(f, 19), (f,), (1.0,)))(0.1)
    assert few.shape == (3, 19)
    assert_close(slopes, inside, 1e-12)


def test_the_chief_ray_alone_through_a_stop_at_the_first_mirror():
    """Only the field determines the size of the beam: the chief ray of a Mersenne telescope."""
    rows = [
        {"radius": -200, "conic": -1, "mirror": True, "stop": True, "thickness": -75.0},
        {"radius": -50, "conic": -1, "mirror": True},
    ]
    rows[0]["semi_diameter"] = 20.0
    lens = load_lens({"surfaces": rows, "sensor": 10.0})
    alone = trace_rays(lens, Scene.point(0.002, np.inf, [0.5]), [[0, 0]])
    both = trace_rays(lens, Scene.point(0.002, np.inf, [0.5]), [[0, 0], [0, 0.5]])
    assert alone.status[0, 0] == both.status[0, 0] == Status.OK
    np.testing.assert_allclose(alone.points[0, 0], both.points[0, 0], atol=1e-13)
