"""Lens and network trained together over the field and over depth.

Each step draws new object points. Patches are blurred by the kernels of these points, and pass
through the sensor layer and the network.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax import Array

from ..image.sensor import convolve_each, noise_of
from ..inputs import require
from ..numerics import Numbers
from .adam import adam, apply_updates, copied
from .error import Last, Restore, mean_error, restored
from .train import compiled_step, truth_of

# A function from the optics and object points to kernels (P, C, K, K), and to the light (P, C) on
# the sensor relative to a constant of the camera.
Points = Callable[[Any, "ObjectPoints"], tuple[Array, Array]]
# A function from the optics before and after an update to optics that can be built.
Hold = Callable[[Any, Any], Any]


@dataclasses.dataclass(frozen=True)
class FieldImager:
    """The chain kernels -> sensor layer -> network, for patches anywhere in the field.

    points: function that returns kernels and light of object points, for instance by `psf`.
    restore: (weights, images) -> images, each from its own image alone; None for a camera without a
        network.
    convolve: (scenes, kernels) -> images as `convolve_each`, or that function shared by devices.
    dtype: of scenes and images. Kernels are made in the dtype of the lens and cast to it. A network
        of your own must have the same dtype: under `jax_enable_x64` libraries make their weights in
        float64.
    """

    points: Points
    restore: Restore | None = None
    convolve: Callable[[Array, Array], Array] = convolve_each
    dtype: Any = jnp.float32

    def sensor(
        self, optics: Any, scenes: Array, seen: "ObjectPoints", noise: Numbers, key: Array
    ) -> Array:
        """Sensor images (B, H, W, C), in the dtype of the scenes, with even brightness.

        Where the lens transmits less light, the gain of the sensor amplifies the noise.

        optics: parameters of the lens.
        scenes: floating (B, H + K - 1, W + K - 1, C), values from 0 to 1; patch b shows point b P
            // B.
        seen: the P object points; B is a multiple of P.
        noise: standard deviation of read noise, (), or of read and shot noise, (2,), see
            `noise_of`.
        key: a PRNG key.
        """
        count = seen.fields.shape[0]
        what = f"scenes: {scenes.shape[0]} patches cannot be shared among {count} points"
        require(scenes.shape[0] % count == 0, f"{what}: give a multiple")
        each = scenes.shape[0] // count
        kernels, light = self.points(optics, seen)
        image = self.convolve(scenes, kernels.repeat(each, axis=0))
        light = light.astype(image.dtype).repeat(each, axis=0)[:, None, None, :]
        white = jax.random.normal(key, image.shape, image.dtype)
        return image + noise_of(noise, light, image) * white

    def __call__(
        self,
        parameters: dict[str, Any],
        scenes: Array,
        seen: "ObjectPoints",
        noise: Numbers,
        key: Array,
        last: Last = restored,
    ) -> tuple[Array, Array, Array]:
        """True, sensor and restored images (B, H, W, C), in the dtype of the imager. All three are
        cut to the part that the network restores, such as the middle.

        parameters: "optics", and "network" for a network.
        scenes: uint8 (B, H + K - 1, W + K - 1, C).
        seen, noise, key: as in `sensor`.
        last: function whose result replaces the restored images, such as `mean_error`, ().
        """
        real = scenes.astype(self.dtype) / 255
        image = self.sensor(parameters["optics"], real, seen, noise, key)
        restore, weights = self.restore, parameters.get("network")
        found = image if restore is None else jax.eval_shape(restore, weights, image)
        truth = truth_of(real, found)
        return truth, truth_of(image, found), last(restore, weights, image, truth)


class ObjectPoints(NamedTuple):
    """Object points of a step.

    fields: (P, 2), radians.
    distances: (P,), mm.
    deviations: of the parts of the lens as built, for `FieldImager.points`; None for the nominal
        lens.
    """

    fields: Array
    distances: Array
    deviations: Any = None


def draw_points(key: Array, count: int, field: float, depths: tuple[float, float]) -> ObjectPoints:
    """Random object points over a circular field and a range of depths.

    The field has one point in each of `count` rings of equal area, at a random azimuth. The range
    of 1 / distance has one point in each of `count` equal intervals, in a random order.

    key: a PRNG key.
    count: number of points P.
    field: largest angle, radians.
    depths: nearest and farthest distance, mm; may be inf.
    """
    ring, turn, depth, order = jax.random.split(key, 4)
    kind = jnp.result_type(float)
    part = (jnp.arange(count, dtype=kind) + jax.random.uniform(ring, (count,), kind)) / count
    radius = jnp.tan(jnp.asarray(field, kind)) * jnp.sqrt(part)
    angle = 2 * jnp.pi * jax.random.uniform(turn, (count,), kind)
    tangents = radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    part = (jnp.arange(count, dtype=kind) + jax.random.uniform(depth, (count,), kind)) / count
    near, far = (1 / d for d in depths)
    vergence = jax.random.permutation(order, near + (far - near) * part)
    distances = jnp.where(vergence > 0, 1 / jnp.where(vergence > 0, vergence, 1), jnp.inf)
    return ObjectPoints(jnp.arctan(tangents), distances)


class _Adam(NamedTuple):
    """Adam on all numbers of the optics, kept within what can be built. rates: see `adam`."""

    rates: Any
    hold: Hold

    def init(self, optics: Any) -> Any:
        return adam({"optics": self.rates})[0]({"optics": optics})

    def update(self, gradient: Any, state: Any, optics: Any) -> tuple[Any, Any]:
        updates, state = adam({"optics": self.rates})[1]({"optics": gradient}, state)
        return self.hold(optics, apply_updates(optics, updates["optics"])), state


@runtime_checkable
class LensSteps(Protocol):
    """An optimiser of the vector of a lens that keeps its limits itself, such as
    `design.RaySteps`."""

    def init(self, vector: Array) -> Any:
        """The state before the first step."""

    def update(self, gradient: Array, state: Any, vector: Array) -> tuple[Array, Any]:
        """The next vector and state."""


class _OfLens(NamedTuple):
    """Steps of the vector "lens" of the optics."""

    steps: LensSteps

    def init(self, optics: Any) -> Any:
        return self.steps.init(optics["lens"])

    def update(self, gradient: Any, state: Any, optics: Any) -> tuple[Any, Any]:
        vector, state = self.steps.update(gradient["lens"], state, optics["lens"])
        return optics | {"lens": vector}, state


def make_field_step(
    imager: FieldImager,
    rates: dict[str, Any],
    draw: Callable[[Array], ObjectPoints],
    seed: int,
    hold: Hold = lambda before, after: after,
) -> tuple[Callable, Callable]:
    """A step of lens and network on the mean absolute error, as (init, step) for `fit`.

    imager: the camera.
    rates: of "network", Adam's learning rates, see `adam`; of "optics", the same, or `LensSteps`
        such as `design.RaySteps`, for optics {"lens": vector of the variables}.
    draw: function that returns the object points of a step from a PRNG key, for instance by
        `draw_points`.
    seed: points and noise depend only on it and on the index of the step.
    hold: function that keeps the optics within limits after a step of Adam, see
        `design.within_limits`.

    init(parameters) -> state; step(state, scenes, noise, index) -> (state, metrics), jitted, with
    the state donated. metrics: loss, (). Parameters without "network" train the optics alone.
    """
    init_adam, update = adam(_weights(rates))
    of = rates["optics"]
    optics = _OfLens(of) if isinstance(of, LensSteps) else _Adam(of, hold)

    def init(parameters: dict[str, Any]) -> tuple[Any, Any, Any]:
        parameters = copied(parameters)
        return parameters, init_adam(_weights(parameters)), optics.init(parameters["optics"])

    def step(state: tuple[Any, Any, Any], scenes: Array, noise: Array, index: Array):
        parameters, moments, means = state
        seen, noise_key = _drawn(draw, seed, index)

        def loss(parameters):
            return imager(parameters, scenes, seen, noise, noise_key, last=mean_error)[2]

        error, gradients = jax.value_and_grad(loss)(parameters)
        updates, moments = update(_weights(gradients), moments)
        new = apply_updates(_weights(parameters), updates)
        new["optics"], means = optics.update(gradients["optics"], means, parameters["optics"])
        return (new, moments, means), {"loss": error}

    return init, compiled_step(step)


def _drawn(
    draw: Callable[[Array], ObjectPoints], seed: int, index: Array
) -> tuple[ObjectPoints, Array]:
    """The object points of a step, and the key of its noise."""
    noise_key, key = jax.random.split(jax.random.fold_in(jax.random.key(seed), index))
    return draw(key), noise_key


def _weights(parameters: dict[str, Any]) -> dict[str, Any]:
    """The parameters without the optics."""
    return {name: value for name, value in parameters.items() if name != "optics"}
