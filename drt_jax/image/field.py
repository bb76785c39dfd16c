"""From a field angle to its image point and back, by the real chief ray."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from ..inputs import require
from ..lens.lens import Lens
from ..lens.paraxial import image_height
from ..lens.scene import Scene, checked_scene, over_points
from ..numerics import Numbers, real_array, safe_divide
from ..rays.trace import trace_bundle

_STEPS = 20
_NEAR = 1e5  # rounding errors of a chief ray that meets its point, relative, in units of `eps`
# Stop points: the centre for the chief ray, and one near it, because the search scales its steps
# with the width of the beam. Without it the chief ray is not found if the stop is at the first
# vertex.
CHIEF = np.array([[0.0, 0.0], [0.0, 0.1]])


def image_point(lens: Lens, scene: Scene) -> Array:
    """Points where the chief rays meet the sensor. The chief ray passes through the centre of the
    stop.

    lens, scene: as in `trace_rays`.

    Returns (..., W, 2), x and y along the axes of the sensor, mm; 0 where the ray fails.
    Differentiable in every mode. The centroid of a spot is another point, see `psf_moments`.
    """
    return _image_points(lens, checked_scene(lens, scene))


@jax.jit
def _image_points(lens: Lens, scene: Scene) -> Array:
    """`image_point`, compiled."""
    return over_points(lambda point: _image_point(lens, point), scene)


def _image_point(lens: Lens, scene: Scene) -> Array:
    """`image_point` (W, 2) of one object point."""
    points = jnp.asarray(CHIEF, lens.curvature.dtype)
    return jnp.stack(trace_bundle(lens, scene, tuple(points)).sensor, axis=-1)[:, 0]


def field_of_image(lens: Lens, point: Numbers, distance: Numbers, wavelength: Numbers) -> Array:
    """The field whose chief ray meets the sensor at a given point.

    lens: the lens.
    point: (2,), along the axes of the sensor, mm.
    distance: as in `trace_rays`.
    wavelength: one, um.

    Returns (2,), angles along x and y, radians; inf if none was found. Newton's method from the
    paraxial field; derivatives by the implicit function theorem.
    """
    scene = checked_scene(lens, Scene.point(0.0, distance, wavelength))
    target = real_array("point", point, lens.curvature.dtype)
    require(target.shape == (2,), f"point: expected x and y, got shape {target.shape}")
    require(scene.wavelengths.size <= 1, f"wavelength: expected one, got {scene.wavelengths.size}")
    return _field_of_image(lens, scene, target)


@jax.jit
def _field_of_image(lens: Lens, scene: Scene, target: Array) -> Array:
    """`field_of_image` of checked arguments."""
    dtype = target.dtype
    unit = image_height(lens, jnp.asarray(jnp.pi / 4, dtype), scene.distance, scene.wavelengths)[0]
    start = jnp.arctan(safe_divide(target, jnp.broadcast_to(unit, (2,))))
    eps = float(jnp.finfo(dtype).eps)

    def miss(field, args):
        lens, scene, target = args
        return _image_point(lens, scene.at(field))[0] - target

    solution: optx.Solution = optx.root_find(
        miss,
        optx.Newton(rtol=16 * eps, atol=64 * eps),
        start,
        args=(lens, scene, target),
        max_steps=_STEPS,
        throw=False,
    )
    # Rounding of the trace can keep the last steps above the tolerance of Newton's method.
    left = jnp.max(jnp.abs(miss(jax.lax.stop_gradient(solution.value), (lens, scene, target))))
    found = left <= _NEAR * eps * (1 + jnp.max(jnp.abs(target)))
    return jnp.where(found, solution.value, jnp.inf)
