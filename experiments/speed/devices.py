"""Weak scaling of training over devices: each has as many images, whatever their number.

On a CPU the devices are virtual (JAX_NUM_CPU_DEVICES=8) and share its cores: what is measured is
the cost of sharing, not a gain. `carried_bytes` is what the devices add up in a step, as the
compiled program says; a ring carries nearly twice that through each of its links.
"""

import dataclasses
import pathlib
import re
import sys
import time
from typing import Annotated, Any

import jax
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import show
from drt_jax.devices import copied, shared, split
from drt_jax.learn import train

from . import _command, _common, _settings, _sharing
from ._common import different, within
from .runs.folder import Run

_BYTES = {"f32": 4, "f64": 8, "s32": 4}


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/devices.yaml.

    counts: of devices, the first 1.
    images: of each device in a step. patch: side of an image, pixels.
    repeats: steps that are timed for each count.
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
    """Times the steps of all counts, in turns."""
    seeds = np.random.default_rng(0)
    side = config.patch + train.Camera.kernel - 1
    most = config.images * max(config.counts)
    scenes = seeds.integers(0, 255, (most, side, side, 3), np.uint8)
    jobs = [_Job(config, count, scenes[: count * config.images]) for count in config.counts]
    ways = [way for job in jobs for way in (job.shared, job.alone)]
    times: list[list[float]] = [[] for _ in ways]
    for _ in tqdm(range(config.repeats), unit="step", leave=False):
        for way, taken in zip(ways, times):
            way()  # threads of the program before may still spin
            begun = time.perf_counter()
            way()
            taken.append(time.perf_counter() - begun)
    seconds = np.reshape([np.median(taken) for taken in times], (-1, 2)).tolist()
    rows = []
    for count, job, (shared_s, alone_s) in zip(config.counts, jobs, seconds):
        row = {"devices": count, "images": count * config.images, **job.about}
        rows.append(row | {"step_s": shared_s, "alone_s": alone_s})
    device = jax.devices()[0]
    return {"rows": rows, "device": device.device_kind, "weights": jobs[0].weights}


class _Job:
    """Steps of training on some devices, and on one with the same images.

    shared, alone: functions that take a step and return its loss.
    about: bytes that all devices add up in a step, and the relative difference of the first loss.
    weights: of the network.
    """

    def __init__(self, config: Config, count: int, scenes: np.ndarray) -> None:
        mesh = _sharing.mesh_of(count)
        lens = drt_jax.load_lens(config.lens)
        init, restore = drt_jax.red_net(**dataclasses.asdict(config.network))
        waves = config.wavelengths_um
        blur = drt_jax.moments_model(lens, ("sensor",), 0.0, (25e3, 25e3), waves, 1e-6)[1]
        weights = init(jax.random.key(0))
        self.weights = train.count_parameters(weights)
        start = {"optics": {"sensor": lens.sensor}, "network": weights}

        def made(mesh: Any) -> tuple[Any, Any]:
            imager = train.make_imager(blur, shared(restore, mesh, 1), train.Camera())
            rates = {"optics": 1e-3, "network": 1e-3}
            begin, step = train.make_step(imager, rates, (25e3, 25e3), 0)
            state = [copied(mesh, begin(start))]
            rest = split(mesh, scenes), np.float32(0.01), np.int32(0)

            def take() -> float:
                state[0], found = step(state[0], *rest)
                return float(found["loss"])

            return take, step.lower(state[0], *rest)

        self.alone, _ = made(None)
        self.shared, lowered = made(mesh)
        carried = _carried(lowered.compile().as_text())
        apart = abs(self.shared() / self.alone() - 1)
        self.about = {"carried_bytes": carried, "loss_apart": apart}


def _carried(program: str) -> int:
    """Bytes that the devices of a compiled program add up."""
    total = 0
    for result in re.findall(r"= (.*?) all-reduce(?:-start)?\(", program):
        for kind, shape in re.findall(r"(\w+)\[([\d,]*)\]", result):
            total += _BYTES.get(kind, 4) * int(np.prod([int(n) for n in shape.split(",") if n]))
    return total


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
    """Draws the time of an image over the number of devices."""
    figure, axes = show.new(width=6, height=4)
    rows = results["rows"]
    counts = [row["devices"] for row in rows]
    for key, label in (("step_s", "shared"), ("alone_s", "one device, as many images")):
        axes.plot(counts, [1e3 * row[key] / row["images"] for row in rows], "o-", label=label)
    axes.set_xscale("log", base=2)
    axes.set_xticks(counts, counts)
    axes.set(xlabel="devices", ylabel="time of an image, ms", ylim=(0, None))
    axes.legend()
    figure.savefig(figures / "scaling.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
