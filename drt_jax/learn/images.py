"""Photographs as others store them: found in a folder, read, cut into squares of 8 bits a channel.

What cannot be read rightly is refused with the reason, never guessed: before anything is decoded,
wherever the header tells. Pillow and tifffile, which come with scikit-image and read for it, are
asked themselves, because scikit-image hands on neither the kind of an image (CMYK, palette,
orientation) nor its size without the pixels.
"""

import collections
import os
import pathlib
import stat

import numpy as np
import tifffile
from PIL import ExifTags, Image, UnidentifiedImageError
from skimage import util

SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp")
# Other images, counted so that nobody misses them unawares.
_UNREAD = {
    *(".gif", ".webp", ".avif", ".heic", ".heif", ".jfif", ".jpe", ".jp2", ".j2k", ".jxl", ".svg"),
    *(".pbm", ".pgm", ".ppm", ".pnm", ".pfm", ".tga", ".ico", ".psd", ".exr", ".hdr", ".eps"),
    *(".raw", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".rw2", ".raf", ".pef", ".srw"),
}
# What a file may be, whatever its name says: what is saved from web pages is often WebP. For
# others Pillow may start a program (EPS).
_FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "GIF", "WEBP")
# Pillow decodes no more either; with its 4 bytes a pixel, this is 0.7 GB.
MOST_PIXELS = 178_956_970
# From what the camera stored to upright, by the orientation of EXIF.
_TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}


class Picture:
    """A decoded image, from which squares are cut.

    size: width and height in pixels, as stored, before it is turned upright.
    """

    def __init__(self, image: Image.Image, orientation: object = 1) -> None:
        """image: of any mode that Pillow converts to RGB, or of 16 bits. orientation: of EXIF."""
        self._image, self._turn = image, _TURNS.get(orientation)  # type: ignore[call-overload]
        self.size = image.size

    def cut(self, top: int, left: int, side: int) -> np.ndarray:
        """A square as uint8 (side, side, 3), upright: grey is repeated, alpha dropped, CMYK
        converted, of 16 bits the upper 8 are taken.

        top, left: its corner in what is stored. side: pixels. All but the square stays as it is:
        converted, a large image would take its memory again.
        """
        part = self._image.crop((left, top, left + side, top + side))
        if part.mode.startswith("I"):  # of 16 bits: I;16, by older Pillow I
            part = Image.fromarray((np.asarray(part) >> 8).astype(np.uint8))
        part = part.convert("RGB")
        return np.asarray(part if self._turn is None else part.transpose(self._turn))


def look(path: pathlib.Path) -> tuple[int, int]:
    """Width and height of an image in a file, in pixels, from its header; raises as `read` does."""
    with _open(path) as image:
        return image.size


def read(path: pathlib.Path) -> Picture:
    """The image in a file, the first one if it holds several.

    Floats must lie from 0 to 1, whole numbers have up to 8 or 16 bits and no sign. Any exception
    says why a file cannot be used: those of the readers are of all kinds. What no regular file is,
    a pipe say, is not opened; an image of over `MOST_PIXELS` pixels is not decoded.
    """
    with _open(path) as image:
        image.load()
        try:
            orientation = image.getexif().get(ExifTags.Base.Orientation)
        except Exception:  # damaged EXIF beside a sound image
            orientation = None
        picture = Picture(image, orientation)
    picture.cut(0, 0, 1)  # raises for modes without a way to RGB
    return picture


def _open(path: pathlib.Path) -> Image.Image:
    """An image of which the header is read; one of floats is decoded."""
    if not stat.S_ISREG(os.stat(path).st_mode):
        raise ValueError("not a regular file")
    try:
        image = Image.open(path, formats=_FORMATS)
    except UnidentifiedImageError as error:
        if path.suffix.lower() in (".tif", ".tiff"):
            return _open_floats(path)
        raise ValueError("no image, or of an unknown kind") from error
    except Image.DecompressionBombError as error:
        raise ValueError(f"more than {MOST_PIXELS} pixels") from error
    width, height = image.size
    problem = f"more than {MOST_PIXELS} pixels" if width * height > MOST_PIXELS else _odd(image)
    if problem or image.mode == "F":
        image.close()
    if problem:
        raise ValueError(problem)
    return _open_floats(path) if image.mode == "F" else image


def _odd(image: Image.Image) -> str:
    """Why the numbers of an image would be misread; nothing if they are not."""
    tags = getattr(image, "tag_v2", {})  # of a TIFF
    bits, sign, white_is_0 = tags.get(258, (1,))[0], tags.get(339, (1,))[0] == 2, tags.get(262) == 0
    long = image.mode == "I" and image.format != "PNG"
    if long or sign or bits == 12 or (white_is_0 and bits > 8):
        return f"{bits} bits{', signed' * sign}{', white is 0' * white_is_0}: not read"
    return ""


def _open_floats(path: pathlib.Path) -> Image.Image:
    """A TIFF of floats, which of Pillow's kinds is at most grey; its first page, as 8 bits."""
    with tifffile.TiffFile(path) as file:
        page = file.pages[0].aspage()
        if page.axes not in ("YX", "YXS", "SYX") or page.photometric not in (1, 2):
            raise ValueError(f"a TIFF of kind {page.photometric!s}, {page.axes}, {page.dtype}")
        if page.dtype is None or page.dtype.kind != "f" or page.samplesperpixel > 4:
            raise ValueError(f"a TIFF of {page.dtype} with {page.samplesperpixel} channels")
        if page.nbytes > 4 * MOST_PIXELS:
            raise ValueError(f"floats of more than {4 * MOST_PIXELS} bytes")
        values, orientation = page.asarray(), page.tags.valueof(ExifTags.Base.Orientation)
    values = np.moveaxis(values, 0, -1) if page.axes == "SYX" else values
    if values.ndim == 3:  # without alpha, the last of 2 or 4
        values = values[..., :3] if values.shape[-1] > 2 else values[..., 0]
    low, high = values.min(), values.max()
    if not (low >= 0 and high <= 1):  # nor is NaN
        raise ValueError(f"floats from {low:.3g} to {high:.3g}; expected 0 to 1")
    # Row by row, because the conversion makes copies of what it is given.
    image = Image.fromarray(np.array([util.img_as_ubyte(row) for row in values]))
    image.getexif()[ExifTags.Base.Orientation] = orientation
    return image


def find_images(folder: str) -> tuple[list[pathlib.Path], list[str]]:
    """Files with one of `SUFFIXES` in a folder and its subfolders, in the order of their paths, and
    a line for whatever is left out: folders that are links (they may lead back) or cannot be read,
    and images of other kinds, counted."""
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
    kinds = ", ".join(SUFFIXES)
    for suffix, count in counts.items():
        left_out.append(f"{folder}: {count} x {suffix}, which is not read; convert to {kinds}")
    return sorted(found), sorted(left_out)
