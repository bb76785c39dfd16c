"""Tolerances of spots, the reference integral, and the experiment."""

import dataclasses
import functools
import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
from experiments._reference import reference

import drt_jax
from drt_jax import Scene, load_lens, psf_moments, pupil
from experiments import _command, accuracy

from ..conftest import RGB

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)


def spot_size(covariance):
    return np.sqrt(np.trace(np.asarray(covariance), axis1=1, axis2=2))


@functools.cache
def focused(name, distance, defocus=0.0):
    """The lens with its sensor `defocus` mm behind the best axial focus of the mean over the
    wavelengths."""
    lens = load_lens(name)
    spread = drt_jax.focus_moments(lens, Scene.point(0.0, distance, RGB), 1e-9).spread
    _, linear, square = np.sum(np.asarray(spread), axis=(1, 2))
    sensor = lens.sensor - linear / (2 * square) + defocus
    return dataclasses.replace(lens, sensor=jnp.asarray(sensor, lens.sensor.dtype))


def assert_kept(lens, field, distance, size, tolerances):
    """Asserts that every tolerance is kept: relative errors of the spot size for the worst
    wavelength."""
    for tolerance in tolerances:
        got = spot_size(psf_moments(lens, Scene.point(field, distance, RGB), tolerance).covariance)
        error = float(np.max(np.abs(got / size - 1)))
        assert error <= tolerance, f"{error:.1e} at a tolerance of {tolerance:g}"


@pytest.mark.slow
@pytest.mark.parametrize("distance", [25e3, math.inf])
@pytest.mark.parametrize(
    "degrees", [0.0, *(pytest.param(x, marks=pytest.mark.slow) for x in (5.0, 10.0, 14.0))]
)
@pytest.mark.parametrize(
    "name", ["double_gauss", pytest.param("cooke_triplet", marks=pytest.mark.slow)]
)
def test_spot_size_keeps_its_tolerance(name, degrees, distance):
    """In focus and 1 mm out of focus, compared with orders whose own error is rounding."""
    field = np.radians(degrees)
    for defocus in (0.0, 1.0):
        lens = focused(name, distance, defocus)
        rules = (
            drt_jax.Gauss(order, "bilateral" if degrees else "rotational") for order in (17, 18)
        )
        size, again = (
            spot_size(
                psf_moments(lens, Scene.point(field, distance, RGB), sampling=rule).covariance
            )
            for rule in rules
        )
        np.testing.assert_allclose(size, again, rtol=2e-12)
        assert_kept(lens, field, distance, size, TOLERANCES)


def truth(lens, field, distance):
    found = reference(lens, field, distance, RGB)
    assert np.max(found.error) < 1e-11
    return found.sigma


@pytest.mark.slow
@pytest.mark.parametrize(("degrees", "distance"), [(0.0, 25e3), (14.0, math.inf)])
def test_spot_size_keeps_its_tolerance_against_snells_law(degrees, distance):
    lens, field = focused("double_gauss", distance), np.radians(degrees)
    assert_kept(lens, field, distance, truth(lens, field, distance), TOLERANCES)


@pytest.mark.parametrize(
    ("degrees", "distance", "front", "rear"),
    [
        pytest.param(0.0, 25e3, 12.0, 20.0, marks=pytest.mark.slow),
        pytest.param(10.0, 25e3, 16.0, 12.0, marks=pytest.mark.slow),
        pytest.param(14.0, math.inf, 20.0, 14.0, marks=pytest.mark.slow),
    ],
)
def test_vignetted_spot_size_keeps_its_tolerance(degrees, distance, front, rear):
    lens = focused("double_gauss", distance)
    semi = lens.semi_diameter.at[0].set(front).at[-2].set(rear)
    lens, field = dataclasses.replace(lens, semi_diameter=semi), np.radians(degrees)
    assert_kept(lens, field, distance, truth(lens, field, distance), TOLERANCES)


# A ring of 3 mm in front of a stop of 4 mm on the only surface; its focal length in glass is 60 mm.
CLIPPED = {
    "surfaces": [
        {"radius": "inf", "thickness": 20.0, "semi_diameter": 3.0},
        {"radius": 20.0, "index": 1.5, "semi_diameter": 4.0, "stop": True},
    ],
    "sensor": 78.0,
}


@pytest.mark.slow
def test_reference_of_a_clipped_beam():
    """On axis only the ring limits a parallel beam, so that it could be the stop. Off axis the two
    circles overlap; a sum over a million points of a grid gives the same result."""
    lens = load_lens(CLIPPED)
    alone = dataclasses.replace(lens, semi_diameter=jnp.array([np.inf, 3.0, np.inf]))
    clipped, round_ = (reference(a, 0.0, math.inf, [0.55]) for a in (lens, alone))
    np.testing.assert_allclose(clipped.sigma, round_.sigma, rtol=1e-12)
    assert np.all(clipped.error < 1e-12)

    tilted = reference(lens, 0.15, math.inf, [0.55])
    assert np.all(tilted.error < 1e-11) and np.all(tilted.gradient_error < 1e-6)
    points, _ = pupil.square_grid(400)
    rays = drt_jax.trace_rays(lens, Scene.point(0.15, math.inf, [0.55]), points)
    good = np.asarray(rays.status[0]) == drt_jax.Status.OK
    assert 0.3 < np.mean(good) < 0.6
    spot = np.asarray(rays.points[0, good, -1, :2])
    # The grid resolves the edge to a cell, 1/200 of the radius, and its errors at the edge cancel.
    np.testing.assert_allclose(np.sqrt(np.sum(np.var(spot, axis=0))), tilted.sigma[0], rtol=1e-3)
    np.testing.assert_allclose(np.mean(spot[:, 1]), tilted.centroid[0], atol=1e-3 * tilted.sigma[0])


@pytest.mark.slow
def test_reference_refuses_a_blocked_beam():
    lens = load_lens(CLIPPED)
    with pytest.raises(ValueError, match="no ray at 0.55 um reaches the sensor"):
        reference(lens, 0.8, math.inf, [0.55])


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("accuracy")
    path = folder / "one_surface.yaml"
    path.write_text(
        "{surfaces: [{radius: 20.0, index: 1.5, semi_diameter: 4.0, stop: true}], sensor: 60.0}"
    )
    scenes = f"scenes=[{{lens: {path}, field_deg: 3, distance_m: .inf, defocus_mm: 0.5}}]"
    _command.main(
        accuracy,
        [
            "--out",
            str(folder / "run"),
            "--set",
            scenes,
            "orders=[2, 8]",
            "rays=[256]",
            "tolerances=[1e-3, 1e-6]",
            "seeds=2",
        ],
    )
    return folder / "run"


@pytest.mark.slow
def test_small_run_of_the_experiment(small_run):
    results = json.loads((small_run / "results.json").read_text())
    rows = results["curves"]
    assert [row["method"] for row in rows] == ["quadrature"] * 2 + [
        "random",
        "square grid",
        "hexapolar",
        "Sobol",
    ]
    known = {"scene", "method", "dtype", "rays", "relative_error", "gradient_error", "seconds"}
    assert all(known <= set(row) and row["seconds"] > 0 for row in rows)
    assert len({row["scene"] for row in rows}) == 1 and rows[0]["rays"] == 6
    # Values and gradients of the library converge to those of the sequential trace ...
    assert rows[1]["relative_error"] < 1e-12 and rows[1]["gradient_error"] < 1e-8
    assert rows[1]["centroid_error"] < 1e-12 and rows[1]["centroid_gradient_error"] < 1e-8
    # ... and 6 rays of a rule have a smaller error than 256 of any pattern.
    assert rows[0]["relative_error"] < min(row["relative_error"] for row in rows[2:])
    for promise in results["tolerances"]:
        assert promise["relative_error"] <= promise["tolerance"]
    assert results["truth"][0]["reference_error"] < 1e-12
    for name in ("time_error", "rays_error", "gradient_error"):
        assert (small_run / "figures" / f"{name}.png").stat().st_size > 10_000


@pytest.mark.slow
def test_finished_run_resumes_to_the_same_numbers(small_run, capsys):
    before = json.loads((small_run / "results.json").read_text())
    _command.main(accuracy, ["--resume", "--out", str(small_run)])
    after = json.loads((small_run / "results.json").read_text())
    assert before["curves"] == after["curves"] and before["tolerances"] == after["tolerances"]
    assert "most rays" in capsys.readouterr().out
