"""An independent sequential trace in plain NumPy, for derivatives by a complex step.

Nothing of the package is used. Rays are refracted one surface after the other by Snell's law
(Welford, Aberrations of Optical Systems, ch. 4; Spencer and Murty, JOSA 52, 672, 1962) and
aimed at the stop by Newton's method. All functions are analytic, so that a parameter moved by
i h gives its derivative as Im(f) / h without any difference (Squire and Trapp, SIAM Rev. 40,
110, 1998): h = 1e-30 leaves no truncation.

A surface with the same medium on both sides, stop or not, is off the path: the straight ray
behind the last surface in front of it, prolonged forwards or backwards, crosses it somewhere,
and goes on from where it was.

Arrays may have leading axes, one place for each moved parameter; behind them come
(wavelength, ray). Lengths in mm, angles in radians, wavelengths in um; surfaces, signs, tilts
and decentres as in the package, the sensor the last row.
"""

import dataclasses
from typing import NamedTuple

import numpy as np

from .oracle_surfaces import cross, dot

STEP = 1e-30
LENS = ("curvature", "conic", "coefficients", "thickness", "semi_diameter", "sensor")
MOVES = ("decentre", "tilt")
MEDIA = ("schott", "strength", "resonance")
SCENE = ("field", "distance")


@dataclasses.dataclass(frozen=True)
class Scene:
    """A lens and its object. `values`: the arrays of a `drt_jax.Lens` by name, those of its
    dispersion, field (2,) and distance (). joined (S,): surfaces with the same glass on both sides
    and no mirror, which are left out of the path."""

    values: dict[str, np.ndarray]
    stop: int
    forms: tuple[str, ...]
    mirrors: tuple[bool, ...]
    joined: tuple[bool, ...]
    wavelengths: np.ndarray

    @classmethod
    def of(cls, lens, field, distance, wavelengths):
        count = len(lens.mirrors)
        values = {name: np.asarray(getattr(lens, name)) for name in LENS}
        values |= {name: np.asarray(getattr(lens.dispersion, name)) for name in MEDIA}
        for name, columns in zip(MOVES, (2, 3)):
            array = getattr(lens, name)
            values[name] = np.zeros((count + 1, columns)) if array is None else np.asarray(array)
        field = np.asarray(field, float)
        values["field"] = np.array([0.0, field]) if field.ndim == 0 else field
        values["distance"] = np.asarray(distance, float)
        joined = tuple(
            lens.glasses[i] == lens.glasses[i + 1] and not lens.mirrors[i] for i in range(count)
        )
        return cls(values, lens.stop, lens.forms, lens.mirrors, joined, np.asarray(wavelengths))

    def replace(self, **values):
        return dataclasses.replace(self, values=self.values | values)

    @classmethod
    def stack(cls, scenes):
        """Scenes of one structure, stacked along a leading axis."""
        first = scenes[0]
        arrays = {k: np.stack([each.values[k] for each in scenes]) for k in first.values}
        return dataclasses.replace(first, values=arrays)


def _wide(value):
    """A parameter (...), broadcast against (..., wavelength, ray)."""
    return np.asarray(value)[..., None, None]


def _rotate(v, axis, angle):
    """The vector `v` rotated right-handed about a coordinate axis."""
    cosine, sine = np.cos(angle), np.sin(angle)
    p, q = (axis + 1) % 3, (axis + 2) % 3
    turned = [None] * 3
    turned[axis] = v[axis]
    turned[p] = cosine * v[p] - sine * v[q]
    turned[q] = sine * v[p] + cosine * v[q]
    return turned


def indices(scene):
    """Refractive index (..., S + 1, W) of the media."""
    square = scene.wavelengths**2
    b, c, a = (scene.values[name][..., None] for name in ("strength", "resonance", "schott"))
    n2 = np.sum(b * square / (square - c), axis=-2)
    for j, power in enumerate((0, 2, -2, -4, -6, -8)):
        n2 = n2 + a[..., j, :] * scene.wavelengths ** float(power)
    n = np.sqrt(n2)
    for i, joined in enumerate(scene.joined):
        if joined:
            n[..., i + 1, :] = n[..., i, :]
    return n


def vertices(scene):
    """z of the S vertices and the sensor (..., S + 1)."""
    thickness, sensor = scene.values["thickness"], scene.values["sensor"]
    batch = np.broadcast_shapes(thickness.shape[:-1], sensor.shape)
    z = [np.zeros(batch, complex)]
    for i in range(thickness.shape[-1]):
        z.append(z[-1] + thickness[..., i])
    return np.stack([*z, np.broadcast_to(sensor, batch)], axis=-1)


class Trace(NamedTuple):
    """own, hits: components x, y, z along the axes of each surface and along those of the lens, S +
    1 each; path (..., W, Q), mm; good (..., W, Q): real rays that meet every surface, the sensor
    and the dummies from the front, run forwards from active surface to active surface, and are not
    totally reflected."""

    own: list
    hits: list
    path: np.ndarray
    good: np.ndarray


def _bend(d, slopes, ratio, mirror):
    """Direction behind a surface, the cosine of the incidence against its normal along z, and
    whether the light passes."""
    size = np.sqrt(1 + slopes[0] ** 2 + slopes[1] ** 2)
    normal = [-slopes[0] / size, -slopes[1] / size, 1 / size]
    along = dot(normal, d)
    sign = np.where(np.real(along) < 0, -1.0, 1.0)
    normal, cosine = [sign * a for a in normal], sign * along
    square = 1 - ratio**2 * (1 - cosine**2)
    # n sin is kept, also where a mirror lies between media that are moved apart.
    leaving = -np.sqrt(square) if mirror else np.sqrt(square)
    bent = [ratio * a + (leaving - ratio * cosine) * b for a, b in zip(d, normal)]
    return bent, along, np.real(square) > 0


def _from_source(point, v, tangent):
    """|P - P0| - |P0| for P0 = -(tangent, 1) / v, from the difference of two squares."""
    source = [-tangent[0], -tangent[1], -1.0]
    first = [v * a - b for a, b in zip(point, source)]
    top = sum(v * a**2 - 2 * a * b for a, b in zip(point, source))
    return top / (np.sqrt(dot(first, first)) + np.sqrt(dot(source, source)))


@np.errstate(all="ignore")  # of rays that are not good
def trace(scene, x, y, stop_only=False):
    """Rays through the points (x, y, 0) mm, (..., W, Q), to a `Trace`.

    The optical path is counted as the package does: from the sphere round the object (the plane
    wave) through the first vertex. With `stop_only`, the list `own` up to the stop.
    """
    values, n, z0 = scene.values, indices(scene), vertices(scene)
    far = np.all(np.isinf(np.real(values["distance"])))
    v = 0.0 if far else 1 / _wide(values["distance"])
    tangent = [np.tan(_wide(values["field"][..., i])) for i in (0, 1)]
    point = [x + 0j, y + 0j, 0 * (x + y) + 0j]
    segment = [v * point[0] + tangent[0], v * point[1] + tangent[1], 1 + 0 * point[2]]
    length = np.sqrt(dot(segment, segment))
    d = [s / length for s in segment]
    count, sense = len(scene.mirrors), 1
    own_hits, hits, path = [], [], None
    good = np.ones(np.broadcast_shapes(*(np.shape(a) for a in d)), bool)
    for i in range(count + 1):
        origin = [*(_wide(values["decentre"][..., i, j]) for j in (0, 1)), _wide(z0[..., i])]
        tilt = [_wide(values["tilt"][..., i, j]) for j in range(3)]
        p, own_d = [a - b for a, b in zip(point, origin)], d
        for axis in range(3):
            p, own_d = _rotate(p, axis, -tilt[axis]), _rotate(own_d, axis, -tilt[axis])
        a = values["coefficients"]
        shape = [_wide(values[name][..., i]) for name in ("curvature", "conic")]
        shape.append([_wide(a[..., i, j]) for j in range(a.shape[-1])])
        q, slopes, s, met = cross(scene.forms[i], p, own_d, shape)
        good = good & met
        own_hits.append(q)
        if stop_only and i == scene.stop:
            return own_hits
        back = q
        for axis in (2, 1, 0):
            back = _rotate(back, axis, tilt[axis])
        hits.append([a + b for a, b in zip(back, origin)])
        if i < count and scene.joined[i]:
            continue
        point, before = hits[-1], n[..., i, :, None]
        if path is None:
            path = before * _from_source(point, v, tangent)
        else:
            path, good = path + before * s, good & (np.real(s) > 0)
        good &= np.real(own_d[2]) * sense > 0
        if i == count:
            break
        ratio = before / n[..., i + 1, :, None]
        own_d, along, passes = _bend(own_d, slopes, ratio, scene.mirrors[i])
        good = good & passes & (np.real(along) * sense > 0)
        sense = -sense if scene.mirrors[i] else sense
        for axis in (2, 1, 0):
            own_d = _rotate(own_d, axis, tilt[axis])
        d = own_d
    return Trace(own_hits, hits, path, good)


@np.errstate(all="ignore")
def reach(scene, pupil):
    """Launch of the rays (..., W, Q) through the stop points `pupil` (2, Q); the 2 x 2 inverse of
    the derivative of the stop point by the launch; and whether the last Newton step was within
    rounding. The scene is real. Field and aperture are increased in steps."""
    lead = np.broadcast_shapes(*(scene.values[k].shape[:-1] for k in ("field", "curvature")))
    shape = (*lead, len(scene.wavelengths), pupil.shape[1])
    radius = _wide(scene.values["semi_diameter"][..., scene.stop])
    x, y = (np.broadcast_to(0.3 * radius * p, shape) for p in pupil)
    for part in (0.3, 0.6, 0.8, 0.9, 1.0):
        eased = scene.replace(field=part * scene.values["field"])
        for _ in range(30 if part == 1 else 8):
            by_x = trace(eased, x + 1j * STEP, y, stop_only=True)[-1]
            by_y = trace(eased, x, y + 1j * STEP, stop_only=True)[-1]
            miss = [np.real(by_x[j]) - part * radius * pupil[j] for j in (0, 1)]
            (a, b), (c, d) = (np.imag([by_x[j], by_y[j]]) / STEP for j in (0, 1))
            inverse = np.array([[d, -b], [-c, a]]) / (a * d - b * c)
            step = [inverse[j, 0] * miss[0] + inverse[j, 1] * miss[1] for j in (0, 1)]
            step = np.where(np.isfinite(step), step, 1.0)
            x, y = x - step[0], y - step[1]
            settled = np.max(np.abs(step), axis=0) < 1e-13 * (1 + np.hypot(x, y))
            if np.all(settled):
                break
    return x, y, inverse, settled


def _aimed(scene, pupil):
    """The first three results of `reach`; ArithmeticError if there is no ray."""
    *start, settled = reach(scene, pupil)
    if not np.all(settled):
        raise ArithmeticError(f"{np.sum(~settled)} rays do not reach the stop")
    return start


def aim(scene, pupil, start=None):
    """Launch (x, y), (..., W, Q), of the rays through the stop points `pupil` (2, Q), in units of
    the stop's semi-diameter. The scene may be complex; `start`: result of `_aimed`."""
    plain = scene.replace(**{k: np.real(v) for k, v in scene.values.items()})
    x, y, inverse = _aimed(plain, pupil) if start is None else start
    radius = _wide(scene.values["semi_diameter"][..., scene.stop])
    for _ in range(3):
        hit = trace(scene, x, y, stop_only=True)[-1]
        miss = [hit[j] - radius * pupil[j] for j in (0, 1)]
        x = x - inverse[0, 0] * miss[0] - inverse[0, 1] * miss[1]
        y = y - inverse[1, 0] * miss[0] - inverse[1, 1] * miss[1]
    return x, y


def xyz(rays):
    """The hits of a `Trace` along the axes of the lens, (..., W, Q, S + 1, 3)."""
    return np.stack([np.stack(np.broadcast_arrays(*hit), -1) for hit in rays.hits], -2)


def rays_of(lens, scene, pupil):
    """Hits (P, W, Q, S + 1, 3), mm, along the axes of the lens, and optical paths (P, W, Q), mm, of
    rays through `pupil` (Q, 2), from the P points of a `drt_jax.Scene`. ArithmeticError or
    AssertionError where a ray fails; apertures are ignored."""
    fields, far = (np.asarray(a) for a in scene.flat())
    each = [Scene.of(lens, *point, np.asarray(scene.wavelengths)) for point in zip(fields, far)]
    points = Scene.stack(each)
    found = trace(points, *aim(points, np.asarray(pupil).T))
    assert np.all(found.good)
    return np.real(xyz(found)), np.real(found.path)


def outputs(scene, rule, symmetry, points, starts=(None, None)):
    """centroid (..., W, 2), covariance (..., W, 2, 2), path (..., W, Q) and hits
    (..., W, Q, S + 1, 3) along the axes of the lens.

    The moments are averages over `rule` = points (2, n) and weights of the disc ("none"), of
    its half x > 0 ("bilateral") or of the radius x = 0, y > 0 ("rotational"); path and hits are
    those of the rays through `points` (2, Q).
    """
    nodes, weights = rule
    x, y, _ = trace(scene, *aim(scene, nodes, starts[0])).own[-1]

    def average(values):
        return np.sum(weights * values, axis=-1)

    zero = 0 * average(x)
    if symmetry == "rotational":
        mean, (xx, yy, xy) = [zero, zero], [average(y * y) / 2] * 2 + [zero]
    else:
        mean = [zero if symmetry == "bilateral" else average(x), average(y)]
        x, y = x - mean[0][..., None], y - mean[1][..., None]
        xx, yy, xy = average(x * x), average(y * y), average(x * y)
        xy = zero if symmetry == "bilateral" else xy
    covariance = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    rays = trace(scene, *aim(scene, points, starts[1]))
    centroid = np.stack(mean, -1)
    return {"centroid": centroid, "covariance": covariance, "path": rays.path, "hits": xyz(rays)}


def jacobian(scene, rule, symmetry, points, names):
    """{output: {parameter: array, shape of the output + shape of the parameter}}, by all elements
    of the parameters `names`, with a complex step."""
    starts = _aimed(scene, rule[0]), _aimed(scene, points)
    jacobians = {}
    for name in names:
        value = scene.values[name]
        moved = value + 1j * STEP * np.eye(value.size).reshape(value.size, *value.shape)
        if name == "semi_diameter":  # those of the other surfaces may be infinite
            moved = np.where(np.isinf(value), np.inf, moved)
        batch = {k: v[None] for k, v in scene.values.items()} | {name: moved}
        for output, f in outputs(scene.replace(**batch), rule, symmetry, points, starts).items():
            f = np.moveaxis(np.broadcast_to(f, (value.size, *f.shape[1:])), 0, -1)
            column = np.imag(f).reshape(*f.shape[:-1], *value.shape) / STEP
            jacobians.setdefault(output, {})[name] = column
    return jacobians
