"""The sag compared with closed forms, its derivatives with 40-digit differences."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import yaml

from drt_jax.lens import surface
from drt_jax.lens.forms import FORMS, Shape, powers_xy
from drt_jax.lens.surface import domain, surface_sag
from drt_jax.pupil.patterns import disc

by_form = jax.jit(surface.by_form, static_argnums=(0, 3))
sag_derivatives = jax.jit(surface.sag_derivatives, static_argnames="form")
vertex_curvature = jax.jit(surface.vertex_curvature, static_argnums=(1, 2))


def conic(r2, c, k):
    return c * r2 / (1 + mpmath.sqrt(1 - (1 + k) * c**2 * r2))


def exact_asphere(x, y, c, k, a):
    r2 = x**2 + y**2
    return conic(r2, c, k) + sum(v * r2 ** (j + 1) for j, v in enumerate(a))


def exact_odd_asphere(x, y, c, k, a):
    r = mpmath.sqrt(x**2 + y**2)
    return conic(r**2, c, k) + sum(v * r ** (j + 1) for j, v in enumerate(a))


def exact_biconic(x, y, c, k, a):
    cx, kx, *rest = a
    root = mpmath.sqrt(1 - (1 + kx) * cx**2 * x**2 - (1 + k) * c**2 * y**2)
    z = (cx * x**2 + c * y**2) / (1 + root)
    return z + sum(v * (x**2 + y**2) ** (j + 1) for j, v in enumerate(rest))


def exact_toroid(x, y, c, k, a):
    cx, *rest = a
    g = conic(y**2, c, k) + sum(v * y ** (2 * j + 2) for j, v in enumerate(rest))
    if cx == 0:
        return g
    return 1 / cx - mpmath.sign(cx) * mpmath.sqrt((1 / cx - g) ** 2 - x**2)


def exact_linear(x, y, c, k, a):
    return exact_asphere(x, y, c, k, []) + a[0] * y


def exact_polynomial_xy(x, y, c, k, a):
    terms = sum(v * x**i * y**j for v, (i, j) in zip(a, powers_xy(len(a))))
    return conic(x**2 + y**2, c, k) + terms


def exact_qbfs(x, y, c, k, a):
    """The closed forms of Q_0 to Q_3 (Forbes 2007)."""
    radius, *rest = a
    r2 = x**2 + y**2
    t = r2 / radius**2
    q = [
        1,
        (13 - 16 * t) / mpmath.sqrt(19),
        mpmath.sqrt(mpmath.mpf(2) / 95) * (29 - 4 * t * (25 - 19 * t)),
        mpmath.sqrt(mpmath.mpf(2) / 2545) * (207 - 4 * t * (315 - t * (577 - 320 * t))),
    ]
    steep = mpmath.sqrt((1 - k * c**2 * r2) / (1 - (1 + k) * c**2 * r2))  # 1 / cos of the conic
    bump = t * (1 - t) * steep
    return conic(r2, c, k) + bump * sum(v * f for v, f in zip(rest, q))


def exact_zernike(x, y, c, k, a):
    """Z_1 to Z_11 as listed by Noll (1976)."""
    radius, *rest = a
    rho, theta = mpmath.sqrt(x**2 + y**2) / radius, mpmath.atan2(y, x)
    root = mpmath.sqrt
    z = [
        1,
        2 * rho * mpmath.cos(theta),
        2 * rho * mpmath.sin(theta),
        root(3) * (2 * rho**2 - 1),
        root(6) * rho**2 * mpmath.sin(2 * theta),
        root(6) * rho**2 * mpmath.cos(2 * theta),
        root(8) * (3 * rho**3 - 2 * rho) * mpmath.sin(theta),
        root(8) * (3 * rho**3 - 2 * rho) * mpmath.cos(theta),
        root(8) * rho**3 * mpmath.sin(3 * theta),
        root(8) * rho**3 * mpmath.cos(3 * theta),
        root(5) * (6 * rho**4 - 6 * rho**2 + 1),
    ]
    return conic(x**2 + y**2, c, k) + sum(v * f for v, f in zip(rest, z))


# form, curvature, conic, coefficients: one line for each shape of the tests below.
SHAPES = {
    "plane": ("asphere", 0.0, 0.0, []),
    "sphere": ("asphere", 1 / 50, 0.0, []),
    "ellipsoid": ("asphere", -1 / 30, 0.4, []),
    "paraboloid": ("asphere", 1 / 40, -1.0, []),
    "hyperboloid": ("asphere", -1 / 25, -2.25, []),
    "even asphere": ("asphere", 1 / 60, -0.5, [0.0, 1e-6, -3e-9]),
    "high even asphere": ("asphere", 1 / 60, -0.5, [0.0, 1e-6, 0, 0, 0, 0, 0, 1e-19]),
    "r2 term": ("asphere", 0.0, 0.0, [1e-3]),
    "odd asphere": ("odd_asphere", 1 / 45, 0.3, [1e-3, 2e-4, -3e-5, 0.0, 1e-7]),
    "biconic": ("biconic", 1 / 50, -0.5, [1 / 30, 0.7]),
    "cylinder": ("biconic", 0.0, 0.0, [1 / 30, 0.0]),
    "biconic with terms": ("biconic", -1 / 50, 0.2, [-1 / 80, -2.0, 1e-5, 1e-7]),
    "toroid": ("toroid", 1 / 50, -0.5, [1 / 100, 1e-5, 2e-6]),
    "toroid, other sense": ("toroid", 1 / 50, -0.5, [-1 / 70]),
    "toroid, flat in x": ("toroid", 1 / 50, 0.0, [0.0, 1e-4]),
    "polynomial": (
        "polynomial_xy",
        1 / 70,
        -1.0,
        [1e-3, -2e-3, 1e-4, 3e-4, -2e-4, 1e-6, 2e-6, 3e-6, 4e-6],
    ),
    "slope": ("linear", 1 / 70, -1.0, [2e-3]),
    "Forbes": ("qbfs", 1 / 60, -0.4, [12.0, 0.05, -0.02, 0.01, 0.003]),
    "Forbes, steep": ("qbfs", 1 / 11, -4.0, [12.0, 0.05, -0.02]),
    "Zernike": ("zernike", -1 / 80, 0.3, [11.0, *(0.01 / np.arange(1.0, 12.0))]),
}


def shape_of(name, dtype=jnp.float64):
    form, c, k, a = SHAPES[name]
    return Shape(jnp.asarray(c, dtype), jnp.asarray(k, dtype), jnp.asarray(a, dtype)), form


def test_every_form_is_in_the_table():
    assert {form for form, *_ in SHAPES.values()} == set(FORMS)
    assert {form.symmetry for form in FORMS.values()} == {"rotational", "bilateral", "none"}


@pytest.mark.parametrize("name", SHAPES)
def test_sag_and_derivatives_against_mpmath(name):
    form, c, k, a = SHAPES[name]
    x, y = 7.0, -4.0
    z, gradient, hessian = sag_derivatives(jnp.array([x, y]), *shape_of(name))
    with mpmath.workdps(40):
        c, k, a = mpmath.mpf(c), mpmath.mpf(k), [mpmath.mpf(v) for v in a]

        def f(x, y):
            return globals()[f"exact_{form}"](x, y, c, k, a)

        assert abs(z - float(f(mpmath.mpf(x), mpmath.mpf(y)))) < 1e-14
        wanted = [float(mpmath.diff(f, (x, y), n)) for n in ((1, 0), (0, 1))]
        np.testing.assert_allclose(gradient, wanted, rtol=1e-13, atol=1e-17)
        second = [float(mpmath.diff(f, (x, y), n)) for n in ((2, 0), (1, 1), (1, 1), (0, 2))]
        np.testing.assert_allclose(np.ravel(hessian), second, rtol=1e-12, atol=1e-17)


@pytest.mark.parametrize(
    "name", [n for n in SHAPES if FORMS[SHAPES[n][0]].symmetry == "rotational"]
)
def test_one_component_is_the_section_of_two(name):
    z1, g1, h1 = sag_derivatives(jnp.array([5.0]), *shape_of(name))
    z2, g2, h2 = sag_derivatives(jnp.array([0.0, 5.0]), *shape_of(name))
    np.testing.assert_allclose([z1, g1[0], h1[0][0]], [z2, g2[1], h2[1][1]], rtol=1e-14)


@pytest.mark.parametrize("name", SHAPES)
def test_mirror_symmetry_is_as_the_table_of_forms_says(name):
    shape, form = shape_of(name)
    w = jnp.array([[3.0, -3.0], [2.0, 2.0]])
    z = np.asarray(surface_sag(w, shape, form))
    assert (abs(z[0] - z[1]) < 1e-15) == (FORMS[form].symmetry != "none")


@pytest.mark.parametrize("name", SHAPES)
def test_vertex_curvature_is_the_bend_at_the_vertex(name):
    if name == "odd asphere":  # its first power makes a cone; without it there is a vertex
        form, c, k, a = SHAPES[name]
        shape, a = Shape(jnp.array(c), jnp.array(k), jnp.array([0.0, *a[1:]])), [0.0, *a[1:]]
    else:
        (shape, form), (_, c, k, a) = shape_of(name), SHAPES[name]
    ours = [bend[0] for bend in vertex_curvature(jax_rows(shape), (form,), 2)]
    with mpmath.workdps(40):
        mp = [mpmath.mpf(v) for v in a]
        exact = globals()[f"exact_{form}"]
        h = mpmath.mpf(10) ** -8
        wanted = [
            sum(s * exact(t * i * h, t * j * h, c, k, mp) for s, t in ((1, 1), (-2, 0), (1, -1)))
            / h**2
            for i, j in ((1, 0), (0, 1))
        ]
    np.testing.assert_allclose(ours, [float(v) for v in wanted], rtol=1e-6, atol=1e-9)


def jax_rows(shape):
    return Shape(shape.curvature[None], shape.conic[None], shape.coefficients[:, None])


@pytest.mark.slow
def test_forms_side_by_side_are_each_their_own():
    names = [
        "Forbes",
        "Zernike",
        "polynomial",
        "sphere",
        "toroid",
        "even asphere",
        "odd asphere",
        "biconic",
        "plane",
    ]
    widest = max(len(SHAPES[n][3]) for n in names)
    rows = [shape_of(n)[0] for n in names]
    shape = Shape(
        jnp.stack([r.curvature for r in rows])[:, None],
        jnp.stack([r.conic for r in rows])[:, None],
        jnp.stack([jnp.pad(r.coefficients, (0, widest - len(r.coefficients))) for r in rows], 1)[
            ..., None
        ],
    )
    w = jnp.asarray(np.random.default_rng(0).uniform(-5, 5, (2, len(names), 4)))
    together = by_form(surface.sag_derivatives, w, shape, tuple(SHAPES[n][0] for n in names))
    for i, name in enumerate(names):
        alone = sag_derivatives(w[:, i], *shape_of(name))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone)):
            np.testing.assert_allclose(a[i], b, rtol=1e-14, atol=1e-18)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("name", SHAPES)
def test_finite_everywhere(name, dtype):
    shape, form = shape_of(name, dtype)
    heights = jnp.array([0.0, 1e-30, 1e-12, 1e-6, 9.9, 49.999999, 50.0, 50.1, 250.0], dtype)
    for part in jax.tree.leaves(sag_derivatives((heights, 0.7 * heights), shape, form)):
        assert jnp.all(jnp.isfinite(part)) and part.dtype == dtype


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_flagged_beyond_the_rim(dtype):
    shape = Shape(jnp.asarray(0.1, dtype), jnp.asarray(0.0, dtype), jnp.zeros(0, dtype))
    heights = jnp.array([9.9, 9.999999, 10.0, 10.1, 50.0, 1e6], dtype)
    w = heights, jnp.zeros_like(heights)
    assert all(jnp.all(jnp.isfinite(a)) for a in jax.tree.leaves(sag_derivatives(w, shape)))
    np.testing.assert_array_equal(domain(w, shape), heights < 9.9995)


def test_forbes_polynomials_on_a_hyperboloid_are_those_of_another_program():
    """Sags of a Qbfs surface in a listing of Zemax."""
    a = [6.336, 1.614, 0.348, 0.15, 0.033, 0.03]
    shape = Shape(jnp.asarray(1 / 21.723), jnp.asarray(-4.428), jnp.asarray(a))
    z = surface_sag((jnp.zeros(2), jnp.array([0.75, 1.86])), shape, "qbfs")
    np.testing.assert_allclose(z, [0.06264589454579239, 0.3307314239746402], atol=1e-12)


def test_slopes_of_forbes_polynomials_are_orthonormal():
    """On a sphere, with the weight 1 / (u sqrt(1 - u^2)) over the disc (Forbes 2007, Eq. 11), the
    slopes along the normal of u^2 (1 - u^2) Q_m are orthonormal. 24 terms, by Gauss-Chebyshev."""
    count, order = 24, 200
    u = np.cos(np.pi * (2 * np.arange(order) + 1) / (4 * order))  # u > 0, weights pi / (2 order)
    unit = Shape(*(jnp.zeros((count, 1)),) * 2, np.insert(np.eye(count), 0, 1, axis=0)[..., None])
    w = (jnp.broadcast_to(u, (count, order)),)
    slopes = np.asarray(sag_derivatives(w, unit, "qbfs")[1][0])
    np.testing.assert_allclose(slopes @ slopes.T / order, np.eye(count), atol=1e-11)


def test_zernike_polynomials_are_orthonormal():
    """All 91 that files may have, over the disc, to the rounding of their polynomials in x, y."""
    count = 91
    points, weights = disc(14, 14)
    unit = Shape(*(jnp.zeros((count, 1)),) * 2, np.insert(np.eye(count), 0, 1, axis=0)[..., None])
    w = jnp.broadcast_to(points.T[:, None], (2, count, len(weights)))
    z = np.asarray(jax.jit(surface_sag, static_argnums=2)(w, unit, "zernike"))
    np.testing.assert_allclose(z * weights @ z.T, np.eye(count), atol=1e-11)
    edge = jnp.stack([jnp.ones((count, 1)), jnp.zeros((count, 1))])  # Z_j(1, 0): n and m alone
    n = np.repeat(np.arange(13), np.arange(1, 14))
    z = np.asarray(surface_sag(edge, unit, "zernike"))[:, 0]
    assert set(np.round(z**2 / (n + 1), 9)) == {0, 1, 2}


def test_toroid_of_another_program(shared):
    """Sags of Zemax, quoted to 16 digits in Optiland's tests."""
    cases = yaml.safe_load((shared / "reference_cases.yaml").read_text())["cases"]
    case = next(c for c in cases if c["id"] == "C13_toroid_1_zemax")
    shape = Shape(jnp.array(1 / 50), jnp.array(-0.5), jnp.array([1 / 100, 1e-5, 0.0]))
    for x, y, wanted in case["reference"]["sag_for_a1_1e_5_a2_0"]:
        assert abs(surface_sag(jnp.array([x, y]), shape, "toroid") - wanted) < 1e-15
