"""All analyses of a lens on one sheet."""

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..compilation import ONCE, jit
from ..image.beam import beam_rule
from ..image.chief import distortion, field_curvature, lateral_colour
from ..image.encircled import encircled
from ..image.fans import RayFans, ray_fans
from ..image.spots import Spots, rule_for, spot_diagram
from ..image.refined import beams_of
from ..image.transfer import Model, transfer_of
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..pupil.rules import PupilRule
from . import analyses
from .figures import FIELD_COLOURS, new
from .layout import draw, lens_drawing

# Fields of a curve, fields of the illumination curve, points of a fan, fields with spots and fans.
_CURVE, _LIGHT, _FAN, _FIELDS = 31, 10, 33, 3
# Highest frequency of transfer functions, cycles/mm, unless the diffraction limit is lower.
_LINES = 200.0
# Order of the spot rule, degree of polynomials, cells for MTF, least and most cells for energy.
_ORDER, _DEGREE, _CELLS, _LEAST, _MOST = 8, 10, 64, 128, 384
_LOWER = slice(2, None)
# Analyses by the names of their axes: title, row and column on the sheet. Those without a column
# have axes for each field, side by side.
_PANELS: dict[str, tuple[str, Any, Any]] = {
    "layout": ("Layout", 0, slice(None)),
    "spots": ("Spots", 1, None),
    "tangential": ("Ray fans, tangential", 2, None),
    "sagittal": ("Ray fans, sagittal", 3, None),
    "mtf": ("Modulation transfer function", _LOWER, 4),
    "energy": ("Encircled energy", _LOWER, 5),
    "foci": ("Field curvature", 1, 3),
    "bent": ("Distortion", 1, 4),
    "colour": ("Lateral colour", 1, 5),
    "light": ("Illumination", _LOWER, 3),
}


def sheet(
    lens: Lens,
    scene: Scene | None = None,
    sampling: float | PupilRule | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> Figure:
    """One figure: layout; spots with the Airy circle, ray fans, transfer functions and encircled
    energy of three of the fields (the layout names those that are left out); field curvature,
    distortion, lateral colour and illumination up to the largest field. All wavelengths count the
    same. Blue to red are wavelengths; other colours are fields.

    scene: fields along y at one distance, and wavelengths, the middle one of which is the
        reference; by default the axis at infinity, in the d line.
    sampling: of the spots, for all fields, as in `spot_diagram`.
    say: called with the name of each step.
    """
    count, draw_on = _analysed(lens, scene, sampling, say)
    figure, first = new(width=14, height=10)
    first.remove()
    grid = figure.add_gridspec(4, 6, height_ratios=[1.5, 1, 0.8, 0.8])
    axes: dict[str, Any] = {}
    for name, (_, row, column) in _PANELS.items():
        places = range(count) if column is None else [column]
        own = [figure.add_subplot(grid[row, place]) for place in places]
        axes[name] = own if column is None else own[0]
    for each in figure.axes:
        each.tick_params(labelsize=6)
        each.xaxis.label.set_fontsize(7)
        each.yaxis.label.set_fontsize(7)
        each.locator_params(axis="x", nbins=6 if each is not axes["layout"] else 10)
    draw_on(axes)
    return figure


def panels(
    lens: Lens,
    scene: Scene | None = None,
    sampling: float | PupilRule | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> dict[str, Figure]:
    """What `sheet` shows, from the same arguments, as a figure for each analysis, by title."""
    count, draw_on = _analysed(lens, scene, sampling, say)
    figures: dict[str, Figure] = {}
    axes: dict[str, Any] = {}
    for name, (title, _, column) in _PANELS.items():
        size = (3.2, 3.2) if column is None else (8.0, 4.0) if name == "layout" else (5.0, 4.0)
        figures[title], own = new(1, count if column is None else 1, *size)
        axes[name] = [*np.ravel(own)] if column is None else own
    draw_on(axes)
    for name in ("bent", "colour"):  # on the sheet they stand beside the field curvature
        axes[name].set_ylabel("field (degrees)")
    return figures


def _analysed(
    lens: Lens, scene: Scene | None, sampling: float | PupilRule | None, say: Callable[[str], None]
) -> tuple[int, Callable[[dict[str, Any]], None]]:
    """The number of fields that have spots, and a function that draws all analyses on axes, which
    are named as in `_PANELS`."""
    scene = checked_scene(lens, Scene.point() if scene is None else scene)
    if scene.distance.ndim or bool(jnp.any(scene.field[..., 0] != 0)):
        raise ValueError("scene: a sheet has fields along y, at one distance")
    fields = [float(angle) for angle in np.ravel(scene.field[..., 1])]
    angles = sorted({*fields})
    some = [angles[k] for k in sorted({0, len(angles) // 2, len(angles) - 1})][:_FIELDS]
    waves, middle = np.asarray(scene.wavelengths), scene.reference(None)
    widest = max(map(abs, angles)) * (1 if max(angles) >= -min(angles) else -1)
    line = np.linspace(0, widest, _CURVE) if widest else np.zeros(1)
    say("tracing chief rays")
    at = lambda fields: Scene.radians(fields, scene.distance, scene.wavelengths)  # noqa: E731
    curve = at(line)
    foci = field_curvature(lens, curve)
    bent, colour = distortion(lens, curve), lateral_colour(lens, curve)
    say("tracing fans")
    fans = ray_fans(lens, at(some), _FAN)
    say("tracing spots")
    # The axis, the fields of the spots, and the fields of the illumination curve.
    wide = np.array([0.0, *some, *line[:: _CURVE // _LIGHT]])
    rule = rule_for(lens, at(wide), sampling, _ORDER)
    spots = spot_diagram(lens, at(wide), rule)
    spots, fans = jax.tree.map(np.asarray, (spots, fans))
    say("tracing waves")
    limit = 2e3 * np.sqrt(spots.solid_angle[0, middle] / np.pi) / waves[middle]
    lines = np.linspace(0, min(limit, _LINES) if limit > 0 else _LINES, _CURVE)
    radii, model, cells = _circles(spots, len(some))
    picked = checked_scene(lens, at(some))
    beams = beams_of(lens, picked, beam_rule(_DEGREE, rule.symmetry, rule))
    contrast, best, energy = _waves(lens, beams, picked.wavelengths, jnp.asarray(lines), radii, model, cells)
    say("drawing")

    def draw_on(axes: dict[str, Any]) -> None:
        lens_drawing(axes["layout"], draw(lens, scene))
        others = ", ".join(f"{np.degrees(a):.4g}°" for a in angles if a not in some)
        if others:
            words = f"without spots, fans, MTF and energy: {others}"
            axes["layout"].set_title(words, fontsize=8, loc="left")
        hues = [FIELD_COLOURS[fields.index(field) % len(FIELD_COLOURS)] for field in some]
        names = [f"{np.degrees(field):.4g}°" for field in some]
        _draw_fields(axes, spots, fans, names, waves, hues)
        analyses.field_curvature(axes["foci"], foci, line, waves)
        analyses.distortion(axes["bent"], bent, line, waves)
        analyses.lateral_colour(axes["colour"], colour, line, waves, 1e3 * spots.airy_radius[0])
        later, cone = slice(1 + len(some), None), spots.solid_angle[:, middle]
        light = cone[later] / cone[0], spots.throughput[later, middle]
        analyses.illumination(axes["light"], *light, wide[later])
        given = [f"{np.degrees(field):.3g}°" for field in some], hues  # as in the layout
        analyses.mtf(axes["mtf"], lines, contrast, best, *given)
        airy = float(spots.airy_radius[0])
        analyses.encircled_energy(axes["energy"], radii, energy, *given, airy)
        axes["energy"].set_title(f"encircled energy ({model})", fontsize=8)
        axes["foci"].set_ylabel("field (degrees)")
        for name in ("foci", "bent", "colour"):
            analyses.legend(axes[name])
        for each in jax.tree.leaves(axes) if lens.afocal else ():
            analyses.in_angles(each)

    return len(some), draw_on


def _draw_fields(
    axes: dict[str, list[Axes]],
    spots: Spots,
    fans: RayFans,
    names: list[str],
    waves: np.ndarray,
    hues: list[str],
) -> None:
    """Spots and ray fans of each of the fields of these names. hues: of the names."""
    for k, name in enumerate(names):
        analyses.spots(axes["spots"][k], spots, 1 + k, waves)
        axes["spots"][k].set_title(name, fontsize=8, color=hues[k])
        analyses.fan(axes["tangential"][k], fans, k, waves)
        analyses.fan(axes["sagittal"][k], fans, k, waves, sagittal=True)
        axes["sagittal"][k].set_xlabel("stop")
    for panel, label in (("spots", "y (um)"), ("tangential", "ey (um)"), ("sagittal", "ex (um)")):
        axes[panel][0].set_ylabel(label)
        analyses.legend(axes[panel][-1])



@functools.partial(jit, wanted=ONCE, static_argnames=("model", "cells"))
def _waves(
    lens: Lens,
    beams,
    waves,
    lines: Array,
    radii: Array,
    model: Model,
    cells: int,
) -> tuple[Array, Array, Array]:
    """MTF (F, 2, N), its limit (N,) at the first field, and encircled energy (F, N)."""
    spectrum = jnp.ones_like(waves)

    def one(beam):
        given = lens, beam, waves
        otf, limit = transfer_of(*given, lines, spectrum, "waves", _CELLS)
        return jnp.abs(otf), limit[0], encircled(*given, radii, spectrum, model, cells)

    contrast, limit, energy = jax.lax.map(one, beams)
    return contrast, limit[0], energy


def _circles(spots: Spots, shown: int) -> tuple[Array, Model, int]:
    """Radii (N,), mm, model and cells of the pupil for the encircled energy of `shown` fields. The
    model is "rays" if "waves" would need too many cells for a grid that holds the spots."""
    airy = float(np.min(spots.airy_radius))
    sizes = analyses.spot_radius(spots)[1 : 1 + shown]
    reach = max(np.max(sizes, initial=0, where=np.isfinite(sizes)), 3 * min(airy, 1e-2))
    cells = 64 * int(np.ceil(5 * reach / airy / 64)) if airy < np.inf else _MOST + 1
    radii = jnp.linspace(0, reach, _CURVE)
    return (radii, "rays", _LEAST) if cells > _MOST else (radii, "waves", max(cells, _LEAST))
