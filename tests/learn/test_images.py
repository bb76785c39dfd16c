"""A zoo of images: each kind is read to what was written, or refused with the reason."""

import os
import struct
import tracemalloc
import zlib

import numpy as np
import pytest
import tifffile
from PIL import ExifTags, Image, ImageOps, features
from skimage import color, io

from drt_jax.learn import images
from drt_jax.learn.images import find_images, look, read

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


@pytest.mark.parametrize("name", READ)
def test_read_as_written(tmp_path, name):
    write, seen = READ[name]
    if not features.check({"webp": "webp", "lab": "littlecms2"}.get(name[:-4], "zlib")):
        pytest.skip("Pillow was built without it")
    path = tmp_path / name
    write(path)
    assert look(path) == (SIDE, SIDE)
    patch = read(path).cut(0, 0, SIDE)
    assert patch.dtype == np.uint8 and patch.shape == (SIDE, SIDE, 3)
    is_rough = path.suffix == ".jpg" or name.startswith(("ycbcr", "half", "lab"))
    np.testing.assert_allclose(patch.astype(int), seen.astype(int), atol=6 if is_rough else 1)
    np.testing.assert_array_equal(read(path).cut(3, 5, 20), patch[3:23, 5:25])


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied(tmp_path, orientation, ending):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    path = tmp_path / f"turned.{ending}"
    Image.fromarray(RGB).save(path, exif=exif)
    with Image.open(path) as image:
        upright = np.asarray(ImageOps.exif_transpose(image).convert("RGB"))
    np.testing.assert_array_equal(read(path).cut(0, 0, SIDE), upright)
    # In words: a camera turned to the right, or upside down.
    turned = {1: RGB, 3: RGB[::-1, ::-1], 6: np.rot90(RGB, -1), 8: np.rot90(RGB)}
    if orientation in turned:
        assert abs(upright.astype(int) - turned[orientation]).max() < 20


def test_orientation_of_floats(tmp_path):
    tag = (ExifTags.Base.Orientation, "H", 1, 6, True)
    tiff(RGB / 255, "rgb", extratags=[tag])(tmp_path / "a.tif")
    np.testing.assert_array_equal(read(tmp_path / "a.tif").cut(0, 0, SIDE), np.rot90(RGB, -1))


def test_damaged_exif_leaves_the_image(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(RGB).save(path, exif=b"Exif\0\0" + b"no directory of tags", quality=100)
    assert read(path).size == (SIDE, SIDE)


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
    "empty.tif": (text(b""), ""),
    "truncated.jpg": (truncated, "truncated"),
    "huge.png": (lambda p: png(p, DEEP[:1], 2, (20000, 20000)), f"than {images.MOST_PIXELS} pix"),
    "pipe.jpg": (os.mkfifo, "not a regular file"),
    "absent.jpg": (lambda path: path.symlink_to("nowhere"), "No such file"),
    "loop.jpg": (lambda path: path.symlink_to(path), "symbolic links"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_with_the_reason(tmp_path, name):
    write, reason = REFUSED[name]
    write(tmp_path / name)
    with pytest.raises(Exception, match=reason):  # of any type, see `read`
        read(tmp_path / name)


def test_too_large_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    monkeypatch.setattr(images, "MOST_PIXELS", SIDE**2 - 1)
    for name in ("rgb.png", "rgb.tif", "cmyk.jpg"):
        READ[name][0](tmp_path / name)
        with pytest.raises(ValueError, match="more than 1023 pixels"):
            look(tmp_path / name)
    READ["float rgb.tif"][0](tmp_path / "a.tif")
    with pytest.raises(ValueError, match="floats of more than 4092 bytes"):
        look(tmp_path / "a.tif")


@pytest.mark.parametrize("mode", ["RGB", "CMYK", "I;16"])
def test_a_large_image_is_not_copied(tmp_path, mode):
    """What Python and NumPy hold beside the pixels of Pillow: a patch."""
    path = tmp_path / "large.tif"
    Image.new(mode, (2000, 2000)).save(path)
    read(path)
    tracemalloc.start()
    picture = read(path)
    for top in range(0, 1900, 100):
        picture.cut(top, 0, 100)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2000 * 2000 / 4


def test_as_scikit_image_reads_photographs(shared):
    for path in sorted((shared / "dtd").rglob("*.jpg"))[::40]:
        width, height = look(path)
        side = min(width, height)
        np.testing.assert_array_equal(
            read(path).cut(0, width - side, side), io.imread(path)[:side, width - side :]
        )


def test_folders_searched_and_named(tmp_path):
    inner = tmp_path / "a.jpg" / "deeper"
    inner.mkdir(parents=True)
    for path in (tmp_path / "z.PNG", inner / "b.jpeg", inner / ".c.tif", tmp_path / "notes.txt"):
        path.touch()
    (tmp_path / "linked.bmp").symlink_to("z.PNG")
    (inner / "back").symlink_to(tmp_path)
    (tmp_path / "beside").symlink_to("a.jpg")
    for k in range(3):
        (inner / f"{k}.GIF").touch()
    (tmp_path / "photo.heic").touch()
    found, left_out = find_images(str(tmp_path))
    wanted = ["a.jpg/deeper/.c.tif", "a.jpg/deeper/b.jpeg", "linked.bmp", "z.PNG"]
    assert [path.relative_to(tmp_path).as_posix() for path in found] == wanted
    kinds = "which is not read; convert to .jpg, .jpeg, .png, .tif, .tiff, .bmp"
    assert left_out == sorted(
        [
            f"{tmp_path}: 3 x .gif, {kinds}",
            f"{tmp_path}: 1 x .heic, {kinds}",
            f"{inner}/back: folder not searched (a link)",
            f"{tmp_path}/beside: folder not searched (a link)",
        ]
    )


def test_unreadable_folder_is_named(tmp_path, monkeypatch):
    (tmp_path / "closed").mkdir()
    (tmp_path / "a.png").touch()
    scandir = os.scandir

    def refusing(path):  # as for others than root, for whom the tests may run
        if str(path).endswith("closed"):
            raise PermissionError(13, "Permission denied", path)
        return scandir(path)

    monkeypatch.setattr(os, "scandir", refusing)
    found, left_out = find_images(str(tmp_path))
    assert [path.name for path in found] == ["a.png"]
    assert left_out == [f"{tmp_path}/closed: folder not searched (Permission denied)"]
