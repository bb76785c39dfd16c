"""Invalid settings: one short line names the key and the expected value, and no run starts."""

import numpy as np
import pytest
from PIL import Image

from .test_experiments import ROOT, main
from .test_starts import STARTS
from .test_tolerance import SETTINGS

# Valid settings, by experiment.
RIGHT = {
    "accuracy": [],
    "design": [],
    "focus": [],
    "restore": ["scene.lens=cooke_triplet", "scene.field=10"],
    "tolerance": [f"{key}={value}" for key, value in SETTINGS.items()],
    "joint": [k for k in STARTS["joint"] if not k.startswith(("arms", "tolerances", "judge"))],
}
# Invalid settings, and parts of the line.
WRONG = {
    "accuracy": [
        ("orders=[2, 41]", "orders: expected 1 to 40"),
        ("rays=[4]", "rays: expected 7 to 1e+07, got 4"),
        ("scenes=[]", "scenes: needs at least one item"),
        ("scenes=[{field_deg: -1}]", "scenes[0].field_deg: expected 0 to 89.9, got -1.0"),
        ("scenes=[{dtype: float16}]", "scenes[0].dtype: expected one of float64, float32"),
    ],
    "design": [
        ("variables=[{kind: curvture}]", "got 'curvture'; did you mean curvature?"),
        ("variables=[{kind: curvature, low: 1, high: 0}]", "is not below high"),
        ("variables=[{kind: curvature, surfaces: [9]}]", "no surface 9"),
        ("variables=[{kind: sensor}, {kind: sensor}]", "twice"),
        ("solves=[{kind: focal_length, value: 50}]", "give surface"),
        ("operands=[]", "operands: needs at least one item"),
        ("operands=[{kind: blur}]", "operands[0].kind: expected one of spot,"),
        ("starts.how=anywhere", "one of normal, sobol, as_built"),
        ("lens=nowhere.yaml", "nowhere.yaml"),
        ("growth.first=2", "growth.first: expected"),
        ("glasses={makers: [SCHOTT], names: zz*}", "glasses.names: no glass of these makers is"),
        ("glasses={makers: [SCHOTT]}", "has no model glass; give nd and vd"),
    ],
    "focus": [
        ("train.bacth=3", "did you mean train.batch?"),
        ("noise=loud", "noise: expected a number, got 'loud'"),
        ("scene.lens=triplet", "no bundled lens 'triplet'"),
        ("data.root=nowhere", "data.root: nowhere is not a folder"),
        ("camera.kernel=8", "camera.kernel: expected an odd number"),
        ("train.batches=0", "train.batches: expected 1 to inf, got 0"),
        ("data.crops_per_image=1 && train.batch=500", "do not fill a batch"),
        ("scene.wavelengths_um=[0.6,0.5,5.0]", "outside the range of N-SK2"),
        ("scene.wavelengths_um=[0.6,0.5]", "expected three, for R, G, B"),
        ("starts_mm=[]", "starts_mm: needs at least one item"),
        ("starts_mm=[133,133]", "starts_mm: an item stands twice"),
        ("distance_m=-1", "distance_m: expected 0.001 to 1e+09, got -1.0"),
        ("noise=.nan", "noise: expected a number, got nan"),
        ("train.network_rate=1", "unknown key train.network_rate"),
    ],
    "restore": [
        ("train.variables=[curvture]", "unknown 'curvture'; known: sensor, curvature, con"),
        ("train.variables=[semi_diameter]", "unknown 'semi_diameter'; known: sensor"),
        ("train.variables=[]", "train.variables: needs at least one item"),
        ("train.variables=[sensor, sensor]", "train.variables: an item stands twice"),
        ("train.variables=[curvature x]", "such as curvature 0, got 'curvature x'"),
        ("train.variables=[sensor 1]", "such as curvature 0, got 'sensor 1'"),
        ("train.variables=[curvature 9]", "train.variables: curvature: no surface 9; there"),
        ("train.variables=[curvature, curvature 1]", "variables: curvature 1 stands twice"),
        ("train.variables=[coefficients]", "coefficients: the lens has none; add some"),
        ("scene.field=90", "scene.field: expected -89 to 89, got 90"),
        ("scene.field=[1, 2, 3]", "scene.field: expected one angle in degrees, or [x, y]"),
    ],
    "tolerance": [
        ("fields_deg=[[1]]", "fields_deg: expected pairs x, y from -89 to 89"),
        ("scales=[]", "scales: needs at least one item"),
        ("tolerances=[{kind: radii, size: 1}]", "got 'radii'; did you mean radius?"),
        ("tolerances=[{kind: tilt, size: 1, which: [3]}]", "tilt: no element 3"),
        ("compensator=focus and tilt", "the fields lie on a line"),
    ],
    "joint": [
        (
            "camera={pixel_um: 4, kernel: 9, tolerance: 0.2}",
            "camera.kernel: ...of the light of the spoilt lens falls outside a kernel of 9 pixels",
        ),
        (
            "judge={rings: 2, patches: 1, waves: 2, cells: 16}",
            "camera.kernel: 9 pixels of 20 um need ... cells of waves: raise judge.cells",
        ),
        ("train.batch=3", "train.batch: expected a multiple of train.points"),
        ("arms=[frozen]", "arms: frozen needs spots"),
        ("arms=[]", "arms: expected one or more, or a map"),
        ("judge.others=nowhere", "judge.others: nowhere is not a folder; give one with images"),
        ("judge.others={photos}", "judge.others: ...photos: expected four photographs or more"),
        ("map.plates=[0, 1]", "map: needs taps above 0 and stops"),
        ("map.noise=[0.1]", "map: needs taps above 0 and stops"),
        ("arms=[filter]", "arms: filter needs taps above 0"),
        ("arms=[freed]", "arms: freed needs taps above 0 and stops"),
        ("arms=[built_network]", "tolerances: needs at least one item"),
        ("model_glass=[0]", "model_glass: surfaces: no glass begins behind surface 0"),
        ("held=[abbe]", "held: unknown 'abbe'; known: curvature, sensor"),
        ("stops=[1]", "stops: needs the solve entrance_pupil"),
        ("taps=4", "taps: expected an odd number, or 0"),
        ("variables=[{kind: conic, surfaces: [9]}]", "variables: conic: no surface 9"),
        ("judge.builds=5", "tolerances: needs at least one item"),
        ("depth_m=[5, 1]", "depth_m: expected the nearest and the farthest"),
    ],
}
# These trace rays.
LONG = "camera={", "judge={", "tolerances=", "compensator="
CASES = [
    pytest.param(name, wrong, line, marks=pytest.mark.slow if wrong.startswith(LONG) else ())
    for name, cases in WRONG.items()
    for wrong, line in cases
]


def refused(capsys, name, *options):
    """The last line of output of an experiment."""
    with pytest.raises(SystemExit) as stopped:
        main(name, *options)
    error = capsys.readouterr().err
    line = error.strip().splitlines()[-1].removeprefix("error: ")
    assert stopped.value.code == 2 and "Traceback" not in error and len(line) <= 300
    return line


@pytest.mark.parametrize("name, wrong, line", CASES)
def test_wrong_settings_get_one_clear_line(name, wrong, line, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(ROOT)
    (photos := tmp_path / "photos").mkdir()
    for k in range(2):
        Image.fromarray(np.full((40, 40, 3), 100 * k, np.uint8)).save(photos / f"{k}.png")
    folder, changes = tmp_path / "run", wrong.replace("{photos}", str(photos)).split(" && ")
    config = ["--config", ROOT / "configs/design/triplet.yaml"] if name == "design" else []
    found = refused(capsys, name, *config, "--out", folder, "--set", *RIGHT[name], *changes)
    assert all(part in found for part in line.split("...")), found
    assert name != "restore" or not folder.exists()


@pytest.mark.parametrize(
    "options, line",
    [
        (["--config", "none.yaml"], "none.yaml: cannot be read"),
        (["--resume"], "nothing to resume"),
        (["--report"], "no results.json in it: the run is not finished"),
    ],
)
def test_a_run_that_is_not_there_is_named(options, line, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert line in refused(capsys, "focus", "--out", tmp_path / "run", *options)
