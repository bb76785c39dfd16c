"""`python -m drt_jax glass NAME`: data of a glass, its neighbours, and the glass map."""

import argparse
import pathlib
from collections.abc import Collection, Iterator, Sequence

import numpy as np
from matplotlib.axes import Axes

from ..lens.glass import FRAUNHOFER, NORMAL_LINE, Glass
from ..lens.glasses import find_glass, indices, map_point, near_names, nearest_glasses
from .figures import new

_NEAR, _ALL = 6, 10_000  # most glasses in a list, and in the map


def arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command line."""
    parser.add_argument("name", nargs="?", help="as the maker writes it, or NAME_MAKER")
    parser.add_argument("--near", metavar="ND,VD", help="glasses next to these in the glass map")
    parser.add_argument("--makers", nargs="+", help="of neighbours, such as SCHOTT OHARA")
    parser.add_argument("--plot", type=pathlib.Path, metavar="FILE.png", help="the glass map")


def output(options: argparse.Namespace) -> Iterator[str]:
    """Lines of output of the command, which also writes the map. ValueError for wrong options."""
    if (options.name is None) == (options.near is None):
        raise ValueError("give the name of a glass or --near ND,VD, one of both")
    if options.near is None:
        glass = find_glass(options.name)
        yield from glass_lines(glass)
        point, name = map_point(glass), glass.name
    else:
        point, name = _pair(options.near), ""
    if point is not None:
        around = nearest_glasses(*point, options.makers, _NEAR + 1)
        yield f"  near in nd and vd    {'distance':>9} {'nd':>9} {'vd':>6}  maker     name"
        for near in [near for near in around if near.glass.name != name][:_NEAR]:
            numbers = f"{near.distance:9.6f} {near.nd:9.6f} {near.vd:6.2f}"
            yield f"{'':23}{numbers}  {near.glass.maker or '-':<9} {near.glass.name}"
    if options.plot:
        if point is None:
            raise ValueError(f"--plot: {name} is not known at the lines F and C")
        figure, axes = new(1, 1, 9, 6)
        glass_map(axes, point, name or options.near, options.makers)
        figure.savefig(options.plot)
        yield f"drawn in {options.plot}"


def _pair(text: str) -> tuple[float, float]:
    try:
        nd, vd = map(float, text.split(","))
    except ValueError:
        nd = vd = np.nan
    if not (1 < nd <= 4 and 0 < vd <= 200):
        raise ValueError(f"--near: expected ND,VD as in 1.6204,60.3, got {text[:40]!r}")
    return nd, vd


def glass_lines(glass: Glass) -> Iterator[str]:
    """Lines with the data of a glass of the table."""
    yield f"{glass.name}{f' ({glass.maker})' if glass.maker else ''}"
    low, high = glass.range
    lines = {f"{name}, {1e3 * w:.2f} nm": w for name, w in zip("dFCg", FRAUNHOFER, strict=True)}
    known = {name: w for name, w in lines.items() if low <= w <= high}
    known = known or {f"{w:g} um": w for w in (low, (low + high) / 2, high)}
    found = indices(glass, np.array([*known.values()])).tolist()
    yield from (f"  n at {name:<15} {n:.7f}" for name, n in zip(known, found, strict=True))
    point = map_point(glass)
    if point is not None:
        yield f"  Abbe number vd       {point[1]:.2f}"
    if point is not None and len(found) == 4:
        partial = (found[3] - found[1]) / (found[1] - found[2])
        above = partial - NORMAL_LINE[0] - NORMAL_LINE[1] * point[1]
        yield f"  P_gF                 {partial:.4f}, {above:+.4f} from the normal line"
    yield f"  range                {low:g} to {high:g} um"
    expansion = "not known" if glass.expansion is None else f"{glass.expansion:g}e-6/K, -30 to 70 C"
    yield f"  expansion            {expansion}; dn/dT {'known' if glass.thermal else 'not known'}"
    yield f"  status               {glass.status or 'not known'}"
    yield f"  source               {glass.source or 'none'}"
    near = [name for name in near_names(glass.name, _NEAR + 1) if name != glass.name]
    yield f"  near in spelling     {', '.join(near[:_NEAR])}"


def glass_map(
    axes: Axes, point: Sequence[float], name: str, makers: Collection[str] | None = None
) -> Axes:
    """Plot nd over vd of the glasses of the table, with a mark at one point.

    point: nd and vd of the mark. name: label of the mark. makers: of the glasses; None for all.
    """
    found = nearest_glasses(point[0], point[1], makers, _ALL)
    for maker in sorted({near.glass.maker for near in found}):
        own = np.array([(near.vd, near.nd) for near in found if near.glass.maker == maker])
        axes.plot(*own.T, ".", markersize=4, label=maker or "substances")
    axes.plot(point[1], point[0], "k+", markersize=14)
    axes.annotate(name, (point[1], point[0]), (8, 8), textcoords="offset points", weight="bold")
    axes.set(xlabel="Abbe number vd", ylabel="index nd")
    axes.invert_xaxis()
    axes.legend(fontsize=8)
    return axes
