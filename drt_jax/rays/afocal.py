"""Light that leaves a lens collimated: angles in place of hits.

An afocal lens is traced as if an ideal lens of 1 m stood behind it, with the sensor of the
prescription in its front focal plane and a sensor in the rear one, without distortion of angles:
there 1 mm is 1 mrad. All analyses then hold as they are, heights read as angles, in mrad; moving
the sensor by 1 mm is a vergence of 1e-3 dioptre.

For a ray of direction l (transverse cosines, |l| = sin a) that meets the front focal plane at x,
with the path L to there: the hit is F t, t = a l / |l|; the transverse direction behind the ideal
lens is -J x / F, J = dl / dt, which is -x / F on the axis; and the path is that of its plane wave
in front, L - n x.l, so that the wavefront is measured against a plane. This change from x, l to t
and J x keeps areas in phase space and the eikonal: d(L - n x.l) = -n x.dl = -n (J x).dt.
"""

import jax.numpy as jnp
from jax import Array

from ..numerics import safe_divide, safe_sqrt
from .system import Vector, dot

# mm: one mm is one mrad.
FOCAL = 1e3


def at_infinity(
    hits: Vector, arrival: Vector, path: Array, exists: Array, index: Array
) -> tuple[Vector, Vector, Array]:
    """Hits (S + 1, W, Q), the last of which become angles in mrad, arrivals and path (W, Q) of rays
    behind the ideal lens; the transverse part of an arrival is that of a unit vector, its z is 1.

    hits, arrival, path: as of a `Bundle`, at the sensor. exists: (W, Q). index: (W, 1)."""
    line = tuple(jnp.where(exists, a, 0) for a in arrival[:-1])
    along = jnp.where(exists, jnp.abs(arrival[-1]), 1)
    sine = safe_sqrt(dot(line, line))
    angle = jnp.arctan2(sine, along)
    short = jnp.where(sine > 0, safe_divide(sine, angle), 1)
    place = tuple(h[-1] for h in hits)
    beside = dot(line, place)
    turned = safe_divide(along - short, sine**2) * beside
    back = tuple(-(short * x + turned * a) / FOCAL for x, a in zip(place, line))
    seen = tuple(FOCAL * safe_divide(a, short) for a in line)
    joined = tuple(jnp.concatenate([h[:-1], a[None]]) for h, a in zip(hits, seen))
    return joined, (*back, jnp.ones_like(along)), path - index * beside
