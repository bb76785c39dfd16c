"""The sequential ray trace by Snell's law, which aiming uses.

The launch point of a ray is its crossing of the plane `System.launch_plane`, which is perpendicular
to the axis of the lens. Arrays have the shape () for one ray, or (wavelength, ray) with a
refractive index (wavelength, 1).

A ray runs forwards. On each row it takes the crossing on the side to which light is expected to go
(`Row.side`), if that crossing lies ahead on the sheet of the surface. In a lens with tilted
surfaces it otherwise takes the crossing on the other side, under the same condition, because an
off-axis mirror may be prescribed with its axis either way.

Source: Welford, Aberrations of Optical Systems (1986), ch. 4.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.forms import Shape
from ..lens.surface import sag_slope
from ..numerics import safe_divide, safe_sqrt
from .meet import meet, near_side
from .status import Status
from .system import Placed, System, Vector, add, along, dot, rotate, where

# Smallest cosine of the angle between a traced ray and the normal of a surface: 0.006 degrees from
# grazing incidence.
_FLATTEST = 1e-4


class Trace(NamedTuple):
    """Traced rays.

    hits: D arrays (R, ...), transverse coordinates on the rows, mm. If the stop is not a row, the
        crossing of the stop is inserted at `system.before`, see `split_stop`. Undefined behind a
        failure.
    status: (...), int32, OK, MISSED, TIR or CROSSED.
    rounding_angle: (...), largest change of direction of a segment by rounding of the hits, radians
        in units of the rounding error.
    """

    hits: Vector
    status: Array
    rounding_angle: Array


def split_stop(system: System, hits: Vector) -> tuple[Vector, Vector]:
    """Splits traced hits into those on the R rows, D arrays (R, ...), and the stop, D arrays (...).

    system: the traced system.
    hits: D arrays, mm, as in `Trace`.
    """
    at = system.before
    crossing = tuple(h[at] for h in hits)
    if system.stop is None:
        return hits, crossing
    return tuple(jnp.concatenate([h[:at], h[at + 1 :]]) for h in hits), crossing


def _refract(d: Vector, normal: Vector, row: "Row", kick: Vector, side: Array | None) -> tuple:
    """Refraction, reflection and diffraction by Snell's law in vector form.

    With the unit normal N and the ratio m = n / n' of indices, the vector m d + kick keeps its part
    along the surface, t. The direction behind is t + s N sqrt(1 - |t|^2), where s is the side to
    which light crosses, reversed by a mirror.

    d: D + 1 arrays, unit vector in front of the surface.
    normal: D + 1 arrays of any length.
    row: the surface.
    kick: D arrays, change of direction by a phase; () for no phase.
    side: 1 if light must cross towards +z of the surface, -1 towards -z; None for any.

    Returns the direction behind the surface, D + 1 arrays; a number above 0 if light crosses to
    that side; and the squared cosine behind the surface, 1 - |t|^2, above 0 if light passes.
    """
    shrink = 1 / jnp.sqrt(dot(normal, normal))
    cosine = dot(normal, d) * shrink
    side = jnp.where(cosine < 0, -1, 1).astype(cosine.dtype) if side is None else side
    front = cosine * side - _FLATTEST
    size, d = row.ratio**2, tuple(row.ratio * a for a in d)
    if kick:
        d = *add(d[:-1], kick), d[-1]
        size = dot(d, d)
    cosine = dot(normal, d) * shrink
    square = 1 - (size - cosine**2)
    change = (side * row.turn * safe_sqrt(square) - cosine) * shrink
    return along(d, change, normal), front, square


class _Kick(NamedTuple):
    """Phases of R rows, or of one.

    kind: (R,), number of the form of the phase; 0 for none.
    phase: its shape, (R,) and (R, K).
    wave: (R, W, 1) or (R,), change of direction behind the row per wave/mm of phase slope, mm.
    """

    kind: Any
    phase: Shape
    wave: Array


def _kicks(system: System, kinds: list[str]) -> _Kick | None:
    """The phases of all rows of a system; None if it has none. kinds: names of the forms of
    phases.
    """
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
    """Change of direction by a phase at a hit, D arrays; () if no row has a phase."""
    if row is None:
        return ()
    none = lambda hit, _: tuple(jnp.zeros_like(a) for a in hit)  # noqa: E731
    each = [lambda hit, phase, kind=kind: sag_slope(hit, phase, kind)[1] for kind in kinds]
    slope = jax.lax.switch(row.kind, [none, *each], hit, row.phase)
    return tuple(row.wave * s for s in slope)


class Row(NamedTuple):
    """One step of the trace: an active surface, the stop or the sensor.

    Several rows have a first axis.

    first, last: True for the first row, and for the sensor.
    active: False for a stop that is only a label: the ray is extended to it in either direction.
    bends: False if the ray continues unchanged.
    surface: the surface in its position.
    kind: number of its form.
    ratio: refractive index in front of it divided by that behind it.
    side: 1 if light is expected to cross towards +z of it, -1 towards -z.
    turn: -1 for a mirror, else 1.
    kick: its phase; None if no row has a phase.
    """

    first: Any
    last: Any
    active: Any
    bends: Any
    surface: Placed
    kind: Any
    ratio: Array
    side: Any
    turn: Any
    kick: _Kick | None


def _forms(system: System) -> tuple[list[str], list[str]]:
    """Sorted names of the forms of surfaces and of phases that occur."""
    by = system.diffraction
    return sorted({*system.forms, system.at_stop[1]}), sorted(set(by.forms)) if by else []


def rows_met(system: System, to_stop: bool = False) -> Row:
    """The steps of the trace to the sensor, or to the stop.

    A stop that is not an active surface is inserted at `system.before` as a step that does not
    bend.

    to_stop: True for the rows in front of the stop and the stop as a label, False for all rows.
    """
    kinds, phases = _forms(system)
    count, at = len(system.forms), system.before
    forms = np.array([kinds.index(form) for form in system.forms])
    rows = Row(
        np.arange(count) == 0,
        np.arange(count) == count - 1,
        np.ones(count, bool),
        np.ones(count, bool),
        system.rows,
        forms.astype(np.int32),
        system.index / system.behind,
        system.sides,
        np.where([*system.mirrors, False], -1, 1).astype(system.index.dtype),
        _kicks(system, phases),
    )
    if system.stop is None and not to_stop:
        return rows
    stop, form = system.at_stop
    near = jax.tree.map(lambda a: a[at], rows)
    active = np.bool_(system.stop is None)
    label = near._replace(
        last=np.False_,
        active=active,
        bends=np.False_,
        surface=stop,
        kind=np.int32(kinds.index(form)),
    )
    tail = jax.tree.map(lambda a: a[at:at] if to_stop else a[at:], rows)

    def joined(front, row, back):
        library = jnp if isinstance(front, Array) else np
        return library.concatenate([front[:at], row[None], back])

    return jax.tree.map(joined, rows, label, tail)


class _State(NamedTuple):
    """Rays behind a row.

    point, direction: D + 1 arrays (...) along the axes of the lens; point in mm.
    hit: D arrays (...), on that row, mm along its axes.
    status, rounding_angle: (...), as in `Trace`.
    """

    point: Vector
    direction: Vector
    hit: Vector
    status: Array
    rounding_angle: Array


class Meeting(NamedTuple):
    """Meetings of rays with each row, along the axes of that row; undefined behind a failure.

    If the stop is not a row, its meeting is inserted at `system.before`, see `split_stop`.

    point, direction: D + 1 arrays (R, ...), a point (mm) and unit vector of the ray in front of the
        row.
    hit: D arrays (R, ...), where the ray, extended both ways, crosses the row, mm.
    crosses: (R, ...), bool, whether the ray crosses the row.
    length: (R, ...), mm from the previous active surface, below 0 for a step back.
    front: (R, ...), above 0 if light comes from the front of the row.
    through: (R, ...), above 0 if light passes the row, that is, without total internal reflection.
    status: (R, ...), int32, status up to and including this row, see `Trace`.
    """

    point: Vector
    direction: Vector
    hit: Vector
    crosses: Array
    length: Array
    front: Array
    through: Array
    status: Array


@partial(jax.jit, static_argnames=("to_stop", "smooth", "forward"))
def _follow(
    system: System,
    launch: Vector,
    to_stop: bool = False,
    smooth: bool = False,
    forward: bool = True,
) -> tuple[_State, Any]:
    """Traces rays through all rows with one `lax.scan`, so that one step is compiled.

    Each step transforms the ray to the axes of the row, intersects it with the row (`meet`), bends
    it (`_refract`) and transforms it back. The first failure decides the status: MISSED if the ray
    does not cross the row, or crosses it from the wrong side; MISSED or CROSSED if the crossing
    lies behind the ray (MISSED on the first row and the sensor, CROSSED on others); TIR if no light
    passes. A failed ray continues with undefined values, or on the axis if `smooth`. A row that
    does not bend leaves the ray as it is and changes only the status.

    launch: D arrays (...), mm on the launch plane.
    to_stop: True to trace only to the stop.
    smooth: as in `meetings`.
    forward: True if a ray that steps back to a row is CROSSED.

    Returns the rays behind the last row, and the `Meeting` with all rows; None if `to_stop`.
    """
    kinds, phases = _forms(system)
    each = [partial(meet, kind) for kind in kinds]
    tilted, way = system.rows.rotation is not None, system.sensor_way
    # Rays start on the launch plane P with the direction q = vergence P - source. Its size |q| is
    # the distance from the object times the vergence.
    point = *launch, jnp.broadcast_to(system.launch_plane, launch[0].shape)
    direction = system.from_object(point)
    far = jnp.sqrt(dot(direction, direction))
    shrink = 1 / far

    def ahead(row, length):
        """Whether a length leads forwards: away from the object on the first row, away from the
        previous row on others.

        The object lies `far` / vergence behind the launch point, so that the first condition is
        vergence length + far > 0. A sensor in front of the last surface is reached backwards, along
        the line from which light only seems to come.
        """
        beyond = jnp.where(row.first, system.vergence * length + far, length)
        beyond = jnp.where(row.last, way * beyond, beyond) > 0
        return beyond | ((not forward) & ~row.first)

    def least(row):
        """The smallest length at which a crossing with a tilted surface is accepted."""
        start = jnp.where(system.vergence > 0, -safe_divide(far, system.vergence), -jnp.inf)
        anywhere = (row.last & (way < 0)) | ~row.active
        return jnp.where(row.first, start, jnp.where(anywhere, -jnp.inf, 0))

    def step(state, row):
        going = state.status == Status.OK
        p, d = row.surface.local(state.point, state.direction)
        if smooth:
            axis = *(jnp.zeros_like(a) for a in d[:-1]), row.side
            p, d = where(going, p, 0), where(going, d, axis)
        side = jnp.where(row.active, row.side, near_side(d))
        encounter = each[0] if len(kinds) == 1 else partial(jax.lax.switch, row.kind, each)
        line = p, d, row.surface.shape, going, side
        own, normal, crosses, length = encounter(*line, least(row) if tilted else None)
        hit, kick = own[:-1], _kick(phases, row.kick, own[:-1])
        direction, front, through = _refract(d, normal, row, kick, None if tilted else side)
        # The first failure decides the status.
        met, beyond = crosses & (~row.active | (front > 0)), ~row.active | ahead(row, length)
        here = jnp.where((through > 0) | ~row.bends, Status.OK, Status.TIR)
        back = jnp.where(row.first | row.last, Status.MISSED, Status.CROSSED)
        here = jnp.where(met, jnp.where(beyond, here, back), Status.MISSED)
        status = jnp.where(going, here.astype(jnp.int32), state.status)
        wide = jnp.maximum(dot(hit, hit), dot(state.hit, state.hit))
        wide = jax.lax.stop_gradient(jnp.sqrt(wide))  # the root has no derivative on the axis
        angle = safe_divide(wide, jnp.where(row.first, 0, abs(length)))
        angle = jnp.maximum(jnp.where(status == Status.OK, angle, 0), state.rounding_angle)
        rotation, origin = row.surface.rotation, row.surface.origin(len(hit))
        point, direction = add(rotate(rotation, own), origin), rotate(rotation, direction)
        behind = _State(point, direction, hit, status, angle)
        if to_stop:
            return behind, None
        behind = where(row.bends, behind, state._replace(status=status))
        return behind, Meeting(p, d, hit, crosses, length, front, through, status)

    zero = jnp.zeros_like(far)
    none = jnp.zeros(zero.shape, jnp.int32)
    direction = tuple(d * shrink for d in direction)
    start = _State(point, direction, (zero,) * len(launch), none, zero)
    return jax.lax.scan(step, start, rows_met(system, to_stop))


def shoot(system: System, launch: Vector) -> Trace:
    """Traces rays to the sensor. launch: D arrays, mm on the launch plane."""
    state, met = _follow(system, launch)
    return Trace(met.hit, state.status, state.rounding_angle)


def shoot_anyway(system: System, launch: Vector) -> tuple[Vector, Array, Array]:
    """Traces rays that may step back where neighbouring surfaces cross.

    Differentiable, and finite for failed rays.

    launch: D arrays, mm on the launch plane.

    Returns `hits` as in `Trace`; the lengths (R - 1, ...) of the segments from each active surface
    to the next and to the sensor, mm; and `status` as in `Trace`. A length is below 0 for a step
    back. A segment to a sensor in front of the last surface (a virtual image) does not count as a
    step back.
    """
    state, met = _follow(system, launch, smooth=True, forward=False)
    lengths = split_stop(system, (met.length,))[0][0][1:]
    if len(lengths):
        lengths = jnp.concatenate([lengths[:-1], lengths[-1:] * system.sensor_way])
    return met.hit, lengths, state.status


def meetings(system: System, launch: Vector, smooth: bool = False) -> Meeting:
    """Meetings of rays with all rows.

    launch: D arrays, mm on the launch plane.
    smooth: True to move failed rays onto the axis, so that all derivatives are finite.
    """
    return _follow(system, launch, smooth=smooth)[1]


def shoot_to_stop(system: System, launch: Vector) -> tuple[Vector, Array]:
    """Traces rays to the stop, also backwards.

    A step back does not end the trace, so that Newton's method can pass through such rays. The
    complete trace checks afterwards whether a found ray steps back.

    launch: D arrays, mm on the launch plane.

    Returns the crossings of the stop, D arrays, mm along its axes, and the status there (...).
    """
    state, _ = _follow(system, launch, to_stop=True, forward=False)
    return state.hit, state.status
