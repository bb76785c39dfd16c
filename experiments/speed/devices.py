"""Weak scaling of training over devices: the number of images per device is constant.

On a CPU the devices are virtual (JAX_NUM_CPU_DEVICES=8) and share its cores. The measurement then
shows the overhead of several devices, not a gain. `carried_bytes` is the size of the all-reduces of
a step in the compiled program; in a ring, nearly twice as much passes through each link.
"""

import dataclasses
import pathlib
import re
import sys
from collections.abc import Callable
from typing import Annotated, Any

import jax
import numpy as np

import drt_jax
from drt_jax import Scene, learn
from drt_jax.devices import copied, shared, split
from drt_jax.learn import train

from . import _command, _common, _plots, _settings, _sharing
from ._common import different, within
from .runs.folder import Run

_BYTES = {"f32": 4, "f64": 8, "s32": 4}


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/devices.yaml.

    counts: numbers of devices; the first is 1.
    images: number of images of each device in a step. patch: side of an image, pixels.
    repeats: number of turns in which the steps of all counts are timed.
    """

    counts: Annotated[tuple[int, ...], within(1, 4096), different] = (1, 2, 4, 8)
    images: Annotated[int, within(1, 4096)] = 2
    patch: Annotated[int, within(7, 4096)] = 64
    repeats: Annotated[int, within(1, 1e6)] = 20
    lens: str = "double_gauss"
    wavelengths_um: tuple[float, ...] = (0.6, 0.53, 0.48)
    network: _settings.Net = _settings.Net()

    def __post_init__(self) -> None:
        _common.require(self.counts[:1] == (1,), "counts: expected 1 first, to compare with")


def run(config: Config, run: Run) -> dict[str, Any]:
    """Times the steps of all counts, in turns.

    For each count, a step on this number of devices is compared with one of the same images on a
    single device: times, and the relative difference of the losses.
    """
    side = config.patch + train.Camera.kernel - 1
    shape = config.images * max(config.counts), side, side, 3
    scenes = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
    lens = drt_jax.load_lens(config.lens)
    init, restore = learn.red_net(**dataclasses.asdict(config.network))
    waves = config.wavelengths_um
    blur = learn.moments_model(lens, ("sensor",), Scene.point(0.0, (25e3, 25e3), waves), 1e-6)[1]
    start = {"optics": {"sensor": lens.sensor}, "network": init(jax.random.key(0))}

    def step_of(count: int, mesh: Any) -> tuple[Callable[[], float], Any]:
        """A function that runs a step with the images of `count` devices and returns its loss; and
        the lowered program."""
        imager = train.make_imager(blur, shared(restore, mesh, 1), train.Camera())
        begin, step = train.make_step(imager, {"optics": 1e-3, "network": 1e-3}, (25e3, 25e3), 0)
        state = [copied(mesh, begin(start))]
        rest = split(mesh, scenes[: count * config.images]), np.float32(0.01), np.int32(0)

        def take() -> float:
            state[0], found = step(state[0], *rest)
            return float(found["loss"])

        return take, step.lower(state[0], *rest)

    rows, calls = [], []
    for count in config.counts:
        alone, _ = step_of(count, None)
        together, lowered = step_of(count, _sharing.mesh_of(count))
        carried = 0
        for result in re.findall(r"= (.*?) all-reduce(?:-start)?\(", lowered.compile().as_text()):
            for kind, shape in re.findall(r"(\w+)\[([\d,]*)\]", result):
                numbers = np.prod([int(n) for n in shape.split(",") if n])
                carried += _BYTES.get(kind, 4) * int(numbers)
        row = {"devices": count, "images": count * config.images, "carried_bytes": carried}
        rows.append(row | {"loss_apart": abs(together() / alone() - 1)})
        calls += [together, alone]
    seconds = np.reshape(_common.medians(calls, config.repeats), (-1, 2))
    for row, pair in zip(rows, seconds.tolist()):
        row |= dict(zip(("step_s", "alone_s"), pair))
    weights = train.count_parameters(start["network"])
    return {"rows": rows, "device": jax.devices()[0].device_kind, "weights": weights}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """The table of counts."""
    header = ["devices", "images a step", "s a step", "s a step of one device"]
    header += ["MB added up a step", "loss apart"]
    rows = []
    for row in results["rows"]:
        cells = [row[name] for name in ("devices", "images", "step_s", "alone_s")]
        rows.append([*cells, 1e-6 * row["carried_bytes"], f"{row['loss_apart']:.1e}"])
    return {f"devices, {results['device']}": _common.table(header, rows)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the time per image over the number of devices."""
    rows = results["rows"]
    counts = [row["devices"] for row in rows]
    with _plots.picture(figures / "scaling.png", 6, 4) as (axes,):
        for key, label in (("step_s", "shared"), ("alone_s", "one device, as many images")):
            axes.plot(counts, [1e3 * row[key] / row["images"] for row in rows], "o-", label=label)
        axes.set_xscale("log", base=2)
        axes.set_xticks(counts, counts)
        axes.set(xlabel="devices", ylabel="time of an image, ms", ylim=(0, None))
        axes.legend()


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
