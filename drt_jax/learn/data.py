"""Image patches for training and testing: from the scikit-image wheel or from a folder.

Patches are uint8 and larger than the image to be restored by the support of the blur, so that
the sensor layer sees true context on all sides. Nothing is downloaded.
"""

import dataclasses
import pathlib
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from skimage import color, data, io, util

# Colour and texture photographs that lie inside the scikit-image wheel.
_BUNDLED = (
    *("astronaut", "brick", "chelsea", "coffee", "grass", "gravel", "hubble_deep_field"),
    *("immunohistochemistry", "retina", "rocket", "stereo_motorcycle"),
)
_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")


class DataError(ValueError):
    """Images that cannot be used; the message names the folder or file and the remedy."""


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Where patches come from.

    root: "bundled", or a folder searched with its subfolders (DTD: its `images` folder).
    crops_per_image: random crops an image.
    test_fraction: share of the images, not of the crops, kept for testing.
    memory_map: a folder on a disk with room, for sets that should not lie in memory; empty: in
        memory.
    """

    root: str = "bundled"
    crops_per_image: int = 4
    test_fraction: float = 0.2
    memory_map: str = ""


class Patches(NamedTuple):
    """train, test: uint8 (N, P, P, 3), in memory or memory-mapped.
    skipped: what was left out, a line for each file with the reason."""

    train: np.ndarray
    test: np.ndarray
    skipped: tuple[str, ...]


def load_patches(
    config: DataConfig, side: int, seed: int, progress: Callable[[list], Iterator] = iter
) -> Patches:
    """Random square patches, split by image into train and test.

    config: where they come from.
    side: of a patch, in pixels.
    seed: the same `config`, `side` and `seed` give the same patches.
    progress: wraps the loop over the images (tqdm).

    Damaged or too small files are skipped and named in the result. DataError for a folder that
    does not exist, or without a usable image on either side.
    """
    if config.crops_per_image < 1 or not 0 < config.test_fraction < 1:
        raise DataError("data: crops_per_image: at least 1; test_fraction: between 0 and 1")
    sources = _sources(config.root)
    order = np.random.default_rng([seed, 0]).permutation(len(sources)).tolist()
    count = max(1, round(config.test_fraction * len(sources)))
    skipped: list[str] = []

    def collected(name: str, group: list[int]) -> np.ndarray:
        crops = (
            crop
            for i in progress(sorted(group))
            for crop in _crops(sources[i], config.crops_per_image, side, [seed, 1, i], skipped)
        )
        patches = _collect(crops, side, config.memory_map)
        if not len(patches):
            raise DataError(
                f"data.root: {config.root}: no usable {name} image; each must measure at least "
                f"{side} x {side} pixels. " + " ".join(skipped[:3])
            )
        return patches

    train, test = collected("train", order[count:]), collected("test", order[:count])
    return Patches(train, test, tuple(skipped))


def _collect(crops: Iterator[np.ndarray], side: int, folder: str) -> np.ndarray:
    """The crops as one array; in a file without a name, so that it vanishes with the process,
    when a folder is given."""
    if not folder:
        return np.array(list(crops), np.uint8).reshape(-1, side, side, 3)
    try:
        with tempfile.TemporaryFile(dir=pathlib.Path(folder).expanduser()) as file:
            count = sum(bool(file.write(crop.tobytes())) for crop in crops)
            file.flush()
            if not count:
                return np.empty((0, side, side, 3), np.uint8)
            return np.memmap(file, np.uint8, "r", shape=(count, side, side, 3))
    except OSError as error:
        raise DataError(f"data.memory_map: {folder}: {error.strerror}") from error


def _sources(root: str) -> Sequence[str | pathlib.Path]:
    """Names of bundled photographs, or paths."""
    if root == "bundled":
        return _BUNDLED
    folder = pathlib.Path(root).expanduser()
    if not folder.is_dir():
        raise DataError(f"data.root: {root} is not a folder; give one with images, or bundled")
    paths = sorted(p for p in folder.rglob("*") if p.suffix.lower() in _SUFFIXES)
    if not paths:
        kinds = ", ".join(_SUFFIXES)
        raise DataError(f"data.root: {root} holds no image ({kinds}), nor do its subfolders")
    return paths


def _crops(
    source: str | pathlib.Path, count: int, side: int, seed: list[int], skipped: list[str]
) -> list[np.ndarray]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = _image(source)
    except Exception as error:  # an image reader may raise anything on a damaged file
        reason = str(error).strip().splitlines()
        skipped.append(f"{source}: unreadable ({reason[0] if reason else type(error).__name__})")
        return []
    height, width = image.shape[:2]
    if min(height, width) < side:
        skipped.append(f"{source}: {width} x {height} pixels, smaller than {side}")
        return []
    generator = np.random.default_rng(seed)
    tops = generator.integers(0, height - side + 1, count)
    lefts = generator.integers(0, width - side + 1, count)
    # Copies, because a view would keep the whole image in memory.
    return [image[y : y + side, x : x + side].copy() for y, x in zip(tops, lefts)]


def _image(source: str | pathlib.Path) -> np.ndarray:
    """Any image as uint8 (H, W, 3): grey is repeated, alpha dropped, pages beyond one too."""
    image = getattr(data, source)() if isinstance(source, str) else io.imread(source)
    if isinstance(image, tuple):  # a stereo pair: one scene
        image = image[0]
    if image.ndim > 3:
        image = image[0]
    if image.ndim == 2:
        image = color.gray2rgb(image)
    if image.ndim != 3 or image.shape[-1] not in (3, 4):
        raise ValueError(f"an array of shape {image.shape} is not an image")
    return util.img_as_ubyte(image[..., :3])


def batches(patches: np.ndarray, size: int, seed: int, start: int = 0) -> Iterator[np.ndarray]:
    """Endless batches (size, P, P, 3): a fresh permutation each epoch, the rest dropped.

    patches: uint8 (N, P, P, 3).
    size: patches in a batch; DataError if there are fewer.
    seed, start: batch number k is a function of `seed` and k alone, so that a resumed run starts
        at `start` and sees what an unbroken one would have seen.
    """
    per_epoch = len(patches) // size
    if not per_epoch:
        raise DataError(
            f"{len(patches)} training patches do not fill a batch of {size}; "
            "raise data.crops_per_image or lower train.batch"
        )
    while True:
        epoch, first = divmod(start, per_epoch)
        order = np.random.default_rng([seed, 2, epoch]).permutation(len(patches))
        for k in range(first, per_epoch):
            yield np.asarray(patches[np.sort(order[k * size : (k + 1) * size])])
        start = (epoch + 1) * per_epoch
