"""Real glasses in place of model glasses, compared with thin lenses in closed form."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design, find_glass
from drt_jax.design import Operand, Solve, Tie, Variables, Vary
from drt_jax.lens.glasses import indices

WAVES = np.array([0.4861327, 0.5875618, 0.6562725])  # F, d, C
NAMES = ("N-BK7", "N-PSK53A", "N-FK51A", "F2", "N-KZFS4", "N-SF2", "N-KZFS11", "N-BAF4")
FOCAL, SEMI = 100.0, 0.25
DOUBLET = {
    "surfaces": [
        {"radius": 60, "thickness": 0.01, "nd": 1.52, "vd": 64, "semi_diameter": SEMI},
        {"radius": -45, "thickness": 0.01, "nd": 1.62, "vd": 36},
        {"radius": -150, "glass": "air"},
    ],
    "sensor": 100.0,
}
DOUBLET["surfaces"][0]["stop"] = True


def thin(crown, flint):
    """The thin doublet of the power 1 at d with the smallest spots: mean square radius of the spot
    for rays of the mean square height 1, and power of the crown. The power at a wavelength is p u +
    (1 - p) w. The focus is free, so that the spot depends on the variance over the wavelengths."""
    n = np.array([indices(find_glass(name), WAVES) for name in (crown, flint)])
    u, w = (n - 1) / (n[:, 1:2] - 1)
    u, w = u - u.mean(), w - w.mean()
    power = -np.dot(w, u - w) / np.dot(u - w, u - w)
    return np.mean((power * u + (1 - power) * w) ** 2), power


VARY = [
    Vary("curvature"),
    Vary("index", (0,), low=1.45, high=1.60),
    Vary("index", (1,), low=1.55, high=1.70),
    Vary("abbe", (0,), low=60, high=70),
    Vary("abbe", (1,), low=35, high=45),
    "sensor",
]


@functools.cache
def snapped():
    """The optimum of a slow doublet of model glasses, the lens with real glasses, and what this
    compiled."""
    lens = drt_jax.load_lens(DOUBLET)
    solves = [Solve("focal_length", FOCAL, surface=2, wavelengths=(WAVES[1],))]
    operands = [Operand("spot", weight=1e3), Operand("glass_map", high=0.0)]
    operands.append(Operand("total_track", high=200.0))
    problem = design.Problem.from_variables(
        Variables.from_lens(lens, VARY, solves=solves),
        operands,
        Scene.radians(0.0, wavelengths=WAVES),
        2,
    )
    found = design.optimise(problem, max_steps=60)
    accept = lambda glass: glass.name in NAMES  # noqa: E731
    return (
        problem,
        found,
        design.snap_glasses(problem, found, accept=accept, max_steps=60),
    )


@pytest.mark.slow
def test_no_other_glass_makes_a_thin_doublet_better():
    """Every alternative has the spot of the closed form, and no spot at the end is smaller than
    that of the chosen pair. The chromatic focal shift is that of the textbook, (P1 - P2) / (v1 -
    v2)."""
    best = snapped()[2]
    pair = best.lens.glasses[1:3]
    assert {*pair} <= {*NAMES} and pair[0] != pair[1]
    size = (1e3 * SEMI) ** 2 / 2
    np.testing.assert_allclose(best.optimum.merit, size * thin(*pair)[0], rtol=5e-3)
    for place, other in ((0, lambda name: (name, pair[1])), (1, lambda name: (pair[0], name))):
        ranked = best.alternatives[place]
        scores = np.array([score for _, score in ranked])
        wanted, powers = np.transpose([thin(*other(near.glass.name)) for near, _ in ranked])
        assert ranked[0][0].glass.name == pair[place] and len(ranked) == len(NAMES) - 1
        slim = np.abs(powers) < 10  # with nearly equal vd the elements are no longer thin
        assert np.sum(slim) >= len(NAMES) - 2
        np.testing.assert_allclose(scores[slim], size * wanted[slim], rtol=0.01)
        assert np.all(scores >= scores[0]) and np.all(wanted >= 0.99 * wanted[0])
    f, d, c = np.array([indices(find_glass(name), WAVES) for name in pair]).T
    v, partial = (d - 1) / (f - c), (f - d) / (f - c)
    foci = np.asarray(drt_jax.focal_length(best.lens, WAVES))
    c0, c1, _, _ = np.asarray(best.lens.curvature)
    power = FOCAL * (d[0] - 1) * (c0 - c1)  # of the crown
    shift = power * partial[0] / v[0] + (1 - power) * partial[1] / v[1]
    np.testing.assert_allclose((foci[1] - foci[0]) / FOCAL, shift, rtol=0.01)
    np.testing.assert_allclose(power, thin(*pair)[1], rtol=1e-3)
    # Where the foci of F and C coincide; the smallest spots are close to this.
    np.testing.assert_allclose(power, v[0] / (v[0] - v[1]), rtol=0.01)
    textbook = (partial[0] - partial[1]) / (v[0] - v[1])
    assert abs(textbook) < 1 / 4500 and abs(shift - textbook) < 1e-4, (pair, textbook, shift)


@pytest.mark.slow
def test_costs_are_told():
    """Each exchange starts where the one before it ended; each merit is that of the problem."""
    _, found, best = snapped()
    ends = [found.score, *(snap.after for snap in best.snaps)]
    assert [snap.before for snap in best.snaps] == ends[:-1]
    assert {best.snaps[0].surfaces, best.snaps[1].surfaces} == {(0,), (1,)}
    first = best.snaps[0]
    model = found.lens.dispersion.model[first.surfaces[0] + 1]
    np.testing.assert_allclose(first.model, model, rtol=1e-9)
    assert first.replaced.startswith("model ") and first.glass in NAMES
    exchanged = [snap for snap in best.snaps[2:]]
    assert all(snap.after < snap.before and snap.replaced in NAMES for snap in exchanged)
    np.testing.assert_allclose(
        best.problem.merit(best.optimum.vector), best.optimum.merit, rtol=1e-9
    )


@pytest.mark.slow
def test_real_glasses_keep_their_formula(tmp_path):
    """Their indices are right also far outside of F to C, where nd and vd do not determine the
    index; and in a file."""
    lens = snapped()[2].lens
    waves = np.array([0.4, 0.7, 1.0])
    wanted = [indices(find_glass(name), waves) for name in lens.glasses[1:3]]
    np.testing.assert_allclose(lens.index(waves)[1:3], wanted, rtol=1e-14)
    drt_jax.save_lens(lens, tmp_path / "own.yaml")
    assert drt_jax.load_lens(tmp_path / "own.yaml").glasses == lens.glasses
    assert "nd:" not in (tmp_path / "own.yaml").read_text()


@pytest.mark.slow
def test_limits_keep_their_names():
    """The limits of the glass map, which real glasses fulfil exactly, and the limits behind
    them."""
    best = snapped()[2]
    maps, length = best.optimum.limits[:2], best.optimum.limits[2]
    assert [(one.kind, one.where, one.value) for one in maps] == [
        ("glass_map", "surface 0", 0),
        ("glass_map", "surface 1", 0),
    ]
    assert length.kind == "total_track" and len(best.optimum.limits) == 3
    np.testing.assert_allclose(length.value, float(best.lens.sensor), rtol=1e-12)


@pytest.mark.slow
def test_a_snap_compiles_nothing(caplog):
    problem, found, _ = snapped()
    caplog.clear()
    jax.config.update("jax_log_compiles", True)  # in all threads
    try:
        accept = lambda glass: glass.name in NAMES[::-1]  # noqa: E731
        design.snap_glasses(problem, found, accept=accept, count=2, steps=2, max_steps=3)
    finally:
        jax.config.update("jax_log_compiles", False)
    compiled = [r.getMessage() for r in caplog.records if "ompil" in r.getMessage()]
    assert not compiled, compiled[:3]


@pytest.mark.slow
def test_what_cannot_snap_is_refused():
    problem, found, _ = snapped()
    for given, said in (
        ({"makers": ["NOBODY"]}, "unknown maker 'NOBODY'"),
        ({"accept": lambda glass: False}, "no glass fits behind surface 0"),
    ):
        with pytest.raises(ValueError, match=said):
            design.snap_glasses(problem, found, **given)
    lens = problem.variables.lens
    like = {name: find_glass("N-BK7") for name in lens.glasses[1:3]}
    model = design.ThermalModel.from_lens(lens, glasses=like)
    warm = problem.variables.at_temperature(40.0, model)
    with pytest.raises(ValueError, match="snap_glasses takes one at 20 C"):
        design.snap_glasses(dataclasses.replace(problem, variables=warm), found)
    for vary, ties, said in (
        (["index"], [Tie((0, 1), kind="index", scale=1.01)], "index 1 is tied with a scale"),
        (["curvature"], [], "has no model glass"),
    ):
        other = lens if ties else drt_jax.with_glass(lens, find_glass("F2"), (0,))
        if not ties:
            other = drt_jax.with_glass(other, find_glass("N-BK7"), (1,))
        one = design.Problem.from_variables(Variables.from_lens(other, vary, ties), ["length"])
        with pytest.raises(ValueError, match=said):
            design.snap_glasses(one, found)
    for glass, surfaces, said in (
        ("F2", (2,), "no glass begins behind surface 2"),
        ("F2", (), "F2 on both sides of surface 1"),
    ):
        with pytest.raises(ValueError, match=said):
            drt_jax.with_glass(lens, find_glass(glass), surfaces)


LINES = (WAVES, np.array([0.6562725, 0.75, 0.8521101]))  # by day and by night


def thin_by_day_and_night(crown, flint):
    """`thin` for a doublet that is focused at three wavelengths for the day and at three for the
    night."""
    pairs = []
    for lines in LINES:
        n = np.array([indices(find_glass(name), lines) for name in (crown, flint)])
        d = np.array([indices(find_glass(name), WAVES[1:2]) for name in (crown, flint)])
        u, w = (n - 1) / (d - 1)
        pairs.append((u - u.mean(), w - w.mean()))
    u, w = np.concatenate(pairs, axis=1)
    power = -np.dot(w, u - w) / np.dot(u - w, u - w)
    return np.sum((power * u + (1 - power) * w) ** 2) / 3


@pytest.mark.slow
def test_one_pair_of_glasses_serves_all_configurations():
    """A slow doublet for day and night, refocused: each exchange agrees with thin lenses."""
    lens, problems = drt_jax.load_lens(DOUBLET), []
    focal = Operand("effective_focal_length", low=FOCAL - 1e-3, high=FOCAL + 1e-3)
    for lines in LINES:
        scene = Scene.radians(0.0, wavelengths=lines)
        own = Variables.from_lens(lens, VARY)
        own_operands = [Operand("spot", weight=1e3), *([focal] if lines is WAVES else [])]
        problems.append(design.Problem.from_variables(own, own_operands, scene, 2))
    both = design.Configurations.from_problems(problems, ["sensor"])
    found = design.optimise(both, max_steps=60)
    accept = lambda glass: glass.name in NAMES  # noqa: E731
    best = design.snap_glasses(both, found, accept=accept, max_steps=60)
    pair = best.lens.glasses[1:3]
    assert {*pair} <= {*NAMES}
    day, night = best.lenses
    assert day.glasses == night.glasses and float(day.sensor) != float(night.sensor)
    for lens in best.lenses:
        np.testing.assert_allclose(lens.index(LINES[1])[1], indices(find_glass(pair[0]), LINES[1]))
    size = (1e3 * SEMI) ** 2 / 2
    np.testing.assert_allclose(best.optimum.merit, size * thin_by_day_and_night(*pair), rtol=0.02)
    np.testing.assert_allclose(best.problem.merit(best.optimum.vector), best.optimum.merit)
    for name in NAMES:  # no exchange of a single glass is better
        for other in ((name, pair[1]), (pair[0], name)):
            if other[0] != other[1]:
                assert thin_by_day_and_night(*other) > 0.98 * thin_by_day_and_night(*pair)


def test_glasses_of_configurations_are_shared():
    """Two lengths of one lens, without rays: a glass is set in both. Model glasses that are
    separate for the configurations are refused."""
    rows = [{"radius": "inf", "thickness": 1.0, "nd": 1.52, "vd": 64.0, "stop": True}]
    rows[0]["semi_diameter"] = 1.0
    lens = drt_jax.load_lens({"surfaces": [*rows, {"radius": "inf"}], "sensor": 9.0})
    problems = [
        design.Problem.from_variables(
            Variables.from_lens(lens, ["index", "abbe", "sensor"]),
            [Operand("total_track", target=length)],
        )
        for length in (9.5, 10.5)
    ]
    both = design.Configurations.from_problems(problems, ["sensor"])
    found = design.optimise(both, max_steps=10)
    best = design.snap_glasses(both, found, count=2, steps=2, max_steps=5)
    assert best.lenses[0].glasses[1] == best.lenses[1].glasses[1] == best.snaps[0].glass
    np.testing.assert_allclose([lens.sensor for lens in best.lenses], [9.5, 10.5], atol=1e-6)
    apart = design.Configurations.from_problems(problems, ["sensor", "index"])
    with pytest.raises(ValueError, match="index 0 of configuration 1, .*; one glass serves all"):
        design.snap_glasses(apart, found)


def test_tied_glasses_are_one():
    """Crown, flint, crown: nd and vd of the crowns are tied, and the crowns get the same glass."""
    rows = [
        {"radius": np.inf, "thickness": 1.0, "nd": nd, "vd": vd}
        for nd, vd in ((1.52, 64), (1.62, 36), (1.52, 64))
    ]
    lens = drt_jax.load_lens(
        {"surfaces": [*rows, {"radius": np.inf, "stop": True, "semi_diameter": 1.0}], "sensor": 9.0}
    )
    ties = [Tie((0, 2), kind=kind) for kind in ("index", "abbe")]
    variables = Variables.from_lens(lens, ["index", "abbe", "sensor"], ties)
    # No rays: the operand is the length, at its target; all glasses have the same merit.
    problem = design.Problem.from_variables(variables, [Operand("total_track", target=9.5)])
    found = design.optimise(problem, max_steps=5)
    best = design.snap_glasses(problem, found, count=2, steps=2, max_steps=3)
    assert best.lens.glasses[1] == best.lens.glasses[3] != best.lens.glasses[2]
    assert {snap.surfaces for snap in best.snaps} == {(0, 2), (1,)}


def test_glasses_that_are_sold_today():
    """SF6G05 is radiation resistant, N-LASF31 was replaced by N-LASF31A, N-SF6HT has the constants
    of N-SF6, LAK9G15 and N-LAF3 are made on inquiry; PMMA is not a glass, IRG24 is opaque to
    visible light."""
    ordinary = ("N-BK7", "N-SF6", "SF6", "F2", "N-LASF31A", "N-PK51", "S-FPL51", "H-K9L", "FCD1")
    others = ("SF6G05", "N-LASF31", "N-SF6HT", "N-SF57HTultra", "FK5HTi", "LAK9G15", "N-LAF3")
    others += ("BK7_SCHOTT", "PMMA", "IRG24", "SF15", "BSM16")
    assert [name for name in ordinary if not design.ordinary_glass(find_glass(name))] == []
    assert [name for name in others if design.ordinary_glass(find_glass(name))] == []
