"""Other programs doing the work that `benchmark` times: an optional extra, each may be missing.

A peer is given the lens as numbers and samples the pupil as its users would: hexapolar rings that
hold about as many rays as asked for. Differences in definition are its error.
"""

import importlib
import importlib.metadata
import itertools
from collections.abc import Callable

import numpy as np

import drt_jax
from drt_jax import pupil

__all__ = ["PEERS", "Missing", "batoid_rays", "network_step", "spot"]

PEERS = ("optiland", "batoid", "torch")


class Missing(Exception):
    """A peer that is not installed; the message says which and how to install it."""


def load(name: str):
    """The module of a peer and its version."""
    try:
        return importlib.import_module(name), importlib.metadata.version(name)
    except ImportError as error:
        raise Missing(f"{name} is not installed: pip install -e '.[peers]'") from error


class Lens:
    """A centred lens of spheres and planes as NumPy arrays, and a scene: gaps (S,), the last to
    the sensor, indices (S + 1, W), field in radians, object distance."""

    def __init__(self, lens: drt_jax.Lens, field: float, distance: float, wavelengths) -> None:
        self.curvature = np.asarray(lens.curvature, float)[:-1]
        thickness = np.asarray(lens.thickness, float)
        self.gaps = np.append(thickness, float(lens.sensor) - np.sum(thickness))
        self.index = np.asarray(lens.index(np.asarray(wavelengths)), float)
        self.stop, self.semi = lens.stop, float(lens.semi_diameter[lens.stop])
        self.field, self.distance, self.wavelengths = field, distance, tuple(wavelengths)
        first = drt_jax.first_order(lens, distance, np.asarray(wavelengths))
        self.pupil = tuple(float(a[0]) for a in first.entrance_pupil)


def _rings(rays: int) -> int:
    return int((np.sqrt(12 * rays - 3) - 3) / 6)


def spot(name: str, lens: Lens, rays: int) -> tuple[Callable, Callable, str]:
    """(value, gradient, version) of the RMS spot radius sigma: value() -> (W,) in mm;
    gradient() -> (W,), (W, 2 S), the latter by curvatures, thicknesses and the sensor position, NaN
    where the peer has none."""
    module, version = load(name)
    return (*{"optiland": _optiland, "batoid": _batoid}[name](module, lens, rays), version)


def _optiland_system(lens: Lens, index: np.ndarray, wavelength: float):
    """An Optiland lens for one wavelength, indices (S + 1,)."""
    optic = importlib.import_module("optiland.optic").Optic()
    material = importlib.import_module("optiland.materials").IdealMaterial
    optic.add_surface(index=0, thickness=lens.distance)
    for i, (c, gap) in enumerate(zip(lens.curvature, lens.gaps)):
        optic.add_surface(
            index=i + 1,
            radius=1 / c if c else np.inf,
            thickness=gap,
            material=material(n=float(index[i + 1])),
            is_stop=i == lens.stop,
        )
    optic.add_surface(index=len(lens.gaps) + 1)
    optic.set_aperture("float_by_stop_size", 2 * lens.semi)
    optic.set_field_type("object_height")
    optic.add_field(y=-lens.distance * np.tan(lens.field))
    optic.add_wavelength(wavelength, is_primary=True)
    return optic


def _optiland(module, lens: Lens, rays: int) -> tuple[Callable, Callable]:
    torch, _ = load("torch")
    backend = importlib.import_module("optiland.backend")
    backend.set_backend("torch")
    backend.set_precision("float64")
    backend.grad_mode.enable()
    pairs = zip(lens.index.T, lens.wavelengths)
    systems = [(_optiland_system(lens, index, wave), wave) for index, wave in pairs]

    def one(optic, wavelength):
        hits = optic.trace(0, 1 if lens.field else 0, wavelength, _rings(rays), "hexapolar")
        return torch.sqrt(hits.x.var(unbiased=False) + hits.y.var(unbiased=False))

    def slopes(leaves, otherwise):
        known = [torch.is_tensor(leaf) and leaf.grad is not None for leaf in leaves]
        return np.array([float(a.grad) if k else otherwise for a, k in zip(leaves, known)])

    def value():
        backend.grad_mode.disable()
        with torch.no_grad():
            sigma = [float(one(*system)) for system in systems]
        backend.grad_mode.enable()
        return np.array(sigma)

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


def _batoid_optic(module, curvature, gaps, index):
    media = [module.ConstMedium(float(n)) for n in index]
    items = []
    for i, (c, place) in enumerate(zip([*curvature, 0], np.append(0, np.cumsum(gaps)))):
        kind = module.RefractiveInterface if i < len(curvature) else module.Detector
        shape = module.Sphere(1 / c) if c else module.Plane()
        where = module.CoordSys(origin=[0, 0, place])
        around = {"inMedium": media[i], "outMedium": media[min(i + 1, len(media) - 1)]}
        items.append(kind(shape, name=f"s{i}", coordSys=where, **around))
    return module.CompoundOptic(items, name="lens", inMedium=media[0], outMedium=media[-1])


def _batoid(module, lens: Lens, rays: int) -> tuple[Callable, Callable]:
    points = pupil.hexapolar(_rings(rays))[0]
    place, radius = lens.pupil
    source = np.array([0.0, -lens.distance * np.tan(lens.field), -lens.distance])
    through = np.stack([*(radius * points), np.full(points.shape[1], place)], axis=-1)
    direction = through - source
    direction = direction / np.linalg.norm(direction, axis=1, keepdims=True)
    # Onto a plane before the first vertex.
    start = through + direction * ((-10.0 - place) / direction[:, 2:])

    def trace(curvature, gaps, k):
        optic = _batoid_optic(module, curvature, gaps, lens.index[:, k])
        speed = direction / lens.index[0, k]
        hits = module.RayVector(*start.T.copy(), *speed.T.copy(), wavelength=1e-6)
        optic.trace(hits)
        return np.sqrt(np.var(hits.x) + np.var(hits.y))

    def value(curvature=lens.curvature, gaps=lens.gaps):
        return np.array([trace(curvature, gaps, k) for k in range(len(lens.wavelengths))])

    count = len(lens.gaps)
    shift = np.eye(count)
    shift[:-1, -1] = -1  # a thickness does not move the sensor

    def gradient():
        base, h = value(), 1e-7 * np.eye(count)
        moved = [value(curvature=lens.curvature + row) for row in h]
        slopes = [(found - base) / 1e-7 for found in moved]
        moved = [value(gaps=lens.gaps + 1e-6 * row) for row in shift]
        slopes += [(found - base) / 1e-6 for found in moved]
        return base, np.array(slopes).T

    return value, gradient


def batoid_rays(lens: Lens, points: np.ndarray, directions: np.ndarray) -> tuple[Callable, str]:
    """(trace, version): sensor hits (Q, 2) of rays through `points` (Q, 3) in front of the lens,
    unit `directions` (Q, 3), at the first wavelength."""
    module, version = load("batoid")
    optic = _batoid_optic(module, lens.curvature, lens.gaps, lens.index[:, 0])

    def trace():
        hits = module.RayVector(*points.T.copy(), *directions.T.copy(), wavelength=1e-6)
        optic.trace(hits)
        return np.stack([hits.x, hits.y], axis=1)

    return trace, version


def network_step(batch: int, patch: int, rate: float) -> tuple[Callable, str]:
    """(step, version): one Adam step of the same RED-Net in PyTorch, channels last, on the mean
    absolute error of random images."""
    torch, version = load("torch")
    nn = torch.nn

    class RedNet(nn.Module):
        def __init__(self):
            super().__init__()
            pairs = itertools.pairwise([3] + [64] * 9 + [3])
            self.layers = nn.ModuleList(nn.Conv2d(a, b, 3, padding=1) for a, b in pairs)

        def forward(self, images):
            features, kept = images, {}
            for i, layer in enumerate(self.layers):
                features = layer(features)
                if i >= 5 and 8 - i in kept:
                    features = features + kept[8 - i]
                if i < 9:
                    features = torch.relu(features)
                if i < 4 and (4 - i) % 2 == 0:
                    kept[i] = features
            return images + features

    torch.manual_seed(0)
    net = RedNet().to(memory_format=torch.channels_last)
    adam = torch.optim.Adam(net.parameters(), rate)
    images, truth = (
        torch.rand(batch, 3, patch, patch).contiguous(memory_format=torch.channels_last)
        for _ in range(2)
    )

    def step():
        adam.zero_grad()
        loss = torch.mean(torch.abs(net(images) - truth))
        loss.backward()
        adam.step()
        return float(loss)

    return step, version
