"""The lens as a pytree."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Lens, Scene, design, load_lens


def test_the_sensor_is_the_last_row():
    lens = load_lens("singlet")
    rows = lens.count + 1
    assert lens.vertices[-1] == lens.sensor and lens.vertices.shape == (rows,)
    for leaf in (lens.curvature, lens.conic, lens.coefficients, lens.semi_diameter):
        assert len(leaf) == rows
    assert lens.curvature[-1] == 0 and np.isinf(lens.semi_diameter[-1])


def test_live_surfaces_bend_light():
    surfaces = [
        {"radius": 50, "thickness": 1, "glass": "N-BK7"},
        {"radius": 40, "thickness": 1, "glass": "N-BK7"},
        {"radius": "inf", "thickness": 1},
        {"radius": "inf", "thickness": 1, "stop": True, "semi_diameter": 2},
        {"radius": -90, "thickness": -9, "mirror": True},
    ]
    assert load_lens({"surfaces": surfaces}).active == (0, 2, 4)


def test_gradient_with_respect_to_a_lens_is_a_lens():
    lens = load_lens("singlet")
    focus = jax.jit(jax.value_and_grad(lambda lens: drt_jax.focal_length(lens, [0.55])[0]))
    f, gradient = focus(lens)
    assert isinstance(gradient, Lens) and gradient.name == ""  # a program serves all names
    # f = R / (n - 1) for a plano-convex lens: df/dc = -f^2 (n - 1)
    n = lens.index([0.55])[2, 0]
    np.testing.assert_allclose(gradient.curvature[1], -(f**2) * (n - 1), rtol=1e-12)
    assert gradient.sensor == 0


def test_wavelength_outside_a_glass_names_its_range():
    with pytest.raises(
        ValueError, match=re.escape("0.9 um is outside the range of SK16, 0.4 to 0.7")
    ):
        load_lens("cooke_triplet").index(jnp.array([0.55, 0.9]))
    with pytest.raises(ValueError, match=re.escape("wavelengths are in um: 0.55")):
        load_lens("cooke_triplet").index(550.0)


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


def test_a_lens_meets_the_one_before_in_a_program():
    """Replacing an array makes another type of pytree, except for arrays that `free` names."""

    @jax.jit
    def change(lens):
        after = dataclasses.replace(lens, semi_diameter=2 * lens.semi_diameter)
        return jax.tree.map(jnp.subtract, after, lens)

    lens = load_lens("singlet")
    found = change(dataclasses.replace(lens, free=("semi_diameter",)))
    np.testing.assert_allclose(found.semi_diameter[:-1], lens.semi_diameter[:-1])
    with pytest.raises(ValueError, match="different pytree metadata"):
        change(lens)


@pytest.mark.parametrize("semi", [0.0, np.inf, np.nan])
def test_a_stop_without_a_size_gets_one_line(semi):
    lens = load_lens("cooke_triplet")
    lens = dataclasses.replace(lens, semi_diameter=lens.semi_diameter.at[lens.stop].set(semi))
    for call in (
        lambda: drt_jax.psf_moments(lens, Scene.point(0.0, np.inf, 0.55)),
        lambda: drt_jax.first_order(lens, np.inf, 0.55),
        lambda: design.Problem.from_variables(
            design.Variables.from_lens(lens, ["thickness"]), ["spot"]
        ),
    ):
        with pytest.raises(ValueError, match=f"stop, surface {lens.stop}, must be above 0 mm"):
            call()


def test_sag_of_a_surface_and_of_the_sensor():
    lens = load_lens("double_gauss")
    r = 1 / float(lens.curvature[0])
    x, y = np.array([[0.0], [3.0]]), np.array([0.0, 4.0, 5.0])
    np.testing.assert_allclose(
        drt_jax.sag(lens, 0, x, y), r - np.sqrt(r**2 - x**2 - y**2), atol=1e-13
    )
    np.testing.assert_array_equal(drt_jax.sag(lens, lens.count, x, y), np.zeros((2, 3)))


def test_a_lens_prints_shortly():
    """Also a gradient, and inside a trace."""
    lens, said = load_lens("double_gauss"), []
    gradient = jax.grad(lambda lens: lens.sensor**2)(lens)
    jax.jit(lambda lens: said.append(repr(lens)))(lens)
    what = f"Lens({lens.name!r}: 11 surfaces, stop: surface 5"
    assert repr(lens) == f"{what}, sensor 133.35, float64)"
    assert repr(gradient) == f"{what}, sensor 266.7, float64)"
    assert said == [f"{what}, float64)".replace(lens.name, "")]
    assert repr(jax.tree.map(lambda _: None, lens)).startswith("Lens(")
