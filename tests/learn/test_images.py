"""Many kinds of images: each is read as it was written, or refused with the reason."""

import os

import numpy as np
import pytest
from PIL import Image
from skimage import io

from drt_jax.learn import images
from drt_jax.learn.images import find_images, look, read

from . import zoo
from .zoo import READ, REFUSED, RGB, SIDE


@pytest.mark.parametrize("name", READ)
def test_read_as_written(tmp_path, name):
    write, seen = READ[name]
    if not zoo.readable(name):
        pytest.skip("Pillow was built without it")
    path = tmp_path / name
    write(path)
    assert look(path) == (SIDE, SIDE)
    pixels = read(path)
    assert pixels.shape == (SIDE, SIDE, 3) and zoo.close(name, pixels, seen)


@pytest.mark.parametrize("ending", ["jpg", "png", "tif", "webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_is_applied(tmp_path, orientation, ending):
    path = tmp_path / f"turned.{ending}"
    upright = zoo.orientations(path, orientation)
    np.testing.assert_array_equal(read(path), upright)
    # For example a camera rotated to the right, or upside down.
    turned = {1: RGB, 3: RGB[::-1, ::-1], 6: np.rot90(RGB, -1), 8: np.rot90(RGB)}
    if orientation in turned:
        assert abs(upright.astype(int) - turned[orientation]).max() < 20


def test_damaged_exif_leaves_the_image(tmp_path):
    path = tmp_path / "a.jpg"
    Image.fromarray(RGB).save(path, exif=b"Exif\0\0" + b"no directory of tags", quality=100)
    assert read(path).shape == (SIDE, SIDE, 3)


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


def test_as_scikit_image_reads_photographs(shared):
    for path in sorted((shared / "dtd").rglob("*.jpg"))[::40]:
        np.testing.assert_array_equal(read(path), io.imread(path))


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
