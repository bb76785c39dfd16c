"""The command `drt-jax`, in a checkout and from a wheel."""

import os
import pathlib
import subprocess
import sys
import zipfile

import pytest

from experiments import __main__ as command

ROOT = pathlib.Path(__file__).resolve().parents[2]
FEW = ["starts.count=1", "trials=2", "tolerance=0.1", "order=2", "fields_deg=[0]"]
FEW += ["wavelengths_um=[0.55]"]


def test_it_lists_every_experiment_that_has_settings(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["drt-jax", "--help"])
    command.main()
    said = capsys.readouterr().out
    settings = {path.stem for path in (ROOT / "configs").glob("*.yaml")}
    assert set(command.names()) == settings
    assert all(f"  {name}\n" in said for name in settings) and "show LENS" in said


def test_what_is_no_experiment_goes_to_the_package(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["drt-jax", "glass", "N-BK7"])
    command.main()
    assert "N-BK7 (SCHOTT)" in capsys.readouterr().out


@pytest.mark.slow
def test_a_wheel_runs_an_experiment_with_its_default_settings(tmp_path):
    """In a folder that is not a checkout; the settings name a lens file next to them."""
    source = tmp_path / "source"
    subprocess.run(["git", "clone", "-q", ROOT, source], check=True)
    for path in subprocess.run(
        ["git", "ls-files", "-m", "-o", "--exclude-standard"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.split():  # fmt: skip
        if (ROOT / path).is_file():
            (source / path).parent.mkdir(parents=True, exist_ok=True)
            (source / path).write_bytes((ROOT / path).read_bytes())
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "-q"]
    subprocess.run([*pip, "wheel", "--no-deps", "-w", tmp_path, source], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "experiments/configs/design/lenses/plates.yaml" in names and len(names) < 300
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    (tmp_path / "work").mkdir()
    words = [sys.executable, "-P", "-m", "experiments", "design", "--out", "run", "--set", *FEW]
    ran = subprocess.run(
        words,
        cwd=tmp_path / "work",
        env=os.environ | {"PYTHONPATH": str(tmp_path / "site"), "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "work" / "run" / "report.html").stat().st_size > 10_000
    settings = (tmp_path / "work" / "run" / "config.yaml").read_text()
    assert str(tmp_path / "site" / "experiments" / "configs" / "design" / "lenses") in settings
