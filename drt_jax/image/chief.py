"""Chief rays over the field: distortion, field curvature, lateral colour, chief ray angle.

A chief ray passes through the centre of the stop. JVPs of the traced ray give the derivatives h_p
and m_p, by the stop point p, of its hit h on the sensor and its slope m there. A distance s behind
the sensor, neighbouring rays are at h + h_p dp + s (m + m_p dp), so they meet the chief ray where
h_p + s m_p is singular. These are the foci of Coddington's equations, for any lens, tilted or not.

All functions take a `Scene` and return arrays whose first axes (...) are its points. jit, vmap and
derivatives in every mode work as for `trace_rays`. A point whose chief ray fails has inf; one that
an aperture clips counts like others. ValueError as of `lens.scene.checked_scene`. Chief rays
through the paraxial entrance pupil, which other programs use unless they aim at the stop, are those
of `with_paraxial_pupil(lens)`.

Sources: Welford, Aberrations of Optical Systems (1986), ch. 4.5 and 6; conventions of the field
curvature and distortion plots of OpticStudio where they are named.
"""

import functools
import math
from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import LARGE, jit
from ..inputs import require_one_of
from ..lens.lens import Lens
from ..lens.scene import Scene, checked_scene, over_points
from ..lens.surface import surface_sag
from ..numerics import (
    Numbers,
    concrete,
    einsum,
    known_values,
    program,
    real_array,
    safe_divide,
    safe_sqrt,
)
from ..rays.known import SEARCH, Known, known_rays
from ..rays.system import Vector, determinant, divide, dot
from ..rays.trace import FOCAL, Bundle, trace_bundle
from .field import CHIEF
from .rounding import warn_of_focus

Mapping = Literal["tangent", "angle"]
# The number of points is padded to a multiple of this, so that programs are shared.
_POINTS = 16


class FieldCurvature(NamedTuple):
    """Foci of narrow pencils about the chief rays, (..., W), mm along the z axis of the sensor,
    from where the chief ray meets it; inf for none.

    tangential: of rays whose stop points are displaced from the centre along the field (y, for the
        axis).
    sagittal: of rays that cross it at right angles to that.
    """

    tangential: Array
    sagittal: Array


class Distortion(NamedTuple):
    """Chief rays on the sensor compared with an ideal image.

    relative: (..., W), displacement from the ideal point, relative to the distance of that point
        from the image of the axis. Only the component along that distance counts; positive
        outwards; 0 on the axis.
    real, ideal: (..., W, 2), mm, x and y on the sensor.
    focal_length: (W,), mm, scale of the ideal image: y by the tangent of the field, or by the
        angle.
    """

    relative: Array
    real: Array
    ideal: Array
    focal_length: Array


class _ChiefRays(NamedTuple):
    """The chief rays of points (...).

    hit: (..., W, 2), mm.
    angle, tangential, sagittal: (..., W), as `chief_ray_angle` and `FieldCurvature` have them.
    by_field: (..., W, 2, 2), mm per radian, derivatives of the hit (x, y) by the field (x, y).
    whole: (..., W), bool, False where the ray fails.
    """

    hit: Array
    angle: Array
    tangential: Array
    sagittal: Array
    by_field: Array
    whole: Array


def field_curvature(lens: Lens, scene: Scene) -> FieldCurvature:
    """Tangential and sagittal foci relative to the sensor, see `FieldCurvature`.

    lens, scene: the lens, and object points with their wavelengths.

    Positive where the focus has the larger z, as OpticStudio plots it. In a lens without a plane of
    symmetry the two focal lines are named by the direction that they are nearer to. Warns, outside
    of a trace, where float32 moves a focus by more than 2 % of the depth of focus,
    wavelength / NA^2.
    """
    scene = checked_scene(lens, scene)
    warn_of_focus(lens, scene)
    found = _chief_rays(lens, scene)
    return FieldCurvature(found.tangential, found.sagittal)


def chief_ray_angle(lens: Lens, scene: Scene) -> Array:
    """Angle between the chief ray and the normal of the sensor's vertex.

    lens, scene: as in `field_curvature`.

    Returns (..., W), radians, 0 or more.
    """
    return _chief_rays(lens, checked_scene(lens, scene)).angle


def lateral_colour(lens: Lens, scene: Scene, reference: int | None = None) -> Array:
    """Hits of the chief rays on the sensor, minus the hits in a reference wavelength.

    lens, scene: as in `field_curvature`.
    reference: index of the reference wavelength; None: the middle one, W // 2.

    Returns (..., W, 2), mm along x and y of the sensor. ValueError for an index out of range.
    """
    scene = checked_scene(lens, scene)
    return _lateral(_chief_rays(lens, scene), scene.reference(reference))


@functools.partial(program, static_argnames="middle")
def _lateral(found: _ChiefRays, middle: int) -> Array:
    """`lateral_colour` from chief rays. middle: index of the reference wavelength."""
    moved = found.hit - found.hit[..., middle, None, :]
    whole = found.whole & found.whole[..., middle, None]
    return jnp.where(whole[..., None], moved, jnp.inf)


def along_field(lens: Lens, scene: Scene) -> tuple[FieldCurvature, Distortion, Array]:
    """`field_curvature`, `distortion` and `lateral_colour` by one trace.

    lens, scene: as there; fields (F, 2) at one distance.
    """
    scene = checked_scene(lens, scene)
    warn_of_focus(lens, scene)
    line = scene.with_axis()
    return _along_field(_chief_rays(lens, line), line.field, scene.reference(None), lens.afocal)


@functools.partial(program, static_argnames=("middle", "afocal"))
def _along_field(
    found: _ChiefRays, fields: Array, middle: int, afocal: bool
) -> tuple[FieldCurvature, Distortion, Array]:
    """`along_field` from chief rays of fields (F + 1, 2), the axis first."""
    bent = _distortion(found, fields, None, "tangent", False, afocal)
    later = jax.tree.map(lambda a: a[1:], found)
    return FieldCurvature(later.tangential, later.sagittal), bent, _lateral(later, middle)


def distortion(
    lens: Lens,
    scene: Scene,
    mapping: Mapping = "tangent",
    focal_length: Numbers | Literal["fitted"] | None = None,
) -> Distortion:
    """Chief rays compared with the ideal image f tan(field) or f field, see `Distortion`.

    lens, scene: as in `field_curvature`.
    mapping: "tangent"; or "angle" (f-theta), for a field (x, y) the angle to the axis.
    focal_length: f, () or (W,), mm; None: the limit of real chief rays near the axis, on the sensor
        where it is, which is OpticStudio's reference; "fitted": calibrated, the least squares over
        the fields of the scene. A finite distance has the same formulae, with
        tan(field) = height / distance. For a lens without an axis a matrix takes the place of f,
        the derivative of the hit at the field 0. The operand "distortion" of a design compares with
        the paraxial image height instead, which differs where the sensor is out of focus.

    ValueError for another mapping or focal length, and for points at several distances.
    """
    require_one_of("mapping", mapping, get_args(Mapping))
    if isinstance(focal_length, str) and focal_length != "fitted":
        raise ValueError(f"focal_length: expected mm, None or 'fitted', got {focal_length!r}")
    scene, dtype = checked_scene(lens, scene), lens.curvature.dtype
    line = scene.with_axis()
    found, waves = _chief_rays(lens, line), len(scene.wavelengths)
    scale = None
    if focal_length is not None and not isinstance(focal_length, str):
        length = real_array("focal_length", focal_length, dtype)
        if length.shape not in ((), (waves,)):
            raise ValueError(f"focal_length: expected () or ({waves},), got {length.shape}")
        scale = jnp.broadcast_to(length, (waves,))[:, None, None] * jnp.eye(2, dtype=dtype)[None]
    calibrated = isinstance(focal_length, str)
    bent = _distortion(found, line.field, scale, mapping, calibrated, lens.afocal)
    relative, real, ideal = (a.reshape(*scene.shape, *a.shape[1:]) for a in bent[:3])
    return Distortion(relative, real, ideal, bent.focal_length)


@functools.partial(jax.jit, static_argnames=("mapping", "calibrated", "afocal"))
def _distortion(
    found: _ChiefRays,
    fields: Array,
    scale: Array | None,
    mapping: Mapping,
    calibrated: bool,
    afocal: bool,
) -> Distortion:
    """`distortion` from chief rays of fields (F + 1, 2), the axis first.

    The ideal image of a field is scale t from the image of the axis, where t is tan(field), or the
    field itself for the mapping "angle". A calibrated scale is multiplied by the least-squares
    factor sum(real . ideal) / sum(ideal . ideal).

    scale: (W, 2, 2), mm; None for the derivative of the hits by the field on the axis.
    """
    scale = found.by_field[0] if scale is None else scale
    whole = found.whole[1:] & found.whole[:1]
    place = jnp.tan(fields[1:])
    if afocal and mapping == "tangent":  # hits are angles, in mrad: compare their tangents
        size = safe_sqrt(jnp.sum(found.hit**2, axis=-1, keepdims=True)) / FOCAL
        longer = jnp.where(size > 0, safe_divide(jnp.tan(size), size), 1)
        found = found._replace(hit=found.hit * longer)
    if mapping == "angle":
        size = safe_sqrt(jnp.sum(place**2, axis=-1, keepdims=True))
        place = place * jnp.where(size > 0, safe_divide(jnp.arctan(size), size), 1)
    ideal = einsum("wij,fj->fwi", scale, place)
    moved = jnp.where(whole[..., None], found.hit[1:] - found.hit[:1], 0)
    if calibrated:
        square = jnp.sum(jnp.where(whole[..., None], ideal**2, 0), axis=(0, 2))
        factor = safe_divide(jnp.sum(moved * ideal, axis=(0, 2)), square)
        scale, ideal = scale * factor[:, None, None], ideal * factor[None, :, None]
    relative = jnp.where(whole, outwards(moved, ideal), jnp.inf)
    real, ideal = (
        jnp.where(whole[..., None], a, jnp.inf) for a in (found.hit[1:], ideal + found.hit[:1])
    )
    focal_length = jnp.where(found.whole[0], scale[:, 1, 1], jnp.inf)
    return Distortion(relative, real, ideal, focal_length)


def outwards(real: Array, ideal: Array) -> Array:
    """Displacements (...) of points from ideal ones, (..., D), along and relative to the distance
    of the ideal point from the image of the axis; 0 on the axis, inf for one at infinity."""
    near = jnp.isfinite(ideal)
    ideal = jnp.where(near, ideal, 0)
    square = jnp.sum(ideal**2, axis=-1)
    moved = safe_divide(jnp.sum(real * ideal, axis=-1) - square, square)
    return jnp.where(jnp.all(near, axis=-1), moved, jnp.inf)


def _chief_rays(lens: Lens, scene: Scene) -> _ChiefRays:
    """The chief rays of the points of a scene that fits the lens."""
    if known_values((lens, scene)) is None:
        return _traced(lens, scene, SEARCH)
    count, shape, (field, far) = math.prod(scene.shape), scene.shape, scene.flat()
    line = scene.at(field, far if scene.distance.ndim else scene.distance)
    far = line.distance
    known = known_rays(lens, line, CHIEF.T.astype(lens.curvature.dtype))
    # Padding lets similar numbers of points share a program.
    there, size = np if concrete(line) else jnp, count + -count % _POINTS
    pad = lambda a, there=np: there.resize(a, (size, *a.shape[1:]))  # noqa: E731
    padded = line.at(pad(line.field, there), pad(far, there) if far.ndim else far)
    return _first(_traced(lens, padded, jax.tree.map(pad, known)), shape)


@functools.partial(program, static_argnames="shape")
def _first(found: _ChiefRays, shape: tuple[int, ...]) -> _ChiefRays:
    """The first chief rays, as many as a scene of a shape has points, with that shape."""
    count = math.prod(shape)
    return jax.tree.map(lambda a: a[:count].reshape(*shape, *a.shape[1:]), found)


@functools.partial(jit, wanted=LARGE)
def _traced(lens: Lens, scene: Scene, known: Known) -> _ChiefRays:
    """`_chief_rays`, compiled."""
    return over_points(functools.partial(_chief_ray, lens), scene, known)


def _chief_ray(lens: Lens, scene: Scene, known: Known) -> _ChiefRays:
    """The chief rays of one point."""
    field = scene.field

    def arriving(point: Vector, field: Array) -> tuple[tuple[Vector, Array, Vector], Bundle]:
        """Hit, sag and slope at the sensor, which are differentiated; and the rays."""
        bundle = trace_bundle(lens, scene.at(field), point, known)
        hit, slope = (tuple(a[:, 0] for a in vector) for vector in (bundle.sensor, bundle.slopes))
        row = jax.tree.map(lambda a: a[..., -1], lens.shape)
        return (hit, surface_sag(hit, row, lens.forms[-1]), slope), bundle

    points = tuple(jnp.asarray(CHIEF, lens.curvature.dtype))
    (hit, _, slope), jvp, bundle = jax.linearize(arriving, points, field, has_aux=True)
    whole, angle = bundle.arrives[:, 0], arrival_angle(lens, bundle)[:, 0]
    still, units = jax.tree.map(jnp.zeros_like, points), jnp.eye(2, dtype=field.dtype)
    # Derivatives by the stop point of the hits on the plane through the chief ray's hit: less the
    # slope times the change of the sag.
    columns = []
    for k in range(2):
        shift = tuple(jnp.full_like(p, float(k == j)) for j, p in enumerate(points))
        d_hit, d_sag, d_slope = jvp(shift, jnp.zeros_like(field))
        columns.append(([a - m * d_sag for a, m in zip(d_hit, slope)], d_slope))
    by_field = jnp.stack([jnp.stack(jvp(still, unit)[0], axis=-1) for unit in units], axis=-1)
    tangential, sagittal = _foci(scene, columns)
    lost = lambda a: jnp.where(whole, a, jnp.inf)  # noqa: E731
    return _ChiefRays(
        jnp.stack(hit, axis=-1), lost(angle), lost(tangential), lost(sagittal), by_field, whole
    )


def arrival_angle(lens: Lens, bundle: Bundle) -> Array:
    """Angles (..., W, Q), radians, 0 or more, between rays and the normal of the sensor's vertex;
    0 for a failed ray. Those that leave an afocal lens are its hits, see `rays.trace.at_infinity`.
    """
    if lens.afocal:
        return safe_sqrt(dot(bundle.sensor, bundle.sensor)) / FOCAL
    *across, along = bundle.arrival
    return jnp.arctan2(safe_sqrt(dot(across, across)), jnp.where(bundle.arrives, jnp.abs(along), 1))


def _foci(scene: Scene, columns: list[tuple]) -> tuple[Array, Array]:
    """Tangential and sagittal foci (W,), mm.

    columns: derivatives of hit and slope by the two components of the stop point.

    det(h_p + s m_p) = 0 has the roots s = eigenvalues of M = -m_p^-1 h_p, a matrix that maps the
    plane of the stop onto itself: mean +- sqrt(half^2 + b c), with
    M = [[mean + half, b], [c, mean - half]]. The tangential one is on that side of the mean where
    e.M e is, e the direction of the field.
    """
    rows = tuple(zip(*(d_slope for _, d_slope in columns)))
    first, second = (divide(rows, tuple(-a for a in d_hit)) for d_hit, _ in columns)
    (a, c), (b, d) = first, second
    mean, half, product = (a + d) / 2, (a - d) / 2, b * c
    root = safe_sqrt(half**2 + product)
    # `turned` is mean - e.M e, e = (x, y) the direction of the field.
    tangent = jax.lax.stop_gradient(scene.tangent)
    size = safe_sqrt(jnp.sum(tangent**2))
    x, y = safe_divide(tangent, jnp.broadcast_to(size, (2,)))
    y = jnp.where(size > 0, y, 1)
    turned = half * (y**2 - x**2) - (b + c) * x * y
    sign = jnp.where(turned < 0, -1, 1).astype(mean.dtype)
    focused = determinant(rows) != 0
    pair = mean - sign * root, mean + sign * root
    return tuple(jnp.where(focused, s, jnp.inf) for s in pair)  # type: ignore[return-value]
