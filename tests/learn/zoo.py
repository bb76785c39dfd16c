"""Kinds of images: how each is written, and its expected content or message."""

import os
import struct
import zlib

import numpy as np
import tifffile
from PIL import ExifTags, Image, ImageOps, features

from drt_jax.learn.images import MOST_PIXELS

SIDE = 32
GENERATOR = np.random.default_rng(0)
Y, X = np.mgrid[:SIDE, :SIDE] / SIDE
# Smooth, because JPEG blurs; all channels and corners differ.
RGB = np.stack([200 * X + 30, 180 * Y + 20, 90 * X + 120 * (1 - Y)], -1).astype(np.uint8)
GREY = RGB[..., 0]
DEEP = GENERATOR.integers(0, 2**16, (SIDE, SIDE, 3), dtype=np.uint16)
NOISE = GENERATOR.integers(0, 256, (SIDE, SIDE, 3), dtype=np.uint8)
ALPHA = NOISE[..., :1]
CMYK = np.concatenate([255 - RGB, GREY[::-1, :, None] // 2], -1)
# Light that inks leave: each colour its own fraction, black the same fraction of all.
INK = np.rint((255.0 - CMYK[..., :3]) * (255.0 - CMYK[..., 3:]) / 255).astype(np.uint8)
COLOURS = GENERATOR.integers(0, 256, (256, 3), dtype=np.uint8)


def grey(values):
    return np.repeat(values[..., None], 3, -1)


def png(path, values, kind, size=None):
    """PNG of 16-bit values, written by hand, because Pillow does not write 16 bits per channel."""
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
    """Writes an array with Pillow."""
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
# How a file is written, and the expected image.
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


# How a file is written, and the expected message.
REFUSED = {
    "float.tif": (tiff((GREY / 255).astype(np.float32), "minisblack"), "of kind F: convert them"),
    "float rgb.tif": (tiff(RGB / 255, "rgb"), "of a kind that is not read"),
    "lab.tif": (tiff(NOISE, "cielab"), "of kind LAB: convert them to 8 or 16 bits a channel"),
    "signed.tif": (tiff(GREY.astype(np.int16), "minisblack"), "of kind I.*: .* without sign"),
    "signed 8.tif": (tiff(GREY.astype(np.int8), "minisblack"), "of kind L: .* without sign"),
    "long.tif": (tiff(GREY.astype(np.uint32), "minisblack"), "of kind I: convert them"),
    "white is 0.tif": (tiff(DEEP[..., 0], "miniswhite"), "16 bits in which 0 is white: not read"),
    "spectrum.tif": (
        tiff(np.tile(NOISE, 2)[..., :5], "minisblack", planarconfig="contig"),
        "of a kind that is not read",
    ),
    "text.jpg": (text(b"no picture"), "of a kind that is not read"),
    "html.png": (text(b"<html><body>404</body></html>"), "of a kind that is not read"),
    "program.jpg": (
        text(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n"),
        "kind that is not read",
    ),
    "empty.png": (text(b""), "of a kind that is not read"),
    "empty.tif": (text(b""), "."),
    "truncated.jpg": (truncated, "truncated"),
    "huge.png": (lambda p: png(p, DEEP[:1], 2, (20000, 20000)), f"than {MOST_PIXELS} pix"),
    "pipe.jpg": (os.mkfifo, "not a regular file"),
    "absent.jpg": (lambda path: path.symlink_to("nowhere"), "No such file"),
    "loop.jpg": (lambda path: path.symlink_to(path), "symbolic links"),
}


def orientations(path, orientation):
    """Writes an image with the orientation tag of a camera; and the image when upright."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    Image.fromarray(RGB).save(path, exif=exif)
    with Image.open(path) as image:
        return np.asarray(ImageOps.exif_transpose(image).convert("RGB"))


def readable(name):
    """Whether Pillow was built with the support that a kind needs."""
    return features.check({"webp": "webp"}.get(name[:-4], "zlib"))


def close(name, patch, seen):
    """Whether a patch agrees with what was written; JPEG and a few others are inexact."""
    is_rough = name.endswith(".jpg") or name.startswith("ycbcr")
    far = np.max(np.abs(patch.astype(int) - seen.astype(int)))
    return patch.dtype == np.uint8 and bool(far <= (6 if is_rough else 1))
