"""Other programs for the work of `benchmark`: an optional extra, each may be missing.

A peer receives the numbers of the lens, and samples the pupil with its own samplings, or with rays
that we aimed. Differences of definition count as its error.
"""

import itertools
import types
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

import drt_jax
from drt_jax import pupil

from ._common import rings
from ._reference import changed, flatten

# Steps of batoid's central differences, for curvatures (1/mm) and distances (mm): those with the
# smallest error of the steps from 1e-7 to 1e-12. One-sided differences have an error of 2 % with
# steps of 1e-7, and of 3e-4 with the best step.
BENT, MOVED = 1e-8, 1e-6
# Distance from the launch of rays to their first hits, mm.
_BEFORE = 15.0


class Variant(NamedTuple):
    """Numbers of a lens: curvatures and gaps (S,), and position and semi-diameter (mm) of the
    paraxial entrance pupil."""

    curvature: np.ndarray
    gaps: np.ndarray
    pupil: tuple[float, float]


class Rays(NamedTuple):
    """Rays of one object point.

    points, weights: (Q, 2) on the unit disc, and (Q,).
    aim: "paraxial": at the paraxial entrance pupil; "iterative": at the stop, a mode of Optiland.
    launch: first hits and directions, (V, W, Q, 3) each, of rays that we aimed, for each variant of
        a lens; None for rays that are not launched by us.
    free: (2,), 0 if the mean of x or of y is 0 by symmetry, otherwise 1.
    """

    points: np.ndarray
    weights: np.ndarray
    aim: str = "paraxial"
    launch: tuple[np.ndarray, np.ndarray] | None = None
    free: tuple[int, int] = (1, 1)

    def starts(self, k: int, wave: int) -> tuple[np.ndarray, np.ndarray]:
        """Points in front of the lens and directions, (Q, 3) each, of the rays of `launch`."""
        hits, directions = (np.asarray(a[k, wave]) for a in self.launch or ())
        return hits - _BEFORE * directions, directions


def _gaussian(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Optiland's GaussianQuadrature with `size` rings."""
    from optiland import backend
    from optiland.distribution import GaussianQuadrature

    backend.set_backend("numpy")
    own = GaussianQuadrature()
    own.generate_points(size)
    return np.stack([own.x, own.y], axis=1), own.weights


# (points, weights) of about the given number of rays; for "Gaussian", of the given number of rings.
PATTERNS: dict[str, Callable[[int], tuple[np.ndarray, np.ndarray]]] = {
    "hexapolar": lambda size: pupil.hexapolar(rings(size)),
    "random": lambda size: pupil.random_disc(size, 0),
    "Gaussian": _gaussian,
}


def rays_of(pattern: Callable, size: int, aim: str) -> Rays:
    """Rays of a pattern."""
    return Rays(*pattern(size), aim)


def shifted(lens: drt_jax.Lens) -> Array:
    """Numbers of the lens (4 S + 1, 2 S) in the order of `flatten`: unchanged, then each increased
    and each decreased by its step. A thickness does not move the sensor."""
    steps = np.diag(np.repeat([BENT, MOVED], lens.count))
    return flatten(lens)[None] + np.concatenate([np.zeros((1, len(steps))), steps, -steps])


_first_order = jax.jit(drt_jax.first_order)


class Lens:
    """A centred lens of aspheres as NumPy arrays, and a scene. ValueError for other lenses.

    It has gaps (S,), of which the last is that to the sensor, index (S + 1, W), field in radians,
    distance in mm, and:

    clear: (S,), radius of each clear aperture, mm; inf at the stop, which rays fill.
    variants: the lens with each row of `values`, (V, P). None for the rows of `shifted`: the lens
        and 4 S changed ones.
    """

    def __init__(
        self, lens: drt_jax.Lens, field: float, distance: float, wavelengths, values: Any = None
    ) -> None:
        if set(lens.forms) != {"asphere"} or lens.phase or lens.elements or lens.tilt is not None:
            raise ValueError("no centred lens of aspheres")
        self.conic = np.asarray(lens.conic, float)[:-1]
        self.coefficients, self.mirrors = np.asarray(lens.coefficients, float)[:-1], lens.mirrors
        self.index = np.asarray(lens.index(np.asarray(wavelengths)), float)
        self.stop, self.semi = lens.stop, float(lens.semi_diameter[lens.stop])
        self.clear = np.array(lens.semi_diameter, float)[:-1]
        self.clear[lens.stop] = np.inf
        self.field, self.distance, self.wavelengths = field, distance, tuple(wavelengths)
        rows = shifted(lens) if values is None else values
        self.variants = []
        for row in rows:
            first = _first_order(changed(lens, row), distance, np.asarray(wavelengths))
            curvature, thickness, sensor = np.split(np.asarray(row), [lens.count, -1])
            gaps = np.append(thickness, sensor - np.sum(thickness))
            entrance = tuple(float(a[0]) for a in first.entrance_pupil)
            self.variants.append(Variant(curvature, gaps, entrance))
        self.curvature, self.gaps, self.pupil = self.variants[0]


def _sigma(x: Any, y: Any, weights: Any, free: tuple[int, int]) -> Any:
    """RMS radius of hits (Q,), arrays of any program."""
    share = weights / weights.sum()
    away = (a - f * (share * a).sum() for a, f in zip((x, y), free))
    return sum((share * a**2).sum() for a in away) ** 0.5


def _optiland_system(lens: Lens, index: np.ndarray, wavelength: float, k: int = 0):
    """An Optiland lens for one wavelength, um. index: (S + 1,). k: index of the variant."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic

    optic = Optic()
    optic.surfaces.add(index=0, thickness=lens.distance)
    curvature, gaps, _ = lens.variants[k]
    for i, (c, gap) in enumerate(zip(curvature, gaps)):
        medium = "mirror" if lens.mirrors[i] else IdealMaterial(n=float(index[i + 1]))
        kind = {"thickness": gap, "material": medium, "is_stop": i == lens.stop}
        shape = {"radius": 1 / c if c else np.inf, "conic": lens.conic[i]}
        if np.isfinite(lens.clear[i]):
            kind["aperture"] = 2 * lens.clear[i]
        if np.any(lens.coefficients[i]):
            shape |= {"surface_type": "even_asphere", "coefficients": lens.coefficients[i].tolist()}
        optic.surfaces.add(index=i + 1, **kind, **shape)
    optic.surfaces.add(index=len(lens.gaps) + 1)
    optic.set_aperture("float_by_stop_size", 2 * lens.semi)
    optic.surfaces[lens.stop + 1].semi_aperture = lens.semi  # needed by its ray aiming
    if np.isinf(lens.distance):
        optic.fields.set_type("angle")
        optic.fields.add(y=np.degrees(lens.field))
    else:
        optic.fields.set_type("object_height")
        optic.fields.add(y=-lens.distance * np.tan(lens.field))
    optic.wavelengths.add(wavelength, is_primary=True)
    return optic


def _optiland_hits(optic: Any, lens: Lens, rays: Rays, wave: int, k: int = 0) -> Any:
    """Traced rays of variant k. wave: index of the wavelength."""
    from optiland import backend
    from optiland.rays import RealRays

    wavelength = lens.wavelengths[wave]
    if rays.launch is None:
        points = types.SimpleNamespace(**dict(zip("xy", map(backend.array, rays.points.T))))
        given = 0, 1 if lens.field else 0, wavelength, None, points
        return optic.trace(*given, record=False)
    place, along = rays.starts(k, wave)
    one = np.ones(len(place))
    found = RealRays(*place.T, *along.T, one, wavelength * one)
    optic.surfaces.trace(found, record=False)
    return found


def optiland_spot(lens: Lens, rays: Rays, count: int = 1) -> Callable:
    """A function value(k) -> RMS spot radii sigma (W,), mm, with NumPy, for the first `count`
    variants."""
    from optiland import backend

    backend.set_backend("numpy")
    colours = [*zip(lens.index.T, lens.wavelengths)]
    systems = [[_optiland_system(lens, *own, k) for own in colours] for k in range(count)]
    for optic in itertools.chain(*systems):
        optic.ray_tracer.set_aiming(rays.aim)

    def value(k: int = 0) -> np.ndarray:
        backend.set_backend("numpy")
        sigma = []
        for wave, optic in enumerate(systems[k]):
            found = _optiland_hits(optic, lens, rays, wave, k)
            light = np.isfinite(found.x) & (found.i > 0)
            some = (a[light] for a in (found.x, found.y, rays.weights))
            sigma.append(_sigma(*some, rays.free))
        return np.array(sigma)

    return value


def optiland_gradient(lens: Lens, rays: Rays) -> Callable:
    """A function gradient() -> sigma (W,) and its derivatives (W, 2 S) by curvatures, thicknesses
    and the sensor position, NaN where unknown, with PyTorch. The launch of rays of `launch` is
    fixed, so that their stop points move with the surfaces in front of the stop."""
    import torch
    from optiland import backend

    def ready() -> None:
        backend.set_backend("torch")
        backend.set_precision("float64")
        backend.grad_mode.enable()

    ready()
    systems = [_optiland_system(lens, *own) for own in zip(lens.index.T, lens.wavelengths)]
    weights = torch.as_tensor(rays.weights)
    for optic in systems:
        optic.ray_tracer.set_aiming(rays.aim)

    def slopes(leaves: list, otherwise: float) -> np.ndarray:
        known = [torch.is_tensor(leaf) and leaf.grad is not None for leaf in leaves]
        return np.array([float(a.grad) if k else otherwise for a, k in zip(leaves, known)])

    def gradient() -> tuple[np.ndarray, np.ndarray]:
        ready()
        values, rows = [], []
        bent = np.where(lens.curvature == 0, np.nan, lens.curvature)  # planes have no radius
        for wave, optic in enumerate(systems):
            shapes = [surface.geometry for surface in optic.surfaces][1:]
            radii, places = [shape.radius for shape in shapes], [shape.cs.z for shape in shapes]
            for leaf in filter(torch.is_tensor, (*radii, *places)):
                leaf.grad = None
            found = _optiland_hits(optic, lens, rays, wave)
            sigma = _sigma(found.x, found.y, weights, rays.free)
            sigma.backward()
            place = slopes(places, 0.0)
            behind = np.cumsum(place[-2:0:-1])[::-1]  # a thickness moves all vertices behind it
            values.append(float(sigma.detach()))
            rows.append([*(-slopes(radii[:-1], np.nan) / bent**2), *behind, place[-1]])
        return np.array(values), np.array(rows)

    return gradient


def _batoid_shape(lens: Lens, i: int, c: float):
    import batoid

    if np.any(lens.coefficients[i, 1:]):
        return batoid.Asphere(1 / c, lens.conic[i], lens.coefficients[i, 1:])
    return batoid.Quadric(1 / c, lens.conic[i]) if c else batoid.Plane()


def _batoid_optic(lens: Lens, variant: Variant, index: np.ndarray):
    import batoid

    curvature, gaps, _ = variant
    if np.any(lens.coefficients[:, :1]) or np.any((curvature == 0) & np.any(lens.coefficients, 1)):
        raise ValueError("no terms of r^2, no aspheres of radius inf")
    media = [batoid.ConstMedium(float(n)) for n in index]
    items = []
    for i, (c, place) in enumerate(zip([*curvature, 0], np.append(0, np.cumsum(gaps)))):
        last = i == len(curvature)
        kind = batoid.Detector if last else batoid.RefractiveInterface
        kind = batoid.Mirror if not last and lens.mirrors[i] else kind
        shape = batoid.Plane() if last else _batoid_shape(lens, i, c)
        both = {"inMedium": media[i], "outMedium": media[min(i + 1, len(media) - 1)]}
        if not last and np.isfinite(lens.clear[i]):
            both["obscuration"] = batoid.ObscNegation(batoid.ObscCircle(lens.clear[i]))
        where = batoid.CoordSys(origin=[0, 0, place])
        items.append(kind(shape, name=f"s{i}", coordSys=where, **both))
    return batoid.CompoundOptic(items, name="lens", inMedium=media[0], outMedium=media[-1])


def _batoid_hits(optic, points, velocities):
    """Traced rays through points (Q, 3)."""
    import batoid

    hits = batoid.RayVector(*points.T.copy(), *velocities.T.copy(), wavelength=1e-6)
    optic.trace(hits)
    return hits


def _at_the_pupil(
    lens: Lens, variant: Variant, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points in front of the lens and directions, (Q, 3) each, of rays through points (Q, 2) of the
    paraxial entrance pupil."""
    place, radius = variant.pupil
    toward = np.array([0.0, np.tan(lens.field), 1.0])
    through = np.column_stack([radius * points, np.full(len(points), place)])
    # From the object point, or along the field for an object at infinity.
    direction = toward + through / lens.distance
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # On a plane in front of the first surface.
    return through + direction * ((-10.0 - radius - place) / direction[:, 2:]), direction


def batoid_spot(lens: Lens, rays: Rays, count: int = 1) -> Callable:
    """The same as `optiland_spot`, with batoid."""
    variants = lens.variants[:count]
    optics = [[_batoid_optic(lens, v, index) for index in lens.index.T] for v in variants]
    if rays.aim != "paraxial":
        raise ValueError("aims no rays")
    pupil_rays = [_at_the_pupil(lens, v, rays.points) for v in variants]

    def value(k: int = 0) -> np.ndarray:
        sigma = []
        for wave, optic in enumerate(optics[k]):
            start, along = pupil_rays[k] if rays.launch is None else rays.starts(k, wave)
            hits = _batoid_hits(optic, start, along / lens.index[0, wave])
            light = ~(hits.vignetted | hits.failed)
            some = (a[light] for a in (hits.x, hits.y, rays.weights))
            sigma.append(_sigma(*some, rays.free))
        return np.array(sigma)

    return value


def differences(value: Callable, count: int) -> Callable:
    """The function gradient() of `optiland_gradient`, by central differences. value: function
    value(k) of the variants of a lens with `count` surfaces."""
    steps = np.repeat([BENT, MOVED], count)

    def gradient() -> tuple[np.ndarray, np.ndarray]:
        base, *moved = (value(k) for k in range(4 * count + 1))
        up, down = np.split(np.array(moved), 2)
        return base, ((up - down).T / (2 * steps))

    return gradient


def batoid_gradient(lens: Lens, rays: Rays) -> Callable:
    """The same as `optiland_gradient`, by central differences with batoid. Each variant has its own
    paraxial pupil, or rays that were aimed for it."""
    return differences(batoid_spot(lens, rays, len(lens.variants)), len(lens.gaps))


class Spots(NamedTuple):
    """Functions of one program that take a `Lens` and `Rays`."""

    sigma: Callable
    gradient: Callable


SPOTS = {
    "optiland": Spots(optiland_spot, optiland_gradient),
    "batoid": Spots(batoid_spot, batoid_gradient),
}


def of_all(program: Spots, lens: Lens, rays: Rays) -> Callable:
    """A function values() -> sigma of all variants, (V, W)."""
    count = len(lens.variants)
    value = program.sigma(lens, rays, count)
    return lambda: np.array([value(k) for k in range(count)])


def batoid_rays(lens: Lens, points: np.ndarray, directions: np.ndarray) -> Callable:
    """A function trace() -> hits (Q, 2) on the sensor at the first wavelength, mm, with batoid.

    points: (Q, 3), in front of the lens, mm. directions: (Q, 3), unit vectors.
    """
    optic = _batoid_optic(lens, lens.variants[0], lens.index[:, 0])

    def trace() -> np.ndarray:
        hits = _batoid_hits(optic, points, directions)
        return np.stack([hits.x, hits.y], axis=1)

    return trace


def network_step(batch: int, patch: int, rate: float) -> Callable:
    """A function step(): one Adam step of the same RED-Net in PyTorch, channels last, for the mean
    absolute error of random images; on a GPU if JAX uses one."""
    import torch
    from torch import nn

    torch.manual_seed(0)
    where = {"device": "cuda" if jax.default_backend() == "gpu" else "cpu"}
    where |= {"memory_format": torch.channels_last}
    pairs = itertools.pairwise([3] + [64] * 9 + [3])
    layers = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairs).to(**where)
    adam = torch.optim.Adam(layers.parameters(), rate)

    def net(images):
        features, skips = images, {}
        for i, layer in enumerate(layers):
            features = layer(features)
            if i >= 5 and 8 - i in skips:
                features = features + skips[8 - i]
            if i < 9:
                features = torch.relu(features)
            if i < 4 and (4 - i) % 2 == 0:
                skips[i] = features
        return images + features

    images, truth = (torch.rand(batch, 3, patch, patch).to(**where) for _ in range(2))

    def step():
        adam.zero_grad()
        loss = torch.mean(torch.abs(net(images) - truth))
        loss.backward()
        adam.step()
        return loss.item()

    return step
