"""The lens: a frozen pytree of arrays over surfaces."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from .glass import Dispersion, check_wavelengths, refractive_index
from ..numerics import concrete
from .surface import MIRRORED, ROTATIONAL, Shape

__all__ = ["Lens", "rotation_matrix"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lens:
    """S surfaces and a flat sensor.

    All arrays are differentiable leaves of one floating dtype; `jax.grad` with respect to a
    lens returns a `Lens`. Lengths in mm, z along the axis from the first vertex.

    curvature (S,) 1/mm; conic (S,), 0 a sphere, -1 a paraboloid; coefficients (S, K), whose
    meaning is that of the surface's form (see `surface`; asphere: of r^2, r^4, ... in mm^-1,
    mm^-3, ...); thickness (S - 1,) between vertices, negative where a mirror has turned the
    light; semi_diameter (S,), the clear aperture (inf: none), at the stop the aperture
    itself; sensor (), its z; dispersion of the S + 1 media, the first before the first surface
    (a surface with the same medium on both sides is not traced: its light keeps the constants
    of the medium in front).

    decentre (S + 1, 2) and tilt (S + 1, 3), of the surfaces and the sensor, each about its own
    place on the axis: x and y in mm; angles about x, then the turned y, then the turned z, in
    radians, right-handed. None, for a centred lens, costs nothing.

    Static: stop, the index of the stop surface; glasses, the names of the S + 1 media; forms,
    a name in `surface.FORMS` for each surface, and mirrors, whether it reflects (empty: all
    aspheres, no mirrors); name.
    """

    curvature: Array
    conic: Array
    coefficients: Array
    thickness: Array
    semi_diameter: Array
    sensor: Array
    dispersion: Dispersion
    decentre: Array | None = None
    tilt: Array | None = None
    stop: int = dataclasses.field(metadata={"static": True}, kw_only=True)
    glasses: tuple[str, ...] = dataclasses.field(metadata={"static": True}, kw_only=True)
    forms: tuple[str, ...] = dataclasses.field(metadata={"static": True}, default=())
    mirrors: tuple[bool, ...] = dataclasses.field(metadata={"static": True}, default=())
    name: str = dataclasses.field(metadata={"static": True}, default="")

    def __post_init__(self):
        count = len(self.glasses) - 1
        object.__setattr__(self, "forms", self.forms or ("asphere",) * count)
        object.__setattr__(self, "mirrors", self.mirrors or (False,) * count)

    @property
    def vertices(self) -> Array:
        """z of the S vertices, shape (S,), mm; the first is 0."""
        return jnp.concatenate([jnp.zeros_like(self.curvature[:1]), jnp.cumsum(self.thickness)])

    @property
    def shape(self) -> Shape:
        """Curvature (S,), conic (S,) and coefficients (K, S)."""
        return Shape(self.curvature, self.conic, self.coefficients.T)

    @property
    def senses(self) -> np.ndarray:
        """Direction (S + 1,) in which light goes before each surface and before the sensor: 1
        along its own z axis, -1 against it after an odd number of mirrors."""
        return np.cumprod([1, *(-1 if mirror else 1 for mirror in self.mirrors)])

    @property
    def symmetry(self) -> str:
        """ "rotation" about the axis, "plane" (x -> -x leaves the lens alone) or "none".

        Of a tilted or decentred lens, "plane" is found from its values: inside a trace, where
        they are not known, it has no symmetry.
        """
        if self.decentre is None and self.tilt is None:
            if ROTATIONAL.issuperset(self.forms):
                return "rotation"
            return "plane" if MIRRORED.issuperset(self.forms) else "none"
        if not concrete((self.decentre, self.tilt)):
            return "none"
        # Neither x, nor a turn about y or z, takes any surface out of the plane x = 0.
        sideways = ((self.decentre, [0]), (self.tilt, [1, 2]))
        still = not any(np.any(np.asarray(a)[:, k]) for a, k in sideways if a is not None)
        return "plane" if still and MIRRORED.issuperset(self.forms) else "none"

    def index(self, wavelengths: ArrayLike) -> Array:
        """Refractive index (S + 1, W) of every medium at `wavelengths` (W,), um.

        ValueError, naming the range, for a known wavelength outside that of a glass.
        """
        check_wavelengths(self.glasses, wavelengths)
        wavelengths = jnp.atleast_1d(jnp.asarray(wavelengths, self.curvature.dtype))
        return refractive_index(self.dispersion, wavelengths)


def rotation_matrix(tilt: Array) -> Array:
    """(3, 3) from the axes of a tilted surface to those of the lens; `tilt` (3,) in radians."""
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(tilt), jnp.sin(tilt)
    one, zero = jnp.ones_like(cx), jnp.zeros_like(cx)
    about_x = jnp.array([[one, zero, zero], [zero, cx, -sx], [zero, sx, cx]])
    about_y = jnp.array([[cy, zero, sy], [zero, one, zero], [-sy, zero, cy]])
    about_z = jnp.array([[cz, -sz, zero], [sz, cz, zero], [zero, zero, one]])
    return about_x @ about_y @ about_z
