import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from drt_jax.learn import adam, apply_updates


def parameters():
    return {
        "optics": {"sensor": jnp.array(133.0), "curvature": jnp.array([0.01, -0.02])},
        "network": [{"kernel": jnp.ones((2, 3), jnp.float32), "bias": jnp.zeros(3, jnp.float32)}],
    }


def gradients(step):
    generator = np.random.default_rng(step)
    return jax.tree.map(
        lambda p: jnp.asarray(
            generator.normal(size=p.shape) * 10.0 ** generator.uniform(-9, 3), p.dtype
        ),
        parameters(),
    )


def test_updates_are_those_of_optax():
    init, update = adam(1e-2)
    update = jax.jit(update)
    reference = optax.adam(1e-2)
    ours, theirs = parameters(), parameters()
    state, other = init(ours), reference.init(theirs)
    for step in range(25):
        change, state = update(gradients(step), state)
        with jax.numpy_dtype_promotion("standard"):  # optax needs it
            wanted, other = reference.update(gradients(step), other)
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=3e-6, atol=1e-12), change, wanted
        )
        ours, theirs = apply_updates(ours, change), optax.apply_updates(theirs, wanted)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), ours, theirs)


def test_each_group_has_its_rate_and_each_leaf_its_dtype():
    init, update = adam({"optics": 0.5, "network": 1e-3})
    state = init(parameters())
    change, state = update(gradients(0), state)
    one, _ = adam(1.0)[1](gradients(0), adam(1.0)[0](parameters()))
    for group, rate in (("optics", 0.5), ("network", 1e-3)):
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, rate * b, rtol=1e-6),
            change[group],
            one[group],
        )
    for tree in (change, state.first, state.second, apply_updates(parameters(), change)):
        jax.tree.map(lambda a, b: np.testing.assert_equal(a.dtype, b.dtype), tree, parameters())


def test_a_group_may_have_a_rate_for_each_of_its_numbers():
    rates = {"optics": {"sensor": 0.5, "curvature": 2e-6}, "network": 1e-3}
    one, _ = adam(1.0)[1](gradients(0), adam(1.0)[0](parameters()))
    change, _ = adam(rates)[1](gradients(0), adam(rates)[0](parameters()))
    for name, rate in rates["optics"].items():
        np.testing.assert_allclose(change["optics"][name], rate * one["optics"][name], rtol=1e-12)
    with pytest.raises(KeyError, match="curvature"):
        adam(rates | {"optics": {"sensor": 0.5}})[1](gradients(0), adam(rates)[0](parameters()))


def test_a_group_without_a_rate_is_an_error():
    init, update = adam({"optics": 0.1})
    with pytest.raises(KeyError, match="network"):
        update(gradients(0), init(parameters()))
