"""Lenses at another temperature."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import LensError, find_glass, load_lens, save_lens
from drt_jax.design import ThermalModel, at_temperature
from drt_jax.lens.edit import scaled
from drt_jax.lens.glass import Glass

WAVES = (0.4861327, 0.5875618, 0.6562725)


def singlet(glass, radius=100.0, thickness=4.0):
    first = {"radius": radius, "thickness": thickness, "glass": glass, "semi_diameter": 5e-3}
    return load_lens({"surfaces": [first | {"stop": True}, {"radius": -radius}], "sensor": 100})


def index(glass, celsius, waves, pressure=1.0):
    lens = singlet(glass)
    hot = at_temperature(lens, celsius, ThermalModel.from_lens(lens), pressure)
    return np.asarray(hot.index(waves)[1])


# SCHOTT's data sheet of N-BK7, as at pmoptics.com/Glass_Temperature_Coefficient.html: changes of
# the index in 1e-6/K relative to air, and absolute, at 1060 nm, e and g.
BK7 = {
    (-40, -20): ((2.4, 2.9, 3.3), (0.3, 0.8, 1.2)),
    (20, 40): ((2.4, 3.0, 3.5), (1.1, 1.6, 2.1)),
    (60, 80): ((2.5, 3.1, 3.7), (1.5, 2.1, 2.7)),
}


@pytest.mark.parametrize("ends", BK7)
def test_coefficients_that_schott_prints(ends):
    for pressure, printed in zip((1.0, 0.0), BK7[ends], strict=True):
        low, high = (index("N-BK7", t, [1.06, 0.546074, 0.435835], pressure) for t in ends)
        np.testing.assert_allclose((high - low) / (ends[1] - ends[0]) * 1e6, printed, atol=0.0501)


# Indices by Optiland, commit 1fcb3876, `Material(name).n(wavelength, temperature, pressure)` at the
# lines F, d and C, taken as wavelengths in this air, at (C, atm). It takes (n^2 - 1) / 2n of the
# absolute index, where Schott's note has the relative one: 2e-7 of the index of N-FK51A.
OPTILAND = {
    ("N-SF57", -20, 1.0): (1.871961095267164, 1.8466014653740805, 1.8364638340999058),
    ("N-SF57", 60, 0.5): (1.8725050604008453, 1.846962863265844, 1.8367642979563188),
    ("N-FK51A", -20, 1.0): (1.4907588882724858, 1.4867709108738394, 1.4850103215765456),
    ("N-FK51A", 60, 0.5): (1.4905148961302679, 1.4865069134297573, 1.4847382839086105),
    ("S-BSL7", -20, 1.0): (1.521773640167196, 1.5162137866208687, 1.5137449557234988),
    ("S-BSL7", 60, 0.5): (1.5222030980839012, 1.5166114508070916, 1.5141300880246504),
    ("S-BSL7", 20, 0.0): (1.5223172979091157, 1.5167363079401526, 1.5142590428934881),
}


@pytest.mark.parametrize("name, celsius, pressure", OPTILAND)
def test_indices_of_another_program(name, celsius, pressure):
    def air(celsius, pressure):
        """Index of air as in OpticStudio's manual."""
        s = np.square(WAVES)
        above = 6432.8 + 2949810 * s / (146 * s - 1) + 25540 * s / (41 * s - 1)
        return 1 + 1e-8 * above * pressure / (1 + 3.4785e-3 * (celsius - 15))

    light = WAVES * air(celsius, pressure) / air(find_glass(name).celsius, 1)
    found = index(name, celsius, light, pressure)
    np.testing.assert_allclose(found, OPTILAND[name, celsius, pressure], atol=2.5e-7, rtol=0)


def test_the_catalogue_is_the_lens_itself():
    lens = load_lens("double_gauss")
    same = at_temperature(lens, 20.0, ThermalModel.from_lens(lens))
    np.testing.assert_allclose(same.index(WAVES), lens.index(WAVES), rtol=0, atol=4e-16)
    cold = dataclasses.replace(same, dispersion=lens.dispersion)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-15), cold, lens)


def test_aspheric_terms_that_opticstudio_picks_up():
    """community.zemax.com, "How thermal parameter values being calculated?": an expansion of
    8e-6/K, a radius of 100, and terms of r^2, r^4 and r^6 at 40 K and 80 K more (the second at 40 K
    is misprinted)."""
    asphere = {"radius": 100, "coefficients": {2: 1e-3, 4: 1e-6, 6: 1e-9}, "stop": True}
    first = asphere | {"glass": "mine", "thickness": 5, "semi_diameter": 5}
    glasses = {"mine": {"schott": [2.25, 0, 0, 0, 0, 0]}}
    lens = load_lens({"glasses": glasses, "surfaces": [first, {"radius": "inf"}], "sensor": 200})
    mine = Glass("mine", thermal=(0.0,) * 6, expansion=8.0)
    model = ThermalModel.from_lens(lens, 23.6, {"mine": mine})
    listed = {
        60: (100.032, 0.9996810, np.nan, 0.99840153),
        100: (100.064, 0.9993604093, 0.998082455, 0.9968061348),
    }
    for celsius, (radius, *factors) in listed.items():
        hot = at_temperature(lens, celsius, model)
        np.testing.assert_allclose(1 / hot.curvature[0], radius, rtol=1e-12)
        ratio = hot.coefficients[0, :3] / lens.coefficients[0, :3]
        given = np.isfinite(factors)
        np.testing.assert_allclose(ratio[given], np.array(factors)[given], rtol=2e-6)


def test_focal_length_of_a_thin_lens():
    """f / f0 = k (n0 - 1) / (n - 1) for a thin lens with the expansion factor k."""
    lens = singlet("N-BK7", 100.0, 1e-6)
    model = ThermalModel.from_lens(lens)

    def focal(celsius):
        hot = at_temperature(lens, celsius, model)
        first = drt_jax.first_order(hot, jnp.inf, jnp.array([0.546074]))
        return first.effective_focal_length[0]

    n0, n = (index("N-BK7", celsius, 0.546074)[0] for celsius in (20, 70))
    expected = (1 + 50 * 7.1e-6) * (n0 - 1) / (n - 1)
    np.testing.assert_allclose(focal(70.0) / focal(20.0), expected, rtol=1e-8)
    # f (alpha - dn/dT / (n - 1)) with the printed 3.0e-6/K at the line e, whose n is 1.51872
    slope = jax.jit(jax.grad(focal))(30.0)
    np.testing.assert_allclose(slope / focal(30.0), 7.1e-6 - 3.0e-6 / 0.51872, atol=0.15e-6)
    step = (focal(31.0) - focal(29.0)) / 2
    np.testing.assert_allclose(slope, step, rtol=1e-4)


def test_air_spaces_between_rims():
    """Rims of two spheres, held apart by a tube that expands along and across the axis."""
    lens = load_lens("double_gauss")
    celsius, mounts = 70.0, 20.0
    hot = at_temperature(lens, celsius, ThermalModel.from_lens(lens, mounts))
    grow = 50e-6 * np.array([find_glass(g).expansion or mounts for g in lens.glasses[1:]]) + 1
    for i in (1, 8):  # between N-SK2 and N-SK16, and between two elements of N-SK16
        alpha = [find_glass(lens.glasses[k]).expansion for k in (i, i + 2)]
        growth, tube = 1 + 50e-6 * np.array(alpha), 1 + 50e-6 * mounts
        height = np.asarray(lens.semi_diameter[i : i + 2])
        radius = 1 / np.asarray(lens.curvature[i : i + 2])

        def sag(radius, height):
            return radius - np.sign(radius) * np.sqrt(radius**2 - height**2)

        before = np.diff(sag(radius, height))[0]
        after = np.diff(sag(growth * radius, tube * height))[0]
        gap = tube * (lens.thickness[i] + before) - after
        np.testing.assert_allclose(hot.thickness[i], gap, rtol=1e-12)
    solid = [i for i, g in enumerate(lens.glasses[1:-1]) if g != "air"]
    solid = np.array(solid)
    thick = lens.thickness * grow[:-1]
    np.testing.assert_allclose(hot.thickness[solid], thick[solid], rtol=1e-14)
    # The cemented surface expands like the glass behind it, the stop like the mount.
    tube = 1 + 50e-6 * mounts
    factors = [*grow[[0, 0, 2, 3, 3]], tube, *grow[[6, 7, 7, 9, 9]], tube]
    np.testing.assert_allclose(hot.semi_diameter, lens.semi_diameter * np.array(factors))


def test_a_telescope_of_one_metal_only_grows():
    lens = load_lens("ritchey_chretien")
    hot = at_temperature(lens, -30.0, ThermalModel.from_lens(lens, 23.6))
    larger = scaled(lens, 1 - 50 * 23.6e-6)
    for name in ("curvature", "thickness", "sensor", "semi_diameter", "coefficients"):
        np.testing.assert_allclose(getattr(hot, name), getattr(larger, name), rtol=1e-12)
    np.testing.assert_allclose(hot.index(0.55), 1)


def test_parts_grow_with_what_holds_them():
    """A grating keeps its number of lines, apertures expand with their surface, positions with the
    mount."""
    surface = {"radius": 50, "glass": "N-BK7", "thickness": 4, "stop": True, "semi_diameter": 5}
    surface |= {"phase": {"form": "linear", "order": 1, "coefficients": {"y": 100}}}
    surface |= {"aperture": {"rectangle": [4, 3], "centre": [1, 0]}, "decentre": [0.5, 0]}
    element = {"surfaces": [0, 1], "about": 0, "pivot": 2, "shift": [0.1, 0, 0]}
    lens = load_lens(
        {"surfaces": [surface, {"radius": "inf"}], "elements": [element], "sensor": 100}
    )
    hot = at_temperature(lens, 120.0, ThermalModel.from_lens(lens))
    glass, tube = 1 + 100 * 7.1e-6, 1 + 100 * 23.6e-6
    lines = np.ravel(hot.phase.coefficients)
    np.testing.assert_allclose(lines[0], 100 / glass, rtol=1e-14)
    np.testing.assert_allclose(hot.apertures.half[0], [4 * glass, 3 * glass], rtol=1e-14)
    np.testing.assert_allclose(hot.apertures.centre[0], [glass, 0], rtol=1e-14)
    np.testing.assert_allclose(hot.decentre[0], [0.5 * glass, 0], rtol=1e-14)
    np.testing.assert_allclose(hot.elements.pivot, 2 * glass, rtol=1e-14)
    np.testing.assert_allclose(hot.sensor, 4 * glass + 96 * tube, rtol=1e-14)


def test_in_programs_over_temperatures():
    """One program for several temperatures, and its derivatives by the numbers of the lens."""
    lens = load_lens("double_gauss")
    model = ThermalModel.from_lens(lens)

    @jax.jit
    def focus(lens, celsius):
        first = drt_jax.first_order(
            at_temperature(lens, celsius, model), jnp.inf, jnp.array([0.55])
        )
        return first.back_focal_distance[0]

    places = jax.vmap(focus, (None, 0))(lens, jnp.array([-20.0, 60.0]))
    alone = [focus(lens, celsius) for celsius in (-20.0, 60.0)]
    np.testing.assert_allclose(places, alone, rtol=1e-12)
    slope = jax.grad(focus)(lens, 60.0).curvature[2]
    step = jnp.zeros_like(lens.curvature).at[2].set(1e-6)
    both = [
        focus(dataclasses.replace(lens, curvature=lens.curvature + s * step), 60.0) for s in (1, -1)
    ]
    np.testing.assert_allclose(slope, (both[0] - both[1]) / 2e-6, rtol=1e-6)


def test_what_is_refused(tmp_path):
    lens = load_lens("double_gauss")
    model = ThermalModel.from_lens(lens)
    hot = at_temperature(lens, 40.0, model)
    with pytest.raises(ValueError, match="is at another temperature; take that at 20 C"):
        at_temperature(hot, 40.0, model)
    with pytest.raises(ValueError, match="change glasses of the lens at 20 C"):
        drt_jax.with_glass(hot, find_glass("N-BK7"), [0])
    with pytest.raises(LensError, match="save the lens at 20 C"):
        save_lens(hot, tmp_path / "hot.yaml")
    with pytest.raises(ValueError, match="lens with other surfaces"):
        at_temperature(load_lens("singlet"), 40.0, model)
    with pytest.raises(ValueError, match=r"mounts: expected one or \d+ numbers"):
        ThermalModel.from_lens(lens, [1.0, 2.0])
    modelled = drt_jax.with_model_glass(lens, [0])
    with pytest.raises(ValueError, match="model .*: thermal and expansion not known; give"):
        ThermalModel.from_lens(modelled)
    like = {modelled.glasses[1]: find_glass("N-SK2")}
    warm = at_temperature(modelled, 40.0, ThermalModel.from_lens(modelled, glasses=like))
    change = warm.index(WAVES) - modelled.index(WAVES)
    ours = hot.index(WAVES) - lens.index(WAVES)
    np.testing.assert_allclose(change[1], ours[1], atol=1e-7)
    assert drt_jax.with_model_glass(hot).dispersion.thermal is not None
    nd = [drt_jax.with_model_glass(hot).index(WAVES[1]), hot.index(WAVES[1])]
    np.testing.assert_allclose(*nd, rtol=1e-12)


def test_air_at_any_wavelength_is_finite():
    lens = singlet("silica")
    hot = at_temperature(lens, 80.0, ThermalModel.from_lens(lens))
    every = drt_jax.lens.glass.refractive_index(hot.dispersion, jnp.geomspace(1e-5, 1e7, 400))
    assert jnp.all(jnp.isfinite(every))
    assert jnp.all(every[0] == 1)
