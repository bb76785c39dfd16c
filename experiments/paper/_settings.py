"""Settings that the paper's experiments share."""

import dataclasses
import math
from typing import Annotated

from drt_jax.learn import train
from drt_jax.learn.data import DataConfig

from ._common import Numbers, different, not_empty, within
from ._optics import Scene, Trained, variable_names
from ._sharing import require_shared


@dataclasses.dataclass(frozen=True)
class Training:
    """Length and rates of training.

    batches: number of steps of each job.
    patch: side of a patch, pixels.
    variables: trained numbers of the lens, by kind, or kind and surface such as "curvature 0".
    optics_rate: Adam's learning rate of the sensor, mm; the rates of other numbers follow from
        `Trained.scale`.
    checkpoint_every: number of batches between checkpoints, rounded up to the next report of
        metrics.
    """

    batches: Annotated[int, within(1, math.inf)]
    batch: Annotated[int, within(1, 4096)] = 16
    patch: Annotated[int, within(7, 4096)] = 64  # 7 is the window of the SSIM
    variables: Annotated[tuple[str, ...], not_empty, different, variable_names] = ("sensor",)
    optics_rate: Annotated[float, within(0, 10)] = 1e-3
    checkpoint_every: Annotated[int, within(1, math.inf)] = 200


@dataclasses.dataclass(frozen=True)
class JointTraining(Training):
    """`Training` with a network. network_rate: Adam's learning rate of the network."""

    network_rate: Annotated[float, within(0, 10)] = 1e-3


@dataclasses.dataclass(frozen=True)
class Net:
    """Settings of `red_net`."""

    skip_every: Annotated[int, within(0, 5)] = 2
    input_skip: bool = True
    layers: Annotated[int, within(1, 50)] = 5
    channels: Annotated[int, within(1, 1024)] = 64


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all three experiments.

    starts_mm: sensor positions at the start of training.
    noise: standard deviation of the sensor noise, for values from 0 to 1.
    """

    starts_mm: Annotated[Numbers, within(1e-3, 1e6)]
    train: Training
    noise: Annotated[float, within(0, 10)] = 0.01
    seed: int = 0
    scene: Scene = Scene()
    camera: train.Camera = train.Camera()
    data: DataConfig = DataConfig()

    @property
    def columns(self) -> tuple[str, ...]:
        """Further columns of metrics.csv: the trained numbers of the lens."""
        return Trained.of(self.scene.lens, self.train.variables).names

    @property
    def paper(self) -> bool:
        """True if the paper has numbers for these settings: its lens, wavelengths and distances,
        and only the sensor trained."""
        usual = {field.name: field.default for field in dataclasses.fields(self)}
        here = vars(self) | {"scene": dataclasses.replace(self.scene, tolerance=Scene.tolerance)}
        same = all(here[n] == usual[n] for n in ("scene", "distance_m", "depth_m") if n in usual)
        return same and self.train.variables == ("sensor",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointSettings(Settings):
    """Settings with a network.

    test_patches: number of test patches; 0 for all.
    devices: number of devices for each batch, see docs/devices.md; a run can be resumed with
        another number.
    """

    train: JointTraining
    test_patches: int = 0
    network: Net = Net()
    devices: int = dataclasses.field(default=1, compare=False)

    def __post_init__(self) -> None:
        require_shared(self.devices, "train.batch", self.train.batch)
