import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import drt_jax
from drt_jax import Lens, LensError, load_lens

from .conftest import LENSES, RGB

GOOD = {
    "surfaces": [
        {"radius": 50.0, "thickness": 4.0, "glass": "N-BK7"},
        {"radius": "inf", "thickness": 2.0, "glass": "air"},
        {"curvature": 0, "semi_diameter": 5.0, "stop": True},
    ],
    "sensor": 90.0,
}


def write(tmp_path, change):
    entry = yaml.safe_load(yaml.safe_dump(GOOD))
    change(entry)
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(entry))
    return path


def surface(i, **values):
    return lambda entry: entry["surfaces"][i].update(values)


def drop(i, key):
    return lambda entry: entry["surfaces"][i].pop(key)


BAD = {
    "unknown key": (
        surface(0, radus=3.0),
        r"surfaces\[0\]: unknown key 'radus'; did you mean 'radius'",
    ),
    "unknown top key": (lambda e: e.update(sensr=1), "unknown key 'sensr'; did you mean 'sensor'"),
    "unknown glass": (
        surface(0, glass="N-BK8"),
        r"surfaces\[0\].glass: unknown glass 'N-BK8'.*N-BK7",
    ),
    "glass and index": (surface(0, index=1.5), "either glass or index"),
    "index below 1": (lambda e: (drop(0, "glass")(e), surface(0, index=0.9)(e)), "below 1"),
    "zero radius": (surface(0, radius=0), r"surfaces\[0\].radius: 0 is no surface"),
    "no radius": (drop(0, "radius"), "either radius"),
    "text": (surface(0, thickness="thick"), r"thickness: expected a number, got 'thick'"),
    "not a number": (surface(0, thickness=float("nan")), "expected a number"),
    "infinite": (surface(0, thickness=float("inf")), "must be finite"),
    "no thickness": (drop(0, "thickness"), r"thickness: expected a number, got None"),
    "negative thickness": (
        surface(0, thickness=-1.0),
        r"surfaces\[0\].thickness: must be positive",
    ),
    "touching": (surface(0, thickness=1e-8), r"surfaces\[0\].thickness: .* leave out one of two"),
    "odd power": (surface(0, coefficients={3: 1e-5}), "3 is not an even power"),
    "too wide": (surface(0, semi_diameter=60.0), r"60 mm reaches beyond the surface.* 50 mm"),
    "negative aperture": (surface(2, semi_diameter=-1.0), "must be positive"),
    "no stop": (surface(2, stop=False), "0 have stop: true"),
    "two stops": (surface(0, stop=True, semi_diameter=9.0), "2 have stop: true"),
    "open stop": (drop(2, "semi_diameter"), r"surfaces\[2\].semi_diameter: the stop needs one"),
    "sensor in the lens": (
        lambda e: e.update(sensor=5.0),
        "sensor: 5 mm lies before the last vertex",
    ),
    "no sensor": (lambda e: e.pop("sensor"), "either sensor"),
    "two sensors": (surface(2, thickness=84.0), "either sensor"),
    "empty": (lambda e: e.update(surfaces=[]), "at least one surface"),
    "infinite curvature": (
        lambda e: (drop(0, "radius")(e), surface(0, curvature="inf")(e)),
        "must be finite",
    ),
    "unknown form": (
        surface(0, form="zernike"),
        r"surfaces\[0\].form: unknown form 'zernike'; known: asphere",
    ),
    "crossing": (
        lambda e: (
            surface(0, semi_diameter=20.0)(e),
            surface(1, semi_diameter=20.0, radius=-50)(e),
        ),
        r"surfaces\[0\].thickness: 4 mm makes surfaces 0 and 1 cross at .* mm from the axis",
    ),
    "mirror with glass": (
        surface(0, mirror=True),
        r"surfaces\[0\].glass: behind a mirror is the medium",
    ),
    "light turned": (
        lambda e: (drop(0, "glass")(e), surface(0, mirror=True)(e)),
        r"surfaces\[0\].thickness: must be negative, as a mirror has turned the light",
    ),
    "short tilt": (surface(1, tilt=[1.0]), r"surfaces\[1\].tilt: expected a list of 3 numbers"),
    "text in decentre": (
        surface(1, decentre=[0, "up"]),
        r"decentre.1: expected a number, got 'up'",
    ),
    "no radius in x": (surface(0, form="toroid"), "either radius_x"),
    "conic_x": (
        surface(0, form="toroid", radius_x=9.0, conic_x=1.0),
        "conic_x: a surface of the form toroid has none",
    ),
    "power of x": (
        surface(0, form="polynomial_xy", coefficients={"x2": 1.0}),
        "'x2' is not a power of x and y",
    ),
    "object": (lambda e: e.update(object={"glass": "N-BK8"}), "object.glass: unknown glass"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_prescriptions_get_one_clear_message(tmp_path, name):
    change, message = BAD[name]
    path = write(tmp_path, change)
    with pytest.raises(LensError, match=message) as error:
        load_lens(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)


def test_missing_and_broken_files(tmp_path):
    with pytest.raises(LensError, match="no bundled lens 'triplett'.*cooke_triplet"):
        load_lens("triplett")
    with pytest.raises(LensError, match="No such file"):
        load_lens(tmp_path / "none.yaml")
    (tmp_path / "broken.yaml").write_text("surfaces: [")
    with pytest.raises(LensError, match="not a YAML file"):
        load_lens(tmp_path / "broken.yaml")


def test_own_lens(tmp_path):
    lens = load_lens(write(tmp_path, surface(1, conic=-0.5, coefficients={4: "1e-6"})))
    assert lens.stop == 2 and lens.glasses == ("air", "N-BK7", "air", "air")
    np.testing.assert_array_equal(lens.curvature, [0.02, 0, 0])
    np.testing.assert_array_equal(lens.coefficients, [[0, 0], [0, 1e-6], [0, 0]])
    np.testing.assert_array_equal(lens.vertices, [0, 4, 6])
    moved = load_lens(write(tmp_path, lambda e: (e.pop("sensor"), surface(2, thickness=84.0)(e))))
    assert moved.sensor == lens.sensor == 90


def test_every_form_from_a_file(tmp_path):
    entry = {
        "object": {"index": 1.1},
        "surfaces": [
            {
                "form": "biconic",
                "radius": 50,
                "radius_x": 40,
                "conic_x": -1,
                "coefficients": {4: 1e-6},
                "thickness": 3,
                "glass": "N-BK7",
            },
            {
                "form": "toroid",
                "radius": 60,
                "curvature_x": 0.01,
                "coefficients": {2: 1e-4},
                "thickness": 3,
                "tilt": [1.0, 0, 0],
            },
            {
                "form": "odd_asphere",
                "radius": "inf",
                "coefficients": {3: 1e-5},
                "thickness": 3,
                "semi_diameter": 2,
                "stop": True,
            },
            {
                "form": "polynomial_xy",
                "radius": "inf",
                "coefficients": {"x1y1": 1e-4},
                "thickness": 9,
                "mirror": True,
                "decentre": [0, 1],
            },
        ],
        "sensor_tilt": [0, 2.0, 0],
    }
    path = tmp_path / "forms.yaml"
    path.write_text(yaml.safe_dump(entry))
    for lens in (load_lens(path), load_lens(entry)):
        assert lens.forms == ("biconic", "toroid", "odd_asphere", "polynomial_xy")
        assert lens.mirrors == (False, False, False, True)
        assert lens.glasses == ("index 1.1", "N-BK7", "air", "air", "air")
        np.testing.assert_allclose(
            lens.coefficients,
            [[1 / 40, -1, 0, 1e-6], [0.01, 1e-4, 0, 0], [0, 0, 1e-5, 0], [0, 0, 0, 1e-4]],
        )
        np.testing.assert_allclose(lens.tilt[1], [np.radians(1.0), 0, 0])
        np.testing.assert_allclose(lens.tilt[-1], [0, np.radians(2.0), 0])
        np.testing.assert_array_equal(lens.decentre[3], [0, 1])
        np.testing.assert_array_equal(lens.senses, [1, 1, 1, 1, -1])


def test_symmetry_is_found():
    surfaces = [
        {"radius": 50, "thickness": 4, "glass": "N-BK7"},
        {"radius": "inf", "semi_diameter": 3, "stop": True},
    ]

    def symmetry(**change):
        return load_lens(
            {"surfaces": [{**surfaces[0], **change}, surfaces[1]], "sensor": 90}
        ).symmetry

    assert symmetry() == symmetry(form="odd_asphere") == "rotation"
    assert symmetry(form="toroid", radius_x=40) == symmetry(tilt=[3, 0, 0]) == "plane"
    assert symmetry(decentre=[0, 1]) == "plane"
    for change in ({"tilt": [0, 1, 0]}, {"decentre": [1, 0]}, {"form": "polynomial_xy"}):
        assert symmetry(**change) == "none"


@pytest.mark.parametrize("name", LENSES)
def test_bundled_lenses_load_and_focus_on_their_sensor(name):
    lens = load_lens(name)
    assert all(leaf.dtype == jnp.float64 for leaf in jax.tree.leaves(lens))
    focus = drt_jax.image_distance(lens, float("inf"), jnp.array(RGB))
    assert np.all(np.abs(lens.sensor - focus) < 1.5)
    assert sorted(drt_jax.lens_names()) == sorted(LENSES)


def test_first_order_data_of_the_double_gauss(shared):
    # design_back_distance_infinity of the Zemax file; EFL 99.50 (99.5007 at the d line)
    lens = load_lens("double_gauss")
    d = jnp.array([0.5875618])
    data = yaml.safe_load((shared / "lens_and_glass.yaml").read_text())
    data = data["lenses"]["double_gauss_zemax28"]
    np.testing.assert_allclose(drt_jax.focal_length(lens, d), data["efl_d"], atol=5e-5)
    # The file's own focus is for its own glasses and criterion: a tenth of a millimetre.
    back = drt_jax.back_focal_distance(lens, d)
    np.testing.assert_allclose(back, data["design_back_distance_infinity"], atol=0.3)


def test_gradient_with_respect_to_a_lens_is_a_lens():
    lens = load_lens("singlet")
    gradient = jax.grad(lambda lens: drt_jax.focal_length(lens, jnp.array([0.55]))[0])(lens)
    assert isinstance(gradient, Lens) and gradient.name == lens.name
    # f = R / (n - 1) for a plano-convex lens: df/dc = -f^2 (n - 1)
    n, f = lens.index(jnp.array([0.55]))[2, 0], drt_jax.focal_length(lens, jnp.array([0.55]))[0]
    np.testing.assert_allclose(gradient.curvature[1], -(f**2) * (n - 1), rtol=1e-12)
    assert gradient.sensor == 0


def test_wavelength_outside_a_glass_names_its_range():
    with pytest.raises(
        ValueError, match=re.escape("0.9 um is outside the range of SK16, 0.4 to 0.7")
    ):
        load_lens("cooke_triplet").index(jnp.array([0.55, 0.9]))


def test_one_compilation_serves_lenses_of_one_shape():
    traced = []

    @jax.jit
    def power(lens):
        traced.append(1)
        return 1 / drt_jax.focal_length(lens, jnp.array([0.55]))[0]

    lens = load_lens("singlet")
    power(lens)
    power(dataclasses.replace(lens, curvature=2 * lens.curvature))
    assert len(traced) == 1


def test_a_lens_may_be_loaded_inside_jit():
    power = jax.jit(lambda s: s / drt_jax.focal_length(load_lens("singlet"), [0.55])[0])
    np.testing.assert_allclose(
        power(1.0), 1 / drt_jax.focal_length(load_lens("singlet"), [0.55])[0]
    )
