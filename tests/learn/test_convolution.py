"""Our convolutions compared with XLA's own, in float64, and with sums in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax.learn import convolution
from drt_jax.learn.convolution import convolve_3x3


def plain(images, kernel):
    padded = np.pad(np.asarray(images, float), ((0, 0), (1, 1), (1, 1), (0, 0)))
    height, width = images.shape[1:3]
    return sum(
        padded[:, i : i + height, j : j + width] @ np.asarray(kernel[i, j], float)
        for i in range(3)
        for j in range(3)
    )


# Winograd's algorithm, for all images at once and one by one, also for sides that are not multiples
# of 4; gathered images; and few channels in or out.
CASES = {
    "large": ((2, 32, 36, 32), 32),
    "odd": ((2, 65, 34, 32), 32),
    "small": ((3, 9, 20, 32), 32),
    "few in": ((2, 64, 33, 3), 32),
    "few out": ((2, 64, 33, 32), 3),
}


@pytest.fixture(scope="module", params=CASES.values(), ids=CASES)
def case(request):
    shape, out = request.param
    rng = np.random.default_rng(0)
    images, kernel = rng.standard_normal(shape), rng.standard_normal((3, 3, shape[-1], out)) / 17
    return images, kernel, rng.standard_normal((*shape[:3], out))


@pytest.mark.parametrize("dtype, bound", [(jnp.float64, 1e-13), (jnp.float32, 5e-6)])
def test_value_and_gradients(case, dtype, bound):
    images, kernel, weight = (jnp.asarray(a, dtype) for a in case)

    def both(convolve):
        value, back = jax.vjp(convolve, images, kernel)
        return value, *back(weight)

    text = jax.jit(convolve_3x3).lower(images, kernel).compile().as_text()
    assert "convolution(" not in text  # or this test compares XLA with itself
    ours, theirs = (
        jax.jit(lambda: both(convolve_3x3))(),
        jax.jit(lambda: both(convolution._direct))(),
    )
    for a, b in zip(ours, theirs):
        assert a.dtype == dtype
        assert float(jnp.max(jnp.abs(a - b))) < bound * float(jnp.max(jnp.abs(b)))
    np.testing.assert_allclose(ours[0], plain(images, kernel), atol=8 * bound)


@pytest.mark.parametrize(
    "shape, out", [((1, 65, 64, 16), 16), ((1, 32, 32, 32), 40), ((2, 8, 8, 40), 40)]
)
def test_other_shapes(shape, out):
    rng = np.random.default_rng(1)
    images, kernel = rng.standard_normal(shape), rng.standard_normal((3, 3, shape[-1], out))
    np.testing.assert_allclose(
        convolve_3x3(jnp.asarray(images), jnp.asarray(kernel)), plain(images, kernel), atol=1e-11
    )


def test_forward_mode_and_vmap(case):
    images, kernel, _ = (jnp.asarray(a) for a in case)
    moved = jax.jit(lambda: jax.jvp(lambda k: convolve_3x3(images, k), (kernel,), (kernel,))[1])()
    np.testing.assert_allclose(moved, plain(images, kernel), atol=1e-11)
    many = jax.jit(jax.vmap(lambda k: convolve_3x3(images, k)))(jnp.stack([kernel, 2 * kernel]))
    np.testing.assert_allclose(many[1], 2 * many[0], atol=1e-11)
