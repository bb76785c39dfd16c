"""Refractive index: one dispersion formula for all media, and model glasses."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..numerics import concrete, safe_divide, safe_sqrt

# Of model glasses: the lines d, F, C, g in um, the powers of L in Conrady's formula, P_gF on
# Schott's normal line as (constant, slope by vd), and where they are used: from line i to line t.
FRAUNHOFER, _CONRADY = (0.5875618, 0.4861327, 0.6562725, 0.4358343), (0, -1, -3.5)
NORMAL_LINE, VISIBLE = (0.6438, -0.001682), (0.365, 1.014)
_NO_MODEL, _FARTHEST = (1.0, 50.0), 0.2
# Wavelengths in um of a medium without a range: 0.1 nm to 1 m.
ANY = 1e-4, 1e6
# Powers of L of `Glass.schott`, and the shortest wavelength of -10 and -12, whose values are too
# large for float32 below.
POWERS, _SHORTEST = (0, 2, -2, -4, -6, -8, 4, -10, -12, 6), 0.01


@dataclasses.dataclass(frozen=True)
class Glass:
    """Dispersion constants of one medium.

    n^2 is the sum of both forms; a Sellmeier glass has a0 = 1, a medium of constant index n has
    a0 = n^2.

    name: as in a prescription.
    sellmeier: (B1 .. BT, C1 .. CT), C in um^2, of any number of terms T.
    schott: (a0 .. a5), the coefficients of L^0, L^2, L^-2, L^-4, L^-6, L^-8, or three more, of
        L^4, L^-10, L^-12, or one more than these, of L^6.
    range: wavelengths in um for which they hold.
    model: nd and vd of a model glass, see `model_glass`.
    partial: how far a model glass lies above the normal line, in P_gF.
    maker, source: of the table of glasses; "" where there is none.
    """

    name: str
    sellmeier: tuple[float, ...] = (0.0,) * 6
    schott: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    range: tuple[float, float] = ANY
    model: tuple[float, float] = _NO_MODEL
    partial: float = 0.0
    maker: str = ""
    source: str = ""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Dispersion:
    """Dispersion constants of M media as arrays, so that an index can be differentiated.

    T = 3 or the number of terms of the medium with the most, the others padded with zeros; so is
    K = 6, 9 or 10, the number of Schott's coefficients.

    strength: (M, T), Sellmeier's B.
    resonance: (M, T), Sellmeier's C in um^2.
    schott: (M, K), the coefficients of the powers of L that `Glass` has.
    ranges: (M, 2), the shortest and the longest wavelength (um) for which each medium has known
        constants.
    model: (M, 2), nd and vd of model glasses, nd = 1 for other media; None if there is none.
    partial: (M,), how far model glasses lie above the normal line, in P_gF; None: all on it.
    """

    strength: Array
    resonance: Array
    schott: Array
    ranges: Array
    model: Array | None = None
    partial: Array | None = None

    @property
    def range(self) -> tuple[Any, Any]:
        """The shortest and the longest wavelength, um, at which all media have a known index; the
        first number is the larger one if there is none. Floats, or arrays () in a trace."""
        if concrete(self.ranges):
            low, high = np.asarray(self.ranges, float).T
            return float(low.max()), float(high.min())
        low, high = jax.lax.stop_gradient(self.ranges).T
        return jnp.max(low), jnp.min(high)

    def knows(self, wavelengths: Array) -> Array:
        """Whether all media have a known index at each wavelength (um), bool; also in a trace."""
        low, high = (jnp.asarray(end, wavelengths.dtype) for end in self.range)
        return (wavelengths >= low) & (wavelengths <= high)

    @classmethod
    def of(cls, media: list[Glass]) -> "Dispersion":
        """The constants of `media`, in the default floating dtype."""
        halves = [np.asarray(m.sellmeier, float).reshape(2, -1) for m in media]
        terms = max(3, *(half.shape[1] for half in halves))
        padded = np.stack([np.pad(half, ((0, 0), (0, terms - half.shape[1]))) for half in halves])
        powers = max(len(m.schott) for m in media)
        models, partial = [m.model for m in media], [m.partial for m in media]

        def array(values):
            return jax.device_put(np.asarray(values, jnp.result_type(float)))

        return cls(
            strength=array(padded[:, 0]),
            resonance=array(padded[:, 1]),
            schott=array([[*m.schott, *[0.0] * (powers - len(m.schott))] for m in media]),
            ranges=array([m.range for m in media]),
            model=array(models) if set(models) != {_NO_MODEL} else None,
            partial=array(partial) if any(partial) else None,
        )


def model_glass(nd: float, vd: float, partial: float = 0.0) -> Glass:
    """A glass of which only nd and the Abbe number vd = (nd - 1) / (nF - nC) are known, and perhaps
    how far its P_gF lies above Schott's normal line, `partial`.

    n = A + B / L + C / L^3.5 (Conrady) through nd, nF - nC and ng - nF = P_gF (nF - nC), with
    P_gF = 0.6438 - 0.001682 vd + partial. ValueError unless 1 < nd <= 4, 10 <= vd <= 120 and
    |partial| <= 0.2.
    """
    if not (1 < nd <= 4 and 10 <= vd <= 120):
        raise ValueError(f"expected 1 < nd <= 4 and 10 <= vd <= 120, got {nd:g} and {vd:g}")
    if not abs(partial) <= _FARTHEST:
        raise ValueError(f"expected P_gF within {_FARTHEST:g} of the normal line, got {partial:g}")
    name = f"model {nd!r} {vd!r}" + (f" {partial!r}" if partial else "")
    return Glass(name, range=VISIBLE, model=(nd, vd), partial=partial)


def nd_and_vd(dispersion: Dispersion) -> Array:
    """nd and the Abbe number vd (M, 2) of all media; vd 0 where there is no dispersion."""
    lines = jnp.asarray(FRAUNHOFER[:3], dispersion.schott.dtype)
    nd, f, c = refractive_index(dispersion, lines).T
    return jnp.stack([nd, safe_divide(nd - 1, f - c)], axis=-1)


def with_media(dispersion: Dispersion, rows: np.ndarray, other: Dispersion) -> Dispersion:
    """The dispersion with the constants of another, of M media or of one, in place of some media,
    bool (M,). It has as many terms as the one with more."""

    def mixed(name: str, none: Any) -> Any:
        both = getattr(dispersion, name), getattr(other, name)
        if both == (None, None):
            return None
        old, new = (jnp.asarray(none) if a is None else a for a in both)
        mask = np.reshape(rows, (-1, *(1,) * (new.ndim - 1)))
        if new.ndim == 2:
            width = max(old.shape[1], new.shape[1])
            old, new = (jnp.pad(a, ((0, 0), (0, width - a.shape[1]))) for a in (old, new))
        return jnp.where(mask, new, old).astype(dispersion.schott.dtype)

    nones = {"model": [_NO_MODEL], "partial": [0.0]}
    names = (field.name for field in dataclasses.fields(Dispersion))
    return Dispersion(**{name: mixed(name, nones.get(name)) for name in names})


def with_models(dispersion: Dispersion, rows: np.ndarray) -> Dispersion:
    """The dispersion with model glasses of the same nd and vd in place of some media, bool (M,)."""
    found = nd_and_vd(dispersion)
    none = jnp.zeros((1, 1), found.dtype)
    models = Dispersion(none, none, none + 1, jnp.asarray([VISIBLE], found.dtype), found)
    return with_media(dispersion, rows, models)


def _model_index(model: Array, partial: Array | None, wavelengths: Array) -> Array:
    """n - 1, (M, W), of model glasses (M, 2), `partial` (M,) above the normal line."""
    d, f, c, g = np.power.outer(FRAUNHOFER, np.asarray(_CONRADY, float))
    formula = np.linalg.inv(np.stack([d, f - c, g - f])).T
    nd, vd = model[:, 0], model[:, 1]
    mean = (nd - 1) / vd
    above = NORMAL_LINE[0] + NORMAL_LINE[1] * vd + (0 if partial is None else partial)
    known = jnp.stack([nd - 1, mean, above * mean], axis=-1)
    powers = jnp.stack([wavelengths**p for p in _CONRADY])
    return known @ jnp.asarray(formula, known.dtype) @ powers


def refractive_index(dispersion: Dispersion, wavelengths: Array) -> Array:
    """Index of each medium at each wavelength, shape (M, W).

    Relative to air, whose own index is taken as 1. Finite for any wavelength; 0 where the formula,
    far outside its range, has no real root.

    dispersion: of M media.
    wavelengths: (W,) in um.
    """
    wavelengths = jnp.clip(wavelengths, *ANY)
    b, c = dispersion.strength[..., None], dispersion.resonance[..., None]
    square = (wavelengths**2)[None, None]
    sellmeier = jnp.sum(safe_divide(b * square, square - c), axis=1)
    within = jnp.clip(wavelengths, _SHORTEST)
    count = dispersion.schott.shape[1]
    powers = jnp.stack([(wavelengths if p > -9 else within) ** p for p in POWERS[:count]])
    index = safe_sqrt(sellmeier + dispersion.schott @ powers)
    if dispersion.model is None:
        return index
    return index + _model_index(dispersion.model, dispersion.partial, wavelengths)
