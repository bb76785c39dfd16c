"""What is drawn of a design: before and after, spots, merit, minima; and the numbers for it."""

import math
import pathlib
from typing import Any

import jax
import numpy as np

import drt_jax
from drt_jax import show
from drt_jax.pupil import hexapolar
from drt_jax.show import layout

from . import _common, _plots

# Minima that are ranked; rings of the rays of a spot that is drawn.
_RANKED, _RINGS = 30, 8


def polylines(config: Any, lens: drt_jax.Lens) -> dict[str, Any]:
    """The polylines of a lens as lists."""
    middle = config.wavelengths_um[len(config.wavelengths_um) // 2]
    drawing = layout.draw(lens, np.radians(config.fields_deg), config.distance_mm, middle)
    return jax.tree.map(lambda a: np.round(a, 4).tolist(), drawing._asdict())


def spot_hits(config: Any, lens: drt_jax.Lens) -> list[dict[str, Any]]:
    """By field: hits in um about the centroid of all colours, by colour, and the covariance."""
    pupil = np.asarray(hexapolar(_RINGS)[0]).T
    found = []
    for field in np.radians(config.fields_deg):
        scene = field, config.distance_mm, config.wavelengths_um
        rays = drt_jax.trace_rays(lens, *scene, pupil)
        mean = np.asarray(drt_jax.psf_moments(lens, *scene, config.tolerance).mean).mean(axis=0)
        hits = 1e3 * (np.asarray(rays.points)[:, :, -1, :2] - mean)
        good = np.asarray(rays.status) == 0
        every = hits[good]
        found.append(
            {
                "hits": [np.round(h[g], 4).tolist() for h, g in zip(hits, good)],
                "covariance": (every.T @ every / max(len(every), 1)).tolist(),
            }
        )
    return found


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draw the lens before and after, its spots, the merit, and the minima."""
    drawings = [_drawing(parts) for parts in results["drawings"]]
    figure, axes = show.new(2, 1, 8, 3.2)
    for ax, drawing, title in zip(axes, drawings, ("start", "designed")):
        show.lens_drawing(ax, drawing).set_title(title, fontsize=9)
    figure.savefig(figures / "lens.png")
    fields, colours = results["fields_deg"], results["wavelengths_um"]
    figure, axes = show.new(1, len(fields), 3.2, 3.4)
    hits = [[np.reshape(h, (-1, 2)) for h in spot["hits"]] for spot in results["spots"]]
    side = 2.1 * max(float(np.max(np.abs(h), initial=1e-3)) for own in hits for h in own)
    for ax, own, spot, field in zip(np.ravel(axes), hits, results["spots"], fields):
        named = {f"{colour:.3f} um": h for colour, h in zip(colours, own)}
        _plots.spots(ax, named, np.array(spot["covariance"]), side, f"{field:g} deg")
    np.ravel(axes)[0].legend(fontsize=7, loc="upper left")
    np.ravel(axes)[0].set(xlabel="um", ylabel="um")
    figure.savefig(figures / "spots.png")
    figure, ax = show.new(1, 1, 6, 3.6)
    if results["starts"]["merits"]:
        _plots.searching(ax, np.array(results["starts"]["best"]))
    else:
        _plots.merits(ax, np.array(results["history"]))
    figure.savefig(figures / "merit.png")
    if results["starts"]["merits"]:
        _draw_minima(results, drawings[1:], figures)


def _drawing(parts: dict[str, Any]) -> layout.Drawing:
    lines = {
        name: [np.reshape(line, (-1, 2)) for line in some]
        for name, some in parts.items()
        if name not in ("sensor", "rays", "fields")
    }
    rays = [[np.reshape(ray, (-1, 2)) for ray in fan] for fan in parts["rays"]]
    fields = parts.get("fields", ())  # older results have none
    return layout.Drawing(**lines, sensor=np.array(parts["sensor"]), rays=rays, fields=fields)


def _draw_minima(
    results: dict[str, Any], drawings: list[layout.Drawing], figures: pathlib.Path
) -> None:
    some = results["starts"]
    sizes = [1e3 * math.sqrt(merit) for merit in some["merits"][:_RANKED]]
    figure, ax = show.new(1, 1, 7, 3.6)
    _plots.ranks(ax, sizes, some["found"][:_RANKED])
    figure.savefig(figures / "minima.png")
    figure, axes = _common.panels(len(drawings), 6, 2.6)
    for ax, drawing, size in zip(np.ravel(axes), drawings, sizes):
        show.lens_drawing(ax, drawing).set_title(f"{size:.3f} um", fontsize=9)
    figure.savefig(figures / "minima_drawn.png")
