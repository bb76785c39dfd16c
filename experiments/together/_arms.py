"""The arms of a joint design: least squares, training, and the judge."""

import math
import time
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from tqdm import tqdm

import drt_jax
from drt_jax import design
from drt_jax.devices import copied, gathered, split
from drt_jax.learn import train
from drt_jax.learn.data import batches
from drt_jax.learn.field import FieldImager, ObjectPoints

from . import _patches, _training
from ._studio import SEED, Studio
from .runs.folder import Run

Arm = Literal["focus", "spots", "mtf", "joint", "joint_from_spots", "damped", "frozen", "tolerant"]
ARMS = {
    "focus": "(a) focus and network",
    "spots": "(b) least squares on spots, then network",
    "mtf": "(c) least squares on MTF, then network",
    "joint": "(d) jointly from the spoilt lens",
    "joint_from_spots": "(e) jointly from (b)",
    "frozen": "(f) lens of (b) through its frozen network",
    "damped": "(d) with least-squares steps of the lens",
    "tolerant": "(e) with lenses as built",
}
# Arms that begin with the finished lens, of which lenses as built are judged.
_BUILT = "spots", "joint_from_spots", "tolerant"
# Steps between those of two seeds, which points and noise depend on.
_APART = 10**7
# Patches of a picture.
_SHOWN = 5


def run(config: Any, run: Run) -> dict[str, Any]:
    """Finishes the lenses, trains and judges all arms."""
    side = config.train.patch + config.camera.kernel - 1
    studio = Studio(config, _patches.read_patches(config.data, side, 0, run.folder))
    lenses = {"spoilt": studio.spoilt} | _finished(studio, run)
    folder = run.folder / "lenses"
    folder.mkdir(exist_ok=True)
    imager = jax.jit(FieldImager(studio.judged_points, studio.restore).__call__)
    rows, losses, shown, drawn = [], [], {}, ["spoilt"]
    _save(studio, folder / "spoilt.yaml", studio.spoilt)
    trained: dict[tuple[str, int], Any] = {}
    arms = [arm for arm in ARMS if arm in config.arms]  # `frozen` after `spots`
    for arm in arms:
        own = []
        for seed in range(config.seeds):
            job = f"{arm} {seed}"
            weights = trained["spots", seed]["network"] if arm == "frozen" else None
            begin = studio.start(arm, seed, lenses, weights)
            parameters, seconds = _train(studio, run, arm, seed, begin)
            trained[arm, seed] = parameters
            own.append(run.metrics(job)["loss"])
            vector = parameters["optics"]["lens"]
            _save(studio, folder / f"{job}.yaml", vector)
            if run.kept(f"judged {job}") is None:
                row = {"arm": arm, "seed": seed, "step_s": seconds}
                row |= {"spot_um": studio.spot_um(vector)}
                run.keep(f"judged {job}", row | _judged(studio, imager, parameters))
            rows.append(run.kept(f"judged {job}"))
            if not seed:
                drawn.append(job)
                shown |= _pictures(studio, imager, parameters, arm)
        losses.append(np.mean(own, axis=0).tolist())
    far, degrees = studio.depths[1], np.degrees(np.hypot(*np.asarray(studio.judged().fields).T))
    return {
        "name": config.name,
        "rows": rows,
        "arms": arms,
        "losses": losses,
        "start_um": {name: studio.spot_um(vector) for name, vector in lenses.items()},
        "builds": _as_built(studio, run, trained) if config.judge.builds else [],
        "drawn": drawn,
        "pictures": arms,
        "pictures_deg": degrees[_shown(len(degrees))].tolist(),
        "field_deg": config.field_deg,
        "far_mm": far if math.isfinite(far) else None,
        **shown,
    }


def _finished(studio: Studio, run: Run) -> dict[str, Array]:
    """The vectors of the lens that least squares has finished, on spots and then on MTF."""
    found, vector = {}, studio.spoilt
    for name, problem in (("spots", studio.spots), ("mtf", studio.sharp)):
        if name == "mtf" and "mtf" not in studio.config.arms:
            continue
        if run.kept(f"finish {name}") is None:
            print(f"least squares: {name}", flush=True)
            best = design.optimise(problem, vector)
            run.keep(f"finish {name}", best.vector.tolist())
        found[name] = vector = jnp.asarray(run.kept(f"finish {name}"))
    return found


def _train(
    studio: Studio, run: Run, arm: str, seed: int, begin: dict[str, Any]
) -> tuple[dict[str, Any], float]:
    """Trained parameters of a job, from its last checkpoint or from `begin` on, and the seconds of
    a step."""
    setting, noise, job = studio.config.train, studio.config.noise, f"{arm} {seed}"
    total = setting.batches
    if arm == "damped":
        total = max(1, round(setting.damped_part * total))
    init, same = studio.step(arm)
    # Points and noise of their own for each seed, by one program.
    step = lambda *given: same(*given[:3], np.int32(given[3] + _APART * seed))  # noqa: E731
    first, state = run.load(job, init(begin), (job,), total)
    saved, started, counted = first, time.perf_counter(), [0, 0.0]
    bar = tqdm(total=total, initial=first, desc=job, unit="batch", dynamic_ncols=True)

    def report(start: int, metrics: dict[str, np.ndarray], state: Any) -> None:
        nonlocal saved, started
        done = start + len(metrics["loss"])
        run.log(job, start, metrics)
        _training.require_finite(job, start, metrics["loss"])
        bar.update(len(metrics["loss"]))
        bar.set_postfix_str(f"loss={metrics['loss'][-1]:.4f}")
        if done == total or done - saved >= setting.checkpoint_every:
            run.save(job, done, state)
            saved = done
        now = time.perf_counter()
        if start > first:  # the first report contains compilation
            counted[0] += len(metrics["loss"])
            counted[1] += now - started
        started = now

    patches = batches(studio.patches.train, setting.batch, seed, first)
    stream = (split(studio.mesh, scenes) for scenes in patches)
    with bar:
        state = copied(studio.mesh, state)
        state = train.fit(step, state, stream, noise, range(first, total), 10, report)
    return jax.tree.map(jnp.asarray, gathered(state[0])), counted[1] / max(counted[0], 1)


def _save(studio: Studio, path: Any, vector: Array) -> None:
    """Writes a lens with apertures that follow the light."""
    lens = studio.variables.lens_of(vector)
    drt_jax.save_lens(design.fit_apertures(studio.spots, lens), path)


def _test(studio: Studio, seen: ObjectPoints, each: int) -> np.ndarray:
    return _patches.thinned(studio.patches.test, each * len(seen.fields))


def _judged(studio: Studio, imager: Callable, parameters: Any) -> dict[str, float]:
    """Quality of the images of an arm, by the judge."""
    seen, config = studio.judged(), studio.config
    patches = _test(studio, seen, config.judge.patches)
    return train.evaluate(imager, parameters, patches, seen, config.noise, 0, len(seen.fields))


def _pictures(studio: Studio, imager: Callable, parameters: Any, arm: str) -> dict[str, Any]:
    """Some images of the judge, evenly over its points."""
    seen = studio.judged()
    some = np.resize(
        _patches.textured(studio.patches.test, len(seen.fields)),
        (len(seen.fields), *studio.patches.test.shape[1:]),
    )
    found = _patches.images(imager, parameters, some, seen, studio.config.noise, 0)
    return {f"{arm} {name}": a[_shown(len(seen.fields))] for name, a in found.items()}


def _shown(count: int) -> np.ndarray:
    """Numbers of the points of a picture."""
    return np.unique(np.linspace(0, count - 1, _SHOWN).astype(int))


def _as_built(studio: Studio, run: Run, trained: dict[tuple[str, int], Any]) -> list[dict]:
    """PSNR of lenses as built, by rays at the points of the judge."""
    imager = jax.jit(FieldImager(studio.points, studio.restore).__call__)
    rows = []
    for (arm, seed), parameters in trained.items():
        if arm not in _BUILT:
            continue
        job = f"built {arm} {seed}"
        if run.kept(job) is None:
            first, *others = _decibels(studio, imager, parameters, job)
            row = {"arm": arm, "seed": seed, "designed": first, "mean": float(np.mean(others))}
            run.keep(job, row | {"low": float(np.percentile(others, 10))})
        rows.append(run.kept(job))
    return rows


def _decibels(studio: Studio, imager: Callable, parameters: Any, job: str) -> list[float]:
    """PSNR of the lens as designed, then of each lens as built."""
    count, seen, found = studio.config.judge.builds, studio.judged(), []
    table = design.draw_perturbations(studio.built, count, SEED + 1)
    patches = _test(studio, seen, 1)
    patches = np.resize(patches, (len(seen.fields), *patches.shape[1:]))
    noise, key = np.float32(studio.config.noise), jax.random.key(0)
    for deviations in (np.zeros(table.shape[1]), *tqdm(table, desc=job, leave=False)):
        view = seen._replace(deviations=jnp.asarray(deviations))
        truth, _, image = imager(parameters, patches, view, noise, key)
        squares = np.mean(np.square(np.asarray(image - truth)), axis=(1, 2, 3))
        found.append(float(np.mean(-10 * np.log10(squares))))
    return found
