"""Plots of analyses over the field. Each function draws a result of `drt_jax` on the given axes,
and returns the axes.

wavelengths (W,) in um set the colour of each curve: blue for the shortest, red for the longest.
fields (F,) are angles in radians. Values that are not finite are left out.
"""

import itertools
import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, to_hex
from matplotlib.patches import Circle

from ..image.chief import Distortion, FieldCurvature
from ..image.fans import RayFans
from ..image.psf import GaussianError
from ..image.spots import Spots
from ..lens.seidel import ThirdOrder
from .figures import FIELD_COLOURS, rounded_up

# Units of lengths on the sensor, and those of an afocal lens.
_UNITS = {"um": "urad", "cycles/mm": "cycles/mrad", r"focus \(mm": "focus (1e-3 dioptre"}
# Rays farther than this many RMS radii from the centroid are stray and do not widen a plot.
_STRAY = 5.0


def spot_radius(found: Spots) -> np.ndarray:
    """The radii (F,) mm of the plots: that of the farthest ray, at most `_STRAY` RMS radii."""
    return np.minimum(np.asarray(found.radius), _STRAY * np.asarray(found.rms))


def colours(wavelengths: ArrayLike) -> list[str]:
    """A colour for each wavelength."""
    waves = np.ravel(np.asarray(wavelengths, float))
    if np.ptp(waves) == 0:
        return ["tab:blue"] * waves.size
    place = (waves - waves.min()) / np.ptp(waves)
    ramp = LinearSegmentedColormap.from_list("", ["tab:blue", "tab:green", "tab:red"])
    return [to_hex(c) for c in ramp(place)]


def coloured(wavelengths: ArrayLike) -> list[dict[str, Any]]:
    """Colour and label of the curve of each wavelength."""
    waves = np.ravel(np.asarray(wavelengths, float))
    return [{"color": c, "label": f"{w:.4g} um"} for c, w in zip(colours(waves), waves)]


def legend(axes: Axes) -> None:
    """The wavelengths of the curves of an analysis, if there are several."""
    if len({*axes.get_legend_handles_labels()[1]}) > 1:
        axes.legend(fontsize=6, frameon=False, handlelength=1, markerscale=4)


def spots(axes: Axes, found: Spots, field: int, wavelengths: ArrayLike, half: float = 0) -> Axes:
    """The spot of one field about its centroid, in um, with the Airy circle.

    found: result of `spot_diagram` for F fields in W wavelengths.
    field: index of the field.
    wavelengths: (W,), um.
    half: half the width of the plot, um; 0 takes the radius of the spot, at most five RMS radii.
        If a ray lies farther out, the label gives its distance.
    """
    centroid = np.asarray(found.centroid)[field]
    points = 1e3 * (np.asarray(found.points)[field] - centroid)
    airy = 1e3 * float(found.airy_radius[field])
    for rays, style in zip(points, coloured(wavelengths)):
        good = np.all(np.isfinite(rays), axis=-1)
        axes.plot(*rays[good].T, ".", markersize=1.5, **style)
    if np.isfinite(airy):
        axes.add_patch(Circle((0, 0), airy, fill=False, color="black", linewidth=0.8, zorder=3))
        shown, farthest = (1e3 * float(a[field]) for a in (spot_radius(found), found.radius))
        half = half or 1.15 * max(shown, airy)
        axes.set(xlim=(-half, half), ylim=(-half, half))
        size = f"RMS {1e3 * float(found.rms[field]):.3g}, Airy {airy:.3g} um"
        size += f", rays to {farthest:.3g}" if farthest > shown else ""
    else:
        size = "no light arrives"
    axes.set_aspect("equal")
    axes.set_xlabel(size, fontsize=7)
    return axes


def fan(
    axes: Axes,
    found: RayFans,
    field: int,
    wavelengths: ArrayLike,
    sagittal: bool = False,
    half: float = 0,
) -> Axes:
    """Transverse ray errors of one field, um, along the y axis of the stop.

    found: result of `ray_fans` for F fields in W wavelengths.
    field: index of the field.
    wavelengths: (W,), um.
    sagittal: True for the x axis of the stop.
    half: half the height of the plot, um; 0 fits it to the curves.
    """
    errors, component = (found.sagittal, 0) if sagittal else (found.tangential, 1)
    curves = 1e3 * np.asarray(errors)[field, ..., component]
    name = f"ray error $e_{'yx'[sagittal]}$ (um)"
    return _over_pupil(axes, found.pupil, curves, wavelengths, name, half)


def path_fan(
    axes: Axes,
    found: RayFans,
    field: int,
    wavelengths: ArrayLike,
    sagittal: bool = False,
    half: float = 0,
) -> Axes:
    """Optical path differences of one field, waves. Arguments as in `fan`, but `half` in waves."""
    curves = np.asarray(found.sagittal_path if sagittal else found.tangential_path)[field]
    name = f"OPD along {'yx'[sagittal]} (waves)"
    return _over_pupil(axes, found.pupil, curves, wavelengths, name, half)


def field_curvature(
    axes: Axes, found: FieldCurvature, fields: ArrayLike, wavelengths: ArrayLike
) -> Axes:
    """Foci over the field, mm from the sensor: solid lines are tangential, dashed sagittal.

    found: result of `field_curvature`, (F, W). fields: (F,), radians. wavelengths: (W,), um.
    """
    return _over_field(axes, found, fields, wavelengths, "field curvature (mm), T solid, S dashed")


def distortion(axes: Axes, found: Distortion, fields: ArrayLike, wavelengths: ArrayLike) -> Axes:
    """Distortion over the field in per cent.

    found: result of `distortion`, (F, W). fields: (F,), radians. wavelengths: (W,), um.
    """
    percent = 100 * np.asarray(found.relative)
    return _over_field(axes, [percent], fields, wavelengths, "distortion (%)")


def lateral_colour(
    axes: Axes, found: ArrayLike, fields: ArrayLike, wavelengths: ArrayLike, airy: float = 0
) -> Axes:
    """Lateral colour along y over the field, um.

    found: result of `lateral_colour`, (F, W, 2), mm. fields: (F,), radians. wavelengths: (W,), um.
    airy: half the width of the shaded band, such as the Airy radius, um; 0 for none.
    """
    if 0 < airy < np.inf:
        axes.axvspan(-airy, airy, color="0.92")
    along_y = 1e3 * np.asarray(found)[..., 1]
    return _over_field(axes, [along_y], fields, wavelengths, "lateral colour (um)")


def illumination(axes: Axes, light: ArrayLike, throughput: ArrayLike, fields: ArrayLike) -> Axes:
    """Relative illumination and throughput, (F,) each, over the fields (F,), radians."""
    axes.plot(_degrees(fields), light, color="black", label="relative illumination")
    axes.plot(_degrees(fields), throughput, "--", color="tab:grey", label="throughput")
    axes.set(xlim=_range(fields), ylim=(0, 1.05), xlabel="field (degrees)")
    axes.set_ylabel("fraction")
    axes.legend(fontsize=6, loc="lower left", frameon=False)
    return axes


def mtf(
    axes: Axes,
    frequencies: ArrayLike,
    curves: ArrayLike,
    limit: ArrayLike,
    names: Sequence[str],
    hues: Sequence[str] = FIELD_COLOURS,
) -> Axes:
    """MTF over frequency: solid lines are tangential, dashed sagittal, dotted the limit.

    frequencies: (N,), cycles/mm.
    curves: (F, 2, N), such as `Transfer.mtf`.
    limit: (N,), MTF without aberrations.
    names: F labels of the fields. hues: their colours.
    """
    axes.plot(frequencies, limit, ":", color="black", label="limit")
    contrast(axes, frequencies, np.asarray(curves), zip(names, itertools.cycle(hues)))
    axes.set(xlim=(0, np.max(np.asarray(frequencies))), xlabel="spatial frequency (cycles/mm)")
    return axes


def contrast(
    axes: Axes, places: ArrayLike, curves: np.ndarray, styles: Iterable[tuple[str, str]]
) -> None:
    """MTF (F, 2, N) over places (N,): solid lines are tangential, dashed sagittal. styles: label
    and colour of each of the F pairs of curves."""
    for (tangential, sagittal), (label, hue) in zip(curves, styles):
        axes.plot(places, tangential, color=hue, label=label)
        axes.plot(places, sagittal, "--", color=hue)
    axes.set(ylim=(0, 1.02), ylabel="MTF, T solid, S dashed")
    axes.legend(fontsize=6, frameon=False)


def mtf_over_field(
    axes: Axes, fields: ArrayLike, curves: ArrayLike, frequencies: Sequence[float]
) -> Axes:
    """MTF over the field, black to grey: solid lines are tangential, dashed sagittal.

    fields: (F,), radians. curves: (F, 2, N). frequencies: (N,), cycles/mm.
    """
    most = max(len(frequencies) - 1, 1)
    styles = [(f"{line:.4g} cycles/mm", str(0.6 * k / most)) for k, line in enumerate(frequencies)]
    contrast(axes, _degrees(fields), np.asarray(curves).T, styles)
    axes.set(xlim=_range(fields), xlabel="field (degrees)")
    return axes


def seidel(axes: Axes, found: ThirdOrder, wavelength: int = 0) -> Axes:
    """Third-order transverse aberrations of each surface and their sums, mm, as bars on one scale,
    which the label gives.

    found: result of `third_order`. wavelength: index of the wavelength.
    """
    kinds = ThirdOrder._fields[:-1]  # those that are lengths
    parts = np.stack([np.asarray(part)[:, wavelength] for part in found[:-1]])
    bars = np.concatenate([parts, parts.sum(axis=1, keepdims=True)], axis=1)
    spacing, places = 2.2 * rounded_up(bars), np.arange(bars.shape[1])
    for k, row in enumerate(bars):
        axes.bar(places, row / spacing, bottom=-k, color=["black"] * (len(row) - 1) + ["0.5"])
        axes.axhline(-k, color="0.7", linewidth=0.6, zorder=0)
    axes.set_yticks(-np.arange(len(bars)), [name.replace("_", " ") for name in kinds])
    shown = places[: -1 : 1 + len(places) // 13]  # names of more would touch
    axes.set_xticks([*shown, places[-1]], [*map(str, shown), "sum"])
    axes.set(ylim=(0.5 - len(bars), 0.5), xlabel=f"surface; line spacing {spacing:.3g} mm")
    return axes


def encircled_energy(
    axes: Axes,
    radii: ArrayLike,
    parts: ArrayLike,
    names: Sequence[str],
    hues: Sequence[str] = FIELD_COLOURS,
    airy: float = 0,
) -> Axes:
    """Encircled energy: the fraction of the light within circles.

    radii: (N,), mm. parts: (F, N), fractions.
    names: F labels of the fields. hues: their colours.
    airy: radius at which a line is drawn, such as the Airy radius, mm; 0 for none.
    """
    places = 1e3 * np.asarray(radii, float)
    for part, name, hue in zip(np.asarray(parts), names, itertools.cycle(hues)):
        axes.plot(places, part, color=hue, label=name)
    if 0 < airy < np.inf:
        axes.axvline(1e3 * airy, color="0.7", linewidth=0.8, zorder=0, label="Airy")
    axes.set(xlim=(0, places.max()), ylim=(0, 1.02), xlabel="radius (um)")
    axes.set_ylabel("encircled energy")
    axes.legend(fontsize=6, loc="lower right", frameon=False)
    return axes


def gaussian_error(
    axes: Axes, found: GaussianError, fields: ArrayLike, distances: ArrayLike
) -> Axes:
    """The error of Gaussian kernels over distance and field, as numbers and colours: the light in
    wrong pixels, in per cent, which is half of `misplaced`.

    found: result of `gaussian_error`, (D, F). fields: (F,), radians. distances: (D,), mm.
    """
    share = 50 * np.asarray(found.misplaced)
    axes.imshow(share, vmin=0, vmax=100, cmap="magma_r", aspect="auto", origin="lower")
    for place, value in np.ndenumerate(share):
        colour = "white" if value > 50 else "black"
        axes.text(
            place[1], place[0], f"{value:.2g}", ha="center", va="center", color=colour, fontsize=7
        )
    axes.set_xticks(range(share.shape[1]), [f"{a:.3g}" for a in _degrees(fields)])
    far = 1e-3 * np.asarray(distances, float)
    axes.set_yticks(range(len(share)), [f"{d:.3g}" if d < np.inf else "∞" for d in far])
    axes.set(xlabel="field (degrees)", ylabel="distance (m)")
    axes.set_title("light in wrong pixels (%)", fontsize=9)
    return axes


def in_angles(axes: Axes) -> None:
    """The units of an afocal lens in place of those of lengths, in labels and title."""
    for label in (axes.xaxis.label, axes.yaxis.label, axes.title):
        text = label.get_text()
        for length, angle in _UNITS.items():
            text = re.sub(rf"\b{length}\b", angle, text)
        label.set_text(text)


def _finite(curve: np.ndarray) -> np.ndarray:
    return np.where(np.isfinite(curve), curve, np.nan)


def _degrees(fields: ArrayLike) -> np.ndarray:
    return np.degrees(np.asarray(fields, float))


def _range(fields: ArrayLike) -> tuple[float, float]:
    angles = _degrees(fields)
    low, high = float(angles.min()), float(angles.max())
    return (low, high) if high > low else (low - 1, high + 1)


def _over_field(
    axes: Axes, curves: Sequence, fields: ArrayLike, wavelengths: ArrayLike, label: str
) -> Axes:
    """One or two curves (F, W), the second dashed, along y over the field."""
    for k, style in enumerate(coloured(wavelengths)):
        for curve, line in zip(curves, ("-", "--")):
            axes.plot(_finite(np.asarray(curve)[:, k]), _degrees(fields), line, **style)
            style = {"color": style["color"]}  # one entry of a legend
    axes.axvline(0, color="0.7", linewidth=0.6, zorder=0)
    axes.set(xlabel=label, ylabel="field (degrees)", ylim=_range(fields))
    return axes


def _over_pupil(
    axes: Axes, pupil: ArrayLike, curves: ArrayLike, wavelengths: ArrayLike, name: str, half: float
) -> Axes:
    """Curves (W, N) over the stop. name: quantity and unit; half: half the height, 0 to fit."""
    for curve, style in zip(np.asarray(curves), coloured(wavelengths)):
        axes.plot(np.asarray(pupil), _finite(curve), **style)
    axes.axhline(0, color="0.7", linewidth=0.6, zorder=0)
    axes.axvline(0, color="0.7", linewidth=0.6, zorder=0)
    along = "x" if " along x" in name or "e_x" in name else "y"
    axes.set(xlim=(-1, 1), xticks=(-1, 0, 1), xlabel=f"pupil $P_{along}$", ylabel=name)
    if half:
        axes.set(ylim=(-half, half), yticks=(-half, 0, half))
    return axes
