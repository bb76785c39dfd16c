"""Large bundles: rays launched by polynomials, in tiles that fit the cache of a core.

The launch point of a ray is a smooth function of its stop point. Polynomials of the stop point are
fitted to the launch points of a few hundred aimed rays. They launch all other rays of the bundle,
which then meet their stop points to rounding. Rays that do not are searched for.
"""

import operator
from collections.abc import Callable
from itertools import accumulate
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from ..numerics import einsum, tensordot
from .aim import aim, beam_size, paraxial_launch
from .status import Status
from .system import System, Vector, dot, where

# Bundles of more than `_MANY` rays for each wavelength are launched by polynomials and solved in
# tiles of `_TILE` rays (all wavelengths together), whose arrays on one surface fit the cache of a
# core. Derivatives need 0.9 kB for each ray and row, 21 MB for `_DERIVATIVES` rays times rows. The
# allocator returns blocks above 32 MB to the operating system after each call, which takes longer
# than the computation.
_MANY, _TILE, _DERIVATIVES = 1024, 2048, 24_000
# In a Double Gauss at 10 degrees, rays miss their stop points by 1e-13 mm with degree 18, by
# 1e-10 mm with degree 14.
_DEGREE = 18


def tile_of(rays: int, waves: int) -> int:
    """Number of rays for each wavelength that are found at once: a whole bundle, or one tile of it.

    rays: number of rays for each wavelength.
    waves: number of wavelengths.
    """
    size = max(_TILE // waves, 64)
    return rays if rays <= max(_MANY, size) else size


def derivative_tile(waves: int, rows: int) -> int:
    """Number of rays for each wavelength whose derivatives are computed at once.

    waves: number of wavelengths.
    rows: number of rows of the system.
    """
    return max(min(_TILE, _DERIVATIVES // rows) // waves, 64)


def in_tiles(function: Callable, most: int, *trees: Any) -> Any:
    """Evaluates `function(*trees)` in tiles of at most `most` rays.

    function: takes and returns arrays with rays on the last axis. Reverse mode evaluates it again
        for each tile, so that only its arguments are stored.
    trees: pytrees of arrays (..., W, Q).
    """
    rays = jax.tree.leaves(trees)[0].shape[-1]
    tiles = -(-rays // most)
    if tiles == 1:
        return function(*trees)
    size = -(-rays // tiles)

    def split(a):
        a = jnp.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, tiles * size - rays)], mode="edge")
        return jnp.moveaxis(a.reshape(*a.shape[:-1], tiles, size), -2, 0)

    def join(a):
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], tiles * size)[..., :rays]

    once = jax.checkpoint(function, prevent_cse=False)
    parts = jax.lax.map(lambda part: once(*part), jax.tree.map(split, trees))
    return jax.tree.map(join, parts)


def _nodes() -> np.ndarray:
    """Points (2, N) of the fit on the unit disc: Gauss nodes in r^2, uniform azimuths."""
    nodes, _ = np.polynomial.legendre.leggauss(_DEGREE // 2 + 2)
    radius = np.sqrt((nodes + 1) / 2)
    angle = np.pi * np.arange(2 * _DEGREE + 4) / (_DEGREE + 2)
    return np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))]).reshape(
        2, -1
    )


def polynomial_launch(system: System, target: Vector) -> Callable[[Vector], Vector]:
    """Fits polynomials of degree 18 in the stop point to the launch points of aimed rays.

    With the monomials x^i y^j at the nodes as the columns of a matrix V = B T (QR factorisation),
    the coefficients are T^-1 B^T launch.

    target: 2 arrays (W, Q), stop points, mm. The fit covers the disc about the axis that contains
        them.

    Returns a function from stop points to launch points, 2 arrays (W, N) each, mm, for any N. It
    returns the paraxial launch if a ray of the fit fails.
    """
    points = _nodes()
    radius = jnp.sqrt(jnp.max(dot(target, target)))
    waves = target[0].shape[0]
    scaled = radius * jnp.asarray(points, radius.dtype)
    nodes = tuple(jnp.broadcast_to(p, (waves, p.size)) for p in scaled)
    sizes, upright = beam_size(system, nodes), system.rows.rotation is None
    aimed = aim(system, nodes, paraxial_launch(system, nodes, sizes[1]), sizes, upright)
    all_ok = jnp.all(aimed.status == Status.OK)

    pairs = np.array([(i, d - i) for d in range(_DEGREE + 1) for i in range(d + 1)])
    # Fit in an orthogonal basis ordered by degree. Its coefficients decrease as fast as the entries
    # of the inverse triangle increase, so that no digit is lost.
    basis, triangle = np.linalg.qr(np.prod(points.T[:, None] ** pairs, axis=-1))
    launch = jnp.stack(aimed.launch)
    projections = tensordot(jnp.asarray(basis.T, launch.dtype), launch, axes=(1, 2))
    terms = tensordot(jnp.asarray(np.linalg.inv(triangle), launch.dtype), projections, axes=1)
    empty = jnp.zeros((_DEGREE + 1, _DEGREE + 1, *terms.shape[1:]), launch.dtype)
    coefficients = empty.at[pairs[:, 0], pairs[:, 1]].set(terms)

    def at(target):
        one = jnp.ones_like(target[0])
        powers = (accumulate([one, *[a / radius] * _DEGREE], operator.mul) for a in target)
        x, y = (jnp.stack([*each]) for each in powers)  # x^0 to x^18, y^0 to y^18
        rows = einsum("ijdw,jwq->idwq", coefficients, y)
        fitted = sum((rows[i] * x[i][None] for i in range(1, _DEGREE + 1)), rows[0])
        start = paraxial_launch(system, target, sizes[1])
        return where(all_ok, tuple(fitted), start)

    return at
