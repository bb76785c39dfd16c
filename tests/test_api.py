"""Public functions with invalid arguments: an error that names the remedy if values are known;
inside a trace finite numbers with a status that shows the failure."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Gauss, Pattern, Scene, Status, learn, load_lens, psf_moments, pupil
from drt_jax.image import diagnose
from drt_jax.lens.glass import refractive_index
from drt_jax.lens.paraxial import image_height
from drt_jax.lens.scene import checked_scene, field_of_height

LENS = load_lens("singlet")
GREEN, POINTS, RULE = (0.55,), pupil.hexapolar(1)[0], Gauss(4, "bilateral")
SCENE = (0.05, 25e3, GREEN)
# Every public function of a field, of a distance, of wavelengths, of points of the stop.
CALLS = {
    "psf_moments": lambda f, d, w, p: psf_moments(LENS, Scene.point(f, d, w)),
    "psf_moments by a rule": lambda f, d, w, p: psf_moments(
        LENS, Scene.point(f, d, w), sampling=RULE
    ),
    "focus_moments": lambda f, d, w, p: drt_jax.focus_moments(LENS, Scene.point(f, d, w)),
    "converged_rule": lambda f, d, w, p: drt_jax.converge(
        drt_jax.psf_moments, LENS, Scene.point(f, d, w)
    ),
    "converged_focus_rule": lambda f, d, w, p: drt_jax.converge(
        drt_jax.focus_moments, LENS, Scene.point(f, d, w)
    ),
    "moments_model": lambda f, d, w, p: learn.moments_model(
        LENS, ("sensor",), Scene.point(f, (d, d), w)
    ),
    "checked_scene": lambda f, d, w, p: checked_scene(LENS, Scene.point(f, d, w)),
    "trace_rays": lambda f, d, w, p: drt_jax.trace_rays(LENS, Scene.point(f, d, w), p),
    "wavefront": lambda f, d, w, p: drt_jax.wavefront(LENS, Scene.point(f, d, w), p),
    "pupil_points": lambda f, d, w, p: drt_jax.pupil.pupil_points(LENS, Scene.point(f, d, w), RULE),
    "image_point": lambda f, d, w, p: drt_jax.image_point(LENS, Scene.point(f, d, w)),
    "image_height": lambda f, d, w, p: image_height(LENS, f, d, w),
    "third_order": lambda f, d, w, p: drt_jax.third_order(LENS, Scene.point(f, d, w)),
    "field_of_image": lambda f, d, w, p: drt_jax.field_of_image(LENS, (0.0, 1.0), d, w),
    "first_order": lambda f, d, w, p: drt_jax.first_order(LENS, d, w),
    "focal_length": lambda f, d, w, p: drt_jax.focal_length(LENS, w),
}
OF_FIELD, OF_DISTANCE = list(CALLS)[:13], list(CALLS)[:15]


def refused(name, *arguments):
    """The error message, which must have one line."""
    with pytest.raises(ValueError) as caught:
        CALLS[name](*arguments)
    text = str(caught.value)
    assert "\n" not in text and len(text) < 300
    return text


@pytest.mark.parametrize("name", OF_FIELD)
def test_fields_of_90_degrees_and_more_are_refused(name):
    assert "10 rad = 573 degrees" in refused(name, 10.0, *SCENE[1:], POINTS)
    for field in (np.radians(135), np.pi, np.radians(90), -np.pi / 2, np.nan):
        assert "must be below 90; Scene.degrees takes degrees" in refused(
            name, field, *SCENE[1:], POINTS
        )
    for field in ("10", None, 1j, True, object(), [[0.0, 0.1], [0.1]]):
        assert refused(name, field, *SCENE[1:], POINTS).startswith("field: ")
    if name not in ("image_height", "third_order"):
        assert "2 rad = 114.6 degrees" in refused(name, (0.1, 2.0), *SCENE[1:], POINTS)
        assert "one angle or two" in refused(name, [0.1] * 3, *SCENE[1:], POINTS)


@pytest.mark.parametrize("name", OF_DISTANCE)
def test_an_object_at_the_first_vertex_is_refused(name):
    """An object may be in front of the vertex, or behind it (virtual)."""
    for distance in (0.0, -0.0, np.nan, 1e-7, np.float32(-1e-7), jnp.array(1e-7)):
        assert "must be 1e-06 mm or more" in refused(name, 0.05, distance, GREEN, POINTS)
    for distance in ("far", None, 1j):
        assert refused(name, 0.05, distance, GREEN, POINTS).startswith("distance: ")
    assert "one number" in refused(name, 0.05, [[1.0, 2.0]], GREEN, POINTS)


@pytest.mark.parametrize("name", CALLS)
def test_wavelengths_that_are_none_are_refused(name):
    for colours in ((), np.zeros(0), [[0.55]], "green", ["0.55"], None, (0.55 + 0j,), [True]):
        assert refused(name, *SCENE[:2], colours, POINTS).startswith("wavelengths: ")
    for colours in ((0.1,), 550.0, (np.nan,), -0.55, 0.0, (0.55, np.inf)):
        assert "outside the range of" in refused(name, *SCENE[:2], colours, POINTS)


@pytest.mark.parametrize("name", ["trace_rays", "wavefront"])
@pytest.mark.parametrize("how", [lambda call: call, jax.jit])
def test_pupils_of_other_shapes_are_refused(name, how):
    call = how(lambda points: CALLS[name](*SCENE, points))
    for shape in ((0, 2), (5, 3), (2,), (1, 2, 2), ()):
        with pytest.raises(ValueError, match=r"pupil: expected x and y of points, \(Q, 2\), got"):
            call(np.zeros(shape))
    with pytest.raises(ValueError, match="pupil.T"):
        call(np.zeros((2, 5)))


def test_pupils_that_are_no_numbers_are_refused():
    for points in ((), "all", [["a", "b"]], [[0.0, 1.0], [0.0]], np.ones((1, 2), bool)):
        for name in ("trace_rays", "wavefront"):
            assert refused(name, *SCENE, points).startswith("pupil: ")
    rays = drt_jax.trace_rays(LENS, Scene.point(*SCENE), [[0, 1], [np.nan, 0]])
    assert rays.status[0].tolist() == [Status.OK, Status.MISSED]


SHAPES = {
    "curvature": lambda a: a[:2],
    "conic": lambda a: a[None],
    "coefficients": lambda a: a[:, None],
    "thickness": lambda a: a[1:],
    "semi_diameter": lambda a: a[:3],
    "sensor": lambda a: a[None],
    "decentre": lambda a: jnp.zeros((4, 3)),
    "tilt": lambda a: jnp.zeros(4),
    "forms": lambda a: a[:-1],
    "stop": lambda a: 7,
}


@pytest.mark.parametrize("name", SHAPES)
def test_arrays_of_a_lens_that_do_not_fit_are_refused(name):
    wrong = dataclasses.replace(LENS, **{name: SHAPES[name](getattr(LENS, name))})
    for call in (
        psf_moments,
        jax.jit(lambda lens, scene: psf_moments(lens, scene, sampling=RULE)),
    ):
        with pytest.raises(ValueError, match=rf"lens\.{name}: expected"):
            call(wrong, Scene.point(*SCENE))
    with pytest.raises(ValueError, match=rf"lens\.{name}: expected"):
        drt_jax.focal_length(wrong, GREEN)


@pytest.mark.parametrize("kind", [jnp.int32, jnp.float32, jnp.complex64])
def test_dtypes_of_a_lens_that_do_not_fit_are_refused(kind):
    for name in ("curvature", "sensor"):
        wrong = dataclasses.replace(LENS, **{name: getattr(LENS, name).astype(kind)})
        with pytest.raises(ValueError, match=r"lens\.\w+: expected"):
            psf_moments(wrong, Scene.point(*SCENE))


@pytest.mark.slow
def test_a_lens_of_arrays_of_numpy_or_of_numbers_will_do():
    same = dataclasses.replace(jax.tree.map(np.asarray, LENS), sensor=float(LENS.sensor))
    ours, other = (psf_moments(lens, Scene.point(*SCENE), sampling=RULE) for lens in (same, LENS))
    np.testing.assert_array_equal(ours.covariance, other.covariance)


def test_orders_and_symmetries_that_no_rule_has_are_refused():
    for kind in (Gauss, drt_jax.Clipped, lambda *a: drt_jax.Soft(*a, 0.1)):
        for order in (2.5, 0, 43, "4", None, True, np.float64(4)):
            with pytest.raises(ValueError, match="order: expected a whole number from 1 to 42"):
                kind(order, "bilateral")
        with pytest.raises(
            ValueError, match="expected one of rotational, bilateral, none, got 'whole'"
        ):
            kind(4, "whole")
    assert Gauss(np.int64(4), "bilateral") == RULE
    for pattern in (pupil.meridian, pupil.hexapolar, pupil.square_grid, pupil.sobol_disc):
        for count in (2.5, 0, None):
            with pytest.raises(ValueError, match="expected at least 1, a whole number, got"):
                pattern(count)
    for points, weights in ((POINTS.T, np.ones(7)), (POINTS, np.ones(6)), (POINTS, 1.0)):
        with pytest.raises(ValueError, match=r"expected positions \(Q, 2\) and weights \(Q,\)"):
            psf_moments(LENS, Scene.point(*SCENE), sampling=Pattern(points, weights))


# ---- inside a trace -----------------------------------------------------------------------------


@jax.jit
def everything(lens, field, distance, wavelengths):
    """Rays and moments, and the gradient of their sum by all four arguments."""

    def total(lens, field, distance, wavelengths):
        scene = field, distance, wavelengths
        rays = drt_jax.trace_rays(lens, Scene.point(*scene), POINTS)
        spot = psf_moments(lens, Scene.point(*scene), sampling=RULE)
        found = rays[:3], spot.mean, spot.throughput
        summed = sum(jnp.sum(leaf) for leaf in jax.tree.leaves(found) if leaf.dtype == float)
        return summed + jnp.sum(spot.covariance), (found, rays.status, spot)

    arguments = lens, field, distance, wavelengths
    return jax.grad(total, argnums=range(4), has_aux=True)(*arguments)


NOWHERE = {
    "10 rad": (10.0, 25e3),
    "135 degrees": (np.radians(135), 25e3),
    "pi": (np.pi, np.inf),
    "90 degrees": (np.radians(90), 25e3),
    "no angle": (np.nan, 25e3),
    "at 0": (0.05, 0.0),
    "no distance": (0.05, np.nan),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NOWHERE)
def test_no_light_comes_from_where_the_lens_cannot_see(name):
    """Status MISSED, a throughput of 0, an infinite blur, derivatives of 0; no NaN."""
    scene = [jnp.asarray(value, float) for value in (*NOWHERE[name], GREEN)]
    slopes, (found, status, spot) = everything(LENS, *scene)
    assert np.all(status == Status.MISSED)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    assert np.all(spot.throughput == 0) and np.all(spot.mean == 0)
    assert np.all(np.isposinf(spot.covariance[:, [0, 1], [0, 1]]))
    assert all(np.all(leaf == 0) for leaf in jax.tree.leaves(slopes))


EXTREME = [(a, b) for a in (0.0, 1e-300, 1.57) for b in (1e-300, 1e-9, 1e300)]


@pytest.mark.slow
@pytest.mark.parametrize("field, distance", EXTREME)
def test_extreme_scenes_have_finite_rays_and_derivatives(field, distance):
    scene = [jnp.asarray(value, float) for value in (field, distance, GREEN)]
    slopes, (found, *_, spot) = everything(LENS, *scene)
    for leaf in jax.tree.leaves((found, slopes)):
        assert np.all(np.isfinite(leaf))
    assert not np.any(np.isnan(spot.covariance))


@jax.jit
def gaussian_optics(lens, field, distance, wavelengths):
    return (
        drt_jax.first_order(lens, distance, wavelengths),
        drt_jax.third_order(lens, Scene.point(field, distance, wavelengths)),
        image_height(lens, field, distance, wavelengths),
        refractive_index(lens.dispersion, wavelengths),
        field_of_height(field, distance),
    )


def test_gaussian_optics_has_no_nan():
    """inf for undefined values inside a trace; an error outside."""
    good = gaussian_optics(LENS, jnp.asarray(0.05), jnp.asarray(25e3), jnp.asarray(GREEN))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(good))
    for field, distance in (*NOWHERE.values(), *EXTREME):
        for colour in (0.55, 0.0, -1.0, 0.0774, 1e-300, 1e300):
            scene = (jnp.asarray(a, float) for a in (field, distance, [colour]))
            first, third, height, index, _ = found = gaussian_optics(LENS, *scene)
            if np.isfinite(field):
                assert not any(np.any(np.isnan(leaf)) for leaf in jax.tree.leaves(found))
            assert np.all(np.isfinite(index))
            if not abs(distance) >= 1e-6 or colour != 0.55:
                assert np.all(np.isinf(first.focal_length)) and np.all(np.isinf(height))
                assert np.all(np.isinf(third.spherical))
    for distance in (np.inf, -np.inf, 0.0, np.nan):
        with pytest.raises(ValueError, match="distance: "):
            field_of_height(1.0, distance)


@pytest.mark.slow
def test_reference_spheres_of_no_radius():
    for curvature in (np.inf, np.nan, [0.0, np.inf]):
        with pytest.raises(ValueError, match="curvature: "):
            drt_jax.wavefront(LENS, Scene.point(*SCENE), POINTS, curvature)
    trace = jax.jit(lambda kappa: drt_jax.wavefront(LENS, Scene.point(*SCENE), POINTS, kappa))
    for kappa in (np.inf, -np.inf, np.nan):
        wave = trace(jnp.asarray(kappa))
        assert np.all(wave.status == Status.UNCONVERGED) and np.all(wave.opd == 0)
        assert np.all(np.isfinite(wave.image))
    for kappa in (0.0, 0.01, 1e200, -1e300):
        wave = trace(jnp.asarray(kappa))
        assert np.all(wave.status == Status.OK) and np.all(np.isfinite(wave.opd))
    with pytest.raises(ValueError, match=r"weights: expected \(7,\)"):
        drt_jax.rms_wavefront(wave, np.ones(6))


# ---- what stops the light -----------------------------------------------------------------------


def changed(**values):
    return dataclasses.replace(LENS, **{k: jnp.asarray(v, float) for k, v in values.items()})


GLASS = {"curvature": 0, "index": 1.5, "thickness": 10.0, "semi_diameter": 8.0, "stop": True}
PLANE = {"object": {"index": 1.5}, "surfaces": [GLASS, {"curvature": 0, "thickness": 30.0}]}


@pytest.mark.slow
def test_a_lens_that_passes_no_ray_says_which_surface():
    narrow = dataclasses.replace(LENS, semi_diameter=LENS.semi_diameter.at[1].set(1e-3))
    cases = [
        (narrow, 1.3, "44% is clipped at surface 1"),
        (LENS, 1.5, "100% misses surface 1"),
        (load_lens(PLANE), np.radians(45), "100% is totally reflected at surface 1"),
    ]
    for lens, field, why in cases:
        with pytest.raises(ValueError) as caught:
            psf_moments(lens, Scene.point(field, np.inf, GREEN), sampling=RULE)
        text = str(caught.value)
        assert text.startswith("no ray at 0.55 um reaches the sensor: ") and why in text
        assert "\n" not in text and len(text) < 300


@pytest.mark.slow
def test_surfaces_that_cross_after_a_step_of_an_optimiser_are_named():
    thin = changed(thickness=[2.0, 0.3])
    assert psf_moments(thin, Scene.point(0.0, np.inf, GREEN)).throughput[0] > 0.999
    init, update = learn.adam({"thickness": 0.5})
    values = {"thickness": thin.thickness}
    updates, _ = update({"thickness": jnp.array([0.0, 1.0])}, init(values))
    crossed = dataclasses.replace(thin, **learn.apply_updates(values, updates))
    why = "surfaces 1 and 2 cross on the axis: -0.2 mm between their vertices"
    for rule in (1e-6, Gauss(4, "rotational")):
        with pytest.raises(ValueError, match=why):
            psf_moments(crossed, Scene.point(0.0, np.inf, GREEN), sampling=rule)
    # A sensor in front of the last surface shows a virtual image.
    assert psf_moments(changed(sensor=3.0), Scene.point(0.0, np.inf, GREEN)).throughput[0] > 0.999
    wide = changed(thickness=[2.0, 1.0], semi_diameter=[5.0, 12.5, 12.5, np.inf])
    height = np.sqrt(2 / float(wide.curvature[1]) - 1)  # of a circle, 1 mm from its vertex
    assert diagnose.crossed(wide).startswith(
        f"; surfaces 1 and 2 cross at y = {height:.4g} mm: 1 mm"
    )
    assert diagnose.crossed(LENS) == ""


@pytest.mark.slow
def test_a_wrong_field_in_an_eager_gradient_is_named():
    """Its values are known in an eager gradient, too."""
    slope = jax.grad(
        lambda field: psf_moments(LENS, Scene.point(field, np.inf, GREEN), sampling=RULE).mean[0, 1]
    )
    assert np.isfinite(slope(0.1))
    with pytest.raises(ValueError, match="10 rad = 573 degrees"):
        slope(10.0)


@pytest.mark.slow
def test_random_lenses_give_finite_moments_or_an_error():
    """And there is no RuntimeWarning of NumPy, which would be an error here."""
    rng, results = np.random.default_rng(0), []
    for _ in range(40):
        moved = {
            name: getattr(LENS, name) * rng.choice([0, 1, -1, 1e-3, 1e3, 1e6, 1e-9], shape)
            for name, shape in (("curvature", 4), ("thickness", 2), ("conic", 4), ("sensor", ()))
        }
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                found = psf_moments(
                    dataclasses.replace(LENS, **moved), Scene.point(0.0, 1e3, GREEN)
                )
            except ValueError as error:
                assert "surface" in str(error) or "no path through its stop point" in str(error)
                results.append(False)
                continue
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
        results.append(True)
    assert 5 < sum(results) < 40


@pytest.mark.slow
def test_the_promise_of_float32_is_kept_and_warned_of():
    """Double Gauss at 10 degrees, a spot of 4.7 um, whose error once was 1.4e-3."""
    double = dataclasses.replace(load_lens("double_gauss"), sensor=jnp.asarray(133.35))
    single = jax.tree.map(lambda a: a.astype(jnp.float32), double)
    scene = np.radians(10), 25e3, (0.6, 0.53, 0.48)
    exact = psf_moments(double, Scene.point(*scene))
    with pytest.warns(UserWarning, match='float32 the spot may be wrong by .*"jax_enable_x64"'):
        found = psf_moments(single, Scene.point(*scene))
    assert found.covariance.dtype == jnp.float32
    sizes = [np.sqrt(np.trace(a.covariance, axis1=1, axis2=2)) for a in (found, exact)]
    np.testing.assert_allclose(*sizes, rtol=1e-3)
    psf_moments(single, Scene.point(*scene), 0.1)  # as asked for, and no warning
    refusal = "sampling: in float32 the spot may be wrong by .*more than 1e-06.*or leave the toler"
    with pytest.raises(ValueError, match=refusal):
        psf_moments(single, Scene.point(*scene), 1e-6)
