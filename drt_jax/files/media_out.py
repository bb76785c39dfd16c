"""Convert the media of a lens to entries of a prescription."""

import math
from typing import Any

import numpy as np

from ..lens.glass import ANY, Dispersion
from ..lens.glasses import find_glass, glass_names
from ..lens.lens import Lens
from .entry import LensError


def medium_of(lens: Lens, i: int) -> dict[str, Any] | None:
    """Prescription keys of medium i; None if only its constants describe it."""
    own = constants_of(lens.dispersion, i)
    if lens.dispersion.model is not None and lens.dispersion.model[i, 0] != 1:
        if own.keys() - {"range"}:
            raise LensError(f"glasses[{i}]: a prescription has no constants beside nd and vd")
        nd, vd = np.asarray(lens.dispersion.model[i]).tolist()
        partial = lens.dispersion.partial
        above = {} if partial is None or not partial[i] else {"partial": float(partial[i])}
        return {"nd": nd, "vd": vd} | above
    if not own:
        return {}
    if own.keys() == {"schott"} and not any(own["schott"][1:]):
        return {"index": math.sqrt(own["schott"][0])}
    unnamed = lens.glasses[i] in lens.labels.unnamed.glasses  # returned by a jitted function
    for name in glass_names() if unnamed else [lens.glasses[i]]:
        try:
            glass = find_glass(name)
        except ValueError:
            return None
        alike = np.float32(glass.range[1]) == np.float32(lens.dispersion.ranges[i, 1])
        if alike and own == constants_of(Dispersion.of([glass]), 0):
            return {"glass": name}
    return None


def constants_of(dispersion: Dispersion, i: int) -> dict[str, Any]:
    """The constants of medium i as a prescription's `glasses` hold them; empty for air."""
    parts = (dispersion.strength, dispersion.resonance, dispersion.schott)
    strength, resonance, schott = (np.asarray(part[i]).tolist() for part in parts)
    terms = max((k + 1 for k, pair in enumerate(zip(strength, resonance)) if any(pair)), default=0)
    constants: dict[str, Any] = {}
    if terms:
        constants["sellmeier"] = strength[:terms] + resonance[:terms]
    schott = schott if any(schott[6:]) else schott[:6]
    if schott != [1, 0, 0, 0, 0, 0]:
        constants["schott"] = schott
    known = np.asarray(dispersion.ranges[i])
    if not np.array_equal(known, np.asarray(ANY, known.dtype)):
        constants["range"] = known.tolist()
    return constants


def media_of_lens(lens: Lens) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Keys of each medium, none for air, and the glasses that the file has to define."""
    plain = [medium_of(lens, i) for i in range(lens.count + 1)]
    described = {name for name, keys in zip(lens.glasses, plain, strict=True) if keys is None}
    media: list[dict[str, Any]] = []
    glasses: dict[str, Any] = {}
    for i, (name, keys) in enumerate(zip(lens.glasses, plain, strict=True)):
        if i and name == lens.glasses[i - 1]:  # light keeps the constants of the medium in front
            keys = media[-1]
        elif keys is None or keys.get("glass") in described:
            own = constants_of(lens.dispersion, i)
            while glasses.setdefault(name, own) != own:  # another medium has this name
                name += "*"
            keys = {"glass": name}
        media.append(keys)
    return media, glasses
