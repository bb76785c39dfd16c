"""The photograph that a lens takes: `python -m experiments.render photo.jpg --set scene.lens=...`.

The photograph is used as the image of a pinhole camera with the lens's focal length; its pixels are
those of the sensor. Its values are linearised by the curve of sRGB, which also encodes the result.
Beyond its border the photograph is extended by its edge values. Writes ideal.png and photo.png, of
the same size, and both side by side, into figures.
"""

import dataclasses
import math
import os
import pathlib
import sys
import time
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from skimage import data
from tqdm import tqdm

import drt_jax
from drt_jax.inputs import one_line
from drt_jax.learn import images

from . import _command, _common, _plots
from ._common import LensFile, odd, or_zero, three_colours, within
from .runs.config import ConfigError
from .runs.folder import Run

# Bytes for each value of a picture, for the picture, its light, the result and intermediate arrays.
_BYTES = 40
_positive = within(np.nextafter(0, 1), math.inf)
_BEYOND = 1e-3  # fraction of light outside the kernels above which the table warns


@dataclasses.dataclass(frozen=True)
class Scene(LensFile):
    """The lens and its scene.

    wavelengths_um: wavelengths of R, G, B.
    distance_m: distance of the object, .inf for infinity; null for that of a .zmx or .seq file,
        and infinity for other lenses.
    depth: picture of the size of the photograph, linear in 1 / distance, white for `near_m`, black
        for the distance of the object; empty for all at that distance.
    near_m: nearest distance of `depth`.
    """

    lens: str = "double_gauss"
    wavelengths_um: Annotated[tuple[float, ...], three_colours] = (0.6, 0.53, 0.48)
    distance_m: Annotated[float, _positive] | None = None
    depth: str = ""
    near_m: Annotated[float, _positive] = 1.0


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/render.yaml.

    photo: path of a file, or "bundled".
    pixel_um: side of a pixel; 0 to spread the photograph over `field_deg`.
    field_deg: field angle of the corners.
    kernel: side of a kernel, pixels; 0 for the size that the blur needs.
    nodes: number of fields on one side of the axis.
    full_well, read_noise: of the sensor, electrons; a full well of 0 for no noise.
    """

    photo: str = "bundled"
    pixel_um: Annotated[float, or_zero(within(0.05, 1e4))] = 0.0
    field_deg: Annotated[float, within(0.01, 60)] = 12.0
    model: Literal["gaussian", "rays", "waves", "auto"] = "rays"
    kernel: Annotated[int, within(0, 255), or_zero(odd)] = 0
    nodes: Annotated[int, within(2, 64)] = 16
    layers: Annotated[int, within(2, 64)] = 8
    full_well: Annotated[float, within(0, 1e9)] = 10000.0
    read_noise: Annotated[float, within(0, 1e6)] = 3.0
    seed: int = 0
    scene: Scene = dataclasses.field(default_factory=Scene)


def linear(pixels: np.ndarray) -> np.ndarray:
    """Linear light of 8-bit values, by the curve of sRGB (IEC 61966-2-1): float32, 0 to 1."""
    level = np.arange(256) / 255
    curve = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return curve.astype(np.float32)[pixels]


def encoded(light: np.ndarray) -> np.ndarray:
    """8-bit values of linear light, which is clipped to 0 to 1, by the curve of sRGB."""
    level = np.clip(light, 0, 1)
    curve = np.where(level <= 0.0031308, 12.92 * level, 1.055 * level ** (1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(np.uint8)


def _read(key: str, name: str) -> np.ndarray:
    """Reads a picture, uint8 (H, W, 3). ConfigError if it cannot be read or is too large."""
    if name == "bundled":
        return np.asarray(data.astronaut())
    path = pathlib.Path(name).expanduser()
    try:
        width, height = images.look(path)
        needed = 3 * width * height * _BYTES
        room = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
        if needed > room:
            raise ValueError(
                f"{width} x {height} pixels take {needed / 1e9:.1f} GB, there are {room / 1e9:.1f}"
            )
        return images.read(path)
    except Exception as error:  # an image reader may raise anything on a damaged file
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise ConfigError(one_line(f"{key}: {name}: {reason}")) from error


def _distance(config: Config, shape: tuple[int, int]) -> Any:
    """Distance of the object, a number or (H, W), mm."""
    scene = config.scene
    far = scene.distance() if scene.distance_m is None else 1e3 * scene.distance_m
    if not scene.depth:
        return far
    grey = _read("scene.depth", scene.depth).mean(axis=-1) / 255
    if grey.shape != shape:
        sizes = f"{grey.shape[1]} x {grey.shape[0]}, the photograph {shape[1]} x {shape[0]}"
        raise ConfigError(f"scene.depth: {scene.depth} has {sizes} pixels: give one of its size")
    vergence, near = 1 / far, 1e-3 / scene.near_m
    with np.errstate(divide="ignore"):
        return 1 / (vergence + (near - vergence) * grey)


def run(config: Config, run: Run) -> dict[str, Any]:
    """Renders the photograph.

    The side of a pixel is given, or follows from the focal length and the field in the corners.
    `converge` chooses kernels and grid, `render` blurs the linear light, and noise is added last.
    """
    pixels = _read("photo", config.photo)
    shape = pixels.shape[:2]
    lens = config.scene.load()
    waves = config.scene.wavelengths_um
    distance = _distance(config, shape)
    focal = float(np.mean(drt_jax.first_order(lens, jnp.inf, waves).effective_focal_length))
    pixel = 1e-3 * config.pixel_um
    if not pixel:
        pixel = abs(focal) * np.tan(np.radians(config.field_deg)) / (np.hypot(*shape) / 2)
    began = time.perf_counter()
    given = lens, shape, distance, pixel, waves, config.kernel or None, config.nodes
    method = drt_jax.converge(drt_jax.render, *given, layers=config.layers, kind=config.model)
    bar = lambda rows: tqdm(rows, unit="row", dynamic_ncols=True)  # noqa: E731
    image = drt_jax.render(lens, linear(pixels), distance, pixel, waves, method, bar)
    if config.full_well:
        key = jax.random.key(config.seed)
        noisy = drt_jax.sensor_noise(jnp.asarray(image), key, config.full_well, config.read_noise)
        image = np.asarray(noisy)
    grid = drt_jax.kernel_grid(lens, waves, method.grid)
    lit = np.asarray(grid.solid_angle) > 0
    result = encoded(np.asarray(image))
    run.figures.mkdir(exist_ok=True)
    Image.fromarray(pixels).save(run.figures / "ideal.png")
    Image.fromarray(result).save(run.figures / "photo.png")
    angle = np.degrees(np.arctan(np.hypot(*shape) / 2 * pixel / abs(focal)))
    return {
        "pixel_um": 1e3 * pixel,
        "sensor_mm": [shape[1] * pixel, shape[0] * pixel],
        "focal_mm": focal,
        "field_deg": float(angle),
        "kernel": method.grid.size,
        "tile": list(method.tile),
        "outside": float(np.max(np.asarray(grid.outside), where=lit, initial=0)),
        "dark": float(np.mean(~lit)),
        "light": float(np.min(np.where(lit, grid.solid_angle, 0)) / np.max(grid.solid_angle)),
        "seconds": time.perf_counter() - began,
        "shape": list(shape),
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Table of the picture, with warnings."""
    wide, high = results["sensor_mm"]
    outside = f"{100 * results['outside']:.2g} %"
    if results["outside"] > _BEYOND:
        outside += f": raise kernel above {results['kernel']}"
    dark = f"{100 * results['dark']:.2g} %"
    if results["dark"]:
        dark += ": the picture reaches beyond the image circle, and is black there"
    rows = [
        ("pixel, um", results["pixel_um"]),
        ("sensor, mm", f"{wide:.4g} x {high:.4g}"),
        ("focal length, mm", results["focal_mm"]),
        ("field in the corners, degrees", results["field_deg"]),
        ("kernel, pixels", results["kernel"]),
        ("light outside the kernels, at most", outside),
        ("fields without light", dark),
        ("time", _common.duration(results["seconds"])),
    ]
    return {"render": _common.table(("", "value"), rows)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws both pictures side by side."""
    height, width = results["shape"]
    photos = {"ideal": "ideal", "photo": "photo"}
    _plots.photographs(figures / "beside.png", figures, photos, (5, 5 * height / width + 0.3))


def arguments(words: list[str]) -> list[str]:
    """Arguments of the command line; the first may be a photograph."""
    if not words or words[0].startswith("-"):
        return words
    quoted = words[0].replace("'", "''")
    return ["--set", f"photo='{quoted}'", *words[1:]]


if __name__ == "__main__":
    _command.main(sys.modules[__name__], arguments(sys.argv[1:]))
