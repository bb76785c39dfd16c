"""Lens + field + distance + wavelengths + points on the stop -> rays with a status."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike

from .fermat import Status, System, arrival, geometry, optical_path, turn
from ..lens.glass import check_wavelengths
from .implicit import Found, solve_rays, solve_rays_forward
from ..lens.lens import Lens, rotation_matrix
from ..numerics import concrete, safe_divide
from ..lens.surface import by_form, sag, sag_derivatives

__all__ = ["Bundle", "Rays", "field_of_height", "trace_bundle", "trace_rays"]

_LINE_STEPS = 5


class Bundle(NamedTuple):
    """Rays in the array layout of `fermat`, rays last.

    hits (D, S + 1, W, Q), mm, along the axes of each surface and the sensor; status (W, Q);
    arrival (D + 1, W, Q), unit vectors at the sensor, along its axes; path (W, Q), optical
    path in mm from the object, see `fermat.optical_path`; found, what the solver
    returned, of the surfaces that bend or stop light.
    """

    hits: Array
    status: Array
    arrival: Array
    path: Array
    found: Found


class Rays(NamedTuple):
    """Traced rays.

    points (W, Q, S + 1, 3), mm: where they cross the surfaces and the sensor, along the axes
    of the lens, z from the first vertex; zeros for a ray that failed. directions, same shape:
    unit vectors (direction cosines) in front of each surface and the sensor. path (W, Q), mm: the
    optical path from the object to the sensor, counted from the sphere round the object (the
    plane wave) that passes through the first vertex; 0 for a ray that failed. status (W, Q),
    int32, see `Status`. newton_steps (), int32: iterations of the whole bundle.
    """

    points: Array
    directions: Array
    path: Array
    status: Array
    newton_steps: Array


def field_of_height(height: ArrayLike, distance: ArrayLike) -> Array:
    """The field angle in radians of an object point `height` mm above the axis.

    `distance` mm from the object plane to the first vertex, finite. Light from above the axis
    travels downwards, so that the angle is negative.
    """
    return -jnp.arctan(jnp.asarray(height, float) / jnp.asarray(distance, float))


def _live_surfaces(lens: Lens) -> list[int]:
    """Surfaces that bend or label rays: not those with the same medium on both sides."""
    media = lens.glasses
    return [
        i
        for i in range(len(lens.forms))
        if i == lens.stop or lens.mirrors[i] or media[i] != media[i + 1]
    ]


def system_of(
    lens: Lens, rows: list[int], field: Array, distance: Array, wavelengths: Array, pupil: Array
) -> System:
    """The Fermat system of the surfaces `rows` and the sensor; arguments as `trace_bundle`."""
    dtype = lens.curvature.dtype
    places = jnp.array([*rows, len(lens.forms)])

    def extend(array):
        return jnp.concatenate([array[jnp.array(rows)], jnp.zeros_like(array[:1])])

    offset = None if lens.decentre is None else lens.decentre[places].T
    rotation = None
    if lens.tilt is not None:
        rotation = jnp.moveaxis(jax.vmap(rotation_matrix)(lens.tilt[places]), 0, -1)
    return System(
        vertex=extend(lens.vertices).at[-1].set(lens.sensor),
        curvature=extend(lens.curvature),
        conic=extend(lens.conic),
        coefficients=extend(lens.coefficients).T,
        index=lens.index(wavelengths)[jnp.array([0, *(i + 1 for i in rows)])],
        # Light with a positive field angle travels upwards: the object lies below the axis.
        source=jnp.concatenate([-jnp.tan(field), -jnp.ones_like(field[:1])]),
        vergence=1 / jnp.asarray(distance, dtype),
        target=lens.semi_diameter[lens.stop] * jnp.asarray(pupil, dtype),
        offset=offset,
        rotation=rotation,
        stop=rows.index(lens.stop),
        forms=(*(lens.forms[i] for i in rows), "asphere"),
        mirrors=tuple(lens.mirrors[i] for i in rows),
    )


def _cross_dead_surfaces(system: System, whole: System, hits: Array, live: list[int]) -> Array:
    """Insert the points where the straight ray crosses the surfaces left out of the solve.

    `system` of the live surfaces, `whole` of all.
    """
    path = geometry(hits, system)
    dim, count = hits.shape[0], len(whole.mirrors)
    z = by_form(sag, hits, system.shape, system.forms)
    own = jnp.concatenate([hits, z[None]])

    def origin(i):
        across = [] if whole.offset is None else [*whole.offset[:, i]]
        across = across or [jnp.zeros_like(whole.vertex[i])] * dim
        return jnp.stack([*across, whole.vertex[i]])[:, None, None, None]

    rows = []
    for i in range(count):
        if i in live:
            rows.append(hits[:, live.index(i)])
            continue
        after = sum(j < i for j in live)  # the live surface, or the sensor, behind it
        p, d = own[:, after : after + 1], path.before[:, after : after + 1]
        far = system.rotation
        if far is not None:
            p, d = (turn(far[..., after : after + 1], a) for a in (p, d))
        p = p + origin([*live, count][after]) - origin(i)
        if far is not None:
            p, d = (turn(whole.rotation[..., i : i + 1], a, back=True) for a in (p, d))
        shape = jax.tree.map(lambda a: a[..., i : i + 1, :, :], whole.shape)
        length = -safe_divide(p[-1], d[-1])
        for _ in range(_LINE_STEPS):
            w = p[:-1] + d[:-1] * length
            height, slope, _ = sag_derivatives(w, shape, whole.forms[i])
            miss = height - p[-1] - d[-1] * length
            length = length + safe_divide(miss, d[-1] - jnp.sum(slope * d[:-1], axis=0))
        rows.append((p[:-1] + d[:-1] * length)[:, 0])
    return jnp.stack([*rows, hits[:, -1]], axis=1)


def trace_bundle(
    lens: Lens,
    field: Array,
    distance: Array,
    wavelengths: Array,
    pupil: ArrayLike,
    forward: bool = False,
    found: Found | None = None,
    thorough: bool = True,
) -> Bundle:
    """Trace rays in the array layout of `fermat`, rays last.

    `field` (D,) angles in radians, `distance` () from the object to the first vertex in mm,
    `wavelengths` (W,) in um, `pupil` (D, Q) or (D, W, Q) points on the unit disc of the stop;
    D = 1 for rays in the meridional (y, z) plane of a lens with rotational symmetry, else 2.
    `forward`: be differentiable in forward mode. `found`, `thorough`: see `solve_rays`.
    """
    live, count = _live_surfaces(lens), len(lens.forms)
    field = jnp.asarray(field, lens.curvature.dtype)
    scene = field, distance, wavelengths, pupil
    system = system_of(lens, live, *scene)
    solve = solve_rays_forward if forward else solve_rays
    found = solve(system, found, thorough)
    hits, status, _ = found
    last, path = arrival(hits, system), optical_path(hits, system)
    if len(live) < count:
        whole = system_of(lens, list(range(count)), *scene)
        hits = _cross_dead_surfaces(system, whole, hits, live)
    radius2 = sum(a**2 for a in hits[:, :-1])
    edge2 = (lens.semi_diameter.at[lens.stop].set(jnp.inf) ** 2)[:, None, None]
    clipped = jnp.any(radius2 > edge2, axis=0) & (status == Status.OK)
    return Bundle(hits, jnp.where(clipped, jnp.int32(Status.CLIPPED), status), last, path, found)


def as_field(field: ArrayLike, dtype: jnp.dtype) -> Array:
    """A field, one angle (along y) or two (x, y) in radians, as (2,)."""
    field = jnp.asarray(field, dtype)
    if field.ndim == 0:
        return jnp.stack([jnp.zeros_like(field), field])
    if field.shape != (2,):
        raise ValueError(f"field: expected one angle or two, got shape {field.shape}")
    return field


def typed_scene(
    lens: Lens, field: ArrayLike, distance: ArrayLike, wavelengths: ArrayLike
) -> tuple[Lens, Array, Array, Array]:
    """The lens, field (2,), distance () and wavelengths (W,), arrays of the lens's dtype.

    One type for numbers, NumPy's and JAX's arrays, so that they share a compiled program.
    """
    dtype = lens.curvature.dtype
    wavelengths = jnp.atleast_1d(jnp.asarray(wavelengths, dtype))
    return lens, as_field(field, dtype), jnp.asarray(distance, dtype), wavelengths


def trace_rays(
    lens: Lens,
    field: ArrayLike,
    distance: ArrayLike,
    wavelengths: ArrayLike,
    pupil: ArrayLike,
    forward: bool = False,
) -> Rays:
    """Trace the rays that cross the stop at given points.

    `field`: angle in radians along y, or (x, y); positive light travels upwards (for a height
    in mm, see `field_of_height`). `distance`: mm from the object plane to the first vertex,
    inf allowed. `wavelengths` (W,) in um. `pupil` (Q, 2), x and y on the stop in units of its
    semi-diameter. Rays are aimed at the real stop, for every wavelength. Differentiable in
    everything but the status, in reverse mode or, if `forward`, in forward mode (`jax.jvp`,
    `jax.jacfwd`); a Hessian-vector product is `jax.jvp` of `jax.grad`, without `forward`.
    ValueError for a known wavelength outside the range of a glass.
    """
    check_wavelengths(lens.glasses, wavelengths)
    scene = typed_scene(lens, field, distance, wavelengths)
    scene = *scene, jnp.asarray(pupil, lens.curvature.dtype)
    if concrete(scene):  # few need a program that can search for rays twice
        rays = _trace_rays(*scene, thorough=False)
        # Inside `jit` even a scene of constants has a status that is not known.
        if concrete(rays) and np.all(np.isin(rays.status, (Status.OK, Status.CLIPPED))):
            return rays
    return _trace_rays(*scene, forward)


@partial(jax.jit, static_argnames=("forward", "thorough"))
def _trace_rays(
    lens: Lens,
    field: Array,
    distance: Array,
    wavelengths: Array,
    pupil: Array,
    forward: bool = False,
    thorough: bool = True,
) -> Rays:
    scene = field, distance, wavelengths, pupil.T
    bundle = trace_bundle(lens, *scene, forward, thorough=thorough)
    whole = system_of(lens, list(range(len(lens.forms))), *scene)
    z = by_form(sag, bundle.hits, whole.shape, whole.forms)
    own = turn(whole.rotation, jnp.concatenate([bundle.hits, z[None]]))
    points = own.at[2].add(whole.vertex[:, None, None])
    if whole.offset is not None:
        points = points.at[:2].add(whole.offset[..., None, None])
    first = whole.vergence * points[:, :1] - whole.source[:, None, None, None]
    steps = jnp.concatenate([first, points[:, 1:] - points[:, :-1]], axis=1)
    length = jnp.sqrt(jnp.sum(steps**2, axis=0))
    directions = steps * safe_divide(jnp.ones_like(length), length)
    good = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
    points, directions = (
        jnp.moveaxis(jnp.where(good, a, 0), (0, 1), (3, 2)) for a in (points, directions)
    )
    path = jnp.where(good, bundle.path, 0)
    return Rays(points, directions, path, bundle.status, bundle.found.steps)
