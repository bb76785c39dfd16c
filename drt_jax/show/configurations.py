"""Drawings of the configurations of one lens, below each other, and a table of their numbers."""

import dataclasses
from collections.abc import Iterator, Sequence
from itertools import count

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes

from ..image.spots import spot_diagram
from ..lens.lens import Lens
from ..lens.paraxial import first_order
from ..lens.scene import Scene, checked_scene
from .layout import beam_of, draw, lens_drawing


def configurations(
    axes: Sequence[Axes], lenses: Sequence[Lens], scenes: Sequence[Scene], half: bool = False
) -> Sequence[Axes]:
    """Draw the configurations of a lens at one scale, with their sensors aligned.

    axes: C axes, such as those of `new(C)`.
    lenses, scenes: C of each; fields along y. A surface without an aperture is as wide as the beams
        of all configurations there.
    half: as in `lens_drawing`.
    """
    pairs = [*zip(lenses, scenes, strict=True)]
    drawings = [draw(*pair) for pair in zip(_with_rims(pairs), scenes)]
    parts = [drawing._replace(fields=(), numbers=()) for drawing in drawings]
    ends = [np.array([drawing.sensor[:, 0].mean(), 0.0]) for drawing in drawings]
    moved = [jax.tree.map(lambda a, end=end: a - end, part) for part, end in zip(parts, ends)]
    points = np.concatenate(jax.tree.leaves(moved))
    corners = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    for ax, drawing, own, end in zip(axes, drawings, moved, ends, strict=True):
        ax.plot(*zip(*corners), linewidth=0)  # one scale
        numbers = [(number, place - end) for number, place in drawing.numbers]
        lens_drawing(ax, own._replace(fields=drawing.fields, numbers=numbers), half)
        ax.set_xlabel("z from the sensor (mm)")
    for ax, (number, focal, speed, *_) in zip(axes, map(_first_order, *zip(*pairs), count(1))):
        ax.set_title(f"{number}: f = {focal} mm, f/{speed}", fontsize=9)
    return axes


def _with_rims(pairs: Sequence[tuple[Lens, Scene]]) -> list[Lens]:
    """The lenses with one semi-diameter for all where a surface has no aperture."""
    beams = [beam_of(lens, point) for lens, scene in pairs for point in scene.each()]
    wide = 1.1 * np.max([beam.wide for beam in beams], axis=0)
    found = []
    for lens, _ in pairs:
        own = np.asarray(lens.semi_diameter)
        free = np.isinf(own) & (wide > 0)
        free[[-1, *(() if lens.apertures is None else lens.apertures.surfaces)]] = False
        rims = jnp.asarray(np.where(free, wide, own), lens.curvature.dtype)
        found.append(dataclasses.replace(lens, semi_diameter=rims))
    return found


def configuration_table(
    lenses: Sequence[Lens], scenes: Sequence[Scene]
) -> Iterator[tuple[str, ...]]:
    """Rows of a table, two of them its header: first-order data of each configuration of a lens in
    the middle wavelength, and the RMS radii of the spots of all wavelengths about their centroid.

    lenses, scenes: C of each; fields along y.
    """
    angles = any(lens.afocal for lens in lenses)
    yield "", "focal length", "f-number", "distance", "magnification", "track", "RMS spots"
    yield "", "mm", "", "mm", "", "mm", "urad by field" if angles else "um by field"
    for k, (lens, scene) in enumerate(zip(lenses, scenes, strict=True), 1):
        found = zip(np.degrees(scene.field[..., 1]), 1e3 * spot_diagram(lens, scene).rms)
        spots = [f"{angle:.4g}°: {rms:.3g}" for angle, rms in found]
        yield *_first_order(lens, scene, k), ", ".join(spots)


def _first_order(lens: Lens, scene: Scene, number: int) -> tuple[str, ...]:
    """The cells of a row of `configuration_table` without spots."""
    scene = checked_scene(lens, scene)
    middle = scene.reference(None)
    found = first_order(lens, scene.distance, scene.wavelengths[middle : middle + 1])
    return (
        f"{number}",
        f"{found.effective_focal_length[0]:.6g}",
        f"{found.f_number[0]:.4g}",
        f"{float(scene.distance):.6g}",
        f"{found.magnification[0] + 0.0:.4g}",
        f"{float(lens.sensor):.6g}",
    )
