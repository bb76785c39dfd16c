"""Why no light arrives: the surfaces that stop it, and surfaces that cross."""

import functools

import jax.numpy as jnp
import numpy as np
from jax import Array

from ..compilation import ONCE, jit
from ..lens.clearance import clipping_surface
from ..lens.lens import Lens
from ..lens.order import crossings, describe_crossing, neighbours_now
from ..lens.scene import Scene
from ..pupil.rules import PupilRule
from ..rays.aim import beam_size, paraxial_launch
from ..rays.snell import meetings
from ..rays.status import Status
from ..rays.trace import Bundle, aims

_HOW = {
    Status.OK: "arrives, but by none of the rays of the rule",
    Status.MISSED: "misses {}",
    Status.TIR: "is totally reflected at {}",
    Status.CLIPPED: "is clipped at {}",
    Status.UNCONVERGED: "has no path through its stop point",
    Status.NO_INDEX: "has no index",
    Status.CROSSED: "steps back to {}, which crosses its neighbour",
}
# Largest number of reasons in a message.
_PARTS = 3


def reasons(lens: Lens, scene: Scene, rule: PupilRule, bundle: Bundle, wavelength: int) -> str:
    """The surfaces that stop the light of a wavelength, as text: "87% misses surface 3, ...". For
    use outside of traces.

    lens, scene: what was traced.
    rule: pupil rule.
    bundle: rays of the rule.
    wavelength: index of the wavelength.
    """
    _, weights = rule.points(lens, scene)
    status, surface = (np.asarray(a) for a in _last_surface(lens, scene, rule, bundle))
    weight = np.broadcast_to(np.asarray(weights, float), status.shape)[wavelength]
    names = {-1: "a surface", lens.count: "the sensor"}
    parts: dict[str, float] = {}
    rays = status[wavelength].tolist(), surface[wavelength].tolist()
    for code, index, share in zip(*rays, weight.tolist(), strict=True):
        place = names.get(index, f"surface {index}")
        how = _HOW[Status(code)].format(place)
        parts[how] = parts.get(how, 0.0) + share
    largest = sorted(parts.items(), key=lambda part: -part[1])[:_PARTS]
    return ", ".join(f"{share:.0%} {how}" for how, share in largest if share > 0)


def crossed(lens: Lens) -> str:
    """The surfaces of a known lens that cross, as text after a semicolon; an empty text if none
    do."""
    pairs = neighbours_now(lens)
    places = zip(pairs, crossings(lens, pairs), strict=True)
    parts = [describe_crossing(lens, pair, place) for pair, place in places if place is not None]
    return "".join(f"; {part}" for part in parts[:_PARTS])


def check_order(lens: Lens) -> None:
    """ValueError if the vertices of two neighbouring surfaces of a known lens are in the wrong
    order."""
    for pair in neighbours_now(lens):
        if pair.gap <= 0 and pair.second < lens.count:
            raise ValueError(f"{describe_crossing(lens, pair, 0.0)}; light cannot go backwards")


@functools.partial(jit, wanted=ONCE)
def _last_surface(lens: Lens, scene: Scene, rule: PupilRule, bundle: Bundle) -> tuple[Array, Array]:
    """Status (W, Q) of rays, and the index (W, Q), int32, of the surface where each ends; S for
    the sensor, -1 for none. For a clipped ray it is the first surface that clips it; for other
    rays the surface where the paraxial launch towards the stop point fails."""
    points, _ = rule.points(lens, scene)
    system, target = aims(lens, scene, points)
    launch = paraxial_launch(system, target, beam_size(system, target)[1])
    places = [*lens.active, lens.count]
    if system.stop is not None:
        places.insert(system.before, lens.stop)
    failed = meetings(system, launch).status != Status.OK
    last = jnp.array(places, jnp.int32)[jnp.argmax(failed, axis=0)]
    last = jnp.where(jnp.any(failed, axis=0), last, -1)
    clips = clipping_surface(lens, bundle.hits)
    return bundle.status, jnp.where(bundle.status == Status.CLIPPED, clips, last)
