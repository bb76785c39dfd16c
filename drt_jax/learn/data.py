"""Image patches for training and testing, from the scikit-image wheel or from a folder.

Patches are uint8. They are larger than the image to be restored by the support of the blur, so that
the sensor layer has true context on all sides. Nothing is downloaded.
"""

import contextlib
import dataclasses
import functools
import io
import os
import pathlib
import shutil
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import IO, NamedTuple, TypeVar

import numpy as np
from skimage import data

from ..inputs import InputError, one_line, require, shown
from .images import SUFFIXES, find_images, in_bands, look, read

# Colour and texture photographs in the scikit-image wheel.
_BUNDLED = (
    *("astronaut", "brick", "chelsea", "coffee", "grass", "gravel", "hubble_deep_field"),
    *("immunohistochemistry", "retina", "rocket", "stereo_motorcycle"),
)
_MOST_CROPS = 100_000
# Largest number of bytes of patches in memory: many times those of the paper's set.
_MOST_MEMORY = 8 * 10**9
_T = TypeVar("_T")
_Source = str | pathlib.Path


class DataError(InputError):
    """Images cannot be used. The message names the folder or file and the remedy."""


@dataclasses.dataclass(frozen=True)
class DataConfig:
    """Where patches come from.

    root: "bundled", or a folder with subfolders (for DTD its `images` folder).
    crops_per_image: number of random crops of each image.
    test_fraction: fraction of the images, not of the crops, for testing.
    memory_map: folder on a disk for patches that do not fit in memory; empty to hold up to 8 GB in
        memory.
    """

    root: str = "bundled"
    crops_per_image: int = 4
    test_fraction: float = 0.2
    memory_map: str = ""

    def __post_init__(self) -> None:
        for key, is_right, expected in (
            ("root", self.root, 'a folder with images, or "bundled"'),
            ("crops_per_image", 1 <= self.crops_per_image <= _MOST_CROPS, f"1 to {_MOST_CROPS}"),
            ("test_fraction", 0 < self.test_fraction < 1, "between 0 and 1"),
        ):
            got = shown(getattr(self, key))
            require(is_right, f"data.{key}: expected {expected}, got {got}", DataError)


class Patches(NamedTuple):
    """Image patches.

    train, test: uint8 (N, P, P, bands), in memory or memory-mapped.
    skipped: for each file, folder or kind of image that was skipped, a line with the reason.
    """

    train: np.ndarray
    test: np.ndarray
    skipped: tuple[str, ...]


def load_patches(
    config: DataConfig,
    side: int,
    seed: int,
    progress: Callable[[list], Iterator] = iter,
    bands: int = 3,
) -> Patches:
    """Random square patches, split by image into train and test.

    config: source of the images.
    side: side of a patch, pixels.
    seed: the same `config`, `side` and `seed` give the same patches.
    progress: wraps the two loops over the images, that over headers and that over contents (tqdm).
    bands: of each patch: 3 for colours, 1 for the luminance. Images of other numbers of bands are
        arrays uint8 (H, W, bands) that `numpy.save` wrote, in a folder of `.npy` files.

    Images that cannot be used are skipped and listed in the result, see `images.read`. Images are
    decoded one at a time. DataError for a folder that does not exist or has fewer than two usable
    images, and for patches that need more memory or disk space than there is.
    """
    sources, skipped = _sources(config.root)
    fitting = [i for i in progress([*range(len(sources))]) if _fits(sources[i], side, skipped)]
    size = bands * side**2  # bytes of a crop
    _check_room(config, len(fitting), side, size)
    usable = 0
    with contextlib.ExitStack() as open_files, _room(config.memory_map):
        pool, test_file = (_file(config.memory_map, open_files) for _ in range(2))
        for i in progress(fitting):
            pixels = _read_or_skip(functools.partial(_pixels, bands=bands), sources[i], skipped)
            if pixels is not None:
                usable += 1
                for crop in _crops(pixels, config.crops_per_image, side, [seed, 1, i]):
                    pool.write(crop.tobytes())
            del pixels  # before the next is decoded
        what = f"data.root: {config.root}: {usable} usable images; train and test need one each, of"
        why = " ".join(map(one_line, skipped[:3]))
        require(usable > 1, f"{what} at least {side} x {side} pixels. {why}", DataError)
        order = np.random.default_rng([seed, 0]).permutation(usable)
        count = min(max(1, round(config.test_fraction * usable)), usable - 1)
        is_test = np.isin(np.arange(usable), order[:count]).repeat(config.crops_per_image)
        _part(pool, test_file, is_test, size)
        shape = -1, side, side, bands
        return Patches(_array(pool, shape), _array(test_file, shape), tuple(map(one_line, skipped)))


def _sources(root: str) -> tuple[Sequence[_Source], list[str]]:
    """Names of bundled photographs, or paths; and a line for each thing that is skipped."""
    if root == "bundled":
        return _BUNDLED, []
    folder = os.path.expanduser(root)
    what = f"data.root: {root}"
    is_folder = os.path.isdir(folder)
    require(is_folder, f"{what} is not a folder; give one with images, or bundled", DataError)
    paths, left_out = find_images(folder)
    kinds, why = ", ".join(SUFFIXES), " ".join(map(one_line, left_out[:3]))
    require(paths, f"{what} holds no image ({kinds}), nor do its subfolders. {why}", DataError)
    return paths, left_out


def _pixels(source: _Source, bands: int = 3) -> np.ndarray:
    """Pixels, uint8 (H, W, bands), of a file or of a bundled photograph."""
    if isinstance(source, pathlib.Path):
        return read(source, bands)
    pixels = getattr(data, source)()
    pixels = pixels[0] if isinstance(pixels, tuple) else pixels  # a stereo pair
    if pixels.ndim == 2:
        pixels = np.broadcast_to(pixels[..., None], (*pixels.shape, 3))
    return in_bands(pixels, bands)


def _size(source: _Source) -> tuple[int, int]:
    """Width and height of an image, pixels."""
    if isinstance(source, pathlib.Path):
        return look(source)
    height, width = _pixels(source).shape[:2]
    return width, height


def _fits(source: _Source, side: int, skipped: list[str]) -> bool:
    """True if an image is large enough according to its header; otherwise adds the reason to
    `skipped`.
    """
    size = _read_or_skip(_size, source, skipped)
    if size and min(size) < side:
        skipped.append(f"{source}: {size[0]} x {size[1]} pixels, smaller than {side}")
    return bool(size and min(size) >= side)


def _read_or_skip(reader: Callable[..., _T], source: _Source, skipped: list[str]) -> _T | None:
    """The result of a reader. If the reader raises, adds the reason to `skipped` and returns
    None.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return reader(source)
    except Exception as error:  # an image reader may raise anything on a damaged file
        reason = getattr(error, "strerror", None) or str(error) or type(error).__name__
        skipped.append(f"{source}: unreadable ({reason})")
        return None


def _crops(pixels: np.ndarray, count: int, side: int, seed: list[int]) -> Iterator[np.ndarray]:
    """Random crops of an image."""
    height, width = pixels.shape[:2]
    generator = np.random.default_rng(seed)
    tops = generator.integers(0, height - side + 1, count)
    lefts = generator.integers(0, width - side + 1, count)
    return (pixels[top : top + side, left : left + side] for top, left in zip(tops, lefts))


def _check_room(config: DataConfig, count: int, side: int, size: int) -> None:
    """Raises DataError if the patches of `count` images need more memory or disk space than there
    is.

    size: of a patch, bytes.
    """
    needed, folder = size * config.crops_per_image * count, config.memory_map
    what = f"{count} images x {config.crops_per_image} crops of {side} x {side} pixels"
    if folder:
        needed = int(needed * (1 + config.test_fraction))  # test patches are moved
        with _room(folder):
            free = shutil.disk_usage(os.path.expanduser(folder)).free
        key, have = f"memory_map: {folder}", f"free are {free / 1e9:.1f}"
        remedy = "lower data.crops_per_image, or give another folder"
    else:
        free, key = _MOST_MEMORY, "crops_per_image"
        have = f"of memory at most {free / 1e9:.0f}"
        remedy = "lower it, or give data.memory_map a folder on a large disk"
    take = f"data.{key}: {what} take {needed / 1e9:.1f} GB"
    require(needed <= free, f"{take}, {have}; {remedy}", DataError)


@contextlib.contextmanager
def _room(folder: str) -> Iterator[None]:
    """Raises DataError for errors of the memory or of the disk."""
    try:
        yield
    except MemoryError as error:
        raise DataError("the patches do not fit in memory; give data.memory_map") from error
    except OSError as error:
        raise DataError(f"data.memory_map: {folder}: {error.strerror}") from error


def _file(folder: str, open_files: contextlib.ExitStack) -> IO[bytes]:
    """A file in memory; or a file without a name in a folder, which is deleted when the process
    ends.
    """
    if not folder:
        return io.BytesIO()
    return open_files.enter_context(tempfile.TemporaryFile(dir=os.path.expanduser(folder)))


def _part(pool: IO[bytes], test_file: IO[bytes], is_test: np.ndarray, size: int) -> None:
    """Moves the test crops from `pool` to `test_file`, and closes the gaps.

    It copies crop by crop, because both files together may be larger than the memory.

    size: bytes of a crop.
    """
    end = 0
    for k, moves in enumerate(is_test):
        pool.seek(k * size)
        crop = pool.read(size)
        if moves:
            test_file.write(crop)
        else:
            pool.seek(end)
            end += pool.write(crop)
    pool.truncate(end)


def _array(file: IO[bytes], shape: tuple[int, ...]) -> np.ndarray:
    """The crops in a file, uint8. shape: shape of the result, with -1 for the number of crops."""
    if isinstance(file, io.BytesIO):
        return np.frombuffer(file.getbuffer(), np.uint8).reshape(shape)
    file.flush()
    return np.memmap(file, np.uint8, "r").reshape(shape)


def batches(patches: np.ndarray, size: int, seed: int, start: int = 0) -> Iterator[np.ndarray]:
    """Endless batches (size, P, P, C) in random order.

    Each epoch is a new permutation of the patches, without its incomplete batch.

    patches: uint8 (N, P, P, C).
    size: number of patches in a batch; DataError if there are fewer.
    seed: batch k depends only on the seed and k, so that a resumed run gets the same batches.
    start: number of the first batch.
    """
    per_epoch = len(patches) // size
    what = f"{len(patches)} training patches do not fill a batch of {size}"
    require(per_epoch, f"{what}; raise data.crops_per_image or lower train.batch", DataError)
    while True:
        epoch, first = divmod(start, per_epoch)
        order = np.random.default_rng([seed, 2, epoch]).permutation(len(patches))
        for k in range(first, per_epoch):
            yield np.asarray(patches[np.sort(order[k * size : (k + 1) * size])])
        start = (epoch + 1) * per_epoch
