"""experiments.render at toy size: its figures, its messages, and invalid photographs."""

import json

import numpy as np
import pytest
from PIL import Image

from drt_jax import LensError, focal_length
from experiments import _command, render as experiment
from experiments.runs.config import load_config

from .test_experiments import ROOT

SETTINGS = ROOT / "configs/render.yaml"
SMALL = ("nodes=2", "kernel=9", "model=gaussian", "scene.lens=cooke_triplet")


def main(*words):
    _command.main(experiment, experiment.arguments([str(word) for word in words]))


@pytest.fixture
def photo(tmp_path):
    """A grey photograph, 40 x 30."""
    path = tmp_path / "photo 1.png"
    Image.fromarray(np.full((30, 40), 128, np.uint8)).save(path)
    return path


def test_a_zoom_takes_its_photograph_in_any_configuration():
    """The focal lengths are those of the patent; the error for a missing configuration names it."""
    zoom, key = "configs/design/lenses/us5568323.zmx", "scene.configuration"
    words = f"scene.lens={ROOT / zoom}"
    for number, focal in ((1, 28.98), (2, 49.99), (3, 68.0)):
        config = load_config(experiment.Config, SETTINGS, [words, f"{key}={number}"])
        found = focal_length(config.scene.load(), 0.5876)
        np.testing.assert_allclose(found, focal, rtol=1e-3)
    macro = f"scene.lens={ROOT / zoom.replace('5568323', '5257137')}"
    for number, distance in ((1, np.inf), (2, 215.4011)):
        config = load_config(experiment.Config, SETTINGS, [macro, f"{key}={number}"])
        assert config.scene.distance() == distance
    config = load_config(experiment.Config, SETTINGS, [words, f"{key}=4"])
    with pytest.raises(LensError, match="no configuration 4; the file has 3"):
        config.scene.load()


@pytest.mark.slow
def test_it_writes_the_photograph_beside_the_ideal_one(photo, tmp_path, capsys):
    folder = tmp_path / "run"
    main(photo, "--out", folder, "--set", *SMALL)
    said = capsys.readouterr().out
    assert "light outside the kernels" in said and "pixel, um" in said
    results = json.loads((folder / "results.json").read_text())
    assert results["kernel"] == 9 and results["shape"] == [30, 40]
    pictures = {path.stem: np.asarray(Image.open(path)) for path in folder.glob("figures/*.png")}
    assert set(pictures) == {"ideal", "photo", "beside"}
    assert pictures["photo"].shape == pictures["ideal"].shape == (30, 40, 3)
    middle = pictures["photo"][10:20, 15:25].mean(axis=(0, 1))
    np.testing.assert_allclose(middle, 128, atol=2)


def test_the_curve_of_srgb_goes_there_and_back():
    levels = np.arange(256, dtype=np.uint8)
    np.testing.assert_array_equal(experiment.encoded(experiment.linear(levels)), levels)


def test_bad_photographs_get_one_line(photo, tmp_path, capsys):
    broken, other = tmp_path / "broken.jpg", tmp_path / "other.png"
    broken.write_bytes(b"no picture")
    Image.fromarray(np.zeros((8, 8), np.uint8)).save(other)
    for words, message in (
        ((broken,), "photo: "),
        ((tmp_path / "none.png",), "No such file"),
        ((photo, "--set", "pixel_um=-1"), "pixel_um: expected"),
        ((photo, "--set", f"scene.depth={other}"), "give one of its size"),
    ):
        with pytest.raises(SystemExit):
            main(*words, "--out", tmp_path / str(abs(hash(words))))
        lines = capsys.readouterr().err.strip().splitlines()
        assert len(lines) == 1 and message in lines[0]
