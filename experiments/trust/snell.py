"""Sequential ray trace by Snell's law: the reference for accuracy and the baseline for speed.

It follows the textbook (Welford, Aberrations of Optical Systems, ch. 4), and shares no formula with
the Fermat solver except the sag. It traces one ray; use `jax.vmap` for more.
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

# Options of XLA for programs that trace many rays a few times.
QUICK = {**LARGE, "xla_backend_optimization_level": 1, "xla_llvm_disable_expensive_passes": True}
_NEWTON_STEPS = 40  # for a nearly grazing ray, each step only halves the distance


def _to_conic(q: Array, d: Array, shape: Shape, side: Array, start: Array) -> Array:
    """Length s at which q + s d meets a conic with its vertex at the origin; NaN if it does not.

    A line crosses a quadric at most twice. Crossings on the sheet of the vertex with s >= `start`
    count. The first one in the direction of `side` is taken; if there is none, the other one.

    side: 1 to cross the surface towards +z, -1 towards -z.
    """
    c, k = shape.curvature, shape.conic
    flat = jnp.stack([d[0], d[1], (1 + k) * d[2]])
    square, linear = c * (flat @ d), d[2] - c * (flat @ q)
    constant = c * (q @ q + k * q[2] ** 2) - 2 * q[2]
    discriminant = linear**2 - square * constant
    top = linear + jnp.copysign(jnp.sqrt(discriminant), linear)
    s = jnp.stack([constant / top, top / square])
    sheet = 1 - (1 + k) * c * (q[2] + s * d[2]) > 0
    fits = jnp.isfinite(s) & sheet & (s >= start)
    meant = fits & (side * (linear - square * s) >= 0)
    best = jnp.argmin(jnp.where(jnp.where(jnp.any(meant), meant, fits), s, jnp.inf))
    return jnp.where(jnp.any(fits), s[best], jnp.nan)


def _intersect(
    p: Array, d: Array, shape: Shape, side: Array, start: Array, form: str
) -> tuple[Array, Array, Array]:
    """First hit of the ray p + s d, s >= start, on the surface at the origin from a side (see
    `_to_conic`), the normal there, and whether there is a hit."""
    near = p @ d
    q = p - near * d  # nearest to the vertex
    ahead = _to_conic(q, d, shape, side, start + near)
    met = jnp.isfinite(ahead)
    more = shape.coefficients.shape[0] > 0
    # A ray that misses the conic may meet the asphere: it starts from the vertex plane.
    q = q + d * jnp.where(met, ahead, -q[2] / d[2] if more else 0)
    if more:
        met = jnp.array(True)

        def closer(_, q):
            z, slope, _ = sag_derivatives(q[:2], shape, form)
            return q + d * ((z - q[2]) / (d[2] - slope[0] * d[0] - slope[1] * d[1]))

        q = jax.lax.fori_loop(0, _NEWTON_STEPS, closer, q)
    z, slope, _ = sag_derivatives(q[:2], shape, form)
    met = met & domain(q[:2], shape, form) & (jnp.abs(z - q[2]) < 1e-6 * (1 + jnp.abs(z)))
    normal = jnp.stack([-slope[0], -slope[1], jnp.ones_like(z)])
    return q, normal / jnp.linalg.norm(normal), met & ((q - p) @ d >= start)


class _Row(NamedTuple):
    """A surface or the sensor, or with a first axis all of them.

    shape: arguments of the sag.
    form: index of the form among those of the lens.
    origin: (3,), vertex, mm.
    axes: (3, 3), rotation from the surface's axes to those of the lens.
    active: True for an active surface or the sensor.
    mirror: True for a mirror.
    sense: 1 or -1 for light along or against the z axis of a lens without tilts.
    ratio: index in front / index behind.
    virtual: True for a sensor in front of the last surface, where a lens without tilts shows a
        virtual image.
    """

    shape: Shape
    form: Array
    origin: Array
    axes: Array
    active: Array
    mirror: Array
    sense: Array
    ratio: Array
    virtual: Array


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
        virtual(lens),
    )


def virtual(lens: Lens) -> Array:
    """`virtual` of all rows, (S + 1,), see `_Row`."""
    none = jnp.zeros(lens.count + 1, bool)
    if lens.tilt is not None or not lens.active:
        return none
    back = lens.sensor - lens.vertices[lens.active[-1]]
    return none.at[-1].set(back * float(lens.senses[-1]) < 0)


def _bend(d: Array, normal: Array, row: _Row, side: Array) -> tuple[Array, Array]:
    """Direction behind a surface; and whether it exists and light crosses the surface towards
    `side` (1, -1; 0 for either)."""
    cosine = normal @ d
    square = 1 - row.ratio**2 * (1 - cosine**2)
    along = jnp.sign(cosine) * jnp.sqrt(jnp.maximum(square, 0)) - row.ratio * cosine
    refracted, reflected = row.ratio * d + normal * along, d - 2 * cosine * normal
    whole = (row.mirror | (square >= 0)) & (side * cosine >= 0)
    return jnp.where(row.mirror, reflected, refracted), whole


def trace_snell(
    lens: Lens, wavelength: Array, point: Array, direction: Array, begun: Array | float = jnp.inf
) -> tuple[Array, Array]:
    """Traces one ray through a lens to its sensor.

    Without tilts, the number of mirrors determines the direction in which light crosses a surface;
    with tilts, both directions are accepted. The straight line, forwards or backwards, crosses
    surfaces that are not active. A sensor in front of the last surface is crossed by the line
    extended backwards.

    wavelength: (), um.
    point: (3,), anywhere on the ray in front of the lens, mm.
    direction: (3,), unit vector.
    begun: (), distance along the ray from the object to `point`, mm; inf for an object at infinity.

    Returns the hits (S + 1, 3) along the axes of the lens, z from the first vertex, mm; and True if
    the ray meets every surface, goes forwards from the object to the first active surface and
    between active ones, and is not totally reflected.
    """
    forms = sorted(set(lens.forms))
    branches = [partial(_intersect, form=form) for form in forms]

    def cross(ray, row):
        point, direction, begun, ok = ray
        p, d = row.axes.T @ (point - row.origin), row.axes.T @ direction
        side = jnp.where(row.active, row.sense, jnp.sign(d[2]))
        start = jnp.where(row.active & ~row.virtual, -begun, -jnp.inf)
        hit, normal, met = jax.lax.switch(row.form, branches, p, d, row.shape, side, start)
        bent, whole = _bend(d, normal, row, side if lens.tilt is None else 0 * side)
        met = met & (~row.virtual | ((hit - p) @ d <= 0))
        hit = row.axes @ hit + row.origin
        behind = hit, row.axes @ bent, jnp.zeros_like(begun)
        behind = jax.tree.map(partial(jnp.where, row.active), behind, (point, direction, begun))
        return (*behind, ok & met & (~row.active | whole)), hit

    begun = jnp.broadcast_to(jnp.asarray(begun, point.dtype), ())
    start = point, direction, begun, jnp.array(True)
    wavelength = jnp.asarray(wavelength, point.dtype)
    (*_, ok), hits = jax.lax.scan(cross, start, _rows(lens, wavelength, forms))
    return hits, ok
