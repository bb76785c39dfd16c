"""A lens at another temperature: indices, shapes, thicknesses and the mount.

Lengths of a lens are valid at 20 C, the constants of each glass at the temperature of its
catalogue. At another temperature t

- the absolute index of a glass changes by Schott's formula (TIE-19), with d = t - `Glass.celsius`,
  (n^2 - 1) / (2 n) (D0 d + D1 d^2 + D2 d^3 + (E0 d + E1 d^2) / (L^2 - L_TK^2)), and indices are
  again relative to air, at t and its pressure: `refractive_index` computes both at any wavelength;
- a surface with the expansion a grows by k = 1 + a (t - 20 C) in all directions: its sag at the
  height h becomes k sag(h / k);
- the mount of an air space is a thin tube between the rims of two surfaces, which grows along and
  across the axis, as OpticStudio has it.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import Numbers, concrete, real_array
from .edit import resized
from .glass import Glass, air_density
from .glasses import find_glass
from .lens import Labels, Lens, sag

# Temperature (C) at which the lengths of a lens hold.
_BUILT = 20.0
_ALUMINIUM = 23.6


def _known(name: str, glasses: Mapping[str, Glass]) -> Glass:
    """The glass of a name, with its numbers of temperature. ValueError if these are not known."""
    glass = glasses.get(name)
    if glass is None:
        try:
            glass = find_glass(name)
        except ValueError:  # a model glass, a constant index, or a name that a program has dropped
            glass = Glass(name)
    missing = [what for what in ("thermal", "expansion") if getattr(glass, what) in ((), None)]
    what = f"glasses: {name}: {' and '.join(missing)} not known; give glasses={{{name!r}: glass}}"
    require(not missing, f"{what} with a glass that has them, such as find_glass('N-BK7')")
    return glass


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ThermalModel:
    """Thermal constants of the glasses and mounts of a lens. Expansions are in 1e-6/K.

    index: (S + 1, 6), `Glass.thermal` of the media; 0 for air.
    celsius: (S + 1,), temperature at which the constants of the media hold, C.
    surfaces: (S + 1,), expansion of the surfaces and of the sensor.
    gaps: (S,), expansion behind each surface: of the glass, or of the mount of an air space.
    """

    index: Array
    celsius: Array
    surfaces: Array
    gaps: Array

    @classmethod
    def from_lens(
        cls, lens: Lens, mounts: Numbers = _ALUMINIUM, glasses: Mapping[str, Glass] | None = None
    ) -> "ThermalModel":
        """The model of a lens whose glasses are found by their names, so not inside of `jit`.

        A surface expands like the glass behind it, or in front of it if behind it is air. A surface
        in air, such as a mirror, expands like the mount behind it.

        lens: the lens.
        mounts: expansion of the mount of air spaces, 1e-6/K: one, or (S,), of the space behind each
            surface, the last one in front of the sensor; by default aluminium's.
        glasses: glasses by the names they have in the lens, with `thermal` and `expansion`, in
            place of those of the table; needed for model glasses.

        ValueError for other counts, and for a glass whose numbers are not known.
        """
        media, dtype = lens.glasses, lens.curvature.dtype
        own = [Glass("air") if m == "air" else _known(m, glasses or {}) for m in media]
        found = np.asarray(mounts, float)
        count = f"mounts: expected one or {lens.count} numbers, got the shape {found.shape}"
        require(found.shape in ((), (lens.count,)), count)
        inside = np.array([np.nan if glass.expansion is None else glass.expansion for glass in own])
        gaps = np.where(np.isnan(inside[1:]), found, inside[1:])
        surfaces = np.where(np.isnan(inside[1:]) & ~np.isnan(inside[:-1]), inside[:-1], gaps)
        index = [(*glass.thermal, *[0.0] * 6)[:6] for glass in own]
        numbers = index, [glass.celsius for glass in own], [*surfaces, gaps[-1]], gaps
        return cls(*(jnp.asarray(array, dtype) for array in numbers))


def at_temperature(
    lens: Lens, celsius: Numbers, model: ThermalModel, pressure: Numbers = 1.0
) -> Lens:
    """The lens at a temperature, in air of this temperature.

    Radii, conics, aspheric and diffractive terms, semi-diameters and apertures change with their
    surface, thicknesses of glass with the glass. An air space changes by its mount between the
    semi-diameters of its two surfaces (at the vertex, where a surface has none), decentres and
    pivots by the mount. A wavelength means the same light at all temperatures. Names of
    glasses get the temperature, where it is known.

    Differentiable by all numbers, also in `jit` and `vmap`.

    lens: the lens, whose lengths hold at 20 C.
    celsius: (), C.
    model: of this lens.
    pressure: (), of the air, atmospheres; 0 for a lens in vacuum.

    ValueError for a lens that is a result of this function, and for other shapes.
    """
    require(lens.dispersion.thermal is None, "lens: is at another temperature; take that at 20 C")
    dtype, count, media = lens.curvature.dtype, lens.count, np.array(lens.glasses)
    now = real_array("celsius", celsius, dtype)
    pressed = real_array("pressure", pressure, dtype)
    require(now.shape == pressed.shape == (), "celsius, pressure: expected one number of each")
    shapes = model.index.shape, model.surfaces.shape
    require(shapes == ((count + 1, 6), (count + 1,)), "model: of a lens with other surfaces")
    surfaces, gaps = (1 + 1e-6 * a * (now - _BUILT) for a in (model.surfaces, model.gaps))
    thermal = jnp.where((media == "air")[:, None], 0, _indices(model, now, pressed))
    name = f" at {float(now):g} C" if concrete(now) else ""
    glasses = tuple(m if m == "air" else m + name for m in lens.glasses)
    behind = _gaps(lens, surfaces, gaps)
    phase, elements, apertures = lens.phase, lens.elements, lens.apertures
    if phase is not None:  # the phase stays at its point of the surface
        own = surfaces[np.array(phase.surfaces)][:, None]
        terms = resized(phase.coefficients, phase.forms, own) / own
        phase = dataclasses.replace(phase, coefficients=terms)
    if apertures is not None:
        own = surfaces[np.array(apertures.surfaces)][:, None]
        centre = apertures.centre if apertures.centre is None else own * apertures.centre
        apertures = dataclasses.replace(apertures, half=own * apertures.half, centre=centre)
    if elements is not None:
        own = gaps[np.minimum(elements.about, count - 1)]
        shift, pivot = own[:, None] * elements.shift, own * elements.pivot
        elements = dataclasses.replace(elements, shift=shift, pivot=pivot)
    held = None if lens.decentre is None else jnp.append(gaps, gaps[-1])[:, None] * lens.decentre
    return dataclasses.replace(
        lens,
        curvature=lens.curvature / surfaces,
        coefficients=resized(lens.coefficients, lens.forms, surfaces[:, None]),
        thickness=behind[:-1],
        semi_diameter=surfaces * lens.semi_diameter,
        sensor=jnp.sum(behind),
        dispersion=dataclasses.replace(lens.dispersion, thermal=thermal),
        decentre=held,
        phase=phase,
        elements=elements,
        apertures=apertures,
        labels=Labels(lens.name, glasses),
    )


def _indices(model: ThermalModel, now: Array, pressure: Array) -> Array:
    """How the indices change, (S + 1, 5), see `Dispersion.thermal`: two terms of Schott's formula
    and L_TK^2, and the densities of air that indices are relative to, before and now.

    now, pressure: (), C and atmospheres.
    """
    d0, d1, d2, e0, e1, resonance = model.index.T
    step = now - model.celsius
    change = step * (d0 + step * (d1 + step * d2)), step * (e0 + step * e1), resonance**2
    before, density = air_density(model.celsius, jnp.ones_like(step)), air_density(now, pressure)
    return jnp.stack([*change, before, jnp.broadcast_to(density, step.shape)], axis=1)


def _gaps(lens: Lens, surfaces: Array, gaps: Array) -> Array:
    """Thicknesses (S,), mm, to the next vertex or the sensor, of a lens that expands.

    surfaces, gaps: (S + 1,) and (S,), factors of expansion.
    """
    cold = jnp.append(lens.thickness, lens.sensor - jnp.sum(lens.thickness))
    limits = jnp.where(jnp.isfinite(lens.semi_diameter), lens.semi_diameter, 0)

    def sags(first: int, spread: Array) -> Array:
        """Sags (S,) of the first or second surface of each gap, where the mount holds it."""
        rows = range(first, first + lens.count)
        return jnp.stack([sag(lens, i, 0.0, spread[k] * limits[i]) for k, i in enumerate(rows)])

    def step(spread: tuple[Array, Array], factors: tuple[Array | float, Array | float]) -> Array:
        """Distance of the second vertex from the first, less that of the rims."""
        return factors[0] * sags(0, spread[0]) - factors[1] * sags(1, spread[1])

    one, own = jnp.ones_like(gaps), (surfaces[:-1], surfaces[1:])
    edge = cold - step((one, one), (1.0, 1.0))
    held = gaps * edge + step((gaps / own[0], gaps / own[1]), own)
    return jnp.where(np.array(lens.glasses[1:]) == "air", held, gaps * cold)
