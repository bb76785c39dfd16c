"""Check that the surfaces of a lens follow one another along the light."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.lens import Lens
from ..lens.order import crossings, heights, neighbours
from ..lens.paraxial import marginal_ray, paraxial_system
from .entry import LensError

# Prescriptions round semi-diameters: neighbours may cross beyond this fraction of the smaller
# semi-diameter.
_RIM = 0.9
# Between vertices closer than this (mm), rounding errors hide the direction of a ray.
CLOSEST = 1e-6
TOUCHING = CLOSEST - 1e-9  # sums of thicknesses are rounded


@jax.jit
def _paraxial_beam(lens: Lens, wave: Array) -> Array:
    return jnp.abs(marginal_ray(paraxial_system(lens, wave), jnp.zeros_like(wave)).height[:, 0])


def _beam(lens: Lens, wave: float) -> np.ndarray:
    """Radius of the paraxial beam on each surface, from an object at infinity, mm."""
    return np.asarray(_paraxial_beam(lens, jnp.asarray(wave, lens.curvature.dtype)))


def check_order(lens: Lens, gaps: list[float], moved: list[bool], wave: float) -> None:
    """LensError if light would go backwards, or if neighbours overlap within both their apertures
    and within the beam of the axis. If they overlap only outside of it, or near the rim, a warning:
    light goes backwards there and is lost. A warning, too, for a sensor in front of the last
    surface, where the image is virtual.

    gaps, moved: see `lens.order.neighbours`, which returns the neighbours.
    wave: wavelength of the beam, um.
    """
    pairs = neighbours(lens, gaps, moved)
    for i, j, gap in pairs:
        forwards = lens.senses[i + 1] > 0
        turned = "" if forwards else ", as a mirror has turned the light"
        if gap >= TOUCHING:
            continue
        if j == lens.count:
            where = f"{float(lens.sensor):g} mm"
            at = f"the vertex of surface {i} at {float(lens.vertices[i]):g} mm"
            if i in lens.active and gap > -CLOSEST:
                raise LensError(f"sensor: {where} touches {at}; move it by {CLOSEST} mm", "sensor")
            if i in lens.active:
                warnings.warn(
                    f"sensor: {where} lies before {at}{turned}: rays are prolonged backwards to a "
                    "virtual image",
                    stacklevel=2,
                )
            continue
        reach = "" if j == i + 1 else f" up to surface {j}, in sum"
        raise LensError(
            f"surfaces[{i}].thickness{reach}: must be {'positive' if forwards else 'negative'}"
            f"{turned}, at least {CLOSEST} mm; leave out one of two surfaces that touch",
            f"surfaces[{i}].thickness",
        )
    semi = np.asarray(lens.semi_diameter)
    rows = zip(pairs, heights(lens, pairs)[1], crossings(lens, pairs), strict=True)
    for (i, j, gap), sags, place in rows:
        rim = min(semi[i], semi[j])
        if j == lens.count or np.isinf(rim):
            continue
        finite = [bool(np.all(np.isfinite(sag))) for sag in sags]
        if not all(finite):
            at = f"surfaces[{j if finite[0] else i}]"
            raise LensError(f"{at}: not finite within {rim:g} mm of the axis; which unit?", at)
        if place is None:
            continue
        message = (
            f"surfaces[{i}].thickness: {lens.senses[i + 1] * gap:g} mm makes surfaces {i} and {j} "
            f"cross at {place:.3g} mm from the axis, within their semi-diameters of "
            f"{semi[i]:g} and {semi[j]:g} mm; raise the thickness or lower a semi-diameter"
        )
        if place < min(_RIM * rim, max(_beam(lens, wave)[[i, j]])):
            raise LensError(message, f"surfaces[{i}].thickness")
        warnings.warn(f"{message}; light that comes there is lost", stacklevel=4)
