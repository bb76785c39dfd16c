"""RED-Net, the restoration network of the paper, as a pair (init, apply).

Five convolutions and five transposed convolutions: 3x3, 64 channels, stride 1, biases, RGB in and
out, 298,947 parameters. At stride 1 a transposed convolution is a convolution with the mirrored
kernel, so all ten are convolutions here. Source: Mao, Shen and Yang, NIPS 2016 (ref. 32 of the
paper).
"""

import itertools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array

from .convolution import convolve_3x3

Parameters = list[dict[str, Array]]


def red_net(
    layers: int = 5, channels: int = 64, skip_every: int = 2, input_skip: bool = True
) -> tuple[Callable[[Array], Parameters], Callable[[Parameters, Array], Array]]:
    """The network as (init, apply).

    layers: number of convolutions before the middle, and of transposed ones behind it.
    channels: channels between layers.
    skip_every: n adds the output of every n-th convolution, counted from the middle, to that of
        its mirror image before the ReLU; 0 for no such skips, 2 in the original.
    input_skip: True adds the input to the output, so that the network learns the correction. The
        last layer then starts at a tenth of its usual scale: the network begins near the identity,
        and the first Adam steps do not kill the ReLUs. (At zero they did: nothing was learned at a
        rate of 1e-3.)

    init(key) -> parameters, float32: a list of {"kernel" (3, 3, in, out), "bias" (out,)}.
    apply(parameters, images (B, H, W, 3) float32) -> restored images of the same shape.
    ValueError for numbers out of range.
    """
    if layers < 1 or channels < 1 or skip_every < 0:
        raise ValueError("layers and channels must be positive, skip_every not negative")
    widths = [3] + [channels] * (2 * layers - 1) + [3]

    def init(key: Array) -> Parameters:
        parameters = []
        for i, (fan_in, fan_out) in enumerate(itertools.pairwise(widths)):
            shape = (3, 3, fan_in, fan_out)
            kernel = jax.random.normal(jax.random.fold_in(key, i), shape, jnp.float32)
            scale = (2 / (9 * fan_in)) ** 0.5  # He et al. 2015, for ReLU
            if input_skip and i == 2 * layers - 1:
                scale = 0.1 * scale
            bias = jnp.zeros(fan_out, jnp.float32)
            parameters.append({"kernel": kernel * jnp.float32(scale), "bias": bias})
        return parameters

    def apply(parameters: Parameters, images: Array) -> Array:
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


def count_parameters(parameters: object) -> int:
    """Number of trainable values in a pytree."""
    return sum(leaf.size for leaf in jax.tree.leaves(parameters))
