"""The paper's experiments with a user's lens: fields, variables, their rates, what is drawn, and
how a run ends when surfaces cross."""

import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import drt_jax
from drt_jax import Scene, learn
from drt_jax.learn import train
from drt_jax.pupil import hexapolar
from experiments import _optics

from .test_experiments import SMALL, assert_same, main, stop

OWN = ["scene.lens=cooke_triplet", "scene.field=10"]
RESTORE = [
    *SMALL,
    *OWN,
    "train.variables=[sensor, curvature]",
    "train.optics_rate=0.01",
    "distance_m=5",
    "starts_mm=[60.1]",
    "table_starts_mm=[60.1]",
    "table_noise=[0.01]",
    "test_patches=3",
]
FOCUS = [*SMALL, *OWN, "train.variables=[curvature]", "distance_m=5", "starts_mm=[60.1, 60.3]"]
NAMES = [f"curvature {i}" for i in range(6)]
SCENE = _optics.Scene(lens="cooke_triplet", field=10.0, tolerance=1e-6)
FAR = 5e3


@functools.cache
def lens(*variables):
    return _optics.Trained.of("cooke_triplet", variables)


def read(folder):
    return json.loads((folder / "results.json").read_text())


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A run of `restore` with a user's lens, field and variables."""
    folder = tmp_path_factory.mktemp("own") / "run"
    main("restore", "--out", folder, "--set", *RESTORE)
    return folder


@pytest.mark.slow
def test_a_lens_is_trained_off_the_axis(own):
    results, rows = read(own), np.genfromtxt(own / "metrics.csv", delimiter=",", names=True)
    header = (own / "metrics.csv").read_text().splitlines()[0].split(",")
    assert header == ["job", "step", "loss", "sensor_mm", "sigma_um", *NAMES, "check"]
    ((start, end),) = results["numbers"]
    cooke = drt_jax.load_lens("cooke_triplet")
    for k, name in enumerate(NAMES):
        assert rows[name.replace(" ", "_")][0] == start[name] == float(cooke.curvature[k])
        assert start[name] != end[name]
    assert rows["sensor_mm"][0] == start["sensor"] == 60.1 != end["sensor"]
    assert end["rms_um"] < 0.5 * start["rms_um"] and end["light"] == pytest.approx(1)
    # The lens in the folder is the reported one, and its blur is that of the training.
    designed = drt_jax.load_lens(own / "designed" / "start 60.1.yaml")
    assert designed.curvature.tolist() == [*(end[name] for name in NAMES), 0.0]
    assert float(designed.sensor) == end["sensor"]
    found = drt_jax.psf_moments(designed, Scene.point(np.radians(10), 5e3, (0.6, 0.53, 0.48)), 1e-9)
    mean, spread = np.asarray(found.mean), np.asarray(found.covariance)
    apart = np.sum((mean - mean.mean(axis=0)) ** 2, axis=1)
    radius = np.sqrt(np.mean(np.trace(spread, axis1=1, axis2=2) + apart))
    assert end["rms_um"] == pytest.approx(1e3 * radius, rel=1e-7)
    figures = {path.stem for path in (own / "figures").glob("*.png")}
    assert figures == {"figure_5a", "restored", "numbers", "designed"}


@pytest.mark.slow
def test_its_table_has_none_of_the_papers_numbers(own, capsys):
    drawn = {path.name: path.read_bytes() for path in (own / "figures").iterdir()}
    main("restore", "--report", "--out", own)
    said = capsys.readouterr().out
    assert "paper" not in said and "133.35" not in said and "0.02 and 0.03" not in said
    assert "| curvature 5 1/mm" in said and "| RMS radius um at 5 m" in said
    assert drawn == {path.name: path.read_bytes() for path in (own / "figures").iterdir()}


@pytest.mark.slow
def test_an_interrupted_run_resumes_to_the_same_lens(own, tmp_path):
    stop("restore", tmp_path / "run", RESTORE, "start 60.1", 10)
    main("restore", "--resume", "--out", tmp_path / "run")
    assert_same(own, tmp_path / "run")
    name = "designed/start 60.1.yaml"
    assert (own / name).read_bytes() == (tmp_path / "run" / name).read_bytes()


@pytest.mark.slow
def test_focus_without_its_sensor_and_how_a_lens_goes_bad(tmp_path, capsys):
    """A sensor that is not a variable does not move. Surfaces that cross end a run; its folder then
    has the last valid lens and all metrics."""
    main("focus", "--out", tmp_path / "good", "--set", *FOCUS, "train.optics_rate=0.01")
    results, said = read(tmp_path / "good"), capsys.readouterr().out
    assert results["final_mm"] == pytest.approx([60.1, 60.3]) and "best_focus_mm" not in results
    assert [end["rms_um"] < start["rms_um"] for start, end in results["numbers"]] == [True, True]
    assert "plane that all starts reach" not in said and "paper" not in said
    figures = {path.stem for path in (tmp_path / "good" / "figures").glob("*.png")}
    assert figures == {"lens", "figure_4b", "numbers", "designed"}

    with pytest.raises(SystemExit) as stopped:
        main("focus", "--out", tmp_path / "bad", "--set", *FOCUS, "train.optics_rate=10")
    said = capsys.readouterr().err.splitlines()[-1]
    assert stopped.value.code == 2 and said.startswith("error: start 60.")
    assert "lower train.optics_rate" in said and "the lens before is" in said
    rows = (tmp_path / "bad" / "metrics.csv").read_text().splitlines()
    assert len(rows) > 10
    for path in (tmp_path / "bad" / "designed").glob("*.yaml"):
        assert drt_jax.load_lens(path).count == 6


@pytest.mark.slow
def test_edof_with_a_field_beside_the_planes_of_the_lens(tmp_path, capsys):
    """With a dense kernel, and variables of single surfaces."""
    some = ["train.variables=[sensor, curvature 0, thickness 1]", "depth_m=[2, 10]"]
    some += ["starts_mm=[60.1, 60.5]", "fixed_mm=60.5", "scene.field=[5, 8]", "test_patches=3"]
    some += ["table_depth_m=[1.5, 5]", "patch_depth_m=[2, 5]", "train.optics_rate=0.01"]
    main("edof", "--out", tmp_path / "run", "--set", *SMALL, *OWN, *some)
    results, said = read(tmp_path / "run"), capsys.readouterr().out
    assert "paper" not in said and "145.29" not in said and "| thickness 1 mm" in said
    assert {"sensor", "curvature 0", "thickness 1"} < set(results["numbers"][1][1])
    with np.load(tmp_path / "run" / "results.npz") as arrays:
        assert arrays["blur_um"].shape == (2, 121, 3) and arrays["changes_mm"].shape == (2, 2, 25)
        # The second is for the trained lens, which has less blur over the depths of its training.
        assert arrays["blur_um"][1].mean() < arrays["blur_um"][0].mean()


@pytest.mark.slow
def test_the_sensor_alone_traces_no_ray_off_the_axis_either():
    some = lens("sensor")
    blur = some.blur(SCENE, FAR, FAR)
    assert "while" not in str(jax.make_jaxpr(blur)(some.start(60.2), FAR))
    assert some.names == () and set(some.start(60.2)) == {"sensor"}


@functools.cache
def joint():
    """The loss of the joint training as a function of the numbers of the lens, and the numbers."""
    some = lens("sensor", "curvature")
    init, restore = learn.red_net(2, 4)
    weights = init(jax.random.key(0))
    imager = train.make_imager(some.blur(SCENE, FAR, FAR), restore, train.Camera(kernel=9))
    scenes = np.random.default_rng(0).integers(0, 255, (3, 24, 24, 3), dtype=np.uint8)

    def loss(optics):
        parameters = {"optics": optics, "network": weights}
        found = imager(parameters, scenes, jnp.array(FAR), np.float32(0.01), jax.random.key(0))
        return jnp.mean(jnp.abs(found[2] - found[0]).astype(jnp.float64))

    return jax.jit(jax.value_and_grad(loss)), some.start(60.2)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["curvature 0", "curvature 3"])
def test_gradient_of_the_joint_loss_by_a_curvature(name):
    """Compared with central differences of varied steps. Images are float32, so that the step must
    not be too small."""
    both, values = joint()
    slope = both(values)[1][name]
    errors = []
    for step in 2e-6 * 2.0 ** np.arange(6):
        ends = [both(values | {name: values[name] + k * step})[0] for k in (-2, -1, 1, 2)]
        difference = (ends[0] - 8 * ends[1] + 8 * ends[2] - ends[3]) / (12 * step)
        errors.append(abs(float(difference / slope) - 1))
    assert min(errors) < 1e-3, errors


@pytest.mark.slow
def test_a_change_of_the_scale_moves_the_rays_as_a_millimetre_of_the_sensor_does():
    """Compared with differences of rays, except for a conic that would have to change by
    thousands."""
    some = lens("sensor", "curvature", "thickness 1", "conic 1")
    scale, pupil = some.scale(SCENE, FAR), hexapolar(4)[0]
    start = some.start(float(some.lens.sensor))
    assert set(scale) == set(start)
    assert scale["sensor"] == 1

    def moved(name, by):
        ends = []
        for sign in (-1, 1):
            values = start | {name: start[name] + sign * by}
            rays = drt_jax.trace_rays(some.lens_of(values), SCENE.seen(FAR), pupil)
            ends.append(np.asarray(rays.points[:, :, -1, :2]))
        change = (ends[1] - ends[0]) / 2
        return np.sqrt(np.mean((change - change.mean(axis=1, keepdims=True)) ** 2))

    wanted = moved("sensor", 1e-3)
    for name in (*NAMES, "thickness 1"):
        assert moved(name, 1e-3 * scale[name]) == pytest.approx(wanted, rel=1e-3), name
    assert moved("conic 1", 1e-3 * scale["conic 1"]) < 0.01 * wanted


def test_a_thickness_leaves_the_sensor_where_it_is():
    some = lens("sensor", "thickness")
    values = some.start(60.2) | {"thickness 1": 6.5}
    found = some.lens_of(values)
    assert float(found.sensor) == 60.2 and float(found.thickness[1]) == 6.5


def test_help_lists_what_may_be_trained(capsys):
    with pytest.raises(SystemExit):
        main("edof", "--help")
    said = capsys.readouterr().out
    assert "train.variables: a list, each item text" in said
    assert "scene.field: a number or a list, each item a number" in said
    for kind in _optics.KINDS:
        assert kind in said
