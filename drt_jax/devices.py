"""Work shared by several devices, of one process or of many, by JAX's own sharding: data are split
along their first axis, everything else is copied to every device.

Source of the terms: JAX's pages on `jax.sharding` and `jax.shard_map`.
"""

import concurrent.futures
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec


def in_turn(run: Callable, tasks: Sequence, threads: int | None = None) -> Iterator:
    """`run(task)` of each task, in order: the first alone, so that one thread compiles it, then by
    threads, by default one for each CPU core."""
    yield from map(run, tasks[:1])
    with concurrent.futures.ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        yield from pool.map(run, tasks[1:])


def device_mesh(count: int) -> Mesh:
    """`count` devices of the default backend in a row, as many of each process.

    ValueError if there are not so many, or if the processes cannot have equally many.
    """
    processes, here = jax.process_count(), jax.local_device_count()
    each, rest = divmod(count, processes)
    if rest or not each:
        raise ValueError(
            f"devices: {count} cannot be shared by {processes} processes: give a multiple"
        )
    if each > here:
        kind = jax.default_backend()
        where = "here" if processes == 1 else "in each process"
        raise ValueError(
            f"devices: {each} of kind {kind} are asked, {here} {'is' if here == 1 else 'are'} "
            f"{where}: lower it" + (f", or set JAX_NUM_CPU_DEVICES={each}" if kind == "cpu" else "")
        )
    own: dict[int, list[jax.Device]] = {}
    for device in jax.devices():
        own.setdefault(device.process_index, []).append(device)
    chosen = [device for some in own.values() for device in some[:each]]
    return jax.make_mesh((count,), ("rows",), axis_types=(AxisType.Auto,), devices=chosen)


def shared(function: Callable, mesh: Mesh | None, whole: int = 0) -> Callable:
    """A function whose work the devices of a mesh share: each calls it with its own part of the
    rows, without a word to the others. The function must treat each row alone. It works in `jit`
    and under differentiation as the function does.

    function: of pytrees; results have an axis of rows first.
    mesh: of `device_mesh`, or any with one axis; None for the function itself.
    whole: number of leading arguments that every device gets whole. The first axis of all others
        is a multiple of the number of devices.
    """
    if mesh is None:
        return function
    rows, copy = PartitionSpec(*mesh.axis_names), PartitionSpec()

    def call(*arguments: Any) -> Any:
        specs = tuple(copy if k < whole else rows for k in range(len(arguments)))
        return jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=rows, check_vma=False)(
            *arguments
        )

    return call


def split(mesh: Mesh | None, tree: Any) -> Any:
    """Arrays with their first axis split among the devices of a mesh; without one, as they are.
    Every process gives the same."""
    return tree if mesh is None else _placed(mesh, tree, PartitionSpec(*mesh.axis_names))


def copied(mesh: Mesh | None, tree: Any) -> Any:
    """Arrays copied to every device of a mesh; without one, as they are. Every process gives the
    same."""
    return tree if mesh is None else _placed(mesh, tree, PartitionSpec())


def _placed(mesh: Mesh, tree: Any, spec: PartitionSpec) -> Any:
    sharding = NamedSharding(mesh, spec)

    def placed(leaf: Any) -> jax.Array:
        array = np.asarray(leaf)
        # Not device_put, which compares the arrays of all processes first.
        return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])

    return jax.tree.map(placed, tree)


def gathered(tree: Any) -> Any:
    """NumPy arrays of arrays on any devices, the rows of all processes included."""

    def whole(leaf: Any) -> np.ndarray:
        local = getattr(leaf, "is_fully_addressable", True) or leaf.is_fully_replicated
        return np.asarray(leaf if local else process_allgather(leaf, tiled=True))

    return jax.tree.map(whole, tree)
