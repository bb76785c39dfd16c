"""Figures of analyses show the computed numbers."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_rgb

import drt_jax
from drt_jax import Scene, show
from drt_jax.image.chief import Distortion
from drt_jax.image.fans import AxialColour, RayFans
from drt_jax.lens.seidel import ThirdOrder
from drt_jax.show import analyses, figures
from drt_jax.show.figures import FIELD_COLOURS
from drt_jax.show.sheet import analysed, highest

WAVES = (0.6, 0.53, 0.48)
LENS = drt_jax.load_lens("cooke_triplet")
SCENE = np.array([0.0, 0.1, 0.2]), np.inf, WAVES


def test_colours_run_from_blue_to_red():
    assert analyses.colours((0.48, 0.6)) == ["#1f77b4", "#d62728"]
    assert analyses.colours(WAVES)[1] not in ("#1f77b4", "#d62728")
    assert len(analyses.colours([0.55])) == 1 and len(analyses.colours([0.5, 0.5])) == 2


def test_a_colour_is_a_field_or_a_wavelength():
    """Colours of fields differ from all colours between those of wavelengths, blue to green to
    red."""
    ramp = np.array([to_rgb(c) for c in analyses.colours(np.linspace(0.4, 0.7, 101))])
    for hue in FIELD_COLOURS:
        assert np.min(np.linalg.norm(ramp - to_rgb(hue), axis=1)) > 0.15
    _, axes = show.new()
    nothing = np.full((2, 3, 2), np.inf)
    show.lateral_colour(axes, nothing, SCENE[0][:2], WAVES)
    analyses.legend(axes)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [f"{w} um" for w in WAVES]


def test_labels_of_an_afocal_lens_name_angles():
    _, axes = show.new()
    axes.set(xlabel="RMS 3, Airy 4 um", ylabel="illumination", title="lateral colour (um)")
    analyses.in_angles(axes)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("RMS 3, Airy 4 urad", "illumination")
    axes.set(xlabel="focus (mm), S dashed", ylabel="cycles/mm")
    analyses.in_angles(axes)
    assert axes.get_xlabel() == "focus (1e-3 dioptre), S dashed"
    assert axes.get_ylabel() == "cycles/mrad" and axes.get_title() == "lateral colour (urad)"


@pytest.mark.slow
def test_curves_hold_the_numbers():
    bent = drt_jax.distortion(LENS, Scene.radians(*SCENE))
    _, axes = show.new()
    show.distortion(axes, bent, SCENE[0], WAVES)
    *curves, _ = axes.lines
    assert len(curves) == 3
    np.testing.assert_allclose(curves[0].get_xdata(), 100 * np.asarray(bent.relative)[:, 0])
    np.testing.assert_allclose(curves[0].get_ydata(), np.degrees(SCENE[0]))
    foci = drt_jax.field_curvature(LENS, Scene.radians(*SCENE))
    _, axes = show.new()
    show.field_curvature(axes, foci, SCENE[0], WAVES)
    styles = [line.get_linestyle() for line in axes.lines[:6]]
    assert sorted(styles) == ["-"] * 3 + ["--"] * 3


@pytest.mark.slow
def test_what_is_not_finite_is_left_out():
    """A spot without light, and a fan with clipped ends."""
    lens = dataclasses.replace(LENS, semi_diameter=LENS.semi_diameter.at[0].set(5.0))
    fans = drt_jax.ray_fans(lens, Scene.radians([0.0, 0.3], np.inf, WAVES), 9)
    _, axes = show.new()
    show.fan(axes, fans, 1, WAVES)
    drawn = axes.lines[0].get_ydata()
    assert np.any(np.isnan(drawn)) and np.any(np.isfinite(drawn))
    found = drt_jax.spot_diagram(LENS, Scene.radians(*SCENE), drt_jax.Gauss(4, "bilateral"))
    dark = dataclasses.replace(
        found,
        points=jnp.full_like(found.points, jnp.inf),
        airy_radius=jnp.full_like(found.airy_radius, jnp.inf),
    )
    stray = dataclasses.replace(found, radius=30 * found.rms)
    assert np.all(analyses.spot_radius(stray) == 5 * np.asarray(found.rms))
    assert np.array_equal(analyses.spot_radius(found), found.radius)
    for each, label in ((found, "RMS"), (stray, "RMS"), (dark, "no light arrives")):
        figure, axes = show.new()
        show.spots(axes, each, 1, WAVES)
        assert axes.get_xlabel().startswith(label)
        assert ("rays to" in axes.get_xlabel()) == (each is stray)
        assert figure._repr_png_()


def test_scales_are_round_and_hold_every_number():
    assert figures.rounded_up([0.3, -2.4, np.inf]) == 3 and figures.rounded_up([]) == 1
    assert figures.rounded_up(1.2e-4) == pytest.approx(1.5e-4)
    assert figures.rounded_up(0.034, (1, 2, 5, 10)) == pytest.approx(0.05)


def test_frequencies_end_where_contrast_does():
    """At 200 cycles/mm, at the diffraction limit, or for a telescope of 28 um at 100."""
    assert highest(900.0, np.array([0.005, np.inf])) == 200
    assert highest(150.0, np.array([0.005])) == 150 and highest(0.0, np.array([1e-9])) == 200
    assert highest(570.0, np.array([0.028, 0.147])) == 100


def test_fans_have_one_scale_with_symbols_and_units():
    pupil = np.linspace(-1, 1, 5)
    errors = np.arange(20.0).reshape(1, 2, 5, 2) * 1e-3
    fans = RayFans(pupil, errors, -errors, errors[..., 0], 2 * errors[..., 0])
    _, axes = show.new()
    show.fan(axes, fans, 0, (0.5, 0.6), half=20.0)
    np.testing.assert_allclose(axes.lines[1].get_ydata(), 1e3 * errors[0, 1, :, 1])
    assert axes.get_ylim() == (-20, 20) and axes.get_ylabel() == "ray error $e_y$ (um)"
    assert axes.get_xlabel() == "pupil $P_y$"
    _, axes = show.new()
    show.path_fan(axes, fans, 0, (0.5, 0.6), sagittal=True)
    np.testing.assert_allclose(axes.lines[0].get_ydata(), 2 * errors[0, 0, :, 0])
    assert axes.get_ylabel() == "OPD along x (waves)" and axes.get_xlabel() == "pupil $P_x$"


def test_bars_are_third_order_aberrations_of_each_surface_and_their_sum():
    """The length of each bar is its number in units of the distance of two lines, which the label
    gives in mm."""
    parts = [np.array([[1.0], [-3.0]]) * 1e-3 * k for k in range(1, 9)]
    _, axes = show.new()
    show.seidel(axes, ThirdOrder(*parts, parts[0]))
    spacing = float(axes.get_xlabel().split()[-2])
    bars = np.array([bar.get_height() for bar in axes.patches]).reshape(8, 3)
    wanted = [np.append(part, np.sum(part)) for part in parts]
    np.testing.assert_allclose(bars * spacing, wanted, rtol=1e-3)
    assert np.max(np.abs(bars)) <= 0.5  # no bar reaches its neighbour
    words = [text.get_text() for text in axes.get_xticklabels()]
    assert words == ["0", "1", "sum"]
    assert axes.get_yticklabels()[1].get_text() == "tangential coma"


def test_further_graphs_hold_their_numbers():
    """With invented numbers, so that nothing is traced."""
    draw = lambda of, *args: of(show.new()[1], *args)  # noqa: E731
    found = AxialColour(np.array([0.1, -0.1]), np.array([[0.2, np.inf], [0.3, 0.4]]))
    axes = draw(show.longitudinal, found, [0.5, 1.0], (0.5, 0.6))
    np.testing.assert_array_equal(axes.lines[0].get_xdata(), [0.2, np.nan])
    np.testing.assert_array_equal(axes.lines[2].get_xdata(), [0.3, 0.4])
    axes = draw(show.focal_shift, found, (0.5, 0.6), 0.55)
    np.testing.assert_allclose(axes.lines[0].get_xdata(), [100, -100])  # um
    curves = np.random.default_rng(0).random((3, 2, 4))
    axes = draw(show.mtf_over_field, [0, 0.1, 0.2], curves, [10, 20, 30, 40])
    np.testing.assert_allclose(axes.lines[3].get_ydata(), curves[:, 1, 1])
    assert len({line.get_color() for line in axes.lines}) == 4
    axes = draw(show.mtf_through_focus, [-1, 0, 1], curves[:, :, :3].swapaxes(1, 2), "abc", 50)
    np.testing.assert_allclose(axes.lines[1].get_ydata(), curves[0, 1, :3])
    assert "50 cycles/mm" in axes.get_ylabel()
    real = np.random.default_rng(1).random((4, 1, 2))
    bent = Distortion(np.array([[0.0], [0.01], [-0.02], [np.inf]]), real, real + 1, np.ones(1))
    axes = draw(show.grid_distortion, bent, 2)
    assert len(axes.lines) == 8 and "largest distortion -2 %" in axes.get_xlabel()
    np.testing.assert_allclose(axes.lines[4].get_xydata(), real[:2, 0])
    hits = np.array([[[1.0, 2.0], [np.inf, 0.0]]])
    axes = draw(show.footprints, hits, 3.0)
    np.testing.assert_array_equal(axes.lines[0].get_xydata(), [[1, 2]])
    assert [circle.radius for circle in axes.patches] == [3]
    axes = draw(show.wavefront_map, np.array([[0.0, 0.5], [np.nan, 1.0]]))
    assert axes.get_title() == "PV 1, RMS 0.408 waves"
    axes = draw(show.point_spread, np.diag([1.0, 4.0]), 1e-3)
    assert axes.images[0].get_extent() == [-1, 1, -1, 1]
    np.testing.assert_allclose(axes.images[0].get_array(), np.diag([0.25, 1.0]))


@pytest.mark.slow
def test_the_numbers_of_a_sheet_are_those_of_the_analyses():
    """With the weights of the scene; contrast agrees with `transfer` with its own choice of
    cells."""
    scene = Scene.radians([0.3, 0.0], np.inf, WAVES, wavelength_weights=(1.0, 3.0, 0.0))
    found = analysed(LENS, scene, None, lambda what: None)
    assert found.names == ["0°", "17.19°"] and not found.left_out
    exact = drt_jax.transfer(LENS, found.scene, found.lines)
    np.testing.assert_allclose(found.contrast, exact.mtf, atol=3e-3)
    np.testing.assert_allclose(found.limit, exact.limit[0, 0], atol=3e-3)
    parts = found.lines[-1] * np.array([0.25, 0.5])
    end = drt_jax.transfer(LENS, Scene.radians(0.3, np.inf, WAVES), parts).mtf
    plain = drt_jax.transfer(LENS, found.scene, parts).mtf
    over = np.asarray(found.over_field)[[0, -1]]
    np.testing.assert_allclose(over, plain, atol=3e-3)
    assert np.max(np.abs(np.asarray(plain[1] - end))) > 0.01  # weights count
    spots = drt_jax.spot_diagram(LENS, found.scene)
    np.testing.assert_allclose(found.spots.rms[:2], spots.rms, rtol=1e-3)
    # Rays that fill the stop evenly show the light: within the error of their number, their RMS
    # radius is that of the spot.
    middle = found.hits[:, 1] - found.hits[:, 1].mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(np.sum(middle**2, axis=-1), axis=1))
    alone = drt_jax.spot_diagram(LENS, Scene.radians([0.0, 0.3], np.inf, WAVES[1])).rms
    np.testing.assert_allclose(size, alone, rtol=0.03)


@pytest.mark.slow
def test_a_sheet_of_a_tilted_lens_says_that_third_order_has_no_theory():
    """Where bars of numbers that are not finite would look like none."""
    rows = LENS.count + 1
    moved = {"tilt": jnp.zeros((rows, 3)).at[0, 0].set(0.01), "decentre": jnp.zeros((rows, 2))}
    lens, scene = dataclasses.replace(LENS, **moved), Scene.radians(0.1, np.inf, 0.53)
    found = analysed(lens, scene, None, lambda what: None)
    assert found.third == "third order: no theory for tilted or decentred surfaces"


@pytest.mark.slow
def test_further_panels(tmp_path):
    scene = Scene.radians([0.0, 0.2], np.inf, WAVES[:2])
    titles = [*show.more_panels(LENS, scene)]
    assert titles[-1].startswith("Point spread function, by waves") and titles[:-1] == [
        "Grid distortion", "Footprints and clear apertures", "Wavefront", "Longitudinal aberration",
        "Chromatic focal shift", "MTF through focus", "Spots through focus",
    ]  # fmt: skip


@pytest.mark.slow
def test_a_sheet_has_all_panels():
    """Also for an axial field alone, and for a lens that passes no light at one of its fields."""
    for fields, count in (([0.0, 0.1, 0.2, 0.3], 29), ([0.0], 14)):
        said: list[str] = []
        figure = show.sheet(LENS, Scene.radians(fields, np.inf, WAVES), say=said.append)
        assert len(figure.axes) == count and said[-1] == "drawing"
        keys = [text.get_text() for text in figure.legends[0].get_texts()]
        names = [f"field {angle:.4g}°" for angle in np.degrees(fields)]
        assert keys == [*names, "0.6 um", "0.53 um (reference)", "0.48 um"]
        assert len(figure._repr_png_()) > 20_000
