"""Surfaces that add a phase: gratings, zone plates and hybrids, compared with closed forms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import (
    Gauss,
    Scene,
    Status,
    focal_length,
    load_lens,
    psf_moments,
    trace_rays,
    wavefront,
)

from ..known import bendable

INF = float("inf")
COLOURS = np.array([0.4861327, 0.5875618, 0.6562725])
PUPIL = np.array([[0, 0], [0.5, 0.2], [-0.3, 0.8], [0.1, -0.9]])
STOP = {"radius": INF, "thickness": 5.0, "stop": True, "semi_diameter": 4.0}


def zone_plate(f, wavelength, terms, **where):
    """Phase of the perfect zone plate, (f - sqrt(f^2 + r^2)) / wavelength, as a power series."""
    series, coefficient = {}, 1.0
    for k in range(1, terms + 1):
        coefficient *= (1.5 - k) / k  # of (1 + x)^(1/2)
        series[2 * k] = -f * coefficient / f ** (2 * k) / (1e-3 * wavelength)
    plate = {"radius": INF, "phase": {"coefficients": series}, "thickness": f} | where
    return load_lens({"surfaces": [STOP, plate]})


@pytest.mark.slow
@pytest.mark.parametrize("order", [-2, 0, 1])
@pytest.mark.parametrize("mirror", [False, True])
def test_the_grating_equation_in_and_out_of_plane(order, mirror):
    """Along the grating n' d' - n d = m L (0, T), for any direction of the light."""
    lines = 400.0
    phase = {"form": "linear", "order": order, "coefficients": {"y": lines}}
    behind = {"mirror": True, "thickness": -10.0} if mirror else {"index": 1.6, "thickness": 10.0}
    lens = load_lens({"surfaces": [STOP, {"radius": INF, "phase": phase} | behind]})
    rays = trace_rays(lens, Scene.point((0.1, 0.25), INF, COLOURS), PUPIL)
    assert np.all(rays.status == Status.OK)
    before, after = (np.asarray(rays.directions[:, :, k]) for k in (1, 2))
    index = 1.0 if mirror else 1.6
    np.testing.assert_allclose(index * after[..., 0], before[..., 0], atol=1e-14)
    kick = order * 1e-3 * COLOURS[:, None] * lines
    turned = index * after[..., 1] - before[..., 1]
    np.testing.assert_allclose(turned, kick + 0 * turned, atol=1e-14)
    assert np.all(after[..., 2] < 0 if mirror else after[..., 2] > 0)


@pytest.mark.slow
def test_an_evanescent_order_is_totally_reflected():
    phase = {"form": "linear", "coefficients": {"y": 1700.0}}
    lens = load_lens({"surfaces": [STOP, {"radius": INF, "phase": phase, "thickness": 10.0}]})
    rays = trace_rays(lens, Scene.point(0.0, INF, COLOURS), PUPIL)
    np.testing.assert_array_equal(rays.status[:2], Status.OK)  # 0.83 and 0.9988
    np.testing.assert_array_equal(rays.status[2], Status.TIR)
    assert all(np.all(np.isfinite(part)) for part in rays)

    def total(lens):
        return jnp.sum(trace_rays(lens, Scene.point(0.0, INF, COLOURS[2:]), PUPIL).points)

    slopes = jax.tree.leaves(jax.grad(total)(lens))
    assert all(np.all(np.isfinite(slope)) for slope in slopes)


@pytest.mark.slow
def test_a_zone_plate_is_stigmatic_and_its_focal_length_falls_with_the_wavelength():
    f, design = 50.0, COLOURS[1]
    lens = zone_plate(f, design, 12)
    np.testing.assert_allclose(focal_length(lens, COLOURS), f * design / COLOURS, rtol=1e-13)
    rays = trace_rays(lens, Scene.point(0.0, INF, design), PUPIL)
    np.testing.assert_allclose(rays.points[0, :, -1, :2], 0, atol=1e-12)
    np.testing.assert_allclose(
        wavefront(lens, Scene.point(0.0, INF, design), PUPIL).opd, 0, atol=1e-8
    )
    # The third order has a third of the focal length.
    third = dataclasses.replace(lens, phase=dataclasses.replace(lens.phase, order=jnp.array([3.0])))
    np.testing.assert_allclose(focal_length(third, COLOURS), f * design / COLOURS / 3, rtol=1e-13)


@pytest.mark.slow
def test_a_mirror_of_phase_focuses_like_a_paraboloid():
    f, design = 50.0, 0.6
    lens = zone_plate(f, design, 12, mirror=True, thickness=-f)
    np.testing.assert_allclose(focal_length(lens, [design]), -f, rtol=1e-13)
    rays = trace_rays(lens, Scene.point(0.0, INF, design), PUPIL)
    np.testing.assert_allclose(rays.points[0, :, -1, :2], 0, atol=1e-12)


def test_a_hybrid_achromat():
    """A thin lens of N-BK7 and a zone plate: powers for Abbe numbers 64 and -3.45 make the foci of
    F and C equal; that of d follows from the partial dispersions."""
    f = 100.0
    dF, dd, dC = COLOURS
    n = np.asarray(load_lens({"surfaces": [STOP | {"glass": "N-BK7"}]}).index(COLOURS))[1]
    glass = (n[1] - 1) / (n[0] - n[2])
    plate = dd / (dF - dC)
    power = np.array([glass, -plate]) / (glass - plate) / f
    curvature = power[0] / (n[1] - 1)
    back = {"radius": INF, "phase": {"coefficients": {2: -power[1] / (2e-3 * dd)}}}
    front = {"curvature": curvature, "thickness": 1e-6, "glass": "N-BK7", "semi_diameter": 0.05}
    lens = load_lens({"surfaces": [front | {"stop": True}, back], "sensor": f})
    found = np.asarray(focal_length(lens, COLOURS))
    expected = 1 / (curvature * (n - 1) + power[1] * COLOURS / dd)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    np.testing.assert_allclose(found[0], found[2], rtol=1e-8)
    assert power[1] > 0 and abs(found[1] / found[0] - 1) < 3e-3


FORMS = {
    "asphere": {2: -30.0, 4: 0.1, 6: 1e-3},
    "odd_asphere": {2: -30.0, 3: 0.5},
    "linear": {"y": 40.0},
    "polynomial_xy": {"x1y0": 9.0, "x0y1": -20.0, "x2y0": -25.0, "x1y1": 2.0, "x0y3": 0.2},
}
# Surfaces that have the phase, and positions of the stop.
BASES = {
    "plane": {"radius": INF},
    "asphere": {"radius": 40.0, "conic": -0.5, "coefficients": {4: 1e-5}, "glass": "N-BK7"},
    "mirror": {"radius": -90.0, "mirror": True},
}


def hybrid(form, base, stop):
    phase = {"form": form, "order": -1, "coefficients": FORMS[form]}
    away = -1 if base == "mirror" else 1
    rows = [
        {"radius": 80.0, "thickness": 4.0, "glass": "SF5"},
        {"radius": 300.0, "thickness": 12.0},
        BASES[base] | {"phase": phase, "thickness": away * 6.0},
        {"radius": -60.0 * away, "thickness": away * 30.0, "index": 1.3},
    ]
    rows[stop] |= {"stop": True, "semi_diameter": 3.0}
    return load_lens({"surfaces": rows})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "base", "stop"),
    [
        ("asphere", "asphere", 0),
        pytest.param("odd_asphere", "mirror", 3, marks=pytest.mark.slow),
        pytest.param("linear", "plane", 2, marks=pytest.mark.slow),
        pytest.param("polynomial_xy", "mirror", 2, marks=pytest.mark.slow),
        pytest.param("polynomial_xy", "asphere", 3, marks=pytest.mark.slow),
    ],
)
def test_rays_are_stationary_and_their_derivatives_right(form, base, stop):
    """By Fermat's principle, a small move of a hit does not change the path. The derivatives of
    hits and paths by phase, order, wavelength and shapes agree with differences."""
    lens = bendable(hybrid(form, base, stop))
    at = {"field": jnp.array([0.03, 0.08]), "colours": jnp.asarray(COLOURS[:2])}

    def outputs(lens, at):
        rays = trace_rays(lens, Scene.point(at["field"], 200.0, at["colours"]), PUPIL)
        return jnp.concatenate([rays.points[:, :, -1, :2].ravel(), rays.path.ravel()])

    rays = trace_rays(lens, Scene.point(at["field"], 200.0, at["colours"]), PUPIL)
    assert np.all(rays.status == Status.OK)
    given = lens, at
    ours = jax.jit(jax.jacfwd(outputs, argnums=(0, 1)))(*given)
    back = jax.jit(jax.jacrev(outputs, argnums=(0, 1)))(*given)
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)  # noqa: E731
    jax.tree.map(same, ours, back)
    value, generator = jax.jit(outputs), np.random.default_rng(0)
    for pick in (
        lambda lens, at: lens.phase.coefficients,
        lambda lens, at: lens.phase.order,
        lambda lens, at: lens.curvature,
        lambda lens, at: lens.thickness,
        lambda lens, at: at["colours"],
        lambda lens, at: at["field"],
    ):
        leaf, slopes = pick(*given), pick(*ours)
        toward = generator.uniform(0.5, 1, leaf.shape) * np.maximum(abs(np.asarray(leaf)), 1e-4)
        step = 1e-5
        moved = lambda s: jax.tree.map(lambda a: a + s * toward if a is leaf else a, given)  # noqa: E731
        sides = (value(*moved(s)) for s in (step, -step))
        change = np.subtract(*sides) / (2 * step)
        along = np.tensordot(slopes, toward, leaf.ndim)
        scale = np.max(abs(along))
        np.testing.assert_allclose(along, change, rtol=1e-6, atol=1e-8 * scale)


@pytest.mark.slow
def test_a_hybrid_needs_one_radius_on_the_axis():
    lens = hybrid("asphere", "asphere", 0)
    assert drt_jax.pupil.symmetry_of(lens, 0.0) == "rotational"
    assert drt_jax.pupil.symmetry_of(hybrid("linear", "plane", 2), 0.0) == "bilateral"
    assert drt_jax.pupil.symmetry_of(hybrid("polynomial_xy", "plane", 2), 0.0) == "none"
    short = psf_moments(lens, Scene.point(0.0, INF, COLOURS), 1e-9)
    long = psf_moments(lens, Scene.point(0.0, INF, COLOURS), sampling=Gauss(12, "none"))
    np.testing.assert_allclose(short.covariance, long.covariance, rtol=1e-8, atol=1e-14)


@pytest.mark.slow
def test_a_phase_of_nothing_changes_nothing():
    rows = [
        {"radius": 80.0, "thickness": 4.0, "glass": "SF5", "stop": True, "semi_diameter": 5.0},
        {"radius": -300.0, "thickness": 90.0},
    ]
    plain = load_lens({"surfaces": rows})
    rows[1] = rows[1] | {"phase": {"coefficients": {2: 0.0}}}
    lenses = load_lens({"surfaces": rows}), plain
    ours, theirs = (trace_rays(lens, Scene.point(0.1, INF, COLOURS), PUPIL) for lens in lenses)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-13), ours, theirs)


@pytest.mark.parametrize(
    ("phase", "message"),
    [
        ({"coefficients": {}}, r"surfaces\[1\].phase.coefficients: give at least one, in waves"),
        ({"coefficients": {3: 1}}, r"surfaces\[1\].phase.coefficients: unknown key 3"),
        ({"order": 0.5, "coefficients": {2: 1}}, r"phase.order: must be a whole number"),
        ({"form": "toroid", "coefficients": {2: 1}}, r"phase.form: expected one of asphere, "),
        ({"form": "grating"}, r"phase.form: unknown form 'grating'"),
        ({"lines": 600}, r"phase: unknown key 'lines'"),
        (600, r"phase: expected a mapping"),
    ],
)
def test_a_bad_phase_is_named(phase, message):
    with pytest.raises(ValueError, match=message):
        load_lens({"surfaces": [STOP, {"radius": INF, "phase": phase}], "sensor": 20.0})


def test_third_order_theory_knows_no_phase():
    with pytest.raises(ValueError, match="no theory for diffractive surfaces"):
        drt_jax.third_order(zone_plate(50.0, 0.5, 1), Scene.point(0.1, INF, COLOURS))
