"""Plots of aberrations over the pupil, the wavelength and the focus. Each function draws a result
of `drt_jax` on axes; colours of wavelengths and fields are those of `analyses`."""

import itertools
from collections.abc import Sequence

import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.patches import Circle

from ..image.chief import Distortion
from ..image.fans import AxialColour
from .analyses import coloured, contrast
from .figures import FIELD_COLOURS


def longitudinal(
    axes: Axes, found: AxialColour, heights: ArrayLike, wavelengths: ArrayLike
) -> Axes:
    """Longitudinal spherical aberration: foci, mm from the sensor, with paraxial foci as points.

    found: result of `axial_colour` for N heights in W wavelengths.
    heights: (N,), on the stop, in units of its semi-diameter. wavelengths: (W,), um.
    """
    rows = zip(np.asarray(found.real), np.asarray(found.paraxial), coloured(wavelengths))
    for real, paraxial, style in rows:
        axes.plot(np.where(np.isfinite(real), real, np.nan), np.asarray(heights), **style)
        axes.plot([paraxial], [0], "o", color=style["color"], markersize=3)
    axes.axvline(0, color="0.7", linewidth=0.6, zorder=0)
    axes.set(ylim=(0, 1), xlabel="focus from the sensor (mm)", ylabel="pupil $P_y$")
    return axes


def focal_shift(axes: Axes, found: AxialColour, wavelengths: ArrayLike, reference: float) -> Axes:
    """Chromatic focal shift, um: paraxial foci over wavelength, minus the focus of a reference.

    found: result of `axial_colour`. wavelengths: (W,), um. reference: a wavelength, um.
    """
    waves, foci = np.asarray(wavelengths, float), 1e3 * np.asarray(found.paraxial)
    axes.plot(foci - np.interp(reference, waves, foci), waves, color="black")
    axes.axhline(reference, color="0.7", linewidth=0.6, zorder=0)
    axes.set(xlabel="paraxial focal shift (um)", ylabel="wavelength (um)")
    axes.set_ylim(waves.min(), waves.max())
    return axes


def mtf_through_focus(
    axes: Axes, focus: ArrayLike, curves: ArrayLike, names: Sequence[str], frequency: float
) -> Axes:
    """MTF at one frequency over the position of the sensor: solid lines are tangential, dashed
    sagittal.

    focus: (Z,), shift of the sensor, mm. curves: (F, Z, 2), MTF.
    names: F labels of the fields. frequency: cycles/mm.
    """
    styles = zip(names, itertools.cycle(FIELD_COLOURS))
    contrast(axes, focus, np.asarray(curves).swapaxes(1, 2), styles)
    axes.axvline(0, color="0.7", linewidth=0.6, zorder=0)
    axes.set_xlim(np.min(np.asarray(focus)), np.max(np.asarray(focus)))
    axes.locator_params(axis="x", nbins=5)
    axes.set_xlabel("shift of the sensor (mm); T solid, S dashed")
    axes.set_ylabel(f"MTF at {frequency:.4g} cycles/mm")
    return axes


def grid_distortion(axes: Axes, found: Distortion, side: int, wavelength: int = 0) -> Axes:
    """The image of a square grid of fields, mm: real chief rays black, the ideal image grey.

    found: result of `distortion` for side x side fields, row by row.
    side: number of fields along a side. wavelength: index of the wavelength.
    """
    for points, colour in ((found.ideal, "0.7"), (found.real, "black")):
        grid = np.asarray(points)[:, wavelength].reshape(side, side, 2)
        grid = np.where(np.isfinite(grid), grid, np.nan)
        for line in (*grid, *grid.swapaxes(0, 1)):
            axes.plot(*line.T, color=colour, linewidth=0.8)
    relative = 100 * np.asarray(found.relative)[:, wavelength]
    most = relative[np.argmax(np.where(np.isfinite(relative), np.abs(relative), -1))]
    axes.set_aspect("equal")
    axes.set(xlabel=f"x (mm); largest distortion {most:.3g} %", ylabel="y (mm)")
    return axes


def footprints(axes: Axes, hits: ArrayLike, semi_diameter: float) -> Axes:
    """Hits of the rays of F fields on a surface, with its clear aperture.

    hits: (F, Q, 2), mm from the vertex; inf for rays that do not arrive.
    semi_diameter: radius of the clear aperture, mm; inf for none.
    """
    for points, hue in zip(np.asarray(hits), itertools.cycle(FIELD_COLOURS)):
        good = np.all(np.isfinite(points), axis=-1)
        axes.plot(*points[good].T, ".", color=hue, markersize=1)
    if np.isfinite(semi_diameter):
        axes.add_patch(Circle((0, 0), semi_diameter, fill=False, color="black", linewidth=0.8))
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()
    return axes


def wavefront_map(axes: Axes, opd: ArrayLike) -> Axes:
    """Path differences over the stop, with their peak to valley and RMS.

    opd: (N, N) [y, x], waves; nan where no light passes.
    """
    waves = np.asarray(opd)
    picture = axes.imshow(waves, origin="lower", extent=(-1, 1, -1, 1), cmap="viridis")
    axes.figure.colorbar(picture, ax=axes, shrink=0.8, label="OPD (waves)")
    inside = waves[np.isfinite(waves)]
    if inside.size:
        size = f"PV {np.ptp(inside):.3g}, RMS {np.std(inside):.3g} waves"
        axes.set_title(size, fontsize=8)
    axes.set(xlabel="pupil $P_x$", ylabel="pupil $P_y$")
    return axes


def point_spread(axes: Axes, kernel: ArrayLike, pixel: float) -> Axes:
    """A PSF relative to its peak, over um about its centre.

    kernel: (N, N) [y, x]. pixel: side of a pixel, mm.
    """
    light = np.asarray(kernel)
    half = 0.5e3 * pixel * len(light)
    peak = np.max(light) or 1.0
    extent = (-half, half, -half, half)
    axes.imshow(light / peak, vmin=0, vmax=1, cmap="magma", origin="lower", extent=extent)
    axes.set(xlabel="x (um)", ylabel="y (um)")
    return axes
