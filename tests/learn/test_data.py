import dataclasses
import itertools
import os
import shutil

import numpy as np
import pytest
from PIL import Image
from skimage import io

from drt_jax.inputs import InputError
from drt_jax.learn import data
from drt_jax.learn.data import DataConfig, DataError, batches, load_patches


@pytest.fixture
def folder(tmp_path):
    """Five usable pictures of different kinds, a damaged, a small and an unrelated file."""
    generator = np.random.default_rng(0)
    (tmp_path / "images" / "striped").mkdir(parents=True)
    for i, shape in enumerate([(60, 70, 3), (60, 70), (60, 70, 4), (90, 50, 3), (50, 50, 3)]):
        image = generator.integers(0, 255, shape, dtype=np.uint8)
        io.imsave(tmp_path / "images" / "striped" / f"{i}.png", image, check_contrast=False)
    small = np.zeros((10, 10, 3), np.uint8)
    io.imsave(tmp_path / "images" / "small.png", small, check_contrast=False)
    (tmp_path / "images" / "damaged.jpg").write_bytes(b"\xff\xd8\xff not a picture")
    (tmp_path / "notes.txt").write_text("no picture")
    return tmp_path


def test_folder_with_subfolders_damaged_and_small_files(folder):
    config = DataConfig(root=str(folder), crops_per_image=3)
    patches = load_patches(config, 40, seed=0)
    assert patches.train.dtype == np.uint8 and patches.train.shape[1:] == (40, 40, 3)
    assert len(patches.train) + len(patches.test) == 15
    assert len(patches.skipped) == 2
    assert any("damaged.jpg: unreadable" in line for line in patches.skipped)
    assert any("small.png: 10 x 10 pixels, smaller than 40" in line for line in patches.skipped)


def test_memory_mapped_patches_are_the_same(folder):
    config = DataConfig(root=str(folder), crops_per_image=3)
    mapped = load_patches(
        DataConfig(root=str(folder), crops_per_image=3, memory_map=str(folder)), 40, seed=0
    )
    assert isinstance(mapped.train, np.memmap)
    np.testing.assert_array_equal(mapped.train, load_patches(config, 40, seed=0).train)


def test_patches_of_any_number_of_bands(folder):
    """For photographs the luminance, with the weights of ITU-R 601; eight bands from arrays."""
    config = DataConfig(root=str(folder), crops_per_image=3)
    grey = load_patches(config, 40, seed=0, bands=1)
    colours = load_patches(config, 40, seed=0).train.astype(float)
    assert grey.train.shape == (*colours.shape[:3], 1)
    assert np.max(np.abs(colours @ [0.299, 0.587, 0.114] - grey.train[..., 0])) < 1
    many = folder / "many"
    many.mkdir()
    generator = np.random.default_rng(0)
    arrays = [generator.integers(0, 255, (41 + i, 50, 8), dtype=np.uint8) for i in range(3)]
    for i, array in enumerate(arrays):
        np.save(many / f"{i}.npy", array)
    np.save(many / "float.npy", np.ones((50, 50, 8)))
    np.save(many / "object.npy", np.array([{}]), allow_pickle=True)
    for memory_map in ("", str(folder)):
        config = DataConfig(root=str(many), crops_per_image=2, memory_map=memory_map)
        patches = load_patches(config, 40, seed=0, bands=8)
        assert patches.train.shape == (4, 40, 40, 8) and patches.test.shape == (2, 40, 40, 8)
        windows = [np.lib.stride_tricks.sliding_window_view(a, (40, 40), (0, 1)) for a in arrays]
        crops = {bytes(np.moveaxis(v, 0, -1)) for w in windows for row in w for v in row}
        assert all(bytes(crop) in crops for crop in (*patches.train, *patches.test))
        assert any(
            "float.npy: unreadable (expected (H, W, bands), uint8" in s for s in patches.skipped
        )
        assert any("object.npy" in line for line in patches.skipped)
    with pytest.raises(DataError, match=r"8 bands, 3 are asked for: give arrays \(H, W, 3\)"):
        load_patches(config, 40, seed=0)
    with pytest.raises(DataError, match="3 bands, 8 are asked for"):
        load_patches(DataConfig(), 40, seed=0, bands=8)


def test_webp_is_found(tmp_path):
    for i in range(2):
        Image.new("RGB", (50, 50), (i, 2, 3)).save(tmp_path / f"{i}.webp", lossless=True)
    patches = load_patches(DataConfig(root=str(tmp_path), crops_per_image=1), 40, seed=0)
    assert not patches.skipped and {*patches.train[0, 0, 0, 1:]} == {2, 3}


def test_split_by_image_and_by_seed(folder):
    config = DataConfig(root=str(folder), crops_per_image=4)
    first, again, other = (load_patches(config, 40, seed=s) for s in (0, 0, 3))
    np.testing.assert_array_equal(first.train, again.train)
    assert not np.array_equal(first.train, other.train)
    # No test crop shares a row of pixels with a training crop: they come from other pictures.
    rows = lambda a: {bytes(r) for p in a for r in p[::8, :20].reshape(-1, 60)}  # noqa: E731
    assert not rows(first.train) & rows(first.test)


def test_bundled_photographs():
    patches = load_patches(DataConfig(crops_per_image=2, test_fraction=0.25), 52, seed=0)
    assert patches.skipped == () and len(patches.train) == 16 and len(patches.test) == 6
    assert len(np.unique(patches.train)) > 200


def test_texture_set(shared):
    patches = load_patches(DataConfig(root=str(shared / "dtd"), crops_per_image=1), 84, seed=0)
    assert len(patches.train) == 320 and len(patches.test) == 80 and patches.skipped == ()


def test_split_is_a_permutation_of_all_where_all_are_usable(tmp_path):
    """Runs that are resumed, and results on disk, depend on the positions of the crops."""
    shapes = [(60, 70, 3), (60, 70), (60, 70, 4), (90, 50, 3), (50, 50, 3), (41, 40, 3), (99, 45)]
    generator = np.random.default_rng(1)
    for name, shape in zip("gfedcba", shapes):
        image = generator.integers(0, 255, shape, dtype=np.uint8)
        io.imsave(tmp_path / f"{name}.png", image, check_contrast=False)

    def crops(i):
        image = io.imread(sorted(tmp_path.iterdir())[i])
        image = image[..., :3] if image.ndim == 3 else np.stack([image] * 3, -1)
        draw = np.random.default_rng([7, 1, i])
        tops = draw.integers(0, image.shape[0] - 40 + 1, 3)
        lefts = draw.integers(0, image.shape[1] - 40 + 1, 3)
        return [image[y : y + 40, x : x + 40] for y, x in zip(tops, lefts)]

    order = np.random.default_rng([7, 0]).permutation(7)
    config = DataConfig(root=str(tmp_path), crops_per_image=3, test_fraction=0.3)
    patches = load_patches(config, 40, seed=7)
    for ours, group in ((patches.test, order[:2]), (patches.train, order[2:])):
        np.testing.assert_array_equal(ours, sum(map(crops, sorted(group)), []))


def test_few_usable_among_thousands(tmp_path):
    Image.new("RGB", (2, 2)).save(tmp_path / "small.png")
    small = (tmp_path / "small.png").read_bytes()
    for k in range(5000):
        (tmp_path / f"{k}.png").write_bytes(small)
    for k in range(6):
        Image.new("RGB", (40, 40), (k, k, k)).save(tmp_path / f"{1000 * k}.png")
    config = DataConfig(root=str(tmp_path), crops_per_image=2)
    for seed in range(3):
        patches = load_patches(config, 40, seed)
        assert len(patches.train) == 10 and len(patches.test) == 2
        assert len(patches.skipped) == 4996
        assert {*patches.train.flat} | {*patches.test.flat} == {0, 1, 2, 3, 4, 5}


def test_split_without_the_damaged(folder):
    """A file whose damage only decoding shows has no place in the split either."""
    for path in folder.rglob("[0-2].png"):
        path.write_bytes(path.read_bytes()[:3000])
    config = DataConfig(root=str(folder), crops_per_image=3, test_fraction=0.5)
    mapped = dataclasses.replace(config, memory_map=str(folder))
    for seed in range(6):
        patches, again = load_patches(config, 40, seed), load_patches(mapped, 40, seed)
        assert len(patches.train) == 3 and len(patches.test) == 3
        assert len(patches.skipped) == 5
        for kept, stored in zip(patches[:2], again[:2]):
            np.testing.assert_array_equal(kept, stored)


def test_whatever_lies_in_a_folder_is_used_or_named(folder):
    os.mkfifo(folder / "pipe.jpg")
    (folder / "loop").symlink_to(folder)
    Image.new("RGB", (90, 90)).save(folder / "moving.gif")
    Image.new("RGB", (1, 1)).save(folder / "point.png")
    Image.new("L", (20000, 10)).save(folder / "strip.png")
    (folder / "page.png").write_text("<html></html>")
    (folder / "two\nlines.png").write_bytes(b"")
    patches = load_patches(DataConfig(root=str(folder), crops_per_image=1), 40, 0)
    assert len(patches.train) + len(patches.test) == 5
    said = {line.partition(": ")[0].rpartition("/")[2]: line for line in patches.skipped}
    assert {*said} == {
        *("pipe.jpg", "loop", folder.name, "point.png", "strip.png", "page.png"),
        *("two lines.png", "damaged.jpg", "small.png"),
    }
    assert "unreadable (not a regular file)" in said["pipe.jpg"]
    assert "20000 x 10 pixels, smaller than 40" in said["strip.png"]
    assert "1 x .gif, which is not read" in said[folder.name]
    assert all(line.isprintable() and len(line) <= 300 for line in patches.skipped)


ERRORS = {
    "not a folder": ({"root": "nowhere"}, "data.root: nowhere is not a folder"),
    "no such user": ({"root": "~nobody at all/a"}, "data.root: .* is not a folder"),
    "no root": ({"root": ""}, "data.root: expected a folder with images, or .bundled., got ''"),
    "no crops": ({"crops_per_image": 0}, "data.crops_per_image: expected 1 to 100000, got 0"),
    "crops": ({"crops_per_image": 10**10}, "data.crops_per_image: .*, got 10000000000"),
    "share": ({"test_fraction": float("nan")}, "data.test_fraction: expected between 0 and 1"),
    "memory": (
        {"crops_per_image": 100_000, "root": "bundled"},
        "data.crops_per_image: 11 images x 100000 crops of 200 x 200 pixels take 132.0 GB, of "
        "memory at most 8; lower it, or give data.memory_map a folder on a large disk",
    ),
    "no map": ({"memory_map": "nowhere"}, "data.memory_map: nowhere: No such file"),
    "too large": ({}, "0 usable images; .* 200 x 200 .*smaller than 200"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_clear_errors(folder, name):
    change, message = ERRORS[name]
    with pytest.raises(DataError, match=message) as caught:
        load_patches(DataConfig(**{"root": str(folder)} | change), 200, 0)
    assert isinstance(caught.value, InputError)


def test_errors_of_folders_and_batches(tmp_path, folder):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "a.avif").touch()
    with pytest.raises(DataError, match="holds no image.* 1 x .avif, which is not read"):
        load_patches(DataConfig(root=str(tmp_path / "empty")), 40, 0)
    shutil.copy(folder / "images" / "striped" / "0.png", tmp_path / "empty")
    with pytest.raises(DataError, match="1 usable images; train and test need one each"):
        load_patches(DataConfig(root=str(tmp_path / "empty")), 40, 0)
    with pytest.raises(DataError, match="3 training patches do not fill a batch of 4"):
        next(batches(np.zeros((3, 2, 2, 3), np.uint8), 4, 0))


def test_errors_of_a_full_disk_and_memory(folder, monkeypatch):
    config = DataConfig(root=str(folder), crops_per_image=100_000, memory_map=str(folder))
    with monkeypatch.context() as patched, pytest.raises(DataError, match="take 2.9 GB, free are"):
        patched.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(9, 8, 10**6))
        load_patches(config, 40, 0)
    with (
        monkeypatch.context() as patched,
        pytest.raises(DataError, match="data.memory_map: .*left"),
    ):
        patched.setattr(data, "_part", full_disk)
        load_patches(dataclasses.replace(config, crops_per_image=1), 40, 0)
    with monkeypatch.context() as patched, pytest.raises(DataError, match="do not fit in memory"):
        patched.setattr(data, "_part", no_memory)
        load_patches(DataConfig(root=str(folder)), 40, 0)


def full_disk(*_):
    raise OSError(28, "No space left on device")


def no_memory(*_):
    raise MemoryError


def test_batches_cover_each_epoch_and_resume_anywhere():
    patches = np.arange(11, dtype=np.uint8)[:, None, None, None] * np.ones((1, 2, 2, 3), np.uint8)
    stream = batches(patches, 3, seed=5)
    seen = [next(stream)[:, 0, 0, 0].tolist() for _ in range(9)]
    for epoch in range(3):
        drawn = list(itertools.chain(*seen[3 * epoch : 3 * epoch + 3]))
        assert len(set(drawn)) == 9  # no patch twice in an epoch
    assert seen[:3] != seen[3:6]
    for start in (0, 1, 3, 7):
        again = batches(patches, 3, seed=5, start=start)
        assert [next(again)[:, 0, 0, 0].tolist() for _ in range(9 - start)] == seen[start:]
