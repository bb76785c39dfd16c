"""Work shared by several devices, of one process or of many, by JAX's own sharding.

Data are split along their first axis, and everything else is copied to every device. Source of the
terms: JAX's pages on `jax.sharding` and `jax.shard_map`.
"""

import concurrent.futures
import dataclasses
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec


def in_turn(run: Callable, tasks: Sequence, threads: int | None = None) -> Iterator:
    """`run(task)` for each task, in order.

    The first task runs alone, so that one thread compiles the program; then threads run the others.

    run: function of a task.
    tasks: the tasks.
    threads: number of threads; None for one for each CPU core.
    """
    yield from map(run, tasks[:1])
    with concurrent.futures.ThreadPoolExecutor(threads or os.cpu_count()) as pool:
        yield from pool.map(run, tasks[1:])


def device_mesh(count: int) -> Mesh:
    """A mesh of `count` devices of the default backend in a row, with equally many of each process.

    ValueError if there are not so many devices, or if the processes cannot have equally many.
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


@dataclasses.dataclass(frozen=True)
class Shared:
    """A function whose work the devices of a mesh share, with the arguments of `shared`."""

    function: Callable
    mesh: Mesh
    whole: int

    def __call__(self, *arguments: Any) -> Any:
        rows, copy = PartitionSpec(*self.mesh.axis_names), PartitionSpec()
        specs = tuple(copy if k < self.whole else rows for k in range(len(arguments)))
        return jax.shard_map(
            self.function, mesh=self.mesh, in_specs=specs, out_specs=rows, check_vma=False
        )(*arguments)


def shared(function: Callable, mesh: Mesh | None, whole: int = 0) -> Callable:
    """A function whose work the devices of a mesh share.

    Each device calls it with its own part of the rows, without communication with the others. The
    function must treat each row independently. It works in `jit` and under differentiation as the
    function does.

    function: of pytrees; its results have an axis of rows first.
    mesh: as `device_mesh` returns it, or any mesh with one axis; None for the function itself.
    whole: number of leading arguments that every device gets whole. The first axis of all others is
        a multiple of the number of devices.
    """
    return function if mesh is None else Shared(function, mesh, whole)


def split(mesh: Mesh | None, tree: Any) -> Any:
    """Arrays with their first axis split among the devices of a mesh; unchanged without a mesh.

    Every process passes the same arrays.
    """
    return tree if mesh is None else _placed(mesh, tree, PartitionSpec(*mesh.axis_names))


def copied(mesh: Mesh | None, tree: Any) -> Any:
    """Arrays copied to every device of a mesh; unchanged without a mesh.

    Every process passes the same arrays.
    """
    return tree if mesh is None else _placed(mesh, tree, PartitionSpec())


def _placed(mesh: Mesh, tree: Any, spec: PartitionSpec) -> Any:
    """Arrays placed on the devices of a mesh."""
    sharding = NamedSharding(mesh, spec)

    def placed(leaf: Any) -> jax.Array:
        array = np.asarray(leaf)
        # device_put would first compare the arrays of all processes.
        return jax.make_array_from_callback(array.shape, sharding, lambda index: array[index])

    return jax.tree.map(placed, tree)


def gathered(tree: Any) -> Any:
    """NumPy arrays of arrays on any devices, with the rows of all processes."""

    def whole(leaf: Any) -> np.ndarray:
        local = getattr(leaf, "is_fully_addressable", True) or leaf.is_fully_replicated
        return np.asarray(leaf if local else process_allgather(leaf, tiled=True))

    return jax.tree.map(whole, tree)
