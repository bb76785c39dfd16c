"""All analyses of a lens on one sheet."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..compilation import ONCE, jit
from ..image.chief import distortion, field_curvature, lateral_colour
from ..image.fans import RayFans, ray_fans
from ..image.spots import Spots, light_rule, spot_diagram
from ..image.transfer import transfer
from ..lens.lens import Lens
from ..pupil.rules import PupilRule
from . import analyses
from .figures import new
from .layout import draw, lens_drawing

# Fields of the curves, and of that of illumination; points of the fans; fields of spots and fans.
_CURVE, _LIGHT, _FAN, _FIELDS = 31, 10, 33, 3
# Frequencies of transfer functions end here, cycles/mm, or where waves do.
_LINES = 200.0
# Of the rule of the spots.
_ORDER = 8


def sheet(
    lens: Lens,
    fields: Sequence[float] = (0.0,),
    distance: float = float("inf"),
    wavelengths: Sequence[float] = (0.5875618,),
    rule: PupilRule | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> Figure:
    """Layout, spots with the Airy circle and ray fans of three of the fields, field curvature,
    distortion, lateral colour and illumination up to the largest of them: one figure.

    fields: angles along y, radians. distance: mm, inf allowed. wavelengths: um, the middle one is
    the reference. rule: of the spots, for all fields; None: as of `spot_diagram`. say: is told what
    is being done.
    """
    angles = sorted({float(angle) for angle in fields})
    some = [angles[k] for k in sorted({0, len(angles) // 2, len(angles) - 1})][:_FIELDS]
    waves, middle = np.array(wavelengths, float), len(wavelengths) // 2
    widest = max(map(abs, angles)) * (1 if max(angles) >= -min(angles) else -1)
    line = np.linspace(0, widest, _CURVE) if widest else np.zeros(1)
    say("tracing chief rays")
    scene = distance, waves
    foci = field_curvature(lens, line, *scene)
    bent, colour = distortion(lens, line, *scene), lateral_colour(lens, line, *scene)
    say("tracing fans")
    fans = _fans(lens, jnp.array(some), jnp.asarray(distance, line.dtype), jnp.array(waves))
    say("tracing spots")
    # The axis, fields of the pictures, and of the curve of illumination.
    wide = np.array([0.0, *some, *line[:: _CURVE // _LIGHT]])
    rule = light_rule(lens, wide, *scene, order=_ORDER) if rule is None else rule
    spots = _spots(lens, jnp.array(wide), jnp.asarray(distance, line.dtype), jnp.array(waves), rule)
    spots, fans = jax.tree.map(np.asarray, (spots, fans))
    say("tracing transfer functions")
    limit = 2e3 * np.sqrt(spots.solid_angle[0, middle] / np.pi) / waves[middle]
    lines = np.linspace(0, min(limit, _LINES) if limit > 0 else _LINES, _CURVE)
    picked = jnp.array(some), jnp.asarray(distance, line.dtype), jnp.array(waves)
    found = _transfers(lens, *picked, jnp.asarray(lines), rule=rule)
    say("drawing")
    figure, axes = _axes(len(some))
    lens_drawing(axes["layout"], draw(lens, fields, distance, wavelengths[middle]))
    _per_field(axes, spots, fans, some, waves)
    analyses.field_curvature(axes["foci"], foci, line, waves)
    analyses.distortion(axes["bent"], bent, line, waves)
    analyses.lateral_colour(axes["colour"], colour, line, waves, 1e3 * spots.airy_radius[0])
    later = slice(1 + len(some), None)
    light = spots.solid_angle[:, middle] / spots.solid_angle[0, middle]
    analyses.illumination(axes["light"], light[later], spots.throughput[later, middle], wide[later])
    names = [f"{np.degrees(field):.3g}°" for field in some]
    analyses.mtf(axes["mtf"], lines, found.mtf, found.limit[0, 0], names)
    axes["foci"].set_ylabel("field (degrees)")
    return figure


_fans = jit(functools.partial(ray_fans, count=_FAN), ONCE)
_spots = jit(spot_diagram, ONCE)
_transfers = jit(functools.partial(transfer, degree=10, cells=48), ONCE)


def _axes(count: int) -> tuple[Figure, dict[str, Any]]:
    """A figure, and axes by name; those of fields are lists."""
    figure, first = new(width=14, height=10)
    first.remove()
    grid = figure.add_gridspec(4, 6, height_ratios=[1.5, 1, 0.8, 0.8])
    at = lambda *place: figure.add_subplot(grid[place])  # noqa: E731
    axes: dict[str, Any] = {"layout": at(0, slice(None))}
    for row, name in enumerate(("spots", "tangential", "sagittal"), 1):
        axes[name] = [at(row, k) for k in range(count)]
    axes |= {name: at(1, k) for k, name in enumerate(("foci", "bent", "colour"), 3)}
    axes["light"], axes["mtf"] = at(slice(2, None), 3), at(slice(2, None), slice(4, None))
    for each in figure.axes:
        each.tick_params(labelsize=6)
        each.xaxis.label.set_fontsize(7)
        each.yaxis.label.set_fontsize(7)
    return figure, axes


def _per_field(
    axes: dict[str, list[Axes]],
    spots: Spots,
    fans: RayFans,
    fields: list[float],
    waves: np.ndarray,
) -> None:
    for k, field in enumerate(fields):
        spot, tangential, sagittal = (axes[n][k] for n in ("spots", "tangential", "sagittal"))
        analyses.spots(spot, spots, 1 + k, waves)
        spot.set_title(f"{np.degrees(field):.4g}°", fontsize=8)
        analyses.fan(tangential, fans, k, waves)
        analyses.fan(sagittal, fans, k, waves, sagittal=True)
        sagittal.set_xlabel("stop")
    for name, label in (("spots", "y (um)"), ("tangential", "ey (um)"), ("sagittal", "ex (um)")):
        axes[name][0].set_ylabel(label)
