"""Refractive index: the catalogue of glasses and one dispersion formula for all media."""

import dataclasses
import difflib
import functools
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from jax import Array
from jax.typing import ArrayLike

from ..numerics import concrete

__all__ = ["Dispersion", "Glass", "find_glass", "refractive_index"]

# The loader of libyaml, where PyYAML was built with it, takes a tenth of the time.
_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_SCHOTT_POWERS = (0, 2, -2, -4, -6, -8)


@dataclasses.dataclass(frozen=True)
class Glass:
    """Dispersion constants of one medium.

    name: as in a prescription. sellmeier: (B1 .. BT, C1 .. CT), C in um^2, of any number of
    terms T. schott: (a0 .. a5), the coefficients of L^0, L^2, L^-2, L^-4, L^-6, L^-8. range:
    wavelengths in um for which they hold. n^2 is the sum of both forms; a Sellmeier glass has
    a0 = 1, a medium of constant index n has a0 = n^2.
    """

    name: str
    sellmeier: tuple[float, ...] = (0.0,) * 6
    schott: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    range: tuple[float, float] = (0.0, float("inf"))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Dispersion:
    """Dispersion constants of M media as arrays, so that an index can be differentiated.

    strength (M, T) and resonance (M, T, um^2) are Sellmeier's B and C, T = 3 or that of the
    medium with the most terms, the others padded with zeros; schott (M, 6) the coefficients of
    L^0, L^2, L^-2, L^-4, L^-6, L^-8.
    """

    strength: Array
    resonance: Array
    schott: Array

    @classmethod
    def of(cls, media: list[Glass]) -> "Dispersion":
        """The constants of `media`, in the default floating dtype."""
        halves = [np.asarray(m.sellmeier, float).reshape(2, -1) for m in media]
        terms = max(3, *(half.shape[1] for half in halves))
        padded = np.stack([np.pad(half, ((0, 0), (0, terms - half.shape[1]))) for half in halves])
        return cls(
            strength=jnp.asarray(padded[:, 0], float),
            resonance=jnp.asarray(padded[:, 1], float),
            schott=jnp.asarray([m.schott for m in media], float),
        )


@functools.cache
def _catalogue() -> dict[str, Glass]:
    text = (pathlib.Path(__file__).parent / "catalogue" / "glasses.yaml").read_text()
    glasses = {"air": Glass("air")}
    for name, entry in yaml.load(text, _Loader).items():
        constants = {key: tuple(entry[key]) for key in ("sellmeier", "schott") if key in entry}
        glasses[name] = Glass(name, range=tuple(entry["range"]), **constants)
    return glasses


def find_glass(name: str) -> Glass:
    """The catalogue's entry for `name`. ValueError, listing near names, if there is none.

    Names are exact: SK16 and N-SK16 are two glasses. Source: `glasses.yaml`.
    """
    glasses = _catalogue()
    if name in glasses:
        return glasses[name]
    folded = {known.lower(): known for known in glasses}
    near = difflib.get_close_matches(name.lower(), folded, n=5, cutoff=0.5)
    near += [known for known in folded if name.lower() in known and known not in near]
    hint = f"near names: {', '.join(folded[n] for n in near[:6])}" if near else "no near name"
    raise ValueError(f"unknown glass {name!r}; {hint}")


def refractive_index(dispersion: Dispersion, wavelengths: Array) -> Array:
    """Index of each medium at each wavelength, shape (M, W).

    `wavelengths` (W,) in um. Relative to air, whose own index is taken as 1.
    """
    square = wavelengths**2
    b, c, a = dispersion.strength, dispersion.resonance, dispersion.schott
    sellmeier = jnp.sum(b[:, :, None] * square / (square - c[:, :, None]), axis=1)
    powers = jnp.stack([wavelengths**p for p in _SCHOTT_POWERS])
    return jnp.sqrt(sellmeier + a @ powers)


def check_wavelengths(names: tuple[str, ...], wavelengths: ArrayLike) -> None:
    """ValueError if a known wavelength (um) lies outside the range of a catalogue glass.

    Inside a trace the values are not known and nothing is checked.
    """
    if not concrete(wavelengths):
        return
    glasses = _catalogue()
    for name in names:
        low, high = glasses[name].range if name in glasses else (0.0, np.inf)
        for value in np.atleast_1d(np.asarray(wavelengths)):
            if not low <= value <= high:
                raise ValueError(
                    f"wavelength {value:g} um is outside the range of {name}, "
                    f"{low:g} to {high:g} um"
                )
