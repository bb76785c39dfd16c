"""The lens of the paper's experiments: what is photographed through it, and what of it is
trained."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import design
from drt_jax.design.kinds import step_of
from drt_jax.pupil import hexapolar
from drt_jax.rays.solve import solve_aimed
from drt_jax.rays.status import Status
from drt_jax.rays.trace import trace_bundle

from ._common import require, require_known, require_within
from .runs.config import ConfigError

# Kinds of numbers that may be trained. Tilts and decentres would break the symmetry for which the
# rays are chosen; semi-diameters would shrink to nothing, as that costs an image no light here.
KINDS = ("sensor", "curvature", "conic", "coefficients", "thickness")
_RINGS = 4  # of the rays by which numbers are compared


@dataclasses.dataclass(frozen=True)
class Scene:
    """What is photographed, and through which lens.

    lens: bundled name or YAML path. wavelengths_um: of the three channels, R, G, B. tolerance:
    relative error of the blur that fixes the number of rays. field: of the object in degrees, one
    angle along y or (x, y).
    """

    lens: str = "double_gauss"
    wavelengths_um: tuple[float, ...] = (0.6, 0.53, 0.48)
    tolerance: float = 1e-9
    field: float | tuple[float, ...] = 0.0

    def __post_init__(self) -> None:
        require(len(self.wavelengths_um) == 3, "scene.wavelengths_um: expected three, for R, G, B")
        limits = {"wavelengths_um": (1e-4, 1e6), "tolerance": (1e-14, 0.5), "field": (-89, 89)}
        require_within("scene.", self, **limits)
        one = np.shape(self.field) in ((), (2,))
        require(one, "scene.field: expected one angle in degrees, or [x, y]")

    def seen(self, distance: float) -> tuple[np.ndarray, float, tuple[float, ...]]:
        """Field in radians, distance in mm and wavelengths, as functions of drt_jax take them."""
        return np.radians(self.field), distance, self.wavelengths_um


def check_variables(names: tuple[str, ...]) -> None:
    """ConfigError for a list of variables that has none, one twice, or of no kind."""
    what = "train.variables"
    require(len(names) > 0, f"{what}: needs at least one item")
    require(len(set(names)) == len(names), f"{what}: an item stands twice")
    for name in names:
        kind, _, row = name.partition(" ")
        require_known(what, (kind,), KINDS)
        good = kind == name or (row.isdecimal() and kind != "sensor")
        expected = f"{what}: expected a kind, or one and a surface, such as curvature 0"
        require(good, f"{expected}, got {name!r}")


def middle(near: float, far: float) -> float:
    """The distance between two, in mm, in the middle of their reciprocals."""
    return near if near == far else 2 / (1 / near + 1 / far)


def spot_of(scene: Scene, lens: drt_jax.Lens, distance: float) -> dict[str, float]:
    """RMS radius in um of the spot of all colours about their mean centroid, and the least share of
    the light of one that arrives, with the rays that this lens needs."""
    found = drt_jax.psf_moments(lens, *scene.seen(distance), scene.tolerance)
    mean, covariance = np.asarray(found.mean), np.asarray(found.covariance)
    squares = np.trace(covariance, axis1=1, axis2=2)
    squares = squares + np.sum((mean - mean.mean(axis=0)) ** 2, axis=1)
    return {"rms_um": 1e3 * math.sqrt(squares.mean()), "light": float(np.min(found.throughput))}


@dataclasses.dataclass(frozen=True)
class Trained:
    """A lens as a function of the numbers of it that are trained: values by name, each in the unit
    of the lens. "sensor" is always among them, mm from the first vertex.

    lens: at the start. variables: the others, None if there are none. moves: whether the sensor is
    trained.
    """

    lens: drt_jax.Lens
    variables: design.Variables | None
    moves: bool

    @classmethod
    def of(cls, name: str, variables: tuple[str, ...]) -> "Trained":
        """Of a lens by its name or path, and `train.variables`. ConfigError for a surface that the
        lens has not."""
        lens, moves = drt_jax.load_lens(name), "sensor" in variables
        parts = [name.partition(" ") for name in variables if name != "sensor"]
        try:
            vary = [design.Vary(kind, (int(i),) if i else (), scale=1.0) for kind, _, i in parts]
            return cls(lens, design.Variables.from_lens(lens, vary) if vary else None, moves)
        except ValueError as error:
            raise ConfigError(f"train.{error}") from error

    @property
    def names(self) -> tuple[str, ...]:
        """Of what is trained beside the sensor's position, such as "curvature 0"."""
        return () if self.variables is None else self.variables.names

    def start(self, sensor: Any) -> dict[str, Array]:
        """The values of the lens, with the sensor at (...) mm."""
        values = {"sensor": jnp.asarray(sensor)}
        if self.variables is not None:
            for name, number in zip(self.names, self.variables.start):
                values[name] = jnp.broadcast_to(number, values["sensor"].shape)
        return values

    def lens_of(self, values: Mapping[str, Any]) -> drt_jax.Lens:
        """The lens of some values. The sensor stays where it is told, whatever moves before it."""
        lens, dtype = self.lens, self.lens.curvature.dtype
        if self.variables is not None:
            numbers = [jnp.asarray(values[name], dtype) for name in self.names]
            lens = self.variables.lens_of(jnp.stack(numbers))
        return dataclasses.replace(lens, sensor=jnp.asarray(values["sensor"], dtype))

    def blur(self, scene: Scene, near: float, far: float) -> Callable:
        """(values, distance in mm from `near` to `far`) to the moments, as of
        `drt_jax.moments_model`; with the sensor alone no ray is traced inside."""
        field, _, colours = scene.seen(near)
        places = () if self.variables is None else self.variables.places
        leaves = tuple(sorted({"sensor", *(place.kind for place in places)}))
        model = drt_jax.moments_model(
            self.lens, leaves, field, (near, far), colours, scene.tolerance
        )[1]

        @jax.jit
        def blur(values: dict[str, Array], distance: Array) -> drt_jax.Moments:
            lens = self.lens_of(values)
            return model({name: getattr(lens, name) for name in leaves}, distance)

        return blur if places else model

    def scale(self, scene: Scene, distance: float) -> dict[str, float]:
        """By name: the change, in the unit of the lens, that counts as 1 mm of the sensor. 0 for a
        sensor that is not trained.

        That which moves the rays on the sensor about their centroid as far as the sensor's does,
        root of the mean square over pupil and colours, to first order, at the start; so one rate
        in mm serves all units, and none spoils the focus faster than another. At most as many
        typical steps of a design as 1 mm is of the sensor's: a conic of a nearly flat surface
        would have to change by thousands.
        """
        pupil = tuple(jnp.asarray(hexapolar(_RINGS)[0].T, self.lens.curvature.dtype))

        def hits(values: dict[str, Array]) -> tuple[Array, Array]:
            lens = self.lens_of(values)
            given = drt_jax.scene_of(lens, *scene.seen(distance))
            bundle = trace_bundle(lens, given, pupil, solve_aimed)
            return jnp.stack([hit[-1] for hit in bundle.hits], axis=-1), bundle.status

        slopes, status = jax.jit(jax.jacfwd(hits, has_aux=True))(self.start(self.lens.sensor))
        good = np.asarray(status == Status.OK)[..., None]
        wide = {}
        for name, slope in slopes.items():
            moved = np.asarray(slope)
            middle = np.sum(moved, axis=1, where=good) / np.sum(good, axis=1)
            wide[name] = float(np.sqrt(np.mean((moved - middle[:, None]) ** 2, where=good)))
            require(wide[name] > 0, f"train.variables: {name} moves no ray; leave it out")
        found = {"sensor": float(self.moves)}
        for name, place in zip(self.names, self.variables.places if self.variables else ()):
            steps = step_of(self.lens, *place) / step_of(self.lens, "sensor", 0, 0)
            found[name] = min(wide["sensor"] / wide[name], steps)
        return found
