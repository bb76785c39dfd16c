"""The sequential trace by Snell's law: what rays are aimed with.

Its rays are labelled by where they cross the vertex plane of the first surface, their `launch`.
Arrays have any shape: () for one ray, or (wavelength, ray) beside an index (wavelength, 1).

Source: Welford, Aberrations of Optical Systems (1986), ch. 4.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import Shape
from ..lens.surface import sag_derivatives
from ..numerics import safe_divide, safe_sqrt
from .meet import meet, quadratic
from .status import Status
from .system import Placed, System, Vector, dot, turn

# A ray that leans more than this (cosine with the axis) is not followed.
_FLATTEST = 1e-4


class Trace(NamedTuple):
    """Rays traced one surface after the other.

    hits: D arrays (R, ...), transverse coordinates on the rows in mm, and on a stop that is none
        of them, which has its place among them: see `apart`. Void behind a failure.
    fate: (...), int32, OK, MISSED or TIR, see `Status`.
    shake: (...), the most that rounding the hits turns a segment by, in units of rounding.
    """

    hits: Vector
    fate: Array
    shake: Array


def apart(system: System, hits: Vector) -> tuple[Vector, Vector]:
    """Traced hits as those on the rows of the system, D arrays (R, ...), and on the stop (...)."""
    at = system.before
    crossing = tuple(h[at] for h in hits)
    if system.stop is None:
        return hits, crossing
    return tuple(jnp.concatenate([h[:at], h[at + 1 :]]) for h in hits), crossing


def _towards(system: System, point: Vector) -> Vector:
    """Direction, of any length, of the light at a point before the lens."""
    return tuple(system.vergence * p - s for p, s in zip(point, system.source, strict=True))


def _begin(system: System, launch: Vector) -> tuple[Vector, Vector]:
    point = *launch, jnp.broadcast_to(system.rows.vertex[0], launch[0].shape)
    direction = _towards(system, point)
    shrink = 1 / jnp.sqrt(dot(direction, direction))
    return point, tuple(d * shrink for d in direction)


def _refract(d: Vector, normal: Vector, row: "_Row", kick: Vector) -> tuple[Vector, Array, Array]:
    """Direction behind a surface by Snell's law in vector form; and by how much light comes from
    its front, and gets through, both above 0. `kick`: what a phase adds to it, D arrays or none."""
    front = jnp.minimum(d[-1] * row.sense - _FLATTEST, dot(normal, d) * row.sense)
    size, d = row.ratio**2, tuple(row.ratio * a for a in d)
    if kick:
        d = *(a + b for a, b in zip(d, kick, strict=False)), d[-1]
        size = dot(d, d)
    shrink = 1 / jnp.sqrt(dot(normal, normal))
    cosine = dot(normal, d) * shrink
    square = 1 - (size - cosine**2)
    bent = (row.leaving * safe_sqrt(square) - cosine) * shrink
    return tuple(a + bent * n for a, n in zip(d, normal, strict=True)), front, square


class _Kick(NamedTuple):
    """Of R rows, or one: kind: of the form of its phase, 0 for none. phase: its shape, (R,) and
    (R, K). wave: (R, W, 1) or (R,), mm by which a wave of it turns light behind the row."""

    kind: Any
    phase: Shape
    wave: Array


def _kicks(system: System, kinds: list[str]) -> _Kick | None:
    by = system.diffraction
    if by is None:
        return None
    rows, kind = np.array(by.rows), np.zeros(len(system.forms), np.int32)
    kind[rows] = [1 + kinds.index(form) for form in by.forms]

    def spread(a):
        return jnp.zeros((kind.size, *a.shape[1:]), a.dtype).at[rows].set(a)

    phase = by.phase._replace(coefficients=by.phase.coefficients.T)
    return _Kick(kind, Shape(*map(spread, phase)), spread(by.wave) / system.behind)


def _kick(kinds: list[str], row: _Kick | None, hit: Vector) -> Vector:
    """The change of direction, D arrays; none without a phase."""
    if row is None:
        return ()
    none = lambda hit, _: tuple(jnp.zeros_like(a) for a in hit)  # noqa: E731
    each = [lambda hit, phase, kind=kind: sag_derivatives(hit, phase, kind)[1] for kind in kinds]
    slope = jax.lax.switch(row.kind, [none, *each], hit, row.phase)
    return tuple(row.wave * s for s in slope)


class _Row(NamedTuple):
    """One thing that a ray meets: a live surface, the stop, the sensor; or with a first axis some.

    first: whether it is the first. live: whether light must come to it from the front, or the ray,
    prolonged either way, is a line that crosses it. bends: whether the ray goes on from here. kind:
    of its form. ratio: of the indices before and behind. sense, leaving: 1 or -1, light goes along
    or against z before it and behind. kick: None for no phase at all.
    """

    first: Any
    live: Any
    bends: Any
    surface: Placed
    kind: Any
    ratio: Array
    sense: Any
    leaving: Any
    kick: _Kick | None


def _rows(system: System, kinds: list[str], phases: list[str], to_stop: bool) -> _Row:
    """All that rays meet, or what they meet up to the stop and the stop, which then is crossed."""
    count, at = len(system.forms), system.before
    senses = system.senses
    forms = np.array([kinds.index(form) for form in system.forms])
    rows = _Row(
        np.arange(count) == 0,
        np.ones(count, bool),
        np.ones(count, bool),
        system.rows,
        forms.astype(np.int32),
        system.index / system.behind,
        senses,
        np.where([*system.mirrors, False], -senses, senses),
        _kicks(system, phases),
    )
    if system.stop is None and not to_stop:
        return rows
    stop, form = system.at_stop
    around = jax.tree.map(lambda a: a[at], rows)
    live = np.bool_(system.stop is None)
    label = around._replace(
        live=live, bends=np.False_, surface=stop, kind=np.int32(kinds.index(form))
    )
    ends = jax.tree.map(lambda a: a[at:at] if to_stop else a[at:], rows)

    def joined(front, row, back):
        library = jnp if isinstance(front, Array) else np
        return library.concatenate([front[:at], row[None], back])

    return jax.tree.map(joined, rows, label, ends)


class _State(NamedTuple):
    """Rays behind a row: point, direction: D + 1 arrays (...), along the axes of the lens. hit: D
    arrays, on that row. fate, shake: see `Trace`."""

    point: Vector
    direction: Vector
    hit: Vector
    fate: Array
    shake: Array


class _Meeting(NamedTuple):
    """Of rays with a row: `hit`, D arrays (...), and `fate` so far (...), see `Trace`. length:
    (...), mm from the live surface before it, below 0 for a step back. short: by how much a ray
    misses the row, comes from behind, is bent too far; called where it is asked."""

    hit: Vector
    length: Array
    fate: Array
    short: Callable[[], Array]


def _as_it_is(going: Array, sense: Array, p: Vector, d: Vector) -> tuple[Vector, Vector]:
    """A lost ray goes on as it came: its numbers are void."""
    return p, d


def _along_the_axis(going: Array, sense: Array, p: Vector, d: Vector) -> tuple[Vector, Vector]:
    """A lost ray goes on along the axis, so that its numbers and their derivatives are finite."""
    axis: Vector = (*(jnp.zeros_like(a) for a in d[:-1]), sense)
    p = tuple(jnp.where(going, a, 0) for a in p)
    return p, tuple(jnp.where(going, a, b) for a, b in zip(d, axis, strict=True))


def _follow(
    system: System,
    launch: Vector,
    to_stop: bool,
    keep: Callable[[_Meeting], Any],
    lost: Callable[..., tuple[Vector, Vector]] = _as_it_is,
    forward: bool = True,
) -> tuple[_State, Any]:
    """Rays behind the last row; and unless that is the stop, what is to `keep` of each meeting.
    lost: how a ray that failed goes on. forward: whether a ray fails that steps back to a row."""
    kinds = sorted({*system.forms, system.at_stop[1]})
    each = [partial(meet, kind) for kind in kinds]
    phases = [] if system.diffraction is None else sorted(set(system.diffraction.forms))

    def step(state, row):
        p, d = row.surface.local(state.point, state.direction)
        p, d = lost(state.fate == Status.OK, row.sense, p, d)
        encounter = each[0] if len(kinds) == 1 else partial(jax.lax.switch, row.kind, each)
        own, normal, met, length = encounter(p, d, row.surface.shape, state.fate == Status.OK)
        bent, front, through = _refract(d, normal, row, _kick(phases, row.kick, own[:-1]))
        crosses = met
        ahead = (length > 0) | row.first | (not forward)
        met = met & (~row.live | ((front > 0) & ahead))
        passes = (through > 0) | ~row.bends
        here = jnp.where(met, jnp.where(passes, Status.OK, Status.TIR), Status.MISSED)
        fate = jnp.where(state.fate == Status.OK, here.astype(jnp.int32), state.fate)
        hit, before = own[:-1], state.hit
        wide = jnp.sqrt(jnp.maximum(dot(hit, hit), dot(before, before)))
        wide = jax.lax.stop_gradient(wide)  # its root has no derivative on the axis
        shake = jnp.where(fate == Status.OK, safe_divide(wide, jnp.where(row.first, 0, length)), 0)
        origin = row.surface.origin(len(hit))
        point = tuple(a + o for a, o in zip(turn(row.surface.rotation, own), origin, strict=True))
        shake = jnp.maximum(shake, state.shake)
        new = _State(point, turn(row.surface.rotation, bent), hit, fate, shake)
        if to_stop:
            return new, None
        kept = state._replace(fate=fate)

        def short() -> Array:
            square, linear, constant = quadratic(p, d, row.surface.shape)
            behind = jnp.where(row.first, 0, jnp.maximum(-length, 0)) + jnp.maximum(-front, 0)
            behind = jnp.where(row.live, behind, 0)
            behind = behind + jnp.where(row.bends, jnp.maximum(-through, 0), 0)
            # By how much a conic is missed, on from the total reflection of rays that graze it.
            missed = jnp.maximum(square * constant - linear**2, 0)
            missed = missed + jnp.where(row.bends, jnp.maximum(row.ratio**2 - 1, 0), 0)
            return jnp.where(crosses, behind, missed)

        keeping = keep(_Meeting(hit, length, fate, short))
        return jax.tree.map(partial(jnp.where, row.bends), new, kept), keeping

    zero = jnp.zeros_like(launch[0])
    none, begin = jnp.zeros(zero.shape, jnp.int32), _begin(system, launch)
    start = _State(*begin, (zero,) * len(launch), none, zero)
    return jax.lax.scan(step, start, _rows(system, kinds, phases, to_stop))


def shoot(system: System, launch: Vector) -> Trace:
    """Trace rays to the sensor; `launch` D arrays in mm on the vertex plane of the first row."""
    state, hits = _follow(system, launch, False, lambda meeting: meeting.hit)
    return Trace(hits, state.fate, state.shake)


def shoot_anyway(system: System, launch: Vector) -> tuple[Vector, Array, Array]:
    """`hits` and `fate` of `Trace`, and between them the lengths (R - 1, ...) of the segments from
    each live surface to the next and to the sensor, mm: a ray may step back, where neighbours
    cross, by a length below 0. Differentiable; void rays are finite."""
    state, (hits, lengths) = _follow(
        system,
        launch,
        False,
        lambda meeting: (meeting.hit, meeting.length),
        _along_the_axis,
        forward=False,
    )
    return hits, apart(system, (lengths,))[0][0][1:], state.fate


def fates(system: System, launch: Vector) -> Array:
    """What became of rays up to each row, and up to a stop that is none of them in its place among
    these: (R, ...) or (R + 1, ...), int32, see `Trace`. `launch` as of `shoot`."""
    return _follow(system, launch, False, lambda meeting: meeting.fate)[1]


def lack(system: System, launch: Vector, target: Vector) -> Array:
    """By how much rays fail to come through stop points, (...): the part of the rows that they do
    not come to, and more the farther one is from getting past the first of these; for one that
    reaches the sensor, more the farther from its stop point it crosses the stop. Finite, and
    differentiable by what pulls the ray through. `launch` as of `shoot`; target: D arrays (...)
    in mm, whose largest counts as far."""
    fate, short, hits = _follow(
        system,
        launch,
        False,
        lambda meeting: (meeting.fate, meeting.short(), meeting.hit),
        _along_the_axis,
    )[1]
    lost = fate != Status.OK
    first = lost & ~jnp.concatenate([jnp.zeros_like(lost[:1]), lost[:-1]])
    _, crossing = apart(system, hits)
    miss = tuple(a - b for a, b in zip(crossing, target, strict=True))
    off = safe_divide(safe_sqrt(dot(miss, miss)), jnp.sqrt(jnp.max(dot(target, target))))
    short = jnp.sum(jnp.where(first, short, 0), axis=0)
    part = jnp.mean(lost.astype(short.dtype), axis=0)
    return part + jnp.log1p(jnp.where(lost[-1], short, off))


def shoot_to_stop(system: System, launch: Vector) -> tuple[Vector, Array]:
    """Where rays cross the stop, D arrays in mm along its axes, and their fate so far (...)."""
    state, _ = _follow(system, launch, True, lambda meeting: None)
    return state.hit, state.fate
