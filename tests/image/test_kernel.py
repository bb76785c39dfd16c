"""Kernels compared with the integral of the Gaussian over each pixel, by adaptive quadrature."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from drt_jax.image import kernel as kernels
from drt_jax.image.kernel import SeparableKernel

gaussian_psf = jax.jit(kernels.gaussian_psf, static_argnums=(2, 3, 4))
PIXEL = 4.4e-3


def pixel_integral(mean, covariance, x, y):
    inverse, norm = np.linalg.inv(covariance), 2 * np.pi * np.sqrt(np.linalg.det(covariance))

    def density(v, u):
        d = np.array([u, v]) - mean
        return np.exp(-d @ inverse @ d / 2) / norm

    value, _ = integrate.dblquad(density, x - 0.5, x + 0.5, y - 0.5, y + 0.5, epsabs=1e-12)
    return value


@pytest.mark.parametrize(
    "covariance", [[[4, 1.5], [1.5, 2]], [[0.3, -0.1], [-0.1, 0.2]], [[9, 8.5], [8.5, 9]]]
)
def test_rotated_kernel_is_the_pixel_integral(covariance):
    mean, covariance = np.array([0.3, -0.2]), np.array(covariance, float)
    kernel = gaussian_psf(
        jnp.asarray(mean[None]) * PIXEL, jnp.asarray(covariance[None]) * PIXEL**2, PIXEL, 41
    )[0]
    np.testing.assert_allclose(jnp.sum(kernel), 1, rtol=1e-14)
    for x, y in ((0, 0), (1, 2), (-2, 1), (3, 3)):
        np.testing.assert_allclose(
            kernel[20 + y, 20 + x], pixel_integral(mean, covariance, x, y), atol=1e-9
        )


@pytest.mark.parametrize("form", ["integrated", "sampled"])
def test_diagonal_covariance_gives_the_separable_kernel(form):
    mean = jnp.array([[0.3, -0.2], [0.0, 0.0], [1.0, 0.5]]) * PIXEL
    variances = jnp.array([[4.0, 2.0], [0.3, 0.2], [100.0, 0.1]]) * PIXEL**2
    covariance = jax.vmap(jnp.diag)(variances)
    separable = kernels.separable_psf(mean, covariance, PIXEL, 21, form)
    assert isinstance(separable, SeparableKernel)
    dense = gaussian_psf(mean, covariance, PIXEL, 21, form)
    np.testing.assert_allclose(separable.dense(), dense, atol=1e-15)


def test_equation_5_as_printed():
    covariance = np.array([[4.0, 1.5], [1.5, 2.0]])
    kernel = gaussian_psf(
        jnp.array([[0.5, 0.0]]) * PIXEL,
        jnp.asarray(covariance[None]) * PIXEL**2,
        PIXEL,
        5,
        "sampled",
    )[0]
    d = np.array([1 - 0.5, -2.0])
    wanted = np.exp(-d @ np.linalg.inv(covariance) @ d / 2) / (
        2 * np.pi * np.sqrt(np.linalg.det(covariance))
    )
    np.testing.assert_allclose(kernel[0, 3], wanted, rtol=1e-13)


def test_energy_of_the_printed_form_is_lost_or_made_up():
    """The reason why it is not the default: the sum is 0.11 at sigma 24 px, and above 1 at 0.3
    px."""
    energy = [
        float(jnp.sum(gaussian_psf(jnp.zeros((1, 2)), s**2 * jnp.eye(2)[None], 1.0, 21, "sampled")))
        for s in (24.0, 0.3)
    ]
    assert 0.10 < energy[0] < 0.12 and energy[1] > 1.2


@pytest.mark.parametrize("form", ["integrated", "sampled"])
@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_finite_from_a_point_to_any_width(form, dense, dtype):
    def kernel(sigma, mean):
        covariance = jnp.diag(jnp.stack([sigma**2, sigma**2]))[None]
        if dense:
            kernel = gaussian_psf(mean[None], covariance, 1.0, 21, form)
        else:
            kernel = kernels.separable_psf(mean[None], covariance, 1.0, 21, form).dense()
        return kernel[0, 8:12, 9:12]

    kernel, jacobian = jax.jit(kernel), jax.jit(jax.jacobian(kernel, argnums=(0, 1)))
    for mean in ([0.0, 0.0], [0.1, 0.5], [0.5, -0.5], [200.0, 0.0]):
        mean = jnp.asarray(mean, dtype)
        for sigma in (0.0, 1e-12, 1e-6, 1e-3, 0.1, 1.0, 24.0, 1e3, 1e6):
            sigma = jnp.asarray(sigma, dtype)
            value = kernel(sigma, mean)
            assert jnp.all(jnp.isfinite(value)) and value.dtype == dtype
            for slope in jacobian(sigma, mean):
                assert jnp.all(jnp.isfinite(slope))
    point = kernel(jnp.zeros((), dtype), jnp.zeros(2, dtype))
    if form == "integrated":
        assert point[2, 1] == 1 and jnp.sum(point) == 1


@pytest.mark.parametrize("form", ["integrated", "sampled"])
@pytest.mark.parametrize(
    "psf, failed",
    [
        (kernels.separable_psf, [[jnp.inf, 0.0], [0.0, jnp.inf]]),
        (kernels.gaussian_psf, [[jnp.inf, 0.0], [0.0, jnp.inf]]),
        (kernels.gaussian_psf, [[jnp.inf] * 2] * 2),
    ],
)
def test_an_infinite_blur_is_black_and_has_no_slope(form, psf, failed):
    """Moments inside a trace have an infinite covariance for a wavelength without rays; kernels of
    others do not change."""
    failed = jnp.array(failed)
    xy = 0.0 if psf is kernels.separable_psf else 1.0
    seen = jnp.array([[4.0, xy], [xy, 2.0]])

    @jax.jit
    def all_of(covariance):
        def kernel(covariance):
            found = psf(jnp.zeros((2, 2)), covariance, 1.0, 5, form)
            return found.dense() if isinstance(found, SeparableKernel) else found

        return kernel(covariance), jax.jacfwd(kernel)(covariance), jax.jacrev(kernel)(covariance)

    value, forward, reverse = all_of(jnp.stack([seen, failed]))
    assert jnp.all(value[1] == 0) and jnp.all(forward[1] == 0) and jnp.all(reverse[1] == 0)
    assert jnp.all(forward[0][:, :, 1] == 0) and jnp.all(reverse[0][:, :, 1] == 0)
    wanted = all_of(jnp.stack([seen, seen]))
    for ours, theirs in zip((value, forward, reverse), wanted, strict=True):
        np.testing.assert_allclose(ours[0], theirs[0], atol=1e-15)


def test_derivative_of_the_kernel():
    @jax.jit
    def corner(parameters):
        mean, (xx, yy, xy) = parameters[:2], parameters[2:]
        covariance = jnp.array([[xx, xy], [xy, yy]])[None]
        return gaussian_psf(mean[None], covariance, 1.0, 11)[0, 4, 7]

    at = jnp.array([0.3, -0.4, 3.0, 2.0, -1.0])
    difference = [
        (corner(at.at[i].add(1e-5)) - corner(at.at[i].add(-1e-5))) / 2e-5 for i in range(5)
    ]
    np.testing.assert_allclose(jax.grad(corner)(at), difference, rtol=1e-8)


ONE, WIDE = np.zeros((1, 2)), np.eye(2)[None]
BAD = {
    "NaN": (ONE, WIDE * np.nan, 1.0, "covariance: must be finite; no ray of that wavelength"),
    "inf": (ONE, WIDE + np.inf, 1.0, "covariance: must be finite"),
    "one NaN": (ONE, [[[1, np.nan], [0, 1]]], 1.0, "covariance: must be finite"),
    "no centroid": (ONE * np.nan, WIDE, 1.0, "mean: must be finite"),
    "no pixel": (ONE, WIDE, 0.0, "pixel: must be above 0 mm, got 0"),
    "a negative pixel": (ONE, WIDE, -4.4e-3, "pixel: must be above 0 mm, got -0.0044"),
    "a NaN pixel": (ONE, WIDE, np.nan, "pixel: must be finite"),
    "an infinite pixel": (ONE, WIDE, np.inf, "pixel: must be finite"),
    "two pixels": (ONE, WIDE, [1.0, 2.0], "pixel: expected"),
    "one number": (0.0, WIDE, 1.0, "mean: expected"),
    "a column": (ONE[0], WIDE, 1.0, "mean: expected"),
    "no channel": (ONE[:0], WIDE[:0], 1.0, "mean: expected"),
    "other channels": (ONE, np.ones((3, 2, 2)), 1.0, "covariance: expected"),
    "variances": (ONE, np.ones((1, 2)), 1.0, r"covariance: expected \(C, 2, 2\)"),
    "three numbers": (ONE, np.ones((1, 3)), 1.0, "covariance: expected"),
    "text": (ONE, WIDE, "4.4 um", "pixel: expected real numbers"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_blur_is_refused(name):
    *given, message = BAD[name]
    with pytest.raises(ValueError, match=message):
        kernels.gaussian_psf(*given)


def test_other_bad_requests():
    with pytest.raises(ValueError, match="form: expected one of integrated, sampled, got 'gauss'"):
        gaussian_psf(jnp.zeros((1, 2)), WIDE, 1.0, 5, "gauss")
    for size in (0, 2.5, -3, "21"):
        with pytest.raises(ValueError, match="size: expected a whole number of pixels"):
            kernels.gaussian_psf(ONE, WIDE, 1.0, size)


def test_a_pixel_that_looks_like_micrometres_is_warned_of():
    with pytest.warns(UserWarning, match="pixel: 4.4 mm .* if it is 4.4 um, give 0.0044"):
        kernels.gaussian_psf(ONE, WIDE, 4.4, 3)


@pytest.mark.parametrize("form", ["integrated", "sampled"])
@pytest.mark.parametrize("dense", [False, True])
def test_no_numbers_make_a_nan(form, dense):
    """Inside a trace, kernels of NaN or of an invalid pixel are 0, and all others are finite:
    values and derivatives, in float64 and float32."""

    def kernel(mean, covariance, pixel):
        psf = kernels.gaussian_psf if dense else kernels.separable_psf
        result = psf(mean, covariance, pixel, 3, form)
        return jnp.stack([leaf.ravel() for leaf in jax.tree.leaves(result)])

    both = jax.jit(lambda *a: (kernel(*a), jax.jacrev(kernel, argnums=range(3))(*a)))
    bad = [(0, np.nan, 1), (0, np.inf, 1), (np.nan, 1, 1), (0, 1, 0), (0, 1, np.nan), (0, 1, -1)]
    for dtype in (jnp.float64, jnp.float32):
        most = float(jnp.finfo(dtype).max)
        odd = [(most, 1, 1), (0, most, 1), (0, 1e-30, 1), (0, 1, 1e-30), (1, 1, most), (0, -1, 1)]
        for mean, variance, pixel in (*bad, *odd):
            arrays = jnp.full((1, 2), mean, dtype), jnp.full((1, 2, 2), variance, dtype)
            value, slopes = both(*arrays, jnp.asarray(pixel, dtype))
            assert all(np.all(np.isfinite(leaf)) for leaf in (value, *slopes))
            if (mean, variance, pixel) in bad:
                assert all(np.all(leaf == 0) for leaf in (value, *slopes))


def test_a_separable_kernel_needs_axes_along_the_pixels():
    with pytest.raises(ValueError, match="covariance: xy must be 0 for a separable kernel"):
        kernels.separable_psf(ONE, [[[1.0, 0.1], [0.1, 1.0]]], PIXEL)
