"""Numbers are leaves and names are labels: other ones compile nothing. Also an operand that is a
user's function."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, design, load_lens
from drt_jax.design import Operand, Solve, Tie, Variables, Vary, trace_fields

ROWS = [
    {"radius": 30.0, "thickness": 4.0, "glass": "N-BK7", "semi_diameter": 8.0},
    {"radius": -60.0, "thickness": 3.0, "glass": "air"},
    {"radius": np.inf, "thickness": 3.0, "stop": True, "semi_diameter": 5.0},
    {"radius": -40.0, "thickness": 2.0, "glass": "F2"},
    {"radius": 50.0, "thickness": 60.0, "glass": "air"},
]


def coma(lens, rays):
    """Centroid minus chief ray, y in mm, of each view: an operand as a user writes one."""
    y, weights = rays.sensor_hits[-1], rays.weights
    return jnp.sum(weights * (y - y[..., :1]), axis=-1)


def lens_of(name, glasses):
    rows = [dict(row) for row in ROWS]
    rows[0]["glass"], rows[3]["glass"] = glasses
    return load_lens({"name": name, "surfaces": rows})


def searched(k):
    """All steps of a design, with other numbers and names for each k."""
    glasses = (("N-BK7", "F2"), ("N-SK16", "F2"), ("SK16", "SF2"))[k]
    lens = lens_of(("one", "two", "three")[k], glasses)
    variables = Variables.from_lens(
        lens,
        [Vary("curvature", low=-0.1 - 0.01 * k), Vary("thickness", (0, 1), low=0.5)],
        [Tie((0, 3), scale=-0.5 - 0.1 * k, shift=0.001 * k)],
        [
            Solve("focal_length", 60.0 + k, 4),
            Solve("f_number", 7.0 + k, wavelengths=(0.5 + k / 99,)),
        ],
    )
    operands = [
        Operand("spot", weight=1.0 + k),
        Operand("distortion", low=-0.02 - 0.01 * k, high=0.03, weight=2.0 + k),
        Operand("glass_edge", low=0.5 + 0.1 * k),
        Operand("total_track", target=70.0 + k, weight=0.01),
        Operand(coma, weight=0.5 + k, fields=(1,)),
        Operand(coma, high=0.2 + k),
    ]
    fields, waves = [0.0, 0.05 + 0.01 * k], (0.5 + 0.01 * k, 0.6)
    given = {"wavelength_weights": (1.0, 2.0 + k), "field_weights": (1.0 + k, 2.0)}
    scene = Scene.radians(fields, 900.0 + k, waves, **given)
    problem = design.Problem.from_variables(variables, operands, scene, 2)
    return problem, design.optimise(problem, max_steps=3)


@pytest.mark.slow
def test_other_numbers_and_names_compile_nothing(caplog):
    searched(0)
    searched(1)  # some values, such as the range of a glass, are needed here for the first time
    caplog.clear()
    with jax.log_compiles():
        found = searched(2)[1]
    compiled = [r.getMessage() for r in caplog.records if "ompil" in r.getMessage()]
    assert not compiled, compiled[:3]
    assert np.isfinite(found.merit) and found.lens.name == "three, re-optimised"
    assert found.lens.glasses == ("air", "SK16", "air", "air", "SF2", "air")
    focal = drt_jax.focal_length(found.lens, 0.5875618)
    np.testing.assert_allclose(focal, 62, rtol=1e-12)


def test_lenses_of_other_names_stack():
    lenses = [lens_of("one", ("N-BK7", "F2")), lens_of("two", ("N-SK16", "SF2"))]
    focal = jax.jit(lambda lens: drt_jax.focal_length(lens, 0.55))
    wanted = [focal(lens) for lens in lenses]
    assert focal._cache_size() == 1
    both = jax.tree.map(lambda *a: jnp.stack(a), *lenses)
    np.testing.assert_allclose(jax.vmap(focal)(both), np.stack(wanted), rtol=1e-14)
    # A lens that a program returns has no name, not that of the lens for which it was compiled.
    assert jax.jit(lambda lens: lens)(lenses[1]).name == ""
    water = dataclasses.replace(lenses[0], labels=lenses[0].labels.unnamed)
    assert jax.tree.structure(water) == jax.tree.structure(lenses[1])
    same = lens_of("three", ("F2", "F2"))  # the same structure: other media lie between
    assert jax.tree.structure(same) == jax.tree.structure(lenses[1])
    mirror = load_lens("hubble")
    assert jax.tree.structure(mirror) != jax.tree.structure(lenses[1])


@pytest.mark.slow
def test_a_function_is_an_operand():
    """As residuals, and as limits that are reported by its name; with derivatives."""
    problem, found = searched(0)
    lens = problem.variables.lens_of(problem.variables.start)
    rays = trace_fields(problem, lens)
    values = coma(lens, rays)
    of_one, limit = problem.operands[4:]
    np.testing.assert_allclose(of_one.residuals(lens, rays), 0.5 * values[1], rtol=1e-12)
    np.testing.assert_allclose(limit.constraints(lens, rays), jnp.ravel(values) - 0.2, rtol=1e-12)
    own = [limit for limit in found.limits if limit.kind == "coma"]
    assert sorted(limit.where for limit in own) == [f"value {k}" for k in range(4)]
    slope = jax.jit(jax.grad(problem.merit))(problem.variables.start)
    assert np.all(np.isfinite(slope))


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: Operand(coma, surfaces=(0,)), "operands: coma: does not depend on surfaces"),
        (lambda: Operand(coma, low=1, high=0), "operands: coma: low 1 is not below high 0"),
        (lambda: Operand(3), "operands: kind: expected one of .*, got 3"),
    ],
)
def test_functions_that_do_not_fit(make, said):
    with pytest.raises(ValueError, match=said):
        make()
