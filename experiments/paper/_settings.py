"""Settings that the paper's experiments share."""

import dataclasses
import math

from drt_jax.learn import train
from drt_jax.learn.data import DataConfig

from ._common import require_list, require_within
from ._optics import Scene, Trained, check_variables
from ._sharing import require_shared


@dataclasses.dataclass(frozen=True)
class Training:
    """Length and speed of training.

    batches: steps of each job.
    patch: side of a patch, pixels.
    variables: trained numbers of the lens, by kind, or kind and surface such as "curvature 0".
    optics_rate: Adam's learning rate of the sensor, mm; other rates follow from `Trained.scale`.
    checkpoint_every: batches between checkpoints, rounded up to reports of metrics.
    """

    batches: int
    batch: int = 16
    patch: int = 64
    variables: tuple[str, ...] = ("sensor",)
    optics_rate: float = 1e-3
    checkpoint_every: int = 200

    def __post_init__(self) -> None:
        # 7 is the window of the SSIM.
        sizes = {"batch": (1, 4096), "patch": (7, 4096), "checkpoint_every": (1, math.inf)}
        rates = {f"{name}_rate": (0, 10) for name in self.rates}
        require_within("train.", self, batches=(1, math.inf), **sizes, **rates)
        check_variables(self.variables)

    @property
    def rates(self) -> dict[str, float]:
        """Learning rates of the groups of parameters."""
        rates = {name: rate for name, rate in vars(self).items() if name.endswith("_rate")}
        return {name.removesuffix("_rate"): rate for name, rate in rates.items()}


@dataclasses.dataclass(frozen=True)
class JointTraining(Training):
    """`Training` with a network. network_rate: Adam's learning rate of the network."""

    network_rate: float = 1e-3


@dataclasses.dataclass(frozen=True)
class Net:
    """Settings of `red_net`."""

    skip_every: int = 2
    input_skip: bool = True
    layers: int = 5
    channels: int = 64

    def __post_init__(self) -> None:
        require_within("network.", self, skip_every=(0, 5), layers=(1, 50), channels=(1, 1024))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of all three experiments.

    starts_mm: sensor positions at the start of training.
    noise: standard deviation of the sensor noise, for values from 0 to 1.
    """

    starts_mm: tuple[float, ...]
    train: Training
    noise: float = 0.01
    seed: int = 0
    scene: Scene = Scene()
    camera: train.Camera = train.Camera()
    data: DataConfig = DataConfig()

    def __post_init__(self) -> None:
        require_list("starts_mm", self.starts_mm)
        require_within("", self, starts_mm=(1e-3, 1e6), noise=(0, 10))

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
    devices: that share each batch, see docs/devices.md; another number goes on with the same run.
    """

    train: JointTraining
    test_patches: int = 0
    network: Net = Net()
    devices: int = dataclasses.field(default=1, compare=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_shared(self.devices, "train.batch", self.train.batch)
