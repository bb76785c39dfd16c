"""Configurations below each other: one scale, one set of rims, their numbers in a table."""

import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, show
from drt_jax.__main__ import main

from ..experiments.test_zoom import TOY


@pytest.fixture(scope="module")
def systems(tmp_path_factory):
    path = tmp_path_factory.mktemp("zoom") / "toy.zmx"
    path.write_text(TOY)
    return path, [drt_jax.load_system(path, configuration=k) for k in (1, 2)]


def outline(ax, k):
    """The outline of element k on axes."""
    return ax.patches[k].get_xy()


@pytest.mark.slow
def test_configurations_have_one_scale_and_their_sensors_in_line(systems):
    lenses, scenes = ([getattr(s, name) for s in systems[1]] for name in ("lens", "scene"))
    figure, axes = show.new(2)
    one, two = show.configurations(axes, lenses, scenes)
    figure.canvas.draw()
    for a, b in ((one.get_xlim(), two.get_xlim()), (one.get_ylim(), two.get_ylim())):
        np.testing.assert_allclose(a, b)
    np.testing.assert_allclose(one.bbox.size, two.bbox.size, atol=0.5)
    for ax, lens in ((one, lenses[0]), (two, lenses[1])):
        z = np.asarray(lens.vertices)
        assert np.max(outline(ax, 1)[:, 0]) == pytest.approx(z[3] - z[-1], abs=1e-9)
        front, back = (outline(ax, k) for k in (0, 1))
        middle = [line[np.abs(line[:, 1]) < 1e-9, 0].min() for line in (front, back)]
        np.testing.assert_allclose(np.diff(middle), z[2] - z[0], atol=1e-9)
    for k in (0, 1):  # the same glass is as wide in both
        rims = [np.max(outline(ax, k)[:, 1]) for ax in (one, two)]
        assert rims[0] == pytest.approx(rims[1], rel=1e-12)
    low, high = one.get_ylim()
    drawn = np.concatenate([line.get_ydata() for ax in axes for line in ax.lines])
    assert np.max(outline(one, 0)[:, 1]) > 2 and low < np.min(drawn) and np.max(drawn) < high


@pytest.mark.slow
def test_the_upper_half_is_drawn_alone():
    lens = drt_jax.load_lens("cooke_triplet")
    _, ax = show.new()
    show.lens_drawing(ax, show.draw(lens, Scene.degrees([0, 10])), half=True)
    low, high = ax.get_ylim()
    assert low == 0 and high > 5
    bar = ax.lines[-1]
    assert np.all(bar.get_ydata() > 0) and "0" in ax.texts[-1].get_text()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["png", "html"])
def test_all_configurations_of_a_file_are_shown(systems, kind, tmp_path, capsys):
    path, found = systems
    words = ["show", str(path), "--configuration", "all", "--out", str(tmp_path / f"a.{kind}")]
    main([*words, *(["--html"] if kind == "html" else [])])
    title, *lines = capsys.readouterr().out.splitlines()
    assert title.endswith("2 configurations") and (tmp_path / f"a.{kind}").stat().st_size > 1e4
    if kind == "html":
        text = (tmp_path / "a.html").read_text()
        assert "<th>focal length</th>" in text and "RMS spots" in text
    for line, system in zip(lines[2:4], found):
        number, focal, speed, distance, size, track, *spots = line.split()
        first = drt_jax.first_order(system.lens, np.inf, 0.55)
        assert number == str(system.configuration) and (distance, size) == ("inf", "0")
        assert float(focal) == pytest.approx(float(first.effective_focal_length[0]), rel=1e-5)
        assert float(speed) == pytest.approx(float(first.f_number[0]), rel=1e-3)
        assert float(track) == pytest.approx(float(system.lens.sensor), rel=1e-5)
        for field, spot in zip(system.scene.each(), spots[1::2], strict=True):
            moments = drt_jax.psf_moments(system.lens, field)
            wanted = 1e3 * jnp.sqrt(jnp.trace(moments.covariance[0]))
            assert float(spot.rstrip(",")) == pytest.approx(float(wanted), rel=0.01)


@pytest.mark.parametrize(
    "words, message",
    [
        (["cooke_triplet", "--configuration", "all"], "cooke_triplet has one; expected a .zmx"),
        (["cooke_triplet", "--configuration", "both"], "invalid configuration value: 'both'"),
    ],
)
def test_what_is_no_configuration_is_refused(words, message, capsys):
    with pytest.raises(SystemExit):
        main(["show", *words])
    assert message in capsys.readouterr().err
