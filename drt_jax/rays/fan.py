"""A fan of rays over the first surface: first guesses for rays that aiming does not find."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from .snell import shoot, split_stop
from .status import Status
from .system import System, Vector, dot

# The fan has `_TILES` tiles per side, each with `_FAN` rays per side. The first guesses for a stop
# point are taken from its `STARTS` nearest tiles: from each tile the ray that crosses the stop
# nearest to the stop point.
_TILES, _FAN, STARTS = 15, 5, 24


def _fan(dim: int, rays: int) -> np.ndarray:
    """Launch points (D, tiles, rays of a tile) between -1 and 1, denser in the middle.

    dim: D, number of transverse components.
    rays: number of rays per side of a tile.
    """
    side = np.linspace(-1, 1, _TILES * rays)
    side = (side * (0.3 + 0.7 * side**2)).reshape(_TILES, rays)
    indices = np.meshgrid(*[np.arange(side.size)] * dim, indexing="ij")
    points = side.ravel()[np.stack(indices)].reshape(dim, *(_TILES, rays) * dim)
    tiles = (0, *range(1, 2 * dim, 2), *range(2, 2 * dim + 1, 2))
    return points.transpose(tiles).reshape(dim, _TILES**dim, rays**dim)


class Fan(NamedTuple):
    """A fan of rays over the first surface.

    launch: D arrays (tiles, rays of a tile), launch points, mm.
    stop: D arrays (W, tiles, rays of a tile), crossings of the stop by the rays that reach the
        sensor, mm; inf for the others.
    """

    launch: Vector
    stop: Vector


def no_fan(system: System, waves: int, rays: int = _FAN) -> Fan:
    """A fan before it is traced, with launch points scaled to -1 to 1.

    waves: number of wavelengths.
    rays: number of rays per side of a tile.
    """
    points = jnp.asarray(_fan(system.dim, rays), system.index.dtype)
    nowhere = jnp.full((waves, *points.shape[1:]), jnp.inf, points.dtype)
    return Fan(tuple(points), (nowhere,) * system.dim)


def trace_fan(system: System, fan: Fan, tried: Vector, width: Array) -> Fan:
    """Traces a fan.

    Pass `fan` and `tried` through the carry of the loop in which this is called: XLA moves work
    that does not depend on the loop out of it, and would trace the fan even when no ray is missing.

    fan: the fan of `no_fan`.
    tried: D arrays (W, Q), launch points already tried, mm; the fan reaches at least 1.6 times as
        far.
    width: (), radius of the beam on the first surface, mm; the fan reaches at least twice as far.
    """
    extent = jnp.maximum(2 * width, 1.6 * jnp.sqrt(jnp.max(dot(tried, tried))))
    launch = tuple(extent * a for a in fan.launch)
    shape = fan.stop[0].shape
    flat = tuple(jnp.broadcast_to(a.reshape(1, -1), (shape[0], a.size)) for a in launch)
    trace = shoot(system, flat)
    _, stop = split_stop(system, trace.hits)
    ok = trace.status == Status.OK
    return Fan(launch, tuple(jnp.where(ok, a, jnp.inf).reshape(shape) for a in stop))


def nearest_start(fan: Fan, target: Vector) -> Vector:
    """One first guess for each stop point, D arrays (W, Q), launch points, mm.

    Each tile offers its ray that crosses the stop nearest to the centre of the stop; of these rays,
    the one nearest to the stop point is taken.

    fan: a traced fan.
    target: D arrays (W, Q), stop points, mm.
    """
    central = jnp.argmin(dot(fan.stop, fan.stop), axis=-1)  # (W, tiles)
    stop = (jnp.take_along_axis(a, central[..., None], axis=-1)[..., 0] for a in fan.stop)
    gaps = (a[..., None] - b[:, None] for a, b in zip(target, stop, strict=True))
    tile = jnp.argmin(sum(g * g for g in gaps), axis=-1)
    return tuple(a[tile, jnp.take_along_axis(central, tile, axis=-1)] for a in fan.launch)


def starts_of(fan: Fan, target: Vector, ranks: Array) -> Vector:
    """N first guesses for each of K stop points, D arrays (W, K, N), launch points, mm.

    Each is the ray of a tile that crosses the stop nearest to the stop point. The tiles are chosen
    by their ranks, in the order of this distance.

    fan: a traced fan.
    target: D arrays (W, K), stop points, mm.
    ranks: (W, K, N), int32, ranks of tiles, 0 for the nearest.
    """
    gaps = (a[:, :, None, None] - b[:, None] for a, b in zip(target, fan.stop, strict=True))
    far = sum(g * g for g in gaps)  # (W, K, tiles, rays)
    near, which = jnp.min(far, axis=-1), jnp.argmin(far, axis=-1)
    order = jax.lax.top_k(-near, min(STARTS, near.shape[-1]))[1]
    order = jnp.take_along_axis(order, ranks, axis=-1, mode="clip")
    chosen = jnp.take_along_axis(which, order, axis=-1)
    return tuple(a[order, chosen] for a in fan.launch)
