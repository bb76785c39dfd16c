"""Further analyses of a lens, which take longer to compile than those of a sheet."""

import dataclasses
import warnings
from collections.abc import Callable, Iterator

import numpy as np
from matplotlib.figure import Figure

from ..image.beam_psf import Sampling
from ..image.chief import distortion
from ..image.fans import axial_colour
from ..image.psf import psf
from ..image.spots import light_rule, spot_diagram
from ..image.transfer import Model, transfer
from ..image.wavefront import wavefront
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..pupil.patterns import hexapolar
from ..pupil.rules import Pattern, PupilRule
from ..rays.status import Status
from . import aberrations, analyses
from .figures import new
from .layout import beam_hits
from .sheet import shown_fields

# Heights on the stop, wavelengths of the focal shift, fields along a side of a grid, points along
# a side of a map of the stop, steps of the sensor, and pixels along a side of a PSF.
_HEIGHTS, _WAVES, _GRID, _MAP, _STEPS, _PIXELS = 20, 15, 9, 32, 5, 65
_RINGS, _CELLS = 8, 128
# Most Airy radii that a PSF of waves on `_CELLS` cells holds.
_WIDEST = 25.0


def more_panels(
    lens: Lens, scene: Scene | None = None, say: Callable[[str], None] = lambda what: None
) -> dict[str, Figure]:
    """Longitudinal aberration, chromatic focal shift, spots and contrast through focus, grid
    distortion, footprints, maps of the wavefront, and PSFs, each as a figure, by title.

    lens, scene, say: as in `sheet`. An afocal lens has no focus: what goes through it is left out.
    """
    scene = checked_scene(lens, Scene.point() if scene is None else scene)
    some = shown_fields(lens, scene)[0]
    rule = light_rule(lens, some, 8)
    parts = [_grid(lens, some), _footprints(lens, some), _maps(lens, some)]
    if not lens.afocal:
        parts += [_axis(lens, some), _through_focus(lens, some, rule), _psf(lens, some, rule)]
    figures: dict[str, Figure] = {}
    for part in parts:
        for title, figure in part:
            say(title)
            figures[title] = figure
    return figures


def _names(scene: Scene) -> list[str]:
    return [f"{angle:.4g}°" for angle in np.degrees(np.asarray(scene.field[:, 1]))]


def _axis(lens: Lens, scene: Scene) -> Iterator[tuple[str, Figure]]:
    """Longitudinal aberration and focal shift, from one trace."""
    own = np.asarray(scene.wavelengths)
    waves = np.unique(np.concatenate([own, np.linspace(own.min(), own.max(), _WAVES)]))
    heights = np.linspace(1 / _HEIGHTS, 1, _HEIGHTS)
    found = axial_colour(lens, Scene.point(0.0, scene.distance, waves), heights)
    figure, axes = new(1, 1, 4.6, 3.3)
    rows = np.searchsorted(waves, own)
    picked = found._replace(paraxial=found.paraxial[rows], real=found.real[rows])
    analyses.legend(aberrations.longitudinal(axes, picked, heights, own))
    yield "Longitudinal aberration", figure
    if len(own) > 1:
        figure, axes = new(1, 1, 4.6, 3.3)
        aberrations.focal_shift(axes, found, waves, float(own[scene.reference(None)]))
        yield "Chromatic focal shift", figure


def _through_focus(lens: Lens, scene: Scene, rule: PupilRule) -> Iterator[tuple[str, Figure]]:
    """Contrast and spots at sensor positions within twice the depth of focus, or where a spot has
    doubled its size."""
    pattern = Pattern(*hexapolar(_RINGS))
    found = spot_diagram(lens, scene, pattern)
    airy = float(np.min(found.airy_radius))
    sizes = np.asarray(found.rms)
    blur = max(np.min(sizes, initial=np.inf, where=np.isfinite(sizes)), 0.5 * airy)
    wave = float(scene.wavelengths[scene.reference(None)])
    reach = 3 * blur * airy / (0.61e-3 * wave)  # blur / NA
    frequency = 0.25 / (2 * max(blur, 0.5 * airy))
    frequency = float(f"{frequency:.1g}")
    focus = np.linspace(-reach, reach, 21)
    sampling = Sampling.of("waves", rule, _CELLS)
    contrast = transfer(lens, scene, [frequency], "waves", focus, sampling).mtf
    figure, axes = new(1, 1, 4.6, 3.3)
    curves = np.asarray(contrast)[..., 0]
    aberrations.mtf_through_focus(axes, focus, curves, _names(scene), frequency)
    yield "MTF through focus", figure
    steps = np.linspace(-reach, reach, _STEPS)
    moved = [dataclasses.replace(lens, sensor=lens.sensor + step) for step in steps]
    each = [spot_diagram(one, scene, pattern) for one in moved]
    half = 1.1e3 * max(
        float(np.max(r[np.isfinite(r)], initial=airy))
        for r in (analyses.spot_radius(spots) for spots in each)
    )
    names = _names(scene)
    figure, axes = new(len(names), _STEPS, 1.6, 1.7)
    for k, row in enumerate(np.reshape(axes, (len(names), _STEPS))):
        for own, spots, step in zip(row, each, steps):
            analyses.spots(own, spots, k, scene.wavelengths, half)
            own.set(xticks=[], yticks=[], xlabel=f"RMS {1e3 * float(spots.rms[k]):.3g} um")
            own.set_title(f"{step:+.3g} mm" if k == 0 else "", fontsize=8)
        row[0].set_ylabel(f"{names[k]}, box {2 * half:.3g} um", fontsize=7)
    yield "Spots through focus", figure


def _grid(lens: Lens, scene: Scene) -> Iterator[tuple[str, Figure]]:
    """Distortion of a square grid of fields whose corners are at the largest field."""
    most = float(np.max(np.abs(np.tan(np.asarray(scene.field[:, 1]))))) / 2**0.5
    if most:
        line = np.linspace(-most, most, _GRID)
        pairs = np.arctan(np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2))
        middle = scene.reference(None)
        waves = scene.wavelengths[middle : middle + 1]
        found = distortion(lens, Scene.radians(pairs, scene.distance, waves))
        figure, axes = new(1, 1, 4.6, 4.0)
        aberrations.grid_distortion(axes, found, _GRID)
        yield "Grid distortion", figure


def _footprints(lens: Lens, scene: Scene) -> Iterator[tuple[str, Figure]]:
    """Rays of all fields on each surface that bends light, and on the stop."""
    middle = scene.reference(None)
    hits = np.stack([beam_hits(lens, point)[middle] for point in scene.each()])
    rows = sorted({*lens.active, lens.stop})
    columns = min(len(rows), 6)
    figure, axes = new(-(-len(rows) // columns), columns, 2.0, 2.2)
    for i, own in zip(rows, np.ravel(axes)):
        semi = float(lens.semi_diameter[i])
        aberrations.footprints(own, hits[:, :, i], semi)
        own.set_title(f"surface {i}{', stop' * (i == lens.stop)}", fontsize=8)
        own.tick_params(labelsize=6)
        own.set_xlabel("x (mm)" if not np.isfinite(semi) else f"x (mm), semi-diameter {semi:.4g}")
        own.xaxis.label.set_fontsize(7)
    for own in np.ravel(axes)[len(rows) :]:
        own.set_axis_off()
    yield "Footprints and clear apertures", figure


def _maps(lens: Lens, scene: Scene) -> Iterator[tuple[str, Figure]]:
    """Path differences over the stop of each field, in the reference wavelength."""
    side = (np.arange(_MAP) + 0.5) * 2 / _MAP - 1
    points = np.stack(np.meshgrid(side, side), axis=-1)
    inside = np.hypot(*np.moveaxis(points, -1, 0)) <= 1
    middle = scene.reference(None)
    one = dataclasses.replace(
        scene, wavelengths=scene.wavelengths[middle : middle + 1], wavelength_weights=None
    )
    found = wavefront(lens, one, points[inside])
    opd = np.where(np.asarray(found.status) == Status.OK, np.asarray(found.opd), np.nan)[:, 0]
    names = _names(scene)
    figure, axes = new(1, len(names), 3.4, 2.7)
    for own, values, name in zip(np.ravel(axes), opd, names):
        grid = np.full(inside.shape, np.nan)
        grid[inside] = values
        aberrations.wavefront_map(own, grid)
        own.set_title(f"{name}: {own.get_title()}", fontsize=7)
    yield "Wavefront", figure


def _psf(lens: Lens, scene: Scene, rule: PupilRule) -> Iterator[tuple[str, Figure]]:
    """PSFs of all wavelengths with their weights."""
    found = spot_diagram(lens, scene, Pattern(*hexapolar(_RINGS)))
    radius = analyses.spot_radius(found)
    airy = float(np.min(found.airy_radius))
    reach = max(float(np.max(radius[np.isfinite(radius)], initial=0)), 4 * airy)
    kind: Model = "waves" if reach < _WIDEST * airy else "rays"
    pixel = 2.2 * reach / _PIXELS
    sampling = Sampling.of(kind, rule, _CELLS if kind == "rays" else 2 * _CELLS)
    with warnings.catch_warnings():  # the labels say how much light falls outside
        warnings.simplefilter("ignore")
        spread = psf(lens, scene, pixel, _PIXELS, sampling=sampling)
    share = np.asarray(scene.spectrum) * np.asarray(spread.throughput)
    share = share[..., None, None]
    kernel = np.sum(share * np.asarray(spread.kernel), axis=1)
    total = np.maximum(np.sum(share[..., 0, 0], axis=1), np.finfo(float).tiny)
    outside = 100 * np.sum(share[..., 0, 0] * np.asarray(spread.outside), axis=1) / total
    names = _names(scene)
    figure, axes = new(1, len(names), 2.6, 2.6)
    for own, light, name, part in zip(np.ravel(axes), kernel, names, outside):
        aberrations.point_spread(own, light, pixel)
        own.set_title(f"{name}, {part:.2g} % outside", fontsize=8)
    yield f"Point spread function, by {kind}, of its peak", figure
