"""`python -m drt_jax show my_lens.yaml`: what a lens is, before anything is done with it."""

import argparse
import math
import os
import pathlib
import sys
import warnings
from collections.abc import Iterator

import jax
import numpy as np

from .files.yaml import lens_names, load_lens
from .image.converged import psf_moments
from .lens.lens import Lens
from .lens.paraxial import first_order
from .pupil import hexapolar
from .rays.status import Status
from .rays.trace import trace_rays

_RINGS = 10  # of the rays by which apertures are judged
_LINES = (0.6562725, 0.5875618, 0.4861327)  # C, d, F


def _options(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m drt_jax", description=__doc__)
    commands = parser.add_subparsers(required=True, metavar="show")
    about = "first-order data, spots over the field, share of light, warnings, and a drawing"
    show = commands.add_parser("show", help=about, description=about)
    show.add_argument("lens", help=f"YAML file or bundled name: {', '.join(lens_names())}")
    show.add_argument("--field", type=float, nargs="+", default=[0, 7, 10], help="degrees")
    show.add_argument("--distance", type=float, default=math.inf, help="to the object, mm")
    show.add_argument("--wavelengths", type=float, nargs="+", default=_LINES, help="um")
    show.add_argument("--out", type=pathlib.Path, help="of the drawing; default: LENS.png here")
    options = parser.parse_args(argv)
    if not all(abs(field) < 90 for field in options.field):
        raise ValueError("--field: must be within 90 degrees")
    if not options.distance > 0:
        raise ValueError("--distance: must be above 0 mm")
    return options


def first_lines(lens: Lens, distance: float, wavelength: float) -> Iterator[str]:
    """First-order data of a lens at one wavelength in um, and what is odd about them."""
    found = jax.tree.map(lambda a: float(a[0]), first_order(lens, distance, np.array([wavelength])))
    image, sensor = found.image_distance, float(lens.sensor)
    yield f"{lens.name}: {lens.count} surfaces, the stop is number {lens.stop}"
    yield f"  wavelength           {wavelength:g} um"
    air = found.effective_focal_length
    air = "" if math.isclose(air, abs(found.focal_length)) else f" ({air:.6g} mm in air)"
    yield f"  focal length         {found.focal_length:.6g} mm{air}, f/{found.f_number:.4g}"
    yield f"  back focal distance  {found.back_focal_distance:.6g} mm"
    for name, image_of in (("entrance", found.entrance_pupil), ("exit    ", found.exit_pupil)):
        width = 2 * image_of.semi_diameter
        yield f"  {name} pupil       {width:.5g} mm wide, at {image_of.position:.5g} mm"
    yield f"  sensor               {sensor:.6g} mm from the first vertex, focus at {image:.6g} mm"
    if abs(image - sensor) > 0.05 * abs(found.focal_length):
        yield "  ! the sensor is far from the focus; is this the distance of the object?"


def field_lines(
    lens: Lens, fields: list[float], distance: float, wavelengths: list[float]
) -> Iterator[str]:
    """A table of spots over fields in degrees, and what is odd about it."""
    spots = [f"spot at {colour:.3f}" for colour in wavelengths]
    yield _row("field", "image height", *spots, "light", "cut by surface")
    yield _row("deg", "mm", *("RMS um" for _ in spots), "%")
    for field in fields:
        try:
            found = psf_moments(lens, math.radians(field), distance, np.array(wavelengths), 1e-3)
        except ValueError as error:
            yield _row(f"{field:.4g}", f"  ! {error}")
            continue
        middle = len(wavelengths) // 2
        mean, passed = float(found.mean[middle, 1]), float(found.passed[middle])
        squares = np.trace(np.asarray(found.covariance), axis1=1, axis2=2)
        spots = [f"{1e3 * math.sqrt(square):.4g}" for square in squares]
        cut = stopping(lens, field, distance, wavelengths[middle])[1]
        where = ", ".join(map(str, cut)) or "none"
        yield _row(f"{field:.4g}", f"{mean:.5g}", *spots, f"{100 * passed:.2f}", where)
        if field == 0 and passed < 0.999:
            yield "  ! on the axis other apertures than the stop cut the beam"


def stopping(
    lens: Lens, field: float, distance: float, wavelength: float
) -> tuple[np.ndarray, np.ndarray]:
    """How far (S + 1,) in mm from the vertices the light of a field in degrees comes that arrives,
    and the surfaces whose apertures are the first to stop some; of rays that fill the stop.
    """
    from .show.layout import local_hits, outside

    filling = hexapolar(_RINGS)[0].T
    rays = trace_rays(lens, math.radians(field), distance, wavelength, filling)
    points, status = np.asarray(rays.points[0]), np.asarray(rays.status[0])
    clipped, arrived = (points[status == s] for s in (Status.CLIPPED, Status.OK))
    wide = np.linalg.norm(local_hits(lens, arrived), axis=-1)
    return np.max(wide, axis=0, initial=0.0), np.unique(np.argmax(outside(lens, clipped), axis=1))


def aperture_lines(
    lens: Lens, fields: list[float], distance: float, wavelength: float
) -> Iterator[str]:
    """Clear apertures that stop nothing, as wide as they are."""
    needed = np.max([stopping(lens, f, distance, wavelength)[0] for f in fields], axis=0)
    for i, semi in enumerate(np.asarray(lens.semi_diameter)[:-1]):
        if math.isfinite(semi) and semi > 1.8 * needed[i] > 0:
            yield (
                f"  ! surface {i}: the light of these fields needs {needed[i]:.4g} mm of its "
                f"semi_diameter of {semi:g} mm, which stops nothing: is it a diameter?"
            )


def _row(first: str, *cells: str) -> str:
    return f"{first:>6}" + "".join(f"{cell:>16}" for cell in cells)


def show(options: argparse.Namespace) -> None:
    """Print what a lens is, and draw it."""
    from .show.figures import new
    from .show.layout import draw, lens_drawing

    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        lens = load_lens(options.lens)
        waves = list(options.wavelengths)
        lines = [*first_lines(lens, options.distance, waves[len(waves) // 2]), ""]
        lines += field_lines(lens, options.field, options.distance, waves)
        middle = waves[len(waves) // 2]
        lines += aperture_lines(lens, options.field, options.distance, middle)
    lines += [f"  ! {warning.message}" for warning in said]
    out = options.out or pathlib.Path(f"{pathlib.Path(options.lens).stem}.png")
    figure, axes = new(width=9, height=4)
    angles = [math.radians(field) for field in options.field]
    lens_drawing(axes, draw(lens, angles, options.distance))
    figure.savefig(out)
    sys.stdout.write("\n".join([*lines, f"drawn in {out}", ""]))


def set_up() -> None:
    """What a command line chooses, and a library does not: float64, and compiled programs kept in
    JAX_COMPILATION_CACHE_DIR or the user's cache."""
    jax.config.update("jax_enable_x64", True)
    if not jax.config.values["jax_compilation_cache_dir"]:
        home = os.environ.get("XDG_CACHE_HOME") or pathlib.Path.home() / ".cache"
        jax.config.update("jax_compilation_cache_dir", str(pathlib.Path(home) / "drt_jax"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)


def main(argv: list[str] | None = None) -> None:
    """Run the command line; errors are one line, and the exit status 2, or 130 after Ctrl-C."""
    try:
        set_up()
        show(_options(argv))
    except KeyboardInterrupt:
        sys.stderr.write("stopped\n")
        raise SystemExit(130) from None
    except ValueError as error:
        sys.stderr.write(f"error: {error}\n")
        raise SystemExit(2) from None
    except OSError as error:
        sys.stderr.write(f"error: {error.filename}: {error.strerror}\n")
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
