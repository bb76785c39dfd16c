"""Classical sequential ray trace by Snell's law: the oracle and the baseline.

Written from the textbook formulae (Welford, Aberrations of Optical Systems, ch. 4), sharing
no formula with the Fermat solver but the sag. One ray at a time; `jax.vmap` for more.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drt_jax import Lens
from drt_jax.lens.elements import rotation_matrix
from drt_jax.lens.forms import Shape
from drt_jax.lens.surface import domain, sag_derivatives

_NEWTON_STEPS = 40  # a ray that all but grazes an asphere halves its distance in each


def _intersect(p: Array, d: Array, shape: Shape, form: str) -> tuple[Array, Array, Array]:
    """Hit of the ray p + s d with the surface at the origin; its normal; whether there is one."""
    q = p - d * (p[2] / d[2])  # on the vertex plane
    met = jnp.array(True)
    c, k = shape.curvature, shape.conic
    if form in ("asphere", "odd_asphere"):
        quadratic = c * (1 + k * d[2] ** 2)
        linear = d[2] - c * (q[0] * d[0] + q[1] * d[1])
        constant = c * (q[0] ** 2 + q[1] ** 2)
        discriminant = linear**2 - quadratic * constant
        root = jnp.sign(d[2]) * jnp.sqrt(jnp.maximum(discriminant, 0))
        met = discriminant >= 0
        ahead = constant / (linear + root)
        if shape.coefficients.shape[0]:  # a ray that misses the conic may meet the asphere
            ahead, met = jnp.where(met, ahead, 0), jnp.array(True)
        q = q + d * ahead
    if shape.coefficients.shape[0]:

        def closer(_, q):
            z, slope, _ = sag_derivatives(q[:2], shape, form)
            return q + d * ((z - q[2]) / (d[2] - slope[0] * d[0] - slope[1] * d[1]))

        q = jax.lax.fori_loop(0, _NEWTON_STEPS, closer, q)
    z, slope, _ = sag_derivatives(q[:2], shape, form)
    met = met & domain(q[:2], shape, form) & (jnp.abs(z - q[2]) < 1e-6 * (1 + jnp.abs(z)))
    normal = jnp.stack([-slope[0], -slope[1], jnp.ones_like(z)])
    return q, normal / jnp.linalg.norm(normal), met


class _Row(NamedTuple):
    """A surface or the sensor, or with a first axis all of them.

    shape, form: what `_intersect` takes, the form by its place among those of the lens. origin,
    axes: of the vertex, mm; from the surface's axes to those of the lens. active: whether it is an
    active surface; the sensor counts as one. mirror: whether it reflects. sense: 1 or -1, light
    goes along or against its z axis. ratio: the index in front by that behind.
    """

    shape: Shape
    form: Array
    origin: Array
    axes: Array
    active: Array
    mirror: Array
    sense: Array
    ratio: Array


def _rows(lens: Lens, wavelength: Array, forms: list[str]) -> _Row:
    index, dtype = lens.index(jnp.atleast_1d(wavelength))[:, 0], wavelength.dtype
    across = jnp.zeros((lens.count + 1, 2), dtype) if lens.decentre is None else lens.decentre
    tilt = jnp.zeros((lens.count + 1, 3), dtype) if lens.tilt is None else lens.tilt
    return _Row(
        Shape(lens.curvature, lens.conic, lens.coefficients),
        jnp.array([forms.index(form) for form in lens.forms]),
        jnp.concatenate([across, lens.vertices[:, None]], axis=1),
        jax.vmap(rotation_matrix)(tilt),
        jnp.array([i in (*lens.active, lens.count) for i in range(lens.count + 1)]),
        jnp.array([*lens.mirrors, False]),
        jnp.asarray(lens.senses, dtype),
        index / jnp.append(index[1:], index[-1]),
    )


def _bend(d: Array, normal: Array, row: _Row) -> tuple[Array, Array]:
    """The direction behind a surface, and whether there is one and light came from its front."""
    cosine = normal @ d
    square = 1 - row.ratio**2 * (1 - cosine**2)
    along = row.sense * jnp.sqrt(jnp.maximum(square, 0)) - row.ratio * cosine
    refracted, reflected = row.ratio * d + normal * along, d - 2 * cosine * normal
    whole = (row.mirror | (square >= 0)) & (row.sense * cosine > 0)
    return jnp.where(row.mirror, reflected, refracted), whole


def trace_snell(
    lens: Lens, wavelength: Array, point: Array, direction: Array
) -> tuple[Array, Array]:
    """Trace one ray through a lens to its sensor.

    A surface that bends no light is crossed by the straight line through the point before it,
    forwards or backwards, and the ray goes on from that point.

    wavelength: () in um. point: (3,) in mm, anywhere on the ray before the lens. direction: (3,), a
    unit vector.
    Returns the hits (S + 1, 3) in mm along the axes of the lens, z from the first vertex, and
    whether the ray met every surface, went forwards from each that bends light to the next, and
    was refracted or reflected there, bool.
    """
    forms = sorted(set(lens.forms))
    branches = [partial(_intersect, form=form) for form in forms]

    def cross(ray, row):
        point, direction, begun, ok = ray
        p, d = row.axes.T @ (point - row.origin), row.axes.T @ direction
        hit, normal, met = jax.lax.switch(row.form, branches, p, d, row.shape)
        ahead = ~begun | (row.sense * (hit - p)[2] >= 0)
        bent, whole = _bend(d, normal, row)
        hit = row.axes @ hit + row.origin
        behind = (
            jnp.where(row.active, hit, point),
            jnp.where(row.active, row.axes @ bent, direction),
        )
        return (*behind, begun | row.active, ok & met & (~row.active | (ahead & whole))), hit

    start = point, direction, jnp.array(False), jnp.array(True)
    wavelength = jnp.asarray(wavelength, point.dtype)
    (*_, ok), hits = jax.lax.scan(cross, start, _rows(lens, wavelength, forms))
    return hits, ok
