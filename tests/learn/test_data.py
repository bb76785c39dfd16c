import itertools

import numpy as np
import pytest
from skimage import io

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


def test_clear_errors(tmp_path, folder):
    with pytest.raises(DataError, match="data.root: nowhere is not a folder"):
        load_patches(DataConfig(root="nowhere"), 40, 0)
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="holds no image"):
        load_patches(DataConfig(root=str(tmp_path / "empty")), 40, 0)
    with pytest.raises(DataError, match="no usable train image.*200 x 200.*smaller than 200"):
        load_patches(DataConfig(root=str(folder)), 200, 0)
    with pytest.raises(DataError, match="crops_per_image: at least 1"):
        load_patches(DataConfig(crops_per_image=0), 40, 0)
    with pytest.raises(DataError, match="data.memory_map: .*nowhere"):
        load_patches(DataConfig(root=str(folder), memory_map=str(tmp_path / "nowhere")), 40, 0)
    with pytest.raises(DataError, match="3 training patches do not fill a batch of 4"):
        next(batches(np.zeros((3, 2, 2, 3), np.uint8), 4, 0))


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
