"""Refractive index: one dispersion formula for all media, and model glasses."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import array, concrete, matmul, program, safe_divide, safe_sqrt

# Of model glasses: the lines d, F, C, g (um), and the powers of the wavelength L in Conrady's
# formula.
FRAUNHOFER, _CONRADY = (0.5875618, 0.4861327, 0.6562725, 0.4358343), (0, -1, -3.5)
# P_gF on Schott's normal line (constant, and slope by vd); range of model glasses, um, from the
# line i to the line t.
NORMAL_LINE, VISIBLE = (0.6438, -0.001682), (0.365, 1.014)
_NO_MODEL, _FARTHEST = (1.0, 50.0), 0.2
# Range (um) of a medium for which none is given: 0.1 nm to 1 m.
ANY = 1e-4, 1e6
# Powers of L in `Glass.schott`. L^-10 and L^-12 are too large for float32 at wavelengths below
# `_SHORTEST`, um.
POWERS, _SHORTEST = (0, 2, -2, -4, -6, -8, 4, -10, -12, 6), 0.01


@dataclasses.dataclass(frozen=True)
class Glass:
    """Dispersion constants of one medium.

    n^2 is the sum of Sellmeier's and Schott's formulas, sum_t B_t L^2 / (L^2 - C_t) + sum_k a_k
    L^p_k with the wavelength L in um. A Sellmeier glass has a0 = 1; a medium of constant index n
    has a0 = n^2.

    name: as in a prescription.
    sellmeier: (B1 .. BT, C1 .. CT), any number of terms T; C in um^2.
    schott: (a0 .. a5), coefficients of L^0, L^2, L^-2, L^-4, L^-6, L^-8, and up to four more, of
        L^4, L^-10, L^-12, L^6.
    range: shortest and longest wavelength for which the constants hold, um.
    model: nd and vd of a model glass, see `model_glass`.
    dPgF: P_gF of a model glass less that of the normal line.
    maker, source: as in the table of glasses; "" for none.
    thermal: D0 (1/K), D1 (1/K^2), D2 (1/K^3), E0 (um^2/K), E1 (um^2/K^2) and L_TK (um) of Schott's
        formula for the absolute index at another temperature, see `design.at_temperature`; empty
        if they are not known.
    expansion: linear, from -30 to 70 C, 1e-6/K; None if it is not known.
    celsius: temperature of glass and air at which the constants hold, C.
    status: "standard", "preferred", "obsolete", "special" or "melt", as the maker calls it; "" if
        it is not known.
    """

    name: str
    sellmeier: tuple[float, ...] = (0.0,) * 6
    schott: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    range: tuple[float, float] = ANY
    model: tuple[float, float] = _NO_MODEL
    dPgF: float = 0.0
    maker: str = ""
    source: str = ""
    thermal: tuple[float, ...] = ()
    expansion: float | None = None
    celsius: float = 20.0
    status: str = ""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Dispersion:
    """Dispersion constants of M media as arrays, so that an index can be differentiated.

    T, at least 3, is the largest number of Sellmeier terms, and K the largest number of Schott's
    coefficients; shorter rows are filled with zeros.

    strength: (M, T), Sellmeier's B.
    resonance: (M, T), Sellmeier's C, um^2.
    schott: (M, K), see `Glass`.
    ranges: (M, 2), shortest and longest wavelength at which each index is known, um.
    model: (M, 2), nd and vd of model glasses, nd = 1 for other media; None without any.
    dPgF: (M,), P_gF of model glasses less that of the normal line; None if all are 0.
    thermal: (M, 5), change from the temperature of the constants, see `design.at_temperature`: of
        Schott's formula D0 d + D1 d^2 + D2 d^3, E0 d + E1 d^2 (um^2) and L_TK^2 (um^2), and the
        density of the air before and now, relative to 15 C and one atmosphere; 0 for air. None at
        the temperature of the constants.
    """

    strength: Array
    resonance: Array
    schott: Array
    ranges: Array
    model: Array | None = None
    dPgF: Array | None = None
    thermal: Array | None = None

    @property
    def range(self) -> tuple[Any, Any]:
        """Shortest and longest wavelength at which the index of all media is known, um.

        If there is no such wavelength, the first number is larger than the second. Both are floats,
        or arrays () in a trace.
        """
        if concrete(self.ranges):
            low, high = np.asarray(self.ranges, float).T
            return float(low.max()), float(high.min())
        low, high = jax.lax.stop_gradient(self.ranges).T
        return jnp.max(low), jnp.min(high)

    def knows(self, wavelengths: Array) -> Array:
        """True where the index of all media is known, bool; also in a trace.

        wavelengths: any shape, um.
        """
        low, high = (jnp.asarray(end, wavelengths.dtype) for end in self.range)
        return (wavelengths >= low) & (wavelengths <= high)

    @classmethod
    def of(cls, media: list[Glass]) -> "Dispersion":
        """The constants of media, in the default floating dtype."""
        halves = [np.asarray(m.sellmeier, float).reshape(2, -1) for m in media]
        terms = max(3, *(half.shape[1] for half in halves))
        padded = np.stack([np.pad(half, ((0, 0), (0, terms - half.shape[1]))) for half in halves])
        powers = max(len(m.schott) for m in media)
        models, dPgF = [m.model for m in media], [m.dPgF for m in media]
        return cls(
            strength=array(padded[:, 0]),
            resonance=array(padded[:, 1]),
            schott=array([[*m.schott, *[0.0] * (powers - len(m.schott))] for m in media]),
            ranges=array([m.range for m in media]),
            model=array(models) if set(models) != {_NO_MODEL} else None,
            dPgF=array(dPgF) if any(dPgF) else None,
        )


def model_glass(nd: float, vd: float, dPgF: float = 0.0) -> Glass:
    """A glass of given nd and Abbe number vd = (nd - 1) / (nF - nC).

    Its index follows Conrady's formula n = A + B / L + C / L^3.5 through nd, nF - nC and ng - nF =
    P_gF (nF - nC), with P_gF = 0.6438 - 0.001682 vd + dPgF.

    nd: index at the d line.
    vd: Abbe number.
    dPgF: P_gF less that of Schott's normal line.

    ValueError unless 1 < nd <= 4, 10 <= vd <= 120 and -0.2 <= dPgF <= 0.2.
    """
    is_glass, is_near = 1 < nd <= 4 and 10 <= vd <= 120, abs(dPgF) <= _FARTHEST
    require(is_glass, f"expected 1 < nd <= 4 and 10 <= vd <= 120, got {nd:g} and {vd:g}")
    require(is_near, f"expected dPgF within {_FARTHEST:g} of 0, got {dPgF:g}")
    name = f"model {nd!r} {vd!r}" + (f" {dPgF!r}" if dPgF else "")
    return Glass(name, range=VISIBLE, model=(nd, vd), dPgF=dPgF)


def nd_and_vd(dispersion: Dispersion) -> Array:
    """nd and Abbe number vd (M, 2) of all media; vd is 0 for a medium without dispersion."""
    lines = jnp.asarray(FRAUNHOFER[:3], dispersion.schott.dtype)
    nd, f, c = refractive_index(dispersion, lines).T
    return jnp.stack([nd, safe_divide(nd - 1, f - c)], axis=-1)


def with_media(dispersion: Dispersion, rows: np.ndarray, other: Dispersion) -> Dispersion:
    """Replaces the media `rows`, bool (M,), by those of `other`.

    other: M media, or one medium for all. The result has as many terms as the dispersion with more
        of them.

    ValueError for a glass of the catalogue among media that `design.at_temperature` has changed.
    """
    hot = dispersion.thermal is not None and other.thermal is None
    require(not hot, "lens: is at another temperature; change glasses of the lens at 20 C")

    def mixed(name: str, none: Any) -> Any:
        both = getattr(dispersion, name), getattr(other, name)
        if all(part is None for part in both):
            return None
        dtype = dispersion.schott.dtype
        old, new = (jnp.asarray(none if a is None else a, dtype) for a in both)
        mask = np.reshape(rows, (-1, *(1,) * (new.ndim - 1)))
        if new.ndim == 2:
            width = max(old.shape[1], new.shape[1])
            old, new = (jnp.pad(a, ((0, 0), (0, width - a.shape[1]))) for a in (old, new))
        return jnp.where(mask, new, old)

    nones = {"model": [_NO_MODEL], "dPgF": [0.0], "thermal": [[0.0] * 5]}
    names = (field.name for field in dataclasses.fields(Dispersion))
    return Dispersion(**{name: mixed(name, nones.get(name)) for name in names})


def with_models(dispersion: Dispersion, rows: np.ndarray) -> Dispersion:
    """Replaces media by model glasses of the same nd and vd. rows: (M,), bool, the media to
    replace.
    """
    found = nd_and_vd(dispersion)
    none = jnp.zeros((1, 1), found.dtype)
    models = Dispersion(none, none, none + 1, jnp.asarray([VISIBLE], found.dtype), found)
    if dispersion.thermal is not None:  # nd and vd are those at the temperature
        models = dataclasses.replace(models, thermal=jnp.zeros((1, 5), found.dtype))
    return with_media(dispersion, rows, models)


def _model_index(model: Array, dPgF: Array | None, wavelengths: Array) -> Array:
    """n - 1 of model glasses, (M, W); 0 for other media. Arguments as in `Dispersion`.

    Inverts the 3 x 3 system for A - 1, B and C of Conrady's formula.
    """
    d, f, c, g = np.power.outer(FRAUNHOFER, np.asarray(_CONRADY, float))
    formula = np.linalg.inv(np.stack([d, f - c, g - f])).T
    nd, vd = model[:, 0], model[:, 1]
    mean = (nd - 1) / vd
    above = NORMAL_LINE[0] + NORMAL_LINE[1] * vd + (0 if dPgF is None else dPgF)
    known = jnp.stack([nd - 1, mean, above * mean], axis=-1)
    powers = jnp.stack([wavelengths**p for p in _CONRADY])
    # A medium with a dispersion formula has no model.
    own = jnp.where(model[:, :1] > 1, known, 0)
    return matmul(matmul(own, jnp.asarray(formula, known.dtype)), powers)


def _air(wavelengths: Array) -> Array:
    """Index of air at 15 C and one atmosphere, less 1, in the shape of the wavelengths, um: Edlen's
    formula of 1953 as in Kohlrausch's Praktische Physik, which Schott and OpticStudio use; below
    its range the value at 0.2 um."""
    square = jnp.clip(wavelengths, 0.2) ** -2
    return 1e-8 * (6432.8 + 2949810 / (146 - square) + 25540 / (41 - square))


def air_density(celsius: Array, pressure: Array) -> Array:
    """Density of air relative to that at 15 C and one atmosphere, as OpticStudio has it.

    celsius, pressure: C and atmospheres, of shapes that broadcast.
    """
    return pressure / (1 + 3.4785e-3 * (celsius - 15))


@program
def refractive_index(dispersion: Dispersion, wavelengths: Array) -> Array:
    """Index of each medium at each wavelength, (M, W), relative to air, whose index is 1.

    It is finite for any wavelength, and 0 where the formula has no real root, far outside of its
    range.

    dispersion: of M media.
    wavelengths: (W,), um.
    """
    wavelengths = jnp.clip(wavelengths, *ANY)
    b, c = dispersion.strength[..., None], dispersion.resonance[..., None]
    square = (wavelengths**2)[None, None]
    sellmeier = jnp.sum(safe_divide(b * square, square - c), axis=1)
    within = jnp.clip(wavelengths, _SHORTEST)
    count = dispersion.schott.shape[1]
    powers = jnp.stack([(wavelengths if p > -9 else within) ** p for p in POWERS[:count]])
    index = safe_sqrt(sellmeier + matmul(dispersion.schott, powers))
    if dispersion.model is not None:
        index = index + _model_index(dispersion.model, dispersion.dPgF, wavelengths)
    if dispersion.thermal is None:
        return index
    # From relative to absolute, by Schott's formula, and back to relative: to other air.
    change, pole, resonance, before, now = dispersion.thermal.T[..., None]
    air = _air(wavelengths)[None]
    share = change + safe_divide(pole, square[0] - resonance)
    absolute = index * (1 + before * air) + safe_divide(index**2 - 1, 2 * index) * share
    return absolute / (1 + now * air)
