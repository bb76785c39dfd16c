"""Patches of images: read, chosen, and sent through a camera."""

import functools
import pathlib
import sys
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from drt_jax.learn.data import DataConfig, Patches, load_patches

from ._report import IMAGES
from .runs.disk import replace

# Most skipped files named on the terminal; the run folder names all.
_NAMED = 20


def read_patches(config: DataConfig, side: int, seed: int, folder: pathlib.Path) -> Patches:
    """Patches of images, with a bar. Prints how many there are and which files were skipped; a long
    list goes into skipped.txt of the folder."""
    reading = functools.partial(tqdm, desc="reading images", leave=False)
    patches = load_patches(config, side, seed, reading)
    for line in patches.skipped[:_NAMED]:
        print(f"skipped {line}", file=sys.stderr)
    if len(patches.skipped) > _NAMED:
        listed = folder / "skipped.txt"
        replace(listed, "".join(f"{line}\n" for line in patches.skipped).encode())
        print(f"skipped {len(patches.skipped)} in all, named in {listed}", file=sys.stderr)
    counts = f"{len(patches.train)} training and {len(patches.test)} test patches"
    print(f"{counts} of {side} x {side}")
    return patches


def images(
    imager: Callable, parameters: Any, scenes: np.ndarray, where: Any, noise: float, seed: int
) -> dict[str, np.ndarray]:
    """True, sensor and restored images of patches, for `draw_patches`. where: the distance, or
    the object points, that `imager` takes."""
    found = imager(parameters, scenes, where, np.float32(noise), jax.random.key(seed))
    return {name: np.asarray(image, np.float16) for name, image in zip(IMAGES, found)}


def thinned(patches: np.ndarray, count: int) -> np.ndarray:
    """At most `count` patches, evenly over the set; all for 0."""
    if not count or count >= len(patches):
        return patches
    return np.asarray(patches[np.linspace(0, len(patches) - 1, count).astype(int)])


def textured(patches: np.ndarray, count: int) -> np.ndarray:
    """At most `count` patches for a figure, evenly over the half with more contrast."""
    contrast = np.std(patches.reshape(len(patches), -1), axis=1)
    return thinned(patches[np.argsort(contrast)[len(patches) // 2 :]], count)
