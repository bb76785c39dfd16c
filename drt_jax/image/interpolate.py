"""Interpolation by local polynomials on equidistant nodes, and of pictures by cubic convolution."""

import jax
import jax.numpy as jnp
from jax import Array

from ..numerics import tensordot


def lagrange(place: Array, count: int, order: int) -> tuple[Array, Array]:
    """Weights of local Lagrange interpolation on equidistant nodes.

    place: (...), position in units of nodes 0 to count - 1.
    count: number of nodes.
    order: number of nodes that a value is interpolated from, the nearest ones.

    Returns the index (...), int32, of the first of these nodes and the weights (..., order). The
    interpolation is continuous, and exact for polynomials of degree order - 1. Outside of the nodes
    the outermost polynomial extrapolates.
    """
    order = min(order, count)
    known = jax.lax.stop_gradient(place)
    first = jnp.clip(jnp.floor(known) - (order - 1) // 2, 0, count - order)
    offset = place - first
    nodes = range(order)
    parts = []
    for j in nodes:
        factors = [(offset - m) / (j - m) for m in nodes if m != j]
        parts.append(jnp.prod(jnp.stack(factors), axis=0) if factors else jnp.ones_like(offset))
    return first.astype(jnp.int32), jnp.stack(parts, axis=-1)


def basis(place: Array, count: int, order: int) -> Array:
    """Matrix (N, count) that interpolates values at nodes 0 to count - 1 to places (N,); `order`
    as in `lagrange`."""
    first, weights = lagrange(place, count, order)
    columns = first[:, None] + jnp.arange(weights.shape[1], dtype=first.dtype)[None]
    chosen = columns[:, :, None] == jnp.arange(count, dtype=first.dtype)[None, None]
    return jnp.sum(jnp.where(chosen, weights[:, :, None], 0), axis=1)


def at_point(table: Array, place: Array, order: int) -> Array:
    """A table interpolated at one point.

    table: (Ny, Nx, ...).
    place: (2,), x and y in units of nodes.
    order: as in `lagrange`.

    Returns an array (...).
    """
    for where in (place[1], place[0]):
        first, weights = lagrange(where, table.shape[0], order)
        rows = jax.lax.dynamic_slice_in_dim(table, first, weights.shape[0], axis=0)
        table = tensordot(weights, rows, axes=1)
    return table


def cubic(picture: Array, y: Array, x: Array) -> Array:
    """A picture interpolated by cubic convolution, which is of third order.

    picture: (H, W, C).
    y, x: (C, ...), places for each colour, in pixels. Outside of the picture its edge pixels apply.

    Returns an array (C, ...). Source: Keys, IEEE Trans. ASSP 29, 1153 (1981).
    """
    height, width, colours = picture.shape
    (row, down), (column, across) = (_keys(a, n) for a, n in ((y, height), (x, width)))
    colour = jnp.arange(colours, dtype=row.dtype).reshape(-1, *[1] * (y.ndim - 1))
    rows = [jnp.clip(row + k, 0, height - 1) * (width * colours) for k in range(-1, 3)]
    columns = [jnp.clip(column + k, 0, width - 1) * colours + colour for k in range(-1, 3)]
    flat = picture.reshape(-1)
    lines = []
    for start in rows:
        parts = [w * flat[start + c] for w, c in zip(across, columns, strict=True)]
        lines.append(sum(parts[1:], parts[0]))
    total = [w * line for w, line in zip(down, lines, strict=True)]
    return sum(total[1:], total[0])


def _keys(place: Array, count: int) -> tuple[Array, list[Array]]:
    """Index of the pixel before `place`, and the weights of the four pixels around it."""
    inside = jnp.clip(place, 0, count - 1)
    first = jnp.floor(jax.lax.stop_gradient(inside))
    s = inside - first
    weights = [
        s * (-0.5 + s * (1 - 0.5 * s)),
        1 + s * s * (-2.5 + 1.5 * s),
        s * (0.5 + s * (2 - 1.5 * s)),
        s * s * (-0.5 + 0.5 * s),
    ]
    return first.astype(jnp.int32), weights
