"""Other programs for the work of `benchmark`: an optional extra, each may be missing.

A peer gets the lens as numbers and samples the pupil as its users would: with hexapolar rings of
about as many rays. Differences in definition count as its error.
"""

import itertools
from collections.abc import Callable
from functools import partial

import numpy as np

import drt_jax
from drt_jax import pupil

from ._common import rings


class Lens:
    """A centred lens of aspheres as NumPy arrays, without clear apertures, and a scene: gaps (S,),
    the last to the sensor, index (S + 1, W), field in radians, distance in mm. ValueError for other
    lenses."""

    def __init__(self, lens: drt_jax.Lens, field: float, distance: float, wavelengths) -> None:
        if set(lens.forms) != {"asphere"} or lens.phase or lens.elements or lens.tilt is not None:
            raise ValueError("no centred lens of aspheres")
        self.curvature = np.asarray(lens.curvature, float)[:-1]
        self.conic = np.asarray(lens.conic, float)[:-1]
        self.coefficients, self.mirrors = np.asarray(lens.coefficients, float)[:-1], lens.mirrors
        thickness = np.asarray(lens.thickness, float)
        self.gaps = np.append(thickness, float(lens.sensor) - np.sum(thickness))
        self.index = np.asarray(lens.index(np.asarray(wavelengths)), float)
        self.stop, self.semi = lens.stop, float(lens.semi_diameter[lens.stop])
        self.field, self.distance, self.wavelengths = field, distance, tuple(wavelengths)
        first = drt_jax.first_order(lens, distance, np.asarray(wavelengths))
        self.pupil = tuple(float(a[0]) for a in first.entrance_pupil)


def _optiland_system(lens: Lens, index: np.ndarray, wavelength: float):
    """An Optiland lens for one wavelength, um. index: (S + 1,)."""
    from optiland.materials import IdealMaterial
    from optiland.optic import Optic

    optic = Optic()
    optic.add_surface(index=0, thickness=lens.distance)
    for i, (c, gap) in enumerate(zip(lens.curvature, lens.gaps)):
        medium = "mirror" if lens.mirrors[i] else IdealMaterial(n=float(index[i + 1]))
        kind = {"thickness": gap, "material": medium, "is_stop": i == lens.stop}
        shape = {"radius": 1 / c if c else np.inf, "conic": lens.conic[i]}
        if np.any(lens.coefficients[i]):
            shape |= {"surface_type": "even_asphere", "coefficients": lens.coefficients[i].tolist()}
        optic.add_surface(index=i + 1, **kind, **shape)
    optic.add_surface(index=len(lens.gaps) + 1)
    optic.set_aperture("float_by_stop_size", 2 * lens.semi)
    if np.isinf(lens.distance):
        optic.set_field_type("angle")
        optic.add_field(y=np.degrees(lens.field))
    else:
        optic.set_field_type("object_height")
        optic.add_field(y=-lens.distance * np.tan(lens.field))
    optic.add_wavelength(wavelength, is_primary=True)
    return optic


def optiland_spot(lens: Lens, rays: int) -> tuple[Callable, Callable]:
    """(value, gradient) of the RMS spot radius sigma: value() -> ((W,),), mm; gradient() -> (W,),
    (W, 2 S), by curvatures, thicknesses and the sensor position, NaN where unknown."""
    import torch
    from optiland import backend

    backend.set_backend("torch")
    backend.set_precision("float64")
    backend.grad_mode.enable()
    pairs = zip(lens.index.T, lens.wavelengths)
    systems = [(_optiland_system(lens, index, wave), wave) for index, wave in pairs]

    def one(optic, wavelength):
        hits = optic.trace(0, 1 if lens.field else 0, wavelength, rings(rays), "hexapolar")
        return torch.sqrt(hits.x.var(unbiased=False) + hits.y.var(unbiased=False))

    def slopes(leaves, otherwise):
        known = [torch.is_tensor(leaf) and leaf.grad is not None for leaf in leaves]
        return np.array([float(a.grad) if k else otherwise for a, k in zip(leaves, known)])

    def value():
        backend.grad_mode.disable()
        with torch.no_grad():
            sigma = [float(one(*system)) for system in systems]
        backend.grad_mode.enable()
        return (np.array(sigma),)

    def gradient():
        values, rows = [], []
        bent = np.where(lens.curvature == 0, np.nan, lens.curvature)  # planes have no radius
        for optic, wavelength in systems:
            shapes = [surface.geometry for surface in optic.surface_group.surfaces][1:]
            radii, places = [shape.radius for shape in shapes], [shape.cs.z for shape in shapes]
            for leaf in filter(torch.is_tensor, (*radii, *places)):
                leaf.grad = None
            sigma = one(optic, wavelength)
            sigma.backward()
            place = slopes(places, 0.0)
            behind = np.cumsum(place[-2:0:-1])[::-1]  # a thickness moves all vertices behind it
            values.append(float(sigma.detach()))
            rows.append([*(-slopes(radii[:-1], np.nan) / bent**2), *behind, place[-1]])
        return np.array(values), np.array(rows)

    return value, gradient


def _batoid_shape(lens: Lens, i: int, c: float):
    import batoid

    if np.any(lens.coefficients[i, 1:]):
        return batoid.Asphere(1 / c, lens.conic[i], lens.coefficients[i, 1:])
    return batoid.Quadric(1 / c, lens.conic[i]) if c else batoid.Plane()


def _batoid_optic(lens: Lens, curvature, gaps, index):
    import batoid

    if np.any(lens.coefficients[:, :1]) or np.any((curvature == 0) & np.any(lens.coefficients, 1)):
        raise ValueError("no terms of r^2, no aspheres of radius inf")
    media = [batoid.ConstMedium(float(n)) for n in index]
    items = []
    for i, (c, place) in enumerate(zip([*curvature, 0], np.append(0, np.cumsum(gaps)))):
        last = i == len(curvature)
        kind = batoid.Detector if last else batoid.RefractiveInterface
        kind = batoid.Mirror if not last and lens.mirrors[i] else kind
        shape = batoid.Plane() if last else _batoid_shape(lens, i, c)
        where = batoid.CoordSys(origin=[0, 0, place])
        both = {"inMedium": media[i], "outMedium": media[min(i + 1, len(media) - 1)]}
        items.append(kind(shape, name=f"s{i}", coordSys=where, **both))
    return batoid.CompoundOptic(items, name="lens", inMedium=media[0], outMedium=media[-1])


def _batoid_hits(optic, points, velocities):
    import batoid

    hits = batoid.RayVector(*points.T.copy(), *velocities.T.copy(), wavelength=1e-6)
    optic.trace(hits)
    return np.stack([hits.x, hits.y], axis=1)


def batoid_spot(lens: Lens, rays: int) -> tuple[Callable, Callable]:
    """`optiland_spot` by batoid, with the gradient by finite differences."""
    points = pupil.hexapolar(rings(rays))[0]
    place, radius = lens.pupil
    toward = np.array([0.0, np.tan(lens.field), 1.0])
    through = np.column_stack([radius * points, np.full(len(points), place)])
    # From the object point, or along the field for an object at infinity.
    direction = toward + through / lens.distance
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # On a plane in front of the first surface.
    start = through + direction * ((-10.0 - radius - place) / direction[:, 2:])

    def sigma(curvature, gaps, k):
        velocity = direction / lens.index[0, k]
        optic = _batoid_optic(lens, curvature, gaps, lens.index[:, k])
        return np.sqrt(np.sum(np.var(_batoid_hits(optic, start, velocity), axis=0)))

    def value(curvature=lens.curvature, gaps=lens.gaps):
        return (np.array([sigma(curvature, gaps, k) for k in range(len(lens.wavelengths))]),)

    count = len(lens.gaps)
    shift = np.eye(count)
    shift[:-1, -1] = -1  # a thickness does not move the sensor

    def gradient():
        (base,), h = value(), 1e-7 * np.eye(count)
        by_curvature = [value(curvature=lens.curvature + row)[0] for row in h]
        by_gap = [value(gaps=lens.gaps + 1e-6 * row)[0] for row in shift]
        slopes = np.concatenate([(by_curvature - base) / 1e-7, (by_gap - base) / 1e-6])
        return base, slopes.T

    return value, gradient


# (value, gradient) of sigma by each program.
SPOTS = {"optiland": optiland_spot, "batoid": batoid_spot}


def batoid_rays(lens: Lens, points: np.ndarray, directions: np.ndarray) -> Callable:
    """trace() -> hits (Q, 2) on the sensor at the first wavelength, mm. points: (Q, 3), in front of
    the lens, mm. directions: (Q, 3), unit vectors."""
    optic = _batoid_optic(lens, lens.curvature, lens.gaps, lens.index[:, 0])
    return partial(_batoid_hits, optic, points, directions)


def network_step(batch: int, patch: int, rate: float) -> Callable:
    """step(): one Adam step of the same RED-Net in PyTorch, channels last, on the mean absolute
    error of random images, on a GPU where JAX uses one."""
    import jax
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
