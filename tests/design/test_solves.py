"""Solves hold exactly in every lens, and raise errors where they cannot hold."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, load_lens
from drt_jax.design import Solve, Variables, Vary

COLOURS = (0.48, 0.55, 0.65)
# Relative.
EXACT = 1e-12


@functools.partial(jax.jit, static_argnums=1)
def held(lens, solve):
    """The quantities that a solve keeps, by other functions of the package."""
    first = drt_jax.first_order(lens, solve.distance, np.array(solve.wavelengths))
    slope = -1 / (2 * first.f_number)
    kinds = {
        "focal_length": 1 / jnp.mean(1 / first.focal_length),
        "effective_focal_length": 1 / jnp.mean(1 / first.effective_focal_length),
        "image_angle": jnp.mean(slope),
        "entrance_pupil": 2 * jnp.mean(first.entrance_pupil.semi_diameter),
        "f_number": 1 / jnp.mean(1 / first.f_number),
        "paraxial_focus": jnp.mean(first.image_distance),
    }
    return kinds[solve.kind]


def random_lenses(variables, count=4, size=0.5):
    rng = np.random.default_rng(1)
    moves = size * rng.normal(size=(count, len(variables.places)))
    return [variables.start + move for move in moves]


CASES = [
    Solve("focal_length", 48.0, 5),
    Solve("focal_length", surface=0),
    Solve("focal_length", surface=2, wavelengths=COLOURS),
    Solve("effective_focal_length", 48.0, 5),
    Solve("image_angle", surface=5),
    Solve("image_angle", -0.11, 5, distance=500.0),
    Solve("entrance_pupil"),
    Solve("entrance_pupil", 9.0),
    Solve("f_number", 4.0),
    Solve("f_number", distance=400.0, wavelengths=COLOURS),
    Solve("paraxial_focus"),
    Solve("paraxial_focus", distance=500.0, wavelengths=COLOURS),
]


@pytest.mark.parametrize("solve", CASES, ids=lambda s: f"{s.kind}-{s.value:g}-{s.surface}")
def test_conditions_hold_whatever_varies(solve):
    """To 1e-12, at the start and for random vectors; checked by `first_order`."""
    variables = Variables.from_lens(
        load_lens("cooke_triplet"), ["curvature", "thickness"], solves=[solve]
    )
    kept = variables.solves[0]
    lens_of = jax.jit(variables.lens_of)
    if not solve.focuses:
        start = held(load_lens("cooke_triplet"), solve)
        assert abs(kept.value / (solve.value or start) - 1) < EXACT
    for vector in (variables.start, *random_lenses(variables)):
        lens = lens_of(vector)
        wanted = lens.sensor if solve.focuses else kept.value
        assert abs(held(lens, solve) / wanted - 1) < EXACT
        # All variables are what the vector says.
        np.testing.assert_allclose(variables.vector(lens), vector, rtol=1e-13, atol=1e-13)


@pytest.mark.slow
def test_a_focal_length_in_air_is_kept_in_front_of_water():
    rows = [{"radius": 30, "glass": "N-BK7", "thickness": 6.0, "semi_diameter": 8.0, "stop": True}]
    lens = load_lens({"surfaces": [*rows, {"radius": -40, "glass": "water", "thickness": 70.0}]})
    water = float(lens.index(0.5875618)[-1, 0])
    for kind, power in (("focal_length", water / 90), ("effective_focal_length", 1 / 90)):
        kept = Variables.from_lens(lens, ["thickness"], solves=[Solve(kind, 90.0, 1)]).lens
        found = drt_jax.first_order(kept, jnp.inf, 0.5875618).effective_focal_length[0]
        assert abs(found * power - 1) < EXACT


@pytest.mark.slow
def test_all_together_in_any_order():
    """They are given in the order in which each would disturb the one before."""
    solves = [
        Solve("best_focus", 0.0, fields=(0.0, 0.2), wavelengths=COLOURS),
        Solve("f_number", 4.5),
        Solve("focal_length", 52.0, 5),
    ]
    variables = Variables.from_lens(
        load_lens("cooke_triplet"), ["curvature", "thickness"], solves=solves
    )
    assert [s.kind for s in variables.solves] == ["focal_length", "f_number", "best_focus"]
    lens_of = jax.jit(variables.lens_of)
    for vector in random_lenses(variables, size=0.2):
        lens = lens_of(vector)
        assert abs(held(lens, solves[2]) / 52 - 1) < EXACT
        assert abs(held(lens, solves[1]) / 4.5 - 1) < EXACT
        assert best(lens, solves[0]) < EXACT


@functools.partial(jax.jit, static_argnums=1)
def best(lens, solve):
    """Relative distance of the sensor from the best focus, by moments that do not use a solve."""
    total = jnp.zeros(3)
    for field in solve.fields:
        symmetry = "rotational" if field == 0 else "bilateral"
        found = drt_jax.focus_moments(
            lens,
            Scene.point(field, solve.distance, solve.wavelengths),
            sampling=drt_jax.Gauss(6, symmetry),
        )
        total += jnp.mean(jnp.sum(found.spread[..., :2], axis=-1), axis=-1)
    return abs(total[1] / total[2] / 2 / lens.sensor)


@pytest.mark.slow
def test_best_focus_is_best():
    """At other positions the spots are larger, by the amount of the parabola; with `value` the
    sensor is at this distance from the focus."""
    lens = load_lens("cooke_triplet")
    solve = Solve("best_focus", fields=(0.0, 0.25), wavelengths=COLOURS)
    sensor = [
        float(Variables.from_lens(lens, ["thickness"], solves=[s]).lens.sensor)
        for s in (solve, dataclasses.replace(solve, value=0.1))
    ]
    assert abs(sensor[1] - sensor[0] - 0.1) < 1e-12
    spots = []
    for shift in (-0.05, 0, 0.05):
        moved = dataclasses.replace(lens, sensor=jnp.asarray(sensor[0] + shift))
        traces = [
            drt_jax.psf_moments(
                moved, Scene.point(f, np.inf, COLOURS), sampling=drt_jax.Gauss(6, "bilateral")
            ).covariance
            for f in solve.fields
        ]
        spots.append(np.mean(np.trace(np.stack(traces), axis1=-2, axis2=-1)))
    assert spots[0] > spots[1] < spots[2] and abs(spots[0] / spots[2] - 1) < 1e-9


@pytest.mark.slow
def test_solved_numbers_have_derivatives():
    """In forward and reverse mode, compared with central differences; the derivative of the
    condition itself is 0."""
    solves = [Solve("focal_length", surface=5), Solve("f_number"), Solve("best_focus")]
    variables = Variables.from_lens(
        load_lens("cooke_triplet"), ["curvature", "thickness"], solves=solves
    )

    def follows(vector):
        lens = variables.lens_of(vector)
        kept = drt_jax.focal_length(lens, 0.5875618)[0]
        return jnp.stack([lens.curvature[5], lens.semi_diameter[3], lens.sensor, kept])

    x = variables.start
    value = jax.jit(follows)
    forward, reverse = (jax.jit(j(follows))(x) for j in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward[3], 0, atol=1e-10)
    off = np.inf
    for h in (1e-2, 1e-3, 1e-4):
        columns = [(value(x + h * e) - value(x - h * e)) / (2 * h) for e in np.eye(len(x))]
        off = np.minimum(off, np.abs(np.stack(columns, axis=1) - forward))
    assert np.all(off < 1e-7 * np.max(np.abs(forward[:3]), axis=1).max())


def test_a_mirror_keeps_its_focus():
    lens = load_lens("ritchey_chretien")
    solves = [Solve("focal_length", surface=lens.active[-1]), Solve("paraxial_focus")]
    variables = Variables.from_lens(lens, ["curvature", "thickness"], solves=solves)
    for vector in random_lenses(variables, size=0.01):
        found = drt_jax.first_order(variables.lens_of(vector), np.inf, 0.5875618)
        assert abs(found.focal_length[0] / variables.solves[0].value - 1) < EXACT
        assert abs(found.image_distance[0] / variables.lens_of(vector).sensor - 1) < 1e-11


@pytest.mark.slow
def test_the_patent_lens_keeps_its_data(shared):
    solves = [Solve("focal_length", 49.565, 11), Solve("f_number", 1.84), Solve("paraxial_focus")]
    lens = load_lens(shared / "patent_rf50.yaml")
    variables = Variables.from_lens(lens, ["curvature", "index", "thickness"], solves=solves)
    for vector in random_lenses(variables, size=0.2):
        found = drt_jax.first_order(variables.lens_of(vector), np.inf, 0.5875618)
        assert abs(found.focal_length[0] / 49.565 - 1) < EXACT
        assert abs(found.f_number[0] / 1.84 - 1) < EXACT


BAD = [
    ([Solve("focal_length", 50)], "solves: focal_length: its curvature follows: give surface, one"),
    ([Solve("focal_length", 50, 9)], "give surface, one of 0, 1, 2, 3, 4, 5"),
    ([Solve("image_angle", -0.1, 1)], "surface 1 lies before the stop, which is number 3"),
    (
        [Solve("paraxial_focus"), Solve("best_focus")],
        "solves: sensor is what two of them change; leave one out",
    ),
    (
        [Solve("f_number"), Solve("entrance_pupil")],
        "solves: semi_diameter 3 is what two of them change",
    ),
    (
        [Solve("focal_length", surface=5), Solve("image_angle", surface=4)],
        "solves: focal_length and image_angle: the second changes what the first keeps",
    ),
    (
        [Solve("f_number", 4.0), Solve("image_angle", surface=5)],
        "solves: f_number and image_angle: the second changes what the first keeps",
    ),
]


@pytest.mark.parametrize("solves, said", BAD)
def test_what_cannot_hold_is_told_in_one_line(solves, said):
    with pytest.raises(ValueError) as told:
        Variables.from_lens(load_lens("cooke_triplet"), ["curvature", "thickness"], solves=solves)
    assert said in str(told.value) and "\n" not in str(told.value)


def test_more_solves_than_variables():
    solves = [Solve("focal_length", surface=5), Solve("paraxial_focus")]
    with pytest.raises(ValueError, match="solves: 2 of them, but 1 variables; leave some out"):
        Variables.from_lens(load_lens("cooke_triplet"), [Vary("curvature", (0,))], solves=solves)
    with pytest.raises(ValueError, match="variables: sensor follows|variables: none is left"):
        Variables.from_lens(load_lens("cooke_triplet"), [Vary("sensor", (0,))], solves=solves[1:])


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: Solve("focus"), "solves: kind: expected one of focal_length"),
        (lambda: Solve("f_number", np.inf), "solves: f_number: value: must be finite"),
        (lambda: Solve("entrance_pupil", -2), "entrance_pupil: value: must be above 0"),
        (lambda: Solve("best_focus", fields=()), "solves: best_focus: fields: none"),
    ],
)
def test_bad_words_and_numbers(make, said):
    with pytest.raises(ValueError) as told:
        make()
    assert said in str(told.value)


@pytest.mark.slow
def test_a_lens_without_focus(tmp_path):
    path = tmp_path / "plate.yaml"
    path.write_text(
        "surfaces:\n"
        "  - {radius: inf, thickness: 4, glass: N-BK7, semi_diameter: 5, stop: true}\n"
        "  - {radius: inf, thickness: 50}\n"
    )
    plate = load_lens(path)
    for solve, said in (
        (Solve("paraxial_focus"), "solves: paraxial_focus: there is no focus"),
        (Solve("best_focus"), "solves: best_focus: there is no focus"),
        (Solve("focal_length", surface=1), "focal_length: the lens has no such value to keep"),
    ):
        with pytest.raises(ValueError, match=said):
            Variables.from_lens(plate, ["thickness", Vary("curvature", (0,))], solves=[solve])
    made = Variables.from_lens(plate, ["thickness"], solves=[Solve("focal_length", 80.0, 1)])
    assert abs(drt_jax.focal_length(made.lens, 0.5875618)[0] / 80 - 1) < EXACT


def test_a_curvature_where_the_beam_is_in_focus_keeps_nothing(tmp_path):
    path = tmp_path / "relay.yaml"
    path.write_text(
        "surfaces:\n"
        "  - {radius: 51.8, thickness: 100, index: 1.518, semi_diameter: 5, stop: true}\n"
        "  - {radius: inf, thickness: 10}\n"
    )
    lens = load_lens(path)
    focused = 51.8 / 0.518 * 1.518
    lens = dataclasses.replace(lens, thickness=jnp.array([focused]), sensor=jnp.array(focused + 10))
    with pytest.raises(ValueError, match="is the beam in focus there"):
        Variables.from_lens(lens, ["thickness"], solves=[Solve("focal_length", 70.0, 1)])
