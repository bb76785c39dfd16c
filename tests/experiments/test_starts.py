"""Every experiment runs from settings to figures, as small as its settings allow."""

import importlib
import json
import pathlib
import pkgutil

import jax
import numpy as np
import pytest
from PIL import Image

import experiments
from drt_jax import design, first_order, load_lens, save_lens
from experiments import _command, _psf_peers, _work, benchmark, tables
from experiments.runs.folder import Run

from .test_experiments import TOY

ROOT = pathlib.Path(__file__).resolve().parents[2]
STARTS = {
    "stability": ["families=[offaxis]", "scenes=12"],
    "requested": [
        *("views=[{lens: singlet, field_deg: 3}]", "parts=[1]", "quantities=[spot]"),
    ],
    "faults": ["parts=[files]", "files=30", "traced=1"],
    "files": ["folders=[{toy}]"],
    "benchmark": [
        *("tasks=[spot,profile]", "growth=false", "repeats=1", "lens=singlet", "field_deg=0"),
        *("rays=[7]", "orders=[5]", "profile.lenses=[{lens: singlet, field_deg: 3}]"),
        *("profile.parts=[0]", "profile.own_orders=[5]", "profile.rays=[7]", "profile.orders=[1]"),
    ],
    "skips": [
        *("rows=[order]", "lens=singlet", "field_deg=2", "wavelengths_um=[0.55]", "generous=12"),
        "repeats=1",
    ],
    "devices": ["counts=[1]", "patch=8", "repeats=2", "network={layers: 1, channels: 4}"],
    "images": [
        *(
            "views=[{lens: singlet, field_deg: 0, pixel_um: 8}]",
            "size=9",
            "rays=[16]",
            "waves=[48]",
        ),
        "photographs=[{lens: singlet, pixel_um: 100}]",
        *("limit=64", "rounds=2", "peers=[64]", "frequencies=5", "photo_pixels=48", "repeats=1"),
        *("gallery.lens=singlet", "gallery.fields_deg=[0]", "gallery.distances_m=[.inf]"),
    ],
    "elements": [
        *("elements=1", "design.fields_deg=[0,5]", "design.wavelengths_um=[0.588]"),
        *("design.variables=[{kind: curvature}, {kind: sensor}]", "design.order=3"),
        *("design.operands=[{kind: spot}, {kind: focal_length, low: 50, high: 50.01}]",),
        *("design.glasses={makers: []}", "design.trials=10"),
    ],
    "temperature": [
        *("lens=singlet", "fields_deg=[0]", "wavelengths_um=[0.55]", "celsius=[-20, 60]"),
        *("mounts=[{name: brass, expansion: 19}]", "order=3", "tolerance=0.1"),
    ],
    "joint": [
        *(
            "lens=singlet",
            "variables=[{kind: curvature}, {kind: sensor}]",
            "solves=[]",
            "limits=[]",
        ),
        *("spoil.per_cent=1", "field_deg=2", "camera={pixel_um: 20, kernel: 9, tolerance: 0.2}"),
        *("network={layers: 1, channels: 4}", "seeds=1", "mtf_at=1", "data.crops_per_image=4"),
        "arms=[focus,spots,joint_from_spots,rays_from_spots,frozen,built_spots,tolerant]",
        "train={batches: 12, batch: 2, patch: 8, points: 2, checkpoint_every: 5}",
        "tolerances=[{kind: radius, size: 1}, {kind: tilt, size: 3}]",
        "judge={rings: 2, patches: 1, waves: 2, cells: 64, builds: 3}",
    ],
}
# Programs of many kinds.
LONG = ("benchmark", "elements", "faults", "files", "images", "joint", "skips", "stability")
LONG += ("temperature",)
# Experiments that have tests of their own, in `test_NAME`.
ELSEWHERE = ("accuracy", "design", "render", "tolerance", "zoom")


def runnable():
    """Names that `python -m experiments.NAME` runs; modules whose names start with _ are parts."""
    names = [m.name for m in pkgutil.iter_modules(experiments.__path__) if m.name[0] != "_"]
    files = {name: importlib.util.find_spec(f"experiments.{name}").origin for name in names}
    main = '\nif __name__ == "__main__":'
    return {name for name, path in files.items() if main in pathlib.Path(path).read_text()}


def test_each_experiment_is_started_somewhere():
    """Those of the paper in `test_experiments`; the others here or in files of their own."""
    assert runnable() == {*STARTS, *ELSEWHERE, *TOY, "tables"}
    for name in ELSEWHERE:
        text = (pathlib.Path(__file__).parent / f"test_{name}.py").read_text()
        assert "_command.main(" in text and "figures" in text and "results.json" in text


def checked_stability(results):
    (row,) = results["families"]
    assert row["ok"] > 0 == row["nan_values"] + row["nan_gradients"] + row["disagree_with_snell"]


def checked_requested(results):
    """float64 keeps all tolerances; float32 keeps or refuses them."""
    assert {row["dtype"] for row in results["rows"]} == {"float64", "float32"}
    for row in results["rows"]:
        assert row["refused"] if row["error"] is None else row["error"] <= row["tolerance"]
        assert not row["refused"] or (row["dtype"] == "float32" and "x64" in row["refused"])
    assert any(row["refused"] for row in results["rows"])


def checked_faults(results):
    assert not any(row["wrong"] + row["traceback"] + row["hang"] for row in results["rows"])
    assert sum(row["refused"] for row in results["rows"]) > 20


def toy_files(folder):
    """A file with a listing that agrees with it, and a file that is not a lens file."""
    save_lens(load_lens("singlet"), folder / "singlet.zmx")
    focal = first_order(load_lens("singlet"), np.inf, [0.5875618]).effective_focal_length[0]
    (folder / "singlet.txt").write_text(f"Effective Focal Length :  {float(focal):.4f}\n")
    (folder / "none.zmx").write_text("SURF 0\n")
    return folder


def checked_files(results):
    """Our result, and for each peer the note that it is not installed."""
    outcomes = [row["outcome"] for row in results["rows"]]
    assert outcomes == ["refused", "absent", "absent", "right", "absent", "absent"]


def checked_benchmark(results):
    """A curve of ours, for each peer the note that it is not installed, the counts and the
    machine."""
    (row,) = results["curves"]
    low, middle, high = row["quartiles_s"]
    assert row["program"] == "drt_jax" and row["error"] < 1e-8 and 0 < low <= middle <= high
    assert results["missing"] == {
        name: f"{name} is not installed: pip install -e '.[peers]'"
        for name in ("optiland", "batoid")
    }
    ours, *others = results["profile"]
    assert ours["program"] == "drt_jax" and ours["error"] < 1e-9 and all(ours["quartiles_s"])
    assert all(bool(row["why"]) != bool(row["quartiles_s"][0]) for row in others)
    solves = list(results["counts"].values())
    assert solves[:2] == [0, 0] and solves[2] > 0
    (machine,) = results["machines"]
    assert machine["cpu"] and machine["cores"] > 0 and machine["versions"]["jax"]


def checked_skips(results):
    """The order from the error traces fewer rays, within the tolerance, than a generous order."""
    (row,) = results["rows"]
    fitted, generous = row["ways"]
    assert fitted["rays"] < generous["rays"] == 12 * 13
    assert fitted["error"] < 1e-6 and generous["error"] < 1e-8 and fitted["compile_s"] > 0
    assert row["factor"] == generous["quartiles_s"][1] / fitted["quartiles_s"][1]


def checked_devices(results):
    """A single device has no all-reduce."""
    (row,) = results["rows"]
    assert row["step_s"] > 0 == row["loss_apart"] == row["carried_bytes"]
    assert results["weights"] == 9 * 3 * 4 + 4 + 9 * 4 * 3 + 3


def checked_images(results):
    """Every model is close to its limit; for missing peers there is a reason."""
    errors = {row["model"]: row["error"] for row in results["kernels"]}
    assert errors["gaussian"] is None and errors["rays"] < 0.1 and errors["waves"] < 0.02
    assert {row["note"] for row in results["peers"]} == {"no program of this kind"}
    assert np.max(results["views"][0]["transfer"]) <= 1 + 1e-9


def checked_elements(results):
    """Both directions at two surfaces; the best lens has a smaller spot than the singlet."""
    first, *others, last = results["rows"]
    assert first["elements"] == 1 and {row["elements"] for row in (*others, last)} == {2}
    assert 1 <= len(others) <= 4 and others[0]["merit"] < first["merit"]
    assert last["merit"] <= 1.001 * others[0]["merit"]


def checked_temperature(results):
    """The focus moves as first-order optics predicts, to a tenth: spherical aberration changes
    little."""
    cold, hot = results["rows"]
    lens = load_lens("singlet")
    model = design.ThermalModel.from_lens(lens, 19.0)
    behind = [
        first_order(own, np.inf, [0.55]).image_distance[0] - own.sensor
        for own in (design.at_temperature(lens, celsius, model) for celsius in (-20.0, 60.0))
    ]
    expected = 1e3 * float(behind[1] - behind[0])
    assert hot["shift_um"] - cold["shift_um"] == pytest.approx(expected, rel=0.1)
    assert all(row["refocused_um"][0] <= row["spots_um"][0] for row in (cold, hot))


def checked_joint(results):
    """Every arm is trained and evaluated, and its lens is the one that it should have."""
    rows = {row["arm"]: row for row in results["rows"]}
    assert list(rows) == results["arms"] and len(rows) == 7
    assert all(0 < row["mae"] < 0.6 and row["step_s"] > 0 for row in rows.values()), rows
    assert rows["spots"]["spot_um"] == pytest.approx(results["start_um"]["spots"])
    assert rows["tolerant"]["spot_um"] != rows["spots"]["spot_um"] < results["start_um"]["spoilt"]
    assert [len(loss) for loss in results["losses"]] == [12] * 7
    assert rows["built_spots"]["spot_um"] > rows["spots"]["spot_um"]
    built = ["spots", "joint_from_spots", "rays_from_spots", "built_spots", "tolerant"]
    assert [row["arm"] for row in results["builds"]] == built
    assert all(row["low"] <= row["mean"] and len(row["each"]) == 3 for row in results["builds"])


@pytest.mark.slow
def test_a_joint_run_that_stops_resumes_to_the_same_numbers(tmp_path, monkeypatch):
    own = [key for key in STARTS["joint"] if not key.startswith(("arms", "tolerances", "judge"))]
    own += ["arms=[spots,rays]", "judge={rings: 2, patches: 1, waves: 2, cells: 64, builds: 0}"]
    experiment, log = importlib.import_module("experiments.joint"), Run.log

    def stopping(self, job, step, rows):
        log(self, job, step, rows)
        if job.startswith("rays") and step == 10:  # after its first checkpoint
            raise KeyboardInterrupt

    folders = tmp_path / "whole", tmp_path / "stopped"
    _command.main(experiment, ["--out", str(folders[0]), "--set", *own])
    monkeypatch.setattr(Run, "log", stopping)
    with pytest.raises(SystemExit):
        _command.main(experiment, ["--out", str(folders[1]), "--set", *own])
    monkeypatch.undo()
    _command.main(experiment, ["--out", str(folders[1]), "--resume"])
    whole, resumed = (json.loads((f / "results.json").read_text()) for f in folders)
    for row in [*whole["rows"], *resumed["rows"]]:
        row.pop("step_s")
    assert whole.pop("machines") and resumed.pop("machines")
    assert whole == resumed


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:size: ")
def test_a_filter_in_front_of_the_network_and_the_best_stop(tmp_path):
    """For the filter, least squares on its error finds a better lens than least squares on spots.
    Photographs of a folder are evaluated, too; and one scene of a map has no network."""
    (photos := tmp_path / "photos").mkdir()
    for k, colour in enumerate((0, 0, 40, 40, 90, 90)):
        pixels = np.random.default_rng(k).integers(0, 160, (90, 90, 1)) + [0, colour, 0]
        Image.fromarray(pixels.astype(np.uint8)).save(photos / f"{k}.png")
    own = [key for key in STARTS["joint"] if not key.startswith(("arms", "tol", "judge", "var"))]
    own += [
        "variables=[{kind: curvature}, {kind: sensor}, {kind: abbe, low: 30, high: 80}]",
        *("model_glass=[1]", "held=[abbe]", "stops=[1, 0.7]", "taps=9", "shot=0.02"),
        "solves=[{kind: entrance_pupil, value: 10}]",
        *("camera.kind=waves", "train.patch=48"),
        "arms=[stopped, freed, filter, rays_from_filter]",
        "judge={rings: 2, patches: 1, waves: 2, cells: 64, others: " + str(photos) + "}",
        "map={noise: [0.02], near_m: [.inf]}",
    ]
    experiment, out = importlib.import_module("experiments.joint"), tmp_path / "run"
    _command.main(experiment, ["--out", str(out), "--set", *own])
    results = json.loads((out / "results.json").read_text())
    behind = results["filter_db"]
    assert behind["filter"] > 1 + max(behind[name] for name in ("stopped", "freed")), behind
    assert len(results["rows"]) == 4 and all(0 < row["mae"] < 0.6 for row in results["rows"])
    (scene,) = results["map"]
    assert scene["lenses"]["filter"][0] > scene["lenses"]["freed"][0]
    assert all("grey_psnr" in row for row in results["rows"])
    assert len(experiment.tables(results)) == 4


# Small kernels lose light.
@pytest.mark.filterwarnings("ignore:size: ")
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in LONG else n for n in STARTS]
)
def test_it_ends_with_results_tables_and_pictures(name, tmp_path, monkeypatch, capsys):
    def missing(name):
        raise ModuleNotFoundError(name=name)

    def fails(*_):
        raise ValueError("no program of this kind")

    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(_work, "version", missing)
    for peer in ("optiland", "prysm"):
        monkeypatch.setattr(_psf_peers, peer, fails)
    experiment = importlib.import_module(f"experiments.{name}")
    if name == "images":  # rays of a histogram that are traced at once
        monkeypatch.setattr(experiment, "_ROUND", 2**15)
    try:
        (toy := tmp_path / "toy").mkdir()
        own = [key.format(toy=toy_files(toy)) if "{toy}" in key else key for key in STARTS[name]]
        _command.main(experiment, ["--out", str(tmp_path / "run"), "--set", *own])
    finally:  # those on speed compile everything anew
        jax.config.update("jax_enable_compilation_cache", True)
    globals()[f"checked_{name}"](json.loads((tmp_path / "run" / "results.json").read_text()))
    assert "done in" in capsys.readouterr().out
    assert all(p.stat().st_size > 3000 for p in (tmp_path / "run" / "figures").iterdir())


def test_a_peer_that_fails_is_a_note(monkeypatch):
    """As for a missing peer, no time is measured."""

    def fails():
        raise ValueError("no program of this kind")

    monkeypatch.setattr(_work, "version", lambda name: "1")
    peers = _work.peer("one", fails) | _work.peer("two", lambda: (lambda: None, 1.0))
    ours = (lambda: None), dict.fromkeys(_work.MEASURED, 1.0)
    none, two = _work.rows_of("work", ours, 0.5, peers, 1)
    assert none["note"] == "no program of this kind" and none["peer_s"] is None
    assert two["peer"] == "two 1" and two["peer_s"] > 0 and two["peer_error"] == 1.0


@pytest.mark.slow
def test_benchmark_starts_new_processes():
    first = _work._FIRST.format(lens="singlet", field=0.0, distance=1e4)
    config = benchmark.Config(lens="singlet", bundle=64, repeats=1)
    spread = _work.SPREAD.format(devices=1, config=config)
    assert all(min(_work.in_a_new_process(code, {})) > 0 for code in (first, spread))


def test_tables_has_nothing_to_write(capsys):
    tables.main([])
    assert capsys.readouterr().out == ""
