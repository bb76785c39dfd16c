"""Variables of a lens: named, bounded, tied; from vector to lens and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import Scene, load_lens
from drt_jax.design import Operand, Problem, Solve, Tie, Variables, Vary
from drt_jax.design.parts import PARTS
from drt_jax.lens.surface import surface_sag

MODEL = """
surfaces:
  - {radius: 20.0, thickness: 3.0, nd: 1.62, vd: 60.0, semi_diameter: 6.0}
  - {radius: -400.0, thickness: 5.0}
  - {radius: -21.0, thickness: 1.0, nd: 1.62, vd: 36.0, conic: 0.1,
     coefficients: {4: 1.0e-5, 6: 2.0e-8}}
  - {radius: 19.0, thickness: 2.5}
  - {radius: inf, thickness: 2.5, stop: true, semi_diameter: 4.0}
  - {radius: 75.0, thickness: 3.0, nd: 1.62, vd: 60.0, phase: {coefficients: {2: 0.0, 4: 0.1}}}
  - {radius: -17.0, thickness: 38.0}
"""
# The numbers that the name of each kind means: (rows, terms).
ALL = {
    "curvature": ([0, 1, 2, 3, 5, 6], [0]),
    "conic": ([0, 1, 2, 3, 5, 6], [0]),
    "coefficients": ([0, 1, 2, 3, 5, 6], [1, 2]),
    "thickness": ([0, 1, 2, 3, 4, 5], [0]),
    "sensor": ([0], [0]),
    "index": ([0, 2, 5], [0]),
    "abbe": ([0, 2, 5], [0]),
    "tilt": ([0, 1, 2, 3, 5, 6], [0, 1, 2]),
    "decentre": ([0, 1, 2, 3, 5, 6], [0, 1]),
    "semi_diameter": ([0, 4], [0]),
    "phase": ([5], [0, 1]),
}


@pytest.fixture
def lens(tmp_path):
    """Three lenses of model glasses, with one asphere and all but two apertures open."""
    path = tmp_path / "model.yaml"
    path.write_text(MODEL)
    return load_lens(path)


def changed(kind, lens, other):
    """Differences of the numbers of a kind; 0 for inf and inf."""
    after, before = (np.asarray(PARTS[kind].read(each)) for each in (lens, other))
    return np.where(after == before, 0, after) - np.where(after == before, 0, before)


def test_all_kinds_are_here():
    assert set(ALL) == set(PARTS)


@pytest.mark.parametrize("kind", ALL)
def test_a_word_is_all_of_a_kind(lens, kind):
    rows, terms = ALL[kind]
    places = Variables.from_lens(lens, [kind]).places
    assert [p[1:] for p in places] == [(row, term) for row in rows for term in terms]


@pytest.mark.parametrize("kind", ALL)
def test_each_number_moves_alone_and_by_itself(lens, kind):
    variables = Variables.from_lens(lens, [kind])
    start = variables.start
    for k, place in enumerate(variables.places):
        moved = variables.lens_of(start.at[k].add(0.1))
        change = changed(kind, moved, variables.lens)
        assert abs(change[place.row, place.term] - 0.1 * variables.scale[k]) < 1e-14
        change[place.row, place.term] = 0
        if kind in ("index", "abbe"):  # also of media that continue behind the next surface
            change[place.row + 1 :] = 0
        np.testing.assert_allclose(change, 0, atol=1e-14)
    others = set(PARTS) - {kind}
    moved = variables.lens_of(start + 0.1)
    for other in others:
        np.testing.assert_allclose(changed(other, moved, variables.lens), 0, atol=1e-13)


def test_from_vector_to_lens_and_back(lens):
    every = Variables.from_lens(lens, [*ALL])
    rng = np.random.default_rng(0)
    vector = jnp.asarray(rng.normal(size=len(every.places))) + every.start
    np.testing.assert_allclose(every.vector(every.lens_of(vector)), vector, rtol=1e-13, atol=1e-13)
    assert len(set(every.names)) == len(every.places)

    # In one program, for many vectors, differentiable: each number depends on its own variable.
    def back(vector):
        return every.vector(every.lens_of(vector))

    many = jnp.stack([vector, 2 * vector])
    program = jax.jit(lambda v: (jax.vmap(back)(v), jax.jacfwd(back)(v[0]), jax.jacrev(back)(v[0])))
    again, *jacobians = program(many)
    np.testing.assert_allclose(again, many, rtol=1e-13, atol=1e-13)
    for jacobian in jacobians:
        np.testing.assert_allclose(jacobian, np.eye(len(vector)), atol=1e-12)


def test_the_sensor_goes_along_with_thicknesses(lens):
    variables = Variables.from_lens(lens, ["thickness"])
    longer = variables.lens_of(variables.start + 1)
    grown = jnp.sum(longer.thickness) - jnp.sum(lens.thickness)
    assert grown > 0.1 and abs(longer.sensor - lens.sensor - grown) < 1e-12


def test_bounds_and_scales(lens):
    vary = [
        Vary("curvature", (0, 1), low=0.0, high=0.06, scale=0.01),
        Vary("index", (0,), low=1.0, high=1.8),
        "thickness",
    ]
    variables = Variables.from_lens(lens, vary)
    np.testing.assert_allclose(variables.low[:2], 0)
    np.testing.assert_allclose(variables.high[:2], 6)
    # Indices are bounded by those of glasses, other numbers are not; the start is inside.
    assert abs(variables.numbers(variables.low)[2] - 1.3) < 1e-12
    assert np.all(np.isinf(variables.low[3:])) and np.all(np.isinf(variables.high[3:]))
    assert variables.start[1] == 0 and variables.lens.curvature[1] == 0
    np.testing.assert_allclose(variables.start[0], 5)


def test_scales_are_what_moves_the_light(lens):
    """A step of any coefficient changes the sag at the edge of the beam by the same amount."""
    variables = Variables.from_lens(lens, [Vary("coefficients", (2,))])
    np.testing.assert_allclose(variables.scale, [0.04 / 4.0**4, 0.04 / 4.0**6], rtol=1e-12)
    # And a step of any phase term adds the same number of waves there; bounds are in waves at 3 mm.
    variables = Variables.from_lens(lens, ["phase"])
    np.testing.assert_allclose(variables.scale, [40 / 4.0**2, 40 / 4.0**4], rtol=1e-12)
    variables = Variables.from_lens(lens, [Vary("phase", sag=50.0, semi_diameter=3.0)])
    bounds = variables.numbers(variables.low), variables.numbers(variables.high)
    np.testing.assert_allclose(bounds, [[-50 / 9, -50 / 81], [50 / 9, 50 / 81]], rtol=1e-12)


@pytest.mark.parametrize("form", ["asphere", "zernike", "qbfs"])
def test_coefficients_bounded_by_what_they_add_to_the_sag(form):
    """Each coefficient at its bound changes the sag by at most 0.2 mm within 3 mm of the axis."""
    terms = {"asphere": {4: 0, 6: 0}, "qbfs": {0: 0, 2: 0}, "zernike": {4: 0, 7: 0}}[form]
    own = {"form": form, "coefficients": terms}
    own |= {} if form == "asphere" else {"norm_radius": 5.0}
    front = {"radius": 20, "thickness": 2, "glass": "N-BK7", "semi_diameter": 2.5, "stop": True}
    bent = load_lens({"surfaces": [front, {"radius": -40, **own}], "sensor": 30.0})
    vary = Vary("coefficients", (1,), sag=0.2, semi_diameter=3.0)
    variables = Variables.from_lens(bent, [vary])
    assert len(variables.places) >= 2
    angle = np.linspace(0, 2 * np.pi, 721)

    def sag(lens):
        shape = jax.tree.map(lambda a: a[..., 1, None], lens.shape)
        return surface_sag((3 * jnp.cos(angle), 3 * jnp.sin(angle)), shape, form)

    for k in range(len(variables.places)):
        for bound in (variables.low, variables.high):
            moved = variables.lens_of(variables.start.at[k].set(bound[k]))
            lifted = np.max(np.abs(sag(moved) - sag(bent)))
            assert abs(lifted - 0.2) < 0.002  # the angles at which a mode is highest are sampled
    np.testing.assert_allclose(variables.high, 1 / 0.03)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"kind": "conic", "sag": 0.1, "semi_diameter": 3}, "are of coefficients, not of conic"),
        ({"sag": 0.1}, "give both, above 0 mm, got 0.1 and 0"),
        ({"sag": -0.1, "semi_diameter": 1}, "give both, above 0 mm"),
        ({"sag": 0.1, "semi_diameter": 1, "low": 0.0}, "replace low and high"),
    ],
)
def test_bounds_by_sag_that_mean_nothing(given, said):
    with pytest.raises(ValueError, match=f"variables: sag and semi_diameter: {said}"):
        Vary(**({"kind": "coefficients"} | given))


def test_norm_radii_are_no_variables(tmp_path):
    path = tmp_path / "forbes.yaml"
    path.write_text(
        "surfaces:\n"
        "  - {radius: 50, thickness: 5, glass: N-BK7, semi_diameter: 5, stop: true, form: qbfs,\n"
        "     norm_radius: 6.0, coefficients: {0: 1.0e-3, 1: 1.0e-4}}\n"
        "  - {radius: inf, thickness: 95, form: toroid, curvature_x: 0.001}\n"
    )
    names = Variables.from_lens(load_lens(path), ["coefficients"]).names
    # For the toroid the curvature in x and y^4; the term of y^2 is its curvature in y.
    assert names == (
        *("coefficients 0[1]", "coefficients 0[2]"),
        *("coefficients 1[0]", "coefficients 1[2]"),
    )


def test_ties(lens):
    ties = [Tie((0, 3)), Tie((1, 6), "opposite"), Tie((0, 5), kind="thickness")]
    variables = Variables.from_lens(lens, ["curvature", "thickness"], ties)
    names = variables.names
    assert "curvature 3" not in names and "curvature 6" not in names and "thickness 5" not in names
    vector = variables.start + jnp.linspace(0.1, 1, len(names))
    made = jax.jit(variables.lens_of)(vector)
    assert made.curvature[3] == made.curvature[0] and made.curvature[6] == -made.curvature[1]
    assert made.thickness[5] == made.thickness[0]
    grown = jax.jacfwd(lambda v: variables.lens_of(v).curvature)(vector)
    leader = names.index("curvature 1")
    assert grown[6, leader] == -grown[1, leader] != 0


def test_scaled_and_shifted_ties(lens):
    """A follower is scale x leader + shift, also for a leader that does not vary, and its
    derivative has the factor scale."""
    ties = [Tie((0, 3), scale=-0.5), Tie((1, 6), "opposite", scale=2.0, shift=0.01)]
    ties.append(Tie((0, 5), kind="thickness", scale=0.25, shift=2.0))
    variables = Variables.from_lens(lens, ["curvature"], ties)
    assert variables.lens.thickness[5] == 0.25 * lens.thickness[0] + 2
    vector = variables.start + jnp.linspace(0.1, 1, len(variables.names))
    made = variables.lens_of(vector)
    assert made.curvature[3] == -0.5 * made.curvature[0] != 0
    assert made.curvature[6] == -2 * made.curvature[1] + 0.01
    grown = jax.jacfwd(lambda v: variables.lens_of(v).curvature)(vector)
    np.testing.assert_array_equal(grown[6], -2 * grown[1])
    assert np.any(grown[1])


@pytest.mark.parametrize(
    "given, said",
    [
        ({"scale": 0.0}, "a scale that is not 0 and a shift, got 0 and 0"),
        ({"scale": np.nan}, "got nan and 0"),
        ({"shift": np.inf}, "got 1 and inf"),
        ({"how": "cemented", "shift": 1.0}, "cemented: takes neither scale nor shift"),
    ],
)
def test_ties_that_mean_nothing(given, said):
    with pytest.raises(ValueError, match=f"ties: .*{said}"):
        Tie((2, 3), **given)


def test_cemented_surfaces_have_one_shape(lens):
    """Also if only a part of the shape varies: the rest is made equal once."""
    variables = Variables.from_lens(
        lens, ["curvature", Vary("conic", (2,))], [Tie((2, 3), "cemented")]
    )
    assert variables.lens.coefficients[3, 1] == lens.coefficients[2, 1] != 0
    made = variables.lens_of(variables.start + 1)
    for name in ("curvature", "conic", "coefficients"):
        array = np.asarray(getattr(made, name))
        np.testing.assert_array_equal(array[2], array[3])
    assert made.conic[2] != lens.conic[2]


def test_what_follows_a_number_that_does_not_change(lens):
    variables = Variables.from_lens(lens, [Vary("thickness")], [Tie((0, 6), "opposite")])
    assert variables.lens.curvature[6] == -lens.curvature[0]


def test_media_go_on_behind_a_stop_and_a_mirror(tmp_path):
    path = tmp_path / "mangin.yaml"
    glass = "nd: 1.6, vd: 50.0"
    path.write_text(
        "surfaces:\n"
        f"  - {{radius: -100, thickness: 2, {glass}, semi_diameter: 5}}\n"
        f"  - {{radius: inf, thickness: 2, {glass}, semi_diameter: 5, stop: true}}\n"
        "  - {radius: -150, thickness: -4, mirror: true, semi_diameter: 6}\n"
        "  - {radius: -100, thickness: -60, semi_diameter: 6}\n"
    )
    variables = Variables.from_lens(load_lens(path), ["index", "abbe"])
    assert variables.names == ("index 0", "abbe 0")
    made = variables.lens_of(variables.start + 1)
    index = np.asarray(made.index(0.55))[:, 0]
    assert index[0] == index[4] == 1 and index[1] == index[2] == index[3] > 1.61


BAD = [
    (dict(vary=["bend"]), "variables: kind: expected one of curvature, conic"),
    (dict(vary=[Vary("curvature", (9,))]), "variables: curvature: no surface 9; there are 0, 1, 2"),
    (dict(vary=[Vary("thickness", (6,))]), "no surface 6; there are 0, 1, 2, 3, 4, 5"),
    (dict(vary=[Vary("index", (1,))]), "variables: index: no surface 1; there are 0, 2, 5"),
    (dict(vary=[Vary("semi_diameter", (1,))]), "no surface 1; there are 0, 4"),
    (dict(vary=[Vary("coefficients", (2,), (3,))]), "no term 3; there are 0, 1, 2"),
    (dict(vary=["curvature", Vary("curvature", (2,))]), "variables: curvature 2 stands twice"),
    (dict(vary=[]), "variables: none is left; name some"),
    (
        dict(vary=[Vary("curvature", (0, 3))], ties=[Tie((0, 3))]),
        "variables: curvature 3 follows from a tie or a solve; leave it out",
    ),
    (
        dict(vary=["curvature"], ties=[Tie((0, 3)), Tie((1, 3))]),
        "ties: curvature 3 follows twice; leave one out",
    ),
    (
        dict(vary=["curvature"], ties=[Tie((0, 3)), Tie((3, 5))]),
        "ties: curvature 3, which curvature 5 follows, itself follows",
    ),
    (
        dict(vary=["curvature"], ties=[Tie((6, 0))], solves=[Solve("focal_length", 50, 6)]),
        "ties: curvature 6, which curvature 0 follows, itself follows",
    ),
    (
        dict(vary=["curvature"], ties=[Tie((0, 6))], solves=[Solve("focal_length", 50, 6)]),
        "ties: curvature 6 follows twice",
    ),
    (dict(vary=["curvature"], ties=[Tie((0, 9))]), "ties: curvature: no surface 9; there are 0"),
    (
        dict(vary=["sensor"], solves=[Solve("paraxial_focus")]),
        "variables: none is left; fewer solves or more variables are needed",
    ),
]


@pytest.mark.parametrize("k", range(len(BAD)))
def test_what_does_not_fit_is_told_in_one_line(lens, k):
    arguments, said = BAD[k]
    with pytest.raises(ValueError) as told:
        Variables.from_lens(lens, **arguments)
    assert said in str(told.value) and "\n" not in str(told.value)


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: Vary("curvature", low=1, high=-1), "variables: curvature: low 1 is not below"),
        (lambda: Vary("curvature", low=np.nan), "variables: curvature: low nan is not below"),
        (lambda: Vary("index", low=3.0), "variables: index: 3 to inf lies outside of 1.3 to 2.2"),
        (lambda: Vary("curvature", scale=-1), "variables: curvature: scale: must be above 0"),
        (lambda: Vary("curvature", 3), "variables: curvature: surfaces: expected whole numbers"),
        (lambda: Vary("curvature", (1.5,)), "surfaces: expected whole numbers from 0"),
        (lambda: Vary("tilt", terms="x"), "variables: tilt: terms: expected whole numbers"),
        (lambda: Tie((0,)), "ties: expected two or more different surfaces"),
        (lambda: Tie((0, 0)), "ties: expected two or more different surfaces"),
        (lambda: Tie((0, 2), "cemented"), "ties: cemented: expected two neighbours"),
        (lambda: Tie((0, 1), "alike"), "ties: how: expected one of equal, opposite"),
        (lambda: Tie((0, 1), kind="bend"), "ties: kind: expected one of curvature"),
    ],
)
def test_bad_words_and_numbers(make, said):
    with pytest.raises(ValueError) as told:
        make()
    assert said in str(told.value) and "\n" not in str(told.value)


def test_a_lens_without_any():
    singlet = load_lens("singlet")
    for kind, said in (("index", "write nd and vd"), ("coefficients", "with_asphere")):
        with pytest.raises(ValueError, match=said):
            Variables.from_lens(singlet, [kind])
    assert Vary("curvature", [1]).surfaces == (1,) and hash(Vary("curvature", [1]))


@pytest.mark.slow
def test_float32_stays(lens):
    small = jax.tree.map(lambda a: a.astype(jnp.float32), lens)
    variables = Variables.from_lens(small, [*ALL], solves=[Solve("focal_length", surface=6)])
    made = variables.lens_of(variables.start)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves((made, variables.start)))


def test_several_sets_of_one_lens_are_one_problem():
    """In any sequence; a number that varies in two of them, or belongs to another lens, is
    refused."""
    lens = load_lens("cooke_triplet")
    tie = Tie((0, 2), how="opposite")
    sets = (
        Variables.from_lens(lens, [Vary("curvature", (0,))], ties=[tie]),
        Variables.from_lens(lens, [Vary("thickness", (1,), low=1.0), Vary("tilt", (1,))]),
    )
    both = Variables.joined(sets)
    assert both.names == sets[0].names + sets[1].names
    vector = both.start * 1.01
    one, two = both.lens_of(vector), sets[0].lens_of(vector[:1])
    np.testing.assert_array_equal(one.curvature, two.curvature)
    np.testing.assert_array_equal(one.thickness[1], lens.thickness[1] * 1.01)
    problem = Problem.from_variables([*sets], ["focal_length"])
    assert problem.variables.names == both.names
    with pytest.raises(ValueError, match="curvature 0 stands twice"):
        Variables.joined([sets[0], sets[0]])
    with pytest.raises(ValueError, match="variables: of different lenses"):
        other = Variables.from_lens(load_lens("singlet"), ["curvature"])
        Problem.from_variables([sets[0], other], ["focal_length"])
    for wrong in ([], [Vary("curvature")], None):
        with pytest.raises(ValueError, match=r"expected Variables.from_lens\(lens"):
            Problem.from_variables(wrong, ["focal_length"])


def test_printed_variables_are_a_few_lines_with_units_and_bounds():
    """The radius of 20 mm is the curvature 0.05; a thickness at its bound is named."""
    lens = load_lens("cooke_triplet")
    thick = float(lens.thickness[0])
    varied = ["curvature", Vary("thickness", (0, 1), low=thick), Vary("sensor")]
    lines = str(Variables.from_lens(lens, varied)).splitlines()
    assert len(lines) == 5 and "9 variables, 0 ties, 0 solves" in lines[0]
    assert lines[1].startswith(f"  curvature (1/mm): [0] {float(lens.curvature[0]):.5g}, [1] ")
    assert lines[2].startswith(f"  thickness (mm): [0] {thick:.5g}, [1] ")
    assert lines[3].startswith("  sensor (mm): ")
    assert lines[4] == f"  thickness 0 at its low bound {thick:.5g} mm"
    many = Variables.from_lens(lens, [Vary("curvature", low=1.0, high=2.0)])
    assert str(many).splitlines()[-1] == "  and 2 more at a bound"


def test_a_printed_problem_says_what_is_varied_traced_and_asked_for():
    lens, scene = load_lens("cooke_triplet"), Scene.degrees([0, 10], 1e3, [0.5, 0.6])
    asked = ["spot", Operand("total_track", high=70.0, weight=2.0), Operand("f_number", target=5)]
    lines = str(Problem.from_variables(Variables.from_lens(lens, ["sensor"]), asked, scene))
    title, view, rays, *operands = lines.splitlines()
    assert title.endswith("variables: 1 sensor")
    assert view == "  fields 0, 10 degrees; object at 1000 mm; wavelengths 0.5, 0.6 um"
    assert "order=6" in rays and rays.endswith("3 operands:")
    assert operands == [
        "  spot: target 0, weight 1",
        "  total_track: high 70, weight 2",
        "  f_number: target 5, weight 1",
    ]
