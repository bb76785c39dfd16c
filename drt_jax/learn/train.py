"""Joint training of optics and network: loss, jitted step, loop, evaluation."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from skimage import metrics

from ..compilation import NETWORK, known_options
from ..image.kernel import Form, gaussian_psf, separable_psf
from ..image.sensor import Convolve, convolve, sensor_layer
from ..image.spot import Moments
from ..inputs import require
from ..numerics import Numbers, safe_divide, safe_sqrt
from .adam import adam, apply_updates, copied
from .error import Last, Restore, mean_error, restored
from .network import count_parameters

Blur = Callable[[dict[str, Array], Array], Moments]
Imager = Callable[..., tuple[Array, Array, Array, Array]]


@dataclasses.dataclass(frozen=True)
class Camera:
    """Constants of the sensor layer.

    pixel_um: side of a pixel, um.
    kernel: side of the kernel, pixels, odd.
    form: form of the kernel, see `gaussian_psf`.
    """

    pixel_um: float = 4.4
    kernel: int = 21
    form: Form = "integrated"

    def __post_init__(self) -> None:
        side, pixel = self.kernel, self.pixel_um
        is_odd = 1 <= side <= 999 and side % 2 == 1
        require(is_odd, f"camera.kernel: expected an odd number of pixels, 1 to 999, got {side}")
        require(1e-3 <= pixel <= 1e4, f"camera.pixel_um: expected 1e-3 to 1e4, got {pixel}")


def make_imager(
    blur: Blur,
    restore: Restore | None,
    camera: Camera,
    convolve: Convolve = convolve,
    dtype: Any = jnp.float32,
) -> Imager:
    """The chain moments -> PSF -> sensor layer -> network as one function.

    blur: a function that `moments_model` returns.
    restore: (parameters, images) -> images, each from its own image alone; None for a camera
        without a network.
    camera: constants of the sensor layer.
    convolve: `convolve`; or `convolve_taps` for values and forward mode, which `make_step` uses
        where a single number is trained.
    dtype: of scenes, images and network; kernels are cast to it.

    The function maps (parameters {"optics", "network"}, scenes uint8 (B, H + K - 1, W + K - 1, C),
    distance in mm, noise, key) to the true, the sensor and the restored image (B, H, W, C), of this
    dtype, and to the standard deviation (C,) of the blur in mm. With `last=mean_error` that error,
    (), takes the place of the restored image. The kernel is centred on the mean centroid of the
    wavelengths that arrive, so that images are registered. Each channel is multiplied by the
    throughput of its wavelength.
    """

    def imager(
        parameters: dict[str, Any],
        scenes: Array,
        distance: Array,
        noise: Numbers,
        key: Array,
        last: Last = restored,
    ) -> tuple[Array, Array, Array, Array]:
        scenes = scenes.astype(dtype) / 255
        spot = blur(parameters["optics"], distance)
        arrives = spot.throughput > 0
        total = jnp.sum(jnp.where(arrives[:, None], spot.mean, 0), axis=0, keepdims=True)
        offset = spot.mean - safe_divide(total, jnp.sum(arrives, dtype=spot.mean.dtype))
        pixel = camera.pixel_um * 1e-3
        psf = separable_psf if spot.separable else gaussian_psf
        kernel = psf(offset, spot.covariance, pixel, camera.kernel, camera.form)
        throughput = jnp.expand_dims(spot.throughput.astype(dtype), (0, 1, 2))
        image = sensor_layer(scenes * throughput, kernel, noise, key, convolve)
        truth = truth_of(scenes, image)
        found = last(restore, parameters.get("network"), image, truth)
        return truth, image, found, blur_width(spot.covariance)

    return imager


def blur_width(covariance: Array) -> Array:
    """Standard deviation (C,) of a blur, mm: the root of the mean of its variances along x and y.

    covariance: (C, 2, 2), mm^2.
    """
    return safe_sqrt(jnp.mean(jnp.diagonal(covariance, 0, 1, 2), axis=1))


def truth_of(scenes: Array, image: Array) -> Array:
    """The part of scenes (B, H + K - 1, W + K - 1, C) that images (B, H, W, C) show."""
    margin = (scenes.shape[1] - image.shape[1]) // 2
    height, width = image.shape[1:3]
    return scenes[:, margin : margin + height, margin : margin + width]


def compiled_step(step: Callable) -> Callable:
    """A function (state, scenes, noise, index) -> (state, metrics), jitted, with the state
    donated."""
    return jax.jit(step, donate_argnums=0, compiler_options=known_options(NETWORK))


def _value_and_gradient(loss: Callable, parameters: Any) -> tuple[tuple[Array, Any], Any]:
    """((value, extras), gradient) of a loss function parameters -> (value, extras).

    Where a single number is trained, such as the sensor position, the gradient is computed in
    forward mode, which takes two thirds of the time, see paper section 3.
    """
    if count_parameters(parameters) > 1:
        return jax.value_and_grad(loss, has_aux=True)(parameters)
    ones = jax.tree.map(jnp.ones_like, parameters)
    value, slope, extras = jax.jvp(loss, (parameters,), (ones,), has_aux=True)
    gradient = jax.tree.map(lambda p: slope.astype(p.dtype).reshape(p.shape), parameters)
    return (value, extras), gradient


def make_step(
    imager: Imager,
    rates: dict[str, Any],
    depths: tuple[float, float],
    seed: int,
    vectorised: bool = False,
) -> tuple[Callable, Callable]:
    """Adam on the mean absolute error as (init, step).

    imager: a function that `make_imager` returns, or of the same arguments, `last` among them.
    rates: learning rates of "optics" and "network", see `adam`, in the unit of each parameter.
    depths: limits of the object distance, which is uniform in each step, mm.
    seed: noise and distance depend only on it and on the index of the step.
    vectorised: True for N jobs at once, along the first axis of all parameters.

    init(parameters) -> state; step(state, scenes, noise, index) -> (state, metrics), jitted, with
    the state donated. metrics: loss, sigma_um (mean over the wavelengths), depth_mm, and the
    parameters of the optics by name, "sensor" as sensor_mm, each () or (N,).
    """
    init_adam, update = adam(rates)
    near, far = depths

    def init(parameters: dict[str, Any]) -> tuple[Any, Any]:
        parameters = copied(parameters)
        make = jax.vmap(init_adam) if vectorised else init_adam
        return parameters, make(parameters)

    def step(state: tuple[Any, Any], scenes: Array, noise: Array, index: Array):
        parameters, moments = state
        noise_key, depth_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), index))
        distance = jax.random.uniform(depth_key, dtype=jnp.result_type(float))
        distance = near + (far - near) * distance

        def loss(parameters):
            found = imager(parameters, scenes, distance, noise, noise_key, last=mean_error)
            return found[2], jnp.mean(found[3])

        (error, sigma), gradients = _value_and_gradient(loss, parameters)
        updates, moments = update(gradients, moments)
        report = {"loss": error, "sigma_um": 1e3 * sigma, "depth_mm": distance}
        for name, value in parameters["optics"].items():
            report["sensor_mm" if name == "sensor" else name] = value
        return (apply_updates(parameters, updates), moments), report

    if vectorised:
        step = jax.vmap(step, in_axes=(0, None, None, None))
    return init, compiled_step(step)


def fit(
    step: Callable,
    state: Any,
    scenes: Iterator[np.ndarray],
    noise: Numbers,
    steps: range,
    every: int,
    report: Callable[[int, dict[str, np.ndarray], Any], None],
    stopped: Callable[[], bool] = lambda: False,
) -> Any:
    """Runs steps and returns the final state.

    step, state: as `make_step` and its `init` return them.
    scenes: batches uint8 (B, P, P, C), one for each step.
    noise: standard deviation, for values from 0 to 1; for a `FieldImager` also read and shot noise.
    steps: indices of the steps.
    every: number of steps between reports; between them nothing waits for the device.
    report: report(start, metrics, state), called every `every` steps and at the end, with the
        metrics since step `start` stacked on the first axis.
    stopped: called after each step; True ends the loop early, with a report.
    """
    strength = np.asarray(noise, np.float32)
    pending: list[dict[str, Array]] = []
    for index in steps:
        state, metric = step(state, next(scenes), strength, np.int32(index))
        pending.append(metric)
        stop = stopped()
        if stop or len(pending) == every or index == steps[-1]:
            stacked = {k: np.stack([np.asarray(m[k]) for m in pending]) for k in metric}
            start, pending = index + 1 - len(pending), []
            report(start, stacked, state)
        if stop:
            break
    return state


def evaluate(
    imager: Imager,
    parameters: dict[str, Any],
    patches: np.ndarray,
    distance: float,
    noise: Numbers,
    seed: int,
    batch: int = 32,
) -> dict[str, float]:
    """Image quality over patches, by scikit-image, for values from 0 to 1, not clipped.

    Returns mae and rmse over all values, psnr (dB) and ssim as means over the patches, of the
    restored images; and the same with the prefix `sensor_` of the images in front of the network.

    imager: a function that `make_imager` returns.
    parameters: of optics and network.
    patches: uint8 (N, P, P, C).
    distance: of the object, mm.
    noise: as of `fit`.
    seed: seed of the noise.
    batch: number of patches that are imaged at a time.
    """
    rows: list[dict[str, float]] = []
    for start in range(0, len(patches), batch):
        part = np.asarray(patches[start : start + batch])
        filled = np.concatenate([part, np.zeros((batch - len(part), *part.shape[1:]), np.uint8)])
        key = jax.random.fold_in(jax.random.key(seed), start)
        images = imager(parameters, filled, distance, np.asarray(noise, np.float32), key)[:3]
        for truth, sensor, image in zip(*(np.asarray(a)[: len(part)] for a in images)):
            rows.append(_quality(truth, image, "") | _quality(truth, sensor, "sensor_"))
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    for prefix in ("", "sensor_"):
        means[prefix + "rmse"] = means.pop(prefix + "mse") ** 0.5
    return means


def _quality(truth: np.ndarray, image: np.ndarray, prefix: str) -> dict[str, float]:
    """Quality of one image: mae, mse, psnr (dB) and ssim, with a prefix."""
    similarity = metrics.structural_similarity(truth, image, data_range=1, channel_axis=-1)
    return {
        prefix + "mae": float(np.mean(np.abs(truth - image))),
        prefix + "mse": metrics.mean_squared_error(truth, image),
        prefix + "psnr": metrics.peak_signal_noise_ratio(truth, image, data_range=1),
        prefix + "ssim": similarity,
    }
