"""Photographs: found in a folder, and read upright with 8 bits per channel. NumPy arrays hold
    images of any number of bands.

Pillow reads and converts photographs. Images that it would read wrongly are refused with the
reason, from the header where that is sufficient.
"""

import collections
import os
import pathlib
import stat

import numpy as np
from PIL import Image, ImageOps, UnidentifiedImageError

from ..inputs import require

# Formats to which other images are best converted, and all formats that are read.
_COMMON = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
SUFFIXES = (*_COMMON, ".jpe", ".jfif", ".webp", ".npy")
# Formats that are not read; such images are counted and reported.
_UNREAD = {
    *(".gif", ".avif", ".heic", ".heif", ".jp2", ".j2k", ".jxl", ".svg"),
    *(".pbm", ".pgm", ".ppm", ".pnm", ".pfm", ".tga", ".ico", ".psd", ".exr", ".hdr", ".eps"),
    *(".raw", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"),
}
# Formats that a file may have, whatever its name: images saved from web pages are often WebP. For
# others Pillow may start a program (EPS).
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "GIF", "WEBP")
# Modes that Pillow converts to RGB correctly; `read` shifts 16 bits to 8.
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
# Pillow's own limit on the number of pixels. At its 4 bytes per pixel this is 0.7 GB.
MOST_PIXELS = 178_956_970


def look(path: pathlib.Path) -> tuple[int, int]:
    """Width and height of an image from its header, pixels. Raises as `read` does."""
    if path.suffix.lower() == ".npy":
        height, width = _array(path).shape[:2]
        return width, height
    with _open(path) as image:
        return image.size


def read(path: pathlib.Path, bands: int = 3) -> np.ndarray:
    """The first image of a file, upright, uint8 (H, W, bands).

    bands: 3 for the colours of a photograph, 1 for its luminance; or the number of bands of a NumPy
        array (`.npy`), uint8 (H, W, bands).

    An exception of any kind says why a file cannot be used. Only regular files are opened, not
    pipes. An image above `MOST_PIXELS` pixels is not decoded.
    """
    if path.suffix.lower() == ".npy":
        return in_bands(np.array(_array(path)), bands)
    with _open(path) as image:
        upright = ImageOps.exif_transpose(image)
        if upright.mode.startswith("I;16"):
            upright = Image.fromarray((np.asarray(upright) >> 8).astype(np.uint8))
        return in_bands(np.asarray(upright.convert("RGB")), bands)


def in_bands(pixels: np.ndarray, bands: int) -> np.ndarray:
    """Pixels (H, W, bands), uint8, of pixels (H, W, C); the luminance of three colours if bands is
    1.

    ValueError for another number of bands.
    """
    if bands == 1 and pixels.shape[2] == 3:
        return np.asarray(Image.fromarray(pixels).convert("L"))[..., None]
    what = f"{pixels.shape[2]} bands, {bands} are asked for: give arrays (H, W, {bands}), uint8,"
    require(pixels.shape[2] == bands, f"{what} written by numpy.save")
    return pixels


def _array(path: pathlib.Path) -> np.ndarray:
    """A NumPy array, (H, W, C), memory-mapped."""
    _refuse_pipes(path)
    pixels = np.load(path, mmap_mode="r", allow_pickle=False)
    expected = f"expected (H, W, bands), uint8, at most {4 * MOST_PIXELS} numbers"
    is_image = pixels.ndim == 3 and pixels.dtype == np.uint8
    is_image = is_image and 0 < pixels.size <= 4 * MOST_PIXELS
    require(is_image, f"{expected}, got {pixels.shape}, {pixels.dtype}")
    return pixels


def _refuse_pipes(path: pathlib.Path) -> None:
    """Raises ValueError for anything that is not a regular file."""
    require(stat.S_ISREG(os.stat(path).st_mode), "not a regular file")


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
    problem = f"more than {MOST_PIXELS} pixels" if width * height > MOST_PIXELS else _flaw(image)
    if problem:
        image.close()
        raise ValueError(problem)
    return image


def _flaw(image: Image.Image) -> str:
    """Why the values of an image would be read wrongly; "" if they are read correctly."""
    tags = getattr(image, "tag_v2", {})  # of a TIFF
    bits, is_deep = tags.get(258, (16,))[0], image.mode.startswith("I;16")
    is_plain = is_deep or image.mode in _MODES
    if is_plain and tags.get(339, (1,))[0] == 1 and not (is_deep and bits != 16):
        # Pillow does not invert 16 bits in which 0 is white.
        return "16 bits in which 0 is white: not read" if is_deep and tags.get(262) == 0 else ""
    return f"numbers of kind {image.mode}: convert them to 8 or 16 bits a channel, without sign"


def find_images(folder: str) -> tuple[list[pathlib.Path], list[str]]:
    """Images in a folder and its subfolders.

    Returns the files with one of `SUFFIXES`, sorted by path; and a line for each thing that is
    skipped: folders that are links (they may lead back) or that cannot be read, and images of other
    formats, counted.
    """
    found, left_out, counts = [], [], collections.Counter[str]()

    def not_searched(error: OSError) -> None:
        left_out.append(f"{error.filename}: folder not searched ({error.strerror})")

    for place, folders, files in os.walk(folder, onerror=not_searched):
        links = filter(os.path.islink, (os.path.join(place, name) for name in folders))
        left_out += [f"{path}: folder not searched (a link)" for path in links]
        for path in (pathlib.Path(place, name) for name in files):
            suffix = path.suffix.lower()
            if suffix in SUFFIXES:
                found.append(path)
            elif suffix in _UNREAD:
                counts[suffix] += 1
    kinds = ", ".join(_COMMON)
    for suffix, count in counts.items():
        left_out.append(f"{folder}: {count} x {suffix}, which is not read; convert to {kinds}")
    return sorted(found), sorted(left_out)
