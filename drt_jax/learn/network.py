"""RED-Net, the restoration network of the paper, as a pair (init, apply).

It has five convolutions and five transposed convolutions: 3x3, 64 channels, stride 1, biases, three
bands (RGB) in and out, 298,947 parameters. At stride 1 a transposed convolution is a convolution
with the mirrored kernel, so all ten are convolutions here. Source: Mao, Shen and Yang, NIPS 2016
(ref. 32 of the paper).
"""

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from ..image.wiener import apply_filter
from ..inputs import require
from .convolution import convolve_3x3

Parameters = list[dict[str, Array]]


def red_net(
    layers: int = 5,
    channels: int = 64,
    skip_every: int = 2,
    input_skip: bool = True,
    bands: int = 3,
    dtype: Any = jnp.float32,
) -> tuple[Callable[[Array], Parameters], Callable[[Parameters, Array], Array]]:
    """The network as a pair of functions (init, apply).

    layers: number of convolutions before the middle, and of transposed convolutions behind it.
    channels: number of channels between layers.
    skip_every: n adds the output of every n-th convolution, counted from the middle, to that of its
        mirror image before the ReLU; 0 for no such skips; 2 in the original.
    input_skip: True adds the input to the output, so that the network learns the correction. The
        last layer then starts at a tenth of its usual scale: the network begins near the identity,
        and the first Adam steps do not make the ReLUs inactive. (With a last layer of zeros they
        did, and nothing was learned at a rate of 1e-3.)
    bands: number of bands of the images, such as 3 colours.
    dtype: of parameters and images; float32 by default, even where JAX's default is float64.

    init(key) -> parameters: a list of {"kernel" (3, 3, in, out), "bias" (out,)}. apply(parameters,
    images (B, H, W, bands)) -> restored images of the same shape and dtype. ValueError for numbers
    out of range, and for images of other bands or of another dtype.
    """
    are_right = min(layers, channels, bands) >= 1 and skip_every >= 0
    require(are_right, "layers, channels and bands must be positive, skip_every not negative")
    widths = [bands] + [channels] * (2 * layers - 1) + [bands]

    def init(key: Array) -> Parameters:
        parameters = []
        for i, (fan_in, fan_out) in enumerate(itertools.pairwise(widths)):
            shape = (3, 3, fan_in, fan_out)
            kernel = jax.random.normal(jax.random.fold_in(key, i), shape, dtype)
            scale = (2 / (9 * fan_in)) ** 0.5  # He et al. 2015, for ReLU
            if input_skip and i == 2 * layers - 1:
                scale = 0.1 * scale
            bias = jnp.zeros(fan_out, dtype)
            parameters.append({"kernel": kernel * jnp.asarray(scale, dtype), "bias": bias})
        return parameters

    def apply(parameters: Parameters, images: Array) -> Array:
        kernel = parameters[0]["kernel"]
        if images.shape[-1:] != kernel.shape[2:3] or images.dtype != kernel.dtype:
            what = f"images: expected (B, H, W, {kernel.shape[2]}), {kernel.dtype}, got"
            got = f"{images.shape}, {images.dtype}"
            raise ValueError(f"{what} {got}: see bands and dtype of red_net")
        features = images
        skips: dict[int, Array] = {}
        for i, layer in enumerate(parameters):
            features = convolve_3x3(features, layer["kernel"]) + layer["bias"].reshape(1, 1, 1, -1)
            if i >= layers and (mirror := 2 * layers - 2 - i) in skips:
                features = features + skips[mirror]
            if i < 2 * layers - 1:
                features = jax.nn.relu(features)
            if skip_every and i < layers - 1 and (layers - 1 - i) % skip_every == 0:
                skips[i] = features
        return images + features if input_skip else features

    return init, apply


def filtered(network: tuple[Callable, Callable], taps: Array) -> tuple[Callable, Callable]:
    """A linear filter of many taps followed by a network, as (init, apply); both are trained.

    A network of small kernels cannot restore a wide blur. The best linear filter of the lens, see
    `wiener`, does this in front of the network.

    network: (init, apply), such as `red_net`.
    taps: (T, T, C, C), [y, x, in, out], at the start, in the dtype of the images.

    init(key) -> {"taps", "network"}: give "taps" a smaller rate, such as 1e-5. apply(parameters,
    images (B, H, W, C)) -> restored images (B, H - T + 1, W - T + 1, C), see `apply_filter`.
    """
    init, apply = network

    def begin(key: Array) -> dict[str, Any]:
        return {"taps": taps, "network": init(key)}

    def restore(parameters: dict[str, Any], images: Array) -> Array:
        return apply(parameters["network"], apply_filter(parameters["taps"], images))

    return begin, restore


def count_parameters(parameters: object) -> int:
    """Number of trainable values in a pytree."""
    return sum(leaf.size for leaf in jax.tree.leaves(parameters))
