"""Numbers that a gradient by a whole lens changes, and those that an optimiser leaves unchanged:
air stays air."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import drt_jax
from drt_jax import learn
from drt_jax.lens.lens import HELD, movable

GREEN = jnp.array([0.5875618])
LENS = drt_jax.load_lens("cooke_triplet")
MIXED = {
    "surfaces": [
        {"radius": 40.0, "thickness": 4.0, "nd": 1.6, "vd": 50.0, "semi_diameter": 9.0},
        {"radius": -90.0, "thickness": 2.0, "glass": "N-BK7", "semi_diameter": float("inf")},
        {
            "radius": -60.0,
            "semi_diameter": 6.0,
            "stop": True,
            "phase": {"form": "asphere", "order": 1, "coefficients": {2: -0.2}},
        },
    ],
    "sensor": 70.0,
}


def power(lens):
    """Sum of the powers of all surfaces, 1/mm, divided by the size of the stop and by all other
    held numbers, so that every number has a derivative if none is held."""
    bends = jnp.sum(jnp.diff(lens.index(GREEN)[:, 0]) * lens.curvature[:-1])
    if lens.phase is not None:
        bends = bends + jnp.sum(lens.phase.order[:, None] * lens.phase.coefficients)
    return (
        bends * (lens.sensor - lens.thickness[0]) / lens.semi_diameter[lens.stop]
        + (lens.semi_diameter[0])
    )


slopes = jax.jit(jax.grad(power))


def held(gradient):
    """The numbers that a designer would not change."""
    model = gradient.dispersion.model
    rest = [] if model is None else [model[0], *model[2:]]  # medium 1 alone is a model glass
    order = [] if gradient.phase is None else [gradient.phase.order]
    constants = dataclasses.replace(gradient.dispersion, model=None, dPgF=None)
    return [*jax.tree.leaves(constants), *rest, *order]


def test_a_jacobian_of_several_outputs_is_that_of_each():
    """Also in `jit`, where each array of the lens becomes a tuple of derivatives."""
    twice = lambda lens: (power(lens), {"twice": 2 * power(lens)})  # noqa: E731
    first, second = jax.jit(jax.jacrev(twice))(LENS)
    one = slopes(LENS)
    for name in ("curvature", "semi_diameter", "sensor"):
        assert np.array_equal(getattr(first, name), getattr(one, name))
        assert np.array_equal(getattr(second["twice"], name), 2 * getattr(one, name))


@pytest.mark.parametrize("prescription", ["cooke_triplet", MIXED], ids=["glasses", "mixed"])
def test_a_gradient_by_a_lens_holds_what_a_designer_holds(prescription):
    lens = drt_jax.load_lens(prescription)
    stop = lens.stop
    for gradient in (jax.grad(power)(lens), slopes(lens), jax.jit(jax.jacfwd(power))(lens)):
        assert all(np.all(np.asarray(a) == 0) for a in held(gradient))
        assert gradient.semi_diameter[stop] == 0 and gradient.semi_diameter[0] == 1
        assert np.all(np.asarray(gradient.curvature[:stop]) != 0)
        if gradient.dispersion.model is not None:
            assert np.all(np.asarray(gradient.dispersion.model[1]) != 0)
            assert np.any(np.asarray(gradient.phase.coefficients) != 0)


def test_what_is_asked_for_by_name_has_its_derivative():
    """By replacement, in and outside of `jit`, and by the field `free`; compared with closed
    forms."""
    stop, semi, constants = LENS.stop, LENS.semi_diameter, LENS.dispersion
    wanted = (semi[0] - power(LENS)) / semi[stop]
    bends = (LENS.sensor - LENS.thickness[0]) / semi[stop]
    by_index = bends * (LENS.curvature[0] - LENS.curvature[1]) / (2 * LENS.index(GREEN)[1, 0])

    def replaced(semi, schott, function):
        dispersion = dataclasses.replace(constants, schott=schott)
        own = dataclasses.replace(LENS, semi_diameter=semi, dispersion=dispersion)
        # Another change keeps those before.
        return function(dataclasses.replace(own, conic=LENS.conic + 1))

    for function in (power, jax.jit(power)):
        by_semi, by_schott = jax.grad(replaced, (0, 1))(semi, constants.schott, function)
        np.testing.assert_allclose(by_semi[stop], wanted, rtol=1e-12)
        np.testing.assert_allclose(by_schott[1, 0], by_index, rtol=1e-12)
    gradient = slopes(dataclasses.replace(LENS, free=tuple(HELD)))
    np.testing.assert_allclose(gradient.semi_diameter[stop], wanted, rtol=1e-12)
    np.testing.assert_allclose(gradient.dispersion.schott[1, 0], by_index, rtol=1e-12)


def test_a_change_within_a_program_holds_as_outside():
    moved = lambda lens: jax.grad(power)(dataclasses.replace(lens, sensor=lens.sensor + 1))  # noqa: E731
    for gradient in (moved(LENS), jax.jit(moved)(LENS)):
        assert gradient.semi_diameter[LENS.stop] == 0
        assert not np.any(np.asarray(gradient.dispersion.schott))


RULES = {
    "adam": lambda: learn.adam(1e-3),
    "optax.adam": lambda: optax.adam(1e-3),
    "optax.adamw": lambda: optax.adamw(1e-3, mask=movable),
    "optax.lion": lambda: optax.lion(1e-3, mask=movable),
}


@pytest.mark.parametrize("rule", RULES)
def test_optimisers_leave_air_and_glass_alone(rule, tmp_path):
    init, update = RULES[rule]()[:2]
    extra = () if rule == "adam" else (LENS,)
    with jax.numpy_dtype_promotion("standard"):  # as optax has it
        updates, _ = update(slopes(LENS), init(LENS), *extra)
    lens = learn.apply_updates(LENS, updates)
    np.testing.assert_array_equal(lens.index(GREEN), LENS.index(GREEN))
    np.testing.assert_array_equal(lens.semi_diameter[1:], LENS.semi_diameter[1:])
    assert np.all(np.asarray(lens.curvature[:-1] != LENS.curvature[:-1]))
    lens.check()
    drt_jax.save_lens(lens, tmp_path / "lens.yaml")
    again = drt_jax.load_lens(tmp_path / "lens.yaml")
    assert again.glasses == LENS.glasses
    np.testing.assert_array_equal(again.curvature, lens.curvature)


def test_check_refuses_nan_and_air_that_is_none(tmp_path):
    def refused(match, **changes):
        lens = dataclasses.replace(LENS, **changes)
        with pytest.raises(ValueError, match=match):
            lens.check()
        with pytest.raises(drt_jax.LensError):
            drt_jax.save_lens(lens, tmp_path / "lens.yaml")
        assert not any(tmp_path.iterdir())

    for name in ("curvature", "semi_diameter", "thickness", "sensor"):
        array = np.array(getattr(LENS, name))
        array[(0,) * array.ndim] = np.nan
        refused(f"lens.{name}: expected numbers, got NaN", **{name: jnp.asarray(array)})
    constants = LENS.dispersion
    for i, k in ((0, 0), (6, 3)):
        changed = dataclasses.replace(constants, schott=constants.schott.at[i, k].add(-1e-3))
        refused(f"medium {i} is called air", dispersion=changed)
    strange = dataclasses.replace(constants, strength=constants.strength.at[2].set(np.nan))
    refused("lens.dispersion.strength: expected numbers", dispersion=strange)
    refused("lens.free: expected some of semi_diameter, dispersion, phase", free=("glass",))


def test_a_mask_of_a_tree_of_parameters():
    """As in a training step: a lens together with other parameters."""
    lens = drt_jax.load_lens("cooke_triplet")
    mask = movable({"optics": lens, "network": [jnp.ones(3)]})
    assert mask["network"] == [True] and mask["optics"].curvature is True
    assert mask["optics"].semi_diameter is False
