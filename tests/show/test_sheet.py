"""Pictures of analyses show what was computed."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.colors import to_rgb

import drt_jax
from drt_jax import Scene, show
from drt_jax.show import analyses
from drt_jax.show.figures import FIELD_COLOURS

WAVES = (0.6, 0.53, 0.48)
LENS = drt_jax.load_lens("cooke_triplet")
SCENE = np.array([0.0, 0.1, 0.2]), np.inf, WAVES


def test_colours_run_from_blue_to_red():
    assert analyses.colours((0.48, 0.6)) == ["#1f77b4", "#d62728"]
    assert analyses.colours(WAVES)[1] not in ("#1f77b4", "#d62728")
    assert len(analyses.colours([0.55])) == 1 and len(analyses.colours([0.5, 0.5])) == 2


def test_a_colour_is_a_field_or_a_wavelength():
    """Colours of fields are no mixture of those of wavelengths, blue to green to red."""
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
    """A spot without light, a fan whose ends are clipped."""
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


@pytest.mark.slow
def test_a_sheet_has_all_panels():
    """Also of the axis alone, and of a lens that passes no light at one of its fields."""
    for fields, count in (([0.0, 0.1, 0.2, 0.3], 16), ([0.0], 10)):
        said: list[str] = []
        figure = show.sheet(LENS, Scene.radians(fields, np.inf, WAVES), say=said.append)
        assert len(figure.axes) == count and said[-1] == "drawing"
        assert len(figure._repr_png_()) > 20_000
