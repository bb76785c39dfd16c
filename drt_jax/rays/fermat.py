"""The Fermat system of a bundle of rays: optical path, its gradient and its Hessian.

A ray is labelled by its object point and the point w_s where it crosses the stop s; unknown
are its hits on the S - 1 other surfaces and on the sensor, the equations dOP/dw_i = 0 on
all S surfaces (paper Eqs. 2 and 3). dF_i/dw_j is zero for |i - j| > 1, so the Newton step
and its transpose cost O(S) a ray.

Arrays here are laid out (component, surface, wavelength, ray): rays last, so that every
operation is one long elementwise loop. There are D = 1 components for rays in the meridional
plane (y), D = 2 in general (x, y). Surface S is the sensor.
"""

import dataclasses
import enum
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import safe_divide, safe_sqrt
from ..lens.surface import Shape, by_form, domain, sag, sag_derivatives

__all__ = [
    "Blocks",
    "Geometry",
    "Status",
    "System",
    "arrival",
    "geometry",
    "hessian",
    "optical_path",
    "residual",
    "solve",
    "solve_transposed",
    "stationary",
    "turn",
    "turned",
]


class Status(enum.IntEnum):
    """What became of a ray: the first of MISSED and TIR along it; CLIPPED only if it is whole."""

    OK = 0
    MISSED = 1  # no forward intersection with a surface
    TIR = 2  # total internal reflection
    CLIPPED = 3  # outside a clear aperture
    UNCONVERGED = 4  # the iteration found no stationary path


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class System:
    """Everything that the path of a ray depends on; the differentiable arguments.

    vertex, curvature, conic (S + 1,) and coefficients (K, S + 1) of the surfaces and the
    sensor; offset (2, S + 1) of their vertices from the axis and rotation (3, 3, S + 1) from
    their own axes to those of the lens, None where there are none; index (S + 1, W); source
    (D + 1,), the object point divided by its distance, so that its last component is -1;
    vergence (), 1/distance in 1/mm, 0 for infinity; target (D, Q) or (D, W, Q), the points
    where the rays cross the stop, mm.

    Static: stop, the index of the stop; forms (S + 1) and mirrors (S).
    """

    vertex: Array
    curvature: Array
    conic: Array
    coefficients: Array
    index: Array
    source: Array
    vergence: Array
    target: Array
    offset: Array | None = None
    rotation: Array | None = None
    stop: int = dataclasses.field(metadata={"static": True}, default=0)
    forms: tuple[str, ...] = dataclasses.field(metadata={"static": True}, default=())
    mirrors: tuple[bool, ...] = dataclasses.field(metadata={"static": True}, default=())

    @property
    def shape(self) -> Shape:
        """Curvature, conic and coefficients, broadcast against (surface, wavelength, ray)."""
        return Shape(
            self.curvature[:, None, None],
            self.conic[:, None, None],
            self.coefficients[..., None, None],
        )

    @property
    def crossings(self) -> Array:
        """`target` as (D, W or 1, Q)."""
        return self.target if self.target.ndim == 3 else self.target[:, None]

    @property
    def senses(self) -> Array:
        """1 or -1 (S + 1, 1, 1): light goes along or against the z axis of each surface."""
        turns = np.cumprod([1, *(-1 if mirror else 1 for mirror in self.mirrors)])
        return jnp.asarray(turns[:, None, None], self.vertex.dtype)


class Geometry(NamedTuple):
    """A path drawn out: what its gradient, its Hessian and its status are made of.

    before (D + 1, S + 1, W, Q): unit vectors of the segments in front of each surface, along
    that surface's axes. after (D + 1, S, W, Q): those behind it, along its axes too.
    inverse_length (S + 1, W, Q): inverse lengths of the former (the first: vergence over |q|).
    slope (D, S + 1, W, Q) and bend (D, D, S + 1, W, Q): derivatives of the sag.
    """

    before: Array
    after: Array
    inverse_length: Array
    slope: Array
    bend: Array


class Blocks(NamedTuple):
    """The Jacobian dF/dw: diagonal (D, D, S, W, Q) holds dF_i/dw_i, upper (D, D, S, W, Q)
    dF_i/dw_{i+1}; dF_{i+1}/dw_i is the transpose of the latter, because F is a gradient."""

    diagonal: Array
    upper: Array


def turn(rotation: Array | None, vectors: Array, back: bool = False) -> Array:
    """`vectors` (3, S, ...) from the axes of each surface to those of the lens, or `back`.

    `rotation` (3, 3, S); None, the axes being the same, returns them as they are.
    """
    if rotation is None:
        return vectors
    matrix = rotation.reshape(*rotation.shape, *(1,) * (vectors.ndim - 2))
    return jnp.sum(matrix * (vectors[:, None] if back else vectors[None]), axis=0 if back else 1)


def turned(rotation: Array | None, vector: tuple, back: bool = False) -> tuple:
    """`turn` for one surface, `rotation` (3, 3), and a vector as a tuple of components."""
    if rotation is None:
        return vector
    matrix = rotation.T if back else rotation
    return tuple(sum(a * b for a, b in zip(row, vector)) for row in matrix)


def _origin(system: System, dim: int) -> Array:
    """Vertices of the surfaces and the sensor, (D + 1, S + 1, 1, 1), mm."""
    across = jnp.zeros((dim, *system.vertex.shape), system.vertex.dtype)
    across = across if system.offset is None else system.offset
    return jnp.concatenate([across, system.vertex[None]])[..., None, None]


def _segments(hits: Array, system: System) -> tuple[Array, Array, Array, Array]:
    """First point (D + 1, W, Q), the steps from each to the next (D + 1, S, W, Q), sag
    derivatives. Steps are sums of small differences: no digit is lost far from the origin."""
    z, slope, bend = by_form(sag_derivatives, hits, system.shape, system.forms)
    own = turn(system.rotation, jnp.concatenate([hits, z[None]]))
    origin = _origin(system, hits.shape[0])
    step = (origin[:, 1:] - origin[:, :-1]) + (own[:, 1:] - own[:, :-1])
    return origin[:, 0] + own[:, 0], step, slope, bend


def arrival(hits: Array, system: System) -> Array:
    """Unit vectors (D + 1, W, Q), along the axes of the sensor, of the rays that reach it."""
    rows = slice(-2, None)
    rotation = None if system.rotation is None else system.rotation[..., rows]
    shape = Shape(*(a[..., rows, :, :] for a in system.shape))
    z = by_form(sag, hits[:, rows], shape, system.forms[rows])
    own = turn(rotation, jnp.concatenate([hits[:, rows], z[None]]))
    step = jnp.diff(_origin(system, hits.shape[0])[:, rows] + own, axis=1)
    if rotation is not None:
        step = turn(rotation[..., 1:], step, back=True)
    length = safe_sqrt(jnp.sum(step**2, axis=0))
    return (step * safe_divide(jnp.ones_like(length), length))[:, 0]


def geometry(hits: Array, system: System) -> Geometry:
    """Directions, lengths and sag derivatives of the paths through `hits` (D, S + 1, W, Q).

    The first segment comes from P_0 = source / vergence. It is scaled by the vergence,
    q = vergence P_1 - source, which has the same direction and stays finite and smooth when
    the object goes to infinity.
    """
    point, step, slope, bend = _segments(hits, system)
    first = system.vergence * point - system.source[:, None, None]
    segment = jnp.concatenate([first[:, None], step], axis=1)
    inverse = safe_divide(jnp.ones_like(segment[0]), safe_sqrt(jnp.sum(segment**2, axis=0)))
    direction = segment * inverse
    scale = jnp.concatenate([inverse[:1] * system.vergence, inverse[1:]], axis=0)
    before, after = direction, direction[:, 1:]
    if system.rotation is not None:
        before = turn(system.rotation, direction, back=True)
        after = turn(system.rotation[..., :-1], direction[:, 1:], back=True)
    return Geometry(before, after, scale, slope, bend)


def optical_path(hits: Array, system: System) -> Array:
    """Optical path (W, Q) in mm from the object to the sensor (paper Eq. 2).

    Counted from the sphere round the object that passes through the first vertex (a plane
    for an object at infinity), so that it stays finite for any distance.
    """
    q, step, _, _ = _segments(hits, system)
    v, p = system.vergence, system.source[:, None, None]
    near = v * q - p
    # (|q - p/v| - |p/v|) without the cancellation, and without dividing by v
    first = (v * jnp.sum(q * q, axis=0) - 2 * jnp.sum(q * p, axis=0)) / (
        jnp.sqrt(jnp.sum(near**2, axis=0)) + jnp.sqrt(jnp.sum(p**2, axis=0))
    )
    lengths = jnp.concatenate([first[None], safe_sqrt(jnp.sum(step**2, axis=0))])
    return jnp.sum(system.index[:, :, None] * lengths, axis=0)


def residual(hits: Array, system: System) -> Array:
    """F = dOP/dw on every surface, dimensionless, shape (D, S, W, Q) (paper Eq. 3)."""
    return _residual(geometry(hits, system), system)


def _residual(path: Geometry, system: System) -> Array:
    index = system.index[:, :, None]
    change = index[:-1] * path.before[:, :-1] - index[1:] * path.after
    return change[:-1] + path.slope[:, :-1] * change[-1]


def hessian(path: Geometry, system: System) -> Blocks:
    """The blocks of dF/dw in closed form from the drawn-out path."""
    dim = path.slope.shape[0]
    slope, index = path.slope, system.index[:, :, None]
    weight = index * path.inverse_length
    # t.T_e for the tangents T_e = unit_e + slope_e z of the surface behind a segment ...
    end = path.before[:-1] + slope * path.before[-1]
    # ... and of the one before it.
    start = path.after[:-1] + slope[:, :-1] * path.after[-1]
    bend = index[:-1] * path.before[-1, :-1] - index[1:] * path.after[-1]
    if system.rotation is not None:
        # T_e . T_f of neighbours whose axes differ
        units = jnp.eye(3, dtype=slope.dtype)[:dim, :, None, None, None]
        tangent = units + jnp.eye(3, dtype=slope.dtype)[2, :, None, None, None] * slope[:, None]
        tangent = jax.vmap(lambda t: turn(system.rotation, t))(tangent)
    diagonal, upper = [], []
    for e in range(dim):
        for f in range(dim):
            same = float(e == f)
            metric = same + slope[e, :-1] * slope[f, :-1]
            diagonal.append(
                weight[:-1] * (metric - end[e, :-1] * end[f, :-1])
                + weight[1:] * (metric - start[e] * start[f])
                + bend * path.bend[e, f, :-1]
            )
            if system.rotation is None:
                metric = same + slope[e, :-1] * slope[f, 1:]
            else:
                metric = jnp.sum(tangent[e, :, :-1] * tangent[f, :, 1:], axis=0)
            upper.append(-weight[1:] * (metric - start[e] * end[f, 1:]))
    shape = (dim, dim, *diagonal[0].shape)
    return Blocks(jnp.stack(diagonal).reshape(shape), jnp.stack(upper).reshape(shape))


def _matvec(a: Array, x: Array) -> Array:
    return jnp.stack([sum(b * y for b, y in zip(row, x)) for row in a])


def _matmul(a: Array, b: Array) -> Array:
    return jnp.stack([_matvec(a, column) for column in jnp.swapaxes(b, 0, 1)], axis=1)


def _transpose(a: Array) -> Array:
    return jnp.swapaxes(a, 0, 1)


def _inverse(a: Array) -> Array:
    if a.shape[0] == 1:
        return safe_divide(jnp.ones_like(a), a)
    determinant = a[0, 0] * a[1, 1] - a[0, 1] * a[1, 0]
    adjugate = jnp.stack([jnp.stack([a[1, 1], -a[0, 1]]), jnp.stack([-a[1, 0], a[0, 0]])])
    return safe_divide(adjugate, determinant)


def _rows(a: Array, first: int, last: int) -> Array:
    """Rows `first` to `last` (excluded) of a (..., surfaces, W, Q), surfaces first; 0 where there
    are none."""
    a = jnp.moveaxis(a, -3, 0)
    below, above = max(-first, 0), max(last - a.shape[0], 0)
    a = a[max(first, 0) : min(last, a.shape[0])]
    return jnp.pad(a, ((below, above), *[(0, 0)] * (a.ndim - 1))) if below or above else a


def _solve_front(blocks: Blocks, rhs: Array, stop: int, at_stop: Array) -> Array:
    """Solution (stop, D, W, Q) on the surfaces before the stop, whose block tridiagonal part is
    symmetric, given that at the stop: elimination, substitution."""
    if stop == 0:
        return jnp.zeros((0, *at_stop.shape), rhs.dtype)

    def eliminate(before, row):
        inverse, reduced = before
        diagonal, upper, b = row
        carry = _matmul(inverse, upper)
        pivot = diagonal - _matmul(_transpose(upper), carry)
        here = _inverse(pivot), b - _matvec(_transpose(carry), reduced)
        return here, here

    def substitute(behind, row):
        inverse, reduced, upper = row
        x = _matvec(inverse, reduced - _matvec(upper, behind))
        return x, x

    diagonal = _rows(blocks.diagonal, 0, stop)
    above = _rows(blocks.upper, -1, stop - 1)
    nothing = jnp.zeros_like(diagonal[0]), jnp.zeros_like(at_stop)
    _, (inverses, reduced) = jax.lax.scan(
        eliminate, nothing, (diagonal, above, _rows(rhs, 0, stop))
    )
    upper = _rows(blocks.upper, 0, stop)
    return jax.lax.scan(substitute, at_stop, (inverses, reduced, upper), reverse=True)[1]


def solve(blocks: Blocks, rhs: Array, stop: int) -> Array:
    """x with (dF/dw) x = rhs (D, S, W, Q) and x = 0 on the stop; x is (D, S + 1, W, Q)."""
    count, none = rhs.shape[1], jnp.zeros_like(rhs[:, 0])

    def march(before, row):
        earlier, here = before
        diagonal, above, upper, b = row
        b = b - _matvec(diagonal, here) - _matvec(_transpose(above), earlier)
        behind = _matvec(_inverse(upper), b)
        return (here, behind), behind

    front = _solve_front(blocks, rhs, stop, none)
    rows = (
        _rows(blocks.diagonal, stop, count),
        _rows(blocks.upper, stop - 1, count - 1),
        _rows(blocks.upper, stop, count),
        _rows(rhs, stop, count),
    )
    _, behind = jax.lax.scan(march, (front[-1] if stop else none, none), rows)
    return jnp.moveaxis(jnp.concatenate([front, none[None], behind]), 0, 1)


def solve_transposed(blocks: Blocks, rhs: Array, stop: int) -> Array:
    """y (D, S, W, Q) with (dF/dw)^T y = rhs (D, S + 1, W, Q), the stop's column left out."""
    count, none = rhs.shape[1] - 1, jnp.zeros_like(rhs[:, 0])

    def march(behind, row):
        here, later = behind
        diagonal, below, upper, c = row
        c = c - _matvec(diagonal, here) - _matvec(below, later)
        before = _matvec(_inverse(_transpose(upper)), c)
        return (before, here), before

    rows = (
        _rows(blocks.diagonal, stop + 1, count + 1),
        _rows(blocks.upper, stop + 1, count + 1),
        _rows(blocks.upper, stop, count),
        _rows(rhs, stop + 1, count + 1),
    )
    _, behind = jax.lax.scan(march, (none, none), rows, reverse=True)
    front = _solve_front(blocks, rhs, stop, behind[0])
    return jnp.moveaxis(jnp.concatenate([front, behind]), 0, 1)


def stationary(hits: Array, system: System) -> Array:
    """Whether these paths are rays, (W, Q), bool: forward, on surfaces that exist, and F = 0.

    F counts as 0 where every component is within 64 times what rounding the hits to the last
    digit changes: for a camera in float64 some 1e-14 radians. Where that is more than 1e-6
    radians (2e-2 in float32), the hits determine no direction, and the path is not accepted.
    """
    # A loop over the surfaces, not arrays over them: what belongs to one stays in the cache.
    dim, surfaces, eps = hits.shape[0], hits.shape[1], jnp.finfo(hits.dtype).eps
    kinds = sorted(set(system.forms))
    rotation = None if system.rotation is None else jnp.moveaxis(system.rotation, -1, 0)
    rows = (
        np.arange(surfaces) == 0,
        jnp.moveaxis(hits, 1, 0),
        _origin(system, dim)[:, :, 0, 0].T,
        rotation,
        Shape(system.curvature, system.conic, system.coefficients.T),
        system.index[..., None],
        system.senses,
        jnp.array([kinds.index(form) for form in system.forms]),
    )

    def drawn(kind, w, shape):
        z, slope, _ = sag_derivatives(w, shape, kind)
        return z, tuple(slope), domain(w, shape, kind)

    def forward(direction, slope):
        return direction[-1] - sum(a * b for a, b in zip(slope, direction))

    def walk(carry, row):
        last, bad = carry
        first, w, origin, rotation, shape, index, sense, kind = row
        draw = [partial(drawn, kind) for kind in kinds]
        draw = draw[0] if len(kinds) == 1 else partial(jax.lax.switch, kind, draw)
        z, slope, exists = draw(w, shape)
        own = turned(rotation, (*w, z))
        # As in `geometry`: the first segment scaled, the others sums of small differences.
        step = tuple(
            jnp.where(first, system.vergence * (a + o) - s, (a - b) + (o - q))
            for a, b, o, q, s in zip(own, last["own"], origin, last["origin"], system.source)
        )
        inverse = safe_divide(jnp.ones_like(z), jnp.sqrt(sum(a * a for a in step)))
        ray = tuple(a * inverse for a in step)
        before, after = turned(rotation, ray, True), turned(last["rotation"], ray, True)
        # Of the segment in front of each surface: a far hit excuses no error of another segment.
        size = jnp.abs(w[0]) if dim == 1 else jnp.maximum(jnp.abs(w[0]), jnp.abs(w[1]))
        scale = jnp.where(first, jnp.abs(system.vergence), 1) * inverse
        shake = index * (1 + scale * jnp.maximum(size, last["size"]))
        both = last["shake"] + shake
        change = tuple(last["index"] * a - index * b for a, b in zip(last["before"], after))
        error = [jnp.abs(a + b * change[-1]) for a, b in zip(change, last["slope"])]
        error = error[0] if dim == 1 else jnp.maximum(*error)
        lean = 1 + sum(a * a for a in last["slope"])
        # Where a ray all but touches two surfaces at once, its direction between them is unknown.
        good = (error**2 <= (64 * eps * both) ** 2 * lean) & (both <= 4 / jnp.sqrt(eps))
        arrives = forward(last["before"], last["slope"]) * last["sense"]
        leaves = forward(after, last["slope"]) * sense
        good = ((good & (jnp.minimum(arrives, leaves) > 0)) | first) & exists
        new = {
            "own": own,
            "origin": origin,
            "before": before,
            "slope": slope,
            "size": size,
            "shake": shake,
            "index": index,
            "sense": sense,
            "rotation": rotation,
        }
        return (new, bad + jnp.where(good, 0, 1).astype(jnp.int32)), None

    none = jnp.zeros(hits.shape[2:], hits.dtype)
    vector = (none,) * (dim + 1)
    last = {
        "own": vector,
        "origin": rows[2][0],
        "before": vector,
        "slope": vector[:-1],
        "size": none,
        "shake": none,
        "index": rows[5][0],
        "sense": rows[6][0],
        "rotation": None if rotation is None else rotation[0],
    }
    (last, bad), _ = jax.lax.scan(walk, (last, none.astype(jnp.int32)), rows)
    return (bad == 0) & (forward(last["before"], last["slope"]) * last["sense"] > 0)
