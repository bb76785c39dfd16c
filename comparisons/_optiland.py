"""Optiland doing the work of `design`: an optional extra; without it every function gives None.

A lens is handed over as numbers; angles in degrees, lengths in mm, spots in um. Its paraxial
quantities, so its pupils and focal lengths, are those of the middle colour of the list.
"""

import dataclasses
import functools
import importlib.util
import math
import time
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import drt_jax
from drt_jax.pupil.rules import Pattern
from experiments import _peers

Numbers = Sequence[float]
COLOURS = (0.4861, 0.5876, 0.6563)
# Of `singlet`: optimiser, variable, limits on the size of radii in mm, settings.
SETTINGS: dict[str, tuple[str, str, tuple, dict]] = {
    "OptimizerGeneric": ("OptimizerGeneric", "radius", (), {}),
    "LeastSquares": ("LeastSquares", "radius", (), {"method_choice": "trf"}),
    "DualAnnealing": ("DualAnnealing", "radius", (10, 1000), {"maxiter": 1000}),
    "Adam": ("TorchAdamOptimizer", "radius", (), {"n_steps": 1000, "lr": 0.1, "gamma": 0.995}),
    "OptimizerGeneric 1/R": ("OptimizerGeneric", "reciprocal_radius", (), {"tol": 1e-9}),
}


def _optional(function: Callable) -> Callable:
    """The function without Optiland's warnings; None without Optiland."""

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        if importlib.util.find_spec("optiland") is None:
            return None
        with warnings.catch_warnings(action="ignore"):
            return function(*args, **kwargs)

    return wrapped


@functools.cache
def _glass() -> type:
    """Optiland's kind of material of given indices at given wavelengths, exact there."""
    from optiland import backend
    from optiland.materials.base import BaseMaterial

    class Listed(BaseMaterial):
        def __init__(self, wavelengths: Numbers, index: np.ndarray):
            super().__init__()
            self.known = np.array([wavelengths, index])[:, np.argsort(wavelengths)]

        def _calculate_n(self, wavelength: Any, **_: Any) -> Any:
            return backend.array(np.interp(backend.to_numpy(wavelength), *self.known))

        def _calculate_k(self, wavelength: Any, **_: Any) -> Any:
            return backend.array(0.0 * backend.to_numpy(wavelength))

    return Listed


def _system(
    lens: drt_jax.Lens, fields_deg: Numbers, wavelengths_um: Numbers, distance_mm: float = math.inf
) -> tuple[Any, np.ndarray]:
    """The lens in Optiland, its aperture that of the stop, and its fields over the largest."""
    from optiland.optic import Optic

    known = _peers.Lens(lens, 0, distance_mm, wavelengths_um)
    media = [_glass()(wavelengths_um, row) for row in known.index]
    optic = Optic()
    optic.surfaces.add(index=0, thickness=distance_mm, material=media[0])
    for i, (c, gap) in enumerate(zip(known.curvature, known.gaps)):
        shape = {"radius": 1 / c if c else np.inf, "conic": known.conic[i]}
        if np.any(known.coefficients[i]):
            shape |= {"surface_type": "even_asphere", "coefficients": [*known.coefficients[i]]}
        shape["material"] = "mirror" if known.mirrors[i] else media[i + 1]
        optic.surfaces.add(index=i + 1, thickness=gap, is_stop=i == known.stop, **shape)
    optic.surfaces.add(index=len(known.gaps) + 1)
    optic.set_aperture("float_by_stop_size", 2 * known.semi)
    fields, kind = np.asarray(fields_deg, float), "angle"
    if math.isfinite(distance_mm):
        fields, kind = -distance_mm * np.tan(np.radians(fields)), "object_height"
    optic.fields.set_type(kind)
    for field in fields:
        optic.fields.add(y=field)
    for i, wave in enumerate(wavelengths_um):
        optic.wavelengths.add(wave, is_primary=i == len(wavelengths_um) // 2)
    return optic, fields / (np.max(np.abs(fields)) or 1.0)


def _tracer(fields: np.ndarray, wavelengths: Numbers, rings: int) -> Callable:
    """trace(optic) -> (W, 2, F, Q) in mm, rays about the centroids of all colours at Optiland's
    Gaussian quadrature of the pupil; sums of squares are squares of the spots' RMS radii. Makes the
    semi-apertures of the surfaces what these rays and those through the rim need."""
    from optiland.distribution import GaussianQuadrature

    points, along = GaussianQuadrature(), np.zeros_like(fields)
    points.generate_points(rings)
    weights, count = points.weights, len(points.weights)
    points.x, points.y = np.append(points.x, [0, 0, 1]), np.append(points.y, [1, -1, 0])

    def trace(optic: Any) -> np.ndarray:
        hits, reach = [], []
        for wave in wavelengths:
            rays = optic.trace(along, fields, wave, None, points)
            hits.append(np.reshape([rays.x, rays.y], (2, len(fields), -1))[..., :count])
            reach.append(np.max(np.hypot(optic.surfaces.x, optic.surfaces.y), axis=1))
        for surface, semi in zip(optic.surfaces, np.max(reach, axis=0)):
            surface.set_semi_aperture(semi)
        apart = np.array(hits)
        apart = apart - np.mean(apart @ weights, axis=0)[..., None]
        return apart * np.sqrt(weights / len(hits))

    return trace


@_optional
def spots_um(
    lens: drt_jax.Lens,
    fields_deg: Numbers,
    wavelengths_um: Numbers = COLOURS,
    distance_mm: float = math.inf,
    rings: int = 12,
) -> list[float | None]:
    """RMS radii of the spots about the centroid of all colours, alike in weight, by Optiland; None
    for a field of which it loses a ray.

    Its Gaussian quadrature, `rings` rings of 4 (rings + 1) rays: uniform over the paraxial entrance
    pupil, whose diameter lets the real ray on axis meet the stop's rim. Nothing is clipped. Of the
    Double Gauss within 0.1 % of `drt_jax.psf_moments` on axis, 0.6 % at 14 degrees.
    """
    optic, fields = _system(lens, fields_deg, wavelengths_um, distance_mm)
    diameter, semi = float(np.ravel(optic.paraxial.EPD())[0]), float(lens.semi_diameter[lens.stop])
    for _ in range(6):
        optic.set_aperture("EPD", diameter)
        optic.trace_generic(0.0, 0.0, 0.0, 1.0, optic.primary_wavelength)
        diameter *= semi / abs(float(np.ravel(optic.surfaces.y[lens.stop + 1])[0]))
    hits = _tracer(fields, wavelengths_um, rings)(optic)
    sizes = 1e3 * np.sqrt(np.sum(hits**2, axis=(0, 1, 3)))
    return [float(size) if np.isfinite(size) else None for size in sizes]


def _singlet(first: float = 1000.0, second: float = -1000.0) -> drt_jax.Lens:
    front = {"radius": first, "thickness": 7.0, "glass": "N-SF11", "semi_diameter": 7.5}
    surfaces = [front | {"stop": True}, {"radius": second, "glass": "air"}]
    return drt_jax.load_lens({"surfaces": surfaces, "sensor": 37.0})


def singlet_merit(first: float, second: float) -> float:
    """The singlet's mean squared distance from the centroid, mm^2, by our trace of 91 rays: the
    centre and 6 i points at i / 5 of the pupil's radius."""
    return _merit(_singlet(first, second))


def _merit(lens: drt_jax.Lens) -> float:
    ring = ((i, np.pi * j / (3 * i)) for i in range(1, 6) for j in range(6 * i))
    points = np.array([0, *(i / 5 * np.exp(1j * angle) for i, angle in ring)])
    rule = Pattern(np.stack([points.real, points.imag], axis=-1), np.full(91, 1 / 91))
    found = drt_jax.psf_moments(lens, drt_jax.Scene.point(0.0, math.inf, 0.55), rule)
    return float(np.trace(np.asarray(found.covariance)[0]))


@_optional
def singlet(
    names: Sequence[str] = tuple(SETTINGS), lens: drt_jax.Lens | None = None
) -> dict[str, dict[str, Any]]:
    """Optiland's optimisers of both radii of the singlet: N-SF11, +-1000 mm, 7 mm thick, beam
    15 mm, sensor 30 mm behind it, 0.55 um; its operand rms_spot_size of 5 hexapolar rings.

    lens: another start, with its own beam and thicknesses.
    By their name: `merit` as `singlet_merit`, `seconds`, `radii`, `lens`.
    """
    from optiland import backend, optimization

    start, found = _singlet() if lens is None else lens, {}
    for name in names:
        kind, variable, limits, settings = SETTINGS[name]
        backend.set_backend("torch" if "Torch" in kind else "numpy")
        if "Torch" in kind:
            backend.set_precision("float64")
        optic, _ = _system(start, (0,), (0.55,))
        optic.set_aperture("EPD", 2 * float(start.semi_diameter[0]))
        problem = optimization.OptimizationProblem()
        spot = {"Hx": 0, "Hy": 0, "wavelength": 0.55, "surface_number": -1, "optic": optic}
        spot |= {"num_rays": 5, "distribution": "hexapolar"}
        problem.add_operand("rms_spot_size", target=0, weight=1, input_data=spot)
        for surface, sign in ((1, 1), (2, -1)):
            bounds = dict(zip(("min_val", "max_val"), sorted(sign * limit for limit in limits)))
            problem.add_variable(optic, variable, surface_number=surface, **bounds)
        since = time.perf_counter()
        getattr(optimization, kind)(problem).optimize(disp=False, **settings)
        seconds, radii = time.perf_counter() - since, [float(r) for r in optic.surfaces.radii[1:3]]
        bent = start.curvature.at[:2].set(1 / np.array(radii))
        end = dataclasses.replace(start, curvature=bent)
        found[name] = {"merit": _merit(end), "seconds": seconds, "radii": radii, "lens": end}
    backend.set_backend("numpy")
    return found


class Told(NamedTuple):
    """What Optiland's least squares is told of a problem, as far as it knows such things.

    bends, gaps: by surface, from 0, limits (low, high) of the curvatures, 1/mm, and thicknesses
    behind them, mm, that vary; behind the last surface to the sensor. focal_length: mm, held in the
    middle colour by an operand; 0: free. pupil_mm: diameter of the entrance pupil; 0: the stop
    keeps its own. edges: (surface, low, high), limits of its operand edge_thickness, mm, as far out
    as the light of either surface; what exceeds them is a residual.
    """

    bends: dict[int, tuple[float, float]]
    gaps: dict[int, tuple[float, float]]
    focal_length: float = 0.0
    pupil_mm: float = 0.0
    edges: Sequence[tuple[int, float, float]] = ()


@_optional
def recover(
    start: drt_jax.Lens,
    told: Told,
    fields_deg: Numbers = (0.0, 10.0, 14.0),
    wavelengths_um: Numbers = COLOURS,
    distance_mm: float = math.inf,
    seconds: float = 60.0,
) -> dict[str, Any]:
    """Optiland's least squares on the spots of a lens, its object at `distance_mm`, for `seconds`.

    Returns `spots_um` as the function, `seconds` of the search, `focal_length`, the `lens`, and
    `lenses`, the start and that after each iteration.

    TRF with x_scale="jac", tol=1e-10, 1 / radius, and a registered operand for each coordinate of 4
    rings of 20 rays. Tried with all thicknesses free, 30 iterations, 3 rings of 12; the root of the
    merit: 6.6 um in 36 s, "lm" 6.5 um in 36 to 44 s; LeastSquares on rms_spot_size of each field
    138 um in 50 s, OptimizerGeneric on the same 11.5 um in 87 s.
    """
    optic, fields = _system(start, fields_deg, wavelengths_um, distance_mm)
    if told.pupil_mm:
        optic.set_aperture("EPD", told.pupil_mm)
    problem = _deviations(optic, _tracer(fields, wavelengths_um, 4))
    _tell(problem, optic, told)
    since = time.perf_counter()
    vectors = _searched(problem, seconds)
    seconds, lenses = time.perf_counter() - since, [start]
    for vector in vectors:
        for variable, number in zip(problem.variables, vector):
            variable.update(number)
        lenses.append(_taken(start, optic))
    return {
        "spots_um": spots_um(lenses[-1], fields_deg, wavelengths_um, distance_mm),
        "seconds": seconds,
        "focal_length": float(np.ravel(optic.paraxial.f2())[0]),
        "lens": lenses[-1],
        "lenses": lenses[:-1],
    }


def _tell(problem: Any, optic: Any, told: Told) -> None:
    """Variables, their bounds, and the operands beside the deviations."""
    for kind, varied in (("reciprocal_radius", told.bends), ("thickness", told.gaps)):
        for surface, ends in varied.items():
            problem.add_variable(optic, kind, surface_number=surface + 1, **_bounds(ends))
    if told.focal_length:
        problem.add_operand("f2", target=told.focal_length, weight=1, input_data={"optic": optic})
    for surface, *ends in told.edges:
        place = {"optic": optic, "surface_number": surface + 1}
        problem.add_operand("edge_thickness", weight=1, input_data=place, **_bounds(ends))


def _searched(problem: Any, seconds: float) -> list[np.ndarray]:
    """Optiland's variables after each iteration of its least squares, and at the end."""
    from optiland import optimization

    vectors, since = list[np.ndarray](), time.perf_counter()

    def in_time(vector: np.ndarray) -> None:
        vectors.append(vector)
        if time.perf_counter() - since > seconds:
            raise StopIteration

    search = optimization.LeastSquares(problem)
    ended = search.optimize(tol=1e-10, method_choice="trf", x_scale="jac", callback=in_time)
    return [*vectors, ended.x]


def _deviations(optic: Any, trace: Callable) -> Any:
    """Optiland's problem with an operand for each of the deviations that `trace` gives."""
    from optiland import optimization

    found = [trace(optic).ravel()]

    def deviation(optic: Any, index: int) -> float:
        if index == 0:  # the first that is asked for
            found[0] = trace(optic).ravel()
        return found[0][index]

    optimization.operand.operand_registry.register("deviation", deviation, overwrite=True)
    problem = optimization.OptimizationProblem()
    for index in range(found[0].size):
        problem.add_operand("deviation", target=0, input_data={"optic": optic, "index": index})
    return problem


def _bounds(ends: Numbers) -> dict[str, float]:
    """Those of low and high that are finite, as Optiland names them."""
    return {name: x for name, x in zip(("min_val", "max_val"), ends) if math.isfinite(x)}


def _taken(start: drt_jax.Lens, optic: Any) -> drt_jax.Lens:
    """The lens with the curvatures and thicknesses that Optiland has."""
    radii = np.array([float(radius) for radius in optic.surfaces.radii[1:]])
    places = np.array([float(place) for place in np.ravel(optic.surfaces.positions)[1:]])
    bent, gaps, sensor = map(jnp.asarray, (1 / radii, np.diff(places[:-1]), places[-1]))
    return dataclasses.replace(start, curvature=bent, thickness=gaps, sensor=sensor)
