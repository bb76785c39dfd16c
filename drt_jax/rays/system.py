"""The traced system: the active surfaces in their positions, and the stop as a label of rays.

A vector is a tuple of components: (y,) for rays in the meridional plane (D = 1) or (x, y) for other
rays (D = 2). A vector of D + 1 components also has z. Each component is an array with one number
for each ray. Components are separate arrays because XLA fuses sums of components into a few long
loops, whereas a sum over an array axis becomes a library call.
"""

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import Shape
from ..lens.lens import Lens
from ..lens.scene import Scene
from ..numerics import matmul, safe_divide

Vector = tuple[Array, ...]
_MM_PER_UM = 1e-3


def dot(a: Any, b: Any) -> Array:
    """Dot product of two vectors with the same number of components."""
    first, *others = (x * y for x, y in zip(a, b, strict=True))
    return sum(others, first)


def add(a: Any, b: Any) -> Vector:
    """Sum of two vectors with the same number of components."""
    return tuple(x + y for x, y in zip(a, b, strict=True))


def subtract(a: Any, b: Any) -> Vector:
    """Difference of two vectors with the same number of components."""
    return tuple(x - y for x, y in zip(a, b, strict=True))


def along(a: Any, length: Any, b: Any) -> Vector:
    """The vector a + length b, as a point on a line from `a` in the direction `b`."""
    return tuple(x + length * y for x, y in zip(a, b, strict=True))


def where(mask: Array, a: Any, b: Any) -> Any:
    """A vector, or another pytree, that is `a` for the rays of a mask and `b` for other rays.

    b: of the structure of `a`, or one number for all components.
    """
    if isinstance(b, int | float):
        return jax.tree.map(lambda x: jnp.where(mask, x, b), a)
    return jax.tree.map(lambda x, y: jnp.where(mask, x, y), a, b)


def determinant(rows: Any) -> Array:
    """Determinant of a 2 x 2 matrix given as rows; 1 for a 1 x 1 matrix.

    The sign of a 2 x 2 determinant shows whether a map is folded (mirrored). The sign of a 1 x 1
    matrix does not, hence the constant 1.
    """
    if len(rows) == 1:
        return jnp.ones_like(rows[0][0])
    (p, q), (r, s) = rows
    return p * s - q * r


def divide(rows: Any, b: Vector) -> Vector:
    """Solves rows x = b for 1 or 2 unknowns by Cramer's rule; returns 0 where the matrix is
    singular.
    """
    if len(b) == 1:
        return (safe_divide(b[0], rows[0][0]),)
    (p, q), (r, s) = rows
    size = determinant(rows)
    x, y = s * b[0] - q * b[1], p * b[1] - r * b[0]
    return safe_divide(x, size), safe_divide(y, size)


def rotate(rotation: Array | None, vector: Vector, back: bool = False) -> Vector:
    """Rotates a vector from the axes of its surface to those of the lens.

    rotation: (3, 3), or (R, 3, 3) for components (R, ...); None if both have the same axes.
    vector: 3 components.
    back: True for the inverse rotation, from the axes of the lens to those of the surface.
    """
    if rotation is None:
        return vector
    extra = (1,) * (vector[0].ndim + 2 - rotation.ndim)
    rows = [[rotation[..., i, j] for j in range(3)] for i in range(3)]
    rows = [[a.reshape(*a.shape, *extra) for a in row] for row in rows]
    return tuple(dot(row, vector) for row in (zip(*rows, strict=True) if back else rows))


class Placed(NamedTuple):
    """R surfaces in their positions; a single surface has arrays without the first axis.

    vertex: (R,), z of the vertices along the axis of the lens, mm.
    curvature: (R,), 1/mm.
    conic: (R,).
    coefficients: (R, K), see `lens.forms`.
    offset: (R, 2), x and y of the vertices, mm; None for none.
    rotation: (R, 3, 3), from the axes of the surfaces to those of the lens; None for none.
    station: (R,), z of the vertices before elements are moved, mm; None for `vertex`.
    """

    vertex: Array
    curvature: Array
    conic: Array
    coefficients: Array
    offset: Array | None
    rotation: Array | None
    station: Array | None = None

    @property
    def axial(self) -> Array:
        """z of the vertices (R,) for paraxial optics, mm."""
        return self.vertex if self.station is None else self.station

    @property
    def shape(self) -> Shape:
        """Curvature, conic and coefficients (K, ...), which broadcast against rays."""
        return Shape(self.curvature, self.conic, jnp.moveaxis(self.coefficients, -1, 0))

    @property
    def wide(self) -> Shape:
        """The shape with axes that broadcast against (surface, wavelength, ray)."""
        return Shape(*(a[..., None, None] for a in self.shape))

    def on(self, like: Array) -> Shape:
        """The shape with every number broadcast to (surface, wavelength, ray) as `like` has."""
        return jax.tree.map(lambda a: jnp.broadcast_to(a, (*a.shape[:-3], *like.shape)), self.wide)

    def origin(self, dim: int) -> Vector:
        """The vertices as vectors of `dim` + 1 components, mm along the axes of the lens."""
        zero = jnp.zeros_like(self.vertex)
        offset = (zero,) * dim if self.offset is None else tuple(jnp.moveaxis(self.offset, -1, 0))
        return *offset, self.vertex

    def local(self, point: Vector, direction: Vector) -> tuple[Vector, Vector]:
        """A line in the axes of one surface, with the origin at its vertex.

        point: D + 1 components along the axes of the lens, mm.
        direction: D + 1 components along the axes of the lens.
        """
        shifted = subtract(point, self.origin(len(point) - 1))
        back = functools.partial(rotate, self.rotation, back=True)
        return back(shifted), back(direction)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Diffraction:
    """Phase functions on N rows of a system.

    phase: curvature and conic (N,), coefficients (K, N) of the phase, in waves.
    wave: (N, W, 1), or (N,) for one ray: optical path added per wave of phase, order times
        wavelength, mm.

    Static:
    rows: N indices of rows.
    forms: N names of forms of the phase.
    """

    phase: Shape
    wave: Array
    rows: tuple[int, ...] = dataclasses.field(metadata={"static": True})
    forms: tuple[str, ...] = dataclasses.field(metadata={"static": True})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class System:
    """All numbers that the path of a ray depends on; the differentiable arguments.

    rows: the R = L + 1 rows: L active surfaces (refracting, reflecting or diffracting) and the
        sensor.
    stop: the stop in its position if it is not an active surface, else None.
    index: (R, W, 1), or (R,) for a single ray: refractive index in front of each row.
    source: (D + 1,), the object point divided by its distance; its last component is -1.
    vergence: (), 1/distance, 1/mm; 0 for infinity.
    diffraction: the rows with a phase; None for none.

    Static:
    before: number of active surfaces in front of the stop.
    forms: R names of forms.
    stop_form: name of the form of the stop.
    mirrors: L booleans, True for a reflecting surface.
    """

    rows: Placed
    stop: Placed | None
    index: Array
    source: Array
    vergence: Array
    diffraction: Diffraction | None
    before: int = dataclasses.field(metadata={"static": True})
    forms: tuple[str, ...] = dataclasses.field(metadata={"static": True})
    stop_form: str = dataclasses.field(metadata={"static": True})
    mirrors: tuple[bool, ...] = dataclasses.field(metadata={"static": True})

    @property
    def dim(self) -> int:
        """D, the number of transverse components."""
        return self.source.shape[0] - 1

    @property
    def at_stop(self) -> tuple[Placed, str]:
        """The stop, active or not, in its position, and the name of its form."""
        if self.stop is not None:
            return self.stop, self.stop_form
        row = self.before
        return jax.tree.map(lambda a: a[row], self.rows), self.forms[row]

    @property
    def behind(self) -> Array:
        """Refractive index (R, W, 1) behind each row; behind the sensor as in front of it."""
        return jnp.concatenate([self.index[1:], self.index[-1:]])

    def from_object(self, point: Vector) -> Vector:
        """Vectors from the object point to points, multiplied by the vergence: vergence P - source.

        They stay finite for an object at infinity, where they are the direction of the light.

        point: D + 1 components, mm along the axes of the lens.
        """
        return tuple(self.vergence * p - s for p, s in zip(point, self.source, strict=True))

    @property
    def launch_plane(self) -> Array:
        """z of the plane on which rays are launched, (), mm.

        It is the plane through the vertex of the first row. If that plane lies behind the object,
        or so near to it that the launch point does not determine the ray (1 + vergence z <= 0.5),
        it is the plane through the first surface of the lens, z = 0.
        """
        first = self.rows.vertex[0]
        return jnp.where(1 + self.vergence * first > 0.5, first, 0)

    @property
    def sensor_way(self) -> Array:
        """1 if the sensor lies ahead of the last surface, -1 if it lies in front of it; ().

        A sensor in front of the last surface shows a virtual image. The sign is that of the
        distance from the last vertex to the sensor along the axis of the last surface, in the
        direction of the light. In a lens with tilts and a mirror this axis does not give the
        direction of the beam; the sensor then counts as ahead.
        """
        rows, rotation = self.rows, self.rows.rotation
        if len(self.forms) == 1 or (rotation is not None and any(self.mirrors)):
            return jnp.ones_like(rows.vertex[0])
        step = rows.vertex[-1] - rows.vertex[-2]
        if rotation is not None:
            last, sensor = (jnp.stack([a[k] for a in rows.origin(2)]) for k in (-2, -1))
            step = matmul(sensor - last, rotation[-2, :, 2])
        return jnp.where(step * self.senses[-1] < 0, -1, 1).astype(step.dtype)

    @property
    def sides(self) -> Array:
        """Side of each row that light crosses to, (R,): 1 towards +z of the axes of the row, -1
        towards -z.

        The sign follows from the number of mirrors in front of the row. There is one exception: if
        the axis of the first row points to the object, by 30 degrees or more out of its vertex
        plane, its sign is reversed. This is an off-axis mirror that is prescribed the other way
        round.
        """
        sides = jnp.asarray(self.senses)
        rotation = self.rows.rotation
        if rotation is None:
            return sides
        vertex = jnp.stack([a[0] for a in self.rows.origin(self.dim)])
        light = self.vergence * vertex - self.source
        turned = matmul(light, rotation[0, :, 2]) < -0.5 * jnp.sqrt(matmul(light, light))
        return sides.at[0].set(jnp.where(turned, -1, 1).astype(sides.dtype))

    @property
    def senses(self) -> np.ndarray:
        """Direction of the light in front of each row, (R,): 1 towards +z of the lens, -1 towards
        -z.
        """
        senses = np.cumprod([1, *(-1 if mirror else 1 for mirror in self.mirrors)])
        return senses.astype(self.index.dtype)


def placed(lens: Lens, rows: Any) -> Placed:
    """Surfaces of a lens in their positions.

    rows: index of one surface, or a list of indices. The shape of a surface has no derivative if
        the surface is neither active nor in `Lens.curved`.
    """
    rows = np.asarray(rows)
    vertex, offset, rotation = lens.places
    bends = np.isin(rows, [*lens.active, *lens.curved])

    def shape(array: Array) -> Array:
        own = array[rows]
        mask = bends.reshape(bends.shape + (1,) * (own.ndim - bends.ndim))
        return own if bends.all() else jnp.where(mask, own, jax.lax.stop_gradient(own))

    return Placed(
        vertex[rows],
        shape(lens.curvature),
        shape(lens.conic),
        shape(lens.coefficients),
        None if offset is None else offset[rows],
        None if rotation is None else rotation[rows],
        None if lens.elements is None else lens.vertices[rows],
    )


def system_of(lens: Lens, scene: Scene, dim: int = 2) -> System:
    """The traced system of a lens and a scene.

    dim: number of transverse components, 2; or 1 for the meridional rays of an axial object in a
        lens with rotational symmetry.
    """
    active, stop, phase = lens.active, lens.stop, lens.phase
    # A wavelength outside the range of a glass gets a finite index; its rays are NO_INDEX.
    waves = jnp.clip(scene.wavelengths, *lens.dispersion.range)
    rows = [*active, lens.count]
    tangent = scene.tangent[2 - dim :]
    by = None
    if phase is not None:  # each wave of phase adds order times wavelength of path
        wave = _MM_PER_UM * phase.order[:, None, None] * waves[None, :, None]
        by = Diffraction(phase.shape, wave, tuple(map(active.index, phase.surfaces)), phase.forms)
    return System(
        rows=placed(lens, rows),
        stop=None if stop in active else placed(lens, stop),
        index=lens.index(waves)[np.array([0, *(i + 1 for i in active)]), :, None],
        # Light with a positive field angle travels upwards: the object lies below the axis.
        source=jnp.concatenate([-tangent, -jnp.ones_like(tangent[:1])]),
        vergence=scene.vergence,
        diffraction=by,
        before=sum(i < stop for i in active),
        forms=tuple(lens.forms[i] for i in rows),
        stop_form=lens.forms[stop],
        mirrors=tuple(lens.mirrors[i] for i in active),
    )
