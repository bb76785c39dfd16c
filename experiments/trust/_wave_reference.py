"""Diffraction transfer functions and images from the sequential trace alone, for an object at
infinity.

Huygens' waves start from a sphere of the radius R about the centroid C of the spot, through the
paraxial exit pupil. A ray crosses the sphere at S, after the optical path L. There it contributes a
wave towards C with the direction cosines d = n (C - S) / R:

    field(x) = integral of P exp(ik (L + n |x - S|)) dd,
    OTF(f) = integral of Q(d + s / 2) conj(Q(d - s / 2)) dd / integral of P^2 dd,  s = f wavelength,

where Q = P exp(ik (L - d.C)) uses the approximation n |x - S| = n R + d.(x - C) of all pupil
functions. Light fills evenly either the stop, P^2 = |dp / dd|, or the beam in front of the lens,
P^2 = |dq / dd|; with pupil aberrations these differ. Results are for both, in this order.

Both integrals are over the coordinates q of `_reference`, so that no ray is aimed at the stop and
the pupil is not sampled by a grid. The rays of d + s / 2 and d - s / 2 are found by Newton's
method. The region of integration, where both rays pass, has corners, at which panels of Gauss nodes
end.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from drt_jax import Lens, first_order
from drt_jax.compilation import jit

from ._reference import LEAD, Region, beyond, heights_within, outside_of, trace
from .snell import QUICK, trace_snell

_UM = 1e3  # per mm
_NEWTON = 6
_RADII, _AZIMUTHS = 64, 24  # nodes: phases change by many periods over the pupil
_POINTS = 512  # points of an image that are computed at a time


class _Light(NamedTuple):
    """A lens and the light through it.

    scene: as in `_reference`, with an object at infinity.
    centre: (3,), C, mm. radius: (), R, mm.
    """

    lens: Lens
    scene: Array
    centre: Array
    radius: Array

    @property
    def wave_number(self) -> Array:
        """1/mm."""
        return 2 * jnp.pi * _UM / self.scene[2]


class _Wave(NamedTuple):
    """The pupil function at one direction.

    direction: (2,), d. path: (), L, mm. place: (3,), S, mm. light: (2,), P^2 |dd / dq|. spread: (),
    |dd / dq|.
    """

    direction: Array
    path: Array
    place: Array
    light: Array
    spread: Array


def _ray(of: _Light, q: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    """Stop point and direction, (4,), to be differentiated; and direction, path and position on the
    sphere."""
    field, _, wavelength = of.scene
    start = jnp.append(q, -LEAD)
    along = jnp.stack([0 * field, jnp.sin(field), jnp.cos(field)])
    hits, _ = trace_snell(of.lens, wavelength, start, along)
    index = of.lens.index(wavelength[None])[:, 0]
    legs = jnp.diff(jnp.concatenate([start[None], hits]), axis=0)
    lengths = jnp.linalg.norm(legs, axis=1)
    last, off = legs[-1] / lengths[-1], hits[-1] - of.centre
    back = last @ off + jnp.sqrt((last @ off) ** 2 - off @ off + of.radius**2)  # from hit to sphere
    place = hits[-1] - back * last
    path = index[0] * (start @ along) + index @ lengths - index[-1] * back
    direction = (index[-1] * (of.centre - place) / of.radius)[:2]
    return jnp.concatenate([hits[of.lens.stop, :2], direction]), (direction, path, place)


def _wave(of: _Light, q: Array) -> _Wave:
    slopes, known = jax.jacfwd(partial(_ray, of), has_aux=True)(q)
    stop, spread = (jnp.abs(jnp.linalg.det(part)) for part in (slopes[:2], slopes[2:]))
    return _Wave(*known, jnp.stack([stop, jnp.ones_like(stop)]), spread)


def _turned(of: _Light, q: Array, by: Array) -> tuple[Array, Array]:
    """q of the ray whose direction differs by `by`, (2,), from that of the ray at q; and the
    remaining error of its direction."""

    def ray(q):
        direction = _ray(of, q)[0][2:]
        return direction, direction

    aim = ray(q)[0] + by

    def closer(_, place):
        slope, found = jax.jacfwd(ray, has_aux=True)(place)
        return place + jnp.linalg.solve(slope, aim - found)

    place = jax.lax.fori_loop(0, _NEWTON, closer, q)
    return place, jnp.max(jnp.abs(ray(place)[0] - aim))


@partial(jit, wanted=QUICK)
def _overlap(of: _Light, reach: Array, shear: Array, part: float) -> tuple[Array, Array]:
    """Autocorrelation of the pupil function at a shear.

    shear: (2,), difference of the directions, along one axis. part: as in `_reference`.

    Returns the integrals (2, 2), [real and imaginary, light], and the number of corners.
    """

    def ends(q):
        return [_turned(of, q, by) for by in (shear / 2, -shear / 2)]

    def excess(q):
        def outside(place, miss):
            beyond = outside_of(of.lens, of.scene, place)
            return jnp.where((miss < 1e-9) & jnp.isfinite(beyond), beyond, 1)

        return jnp.concatenate([outside(*end) for end in ends(q)])

    low, high, _ = heights_within(excess, reach)
    region = Region(excess, low + part * (high - low), reach)
    azimuth, width, corners = region.half_lines(_AZIMUTHS)

    def phase(wave):
        return of.wave_number * (wave.path - wave.direction @ of.centre[:2])

    def line(angle):
        radius, _ = region.edge(angle)

        def node(t, weight):
            q = region.point(angle, radius * t)
            first, second = (_wave(of, place) for place, _ in ends(q))
            light = jnp.sqrt(first.light / first.spread * second.light / second.spread)
            area = _wave(of, q).spread * radius**2 * t * weight
            turn = phase(first) - phase(second)
            return area * jnp.stack([jnp.cos(turn), jnp.sin(turn)])[:, None] * light[None]

        t, weight = np.polynomial.legendre.leggauss(_RADII)
        return jnp.sum(jax.vmap(node)(jnp.asarray(1 + t) / 2, jnp.asarray(weight)), axis=0)

    half = jnp.tensordot(width, jax.vmap(line)(azimuth), 1)
    # The mirror image in x changes the sign of a shear along x, which conjugates the integral.
    both = jnp.stack([jnp.ones_like(reach), jnp.where(shear[0] == 0, 1.0, 0.0)])
    return 2 * half * both[:, None], corners


@partial(jit, wanted=QUICK)
def _nodes(of: _Light, reach: Array, part: float) -> tuple[_Wave, Array, Array]:
    """The pupil function at nodes of half of the pupil, the areas of the nodes in q, and the
    heights of their hits on the sensor."""
    excess = partial(outside_of, of.lens, of.scene)
    low, high, _ = heights_within(excess, reach)
    region = Region(excess, low + part * (high - low), reach)
    azimuth, width, _ = region.half_lines(_AZIMUTHS)
    t, weight = np.polynomial.legendre.leggauss(_RADII)

    def line(angle):
        radius, _ = region.edge(angle)
        places = jax.vmap(lambda t: region.point(angle, radius * t))(jnp.asarray(1 + t) / 2)
        area = radius**2 * jnp.asarray((1 + t) * weight) / 4
        hits = jax.vmap(partial(trace, of.lens, of.scene))(places)[0][:, -1, 1]
        return jax.vmap(partial(_wave, of))(places), area, hits

    waves, area, hits = jax.vmap(line)(azimuth)
    found = waves, area * width[:, None], hits
    return jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), found)


def _light(lens: Lens, field: float, wavelength: float) -> tuple[_Light, float]:
    """The light, and the reach of `_reference`."""
    scene, reach = jnp.array([field, 0.0, wavelength]), beyond(lens, field)
    pupil = lens.vertices[-2] + first_order(lens, np.inf, scene[2:]).exit_pupil.position[0]
    centre = jnp.stack([0 * lens.sensor, 0 * lens.sensor, lens.sensor])
    first = _Light(lens, scene, centre, jnp.abs(lens.sensor - pupil))
    waves, area, heights = _nodes(first, reach, 0.5)
    light = waves.light[:, 0] * area
    return first._replace(centre=centre.at[1].set(light @ heights / jnp.sum(light))), reach


def transfer(
    lens: Lens, field: float, wavelength: float, frequencies: Sequence[float]
) -> tuple[np.ndarray, float]:
    """Modulus of the transfer functions of a centred lens, (2, 2, N), [light, tangential and
    sagittal], and the largest change when other nodes are used.

    field: angle along y, radians. wavelength: um. frequencies: cycles/mm.
    """
    of, reach = _light(lens, field, wavelength)
    shears = [f * wavelength / _UM * np.eye(2)[axis] for axis in (1, 0) for f in frequencies]
    found = []
    for part in (0.5, 0.57):
        light = np.asarray(_overlap(of, reach, jnp.zeros(2), part)[0][0])
        waves = [np.asarray(_overlap(of, reach, jnp.asarray(s), part)[0]) for s in shears]
        found.append(np.array([np.hypot(*wave) / light for wave in waves]).T.reshape(2, 2, -1))
    return found[0], float(np.max(np.abs(found[0] - found[1])))


def image(
    lens: Lens, field: float, wavelength: float, places: np.ndarray
) -> tuple[np.ndarray, float]:
    """Irradiance (2, N), [light], at `places` (N, 2) on the sensor, mm, in 1/mm^2 of all light; and
    the largest change when other nodes are used, relative to the peak. Other arguments as in
    `transfer`."""
    (of, reach), found = _light(lens, field, wavelength), []
    index, wave_number = float(lens.index(of.scene[2:])[-1, 0]), float(of.wave_number)
    for part in (0.5, 0.57):
        waves, area, _ = jax.tree.map(np.asarray, _nodes(of, reach, part))
        size = np.sqrt(waves.light * waves.spread[:, None]) * area[:, None]  # P dd
        wave = size * np.exp(1j * wave_number * waves.path)[:, None]
        light = 2 * (wavelength / _UM) ** 2 * area @ waves.light
        fields = []
        for some in np.array_split(places, -(-len(places) // _POINTS)):
            both = 0
            for mirror in (1, -1):  # the half with x < 0
                off = waves.place[None] - np.pad(some * [mirror, 1], ((0, 0), (0, 1)))[:, None]
                off[..., 2] -= float(lens.sensor)
                far = np.sqrt(np.sum(off**2, axis=-1)) - float(of.radius)
                both = both + np.exp(1j * wave_number * index * far) @ wave
            fields.append(both)
        found.append((np.abs(np.concatenate(fields)) ** 2 / light).T)
    return found[0], float(np.max(np.abs(found[0] - found[1])) / np.max(found[0]))
