"""`python -m drt_jax show my_lens.yaml`: what a lens is, before anything is done with it; `convert`
writes a lens file in the format of another program; `glass N-BK7`: what a glass is; `check`:
whether this machine computes what it should."""

import argparse
import contextlib
import dataclasses
import json
import math
import os
import pathlib
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .check.run import kept_programs, machine, report, rows
from .check.truth import TRUTHS
from .compilation import ONCE, jit, keep_programs
from .files.load import lens_names, load_lens, load_system
from .files.write import save_lens
from .image.converged import psf_moments
from .image.diagnose import crossed
from .inputs import require
from .lens.lens import Lens
from .lens.order import may_cross
from .lens.paraxial import FirstOrder, first_order
from .lens.scene import Scene, checked_scene
from .pupil.clipped import Clipped
from .pupil.rules import Gauss, Pattern, PupilRule, Symmetry, gauss_points, symmetry_of
from .rays.status import Status
from .show import glasses
from .show.configurations import configuration_table, configurations
from .show.figures import new
from .show.layout import ENDS, Beam, beam_of
from .show.more import more_panels
from .show.page import Part, page
from .show.prescription import first_rows, prescription
from .show.sheet import panels, sheet

_LINES = (0.6562725, 0.5875618, 0.4861327)  # C, d, F
# Orders of the two rules for the spots; a larger relative difference of spot size is reported.
_ORDERS, _TOLERANCE = (14, 20), 1e-3
_MISSING = "warn: leave out what is unsupported and rays can go on without, with a warning"
_OTHERS = (".zmx", ".seq")
_DEFOCUS = 3.0  # a spot larger than this many times the smallest spot is out of focus
_WAVES = 5  # of more wavelengths of a file, the primary, longest and shortest are shown
_NO_SIZE = 1e-9  # mm, mrad: a smaller spot is only rounding error


def _options(argv: list[str] | None) -> argparse.Namespace:
    """The parsed command line."""
    parser = argparse.ArgumentParser(prog="python -m drt_jax", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="show, convert, glass or check")

    def command(name: str, run: Callable, about: str) -> argparse.ArgumentParser:
        added = commands.add_parser(name, help=about, description=about)
        added.set_defaults(run=run)
        return added

    about = (
        "first-order data, spots over the field, share of light, warnings, and a sheet of analyses"
    )
    show = command("show", run_show, about)
    names = ", ".join(lens_names())
    show.add_argument("lens", help=f".yaml, .zmx or .seq file, or a bundled name: {names}")
    own = "default: those of a .zmx or .seq file, else"
    ends = "default: those of a .zmx or .seq file with their weights, else"
    which = "number of a configuration or zoom position of a .zmx or .seq file, from 1"
    every = f"{which}; or all: their layouts under each other and a table of their numbers"
    show.add_argument("--configuration", type=configuration, help=every)
    show.add_argument("--field", type=float, nargs="+", help=f"degrees; {own} 0 7 10")
    show.add_argument("--distance", type=float, help=f"to the object, mm; {own} inf")
    show.add_argument("--wavelengths", type=float, nargs="+", help=f"um; {ends} C, d and F")
    show.add_argument("--missing", choices=("error", "warn"), default="error", help=_MISSING)
    show.add_argument("--html", action="store_true", help="a page of tables and figures instead")
    more = "a page with more figures, such as through-focus MTF and PSF; a minute longer"
    show.add_argument("--all", action="store_true", help=more)
    ends = "of the sheet or page; default: LENS.png or LENS.html here"
    show.add_argument("--out", type=pathlib.Path, help=ends)
    about = "write a lens as a file of another program; says what is not in it"
    convert = command("convert", run_convert, about)
    convert.add_argument("lens", help=".yaml, .zmx or .seq file, or a bundled name")
    convert.add_argument("out", type=pathlib.Path, help="file that ends in .yaml, .zmx or .seq")
    convert.add_argument("--configuration", type=int, help=which)
    convert.add_argument("--missing", choices=("error", "warn"), default="error", help=_MISSING)
    about = "index, Abbe number, partial dispersion, range and source of a glass, its neighbours"
    glasses.arguments(command("glass", lambda options: _write(glasses.told(options)), about))
    about = "eleven scenes against numbers of other programs; exit status 1 if one is wrong"
    check = command("check", run_check, about)
    check.add_argument("scenes", nargs="*", help=f"some of {', '.join(TRUTHS)}; default: all")
    check.add_argument("--json", type=pathlib.Path, help="a file for all of it, for a bug report")
    return parser.parse_args(argv)


def configuration(text: str) -> int | str:
    """The number of a configuration, or "all"."""
    return text if text == "all" else int(text)


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
    """A table of spots of the points of a scene, with warnings as lines between its rows.

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
            rough, found = (psf_moments(lens, point, rule) for rule in rules)
        except ValueError as error:  # no light arrives in one of the wavelengths
            yield f"{field:.4g}", f"! {error}"
            continue
        light = 100 * float(found.throughput[middle])
        cut = "; ".join(filter(None, (", ".join(map(str, beam.clipping)), *beam.ends))) or "none"
        squares = [np.trace(np.asarray(m.covariance), axis1=1, axis2=2) for m in (found, rough)]
        sizes = [f"{1e3 * s:.4g}" if s > _NO_SIZE else "<1e-6" for s in np.sqrt(squares[0])]
        height = round(float(found.mean[middle, 1]), 9) + 0.0  # no -0
        yield f"{field:.4g}", f"{height:.5g}", *sizes, f"{light:.2f}", cut
        change = np.max(np.abs(squares[1] - squares[0]) / np.maximum(squares[0], _NO_SIZE**2)) / 2
        if change > _TOLERANCE:
            yield f"  ! these spots are known to {change:.1g} of their size only"
        for wavelength, part in zip(wavelengths, 100 * np.asarray(found.throughput)):
            if f"{part:.2f}" != f"{light:.2f}":
                yield f"  ! at {wavelength:.4g} um {part:.2f} % of the light arrives"
        if ENDS[Status.CROSSED] in beam.ends:
            wide = np.where(np.isinf(lens.semi_diameter), 1.3 * beam.wide, lens.semi_diameter)
            where = crossed(dataclasses.replace(lens, semi_diameter=jnp.asarray(wide)))
            yield f"  ! rays that would have to step back do not arrive{where}"
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
    """Warnings of clear apertures that are so wide that they clip nothing."""
    needed = np.max([beam.wide for beam in beams], axis=0)
    for i, semi in enumerate(np.asarray(lens.semi_diameter)[:-1]):
        if math.isfinite(semi) and semi > 1.8 * needed[i] > 0:
            yield (
                f"  ! surface {i}: the light of these fields needs {needed[i]:.4g} mm of its "
                f"semi_diameter of {semi:g} mm, which stops nothing: is it a diameter?"
            )


def _row(first: str, *cells: str) -> str:
    """A row of a table as text."""
    *numbers, last = cells
    return f"{first:>6}" + "".join(f"{cell:>15}" for cell in numbers) + f"   {last}".rstrip()


def _write(lines: Iterable[tuple[str, ...] | str]) -> list[tuple[str, ...] | str]:
    """Writes each line, or row of a table, to stdout as soon as it is known, and returns them
    all.
    """
    written = []
    for line in lines:
        written.append(line)
        _print_line(line if isinstance(line, str) else _row(*line))
    return written


def _print_line(line: str) -> None:
    """Writes one line to stdout, in place of the current task."""
    _show_task("")
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _show_task(what: str) -> None:
    """Shows the current task on the last line of a terminal; writes nothing if stderr is not a
    terminal.
    """
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\033[K{what}")
        sys.stderr.flush()


def run_convert(options: argparse.Namespace) -> None:
    """Writes a lens in another format, and prints which data the new file leaves out."""
    read, write = (pathlib.Path(p).suffix.lower() in _OTHERS for p in (options.lens, options.out))
    load, given = load_system if read else load_lens, (options.lens, options.missing)
    whole = read and write and options.configuration is None  # with all configurations
    with _warnings_on_stdout():
        first = load(*given, 1 if whole else options.configuration)
        lens, count = (first, 1) if isinstance(first, Lens) else (first.lens, first.configurations)
        found = [first, *(load(*given, k + 1) for k in range(1, count if whole else 1))]
        save_lens(found, options.out)
    what = f"{len(found)} configurations, " if found[1:] else ""
    _write([f"{lens.name or 'the lens'}, {what}{lens.count} surfaces, is written to {options.out}"])


@contextlib.contextmanager
def _warnings_on_stdout() -> Iterator[None]:
    """Prints every warning as a line, once."""
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # each once
        warnings.showwarning = lambda message, *_, **__: _print_line(f"  ! {message}")
        yield


class _View(NamedTuple):
    """What is shown: a lens, fields in degrees, the distance in mm, wavelengths in um, the middle
    one of which is the reference, their weights, and a line on what of a file is left out, or "".
    """

    lens: Lens
    fields: list[float]
    distance: float
    wavelengths: list[float]
    weights: list[float]
    note: str = ""

    @property
    def scene(self) -> Scene:
        """The scene."""
        waves, weights = np.array(self.wavelengths), np.array(self.weights)
        shown = Scene.degrees(self.fields, self.distance, waves, wavelength_weights=weights)
        return checked_scene(self.lens, shown)


def _view(options: argparse.Namespace) -> _View:
    """What the options and a file ask for. Options override the values of a .zmx or .seq file."""
    fields, distance, waves, note = [0.0, 7.0, 10.0], math.inf, list(_LINES), ""
    weights = {wave: 1.0 for wave in waves}
    if pathlib.Path(options.lens).suffix.lower() in _OTHERS:
        system = load_system(options.lens, options.missing, options.configuration)
        lens, distance = system.lens, system.distance
        primary = float(system.wavelengths[system.primary])
        weights = dict(zip(map(float, system.wavelengths), map(float, system.wavelength_weights)))
        others = sorted({*weights} - {primary}, reverse=True)
        if len(others) >= _WAVES and options.wavelengths is None:
            left = ", ".join(f"{w:.4g}" for w in others[1:-1])
            note, others = (
                f"  ! wavelengths of the file left out: {left} um",
                [others[0], others[-1]],
            )
        middle = (len(others) + 1) // 2
        waves = [*others[:middle], primary, *others[middle:]]
        angles = system.fields
        if angles is not None and not np.any(angles[:, 0]):
            fields = np.unique(np.round(np.degrees(angles[:, 1]), 12)).tolist()
        elif options.field is None:
            warnings.warn("the file has no fields along y alone: --field 0 7 10", stacklevel=2)
    else:
        lens = load_lens(options.lens, options.missing, options.configuration)
    distance = distance if options.distance is None else options.distance
    waves = options.wavelengths or waves
    shares = [weights.get(wave, 1.0) for wave in waves]
    return _View(lens, options.field or fields, distance, waves, shares, note)


def run_show(options: argparse.Namespace) -> None:
    """Prints the data of a lens as they are computed, and draws its sheet."""
    if not all(abs(field) < 90 for field in options.field or ()):
        raise ValueError("--field: must be within 90 degrees")
    if options.configuration == "all":
        _show_all(options)
        return
    with _warnings_on_stdout():
        view = _view(options)
        lens, fields, distance, waves, _, note = view
        scene, middle = view.scene, waves[len(waves) // 2]
        found = jax.tree.map(lambda a: a.item(), _first_order(lens, distance, np.array([middle])))
        about = f"{lens.count} surfaces, stop: surface {lens.stop} (counted from 0)"
        first = [*first_rows(lens, found, middle)]
        _write([f"{lens.name}: {about}", *(f"  {name:<19}  {value}" for name, value in first)])
        _show_task("tracing; another kind of lens is compiled first, for half a minute or less")
        axial = beam_of(lens, Scene.point(0.0, distance, middle))
        beams = [beam_of(lens, point) for point in scene.each()]
        focus = [] if lens.afocal else focus_lines(found, middle, axial)
        notes = _write([*focus, *filter(None, [note]), ""])
        table = _write(field_rows(lens, scene, fields, beams))
        notes += _write(aperture_lines(lens, beams))
        web = options.html or options.all
        kind = ".html" if web else ".png"
        out = options.out or pathlib.Path(f"{pathlib.Path(options.lens).stem}{kind}")
        symmetry, cut = symmetry_of(lens, scene.field), any(beam.clips for beam in beams)
        rule = Clipped(8, symmetry, 8, may_cross(lens)) if cut else Gauss(8, symmetry)
        shown = lens, scene, rule, _show_task
        if web:
            rows = [row for row in table if not isinstance(row, str)]
            lines = [line for line in (*notes, *table) if isinstance(line, str) and line]
            parts: list[tuple[str, Part]] = [("First-order data", first), ("Spots and light", rows)]
            parts += [("Warnings", "\n".join(lines))] if lines else []
            used = np.max([beam.wide for beam in beams], axis=0)[:-1]
            parts += [*prescription(lens, used).items(), *panels(*shown).items()]
            parts += [*more_panels(lens, scene, _show_task).items()] if options.all else []
            out.write_text(page(f"{lens.name}: {about}", parts), encoding="utf-8")
        else:
            figure = sheet(*shown)
            figure.text(0.01, 0.01, note.strip(" !"), fontsize=7)
            figure.savefig(out)
    size = f", {out.stat().st_size / 1024:.0f} kB" if web else ""
    _write([f"drawn in {out}{size}"])


def _show_all(options: argparse.Namespace) -> None:
    """Prints a table of all configurations of a file, and draws them under each other."""
    path = pathlib.Path(options.lens)
    several = path.suffix.lower() in (".zmx", ".seq")
    require(several, f"--configuration all: {path.name} has one; expected a .zmx or .seq file")
    with _warnings_on_stdout():
        count = load_system(path, options.missing, 1).configurations
        each = [vars(options) | {"configuration": k} for k in range(1, count + 1)]
        views = [_view(argparse.Namespace(**own)) for own in each]
        lenses, scenes = [view.lens for view in views], [view.scene for view in views]
        title = f"{lenses[0].name or path.stem}: {count} configurations"
        rows = _write([title, *configuration_table(lenses, scenes)])[1:]
        figure, axes = new(count, width=6.5, height=2.4)
        configurations([*np.ravel(axes)], lenses, scenes)
    web = options.html or options.all
    out = options.out or path.with_suffix(".html" if web else ".png").name
    parts: list[tuple[str, Part]] = [("Configurations", rows), ("Layouts", figure)]
    if web:
        pathlib.Path(out).write_text(page(title, parts), encoding="utf-8")
    else:
        figure.savefig(out)
    _write([f"drawn in {out}"])


def run_check(options: argparse.Namespace) -> None:
    """Compares the scenes with their truth, prints a table, and exits with 1 if one is wrong."""
    names = options.scenes or [*TRUTHS]
    if unknown := [name for name in names if name not in TRUTHS]:
        raise ValueError(f"scenes: no {unknown[0]!r}; known: {', '.join(TRUTHS)}")
    began, about, kept = time.perf_counter(), machine(), kept_programs()
    _write([*(f"{name:<11} {value}" for name, value in about.items()), ""])
    _show_task("compiling and comparing: up to a minute and a half if nothing is kept")
    found = [*rows(names)]
    head = f"{'scene':<9}{'compared':<49}{'error':>8} {'allowed':<19}"
    _write([f"{head}{'first s':>7}{'again ms':>10}{'usual':>7}"])
    for row in found:
        truth = TRUTHS[row.name]
        line = f"{row.name:<9}{truth.about:<49}"
        if row.error is None:
            _write([f"{line}  FAILED", f"  ! {row.message}"])
            continue
        allowed = f"{truth.allowed:.1e} {truth.unit}"
        times = f"{row.first:>7.1f}{row.again:>10.2g}{truth.usual:>7g}"
        _write([f"{line}{row.error:>8.1e} {allowed:<19}{times}  {'ok' if row.right else 'WRONG'}"])
        if not row.right:
            _write([f"  ! expected: {truth.source}; allowed: {truth.why}"])
    seconds, right = time.perf_counter() - began, sum(row.right for row in found)
    new = "" if kept is None else f", {(kept_programs() or 0) - kept} programs compiled and kept"
    _write(["", f"{right} of {len(found)} scenes are right, in {seconds:.0f} s{new}"])
    if options.json:
        text = json.dumps(report(found, about, seconds), indent=2)
        options.json.write_text(text + "\n", encoding="utf-8")
    if right < len(found):
        raise SystemExit(1)


def set_up() -> None:
    """Changes settings that a library must not change.

    It enables float64, and keeps compiled programs if there is a folder for them.
    """
    jax.config.update("jax_enable_x64", True)
    with contextlib.suppress(OSError):
        keep_programs()


def main(argv: list[str] | None = None) -> None:
    """Runs the command line. An error prints one line; exit status 2, 1 (file) or 130 (Ctrl-C)."""
    try:
        set_up()
        options = _options(argv)
        options.run(options)
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        raise SystemExit(130) from None
    except ValueError as error:
        sys.stderr.write(f"error: {error}\n")
        raise SystemExit(2) from None
    except BrokenPipeError:  # the reader, such as `head`, has enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:
        place = f"{error.filename}: " if error.filename else ""
        sys.stderr.write(f"error: {place}{error.strerror}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
