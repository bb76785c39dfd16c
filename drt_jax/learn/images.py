"""Photographs: found in a folder, read upright with 8 bits per channel. Arrays of NumPy hold images
of any number of bands.

Pillow reads and converts photographs. Images that it would misread are refused with the reason,
from the header where that suffices.
"""

import collections
import os
import pathlib
import stat

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

# Those that others are best converted to, and all that are read.
_COMMON = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
SUFFIXES = (*_COMMON, ".jpe", ".jfif", ".webp", ".npy")
# Images of other kinds, which are counted and reported.
_UNREAD = {
    *(".gif", ".avif", ".heic", ".heif", ".jp2", ".j2k", ".jxl", ".svg"),
    *(".pbm", ".pgm", ".ppm", ".pnm", ".pfm", ".tga", ".ico", ".psd", ".exr", ".hdr", ".eps"),
    *(".raw", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"),
}
# Formats that a file may have, whatever its name: images saved from web pages are often WebP. For
# others Pillow may start a program (EPS).
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "GIF", "WEBP")
# Modes that Pillow converts to RGB rightly; 16 bits are shifted here.
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
# Pillow's own limit; at its 4 bytes per pixel this is 0.7 GB.
MOST_PIXELS = 178_956_970


def look(path: pathlib.Path) -> tuple[int, int]:
    """Width and height of an image from its header, pixels; raises as `read` does."""
    if path.suffix.lower() == ".npy":
        height, width = _array(path).shape[:2]
        return width, height
    with _open(path) as image:
        return image.size


def read(path: pathlib.Path, bands: int = 3) -> np.ndarray:
    """The first image of a file, upright, uint8 (H, W, bands).

    bands: 3 for the colours of a photograph, 1 for its luminance; or those of an array of NumPy
        (`.npy`), uint8 (H, W, bands).

    An exception of any kind says why a file cannot be used. Only regular files are opened, not
    pipes; an image above `MOST_PIXELS` pixels is not decoded.
    """
    if path.suffix.lower() == ".npy":
        return in_bands(np.array(_array(path)), bands)
    with _open(path) as image:
        upright = ImageOps.exif_transpose(image)
        if upright.mode.startswith("I;16"):
            upright = Image.fromarray((np.asarray(upright) >> 8).astype(np.uint8))
        return in_bands(np.asarray(upright.convert("RGB")), bands)


def in_bands(pixels: np.ndarray, bands: int) -> np.ndarray:
    """Pixels (H, W, bands) of pixels (H, W, C), uint8; of three colours also the luminance.
    ValueError for another number of bands."""
    if bands == 1 and pixels.shape[2] == 3:
        return np.asarray(Image.fromarray(pixels).convert("L"))[..., None]
    if pixels.shape[2] != bands:
        raise ValueError(
            f"{pixels.shape[2]} bands, {bands} are asked for: give arrays (H, W, {bands}), uint8, "
            "written by numpy.save"
        )
    return pixels


def _array(path: pathlib.Path) -> np.ndarray:
    """An array of NumPy, (H, W, C), not yet read from its file."""
    _refuse_pipes(path)
    pixels = np.load(path, mmap_mode="r", allow_pickle=False)
    if pixels.ndim != 3 or pixels.dtype != np.uint8 or not 0 < pixels.size <= 4 * MOST_PIXELS:
        expected = f"expected (H, W, bands), uint8, at most {4 * MOST_PIXELS} numbers"
        raise ValueError(f"{expected}, got {pixels.shape}, {pixels.dtype}")
    return pixels


def _refuse_pipes(path: pathlib.Path) -> None:
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError("not a regular file")


def _open(path: pathlib.Path) -> Image.Image:
    """Opens an image and reads its header."""
    _refuse_pipes(path)
    try:
        image = Image.open(path, formats=_FORMATS)
    except UnidentifiedImageError as error:
        raise ValueError("no image, or of a kind that is not read") from error
    except Image.DecompressionBombError as error:
        raise ValueError(f"more than {MOST_PIXELS} pixels") from error
    width, height = image.size
    problem = f"more than {MOST_PIXELS} pixels" if width * height > MOST_PIXELS else _odd(image)
    if problem:
        image.close()
        raise ValueError(problem)
    return image


def _odd(image: Image.Image) -> str:
    """Why the values of an image would be misread; "" if they are not."""
    tags = getattr(image, "tag_v2", {})  # of a TIFF
    bits, is_deep = tags.get(258, (16,))[0], image.mode.startswith("I;16")
    is_plain = is_deep or image.mode in _MODES
    if is_plain and tags.get(339, (1,))[0] == 1 and not (is_deep and bits != 16):
        # Pillow does not invert 16 bits in which 0 is white.
        return "16 bits in which 0 is white: not read" if is_deep and tags.get(262) == 0 else ""
    return f"numbers of kind {image.mode}: convert them to 8 or 16 bits a channel, without sign"


def find_images(folder: str) -> tuple[list[pathlib.Path], list[str]]:
    """Files with one of `SUFFIXES` in a folder and its subfolders, sorted by path, and a line for
    each thing skipped: folders that are links (they may lead back) or cannot be read, and images of
    other kinds, counted."""
    found, left_out, counts = [], [], collections.Counter[str]()
    folders = [folder]
    while folders:
        try:
            with os.scandir(folders.pop()) as listing:
                entries = list(listing)
        except OSError as error:
            left_out.append(f"{error.filename}: folder not searched ({error.strerror})")
            continue
        for entry in entries:
            suffix = pathlib.Path(entry.name).suffix.lower()
            if entry.is_dir(follow_symlinks=False):
                folders.append(entry.path)
            elif entry.is_symlink() and os.path.isdir(entry.path):
                left_out.append(f"{entry.path}: folder not searched (a link)")
            elif suffix in SUFFIXES:
                found.append(pathlib.Path(entry.path))
            elif suffix in _UNREAD:
                counts[suffix] += 1
    kinds = ", ".join(_COMMON)
    for suffix, count in counts.items():
        left_out.append(f"{folder}: {count} x {suffix}, which is not read; convert to {kinds}")
    return sorted(found), sorted(left_out)
