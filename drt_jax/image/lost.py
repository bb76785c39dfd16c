"""Why no light arrives: which surface stops it, and which surfaces cross."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..lens.aperture import depths
from ..lens.lens import Lens
from ..lens.order import crossing, neighbours_now, told
from ..lens.scene import Scene
from ..pupil.rules import PupilRule
from ..rays.aim import beam_size, paraxial_launch
from ..rays.find import Found
from ..rays.snell import meetings
from ..rays.status import Status
from ..rays.trace import Bundle, aims, bundle_of

_HOW = {
    Status.OK: "arrives, but by none of the rays of the rule",
    Status.MISSED: "misses {}",
    Status.TIR: "is totally reflected at {}",
    Status.CLIPPED: "is clipped at {}",
    Status.UNCONVERGED: "finds no way through the stop",
    Status.NO_INDEX: "has no index",
}
# What is said at most.
_PARTS = 3


def reasons(lens: Lens, scene: Scene, rule: PupilRule, found: Found, colour: int) -> str:
    """What stops the light of a colour, in words: "87 % misses surface 3, ...".

    rule: whose weights tell how much light a ray stands for. found: its rays. All is known.
    """
    _, weights = rule.points(lens, scene)
    bundle, row = _ends(lens, scene, rule, found)
    status, row = np.asarray(bundle.status)[colour], np.asarray(row)[colour]
    weight = np.broadcast_to(np.asarray(weights, float), bundle.status.shape)[colour]
    edges = np.argmax(_stopped(lens, bundle)[:, colour], axis=0)
    surface = np.where(status == Status.CLIPPED, edges, row)
    names = {-1: "a surface", lens.count: "the sensor"}
    parts: dict[str, float] = {}
    for code, index, share in zip(status.tolist(), surface.tolist(), weight.tolist(), strict=True):
        place = names.get(index, f"surface {index}")
        how = _HOW[Status(code)].format(place)
        parts[how] = parts.get(how, 0.0) + share
    largest = sorted(parts.items(), key=lambda part: -part[1])[:_PARTS]
    return ", ".join(f"{share:.0%} {how}" for how, share in largest if share > 0)


def crossed(lens: Lens) -> str:
    """Which surfaces of a known lens cross, in words after a semicolon; nothing if none does."""
    pairs = [(pair, crossing(lens, pair)) for pair in neighbours_now(lens)]
    parts = [told(lens, pair, place) for pair, place in pairs if place is not None]
    return "".join(f"; {part}" for part in parts[:_PARTS])


def check_order(lens: Lens) -> None:
    """ValueError for a known lens with the vertices of two neighbours in the wrong order."""
    for pair in neighbours_now(lens):
        if pair.gap <= 0:
            raise ValueError(f"{told(lens, pair, 0.0)}; light cannot go backwards")


@jax.jit
def _ends(lens: Lens, scene: Scene, rule: PupilRule, found: Found) -> tuple[Bundle, Array]:
    """The bundle of known rays, and the surface (W, Q) where each that paraxial optics launches
    towards its point of the stop ends, S for the sensor, -1 for none."""
    points, _ = rule.points(lens, scene)
    system, target = aims(lens, scene, points)
    bundle = bundle_of(lens, scene, system, target, found)
    launch = paraxial_launch(system, target, beam_size(system, target)[1])
    places = [*lens.live, lens.count]
    if system.stop is not None:
        places.insert(system.before, lens.stop)
    failed = meetings(system, launch).status != Status.OK
    ends = jnp.array(places)[jnp.argmax(failed, axis=0)]
    return bundle, jnp.where(jnp.any(failed, axis=0), ends, -1)


def _stopped(lens: Lens, bundle: Bundle) -> np.ndarray:
    """Whether each surface and the sensor clips rays, (S + 1, W, Q)."""
    semi = np.asarray(lens.semi_diameter.at[lens.stop].set(jnp.inf))
    wide = np.sqrt(sum(np.asarray(hit) ** 2 for hit in bundle.hits))
    found = wide > semi[:, None, None]
    if lens.apertures is not None:
        pairs = zip(lens.apertures.surfaces, lens.apertures.blocks)
        for (surface, blocks), depth in zip(pairs, np.asarray(depths(lens.apertures, bundle.hits))):
            found[surface] |= (depth > 0) == blocks
    return found
