"""Sensitivity of a lens to each error alone, as a table; and the sizes of errors for a drop."""

import csv
import dataclasses
import os
from typing import NamedTuple

import numpy as np

from ..inputs import require
from ..numerics import Numbers
from .assembly import Assembly, Given
from .configurations import AnyProblem
from .deviations import KINDS
from .perturbed import Deviation, PerturbedLens
from .tolerance import Predicted, monte_carlo

# Operands in units other than mm or none: a factor and the unit in which a table shows them.
_UNITS = {
    **dict.fromkeys(("spot", "spot_of_colours", "spot_chief", "rms_spot"), (1e3, "um")),
    **dict.fromkeys(("centroid", "lateral_colour"), (1e3, "um")),
    **dict.fromkeys(("path_difference", "rms_wavefront"), (1.0, "waves")),
    "distortion": (100.0, "%"),
    "chief_ray_angle": (180 / np.pi, "deg"),
}
_AT = {"mtf": " at {:g} cycles/mm", "encircled_energy": " within {:g} mm"}
_FOCUS = (("sensor", "mm"), ("sensor tilt x", "rad"), ("sensor tilt -y", "rad"))
_TRIALS = 5  # of each size by rays, after the parabola
_GRID = 400  # sizes at which the parabola is evaluated
_STEEPEST = 0.5, 4.0  # powers of the size with which a drop grows, at least and at most


class Sensitivity(NamedTuple):
    """Change of the criterion of an `Assembly` by each error alone; prints as a table.

    criterion: name of the criterion.
    unit, factor: unit in which the table shows the criterion, and the factor from its own unit.
    nominal: the criterion without errors.
    target: target of the criterion; a lens is better if its criterion is nearer to it.
    deviations: the P errors.
    sizes: (P,), in the units of `Tolerance`.
    before: (P, 2), change of the criterion at minus and plus the size, with all adjustments held.
    after: (P, 2), change after compensation; infinite where rays fail.
    moves: (P, 2, C), changes of the adjustments.
    adjustments: C pairs of a name and a unit.
    by: "rays" for traced lenses, "second derivatives" for a prediction.
    each: (P, 2, Z), `after` for each of several configurations; None for a single one and for a
        prediction.
    """

    criterion: str
    unit: str
    factor: float
    nominal: float
    target: float
    deviations: tuple[Deviation, ...]
    sizes: np.ndarray
    before: np.ndarray
    after: np.ndarray
    moves: np.ndarray
    adjustments: tuple[tuple[str, str], ...]
    by: str
    each: np.ndarray | None = None

    @property
    def growth(self) -> np.ndarray:
        """Increase (P,) of the distance of the criterion from its target, after compensation, for
        the worse sign of each error.
        """
        off = abs(self.nominal - self.target)
        return np.max(np.abs(self.nominal + self.after - self.target) - off, axis=1)

    def worst(self, count: int | None = None) -> "Sensitivity":
        """The errors with the largest `growth`, largest first.

        count: number of errors; None for all.
        """
        order = np.argsort(-self.growth, kind="stable")[:count]
        names = "sizes", "before", "after", "moves", *(() if self.each is None else ("each",))
        arrays = {name: getattr(self, name)[order] for name in names}
        return self._replace(deviations=tuple(self.deviations[k] for k in order), **arrays)

    def rows(self) -> list[list[str]]:
        """The table, worst error first: a line of headings, and a line for each error."""
        some, unit = self.worst(), f" ({self.unit})" if self.unit else ""
        changes = (f"{when} {sign}{unit}" for when in ("before", "after") for sign in "-+")
        moved = (f"{name} ({unit})" for name, unit in self.adjustments)
        each = np.zeros((len(some.sizes), 2, 0)) if some.each is None else some.each
        worse = (f"in configuration {number}{unit}" for number in range(1, each.shape[2] + 1))
        rows = [["error", "size", *changes, *worse, *moved]]
        for k, deviation in enumerate(some.deviations):
            size = f"{some.sizes[k]:.4g} {KINDS[deviation.kind].unit}".strip()
            largest = np.argmax(np.abs(each[k]), axis=0), range(each.shape[2])
            both = self.factor * np.concatenate([some.before[k], some.after[k], each[k][largest]])
            words = (f"{change:+.4g}" if np.isfinite(change) else "fails" for change in both)
            most = (f"{move:.3g}" for move in np.max(np.abs(some.moves[k]), axis=0, initial=0))
            rows.append([str(deviation), size, *words, *most])
        return rows

    def csv(self, path: str | os.PathLike) -> None:
        """Writes the table as comma-separated values.

        path: of the file.
        """
        with open(path, "w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(self.rows())

    def __str__(self) -> str:
        nominal = f"{self.factor * self.nominal:.4g} {self.unit}".strip()
        rows = self.rows()
        widths = [max(map(len, column)) for column in zip(*rows)]
        first = f"{self.criterion}: {nominal} without errors; changes by {self.by}"
        cells = ([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])] for row in rows)
        return "\n".join([first, *map("  ".join, cells)])


def sensitivity(
    problem: AnyProblem,
    perturbed: PerturbedLens,
    compensator: Given = "focus",
    predicted: Predicted | None = None,
) -> Sensitivity:
    """Change of the criterion by each error alone, at plus and minus its size.

    problem: gives the fields, wavelengths and pupil rule; or `Configurations`, over which the
        criterion is the mean. The table also has the change in each configuration, for the worse
        sign.
    perturbed: the lens and its errors.
    compensator: as in `as_built`; an `Assembly` has another criterion than spots.
    predicted: result of `predict` for the same arguments; the table is then computed from second
        derivatives, and no ray is traced.

    ValueError as in `as_built`, and for a lens that fails without errors.
    """
    assembly = Assembly.of(compensator).placed(problem, perturbed.lenses, perturbed.beam_radius)
    count = len(perturbed.deviations)
    ends = np.concatenate([-np.eye(count), np.eye(count), np.zeros((1, count))])
    if predicted is None:
        built = monte_carlo(problem, perturbed, ends, assembly)
        moves, each = np.asarray(built.moves), np.asarray(built.each)
        values = held = np.asarray(built.value)
        if moves.shape[1]:
            fixed = dataclasses.replace(assembly, held=built.moves[-1])
            held = np.asarray(monte_carlo(problem, perturbed, ends, fixed).value)
    else:
        both = [predicted, predicted.before or predicted]
        values, held = (np.asarray(assembly.value(m.at(ends, "second"))) for m in both)
        moves = ends @ np.asarray(predicted.move_slopes)
        each = np.zeros((len(ends), 0))
    figure, parts = assembly.figure, assembly.parts
    factor, unit = _UNITS.get(figure.name, (1.0, ""))
    named = _names_of_focus(moves.shape[1], 1 + len(perturbed.others))
    if parts is not None:
        named = tuple((str(one), KINDS[one.kind].unit) for one in parts.deviations)
    values, held, moves = (np.asarray(array, float) for array in (values, held, moves))
    _require_nominal(float(values[-1]))
    changes = (held - values[-1], values - values[-1], moves - moves[-1], each - each[-1])
    pairs = (np.stack([a[:count], a[count : 2 * count]], axis=1) for a in changes)
    before, after, shifts, each = pairs
    return Sensitivity(
        figure.name.replace("_", " ") + _AT.get(figure.name, "").format(figure.at),
        unit,
        factor,
        float(values[-1]),
        0.0 if assembly.of_squares else float(figure.target),
        perturbed.deviations,
        np.asarray(perturbed.sizes, float),
        before,
        after,
        shifts,
        named,
        "rays" if predicted is None else "second derivatives",
        each if perturbed.others and predicted is None else None,
    )


def _names_of_focus(count: int, configurations: int) -> tuple[tuple[str, str], ...]:
    """Names and units of `count` adjustments of the sensor, of each configuration or of all."""
    if configurations == 1 or count <= 1:
        return _FOCUS[:count]
    own = _FOCUS[: count // configurations]
    numbers = range(1, configurations + 1)
    return tuple((f"{name} of configuration {k}", unit) for k in numbers for name, unit in own)


def inverse_sensitivity(
    problem: AnyProblem,
    perturbed: PerturbedLens,
    compensator: Given,
    drop: float,
    most: float = 10.0,
) -> PerturbedLens:
    """The lens with other sizes of its errors: each alone worsens the criterion by `drop`.

    A parabola through three traced lenses gives the size of each error, in the worse direction; a
    few traced lenses correct it. Components x and y of one part get the smaller size. Pass the
    result to `sensitivity` for a table. For a budget of N parts that add as a root sum of squares,
    use the whole drop divided by N ** 0.5.

    problem, perturbed, compensator: as in `sensitivity`.
    drop: allowed change of the criterion after compensation, above 0, in its own unit (mm for
        spots).
    most: largest factor by which a size may grow. An error whose change is still below the drop
        there gets this size.

    ValueError as in `as_built`, for a lens that fails without errors, and for a drop or a factor
    that is not above 0.
    """
    require(0 < drop < np.inf, f"drop: must be above 0 and finite, got {drop:g}")
    require(0 < most < np.inf, f"most: must be above 0 and finite, got {most:g}")
    assembly = Assembly.of(compensator).placed(problem, perturbed.lenses, perturbed.beam_radius)
    signs, count = np.array([-1.0, 1.0]), len(perturbed.deviations)
    bounds = [KINDS[deviation.kind].most for deviation in perturbed.deviations]
    top = np.minimum(most, 0.99 * np.array(bounds) / np.asarray(perturbed.sizes))[:, None]

    def growths(sizes: np.ndarray) -> np.ndarray:
        """Loss beyond that without errors (P, 2), at sizes (P, 2) to both sides."""
        rows = [np.diag(side) for side in (signs * sizes).T]
        built = monte_carlo(problem, perturbed, np.concatenate([*rows, zero]), assembly)
        _require_nominal(float(built.value[-1]))
        loss = np.asarray(assembly.loss(built.value))
        return (loss[:-1] - loss[-1]).reshape(2, count).T

    zero = np.zeros((1, count))
    size = np.minimum(np.ones((count, 2)), top)
    low, high = np.zeros_like(size), np.broadcast_to(top, size.shape)
    old, fell = size, growths(size)
    size = _parabola_sizes(old, fell, top, drop)
    for _ in range(_TRIALS):
        found = growths(size)
        low = np.where(found < drop, np.maximum(low, size), low)
        high = np.where(found >= drop, np.minimum(high, size), high)
        with np.errstate(divide="ignore", invalid="ignore"):
            power = np.log(found / fell) / np.log(size / old)
            power = np.clip(np.where(np.isfinite(power), power, 1.0), *_STEEPEST)
            new = size * (drop / np.maximum(found, 1e-3 * drop)) ** (1 / power)
        middle = np.where(low > 0, np.sqrt(low * high), high / 4)
        inside = (new > low) & (new < high) & np.isfinite(found)
        old, fell = size, found
        size = np.where(found == drop, size, np.where(inside, new, middle))
        size = np.where(low >= top, top, size)
    least = np.min(size, axis=1)
    for part in perturbed.parts:
        least[part] = np.min(least[part])
    return dataclasses.replace(
        perturbed, sizes=perturbed.sizes * least.astype(perturbed.sizes.dtype)
    )


def _require_nominal(value: float) -> None:
    """ValueError unless the criterion of the lens without errors is finite."""
    lost = "problem: without errors rays of the lens fail or no light of a field arrives"
    require(np.isfinite(value), f"{lost}: give smaller fields, or a smaller stop")


def _parabola_sizes(size: np.ndarray, fell: np.ndarray, top: np.ndarray, drop: float) -> np.ndarray:
    """Sizes (P, 2), at most `top` (P, 1), at which errors change the criterion by `drop`; from the
    changes `fell` (P, 2) at sizes (P, 2) of both signs.

    The change is a t + b t^2 for an error of the size t, with the sign of a to one side.
    """
    slope, bend = (fell[:, 1] - fell[:, 0]) / 2, (fell[:, 1] + fell[:, 0]) / 2
    t, found = top * np.geomspace(1e-4, 1, _GRID), np.empty_like(size)
    part, rows = t / size[:, :1], np.arange(len(size))
    for side, sign in enumerate((-1.0, 1.0)):
        reached = sign * slope[:, None] * part + bend[:, None] * part**2 >= drop
        first = np.argmax(reached, axis=1)
        found[:, side] = np.where(reached.any(axis=1), t[rows, first], top[:, 0])
    return found


def yields(values: np.ndarray, levels: Numbers, compensator: Given = "focus") -> np.ndarray:
    """Fractions (L,) of lenses as built that are as good as each level, or better.

    values: (K,), criterion of lenses, as `monte_carlo` returns it; or (K, Z), of each of Z
        configurations (`AsBuilt.each`), of which all have to be as good as the level.
    levels: (L,), in the unit of the criterion.
    compensator: the `Assembly` of the lenses, which has the criterion.
    """
    loss = Assembly.of(compensator).loss
    allowed = np.asarray(loss(np.asarray(levels, float)))
    worst = np.asarray(loss(np.asarray(values))).reshape(len(values), -1).max(axis=1)
    return np.mean(worst[:, None] <= allowed[None], axis=0)
