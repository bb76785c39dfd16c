"""Pictures of `experiments.images`."""

import pathlib
from typing import Any

import numpy as np
from PIL import Image

from drt_jax import show

from . import _common
from ._plots import error_curves

MODELS = "gaussian", "rays", "waves"


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the gallery, error over time, transfer functions and the photographs."""
    _draw_gallery(results, figures / "gallery.png")
    views = results["views"]
    figure, axes = show.new(2, len(views), 4.2, 3.4)
    for view, (above, below) in zip(views, np.reshape(axes, (2, -1)).T):
        series = {}
        for table, by, cost in (("kernels", "model", "value_s"), ("peers", "program", "seconds")):
            rows = [r for r in results[table] if r["lens"] == view["lens"] and r["error"]]
            for (name, *_), own in _common.grouped(rows, by).items():
                series[name] = [r[cost] for r in own], [[r["error"]] for r in own]
        error_curves(above, series, "seconds", "error of the kernel (L1)")
        above.set_title(f"{view['lens']}, {view['field_deg']:g} degrees", fontsize=9)
        by_waves, by_rays, limit = np.asarray(view["transfer"])
        lines = view["frequencies"]
        show.mtf(below, lines, [by_waves, by_rays], limit[0], ("waves", "rays"))
    figure.savefig(figures / "models.png")
    photos = [("ideal", "ideal")] + [
        (f"photo_{p['lens']}", p["lens"]) for p in results["photographs"]
    ]
    figure, axes = show.new(1, len(photos), 3.6, 4.1)
    for ax, (name, title) in zip(np.ravel(axes), photos):
        ax.imshow(np.asarray(Image.open(figures / f"{name}.png")), interpolation="antialiased")
        ax.set(xticks=[], yticks=[], title=title)
    figure.savefig(figures / "photographs.png")


def _draw_gallery(results: dict[str, Any], path: pathlib.Path) -> None:
    """Draws fields down and distances across, with the three models of each."""
    kernels, what = results["gallery_kernels"], results["gallery"]
    count, fields, models = kernels.shape[:3]
    figure, axes = show.new(fields, count * models, 1.3, 1.45)
    for row, ax in zip(range(fields), np.reshape(axes, (fields, -1))):
        for k, one in enumerate(ax):
            far, model = divmod(k, models)
            picture = np.moveaxis(kernels[far, row, model], 0, -1)
            one.imshow(np.sqrt(np.clip(picture / picture.max(), 0, 1)), origin="lower")
            one.set(xticks=[], yticks=[])
            if row == 0:
                away = what["distances_m"][far]
                one.set_title(f"{MODELS[model]}\n{away} m", fontsize=7)
        ax[0].set_ylabel(f"{what['fields_deg'][row]:g} degrees", fontsize=7)
    figure.savefig(path)
