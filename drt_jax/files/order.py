"""Whether the surfaces of a lens follow one another as light goes."""

import itertools
import math
import warnings

import jax
import numpy as np

from ..lens.forms import Shape
from ..lens.lens import Lens
from ..lens.surface import surface_sag
from .entry import LensError

# Neighbours that overlap by less at their rims touch (mm); from this part of the smaller
# semi-diameter on they may cross, as apertures of prescriptions are rounded.
_TOUCH, _RIM = 1e-4, 0.9
# The direction of a ray between vertices closer than this (mm) drowns in rounding.
_CLOSEST = 1e-6
_sag = jax.jit(surface_sag, static_argnums=2)


def check_order(lens: Lens, gaps: list[float], moved: list[bool]) -> None:
    """LensError where light would go backwards, or neighbours overlap in both their apertures; only
    a warning where they do so near the rim, where light then goes backwards and is lost.

    Neighbours are the surfaces that bend light, and the sensor behind the last. The straight ray
    between two of them may cross a stop that bends none before the first or behind the second, so
    that it may lie anywhere. A pair of which one is moved without the other is left out: away from
    the axis, or at an angle to it, it may lie before its neighbour there and behind it where the
    light goes.

    gaps: mm from each surface to the next and from the last to the sensor.
    moved: of each surface and the sensor.
    """
    groups = () if lens.elements is None else lens.elements.spans
    apart = lambda i, j: any((a <= i <= b) != (a <= j <= b) for a, b in groups)  # noqa: E731
    chain = itertools.pairwise([*(lens.live or (lens.stop,)), lens.count])
    pairs = [(i, j, sum(gaps[i:j])) for i, j in chain if not (moved[i] or moved[j] or apart(i, j))]
    for i, j, distance in pairs:
        forwards = lens.senses[i + 1] > 0
        turned = "" if forwards else ", as a mirror has turned the light"
        if (distance if forwards else -distance) >= _CLOSEST:
            continue
        if j == lens.count:
            raise LensError(
                f"sensor: {float(lens.sensor):g} mm lies before the vertex of surface {i} at "
                f"{float(lens.vertices[i]):g} mm{turned}",
                "sensor",
            )
        reach = "" if j == i + 1 else f" up to surface {j}, in sum"
        raise LensError(
            f"surfaces[{i}].thickness{reach}: must be {'positive' if forwards else 'negative'}"
            f"{turned}, at least {_CLOSEST} mm; leave out one of two surfaces that touch",
            f"surfaces[{i}].thickness",
        )
    semi = np.asarray(lens.semi_diameter)
    shape = [np.asarray(a) for a in (lens.curvature, lens.conic, lens.coefficients)]
    for i, j, distance in pairs:
        rim = min(semi[i], semi[j])
        if j == lens.count or math.isinf(rim):
            continue
        y = np.linspace(0, rim, 257, dtype=semi.dtype)
        front, back = (
            np.asarray(_sag((0 * y, y), Shape(*(a[k] for a in shape)), lens.forms[k]))
            for k in (i, j)
        )
        if not np.all(np.isfinite(front) & np.isfinite(back)):
            at = f"surfaces[{i if not np.all(np.isfinite(front)) else j}]"
            raise LensError(f"{at}: not finite within {rim:g} mm of the axis; which unit?", at)
        crossed = lens.senses[i + 1] * (front - back - distance) > _TOUCH
        if not np.any(crossed):
            continue
        place = y[np.argmax(crossed)]
        message = (
            f"surfaces[{i}].thickness: {distance:g} mm makes surfaces {i} and {j} cross at "
            f"{place:.3g} mm from the axis, within their semi-diameters of "
            f"{semi[i]:g} and {semi[j]:g} mm; raise the thickness or lower a semi-diameter"
        )
        if place < _RIM * rim:
            raise LensError(message, f"surfaces[{i}].thickness")
        warnings.warn(f"{message}; light that comes there is lost", stacklevel=4)
