"""The scene: object points and wavelengths."""

import contextlib
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import Numbers, concrete, known_array, real_array
from .lens import Lens

_RIGHT, _DEGREE = np.pi / 2, np.pi / 180
# The d line of helium, um.
D_LINE = 0.5875618
# Smallest distance of an object in front of the first vertex or behind it, mm: the square of
# 1 / distance is still finite in float32.
NEAREST = 1e-6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Scene:
    """Where light comes from, and in which colours: object points and wavelengths.

    field: (..., 2), angles along x and y, radians: light travels along (tan x, tan y, 1).
    distance: (...), from the object plane to the first vertex, mm; inf, or -inf, for an object at
        infinity. Below 0 for a virtual object: light that converges to a point behind the first
        vertex.
    wavelengths: (W,), um.
    wavelength_weights: (W,), of any sum; None for equal weights.
    field_weights: (F,), of any sum, for a design problem; None for equal weights.

    `field[..., 0]` and `distance` broadcast to the shape of the points: () for one point, (P,) for
    P points, (Z, F) for every field at every distance. Results of analyses have this shape as their
    first axes, then that of the wavelengths. All fields are leaves of a pytree.
    """

    field: Array
    distance: Array
    wavelengths: Array
    wavelength_weights: Array | None = None
    field_weights: Array | None = None

    @classmethod
    def point(
        cls,
        field: Numbers = 0.0,
        distance: Numbers = np.inf,
        wavelengths: Numbers = D_LINE,
        **weights: Numbers | None,
    ) -> "Scene":
        """One field: a point, or points at several distances.

        field: one angle (along y) or two (x, y), radians.
        distance: () or (Z,), mm.
        wavelengths: one or (W,), um.
        weights: `wavelength_weights`.

        ValueError for other shapes, for anything that is not a real number, and for known numbers
        that are not possible: an angle of 90 degrees or more, a distance within 1e-6 mm of 0.
        """
        angles = known_angles("field", field)
        shape, far = angles.shape, np.shape(known_array("distance", distance))
        require(shape in ((), (2,)), f"field: expected one angle or two, got shape {shape}")
        require(len(far) < 2, f"distance: expected one number or (Z,), got shape {far}")
        return cls._made(angles if angles.ndim else _pairs(angles), distance, wavelengths, weights)

    @classmethod
    def radians(
        cls,
        fields: Numbers,
        distance: Numbers = np.inf,
        wavelengths: Numbers = D_LINE,
        **weights: Numbers | None,
    ) -> "Scene":
        """Points at several fields.

        fields: (F,) along y, or pairs (F, 2) along x and y, radians; one number for one point.
        distance: one, or (F,) with one for each field, mm.
        wavelengths: one or (W,), um.
        weights: `wavelength_weights` (W,) and `field_weights` (F,).

        ValueError as of `point`.
        """
        return cls._made(_fields(known_angles("fields", fields)), distance, wavelengths, weights)

    @classmethod
    def degrees(cls, fields: Numbers, *others: Any, **named: Any) -> "Scene":
        """`radians` of fields in degrees."""
        return cls.radians(known_array("fields", fields) * _DEGREE, *others, **named)

    @classmethod
    def heights(cls, heights: Numbers, distance: Numbers, *others: Any, **named: Any) -> "Scene":
        """`radians` of object points at heights above the axis: (F,) or (F, 2), mm, at a finite
        distance."""
        return cls.radians(field_of_height(heights, distance), distance, *others, **named)

    @classmethod
    def grid(
        cls,
        fields: Numbers,
        distances: Numbers,
        wavelengths: Numbers = D_LINE,
        **weights: Numbers | None,
    ) -> "Scene":
        """Every field at every distance: points of the shape (Z, F).

        fields, wavelengths, weights: as in `radians`.
        distances: one or (Z,), mm.
        """
        far = known_array("distances", distances).reshape(-1, 1)
        angles = _fields(known_angles("fields", fields))
        return cls._made(angles.reshape(-1, 2), far, wavelengths, weights)

    @classmethod
    def _made(
        cls, angles: Any, distance: Numbers, wavelengths: Numbers, weights: dict[str, Any]
    ) -> "Scene":
        """A scene of angles (..., 2)."""
        far, waves = known_array("distance", distance), known_array("wavelengths", wavelengths)
        _check_distance(distance)
        waves = waves.reshape(1) if waves.ndim == 0 else waves
        shares = {n: None if w is None else known_array(n, w) for n, w in weights.items()}
        return cls(angles, far, waves, **shares)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the points."""
        return np.broadcast_shapes(np.shape(self.field)[:-1], np.shape(self.distance))

    @property
    def spectrum(self) -> Array:
        """Weights of the wavelengths, (W,), of any sum."""
        own = self.wavelength_weights
        return jnp.ones_like(self.wavelengths) if own is None else own

    def at(self, field: Array, distance: Array | None = None) -> "Scene":
        """The same colours from another field (..., 2), and from another distance (...)."""
        distance = self.distance if distance is None else distance
        return Scene(field, distance, self.wavelengths, self.wavelength_weights)

    def reference(self, index: int | None) -> int:
        """The index of the reference wavelength: the middle one, W // 2, for None.

        ValueError for an index out of range.
        """
        count = len(self.wavelengths)
        found = count // 2 if index is None else index
        is_index = -count <= found < count
        require(is_index, f"reference: expected an index of the wavelengths, got {index!r}")
        return found

    def with_axis(self) -> "Scene":
        """The points of a scene with one distance as (1 + F,): the axis, then the fields.

        ValueError for several distances.
        """
        shape = np.shape(self.distance)
        require(not shape, f"distance: expected one for all fields, got shape {shape}")
        return self.at(jnp.pad(self.field.reshape(-1, 2), ((1, 0), (0, 0))))

    def each(self) -> "list[Scene]":
        """The points, one by one; of known numbers as NumPy arrays."""
        fields, far = self.flat()
        return [self.at(fields[k], far[k]) for k in range(len(far))]

    def flat(self) -> tuple[Array, Array]:
        """Field (P, 2) and distance (P,) of all points; of known numbers as NumPy arrays."""
        there = np if concrete((self.field, self.distance)) else jnp
        fields = there.broadcast_to(self.field, (*self.shape, 2))
        return fields.reshape(-1, 2), there.broadcast_to(self.distance, self.shape).reshape(-1)

    @property
    def possible(self) -> Array:
        """True if light from the object can enter the lens, (...), bool.

        This needs angles below 90 degrees and a distance other than 0. In a trace, the rays of
        other scenes are MISSED.
        """
        return jnp.all(ahead(self.field), axis=-1) & away_from_vertex(self.distance)

    @property
    def tangent(self) -> Array:
        """Tangents (..., 2) of the field angles; 0 for an angle of 90 degrees or more."""
        return jnp.tan(jnp.where(ahead(self.field), self.field, 0))

    @property
    def vergence(self) -> Array:
        """1 / distance, (...), 1/mm; 0 for a distance of 0."""
        return vergence_of(self.distance)


def ahead(angle: Array) -> Array:
    """True where light at an angle to the axis (...), radians, travels forwards, bool."""
    return jnp.abs(angle) < _RIGHT


def away_from_vertex(distance: Array) -> Array:
    """True where an object at a distance (...), mm, does not lie at the first vertex, bool."""
    return jnp.abs(distance) >= NEAREST


def vergence_of(distance: Array) -> Array:
    """1 / distance (...), 1/mm; 0 for a distance of 0."""
    good = away_from_vertex(distance)
    return jnp.where(good, 1 / jnp.where(good, distance, 1), 0)


def checked_scene(lens: Lens, scene: Scene) -> Scene:
    """A scene as arrays in the dtype of a lens. Known numbers stay known inside `jit`.

    ValueError for what is not a `Scene`, for a lens whose arrays do not fit together, for points
    and weights of the wrong shape, and, as far as values are known, for numbers that are not
    possible, see `Scene.point`, and for a wavelength outside the range of a glass.
    """
    what = "scene: expected a Scene, such as Scene.degrees([0, 14], wavelengths=0.55), got a"
    require(isinstance(scene, Scene), f"{what} {type(scene).__name__}")
    lens.check()
    dtype = lens.curvature.dtype

    def array(what: str) -> Array:
        """Numbers of the scene; known ones stay known inside `jit`."""
        numbers = getattr(scene, what)
        with jax.core.eval_context() if concrete(numbers) else contextlib.nullcontext():
            found = real_array(what, numbers, dtype)
            return found if found.ndim or not what.startswith("wavelength") else found[None]

    lens.checked_wavelengths(scene.wavelengths)  # ValueError
    waves = array("wavelengths")
    weights = None if scene.wavelength_weights is None else array("wavelength_weights")
    if weights is not None and weights.shape != waves.shape:
        raise ValueError(f"wavelength_weights: expected {waves.shape}, got {weights.shape}")
    known_angles("field", scene.field)
    _check_distance(scene.distance)
    field, distance = array("field"), array("distance")
    require(field.shape[-1:] == (2,), f"field: expected (..., 2), got shape {field.shape}")
    try:
        np.broadcast_shapes(field.shape[:-1], distance.shape)
    except ValueError:
        what = f"distance: expected one, or one for each of the fields {field.shape[:-1]}"
        raise ValueError(f"{what}, got shape {distance.shape}") from None
    return Scene(field, distance, waves, weights, scene.field_weights)


def over_points(function: Callable[..., Any], scene: Scene, *others: Any) -> Any:
    """A function of one object point, evaluated for all points of a scene. Its results get the
    shape of the points as their first axes.

    function: takes a scene of one point, and the entries of `others` for that point.
    scene: arrays, as `checked_scene` returns them.
    others: trees of arrays with the P points on the first axis, if the scene has several.
    """
    if not scene.shape:
        return function(scene, *others)
    # If there is one distance, all points share what follows from it.
    points = scene.flat() if scene.distance.ndim else (scene.field.reshape(-1, 2),)
    found = jax.vmap(lambda point, *own: function(scene.at(*point), *own))(points, *others)
    return jax.tree.map(lambda a: a.reshape(*scene.shape, *a.shape[1:]), found)


def known_angles(what: str, values: Numbers) -> Any:
    """Angles as an array (...), radians. ValueError for a known angle of 90 degrees or more."""
    found = known_array(what, values)
    for angle in _known(values):
        if not abs(angle) < _RIGHT:
            raise ValueError(
                f"{what}: {angle:g} rad = {np.degrees(angle):.4g} degrees, must be below 90; "
                "Scene.degrees takes degrees"
            )
    return found


def _pairs(angles: Any) -> Any:
    """Pairs (..., 2) of the angles (...) along y."""
    there = np if isinstance(angles, np.ndarray) else jnp
    return there.stack([there.zeros_like(angles), angles], axis=-1)


def _fields(angles: Any) -> Any:
    """Pairs (F, 2), or (2,), of angles: (F,) or () along y, or pairs (F, 2)."""
    pairs = _pairs(angles) if angles.ndim < 2 else angles
    is_list = pairs.shape[-1] == 2 and pairs.size and pairs.ndim <= 2
    require(is_list, f"fields: expected (F,) or (F, 2), got shape {angles.shape}")
    return pairs


def _check_distance(distance: Numbers) -> None:
    """ValueError for a known distance within 1e-6 mm of 0."""
    for value in _known(distance):
        if not abs(value) >= np.float32(NEAREST):  # 1e-6 in float32, too
            raise ValueError(
                f"distance: must be {NEAREST:g} mm or more, inf for an object at infinity, below "
                f"0 for light that converges to a point behind the first vertex; got {value:g}"
            )


def distance_array(distance: Numbers, dtype: Any) -> Array:
    """A distance as an array (), mm.

    ValueError for other shapes, for anything that is not a number, and for a known distance within
    1e-6 mm of 0.
    """
    far = real_array("distance", distance, dtype)
    require(not far.ndim, f"distance: expected one number, got shape {far.shape}")
    _check_distance(distance)
    return far


def _known(values: Numbers) -> list[float]:
    """The values as a list; empty inside a trace."""
    return np.ravel(np.asarray(values, float)).tolist() if concrete(values) else []


def field_of_height(height: Numbers, distance: Numbers) -> Array:
    """Field angle (...) of an object point, radians.

    The angle is negative for a point above the axis, from which light travels downwards.

    height: (...), of the object point above the axis, mm.
    distance: (), from the object plane to the first vertex, finite, mm.

    ValueError for a known distance that is 0 or not finite. Inside a trace the angle is then 90
    degrees, from which no light enters the lens.
    """
    heights = real_array("height", height, float)
    far = distance_array(distance, float)
    is_far = np.inf in np.abs(_known(distance))
    require(not is_far, "distance: at infinity an object has a field, but no height")
    good = away_from_vertex(far) & (jnp.abs(far) < jnp.inf)
    return jnp.where(good, -jnp.arctan(heights / jnp.where(good, far, 1)), _RIGHT)
