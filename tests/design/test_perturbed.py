"""Errors of parts beside the same lens written by hand, and beside what the words mean."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax.design import PerturbedLens, Tolerance, elements_of
from drt_jax.design.deviations import KINDS
from drt_jax.lens.glass import refractive_index
from drt_jax.lens.lens import sag

from ..conftest import assert_close

LINES = jnp.array([0.4861327, 0.5875618, 0.6562725])
HALF_WAVE = 0.5460740e-3 / 2
# A cemented doublet, a stop in air, a lens of model glass whose back is no sphere.
ROWS = [
    {"radius": 30.0, "thickness": 4.0, "glass": "N-BK7", "semi_diameter": 8.0},
    {"radius": -25.0, "thickness": 1.5, "glass": "F2", "semi_diameter": 8.0},
    {"radius": math.inf, "thickness": 3.0, "glass": "air", "semi_diameter": 8.0},
    {"radius": math.inf, "thickness": 3.0, "glass": "air", "semi_diameter": 5.0, "stop": True},
    {"radius": 60.0, "thickness": 3.0, "nd": 1.6, "vd": 50.0, "semi_diameter": 8.0},
    {"radius": -50.0, "conic": -0.5, "glass": "air", "semi_diameter": 8.0},
]


def lens_of(rows=(), **top):
    """The lens with keys of some surfaces changed: {surface: {key: value}}."""
    changes = dict(rows)
    surfaces = [{**row, **changes.get(i, {})} for i, row in enumerate(ROWS)]
    return drt_jax.load_lens({"name": "mine", "surfaces": surfaces, "sensor": 60.0, **top})


def perturbed(lens, *tolerances):
    return PerturbedLens.from_lens(lens, lens.semi_diameter[:-1], tolerances)


def same(ours, wanted):
    """Asserts that lenses agree in all numbers and names."""
    for name in ("curvature", "conic", "thickness", "sensor"):
        assert_close(getattr(ours, name), getattr(wanted, name), 1e-13)
    z, across, turned = wanted.places
    here = ours.places
    nowhere, upright = jnp.zeros((len(z), 2)), jnp.broadcast_to(jnp.eye(3), (len(z), 3, 3))
    assert_close(here[0], z, 1e-14)
    for a, b, none in ((here[1], across, nowhere), (here[2], turned, upright)):
        assert_close(none if a is None else a, none if b is None else b, 1e-14, 1e-14)


def test_elements_are_what_glass_holds_together():
    assert elements_of(lens_of()) == ((0, 2), (4, 5))
    double_gauss = drt_jax.load_lens("double_gauss")
    assert elements_of(double_gauss) == ((0, 1), (2, 4), (6, 8), (9, 10))
    hubble = drt_jax.load_lens("hubble")
    assert elements_of(hubble) == tuple((i, i) for i in hubble.active)
    # A back surface that is a mirror belongs to its glass; so does where the light comes out.
    back = [
        {"radius": -100.0, "thickness": 5.0, "glass": "N-BK7", "semi_diameter": 10.0, "stop": True},
        {"radius": -150.0, "thickness": -5.0, "mirror": True, "semi_diameter": 10.0},
        {"radius": -100.0, "glass": "air", "semi_diameter": 10.0},
    ]
    lens = drt_jax.load_lens({"name": "back", "surfaces": back, "sensor": -80.0})
    assert elements_of(lens) == ((0, 2),)
    # One piece of glass, seen twice.
    some = perturbed(lens, Tolerance("index", 1e-3))
    assert len(some.deviations) == 1
    changed = some.lens_of(jnp.ones(1)).index(LINES) - lens.index(LINES)
    np.testing.assert_allclose(changed[1:3, 1], 1e-3, rtol=1e-10)


def test_decentres_and_tilts_are_those_of_elements_in_a_prescription():
    some = perturbed(lens_of(), Tolerance("decentre", 0.1), Tolerance("tilt", 6, (1,)))
    assert list(map(str, some.deviations)) == [
        *("decentre of element 0, x", "decentre of element 0, y"),
        *("decentre of element 1, x", "decentre of element 1, y"),
        *("tilt of element 1, x", "tilt of element 1, y"),
    ]
    by_hand = lens_of(
        elements=[
            {"surfaces": [0, 2], "shift": [0.05, -0.1, 0]},
            {"surfaces": [4, 5], "shift": [0, 0.02, 0], "tilt": [0.1, -0.05, 0]},
        ]
    )
    off = jnp.array([0.5, -1, 0, 0.2, 1, -0.5])
    same(jax.jit(some.lens_of)(off), by_hand)
    same(some.lens_of(0 * off), lens_of())


def test_elements_move_within_those_of_the_prescription():
    """An error moves an element in its cell; the cell has its own position, and the surface has one
    in the cell: three rigid motions in sequence."""
    cell = {"surfaces": [4, "sensor"], "tilt": [10, 0, 0], "shift": [0, 1, 0]}
    inner = {"surfaces": [5, 5], "shift": [0.3, 0, 0]}
    lens = lens_of(elements=[inner, cell])
    some = perturbed(lens, Tolerance("decentre", 0.1, (1,)), Tolerance("tilt", 60, (1,)))
    z, across, turned = some.lens_of(jnp.array([1.0, 0, 0, 1])).places
    found = np.c_[across, z]
    degree = math.pi / 180

    def about(axis, angle):
        cos, sin = math.cos(angle), math.sin(angle)
        if axis == "x":
            return np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
        return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])

    vertex = np.array([0, 0, lens.vertices[4]])
    own, whole = about("y", degree), about("x", 10 * degree)
    for row, start in ((4, [0, 0, 0]), (5, [0.3, 0, 3.0])):
        moved = own @ start + [0.1, 0, 0]
        np.testing.assert_allclose(found[row], vertex + whole @ moved + [0, 1, 0], atol=1e-13)
        np.testing.assert_allclose(turned[row], whole @ own, atol=1e-14)
    sensor = vertex + whole @ [0, 0, float(lens.sensor) - vertex[2]] + [0, 1, 0]
    np.testing.assert_allclose(found[6], sensor, atol=1e-12)
    with pytest.raises(ValueError, match=r"surfaces 4 to 5 is cut by .*, 5 to 6; put one inside"):
        perturbed(lens_of(elements=[{"surfaces": [5, "sensor"]}]), Tolerance("tilt", 1))


def test_wedge_is_the_tilt_of_a_surface():
    some = perturbed(lens_of({1: {"tilt": [0.2, 0, 0]}}), Tolerance("wedge", 3, (1, 5)))
    assert list(map(str, some.deviations)) == [
        *("wedge of surface 1, x", "wedge of surface 1, y"),
        *("wedge of surface 5, x", "wedge of surface 5, y"),
    ]
    by_hand = lens_of({1: {"tilt": [0.25, 0, 0]}, 5: {"tilt": [0, -0.05, 0]}})
    same(some.lens_of(jnp.array([1.0, 0, 0, -1])), by_hand)


def test_radius_and_thickness_are_those_of_a_prescription():
    some = perturbed(lens_of(), Tolerance("radius", 2.0), Tolerance("thickness", 0.1))
    assert [e.place for e in some.deviations] == [
        0,
        1,
        4,
        5,
        0,
        1,
        2,
        3,
        4,
    ]  # planes have no radius
    off = jnp.array([1.0, 0, -0.5, 0, 0, 0, -1, 0, 1])
    by_hand = lens_of({
        0: {"radius": 30.6}, 4: {"radius": 59.4, "thickness": 3.1}, 2: {"thickness": 2.9},
    })  # fmt: skip
    same(some.lens_of(off), by_hand)
    toroid = lens_of({5: {"form": "toroid", "radius_x": -80.0}})
    bent = perturbed(toroid, Tolerance("radius", 1.0, (5,))).lens_of(jnp.ones(1))
    assert_close(1 / bent.curvature[5], jnp.array(-50.5), 1e-14)
    assert_close(1 / bent.coefficients[5, 0], jnp.array(-80.8), 1e-14)


@pytest.mark.parametrize("surface", [0, 1, 2])
def test_fringes_are_between_rim_and_nominal_surface(surface):
    """On a sphere, the distance of the rim from the nominal sphere, measured from the centre of the
    nominal sphere."""
    lens = lens_of()
    some = perturbed(lens, Tolerance("fringes", 4.0, (surface,)))
    bent = some.lens_of(jnp.ones(1))
    h = 8.0
    z, c = float(sag(lens, surface, 0.0, h)), float(bent.curvature[surface])
    far = abs(math.hypot(h, z - 1 / c) - abs(1 / c))
    assert far == pytest.approx(4 * HALF_WAVE, rel=1e-3)
    higher = float(sag(bent, surface, 0.0, h)) - z
    assert higher > 0  # a positive error raises the rim


def test_irregularity_is_the_biconic_with_these_fringes_between_its_meridians():
    lens = lens_of()
    some = perturbed(lens, Tolerance("irregularity", 2.0, (0, 5)))
    off = some.lens_of(jnp.array([1.0, -0.5]))
    assert set(off.forms) == {"biconic"}
    same(some.lens_of(jnp.zeros(2)), lens)
    for surface, fringes in ((0, 2.0), (5, -1.0)):
        y = sag(off, surface, 0.0, 8.0) - sag(lens, surface, 0.0, 8.0)
        x = sag(off, surface, 8.0, 0.0) - sag(lens, surface, 8.0, 0.0)
        slope = jax.grad(lambda y: sag(lens, surface, 0.0, y))(8.0)
        apart = (y - x) / jnp.sqrt(1 + slope**2)
        np.testing.assert_allclose(apart, fringes * HALF_WAVE, rtol=1e-3)
    # The same surface by hand.
    c, a = float(off.curvature[0]), float(off.coefficients[0, 0])
    by_hand = lens_of({0: {"form": "biconic", "radius": 1 / c, "radius_x": 1 / a}})
    x, y = jnp.linspace(-7, 7, 5), jnp.linspace(3, -6, 5)
    assert_close(sag(off, 0, x, y), sag(by_hand, 0, x, y), 1e-13)


def test_index_and_abbe_number_are_off_by_what_is_said():
    lens = lens_of()
    some = perturbed(lens, Tolerance("index", 1e-3), Tolerance("abbe", 1.0))
    assert [e.place for e in some.deviations] == [0, 1, 4, 0, 1, 4]

    def told(lens):
        f, d, c = refractive_index(lens.dispersion, LINES).T[:, jnp.array([1, 2, 5])]
        return d, (d - 1) / (f - c)

    nd, vd = told(lens)
    for k in range(3):
        unit = jnp.zeros(6).at[k].set(1.0)
        more = 1e-3 * jnp.eye(3)[k]
        assert_close(told(jax.jit(some.lens_of)(unit))[0], nd + more, 1e-13)
        there, number = told(some.lens_of(jnp.roll(unit, 3)))
        assert_close(there, nd, 1e-13)
        assert_close(number, vd * (1 + 0.01 * jnp.eye(3)[k]), 1e-6)


@pytest.mark.slow
def test_errors_have_derivatives_and_keep_the_dtype():
    lens = jax.tree.map(lambda a: a.astype(jnp.float32), lens_of())
    kinds = [Tolerance(kind, 1e-2) for kind in KINDS]
    some = perturbed(lens, *kinds)
    off = jnp.zeros(len(some.deviations), jnp.float32)
    assert {a.dtype for a in jax.tree.leaves(some.lens_of(off))} == {jnp.dtype("float32")}
    some = perturbed(lens_of(), *kinds)
    off = jnp.full(len(some.deviations), 0.3)
    numbers = jax.jit(lambda off: jnp.concatenate([*map(jnp.ravel, leaves(some.lens_of(off)))]))
    ahead = jax.jit(lambda off, unit: jax.jvp(numbers, (off,), (unit,))[1])
    for unit in jnp.eye(len(off))[::7]:
        plus, minus = (np.asarray(numbers(off + step * unit)) for step in (1e-3, -1e-3))
        known = np.isfinite(plus)
        assert np.all(known == np.isfinite(minus))
        slope = (plus[known] - minus[known]) / 2e-3
        np.testing.assert_allclose(slope, ahead(off, unit)[known], rtol=1e-5, atol=1e-11)


def leaves(lens):
    """The arrays of a lens with respect to which derivatives are taken."""
    return [a for a in jax.tree.leaves(lens) if jnp.issubdtype(a.dtype, jnp.floating)]


@pytest.mark.parametrize(
    "kind, settings, said",
    [
        ("radii", {}, "kind: expected one of radius, fringes"),
        ("radius", {"size": 0.0}, "radius: size: must be above 0 and below 100, got 0"),
        ("radius", {"size": 100.0}, "radius: size: must be above 0 and below 100, got 100"),
        ("decentre", {"size": -1.0}, "decentre: size: must be above 0, got -1"),
        ("tilt", {"size": math.nan}, "tilt: size: must be above 0, got nan"),
    ],
)
def test_tolerances_that_mean_nothing_are_refused(kind, settings, said):
    with pytest.raises(ValueError, match=f"^tolerances: {said}"):
        Tolerance(kind, **{"size": 1.0, **settings})


@pytest.mark.parametrize(
    "tolerances, said",
    [
        ([], "none; name at least one"),
        ([("decentre", (2,))], "decentre: no element 2 can deviate; there are 0, 1"),
        ([("radius", (2,))], "radius: no surface 2 can deviate; there are 0, 1, 4, 5"),
        ([("index", (2,))], "index: no surface 2 can deviate; there are 0, 1, 4"),
        ([("tilt", ()), ("tilt", (1,))], "tilt of element 1, x is named twice; remove one"),
        ([("abbe", (1, 1))], "abbe of surface 1 is named twice; remove one"),
    ],
)
def test_parts_that_are_not_there_are_refused(tolerances, said):
    with pytest.raises(ValueError, match=f"^tolerances: {said}"):
        perturbed(lens_of(), *(Tolerance(kind, 1.0, which) for kind, which in tolerances))


def test_what_a_lens_has_none_of_is_refused_by_name():
    mirror = [{"radius": -100.0, "mirror": True, "stop": True, "semi_diameter": 5.0}]
    lens = drt_jax.load_lens({"name": "mirror", "surfaces": mirror, "sensor": -50.0})
    for kind, said in (
        ("index", "the lens has no glass"),
        ("thickness", "the lens has one surface, without a thickness behind it"),
    ):
        with pytest.raises(ValueError, match=f"^tolerances: {kind}: {said}"):
            perturbed(lens, Tolerance(kind, 1e-3))
    flat = dataclasses.replace(lens, curvature=0 * lens.curvature)
    with pytest.raises(ValueError, match="no surface is curved; for planes use fringes"):
        perturbed(flat, Tolerance("radius", 1.0))
    with pytest.raises(ValueError, match=r"^beam_radius: expected \(1,\), got shape \(2,\)"):
        PerturbedLens.from_lens(lens, lens.semi_diameter, [Tolerance("tilt", 1.0)])
