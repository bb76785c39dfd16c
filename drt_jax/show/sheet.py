"""All analyses of a lens on one sheet."""

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..compilation import ONCE, jit
from ..image.beam import Beam, beam_rule
from ..image.chief import Distortion, FieldCurvature, along_field
from ..image.encircled import encircled
from ..image.fans import RayFans, ray_fans
from ..image.refined import beams_of
from ..image.spots import Spots, rule_for, spot_diagram
from ..image.transfer import Model, transfer_of
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene
from ..lens.seidel import ThirdOrder, third_order
from ..pupil.rules import PupilRule
from . import analyses
from .figures import FIELD_COLOURS, new, rounded_up, scale_bar
from .layout import beam_hits, draw, lens_drawing

# Points of a curve over the field, points of a fan, frequencies, radii.
_CURVE, _FAN, _FREQUENCIES, _RADII = 61, 65, 32, 61
# Every so many points of a curve over the field there are spots and contrast; the latter at these
# parts of the highest frequency.
_STEP, _PARTS = 6, (0.25, 0.5)
# Highest frequency of transfer functions, cycles/mm, unless the diffraction limit is lower.
_LINES = 200.0
# The contrast of a spot is nothing above this over its RMS size.
_FADED = 2.5
# Order of the spot rule, degree of polynomials, cells for MTF, least and most cells for energy.
_ORDER, _DEGREE, _CELLS, _LEAST, _MOST = 8, 10, 64, 128, 384
# Names of axes: those with one for each field, and those of curves, by the titles of their panels.
_BY_FIELD = {
    "spots": "Spots",
    "fan_y": "Ray fans",
    "fan_x": "Ray fans",
    "path_y": "Optical path difference",
    "path_x": "Optical path difference",
}
_ALONE = {
    "foci": "Field curvature",
    "bent": "Distortion",
    "colour": "Lateral colour",
    "light": "Illumination",
    "mtf": "Modulation transfer function",
    "over_field": "MTF over the field",
    "energy": "Encircled energy",
    "seidel": "Third-order aberrations",
}


class Results(NamedTuple):
    """What a sheet shows of F fields.

    lens, scene: the lens, and its fields that are shown, at most one for each colour.
    left_out: the angles of those that are not, radians.
    line: (61,), angles of the curves over the field, radians.
    foci, bent, colour: of these.
    fans, spots, hits: of the fields; spots also of every sixth point of the line, `hits`
        (F, W, Q, 2), mm, evenly over the stop; inf for a ray that does not arrive.
    lines, contrast, limit: frequencies (N,), cycles/mm, MTF (F, 2, N) of the fields, and its limit
        (N,) at the first of them.
    over_field: MTF (11, 2, 2) at every sixth point of the line, at `_PARTS` of the last frequency.
    radii, energy, model: radii (M,), mm, encircled energy (F, M), and how it is computed.
    third: third-order aberrations, or why there are none.
    """

    lens: Lens
    scene: Scene
    left_out: list[float]
    line: np.ndarray
    foci: FieldCurvature
    bent: Distortion
    colour: np.ndarray
    fans: RayFans
    spots: Spots
    hits: np.ndarray
    lines: np.ndarray
    contrast: np.ndarray
    limit: np.ndarray
    over_field: np.ndarray
    radii: np.ndarray
    energy: np.ndarray
    model: Model
    third: ThirdOrder | str

    @property
    def fields(self) -> np.ndarray:
        """The angles of the fields that are shown, (F,), radians."""
        return np.asarray(self.scene.field)[:, 1]

    @property
    def names(self) -> list[str]:
        """The names of the fields that are shown."""
        return [f"{angle:.4g}°" for angle in np.degrees(self.fields)]


def sheet(
    lens: Lens,
    scene: Scene | None = None,
    sampling: float | PupilRule | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> Figure:
    """One figure: layout; spots with the Airy circle, ray fans and path differences, on one scale
    for all fields, transfer functions and encircled energy of at most five of the fields (it names
    those that are left out); field curvature, distortion, lateral colour, illumination and contrast
    up to the largest field; third-order aberrations. Blue to red are wavelengths, with the weights
    of the scene; other colours are fields.

    scene: fields along y at one distance, and wavelengths, the middle one of which is the
        reference; by default the axis at infinity, in the d line.
    sampling: of the spots, for all fields, as in `spot_diagram`.
    say: called with the name of each step.
    """
    found = analysed(lens, scene, sampling, say)
    count = len(found.fields)
    figure, first = new(width=9 + 1.6 * count, height=12)
    first.remove()
    figure.set_layout_engine("none")
    split = (2.2 + 1.6 * count) / (9 + 1.6 * count)  # inches on either side
    top = figure.add_gridspec(1, 1, left=0.04, right=0.9, top=0.96, bottom=0.74)
    left = figure.add_gridspec(5, count, left=0.05, right=split - 0.05, top=0.68, bottom=0.05)
    right = figure.add_gridspec(4, 2, left=split, right=0.99, top=0.68, bottom=0.05)
    left.update(wspace=0.08, hspace=0.35)
    right.update(wspace=0.42, hspace=0.3)
    axes: dict[str, Any] = {"layout": figure.add_subplot(top[0])}
    for row, name in enumerate(_BY_FIELD):
        axes[name] = [figure.add_subplot(left[row, column]) for column in range(count)]
    for place, name in enumerate(_ALONE):
        axes[name] = figure.add_subplot(right[place])
    for each in figure.axes:
        each.tick_params(labelsize=6)
        each.xaxis.label.set_fontsize(8)
        each.yaxis.label.set_fontsize(8)
        each.locator_params(axis="x", nbins=6 if each is not axes["layout"] else 10)
    say("drawing")
    _draw_on(axes, found)
    figure.legend(handles=[*_keys(found)], fontsize=8, loc="upper right")
    figure.suptitle(found.lens.name)
    return figure


def panels(
    lens: Lens,
    scene: Scene | None = None,
    sampling: float | PupilRule | None = None,
    say: Callable[[str], None] = lambda what: None,
) -> dict[str, Figure]:
    """What `sheet` shows, from the same arguments, as a figure for each panel, by title."""
    found = analysed(lens, scene, sampling, say)
    count = len(found.fields)
    figures: dict[str, Figure] = {}
    axes: dict[str, Any] = {}
    say("drawing")
    figures["Layout"], axes["layout"] = new(1, 1, 11.0, 4.5)
    for title in dict.fromkeys(_BY_FIELD.values()):
        names = [name for name in _BY_FIELD if _BY_FIELD[name] == title]
        figures[title], own = new(len(names), count, 2.1, 1.9)
        axes |= zip(names, np.reshape(own, (len(names), count)).tolist())
    for name, title in _ALONE.items():
        figures[title], axes[name] = new(1, 1, 4.6, 3.3)
    _draw_on(axes, found)
    for own in itertools.chain(*(axes[name] for name in _BY_FIELD)):
        own.yaxis.label.set_fontsize(8)
    for title in ("Layout", *_BY_FIELD.values()):
        if not figures[title].legends:
            keys = [*_keys(found)]
            figures[title].legend(handles=keys, fontsize=8, loc="outside lower center", ncols=4)
    return figures


def _keys(found: Results) -> Iterator[Line2D]:
    """What the colours of fields and wavelengths mean, as handles of a legend."""
    for name, hue in zip(found.names, FIELD_COLOURS):
        yield Line2D([], [], color=hue, label=f"field {name}")
    waves, weights = np.asarray(found.scene.wavelengths), np.asarray(found.scene.spectrum)
    middle = found.scene.reference(None)
    for k, hue in enumerate(analyses.colours(waves)):
        words = f"{waves[k]:.4g} um" + (" (reference)" if k == middle < len(waves) - 1 else "")
        words += f", weight {weights[k]:.3g}" if np.ptp(weights) else ""
        yield Line2D([], [], color=hue, marker=".", label=words)


def analysed(
    lens: Lens, scene: Scene | None, sampling: float | PupilRule | None, say: Callable[[str], None]
) -> Results:
    """The numbers of a sheet, from the arguments of `sheet`."""
    scene = checked_scene(lens, Scene.point() if scene is None else scene)
    shown, left_out = shown_fields(lens, scene)
    some = np.asarray(shown.field)[:, 1]
    angles = [*some.tolist(), *left_out]
    middle = scene.reference(None)
    widest = max(map(abs, angles)) * (1 if max(angles) >= -min(angles) else -1)
    line = np.linspace(0, widest, _CURVE)
    at = functools.partial(_along_y, lens, scene)
    say("tracing rays")
    with ThreadPoolExecutor(1) as aside:  # Python traces one program while XLA compiles another
        of_chief = aside.submit(along_field, lens, at(line))
        of_fans = aside.submit(ray_fans, lens, shown, _FAN)
        of_third = aside.submit(_third_order, lens, at([widest]))
        wide = np.array([*some, *line[::_STEP]])
        rule = rule_for(lens, at(wide), sampling, _ORDER)
        spots = jax.tree.map(np.asarray, spot_diagram(lens, at(wide), rule))
        hits = np.stack([beam_hits(lens, point)[:, :, -1] for point in shown.each()])
        say("tracing waves")
        cone = spots.solid_angle[len(some), middle]
        limit = 2e3 * np.sqrt(cone / np.pi) / float(np.asarray(scene.wavelengths)[middle])
        lines = np.linspace(0, highest(limit, spots.rms[: len(some)]), _FREQUENCIES)
        radii, model, cells = _circles(spots, len(some))
        beams = beams_of(lens, at(wide), beam_rule(_DEGREE, rule.symmetry, rule))
        asked = scene.wavelengths, scene.spectrum, *(jnp.asarray(a, float) for a in (lines, radii))
        waves = _waves(lens, beams, asked, len(some), model, cells)
    foci, bent, colour = jax.tree.map(np.asarray, of_chief.result())
    fans = jax.tree.map(np.asarray, of_fans.result())
    third: ThirdOrder | str
    try:
        third = jax.tree.map(lambda a: np.asarray(a)[0], of_third.result())
        if not all(np.all(np.isfinite(part)) for part in third):  # as in `jit` of tilted surfaces
            third = "third order: no theory for tilted or decentred surfaces"
    except ValueError as error:  # no theory for such a lens
        third = str(error)
    traced = shown, left_out, line, foci, bent, colour, fans, spots, hits
    contrast, best, over, energy = map(np.asarray, waves)
    curves = lines, contrast, best, over, radii, energy, model
    return Results(lens, *traced, *curves, third)


def shown_fields(lens: Lens, scene: Scene) -> tuple[Scene, list[float]]:
    """A scene of the fields that are shown, one for each colour at most and each once, in rising
    order, and the angles of the others, radians. ValueError unless fields lie along y at one
    distance."""
    across, along = np.moveaxis(np.asarray(scene.field), -1, 0)
    if scene.distance.ndim or np.any(across):
        raise ValueError("scene: a sheet has fields along y, at one distance")
    angles = np.unique(along)
    count = min(len(angles), len(FIELD_COLOURS))
    picked = np.round(np.linspace(0, len(angles) - 1, count)).astype(int)
    return _along_y(lens, scene, angles[picked]), np.delete(angles, picked).tolist()


def _along_y(lens: Lens, scene: Scene, angles: Sequence[float] | np.ndarray) -> Scene:
    """A scene of fields along y, (F,) radians. An array of a named dtype compiles nothing."""
    along = np.asarray(angles)
    return checked_scene(lens, scene.at(jnp.asarray(np.stack([0 * along, along], -1), float)))


_third_order = jit(third_order, ONCE)


def _draw_on(axes: dict[str, Any], found: Results) -> None:
    """Draws results on axes, which are named as in `_PANELS`."""
    lens, line, waves, spots = found.lens, found.line, found.scene.wavelengths, found.spots
    count, middle = len(found.fields), found.scene.reference(None)
    if (own := lens_drawing(axes["layout"], draw(lens, found.scene)).get_legend()) is not None:
        own.remove()  # the key of the page has the fields, too
    if found.left_out:
        others = ", ".join(f"{angle:.4g}°" for angle in np.degrees(found.left_out))
        axes["layout"].set_title(
            f"fields not drawn here or below: {others}", fontsize=8, loc="left"
        )
    _draw_fields(axes, found)
    analyses.field_curvature(axes["foci"], found.foci, line, waves)
    analyses.distortion(axes["bent"], found.bent, line, waves)
    airy = float(spots.airy_radius[0])
    analyses.lateral_colour(axes["colour"], found.colour, line, waves, 1e3 * airy)
    later, cone = slice(count, None), spots.solid_angle[:, middle]
    light = cone[later] / cone[count], spots.throughput[later, middle]
    analyses.illumination(axes["light"], *light, line[::_STEP])
    analyses.mtf(axes["mtf"], found.lines, found.contrast, found.limit, found.names)
    pair = found.lines[-1] * np.array(_PARTS)
    analyses.mtf_over_field(axes["over_field"], line[::_STEP], found.over_field, pair)
    analyses.encircled_energy(axes["energy"], found.radii, found.energy, found.names, airy=airy)
    axes["energy"].set_ylabel(f"encircled energy, by {found.model}")
    if isinstance(found.third, str):
        axes["seidel"].text(0.5, 0.5, found.third, ha="center", va="center", wrap=True, fontsize=7)
        axes["seidel"].set_axis_off()
    else:
        analyses.seidel(axes["seidel"], found.third, middle)
    for name in ("foci", "bent", "colour"):
        analyses.legend(axes[name])
    for each in jax.tree.leaves(axes) if lens.afocal else ():
        analyses.in_angles(each)


def _draw_fields(axes: dict[str, list[Axes]], found: Results) -> None:
    """Spots, ray fans and path differences of each field, each on one scale."""
    spots, fans, waves = found.spots, found.fans, found.scene.wavelengths
    count = len(found.fields)
    if not found.lens.afocal:
        spots = dataclasses.replace(spots, points=jnp.asarray(found.hits, float))
    sizes = [*analyses.spot_radius(spots)[:count], *spots.airy_radius[:count]]
    half = 1.1e3 * max((s for s in sizes if np.isfinite(s)), default=1e-3)
    errors = 1e3 * np.stack([fans.tangential[..., 1], fans.sagittal[..., 0]])
    error, path = map(rounded_up, (errors, np.stack([fans.tangential_path, fans.sagittal_path])))
    for k, (name, hue) in enumerate(zip(found.names, FIELD_COLOURS)):
        own = axes["spots"][k]
        analyses.spots(own, spots, k, waves, half)
        own.set_title(name, fontsize=9, color=hue)
        own.set(xticks=[], yticks=[])
        scale_bar(own, "um")
        for panel, of, size in (("fan", analyses.fan, error), ("path", analyses.path_fan, path)):
            of(axes[f"{panel}_y"][k], fans, k, waves, False, size)
            of(axes[f"{panel}_x"][k], fans, k, waves, True, size)
    for own in itertools.chain(*(axes[f"{p}_{x}"][1:] for p in ("fan", "path") for x in "yx")):
        own.set_ylabel("")
        own.tick_params(labelleft=False)


@functools.partial(jit, wanted=ONCE, static_argnames=("count", "model", "cells"))
def _waves(
    lens: Lens, beams: Beam, asked: tuple[Array, ...], count: int, model: Model, cells: int
) -> tuple[Array, Array, Array, Array]:
    """MTF (count, 2, N) and encircled energy (count, M) of the first of P beams, the limit (N,) of
    that of the first, and MTF (P - count, 2, 2) of the others at `_PARTS` of the last frequency.

    asked: wavelengths (W,), spectrum (W,), frequencies (N,) and radii (M,).
    """
    waves, spectrum, lines, radii = asked
    # All beams at two frequencies at a time, so that the transfer function is compiled once.
    pairs = jnp.concatenate([lines.reshape(-1, 2), lines[-1:, None] * jnp.array([_PARTS])])
    each, others = len(pairs) - 1, len(beams.index) - count
    beam = np.append(np.repeat(np.arange(count), each), count + np.arange(others))
    pair = np.append(np.tile(np.arange(each), count), np.full(others, each))

    def at(place: tuple[Array, Array]) -> tuple[Array, Array]:
        one = jax.tree.map(lambda a: a[place[0]], beams)
        return transfer_of(lens, one, waves, pairs[place[1]], spectrum, "waves", _CELLS)

    otf, limit = jax.lax.map(at, (jnp.asarray(beam), jnp.asarray(pair)))
    contrast = jnp.abs(otf)
    joined = lambda a: jnp.moveaxis(a.reshape(count, each, 2, 2), 1, 2).reshape(count, 2, -1)  # noqa: E731
    energy = jax.lax.map(
        lambda beam: encircled(lens, beam, waves, radii, spectrum, model, cells),
        jax.tree.map(lambda a: a[:count], beams),
    )
    split = count * each
    return joined(contrast[:split]), joined(limit[:split])[0, 0], contrast[split:], energy


def highest(limit: float, sizes: np.ndarray) -> float:
    """The highest frequency that is drawn, cycles/mm: the diffraction limit, if there is one, 200,
    or where the contrast of the smallest of RMS spot sizes (F,), mm, has fallen to nothing."""
    blur = np.min(sizes, initial=np.inf, where=np.isfinite(sizes) & (sizes > 0))
    return min(limit if limit > 0 else _LINES, _LINES, rounded_up(_FADED / blur, (1, 2, 4, 10)))


def _circles(spots: Spots, shown: int) -> tuple[np.ndarray, Model, int]:
    """Radii (M,), mm, model and cells of the pupil for the encircled energy of `shown` fields. The
    model is "rays" if "waves" would need too many cells for a grid that holds the spots."""
    airy = float(np.min(spots.airy_radius))
    sizes = analyses.spot_radius(spots)[:shown]
    reach = max(np.max(sizes, initial=0, where=np.isfinite(sizes)), 3 * min(airy, 1e-2))
    cells = 64 * int(np.ceil(5 * reach / airy / 64)) if airy < np.inf else _MOST + 1
    radii = np.linspace(0, reach, _RADII)
    return (radii, "rays", _LEAST) if cells > _MOST else (radii, "waves", max(cells, _LEAST))
