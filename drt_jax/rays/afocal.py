"""Afocal systems: light that leaves a lens collimated. Image heights are replaced by angles.

An afocal lens is traced as if an ideal lens of focal length F = 1 m stood behind it. The sensor of
the prescription lies in the front focal plane of the ideal lens, and a second sensor lies in its
rear focal plane, where 1 mm stands for 1 mrad. The ideal lens maps angles to heights without
distortion. All analyses then work unchanged if heights are read as angles in mrad. Moving the
second sensor by 1 mm is a vergence of 1e-3 dioptre.

Consider a ray with transverse direction cosines l, |l| = sin a, that meets the front focal plane at
x with the optical path L. In the rear focal plane

    hit                   F t             with t = a l / |l|
    transverse direction  -J x / F        with J = dl/dt (J is the unit matrix on the axis)
    optical path          L - n x.l       the path of the plane wave in front, so that the
                                          wavefront is measured against a plane

J has the eigenvalue cos a along l and sin a / a across it. The map from (x, l) to (t, J x)
preserves areas in phase space and the eikonal: d(L - n x.l) = -n x.dl = -n (J x).dt.
"""

import jax.numpy as jnp
from jax import Array

from ..numerics import safe_divide, safe_sqrt
from .system import Vector, dot

# Focal length F of the ideal lens, mm, so that 1 mm is 1 mrad.
FOCAL = 1e3


def at_infinity(
    hits: Vector, arrival: Vector, path: Array, exists: Array, index: Array
) -> tuple[Vector, Vector, Array]:
    """Replaces sensor hits by angles, for rays behind the ideal lens of an afocal system.

    hits: D arrays (S + 1, W, Q), mm, as in `Bundle`; the last row is the sensor.
    arrival: D + 1 arrays (W, Q), unit vectors at the sensor, as in `Bundle`.
    path: (W, Q), mm, optical path to the sensor.
    exists: (W, Q), bool, rays that exist.
    index: (W, 1), refractive index in front of the sensor.

    Returns the hits (S + 1, W, Q), of which those on the sensor are angles in mrad; the arrivals
    (W, Q), whose transverse part is that of a unit vector and whose z is set to 1; and the path (W,
    Q), mm.
    """
    line = tuple(jnp.where(exists, a, 0) for a in arrival[:-1])
    along = jnp.where(exists, jnp.abs(arrival[-1]), 1)
    sine = safe_sqrt(dot(line, line))
    angle = jnp.arctan2(sine, along)
    sinc = jnp.where(sine > 0, safe_divide(sine, angle), 1)
    point = tuple(h[-1] for h in hits)
    x_dot_l = dot(line, point)
    radial = safe_divide(along - sinc, sine**2) * x_dot_l
    slopes = tuple(-(sinc * x + radial * a) / FOCAL for x, a in zip(point, line))
    angles = tuple(FOCAL * safe_divide(a, sinc) for a in line)
    joined = tuple(jnp.concatenate([h[:-1], a[None]]) for h, a in zip(hits, angles))
    return joined, (*slopes, jnp.ones_like(along)), path - index * x_dot_l
