"""The arms of a joint design: least squares, training, and evaluation by another image model."""

import dataclasses
import itertools
import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from tqdm import tqdm

import drt_jax
from drt_jax import design
from drt_jax.learn import train
from drt_jax.learn.data import DataConfig, DataError, batches, load_patches
from drt_jax.learn.field import FieldImager, ObjectPoints

from . import _common, _training
from ._setup import ARMS, SEED, Setup
from .runs.config import ConfigError
from .runs.folder import Run

# Steps between those of two seeds, which points and noise depend on.
_APART = 10**7
# Patches of a picture; of a photograph through two lenses its side, pixels, and its place in the
# field.
_SHOWN, _SIDE, _PLACE = 5, 112, 0.9
# Parameters by arm and seed.
Trained = dict[tuple[str, int], Any]


def run(config: Any, run: Run) -> dict[str, Any]:
    """Optimises the lenses, then trains and evaluates all arms."""
    side = config.train.patch + config.camera.kernel - 1 + max(config.taps - 1, 0)
    others = _others(config.judge.others, side, run)
    setup = Setup(config, _training.read_patches(config.data, side, 0, run.folder))
    about = _common.settings(config, "name", "field_deg") | {"map": _map(setup, run)}
    plates = config.map.plates
    about |= {"plates": run.once("plates", lambda: _plates(setup, plates)) if plates else []}
    if not config.arms:
        return about | {"rows": []}
    begins = {"spoilt": None} | {ARMS[arm].begins: None for arm in ARMS if arm in config.arms}
    lenses = {name: setup.finished(name, run.once) for name in begins}
    (run.folder / "lenses").mkdir(exist_ok=True)
    _save(setup, run, "spoilt", setup.spoilt)
    imager = jax.jit(FieldImager(setup.judged_points, setup.restore).__call__)
    test = {"": setup.patches.test} | others
    rows, losses, trained = [], [], {}
    arms = [arm for arm in ARMS if arm in config.arms]  # `frozen` after `spots`
    jobs = {(arm, seed): f"{arm} {seed}" for arm in arms for seed in range(config.seeds)}
    for (arm, seed), job in jobs.items():
        weights = trained["spots", seed]["network"] if ARMS[arm].frozen else None
        begin = setup.start(ARMS[arm], seed, lenses[ARMS[arm].begins], weights)
        found, seconds = _train(setup, run, arm, seed, begin)
        trained[arm, seed], vector = found, found["optics"]["lens"]
        _save(setup, run, job, vector)
        row = {"arm": arm, "seed": seed, "step_s": seconds, "spot_um": setup.spot_um(vector)}
        judge = partial(_judged, setup, imager, found, test)
        rows.append(run.once(f"judged {job}", lambda: row | judge()))
    for arm in arms:
        own = [run.metrics(jobs[arm, seed])["loss"] for seed in range(config.seeds)]
        losses.append(np.mean(own, axis=0).tolist())
    angles = np.degrees(np.hypot(*np.asarray(setup.judged.fields).T))
    some = np.unique(np.linspace(0, len(angles) - 1, _SHOWN).astype(int))
    pictures = {}
    for arm in arms:
        patches = _one_each(setup, _training.textured(setup.patches.test, len(angles)))
        images = _training.images(imager, trained[arm, 0], patches, setup.judged, setup.noise, 0)
        pictures |= {f"{arm} {name}": array[some] for name, array in images.items()}
    builds = _as_built(setup, run, trained, test.get("others")) if config.judge.builds else []
    return {
        **about,
        "rows": rows,
        "arms": arms,
        "losses": losses,
        "start_um": {name: setup.spot_um(vector) for name, vector in lenses.items()},
        "filter_db": {name: setup.filter_db(vector) for name, vector in lenses.items()},
        "builds": builds,
        "drawn": ["spoilt", *(jobs[arm, 0] for arm in arms)],
        "pictures": arms,
        "pictures_deg": angles[some].tolist(),
        "far_mm": setup.depths[1] if math.isfinite(setup.depths[1]) else None,
        **pictures,
        **_photograph(setup, side, trained, builds or rows),
    }


def _map(setup: Setup, run: Run) -> list[dict[str, Any]]:
    """PSNR after the best filter and f-number of optimised lenses, for each scene of the map."""
    rows, asked = [], setup.config.map
    for near, noise in itertools.product(asked.near_m, asked.noise):
        depths = near, setup.config.depth_m[1]
        scene = dataclasses.replace(setup.config, depth_m=depths, noise=noise)
        what = f"{near:g} m, noise {noise:g}"
        print(f"map: {what}", flush=True)

        def measured() -> dict[str, tuple[float, float]]:
            own, found = Setup(scene, setup.patches), {}
            for name in ("spots", "stopped", "freed", "filter"):
                vector = own.finished(name, lambda part, make: run.once(f"{what}: {part}", make))
                ideal = drt_jax.first_order(own.lens_of(vector), math.inf, own.waves)
                found[name] = own.filter_db(vector), float(ideal.f_number[1])
            return found

        lenses = run.once(f"map {what}", measured)
        nearest = near if math.isfinite(near) else None
        rows.append({"near_m": nearest, "noise": noise, "lenses": lenses})
    return rows


def _plates(setup: Setup, factors: Sequence[float]) -> list[dict[str, float]]:
    """PSNR after the best filter, for each stop and factor. The lens is optimised for spots without
    the coefficients of its file; then these coefficients times each factor are added."""
    spoilt, rows = setup.lens_of(setup.spoilt), []
    bare = dataclasses.replace(spoilt, coefficients=0 * spoilt.coefficients)
    for stop in setup.config.stops:
        lens = setup.lens_of(setup.stopped(bare, setup.config.held, stop))
        number = float(drt_jax.first_order(lens, math.inf, setup.waves).f_number[1])
        for factor in factors:
            built = dataclasses.replace(lens, coefficients=factor * spoilt.coefficients)
            db = setup.filter_db(setup.variables.vector(built))
            rows.append({"f_number": number, "factor": factor, "db": db})
        print(f"f/{number:.1f}: {np.round([row['db'] for row in rows[-len(factors) :]], 2)}")
    return rows


def _train(
    setup: Setup, run: Run, arm: str, seed: int, begin: dict[str, Any]
) -> tuple[dict[str, Any], float]:
    """Trained parameters of a job, from its last checkpoint or from `begin` on, and the seconds of
    a step."""
    setting, job = setup.config.train, f"{arm} {seed}"
    total = setting.batches * ARMS[arm].longer
    init, same = setup.step(ARMS[arm])
    # Points and noise of their own for each seed, by one program.
    step = lambda *given: same(*given[:3], np.int32(given[3] + _APART * seed))  # noqa: E731
    first, state = run.load(job, init(begin), (job,), total)
    times: list[tuple[int, float]] = []  # steps that are done, and when; the first has compilation

    def log(start: int, metrics: dict[str, np.ndarray], state: Any) -> None:
        run.log(job, start, metrics)
        _training.require_finite(job, start, metrics["loss"])
        times.append((start + len(metrics["loss"]), time.perf_counter()))

    scenes = batches(setup.patches.train, setting.batch, seed, first)
    loop = _training.Loop(run, job, range(first, total), setting.checkpoint_every, setup.mesh)
    state = loop.train(step, state, scenes, setup.noise, log)
    steps, seconds = np.subtract(times[-1], times[0]) if times else (0, 0.0)
    return state[0], float(seconds) / max(int(steps), 1)


def _save(setup: Setup, run: Run, name: str, vector: Array) -> None:
    """Writes a lens with apertures fitted to its beams."""
    lens = design.fit_apertures(setup.spots, setup.variables.lens_of(vector))
    drt_jax.save_lens(lens, run.folder / "lenses" / f"{name}.yaml")


def _others(folder: str, side: int, run: Run) -> dict[str, np.ndarray]:
    """A patch of each photograph of `judge.others`: all, and the thirds with the least and the most
    colour; {} for no folder. ConfigError for one that cannot be used."""
    if not folder:
        return {}
    try:
        every = _training.read_patches(DataConfig(folder, 1, 0.99), side, 0, run.folder).test
    except DataError as error:
        raise ConfigError(str(error).replace("data.root", "judge.others")) from error
    third = len(every) // 3
    _common.require(third > 0, f"judge.others: {folder}: expected four photographs or more")
    colour = np.argsort(np.mean(np.ptp(every, axis=-1), axis=(1, 2)))
    return {"others": every, "grey": every[colour[:third]], "coloured": every[colour[-third:]]}


def _judged(
    setup: Setup, imager: Callable, parameters: Any, test: dict[str, np.ndarray]
) -> dict[str, Any]:
    """Quality of the images of an arm in the evaluation; PSNR alone for the other images."""
    count, found = len(setup.judged.fields), {}
    for name, every in test.items():
        patches = _training.thinned(every, setup.config.judge.patches * count)
        own = train.evaluate(imager, parameters, patches, setup.judged, setup.noise, 0, count)
        found |= {f"{name}_psnr": own["psnr"]} if name else own
    return found


def _one_each(setup: Setup, patches: np.ndarray) -> np.ndarray:
    """A patch for each point of the evaluation; patches are repeated if there are too few."""
    return np.resize(patches, (len(setup.judged.fields), *patches.shape[1:]))


def _photograph(setup: Setup, side: int, trained: Trained, rows: list[dict]) -> dict[str, Any]:
    """Part of a photograph through the lens and network of the first arm, and of the best arm.

    rows: of lenses as built, or of arms. Where they are of lenses as built, both lenses have the
        same errors: those with which the first arm reaches its 10th percentile.
    """
    config, measure = setup.config, "low" if "low" in rows[0] else "psnr"
    groups = _common.grouped(rows, "arm").items()
    means = {arm: float(np.mean([row[measure] for row in own])) for (arm,), own in groups}
    arms = list(dict.fromkeys([next(iter(means)), max(means, key=means.__getitem__)]))
    errors = None
    if measure == "low":
        table, each = _built_lenses(setup), rows[0]["each"]
        errors = jnp.asarray(table[np.argsort(each)[len(each) // 10]])
    try:
        few = dataclasses.replace(config.data, crops_per_image=8)
        every = load_patches(few, side - config.train.patch + _SIDE, 0).test
    except DataError:  # the photographs are too small
        every = setup.patches.test
    scene = every[[int(np.argmax(np.std(every, axis=(1, 2, 3))))]]
    field = jnp.array([[0.0, math.atan(_PLACE * math.tan(setup.field))]])
    seen = ObjectPoints(field, jnp.array([setup.depths[1]]), errors)
    imager, found = jax.jit(FieldImager(setup.points, setup.restore).__call__), {}
    for arm in arms:
        images = _training.images(imager, trained[arm, 0], scene, seen, setup.noise, 0)
        found |= {f"photograph {arm} {name}": image[0] for name, image in images.items()}
    return {"photographs": arms, "measure": [means[arm] for arm in arms], **found}


def _built_lenses(setup: Setup) -> np.ndarray:
    """Deviations of the lenses as built that are used in the evaluation."""
    return design.draw_perturbations(setup.built, setup.config.judge.builds, SEED + 1)


def _as_built(setup: Setup, run: Run, trained: Trained, others: np.ndarray | None) -> list[dict]:
    """PSNR of lenses as built, for arms that start from a lens of least squares, by rays at the
    points of the evaluation; with the prefix `others_` for other photographs."""
    imager = jax.jit(FieldImager(setup.points, setup.restore).__call__)
    rows = []
    for (arm, seed), parameters in trained.items():
        if ARMS[arm].begins in ("spots", "built") and not ARMS[arm].frozen:
            job, row = f"built {arm} {seed}", {"arm": arm, "seed": seed}
            for prefix, patches in (("", setup.patches.test), ("others_", others)):
                if patches is not None:
                    judge = partial(_decibels, setup, imager, parameters, patches, prefix + job)
                    found = run.once(prefix + job, judge)
                    row |= {prefix + key: value for key, value in found.items()}
            rows.append(row)
    return rows


def _decibels(
    setup: Setup, imager: Callable, parameters: Any, patches: np.ndarray, job: str
) -> dict[str, Any]:
    """PSNR of the lens as designed; and of lenses as built: each, mean and 10th percentile."""
    table = _built_lenses(setup)
    patches = _training.thinned(patches, len(setup.judged.fields))
    patches, found = _one_each(setup, patches), []
    noise, key = np.float32(setup.noise), jax.random.key(0)
    for deviations in (np.zeros(table.shape[1]), *tqdm(table, desc=job, leave=False)):
        view = setup.judged._replace(deviations=jnp.asarray(deviations))
        truth, _, image = imager(parameters, patches, view, noise, key)
        squares = np.mean(np.square(np.asarray(image - truth)), axis=(1, 2, 3))
        found.append(float(np.mean(-10 * np.log10(squares))))
    each = np.round(found[1:], 3)
    built = {"mean": float(np.mean(each)), "low": float(np.percentile(each, 10))}
    return {"designed": found[0]} | built | {"each": each.tolist()}
