"""`python -m drt_jax show LENS`: data, spots and warnings as lines, and a sheet or a page."""

import argparse
import dataclasses
import math
import pathlib
import warnings
from collections.abc import Callable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from ..compilation import ONCE, jit
from ..files.load import lens_names, load_lens, load_system
from ..image.converged import psf_moments
from ..image.diagnose import crossed
from ..inputs import require
from ..lens.lens import Lens
from ..lens.order import may_cross
from ..lens.paraxial import FirstOrder, first_order
from ..lens.scene import Scene, checked_scene
from ..pupil.clipped import Clipped
from ..pupil.rules import Gauss, Pattern, PupilRule, Symmetry, gauss_points, symmetry_of
from ..rays.status import Status
from .configurations import configuration_table, configurations
from .figures import new
from .layout import ENDS, Beam, beam_of, draw, lens_drawing
from .more import more_panels
from .page import Part, page
from .prescription import first_rows, prescription
from .sheet import panels, sheet

_LINES = (0.6562725, 0.5875618, 0.4861327)  # C, d, F
# Orders of the two rules for the spots; a larger relative difference of spot size is reported.
_ORDERS, _TOLERANCE = (14, 20), 1e-3
OTHERS = (".zmx", ".seq")
_DEFOCUS = 3.0  # a spot larger than this many times the smallest spot is out of focus
_HALVINGS = 8  # of the fields of a lens that names none
_WAVES = 5  # of more wavelengths of a file, the primary, longest and shortest are shown
MISSING = "warn: leave out what is unsupported and rays can go on without, with a warning"
WHICH = "number of a configuration or zoom position of a .zmx or .seq file, from 1"
_NO_SIZE = 1e-9  # mm, mrad: a smaller spot is only rounding error
# A line of text, or a row of a table.
Line = tuple[str, ...] | str


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command line."""
    names = ", ".join(lens_names())
    parser.add_argument("lens", help=f".yaml, .zmx or .seq file, or a bundled name: {names}")
    own = "default: those of a .zmx or .seq file, else"
    ends = "default: those of a .zmx or .seq file with their weights, else"
    every = f"{WHICH}; or all: their layouts under each other and a table of their numbers"
    parser.add_argument("--configuration", type=configuration, help=every)
    lit = f"degrees; {own} 0 7 10, halved until light arrives"
    parser.add_argument("--field", type=float, nargs="+", help=lit)
    parser.add_argument("--distance", type=float, help=f"to the object, mm; {own} inf")
    parser.add_argument("--wavelengths", type=float, nargs="+", help=f"um; {ends} C, d and F")
    parser.add_argument("--missing", choices=("error", "warn"), default="error", help=MISSING)
    parser.add_argument("--html", action="store_true", help="a page of tables and figures instead")
    more = "a page with more figures, such as through-focus MTF and PSF; a minute longer"
    parser.add_argument("--all", action="store_true", help=more)
    ends = "of the sheet or page; default: LENS.png or LENS.html here"
    parser.add_argument("--out", type=pathlib.Path, help=ends)


def configuration(text: str) -> int | str:
    """The number of a configuration, or "all"."""
    return text if text == "all" else int(text)


def output(options: argparse.Namespace, say: Callable[[str], None]) -> Iterator[Line]:
    """Yields the data of a lens, as lines and rows of tables, when they are computed; draws its
    sheet. ValueError for wrong options. say: called with the name of each step.

    The fast results come first: first-order data, then a file with the drawing, then spots and
    warnings. The sheet or page with all analyses replaces the file at the end.
    """
    if not all(abs(field) < 90 for field in options.field or ()):
        raise ValueError("--field: must be within 90 degrees")
    if options.configuration == "all":
        yield from _all_told(options)
        return
    view = view_of(options)
    lens, _, distance, waves, _, note = view
    middle = waves[len(waves) // 2]
    found = jax.tree.map(lambda a: a.item(), _first_order(lens, distance, np.array([middle])))
    about = f"{lens.count} surfaces, stop: surface {lens.stop} (counted from 0)"
    first = [*first_rows(lens, found, middle)]
    yield f"{lens.name}: {about}"
    yield from (f"  {name:<19}  {value}" for name, value in first)
    say("tracing; another kind of lens is compiled first, for half a minute or less")
    view = view.lit()
    scene, fields = view.scene, view.fields
    out, web = _file_of(options)
    # The drawing is written after some seconds; the sheet, or the whole page, replaces it.
    data: list[tuple[str, Part]] = [("First-order data", first)]
    drawing, axes = new(1, 1, 11.0, 4.5)
    lens_drawing(axes, draw(lens, scene))
    _write(out, drawing if not web else page(lens.name, [*data, ("Layout", drawing)]))
    yield f"the lens is drawn in {out}; its analyses follow there"
    axial = beam_of(lens, scene.at(jnp.asarray(np.zeros(2), float)))
    beams = [beam_of(lens, point) for point in scene.each()]
    notes = [] if lens.afocal else [*focus_lines(found, middle, axial)]
    notes += [note] if note else []
    yield from (*notes, "")
    table: list[Line] = []
    for row in field_rows(lens, scene, fields, beams):
        table.append(row)
        yield row
    yield from (wide := [*aperture_lines(lens, beams)])
    symmetry, cut = symmetry_of(lens, scene.field), any(beam.clips for beam in beams)
    rule = Clipped(8, symmetry, 8, may_cross(lens)) if cut else Gauss(8, symmetry)
    shown = lens, scene, rule, say
    if not web:
        figure = sheet(*shown)
        figure.text(0.01, 0.01, note.strip(" !"), fontsize=7)
        _write(out, figure)
        yield f"drawn in {out}"
        return
    rows = [row for row in table if not isinstance(row, str)]
    lines = [*notes, *wide, *(line for line in table if isinstance(line, str))]
    parts: list[tuple[str, Part]] = [*data, ("Spots and light", rows)]
    parts += [("Warnings", "\n".join(lines))] if lines else []
    used = np.max([beam.wide for beam in beams], axis=0)[:-1]
    parts += [*prescription(lens, used).items(), *panels(*shown).items()]
    parts += [*more_panels(lens, scene, say).items()] if options.all else []
    _write(out, page(f"{lens.name}: {about}", parts))
    yield f"drawn in {out}, {out.stat().st_size / 1024:.0f} kB"


def _all_told(options: argparse.Namespace) -> Iterator[Line]:
    """A table of all configurations of a file, whose layouts are drawn below each other."""
    path = pathlib.Path(options.lens)
    several = path.suffix.lower() in OTHERS
    require(several, f"--configuration all: {path.name} has one; expected a .zmx or .seq file")
    count = load_system(path, options.missing, 1).configurations
    each = [vars(options) | {"configuration": k} for k in range(1, count + 1)]
    views = [view_of(argparse.Namespace(**own)).lit() for own in each]
    lenses, scenes = [view.lens for view in views], [view.scene for view in views]
    title = f"{lenses[0].name or path.stem}: {count} configurations"
    yield title
    yield from (rows := [*configuration_table(lenses, scenes)])
    figure, axes = new(count, width=6.5, height=2.4)
    configurations([*np.ravel(axes)], lenses, scenes)
    out, web = _file_of(options)
    if web:
        _write(out, page(title, [("Configurations", rows), ("Layouts", figure)]))
    else:
        _write(out, figure)
    yield f"drawn in {out}"


def _write(out: pathlib.Path, shown: Figure | str) -> None:
    """Write a figure, or the text of a page."""
    if isinstance(shown, str):
        out.write_text(shown, encoding="utf-8")
    else:
        shown.savefig(out)


def _file_of(options: argparse.Namespace) -> tuple[pathlib.Path, bool]:
    """The file of a sheet or page, and whether it is a page."""
    web = options.html or options.all
    name = f"{pathlib.Path(options.lens).stem}.{'html' if web else 'png'}"
    return options.out or pathlib.Path(name), web


class View(NamedTuple):
    """The lens and the scene that are shown.

    lens: the lens.
    fields: degrees; an empty list if neither options nor file give any, see `lit`.
    distance: of the object, mm.
    wavelengths, weights: wavelengths, um, of which the middle one is the reference, and weights.
    note: a line about fields and wavelengths of the file that are left out, or "".
    """

    lens: Lens
    fields: list[float]
    distance: float
    wavelengths: list[float]
    weights: list[float]
    note: str = ""

    @property
    def scene(self) -> Scene:
        """The scene of the fields, distance and wavelengths."""
        waves, weights = np.array(self.wavelengths), np.array(self.weights)
        shown = Scene.degrees(self.fields, self.distance, waves, wavelength_weights=weights)
        return checked_scene(self.lens, shown)

    def lit(self) -> "View":
        """The view with fields. If it has none, they are 0, 7 and 10 degrees, and the last two are
        halved until their throughput is at least half of that on the axis."""
        if self.fields:
            return self
        fields = np.array([0.0, 7.0, 10.0])
        for _ in range(_HALVINGS):
            ends = self._replace(fields=fields[[0, 2]].tolist()).scene
            axis, edge = (beam_of(self.lens, point).share for point in ends.each())
            if edge >= axis / 2:
                break
            fields = fields / 2
        return self._replace(fields=fields.tolist())


def view_of(options: argparse.Namespace) -> View:
    """The view that options and file give. Options override the values of a .zmx or .seq file."""
    fields, left = list[float](), list[str]()
    distance, waves = math.inf, list(_LINES)
    weights = {wave: 1.0 for wave in waves}
    if pathlib.Path(options.lens).suffix.lower() in OTHERS:
        system = load_system(options.lens, options.missing, options.configuration)
        lens, distance = system.lens, system.distance
        primary = float(system.wavelengths[system.primary])
        weights = dict(zip(map(float, system.wavelengths), map(float, system.wavelength_weights)))
        others = sorted({*weights} - {primary}, reverse=True)
        if len(others) >= _WAVES and options.wavelengths is None:
            left.append(f"wavelengths {', '.join(f'{w:.4g}' for w in others[1:-1])} um")
            others = [others[0], others[-1]]
        middle = (len(others) + 1) // 2
        waves = [*others[:middle], primary, *others[middle:]]
        angles = system.fields
        if angles is not None and not np.any(angles[:, 0]):
            every = (np.unique(np.round(np.degrees(angles[:, 1]), 12)) + 0.0).tolist()  # no -0
            fields = [angle for angle in every if abs(angle) < 90] or every
            if len(fields) < len(every) and options.field is None:
                left.append("fields of 90 degrees or more")
        elif options.field is None:
            warnings.warn("the file has no fields along y alone; give --field", stacklevel=2)
    else:
        lens = load_lens(options.lens, options.missing, options.configuration)
    distance = distance if options.distance is None else options.distance
    waves = options.wavelengths or waves
    shares = [weights.get(wave, 1.0) for wave in waves]
    note = f"  ! left out of what the file has: {'; '.join(left)}" if left else ""
    return View(lens, options.field or fields, distance, waves, shares, note)


def focus_lines(found: FirstOrder, wavelength: float, axial: Beam) -> Iterator[str]:
    """A warning if the spot on the axis shows that the sensor is out of focus."""
    airy = 1.22e-3 * wavelength * float(found.f_number)
    if axial.spot > max(_DEFOCUS * axial.best, airy):
        way = "further" if axial.shift > 0 else "nearer"
        yield (
            f"  ! out of focus on the axis: the spot of {1e3 * axial.spot:.2g} um is "
            f"{1e3 * axial.best:.2g} um with the sensor {abs(axial.shift):.2g} mm {way}; check the "
            "sensor and --distance"
        )


def field_rows(
    lens: Lens, scene: Scene, fields: list[float], beams: list[Beam]
) -> Iterator[tuple[str, ...] | str]:
    """A table with the spots of all points of a scene, with warnings as lines between its rows.

    fields: the fields in degrees.
    """
    wavelengths = np.asarray(scene.wavelengths).tolist()
    spots = [f"spot at {wavelength:.3f}" for wavelength in wavelengths]
    place, unit, size = ("angle", "mrad", "urad") if lens.afocal else ("height", "mm", "um")
    yield "field", f"image {place}", *spots, "transmitted", "limiting surfaces"
    yield "deg", unit, *(f"RMS {size}" for _ in spots), "%", ""
    middle, symmetry = scene.reference(None), symmetry_of(lens, scene.field)
    whole = not any(beam.clips for beam in beams)
    for field, point, beam in zip(fields, scene.each(), beams):
        try:
            rules = (_rule(lens, order, symmetry, whole) for order in _ORDERS)
            each = (psf_moments(lens, point, rule) for rule in rules)
            rough, found = jax.tree.map(np.asarray, (*each,))
        except ValueError as error:  # no light arrives in one of the wavelengths
            yield f"{field:.4g}", f"! {error}"
            continue
        light = 100 * float(found.throughput[middle])
        cut = "; ".join(filter(None, (", ".join(map(str, beam.clipping)), *beam.ends))) or "none"
        squares = [np.trace(m.covariance, axis1=1, axis2=2) for m in (found, rough)]
        sizes = [f"{1e3 * s:.4g}" if s > _NO_SIZE else "<1e-6" for s in np.sqrt(squares[0])]
        height = round(float(found.mean[middle, 1]), 9) + 0.0  # no -0
        yield f"{field:.4g}", f"{height:.5g}", *sizes, f"{light:.2f}", cut
        change = np.max(np.abs(squares[1] - squares[0]) / np.maximum(squares[0], _NO_SIZE**2)) / 2
        if change > _TOLERANCE:
            yield f"  ! these spots are known to {change:.1g} of their size only"
        for wavelength, part in zip(wavelengths, 100 * found.throughput):
            if f"{part:.2f}" != f"{light:.2f}":
                yield f"  ! at {wavelength:.4g} um {part:.2f} % of the light arrives"
        if ENDS[Status.CROSSED] in beam.ends:
            wide = np.where(np.isinf(lens.semi_diameter), 1.3 * beam.wide, lens.semi_diameter)
            where = crossed(dataclasses.replace(lens, semi_diameter=jnp.asarray(wide)))
            yield f"  ! rays that meet two surfaces in the wrong order do not arrive{where}"
        if field == 0 and f"{light:.2f}" != "100.00" and not (beam.obscured and not beam.ends):
            share = f"{100 - light:.2g} % of the light that fills the stop"
            yield f"  ! on the axis {share} is vignetted; limiting surfaces: {cut}"


_first_order = jit(first_order, ONCE)


def _rule(lens: Lens, order: int, symmetry: Symmetry, whole: bool) -> PupilRule:
    """A pupil rule. All orders share one compiled program.

    whole: True if the beam fills the stop.
    """
    if not whole:
        return Clipped(order, symmetry, _ORDERS[-1], may_cross(lens))
    points, weights = gauss_points(order, symmetry)
    more = gauss_points(_ORDERS[-1], symmetry)[1].size - weights.size
    return Pattern(np.pad(points, ((0, more), (0, 0))), np.pad(weights, (0, more)), symmetry)


def aperture_lines(lens: Lens, beams: list[Beam]) -> Iterator[str]:
    """Warnings of clear apertures so wide that they clip no ray."""
    needed = np.max([beam.wide for beam in beams], axis=0)
    for i, semi in enumerate(np.asarray(lens.semi_diameter)[:-1]):
        if math.isfinite(semi) and semi > 1.8 * needed[i] > 0:
            yield (
                f"  ! surface {i}: the light of these fields needs {needed[i]:.4g} mm of its "
                f"semi_diameter of {semi:g} mm, which stops nothing: is it a diameter?"
            )
