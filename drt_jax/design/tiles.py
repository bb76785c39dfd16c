"""Rows of work, such as searches and lenses, in tiles: one program on one core for each tile."""

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from ..devices import copied, gathered, in_turn, split


def tile_size(size: int, mesh: Mesh | None) -> int:
    """Number of rows of a tile: `size` for every device."""
    return size * (mesh.size if mesh else 1)


def in_tiles(
    program: Callable, whole: tuple, rows: Any, size: int, threads: int | None, mesh: Mesh | None
) -> Iterator[Any]:
    """Yields the results of a program for each tile, with NumPy arrays.

    They do not depend on the size of tiles, on threads or devices.

    program: jitted function of `whole`, of the rows of a tile and of the mesh; its results have an
        axis of rows first.
    whole: arguments that are the same for all tiles.
    rows: pytree of NumPy arrays whose first axis is that of the rows.
    size: number of rows of a tile for every device.
    threads: number of threads; None for one per core. Not used with a mesh.
    mesh: devices that share each tile, of `devices.device_mesh`; None for the default device.
    """
    whole, count = copied(mesh, whole), len(jax.tree.leaves(rows)[0])
    size = tile_size(size, mesh)

    def run(first: int) -> Any:
        own = np.arange(first, min(first + size, count))
        taken = np.resize(own, size)  # a tile that is not full repeats its rows
        tile = split(mesh, jax.tree.map(lambda a: jnp.asarray(a[taken]), rows))
        return jax.tree.map(lambda a: a[: len(own)], gathered(program(*whole, tile, mesh)))

    # Devices that share a tile take the tiles in one order.
    yield from in_turn(run, range(0, count, size), 1 if mesh else threads)
