"""A lens as rows of tables: its first-order data, and the prescription, from which it can be typed
in again."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from ..lens.forms import FORMS
from ..lens.lens import Lens
from ..lens.paraxial import FirstOrder

Row = tuple[str, ...]


def first_rows(lens: Lens, found: FirstOrder, wavelength: float) -> Iterator[tuple[str, str]]:
    """The first-order data of a lens at one wavelength, um: names and values."""
    yield "wavelength", f"{wavelength:g} um"
    air = float(found.effective_focal_length)
    both = "" if math.isclose(air, abs(found.focal_length)) else f" ({air:.6g} mm in air)"
    yield "focal length", f"{found.focal_length:.6g} mm{both} (EFL)"
    yield "working f-number", f"f/{found.f_number:.4g}"
    yield "back focal length", f"{found.back_focal_distance:.6g} mm (BFL)"
    for name, image_of, end in (
        ("entrance pupil", found.entrance_pupil, "first"),
        ("exit pupil", found.exit_pupil, "last"),
    ):
        place = f"at {image_of.position + 0.0:.5g} mm from the {end} vertex"
        yield name, f"diameter {2 * image_of.semi_diameter:.5g} mm, {place}"
    size = 2 * np.asarray(lens.semi_diameter)[lens.stop]
    yield "stop", f"surface {lens.stop}, diameter {size:.5g} mm"
    yield "sensor", f"{float(lens.sensor):.6g} mm from the first vertex (total track)"
    if lens.afocal:
        far = float(found.image_distance) - float(lens.vertices[-2])
        vergence = f"{1e3 / far if far else math.inf:.4g} dioptres behind the last vertex"
        yield "vergence", f"{vergence}, 0 for collimated light"
    else:
        yield "paraxial focus", f"{found.image_distance:.6g} mm from the first vertex"


def prescription(lens: Lens, used: Sequence[float] = ()) -> dict[str, list[Row]]:
    """The tables of a lens by title, their header first: surfaces; and, where there are any,
    coefficients of aspheres and other forms by power, tilts and decentres, groups that move
    together, apertures that are no circles about the vertex, and phases.

    used: (S,), mm, largest distances of rays from the vertices; () for none.
    """
    tables = {
        "Surfaces": [*_surfaces(lens, used)],
        "Coefficients of the sag (mm and its powers)": [*_coefficients(lens)],
        "Decentres and tilts": [*_places(lens)],
        "Groups of surfaces": [*_groups(lens)],
        "Apertures and obscurations": [*_apertures(lens)],
        "Diffractive surfaces (waves / mm^power)": [*_phases(lens)],
    }
    return {title: rows for title, rows in tables.items() if len(rows) > 1}


def _surfaces(lens: Lens, used: Sequence[float]) -> Iterator[Row]:
    extra = ["used semi-diameter mm"] if len(used) else []
    yield (
        "surface",
        "radius mm",
        "thickness mm",
        "medium",
        "conic",
        "clear semi-diameter mm",
        *extra,
    )
    gaps = [*np.asarray(lens.thickness), float(lens.sensor - lens.vertices[-2])]
    numbers = zip(*map(np.asarray, (lens.curvature, lens.conic, lens.semi_diameter)))
    for i, ((curvature, conic, semi), gap) in enumerate(zip(numbers, gaps)):
        radius = f"{1 / curvature:.9g}" if curvature else "plane"
        name = f"{i}, stop" if i == lens.stop else str(i)
        clear = f"{semi:.6g}" if np.isfinite(semi) else "none"
        own = [f"{used[i]:.4g}"] if len(used) else []
        yield name, radius, f"{gap:.9g}", _medium(lens, i), f"{conic:.9g}", clear, *own
    curvature, conic = (float(np.asarray(a)[-1]) for a in (lens.curvature, lens.conic))
    if curvature:
        yield "sensor", f"{1 / curvature:.9g}", "", "", f"{conic:.9g}", "", *([""] * len(extra))


def _medium(lens: Lens, i: int) -> str:
    """The medium behind a surface: a mirror, the name of a glass, or nd, vd and, where it is not on
    the normal line, the deviation of the partial dispersion of a model glass."""
    name = lens.glasses[i + 1]
    if lens.mirrors[i]:
        return "mirror"
    if not name.startswith("model "):
        return name
    nd, vd, dPgF, *_ = [*map(float, name.split()[1:]), 0.0]
    more = f", dPgF {dPgF:.5f}" if abs(dPgF) > 5e-6 else ""
    return f"nd {nd:.5f}, vd {vd:.5g}{more}"


def _written(form: str, values: np.ndarray) -> str:
    """The coefficients (K,) of a form that are not 0, by power or name."""
    names = [*FORMS[form].named, *map(str, FORMS[form].powers)]
    return "; ".join(f"{name}: {value:.9g}" for name, value in zip(names, values) if value)


def _coefficients(lens: Lens) -> Iterator[Row]:
    values = np.asarray(lens.coefficients)
    yield "surface", "form", "coefficients by power"
    for i in np.flatnonzero(np.any(values, axis=1)):
        form = lens.forms[i]
        name = "sensor" if i == lens.count else str(i)
        yield name, form.replace("_", " "), _written(form, values[i])


def _places(lens: Lens) -> Iterator[Row]:
    yield "surface", "decentre x, y mm", "tilt about x, y, z degrees"
    none = np.zeros((lens.count + 1, 1))
    moved, tilted = (
        none * np.ones(size) if a is None else np.asarray(a)
        for a, size in ((lens.decentre, 2), (lens.tilt, 3))
    )
    for i in np.flatnonzero(np.any(moved, axis=1) | np.any(tilted, axis=1)):
        both = (", ".join(f"{v:.9g}" for v in row) for row in (moved[i], np.degrees(tilted[i])))
        yield "sensor" if i == lens.count else str(i), *both


def _groups(lens: Lens) -> Iterator[Row]:
    yield "surfaces", "shift x, y, z mm", "tilt about x, y, z degrees", "pivot"
    if (own := lens.elements) is None:
        return
    rows = zip(own.spans, own.about, *map(np.asarray, (own.shift, own.tilt, own.pivot)))
    for (first, last), about, shift, tilt, pivot in rows:
        both = (", ".join(f"{v:.9g}" for v in row) for row in (shift, np.degrees(tilt)))
        yield f"{first} to {last}", *both, f"{pivot:.9g} mm behind surface {about}"


def _apertures(lens: Lens) -> Iterator[Row]:
    yield "surface", "kind", "half widths x, y mm", "centre x, y mm"
    if (own := lens.apertures) is None:
        return
    centres = np.zeros((len(own.kinds), 2)) if own.centre is None else np.asarray(own.centre)
    for i, kind, blocks, *pairs in zip(
        own.surfaces, own.kinds, own.blocks, np.asarray(own.sizes), centres
    ):
        both = (", ".join(f"{v:.9g}" for v in pair) for pair in pairs)
        yield str(i), f"{kind}, {'obscuration' if blocks else 'aperture'}", *both


def _phases(lens: Lens) -> Iterator[Row]:
    yield "surface", "form", "order", "coefficients by power"
    if lens.phase is None:
        return
    values, orders = map(np.asarray, (lens.phase.coefficients, lens.phase.order))
    for i, form, row, order in zip(lens.phase.surfaces, lens.phase.forms, values, orders):
        yield str(i), form.replace("_", " "), f"{order:g}", _written(form, row)
