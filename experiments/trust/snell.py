"""Classical sequential ray trace by Snell's law: the oracle and the baseline.

From the textbook (Welford, Aberrations of Optical Systems, ch. 4); it shares no formula with the
Fermat solver except the sag. One ray at a time; `jax.vmap` for more.
"""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from drt_jax import Lens
from drt_jax.compilation import LARGE
from drt_jax.lens.elements import rotation_matrix
from drt_jax.lens.forms import Shape
from drt_jax.lens.surface import domain, sag_derivatives

# Of XLA, for programs that trace many rays a few times.
QUICK = {
    **LARGE,
    "xla_backend_optimization_level": 1,
    "xla_llvm_disable_expensive_passes": True,
}
_NEWTON_STEPS = 40  # a nearly grazing ray only halves its distance in each


def _intersect(p: Array, d: Array, shape: Shape, form: str) -> tuple[Array, Array, Array]:
    """Hit of the ray p + s d on the surface at the origin, the normal there, and whether there is a
    hit."""
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

    shape: arguments of the sag.
    form: index of the form among those of the lens.
    origin: (3,), vertex, mm.
    axes: (3, 3), rotation from the surface's axes to those of the lens.
    active: True for an active surface or the sensor.
    mirror: True for a mirror.
    sense: 1 or -1 for light along or against the z axis.
    ratio: index in front / index behind.
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
    """Direction behind a surface, and whether it exists and light comes from the front."""
    cosine = normal @ d
    square = 1 - row.ratio**2 * (1 - cosine**2)
    along = row.sense * jnp.sqrt(jnp.maximum(square, 0)) - row.ratio * cosine
    refracted, reflected = row.ratio * d + normal * along, d - 2 * cosine * normal
    whole = (row.mirror | (square >= 0)) & (row.sense * cosine > 0)
    return jnp.where(row.mirror, reflected, refracted), whole


def trace_snell(
    lens: Lens, wavelength: Array, point: Array, direction: Array
) -> tuple[Array, Array]:
    """Traces one ray through a lens to its sensor. Returns the hits (S + 1, 3) along the axes of
    the lens, z from the first vertex, mm, and True if the ray meets every surface, goes forwards
    between active ones, and is not totally reflected. Surfaces that are not active are crossed by
    the straight line, forwards or backwards.

    wavelength: (), um.
    point: (3,), anywhere on the ray in front of the lens, mm.
    direction: (3,), unit vector.
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
