"""First-order data compared with closed forms and Fermat rays; gradients of first and third
order."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from experiments.snell import trace_snell

import drt_jax
from drt_jax import Scene, Status, load_lens, trace_rays
from drt_jax.lens.paraxial import image_height
from drt_jax.lens.scene import field_of_height

from ..conftest import RGB
from ..known import freed

GREEN = jnp.array([0.55])
COLOURS = jnp.array(RGB)
data_of = jax.jit(lambda lens, waves: drt_jax.first_order(lens, jnp.inf, waves))


def entrance(lens, waves):
    return data_of(lens, waves).entrance_pupil


def exit_(lens, waves):
    return data_of(lens, waves).exit_pupil


first_order, third_order = jax.jit(drt_jax.first_order), jax.jit(drt_jax.third_order)
image_height = jax.jit(image_height)


def thin(gap=None, radius=25.0):
    """Plano-convex singlet without thickness, n = 1.5: f = 2 R in air. The stop is its plane or,
    given a gap, another plane in front (+) or behind it (-)."""
    stop = {"curvature": 0, "semi_diameter": 2.0, "stop": True}
    glass = {"radius": radius, "index": 1.5}
    plane = {"curvature": 0}
    if gap is None:
        surfaces = [glass, plane | stop]
    elif gap > 0:
        surfaces = [stop | {"thickness": gap}, glass, plane]
    else:
        surfaces = [glass, plane | {"thickness": -gap}, stop]
    for surface in surfaces[:-1]:
        surface.setdefault("thickness", 5.0)
    lens = load_lens({"surfaces": surfaces, "sensor": 200.0})
    # Too thin for a prescription, whose surfaces would cross.
    none = np.array([n == "index 1.5" for n in lens.glasses[1:-1]])
    return dataclasses.replace(lens, thickness=jnp.where(none, 0.0, lens.thickness))


def test_pupils_of_a_thin_lens():
    """f = 50: a stop at 20 mm is imaged to 50 * 20 / (20 - 50) = -33.333 mm, 5/3 its size."""
    for gap, at in ((20.0, exit_), (-20.0, entrance)):
        pupil = at(thin(gap), GREEN)
        sign = 1 if gap > 0 else -1
        np.testing.assert_allclose(pupil.position, -sign * 100 / 3, atol=1e-7)
        np.testing.assert_allclose(pupil.semi_diameter, 10 / 3, atol=1e-8)
    for gap, at, position in ((20.0, entrance, 0.0), (-20.0, exit_, 0.0), (None, exit_, 0.0)):
        pupil = at(thin(gap), GREEN)
        np.testing.assert_allclose(pupil.position, position, atol=1e-8)
        np.testing.assert_allclose(pupil.semi_diameter, 2.0, atol=1e-8)


@pytest.mark.parametrize("gap", [20.0, 0.0, -2.0])
def test_exit_pupil_while_the_stop_slides_through_the_lens(gap):
    """f = 50: a stop at `gap` mm in front of the lens, or behind it at the position of the light
    without the lens, is imaged to 50 gap / (gap - 50), 50 / (50 - gap) its size."""
    lens = thin(20.0)
    lens = dataclasses.replace(lens, thickness=lens.thickness.at[0].set(gap))
    pupil = exit_(lens, GREEN)
    np.testing.assert_allclose(pupil.position, 50 * gap / (gap - 50), atol=1e-12)
    np.testing.assert_allclose(pupil.semi_diameter, 2 * 50 / (50 - gap), rtol=1e-12)
    np.testing.assert_allclose(entrance(lens, GREEN).position, 0, atol=1e-12)


def test_first_order_of_a_stop_that_touches_the_lens(shared):
    """P01: the numbers of OpticStudio's listing, for a stop plane 0 mm in front of R = 20."""
    case = yaml.safe_load((shared / "psf_cases.yaml").read_text())["cases"][0]
    wanted = case["reference"]["first_order"]
    stop, front, back = case["prescription"]["surfaces"]
    surfaces = [
        {"radius": s["R"], "thickness": s["t"], "index": s.get("n_after", 1.0)}
        for s in (stop, front, back)
    ]
    surfaces[0] |= {"stop": True, "semi_diameter": stop["semi_diameter"]}
    lens = load_lens({"surfaces": surfaces})
    first = first_order(lens, jnp.inf, jnp.array([0.543]))
    pupil = first.exit_pupil
    ours = [first.focal_length, first.back_focal_distance, first.f_number]
    ours += [2 * pupil.semi_diameter, pupil.position + lens.vertices[-2] - lens.sensor]
    names = ("EFL", "BFL", "paraxial_fno", "exit_pupil_diameter", "exit_pupil_from_image")
    np.testing.assert_allclose(np.ravel(ours), [wanted[n] for n in names], atol=6e-6)


def test_first_order_data_of_the_double_gauss(shared):
    # design_back_distance_infinity of the Zemax file; EFL 99.50 (99.5007 at the d line)
    first = first_order(load_lens("double_gauss"), jnp.inf, jnp.array([0.5875618]))
    data = yaml.safe_load((shared / "lens_and_glass.yaml").read_text())
    data = data["lenses"]["double_gauss_zemax28"]
    np.testing.assert_allclose(first.focal_length, data["efl_d"], atol=5e-5)
    # The file's own focus is for its own glasses and criterion: a tenth of a millimetre.
    back = data["design_back_distance_infinity"]
    np.testing.assert_allclose(first.back_focal_distance, back, atol=0.3)


def test_telecentric_pupils_are_infinite_and_have_no_nan():
    """A stop in the front focus of one surface of power 1/64 mm: its exit pupil is at infinity."""
    surfaces = [
        {"curvature": 0, "thickness": 64.0, "semi_diameter": 2.0, "stop": True},
        {"curvature": 1 / 32, "index": 1.5},
    ]
    lens = load_lens({"surfaces": surfaces, "sensor": 200.0})
    pupil = exit_(lens, GREEN)
    assert np.all(np.isinf(pupil.position)) and np.all(np.isinf(pupil.semi_diameter))
    np.testing.assert_allclose(first_order(lens, jnp.inf, GREEN).f_number, 96 / 4, rtol=1e-12)
    gradient = jax.jit(jax.grad(lambda lens: sum(jnp.sum(p) for p in exit_(lens, GREEN))))(lens)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))
    behind = dataclasses.replace(lens, thickness=lens.thickness + 1e-3)
    assert np.all(exit_(behind, GREEN).position > 1e6)


@pytest.mark.slow
def test_pupils_are_where_fermat_chief_rays_cross_the_axis():
    """A chief ray at 1e-4 rad: third-order aberrations are 1e-8 of the distance."""
    lens = load_lens("cooke_triplet")
    rays = trace_rays(lens, Scene.point(1e-4, np.inf, RGB), [[0.0, 0.0]])
    points = np.asarray(rays.points[:, 0])
    first = points[:, 0, 1] / np.tan(1e-4)
    vertex = float(lens.vertices[-2])
    (y0, z0), (y1, z1) = points[:, -2, 1:].T, points[:, -1, 1:].T
    last = z0 - y0 * (z1 - z0) / (y1 - y0) - vertex
    np.testing.assert_allclose(-first, entrance(lens, COLOURS).position, rtol=1e-6)
    np.testing.assert_allclose(last, exit_(lens, COLOURS).position, rtol=1e-6)


def test_conjugates_of_a_thin_lens():
    """f = 50, object at 150: image at 75, magnification -1/2; image of an object 10 mm below
    the axis 5 mm above it."""
    lens = thin()
    distance, inf = 150.0, jnp.inf
    near, far = first_order(lens, distance, GREEN), first_order(lens, inf, GREEN)
    np.testing.assert_allclose(near.focal_length, 50, rtol=1e-9)
    np.testing.assert_allclose(near.front_focal_distance, -50, rtol=1e-9)
    np.testing.assert_allclose(near.image_distance, 75, rtol=1e-9)
    np.testing.assert_allclose(near.magnification, -0.5, rtol=1e-9)
    field = field_of_height([-10.0, 0.0, 10.0], distance)
    height = image_height(lens, field, distance, GREEN)
    np.testing.assert_allclose(height, [[5.0], [0.0], [-5.0]], rtol=1e-8)
    np.testing.assert_allclose(far.magnification, 0)
    np.testing.assert_allclose(far.f_number, 12.5, rtol=1e-9)
    np.testing.assert_allclose(near.f_number, 18.75, rtol=1e-9)
    np.testing.assert_allclose(near.numerical_aperture, 2 / 75, rtol=1e-9)


def test_afocal_lens_is_infinite_and_has_no_nan():
    """A plane-parallel plate: no focus, magnification 1, no aberration of the image at infinity."""
    plate = {"curvature": 0, "index": 1.5, "thickness": 5.0}
    stop = {"curvature": 0, "semi_diameter": 2.0, "stop": True}
    lens = load_lens({"surfaces": [plate, stop], "sensor": 200.0})
    first = first_order(lens, jnp.inf, GREEN)
    for value in first[:5]:
        assert np.all(np.isinf(value))
    assert first.numerical_aperture == 0
    np.testing.assert_allclose(first_order(lens, 80.0, GREEN).magnification, 1)

    def total(lens):
        sums = third_order(lens, Scene.point(0.1, jnp.inf, GREEN)).total
        return sum(jnp.sum(a) for a in sums) + jnp.sum(drt_jax.focal_length(lens, GREEN))

    gradient = jax.jit(jax.grad(total))(lens)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient))


CASSEGRAIN = {
    "surfaces": [
        {
            "radius": -1000,
            "conic": -1,
            "mirror": True,
            "semi_diameter": 100,
            "stop": True,
            "thickness": -375.0,
        },
        {"radius": -1000 / 3, "conic": -4.0, "mirror": True, "thickness": 475.0},
    ]
}


def test_cassegrain():
    """Primary f 500, secondary 125 mm in front of its focus, m = 4: focus 500 mm behind the
    secondary, focal length 2000; 1/f of the second is 1/125 - 1/500."""
    lens = load_lens(CASSEGRAIN)
    first = first_order(lens, np.inf, GREEN)
    np.testing.assert_allclose(first.focal_length, 2000, rtol=1e-12)
    np.testing.assert_allclose(first.back_focal_distance, 500, rtol=1e-12)
    np.testing.assert_allclose(first.f_number, 10, rtol=1e-12)
    np.testing.assert_allclose(image_height(lens, 0.01, np.inf, GREEN), 2000 * np.tan(0.01))
    # Petzval: 1 / R = 2 / R2 - 2 / R1, R the radius of the field
    np.testing.assert_allclose(first.petzval_radius, -1 / (-2 / 1000 + 6 / 1000))


IMMERSED = {
    "object": {"index": 1.2},
    "surfaces": [
        {
            "radius": 40,
            "conic": -0.7,
            "coefficients": {2: 3e-4, 4: -2e-6},
            "thickness": 6,
            "glass": "N-SK16",
        },
        {"radius": -90, "coefficients": {4: 3e-6}, "thickness": 4},
        {"curvature": 0, "semi_diameter": 5, "stop": True, "thickness": 3},
        {
            "radius": 60,
            "form": "odd_asphere",
            "conic": 0.5,
            "coefficients": {2: -2e-4, 4: 1e-6},
            "thickness": 3,
            "glass": "SF10",
        },
        {"radius": -50, "glass": "water"},
    ],
    "sensor": 150.0,
}


@pytest.mark.slow
def test_image_space_in_water():
    """A thick lens in front of water: n' / f' is the power. Fermat rays end where Snell's do and,
    close to the axis, in the paraxial focus."""
    surfaces = [
        {"radius": 30, "glass": "N-BK7", "thickness": 6.0, "semi_diameter": 8.0, "stop": True},
        {"radius": -40, "glass": "water"},
    ]
    lens = load_lens({"surfaces": surfaces, "sensor": 70.0})
    n, water = lens.index(COLOURS)[1:]
    first, second = (n - 1) / 30, (water - n) / -40
    power = first + second - 6 / n * first * second
    focal = water / power
    data = first_order(lens, np.inf, COLOURS)
    np.testing.assert_allclose(data.focal_length, focal, rtol=1e-13)
    np.testing.assert_allclose(data.effective_focal_length, 1 / power, rtol=1e-13)
    back = focal * (1 - 6 / n * first)
    np.testing.assert_allclose(data.back_focal_distance, back, rtol=1e-13)
    front = -(1 - 6 / n * second) / power
    np.testing.assert_allclose(data.front_focal_distance, front, rtol=1e-13)
    np.testing.assert_allclose(data.numerical_aperture, 8 * power, rtol=1e-13)

    rays = trace_rays(lens, Scene.point(0.0, np.inf, RGB), [[0.0, 1e-4], [0.0, 0.9], [0.6, -0.5]])
    assert np.all(rays.status == Status.OK)
    points = np.asarray(rays.points)
    step = points[:, 0, 2] - points[:, 0, 1]
    cross = points[:, 0, 1, 2] - points[:, 0, 1, 1] * step[:, 2] / step[:, 1]
    np.testing.assert_allclose(cross - 6, back, rtol=1e-7)
    axis = jnp.array([0.0, 0.0, 1.0])
    snell = jax.jit(jax.vmap(trace_snell, (None, None, 0, None)))
    for k, wavelength in enumerate(RGB):
        hits, ok = snell(lens, wavelength, points[k, :, 0] - 9 * np.asarray(axis), axis)
        assert np.all(ok)
        np.testing.assert_allclose(points[k], hits, atol=1e-11)


@pytest.mark.slow
def test_gradients_batches_and_one_program_for_all():
    """Gradients agree with central differences of the fourth order to 1e-6, all in one vmap."""
    lens = freed(load_lens(IMMERSED))

    def terms(lens):
        first = drt_jax.first_order(lens, 200.0, COLOURS)
        total = drt_jax.third_order(lens, Scene.point(0.1, 200.0, COLOURS)).total
        return jnp.stack([*first[:7], *first.entrance_pupil, *first.exit_pupil, *total])

    weight = jnp.sin(jnp.arange(60.0).reshape(20, 3))
    weight = weight / jnp.maximum(jnp.abs(jax.jit(terms)(lens)), 1e-3)
    leaves = ("curvature", "thickness", "conic", "coefficients", "semi_diameter")
    step = {
        "curvature": 1e-5,
        "thickness": 1e-2,
        "conic": 1e-2,
        "coefficients": 1e-8,
        "semi_diameter": 1e-2,
    }
    moves = []
    for name in leaves:
        leaf = getattr(lens, name)
        way = np.linspace(0.5, 1.0, leaf.size).reshape(leaf.shape) * step[name]
        for s in (-2, -1, 1, 2):
            moves.append(dataclasses.replace(lens, **{name: leaf + s * way}))
    many = jax.tree.map(lambda *a: jnp.stack(a), lens, *moves)
    values, gradients = jax.jit(
        jax.vmap(jax.value_and_grad(lambda lens: jnp.sum(weight * terms(lens))))
    )(many)
    for k, name in enumerate(leaves):
        low, lower, higher, high = values[1 + 4 * k : 5 + 4 * k]
        wanted = (8 * (higher - lower) - (high - low)) / 12
        leaf = getattr(gradients, name)[0]
        way = np.linspace(0.5, 1.0, leaf.size).reshape(leaf.shape) * step[name]
        np.testing.assert_allclose(np.sum(leaf * way), wanted, rtol=1e-6, atol=1e-9)
