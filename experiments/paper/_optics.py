"""The lens of the paper's experiments: the scene, and the trained numbers."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import design, learn
from drt_jax.design.parts import Place, step_of
from drt_jax.lens.scene import checked_scene
from drt_jax.pupil import hexapolar
from drt_jax.rays.solve import solve_aimed
from drt_jax.rays.status import Status
from drt_jax.rays.trace import trace_bundle

from ._common import Colours, require, within
from .runs.config import ConfigError

# Kinds of trained numbers. Tilts and decentres would break the symmetry of the pupil rule;
# semi-diameters would shrink to 0, because the loss does not depend on the throughput.
KINDS = ("sensor", "curvature", "conic", "coefficients", "thickness")
_RINGS = 4  # rings of rays in `Trained.scale`


@dataclasses.dataclass(frozen=True)
class Scene:
    """The lens and the scene that it photographs.

    lens: bundled name or YAML path.
    wavelengths_um: wavelengths of the channels R, G, B.
    tolerance: relative error of the blur, which determines the number of rays.
    field: angle of the object along y, or (x, y), degrees.
    """

    lens: str = "double_gauss"
    wavelengths_um: Colours = (0.6, 0.53, 0.48)
    tolerance: Annotated[float, within(1e-14, 0.5)] = 1e-9
    field: Annotated[float | tuple[float, ...], within(-89, 89)] = 0.0

    def __post_init__(self) -> None:
        one = np.shape(self.field) in ((), (2,))
        require(one, "scene.field: expected one angle in degrees, or [x, y]")

    def seen(self, *distances: float) -> drt_jax.Scene:
        """The object points at one or several distances, mm."""
        far = distances if len(distances) > 1 else distances[0]
        return drt_jax.Scene.point(np.radians(self.field), far, self.wavelengths_um)


def variable_names(names: tuple[str, ...]) -> str:
    """Variables: each is a kind, or a kind and the number of a surface."""
    for name in names:
        kind, _, row = name.partition(" ")
        if kind not in KINDS:
            return f"unknown {kind!r}; known: {', '.join(KINDS)}"
        if kind != name and (not row.isdecimal() or kind == "sensor"):
            return f"expected a kind, or one and a surface, such as curvature 0, got {name!r}"
    return ""


def middle(near: float, far: float) -> float:
    """Harmonic mean of two distances, mm."""
    return near if near == far else 2 / (1 / near + 1 / far)


@dataclasses.dataclass(frozen=True)
class Trained:
    """A lens as a function of its trained numbers: values by name, each in the unit of the lens,
    always with "sensor", mm from the first vertex.

    lens: lens at the start.
    variables: the other trained numbers; None without any.
    moves: True if the sensor is trained.
    """

    lens: drt_jax.Lens
    variables: design.Variables | None
    moves: bool

    @classmethod
    def of(cls, name: str, variables: tuple[str, ...]) -> "Trained":
        """Makes it from the name or path of a lens, and `train.variables`. ConfigError for a
        surface that the lens does not have."""
        lens, moves = drt_jax.load_lens(name), "sensor" in variables
        parts = [name.partition(" ") for name in variables if name != "sensor"]
        try:
            vary = [design.Vary(kind, (int(i),) if i else (), scale=1.0) for kind, _, i in parts]
            return cls(lens, design.Variables.from_lens(lens, vary) if vary else None, moves)
        except ValueError as error:
            raise ConfigError(f"train.{error}") from error

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the trained numbers besides the sensor, such as "curvature 0"."""
        return () if self.variables is None else self.variables.names

    def start(self, sensor: Any) -> dict[str, Array]:
        """Values of the trained numbers at the start. sensor: (...), position of the sensor, mm."""
        values = {"sensor": jnp.asarray(sensor)}
        if self.variables is not None:
            for name, number in zip(self.names, self.variables.start):
                values[name] = jnp.broadcast_to(number, values["sensor"].shape)
        return values

    def lens_of(self, values: Mapping[str, Any]) -> drt_jax.Lens:
        """The lens for values. The position of the sensor is that in `values`, independent of the
        thicknesses."""
        lens, dtype = self.lens, self.lens.curvature.dtype
        if self.variables is not None:
            numbers = [jnp.asarray(values[name], dtype) for name in self.names]
            lens = self.variables.lens_of(jnp.stack(numbers))
        return dataclasses.replace(lens, sensor=jnp.asarray(values["sensor"], dtype))

    def blur(self, scene: Scene, near: float, far: float) -> Callable:
        """Function (values, distance in mm between `near` and `far`) -> moments, by
        `learn.moments_model`; it traces no ray if only the sensor is trained."""
        places = () if self.variables is None else self.variables.places
        leaves = tuple(sorted({"sensor", *(place.kind for place in places)}))
        model = learn.moments_model(self.lens, leaves, scene.seen(near, far), scene.tolerance)[1]

        @jax.jit
        def blur(values: dict[str, Array], distance: Array) -> drt_jax.results.Moments:
            lens = self.lens_of(values)
            return model({name: getattr(lens, name) for name in leaves}, distance)

        return blur if places else model

    def scale(self, scene: Scene, distance: float) -> dict[str, float]:
        """Change of each number, by name and in the unit of the lens, that is equivalent to 1 mm of
        the sensor; 0 for a sensor that is not trained.

        Both change the deviations of the rays from the centroid by the same amount (root mean
        square over pupil and wavelengths, to first order, at the start). One rate in mm is
        therefore suitable for numbers of all units, and no number changes the focus faster than the
        sensor does. In units of the typical step of a design, the change is at most that of 1 mm of
        the sensor; without this bound the conic of a nearly flat surface would change by
        thousands.
        """
        pupil = tuple(jnp.asarray(hexapolar(_RINGS)[0].T, self.lens.curvature.dtype))

        def hits(values: dict[str, Array]) -> tuple[Array, Array]:
            lens = self.lens_of(values)
            seen = checked_scene(lens, scene.seen(distance))
            bundle = trace_bundle(lens, seen, pupil, solve_aimed)
            return jnp.stack([hit[-1] for hit in bundle.hits], axis=-1), bundle.status

        slopes, status = jax.jit(jax.jacfwd(hits, has_aux=True))(self.start(self.lens.sensor))
        passes = np.asarray(status == Status.OK)[..., None]
        spread = {}
        for name, derivative in slopes.items():
            slope = np.asarray(derivative)
            mean = np.sum(slope, axis=1, where=passes) / np.sum(passes, axis=1)
            spread[name] = float(np.sqrt(np.mean((slope - mean[:, None]) ** 2, where=passes)))
            require(spread[name] > 0, f"train.variables: {name} moves no ray; leave it out")
        found = {"sensor": float(self.moves)}
        for name, place in zip(self.names, self.variables.places if self.variables else ()):
            steps = step_of(self.lens, place) / step_of(self.lens, Place("sensor", 0, 0))
            found[name] = min(spread["sensor"] / spread[name], steps)
        return found
