"""Figures of a design from its lens files: before and after, spots, merit, minima."""

import math
import pathlib
from typing import Any

import numpy as np

import drt_jax
from drt_jax import Scene, show
from drt_jax.pupil import hexapolar
from drt_jax.show import layout

from . import _common, _plots

# Most ranked minima; rings of rays of a drawn spot.
_RANKED, _RINGS = 30, 8


def _drawing(results: dict[str, Any], path: pathlib.Path) -> layout.Drawing:
    """The drawing of a lens file."""
    waves, fields = results["wavelengths_um"], np.radians(results["fields_deg"])
    distance = results["distance_mm"] or math.inf
    return layout.draw(
        drt_jax.load_lens(path), Scene.radians(fields, distance, waves[len(waves) // 2])
    )


def _spots(results: dict[str, Any], lens: drt_jax.Lens) -> list[tuple[list, np.ndarray]]:
    """For each field, the hits of each wavelength about the centroid of all, um, and their
    covariance, um^2."""
    pupil = hexapolar(_RINGS)[0]
    found = []
    for field in np.radians(results["fields_deg"]):
        distance = results["distance_mm"] or math.inf
        scene = Scene.point(field, distance, results["wavelengths_um"])
        rays = drt_jax.trace_rays(lens, scene, pupil)
        moments = drt_jax.psf_moments(lens, scene, results["tolerance"])
        mean = np.asarray(moments.mean).mean(axis=0)
        hits = 1e3 * (np.asarray(rays.points)[:, :, -1, :2] - mean)
        arrives = np.asarray(rays.status) == 0
        every = hits[arrives]
        own = [h[a] for h, a in zip(hits, arrives)]
        found.append((own, every.T @ every / max(len(every), 1)))
    return found


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the lens before and after, its spots, the merit, and the minima."""
    folder = figures.parent
    drawings = [_drawing(results, folder / f"{name}.yaml") for name in ("start", "designed")]
    figure, axes = show.new(2, 1, 8, 3.2)
    for ax, drawing, title in zip(axes, drawings, ("start", "designed")):
        show.lens_drawing(ax, drawing).set_title(title, fontsize=9)
    figure.savefig(figures / "lens.png")
    fields, waves = results["fields_deg"], results["wavelengths_um"]
    figure, axes = show.new(1, len(fields), 3.2, 3.4)
    spots = _spots(results, drt_jax.load_lens(folder / "designed.yaml"))
    side = 2.1 * max(float(np.max(np.abs(h), initial=1e-3)) for own, _ in spots for h in own)
    for ax, (own, covariance), field in zip(np.ravel(axes), spots, fields):
        named = {f"{wave:.3f} um": h for wave, h in zip(waves, own)}
        _plots.spots(ax, named, covariance, side, f"{field:g} deg")
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
        count = sum(1 for _ in folder.glob("minimum_*.yaml"))
        others = [_drawing(results, folder / f"minimum_{k + 1}.yaml") for k in range(count)]
        _draw_minima(results, [drawings[1], *others], figures)


def _draw_minima(
    results: dict[str, Any], drawings: list[layout.Drawing], figures: pathlib.Path
) -> None:
    starts = results["starts"]
    sizes = [1e3 * math.sqrt(merit) for merit in starts["merits"][:_RANKED]]
    figure, ax = show.new(1, 1, 7, 3.6)
    _plots.ranks(ax, sizes, starts["found"][:_RANKED])
    figure.savefig(figures / "minima.png")
    figure, axes = _common.panels(len(drawings), 6, 2.6)
    for ax, drawing, size in zip(np.ravel(axes), drawings, sizes):
        show.lens_drawing(ax, drawing).set_title(f"{size:.3f} um", fontsize=9)
    figure.savefig(figures / "minima_drawn.png")
