"""Tools of the experiments on speed. `test_starts` runs the experiments."""

import dataclasses
from functools import partial

import jax
import numpy as np
import pytest
from experiments._reference import changed, reference
from experiments.snell import trace_snell
from scipy import integrate, special

import drt_jax
from drt_jax import Scene
from experiments import (
    _common,
    _curves,
    _peers,
    _profile,
    _wave_reference as wave,
    _waves,
    _work,
    benchmark,
)
from experiments.runs.config import ConfigError
from experiments.runs.machine import machine


def test_quartiles_are_of_all_turns():
    low, middle, high = _common.quartiles([lambda: None], 2)[0]
    assert 0 < low <= middle <= high


def rows(*points):
    return [{"error": error, "quartiles_s": [0, seconds, 9]} for error, seconds in points]


def test_where_a_program_is_faster_is_named():
    own = rows((1e-2, 2.0), (1e-6, 3.0))
    assert _curves.faster(rows((1e-1, 2.5), (1e-3, 4.0)), own) == "never"
    assert _curves.faster(rows((1e-1, 1.0), (1e-2, 9.0)), own) == "1e-01"
    assert _curves.faster(rows((1e-1, 1.0), (1e-4, 2.5), (1e-9, 8.0)), own) == "1e-01, 1e-04, 1e-09"
    assert _curves.faster(rows((1e-1, 1.0), (1e-4, 1.0)), own) == "1e-01 to 1e-04"
    assert _curves.least(own, 1e-4) == 3.0 and _curves.least(own, 1e-9) == np.inf
    some = [{"task": "sigma", "program": "drt_jax"} | row for row in own]
    some += [{"task": "sigma", "program": "other"} | row for row in rows((1e-3, 1.0))]
    assert "| sigma | other   | 1e-03 " in _curves.summary(some)


def test_times_of_two_machines_are_in_no_table():
    one = machine()
    assert one["cpu"] in _common.one_machine({"machines": [one, one | {"load": 9.0}]})
    for other in ({"cpu": "another"}, {"cores": 512}, {"device": "gpu"}):
        with pytest.raises(ConfigError, match="times of two machines are never in one table"):
            _common.one_machine({"machines": [one, one | other]})


def tried(*errors):
    return iter([(lambda: None, error) for error in errors])


def test_a_sweep_ends_where_it_is_exact_or_more_rays_do_not_help():
    assert [error for _, error in _profile.sweep(tried(1e-2, 1e-4, 1e-10, 1e-3))] == [
        *(1e-2, 1e-4, 1e-10)
    ]
    assert len([*_profile.sweep(tried(1e-2, 9e-3, 1e-4))]) == 2
    assert len([*_profile.sweep(tried(np.nan, 1e-4))]) == 1


def test_an_attempt_has_calls_by_tolerance_or_a_reason():
    def fails(*errors):
        yield from tried(*errors)
        raise AttributeError("no such surface\nand more")

    calls, row = _profile.attempt([tried(1e-2, 1e-4, 1e-7), tried(1e-7)])
    assert [len(some) for some in calls] == [2, 2, 0]
    assert row["error"] == 1e-7 and row["why"] == ""
    calls, row = _profile.attempt([fails()])
    assert not any(calls) and row["why"] == "AttributeError: no such surface"
    calls, row = _profile.attempt([fails(1e-4)])  # the results before the failure count
    assert [len(some) for some in calls] == [1, 0, 0] and row["why"] == ""
    assert _profile.attempt([tried(np.nan)])[1]["why"] == "the spot is not finite"
    assert _profile.attempt([tried(1e-2)])[1]["why"] == "no sampling comes to 1e-03"


def test_a_profile_counts_scenes_and_compares_with_the_fastest():
    """Two scenes; the reference of the second is not accurate to nine digits."""

    def row(program, field, error, *seconds):
        times = [None if s is None else [s, s, s] for s in seconds]
        why = "" if seconds[0] else "failed"
        known = {"program": program, "field_deg": field, "reference_error": error, "first_s": 2.0}
        return known | {"quartiles_s": times, "why": why}

    rows = [row("a", 0, 1e-13, 1.0, 2.0, None), row("b", 0, 1e-13, 3.0, None, None)]
    rows += [row("a", 1, 1e-8, 2.0, 2.0, 2.0), row("b", 1, 1e-8, None, None, None)]
    assert {name: own.tolist() for name, own in _profile.ratios(rows, 0).items()} == {
        "a": [1.0, 1.0],
        "b": [3.0, np.inf],
    }
    assert _profile.ratios(rows, 2)["a"].tolist() == [np.inf]
    cells = [cell.strip() for cell in _profile.summary(rows).splitlines()[-1].split("|")]
    assert cells[1:-1] == ["b", "1 of 2", "3", "0 of 2", "", "0 of 1", "", "2.0 s"]
    counted = _profile.reasons(rows).splitlines()[-1]
    assert [cell.strip() for cell in counted.split("|")][1:-1] == ["b", "failed", "1"]


def test_files_of_a_profile_are_those_of_the_folder_and_none_is_needed(tmp_path):
    assert _profile.jobs(_profile.Profile(files=str(tmp_path / "none"))) == {}
    drt_jax.save_lens(drt_jax.load_lens("singlet"), tmp_path / "singlet.zmx")
    (tmp_path / "bad.zmx").write_text("SURF 0\n")
    sizes = _profile.Profile(files=str(tmp_path))
    work = _profile.jobs(sizes)
    assert list(work) == ["bad.zmx", "singlet.zmx"]
    found = work["bad.zmx"]()
    assert not found["profile"] and found["left_out"][0]["why"]
    at, *_ = _profile.from_file(tmp_path / "singlet.zmx", (0.0, 1.0))
    assert at.field == 0 and at.distance == np.inf


@pytest.mark.slow
def test_our_nodes_through_another_tracer_come_to_the_reference(monkeypatch):
    """Rays that we aim, traced by Snell's law: weights, symmetry and launch agree. Central
    differences of changed lenses, for each of which rays are aimed again, are derivatives at fixed
    stop points."""
    lens, field = drt_jax.load_lens("cooke_triplet"), np.radians(14)
    given = lens, field, np.inf, (0.55,)
    values = _peers.shifted(lens)

    @jax.jit
    def traced(values, places, along):
        trace = jax.vmap(trace_snell, (None, None, 0, 0))
        return trace(changed(lens, values), 0.55, places, along)

    def value(rays, k):
        hits, ok = traced(values[k], *map(jax.numpy.asarray, rays.starts(k, 0)))
        assert np.all(ok)
        x, y = np.asarray(hits[:, -1, :2]).T
        return np.array([_peers._sigma(x, y, rays.weights, rays.free)])

    def snell(numbers, rays, count=1):
        return lambda k=0: value(rays, k)

    def slopes(numbers, rays):
        return _peers.differences(partial(value, rays), lens.count)

    monkeypatch.setattr(_work, "version", lambda name: "1")
    monkeypatch.setattr(_peers, "SPOTS", {"snell": _peers.Spots(snell, slopes)})
    scene, truth = Scene.point(field, np.inf, (0.55,)), reference(*given)
    curved = dataclasses.replace(lens, curved=(lens.stop,))
    every = _curves.samplings(curved, scene, (), (3, 8), values := _peers.shifted(curved))
    nodes = [(name, of) for name, of in every if "our" in name]
    numbers = _peers.Lens(*given)
    error = partial(benchmark.spot_error, truth, lens.count)
    ways = _curves.of_spots(numbers, nodes, lambda spots, *given: spots.sigma(*given))
    tries, notes = _curves.tried(ways, error)
    assert not notes
    coarse, fine = tries
    assert fine.program == "snell 1, launched by us" and fine.size == 8 * 9
    assert fine.error < 1e-11 < coarse.error < 1e-2
    ways = _curves.of_spots(numbers, nodes[1:], lambda spots, *own: spots.gradient(*own))
    (moved,), _ = _curves.tried(ways, lambda found: error(*found))
    assert 1e-11 < moved.error < 1e-5

    # All variants, as in a tolerance analysis.
    some = [reference(changed(lens, row), *given[1:], slopes=False) for row in values[:3]]

    def worst(found):
        return max(abs(s[0] / t.sigma[0] - 1) for s, t in zip(found, some))

    (many,), _ = _curves.tried(_curves.of_spots(numbers, nodes[1:], _peers.of_all), worst)
    assert many.error < 1e-11


FREQUENCIES = np.array([20.0, 60.0, 150.0])


@pytest.mark.slow
def test_the_reference_of_waves_is_the_closed_form_of_a_perfect_lens():
    """For a paraboloid of f/10 on its axis: contrast of its pupil, and nearly the Airy pattern."""
    stop = {"radius": np.inf, "thickness": 60, "glass": "air", "semi_diameter": 5, "stop": True}
    mirror = {"radius": -200, "conic": -1, "mirror": True, "semi_diameter": 6}
    lens = drt_jax.load_lens({"surfaces": [stop, mirror], "sensor": -40})
    wavelength = 0.5
    found, change = wave.transfer(lens, 0.0, wavelength, FREQUENCIES)
    edge = np.sin(2 * np.arctan(2.5 / 100))  # a ray at height 2 f tan(u / 2) leaves at the angle u

    def size(x, y):  # light of evenly lit heights in d = sin u
        cosine = np.sqrt(1 - x**2 - y**2)
        return 1 / ((1 + cosine) / 2 * np.sqrt(cosine))

    def overlap(shift):
        half, both = shift / 2, lambda y, x: size(x - shift / 2, y) * size(x + shift / 2, y)
        rim = lambda x: np.sqrt(np.maximum(edge**2 - (abs(x) + half) ** 2, 0))  # noqa: E731
        return integrate.dblquad(both, 0, edge - half, 0, rim, epsabs=1e-10)[0]

    exact = [overlap(f * wavelength * 1e-3) / overlap(0) for f in FREQUENCIES]
    assert change < 1e-9
    np.testing.assert_allclose(found, [[exact, exact]] * 2, atol=1e-7)
    radii = 1e-3 * np.array([1e-3, 2.0, 6.1, 8.0])
    light, change = wave.image(lens, 0.0, wavelength, np.stack([0 * radii, radii], axis=1))
    v = np.pi * radii / (wavelength * 1e-3 * 10)
    airy = np.pi / 4 / (wavelength * 1e-3 * 10) ** 2 * (2 * special.j1(v) / v) ** 2
    assert change < 1e-9
    np.testing.assert_allclose(light, [airy] * 2, atol=3e-3 * airy[0])


@pytest.mark.slow
def test_the_reference_of_waves_agrees_with_the_library_off_axis():
    lens, field = drt_jax.load_lens("cooke_triplet"), np.radians(14)
    at = _waves.focused(lens, field, 0.55, _waves.Waves(size=9))
    scene = Scene.point(field, np.inf, (0.55,))
    mtf, change = wave.transfer(at.lens, field, 0.55, FREQUENCIES)
    own = drt_jax.transfer(at.lens, scene, FREQUENCIES, sampling=1e-4).mtf
    assert change < 1e-9
    np.testing.assert_allclose(own, mtf[0], atol=1e-4)  # light that fills the stop evenly
    assert 1e-4 < np.max(np.abs(own - mtf[1])) < 1e-2
