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
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

import drt_jax
from drt_jax import show
from drt_jax.devices import copied, shared, split
from drt_jax.learn import train

from . import _command, _common, _sharing, _training
from .runs.folder import Run

COLUMNS = ()
_BYTES = {"f32": 4, "f64": 8, "s32": 4}


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/devices.yaml.

    counts: of devices, the first 1.
    images: of each device in a step. patch: side of an image, pixels.
    steps: timed for each count.
    """

    counts: tuple[int, ...] = (1, 2, 4, 8)
    images: int = 2
    patch: int = 64
    steps: int = 20
    lens: str = "double_gauss"
    wavelengths_um: tuple[float, ...] = (0.6, 0.53, 0.48)
    network: _training.Net = _training.Net()

    def __post_init__(self) -> None:
        limits = {"counts": (1, 4096), "images": (1, 4096), "patch": (7, 4096), "steps": (1, 1e6)}
        _common.require_within("", self, **limits)
        _common.require_different("counts", self.counts)
        _common.require(self.counts[:1] == (1,), "counts: expected 1 first, to compare with")


def run(config: Config, run: Run) -> dict[str, Any]:
    """Times the steps of all counts, in turns."""
    seeds = np.random.default_rng(0)
    side = config.patch + train.Camera.kernel - 1
    most = config.images * max(config.counts)
    scenes = seeds.integers(0, 255, (most, side, side, 3), np.uint8)
    jobs = [_job(config, count, scenes[: count * config.images]) for count in config.counts]
    times: list[list[float]] = [[] for _ in jobs]
    for _ in tqdm(range(config.steps), unit="step", leave=False):
        for step, taken in zip(jobs, times):
            step()  # threads of the program before may still spin
            begun = time.perf_counter()
            step()
            taken.append(time.perf_counter() - begun)
    rows = []
    for count, step, taken in zip(config.counts, jobs, times):
        seconds = float(np.median(taken))
        row = {"devices": count, "images": count * config.images, "step_s": seconds}
        rows.append(row | {"image_s": seconds / (count * config.images), **step.about})
    device = jax.devices()[0]
    return {"rows": rows, "device": device.device_kind, "weights": jobs[0].weights}


class _job:
    """Steps of training on some devices.

    about: bytes that all devices add up, and the difference of the first loss from that of one
        device with the same images, relative.
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

        def made(mesh: Any) -> tuple[Any, Any, np.ndarray]:
            imager = train.make_imager(blur, shared(restore, mesh, 1), train.Camera())
            rates = {"optics": 1e-3, "network": 1e-3}
            begin, step = train.make_step(imager, rates, (25e3, 25e3), 0)
            return copied(mesh, begin(start)), step, split(mesh, scenes)

        noise, first = np.float32(0.01), np.int32(0)
        state, alone, own = made(None)
        reference = float(alone(state, own, noise, first)[1]["loss"])
        self._state, self._step, self._scenes = made(mesh)
        lowered = self._step.lower(self._state, self._scenes, noise, first)
        carried = _carried(lowered.compile().as_text())
        loss = self()
        self.about = {"carried_bytes": carried, "loss_apart": abs(loss / reference - 1)}

    def __call__(self) -> float:
        """The loss of a step."""
        given = self._scenes, np.float32(0.01), np.int32(0)
        self._state, found = self._step(self._state, *given)
        return float(found["loss"])


def _carried(program: str) -> int:
    """Bytes that the devices of a compiled program add up."""
    total = 0
    for result in re.findall(r"= (.*?) all-reduce(?:-start)?\(", program):
        for kind, shape in re.findall(r"(\w+)\[([\d,]*)\]", result):
            total += _BYTES.get(kind, 4) * int(np.prod([int(n) for n in shape.split(",") if n]))
    return total


def tables(results: dict[str, Any]) -> dict[str, str]:
    """The table of counts."""
    header = ["devices", "images a step", "s a step", "ms an image", "against one device"]
    header += ["MB added up a step", "loss apart"]
    rows, one = [], results["rows"][0]["image_s"]
    for row in results["rows"]:
        cells = [row["devices"], row["images"], row["step_s"], 1e3 * row["image_s"]]
        cells += [row["image_s"] / one, 1e-6 * row["carried_bytes"], f"{row['loss_apart']:.1e}"]
        rows.append(cells)
    return {f"devices, {results['device']}": _common.table(header, rows)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the time of an image over the number of devices."""
    figure, axes = show.new(width=6, height=4)
    counts = [row["devices"] for row in results["rows"]]
    axes.plot(counts, [1e3 * row["image_s"] for row in results["rows"]], "o-")
    axes.set_xscale("log", base=2)
    axes.set_ylim(0)
    axes.set_xlabel("devices")
    axes.set_ylabel("time of an image, ms")
    figure.savefig(figures / "scaling.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
