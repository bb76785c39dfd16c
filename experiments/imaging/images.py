"""The image of a point by each model: run time, error and picture.

Kernels by rays and by waves with increasing numbers of cells, and Gaussian kernels, are computed
for each lens and field. `error` is the difference from the limit of the model: a histogram of very
many rays, or waves with very many cells. `off` is the difference from the limit of waves. Both are
sums of absolute differences over all pixels, for the worst wavelength. Optiland's FFT PSF and
prysm's matrix Fourier transform are compared with the limit of waves at the middle wavelength;
prysm traces no rays and gets our pupil function.

Writes results.json: `kernels` have `lens`, `model`, `cells`, `value_s`, `gradient_s` (of a weighted
sum of the kernel, by every number of the lens), `error`, `off`; `peers`; `views`: the light outside
of the kernel, the noise of the histogram, the rays that arrive, seconds of 9 x 9 fields, MTF and
its limit; `photographs`, in figures.
"""

import dataclasses
import math
import pathlib
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from PIL import Image
from skimage import data, transform

import drt_jax
from drt_jax import Lens, Sampling, Scene, show
from drt_jax.compilation import LARGE, known_options
from drt_jax.image.psf import difference

from . import _command, _common, _plots, _psf_peers, _work, render
from ._common import Colours, not_empty, odd, within
from ._psf_peers import Shot
from .runs.folder import Run

MODELS = "gaussian", "rays", "waves"
# Number of rays traced at a time for a histogram.
_ROUND = 2**17


@dataclasses.dataclass(frozen=True)
class Photo:
    """A lens that takes the photograph, and the side of its pixels."""

    lens: str
    pixel_um: Annotated[float, within(0.05, 1e4)]


@dataclasses.dataclass(frozen=True)
class View(Photo):
    """A lens, its pixels, and a field angle along y."""

    field_deg: Annotated[float, within(0, 89.9)]


@dataclasses.dataclass(frozen=True)
class Gallery:
    """Object points whose kernels are drawn."""

    lens: str = "double_gauss"
    fields_deg: tuple[float, ...] = (0.0, 7.0, 14.0)
    distances_m: tuple[float, ...] = (10.0, 25.0, math.inf)
    pixel_um: float = 4.4


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/images.yaml.

    views: lenses and object points.
    photographs: lenses that take the photograph.
    size: side of a kernel, pixels.
    rays, waves: cells per side of the models' grids.
    limit: cells per side for the limit of waves.
    rounds: number of rounds of 2^17 rays per wavelength for the histogram.
    peers: samples per side of the peers' pupils.
    frequencies: number of frequencies of the MTF, up to the pixels' Nyquist frequency.
    photo_pixels: side of the photograph.
    """

    views: Annotated[tuple[View, ...], not_empty]
    photographs: tuple[Photo, ...]
    gallery: Gallery = dataclasses.field(default_factory=Gallery)
    wavelengths_um: Annotated[Colours, within(1e-2, 1e3)] = (0.6, 0.53, 0.48)
    size: Annotated[int, within(3, 255), odd] = 21
    rays: Annotated[tuple[int, ...], within(8, 1024)] = (24, 36, 52, 72, 104)
    waves: Annotated[tuple[int, ...], within(8, 1024)] = (48, 64, 96, 128, 192, 256)
    limit: Annotated[int, within(8, 2048)] = 640
    rounds: Annotated[int, within(2, 1024)] = 16
    peers: Annotated[tuple[int, ...], within(16, 2048)] = (64, 128, 256, 512)
    frequencies: Annotated[int, within(2, 1e4)] = 41
    photo_pixels: Annotated[int, within(16, 4096)] = 512
    repeats: Annotated[int, within(1, 1000)] = 15


def histogram(shot: Shot, rounds: int, centre: np.ndarray) -> tuple[np.ndarray, float, int]:
    """Histogram (W, size, size) of traced rays on pixels about `centre` (2,), mm; its noise, from
    its two halves; and the smallest number, over the wavelengths, of rays that arrive."""
    edges = (np.arange(shot.size + 1) - shot.size / 2) * shot.pixel
    points = drt_jax.pupil.random_disc(_ROUND * rounds, 0)[0]
    halves = np.zeros((2, len(shot.waves), shot.size, shot.size))
    arrived = np.zeros((2, len(shot.waves)))
    for k in range(rounds):
        rays = drt_jax.trace_rays(shot.lens, shot.scene, points[k * _ROUND : (k + 1) * _ROUND])
        arrives = np.asarray(rays.status) == drt_jax.Status.OK
        hits = np.asarray(rays.points[:, :, -1, :2]) - centre
        for w, (ok, (x, y)) in enumerate(zip(arrives, np.moveaxis(hits, -1, 1))):
            halves[k % 2, w] += np.histogram2d(y[ok], x[ok], (edges, edges))[0]
        arrived[k % 2] += arrives.sum(axis=1)
    whole = halves.sum(axis=0) / arrived.sum(axis=0)[:, None, None]
    pair = (h / n[:, None, None] for h, n in zip(halves, arrived))
    noise = difference(*pair) / 2 if rounds > 1 else 2
    return whole, noise, int(arrived.sum(axis=0).min())


def measure(config: Config, view: View) -> dict[str, Any]:
    """Time and error of every model, and of the peers, at one view."""
    lens = drt_jax.load_lens(view.lens)
    field, pixel = math.radians(view.field_deg), 1e-3 * view.pixel_um
    shot = Shot(lens, field, np.array(config.wavelengths_um), pixel, config.size)
    rule = shot.model("waves", 1e-3).rule
    limit = Sampling("waves", rule, config.limit)
    finest = drt_jax.psf(lens, shot.scene, pixel, config.size, sampling=limit)
    collected, noise, arrived = histogram(shot, config.rounds, np.asarray(finest.centre))
    limits = {"rays": collected, "waves": np.asarray(finest.kernel)}
    cells = {"gaussian": (0,), "rays": config.rays, "waves": config.waves}
    name = {"lens": view.lens, "field_deg": view.field_deg}
    rows = []
    for model in (Sampling(kind, rule, n) for kind in MODELS for n in cells[kind]):
        kernel, *seconds = _timed(shot, model, config.repeats)
        own = limits.get(model.kind)
        row = {"model": model.kind, "cells": model.cells, "value_s": seconds[0]}
        row |= {"gradient_s": seconds[1], "off": difference(kernel, limits["waves"])}
        rows.append(name | row | {"error": None if own is None else difference(kernel, own)})
    about = {"outside": float(np.max(finest.outside)), "noise": noise, "rays": arrived}
    about |= {"rays_off": difference(*limits.values())}
    lines, curves = contrast(config, lens, field, pixel)
    about |= {"grid_s": field_grid(shot, config.repeats), "frequencies": lines}
    about |= {"transfer": curves}
    return {"rows": rows, "view": name | about, "peers": _peer_rows(config, shot, rule, name)}


def _timed(shot: Shot, model: Sampling, repeats: int) -> tuple[np.ndarray, float, float]:
    """A kernel, and the seconds for it alone and for the gradient of a weighted sum of it."""
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(shot.size, shot.size)))

    def mean(lens: Lens) -> jax.Array:
        return jnp.sum(weights[None] * shot.kernel(lens, model))

    options = known_options(LARGE)  # the options that psf uses
    functions = partial(shot.kernel, model=model), jax.value_and_grad(mean)
    programs = (jax.jit(function, compiler_options=options) for function in functions)
    value, gradient = (_work.compiled(program, shot.lens)[0] for program in programs)
    return np.asarray(value()), *_common.medians([value, gradient], repeats)


def field_grid(shot: Shot, repeats: int) -> float:
    """Seconds for wave kernels of 9 x 9 fields, with the field of the view in the corners."""
    side = math.atan(math.tan(max(shot.field, 1e-3)) / math.sqrt(2))
    scene = Scene.grid([[side, side]], math.inf, shot.waves)
    given = shot.lens, scene, shot.pixel, shot.size, 4, "waves", 1e-2
    method = drt_jax.converge(drt_jax.kernel_grid, *given)
    call = partial(drt_jax.kernel_grid, shot.lens, shot.waves, method)
    return _common.medians([call], repeats)[0]


def contrast(config: Config, lens: Lens, field: float, pixel: float) -> tuple[list, list]:
    """Frequencies up to that of Nyquist; and the MTF by waves, by rays, and its diffraction limit,
    (3, 2, N)."""
    lines = np.linspace(0, 0.5 / pixel, config.frequencies)
    scene = Scene.point(field, wavelengths=np.array(config.wavelengths_um))
    by_waves, by_rays = (drt_jax.transfer(lens, scene, lines, model) for model in ("waves", "rays"))
    curves = np.stack([by_waves.mtf, by_rays.mtf, by_waves.limit])
    return lines.tolist(), curves.tolist()


def _peer_rows(config: Config, shot: Shot, rule: Any, name: dict[str, Any]) -> list[dict]:
    """Rows of other programs, at the middle wavelength."""
    one = dataclasses.replace(shot, waves=shot.waves[[len(shot.waves) // 2]])
    chief = np.ravel(drt_jax.image_point(one.lens, one.scene))
    limit = Sampling("waves", rule, config.limit)

    def optiland(count: int) -> tuple[Callable, Any]:
        return _psf_peers.optiland(one, count), one.kernel(one.lens, limit, chief)[0]

    def prysm(count: int) -> tuple[Callable, Any]:
        *given, centre = _psf_peers.pupil(one, rule, count)
        return _psf_peers.prysm(one, *given), one.kernel(one.lens, limit, centre)[0]

    rows = []
    for program, make in (("optiland", optiland), ("prysm", prysm)):
        for count in config.peers:
            row = name | {"program": program, "samples": count, "note": ""}
            try:
                call, truth = make(count)
                error, seconds = difference(call(), truth), _common.medians([call], 3)[0]
                rows.append(row | {"seconds": seconds, "error": error})
            except (ImportError, ValueError) as failure:
                rows.append(row | {"seconds": None, "error": None, "note": str(failure)[:80]})
                break
    return rows


def gallery(config: Config) -> np.ndarray:
    """Kernels (distances, fields, models, W, size, size) of the gallery."""
    points = config.gallery
    lens, waves = drt_jax.load_lens(points.lens), np.array(config.wavelengths_um)
    pixels = 1e-3 * points.pixel_um, config.size
    distances = [1e3 * d for d in points.distances_m]
    scene = Scene.grid(np.radians(points.fields_deg), distances, waves)
    models = [drt_jax.converge(drt_jax.psf, lens, scene, *pixels, kind) for kind in MODELS]
    found = [drt_jax.psf(lens, scene, *pixels, sampling=model) for model in models]
    return np.stack([np.asarray(one.kernel, np.float32) for one in found], axis=2)


def photograph(config: Config, view: Photo, figures: pathlib.Path) -> dict[str, Any]:
    """Renders the photograph by a lens, writes it into figures, and returns its row."""
    count = config.photo_pixels
    picture = transform.resize(data.astronaut(), (count, count), anti_aliasing=True)
    pixels = np.round(255 * picture).astype(np.uint8)
    lens, waves = drt_jax.load_lens(view.lens), np.array(config.wavelengths_um)
    ideal = render.linear(pixels)
    seen = math.inf, 1e-3 * view.pixel_um, waves
    method = drt_jax.converge(drt_jax.render, lens, ideal.shape[:2], *seen)
    call = partial(drt_jax.render, lens, ideal, *seen, method)
    start = time.perf_counter()
    image = np.asarray(call())
    first = time.perf_counter() - start
    figures.mkdir(exist_ok=True)
    Image.fromarray(pixels).save(figures / "ideal.png")
    Image.fromarray(render.encoded(image)).save(figures / f"photo_{view.lens}.png")
    seconds = _common.medians([call], 3)[0]
    name = {"lens": view.lens, "pixel_um": view.pixel_um}
    return name | {"first_s": first, "seconds": seconds, "kernel": method.grid.size}


def run(config: Config, run: Run) -> dict[str, Any]:
    """Measures the views, then renders the photographs."""
    jobs = {f"{v.lens} {v.field_deg:g}": partial(measure, config, v) for v in config.views}
    taken = {f"photo {v.lens}": v for v in config.photographs}
    jobs |= {name: partial(photograph, config, v, run.figures) for name, v in taken.items()}
    found = _common.measured(run, "part", jobs)
    views, photographs = found[: len(config.views)], found[len(config.views) :]
    settings = dataclasses.asdict(config.gallery)
    return {
        "kernels": sum((each["rows"] for each in views), []),
        "peers": sum((each["peers"] for each in views), []),
        "views": [each["view"] for each in views],
        "photographs": photographs,
        "wavelengths_um": list(config.wavelengths_um),
        "gallery": settings | {"distances_m": [str(d) for d in config.gallery.distances_m]},
        "gallery_kernels": gallery(config),
        "seconds": run.seconds,
    }


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Tables of the models, the peers, the views and the photographs."""

    def short(error: float | None) -> str:
        return "" if error is None else f"{error:.1e}"

    def place(row: dict[str, Any]) -> str:
        return f"{row['lens']} {row['field_deg']:g}"

    time_of = _common.duration
    lines = [
        (place(r), r["model"], r["cells"] or None, time_of(r["value_s"]), time_of(r["gradient_s"]))
        + (short(r["error"]), short(r["off"]))
        for r in results["kernels"]
    ]
    header = ("lens, degrees", "model", "cells", "kernel", "and gradient")
    header += ("error", "off the waves")
    others = [
        (place(r), r["program"], r["samples"], time_of(r["seconds"]), short(r["error"]), r["note"])
        for r in results["peers"]
    ]
    views = [
        (place(v), short(v["outside"]), v["rays"], short(v["noise"]), short(v["rays_off"]))
        + (time_of(v["grid_s"]),)
        for v in results["views"]
    ]
    columns = ("lens, degrees", "outside", "rays of the histogram", "its noise")
    columns += ("rays off the waves", "9 x 9 fields")
    photos = [
        (p["lens"], p["pixel_um"], p["kernel"], time_of(p["first_s"]), time_of(p["seconds"]))
        for p in results["photographs"]
    ]
    names = ("lens", "pixel, um", "kernel", "first", "next")
    programs = ("lens, degrees", "program", "samples", "time, one colour", "error", "")
    return {
        "images": _common.table(header, lines),
        "images, other programs": _common.table(programs, others),
        "images, views": _common.table(columns, views),
        "images, photographs": _common.table(names, photos),
    }


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the gallery, error over time, transfer functions and the photographs."""
    _draw_gallery(results, figures / "gallery.png")
    views = results["views"]
    count = len(views)
    with _plots.picture(figures / "models.png", 4.2, 3.4, 2 * count, count) as axes:
        for view, above, below in zip(views, axes[:count], axes[count:]):
            series = {}
            for key, by, cost in (("kernels", "model", "value_s"), ("peers", "program", "seconds")):
                rows = [r for r in results[key] if r["lens"] == view["lens"] and r["error"]]
                for (name, *_), own in _common.grouped(rows, by).items():
                    series[name] = [r[cost] for r in own], [[r["error"]] for r in own]
            _plots.error_curves(above, series, "seconds", "error of the kernel (L1)")
            above.set_title(f"{view['lens']}, {view['field_deg']:g} degrees", fontsize=9)
            by_waves, by_rays, limit = np.asarray(view["transfer"])
            show.mtf(below, view["frequencies"], [by_waves, by_rays], limit[0], ("waves", "rays"))
    photos = {"ideal": "ideal"} | {f"photo_{p['lens']}": p["lens"] for p in results["photographs"]}
    _plots.photographs(figures / "photographs.png", figures, photos, (3.6, 4.1))


def _draw_gallery(results: dict[str, Any], path: pathlib.Path) -> None:
    """Draws kernels, with a row for each field and columns for the distances, each with three
    models."""
    kernels, points = results["gallery_kernels"], results["gallery"]
    distances, fields, models = kernels.shape[:3]
    across = distances * models
    with _plots.picture(path, 1.3, 1.45, fields * across, across) as axes:
        for ax, (row, far, model) in zip(axes, np.ndindex(fields, distances, models)):
            picture = np.moveaxis(kernels[far, row, model], 0, -1)
            ax.imshow(np.sqrt(np.clip(picture / picture.max(), 0, 1)), origin="lower")
            ax.set(xticks=[], yticks=[])
            if row == 0:
                ax.set_title(f"{MODELS[model]}\n{points['distances_m'][far]} m", fontsize=7)
            if far == model == 0:
                ax.set_ylabel(f"{points['fields_deg'][row]:g} degrees", fontsize=7)


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
