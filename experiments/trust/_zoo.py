"""Kinds of images: how each is written, and what is to be seen in it or said of it."""

import os
import pathlib
import struct
import tempfile
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import tifffile
from PIL import ExifTags, Image, ImageOps, features
from skimage import color

from drt_jax.inputs import InputError, one_line
from drt_jax.learn.images import MOST_PIXELS, read

from ._outcomes import Tally, judged

SIDE = 32
GENERATOR = np.random.default_rng(0)
Y, X = np.mgrid[:SIDE, :SIDE] / SIDE
# Smooth, because JPEG blurs; no channel and no corner like another.
RGB = np.stack([200 * X + 30, 180 * Y + 20, 90 * X + 120 * (1 - Y)], -1).astype(np.uint8)
GREY = RGB[..., 0]
DEEP = GENERATOR.integers(0, 2**16, (SIDE, SIDE, 3), dtype=np.uint16)
NOISE = GENERATOR.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
ALPHA = NOISE[..., :1]
CMYK = np.concatenate([255 - RGB, GREY[::-1, :, None] // 2], -1)
# What ink leaves of the light: of each colour its share, of all that of black.
INK = np.rint((255.0 - CMYK[..., :3]) * (255.0 - CMYK[..., 3:]) / 255).astype(np.uint8)
# Lightness, and a and b, which have a sign.
LAB = np.rint(np.stack([30 + 50 * X, 30 * Y - 15, 20 * X - 10], -1))
STORED = np.rint(LAB * [2.55, 1, 1]).astype(int).astype(np.uint8)
COLOURS = GENERATOR.integers(0, 256, (256, 3), dtype=np.uint8)


def grey(values):
    return np.repeat(values[..., None], 3, -1)


def png(path, values, kind, size=None):
    """Values of 16 bits as PNG, written by hand, since Pillow writes no 16 bits a channel."""
    height, width = size or values.shape[:2]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in values)
    head = struct.pack(">2I5B", width, height, 16, kind, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    coded = (
        struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
        for name, data in chunks
    )
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(coded))


def pillow(values, **options):
    """Writes what Pillow sees in an array."""
    return lambda path: Image.fromarray(values).save(path, **options)


def inks(path):
    Image.frombytes("CMYK", (SIDE, SIDE), CMYK.tobytes()).save(path, quality=100)


def palette(path):
    image = Image.fromarray(GREY).copy()
    image.putpalette(COLOURS.tobytes())
    image.save(path)


def frames(**options):
    several = [Image.fromarray(RGB), Image.fromarray(NOISE)]
    return lambda path: several[0].save(path, save_all=True, append_images=several[1:], **options)


def tiff(values, kind, **options):
    """Writes a TIFF without Pillow. kind: its photometric interpretation."""
    return lambda path: tifffile.imwrite(path, values, photometric=kind, **options)


TABLE = (COLOURS.T.astype(np.uint16)) * 257
# How a file is written, and what is seen in it.
READ = {
    "rgb.png": (pillow(RGB), RGB),
    "rgb.bmp": (pillow(RGB), RGB),
    "rgb.tif": (tiff(NOISE, "rgb"), NOISE),
    "rgb.jpg": (pillow(RGB, quality=100), RGB),
    "ycbcr.tif": (pillow(RGB, compression="jpeg", quality=100), RGB),
    "lzw.tiff": (pillow(NOISE, compression="tiff_lzw"), NOISE),
    "planes.tif": (tiff(np.moveaxis(NOISE, -1, 0), "rgb", planarconfig="separate"), NOISE),
    "rgba.png": (pillow(np.concatenate([NOISE, ALPHA], -1)), NOISE),
    "rgba.tif": (tiff(np.concatenate([NOISE, ALPHA], -1), "rgb", extrasamples=[2]), NOISE),
    "grey.png": (pillow(GREY), grey(GREY)),
    "grey.jpg": (pillow(GREY, quality=100), grey(GREY)),
    "grey alpha.png": (pillow(np.concatenate([GREY[..., None], ALPHA], -1)), grey(GREY)),
    "grey alpha 16.png": (lambda p: png(p, DEEP[..., :2], 4), grey(DEEP[..., 0] >> 8)),
    "white is 0.tif": (tiff(GREY, "miniswhite"), grey(255 - GREY)),
    "16.png": (lambda p: png(p, DEEP[..., :1], 0), grey(DEEP[..., 0] >> 8)),
    "rgb16.png": (lambda p: png(p, DEEP, 2), DEEP >> 8),
    "16.tif": (tiff(DEEP[..., 0], "minisblack"), grey(DEEP[..., 0] >> 8)),
    "16 big.tif": (tiff(DEEP[..., 0], "minisblack", byteorder=">"), grey(DEEP[..., 0] >> 8)),
    "rgb16.tif": (tiff(DEEP, "rgb"), DEEP >> 8),
    "1 bit.png": (pillow(GREY > 99), grey(255 * (GREY > 99))),
    "palette.png": (palette, COLOURS[GREY]),
    "palette.tif": (tiff(GREY, "palette", colormap=TABLE), COLOURS[GREY]),
    "cmyk.jpg": (inks, INK),
    "cmyk.tif": (tiff(CMYK, "separated"), INK),
    "cmyk16.tif": (tiff(CMYK.astype(np.uint16) * 257, "separated"), INK),
    "lab.tif": (tiff(STORED, "cielab"), np.rint(255 * color.lab2rgb(LAB))),
    "float.tif": (tiff((GREY / 255).astype(np.float32), "minisblack"), grey(GREY)),
    "float rgb.tif": (tiff(RGB / 255, "rgb"), RGB),
    "float rgba.tif": (tiff(np.concatenate([RGB / 255, ALPHA], -1), "rgb"), RGB),
    "half.tif": (tiff((RGB / 255).astype(np.float16), "rgb"), RGB),
    "pages.tif": (tiff(np.stack([NOISE, RGB]), "rgb"), NOISE),
    "frames.png": (frames(), RGB),
    "several of a camera.jpg": (frames(format="MPO", quality=100), RGB),
    "webp.png": (pillow(RGB, format="WEBP", lossless=True), RGB),
    "gif.jpg": (pillow(GREY, format="GIF"), grey(GREY)),
}


def text(words):
    return lambda path: path.write_bytes(words)


def truncated(path):
    Image.fromarray(NOISE).save(path, quality=100)
    path.write_bytes(path.read_bytes()[:-1000])


def floats(values):
    return tiff(np.where(X > 0.9, values, X).astype(np.float32), "minisblack")


# How a file is written, and what is said of it.
REFUSED = {
    "nan.tif": (floats(np.nan), "floats from nan to nan; expected 0 to 1"),
    "infinite.tif": (floats(np.inf), "floats from 0 to inf"),
    "negative.tif": (floats(-0.5), "floats from -0.5 to 0.875"),
    "bright.tif": (tiff(RGB.astype(np.float64), "rgb"), "floats from .* to 2"),
    "signed.tif": (tiff(GREY.astype(np.int16), "minisblack"), "16 bits, signed: not read"),
    "signed 8.tif": (tiff(GREY.astype(np.int8), "minisblack"), "8 bits, signed: not read"),
    "long.tif": (tiff(GREY.astype(np.uint32), "minisblack"), "32 bits: not read"),
    "white is 0.tif": (tiff(DEEP[..., 0], "miniswhite"), "16 bits, white is 0: not read"),
    "spectrum.tif": (
        tiff(np.tile(NOISE, 2)[..., :5], "minisblack", planarconfig="contig"),
        "a TIFF of .*uint8.* 5 channels",
    ),
    "text.jpg": (text(b"no picture"), "no image, or of an unknown kind"),
    "html.png": (text(b"<html><body>404</body></html>"), "no image, or of an unknown kind"),
    "program.jpg": (text(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"), "unknown kind"),
    "empty.png": (text(b""), "no image, or of an unknown kind"),
    "empty.tif": (text(b""), "."),
    "truncated.jpg": (truncated, "truncated"),
    "huge.png": (lambda p: png(p, DEEP[:1], 2, (20000, 20000)), f"than {MOST_PIXELS} pix"),
    "pipe.jpg": (os.mkfifo, "not a regular file"),
    "absent.jpg": (lambda path: path.symlink_to("nowhere"), "No such file"),
    "loop.jpg": (lambda path: path.symlink_to(path), "symbolic links"),
}


def orientations(path: pathlib.Path, orientation: int) -> np.ndarray:
    """Write an image that a camera was turned for, and what it shows upright."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(RGB).save(path, exif=exif)
    with Image.open(path) as image:
        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))


def readable(name: str) -> bool:
    """Whether Pillow was built with what a kind needs."""
    return features.check({"webp": "webp", "lab": "littlecms2"}.get(name[:-4], "zlib"))


def close(name: str, patch: np.ndarray, seen: np.ndarray) -> bool:
    """Whether a patch shows what was written: JPEG and a few others are rough."""
    is_rough = name.endswith(".jpg") or name.startswith(("ycbcr", "half", "lab"))
    far = np.max(np.abs(patch.astype(int) - seen.astype(int)))
    return patch.dtype == np.uint8 and bool(far <= (6 if is_rough else 1))


def images() -> dict[str, Any]:
    """The row of all kinds: read as written, or refused with a reason."""
    tally = Tally("images")
    with tempfile.TemporaryDirectory() as folder:
        for name, (write, seen) in READ.items():
            if readable(name):
                write(path := pathlib.Path(folder) / name)
                _try(tally, path, lambda patch, n=name, s=seen: close(n, patch, s))
        for k, ending in ((k, e) for k in range(1, 9) for e in ("jpg", "png", "tif")):
            path = pathlib.Path(folder) / f"turned {k}.{ending}"
            upright = orientations(path, k)
            _try(tally, path, lambda patch, s=upright: np.array_equal(patch, s))
        for name, (write, _) in REFUSED.items():
            write(path := pathlib.Path(folder) / f"bad {name}")
            _try(tally, path, lambda patch: False)
    return tally.row


def _try(tally: Tally, path: pathlib.Path, is_right: Callable[[np.ndarray], bool]) -> None:
    def see() -> bool:
        try:
            return is_right(read(path).cut(0, 0, SIDE))
        except Exception as error:  # of any type, see `read`; the trainer names the file with it
            raise InputError(f"{path.name}: {one_line(str(error))}") from error

    tally.add((found := judged(see))[0], (path.name, found[1]))
