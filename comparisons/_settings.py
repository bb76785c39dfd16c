"""Which other optimisers go from the starts of a design, and what they can be told of it."""

import dataclasses
from typing import Annotated, Any

from drt_jax.design import Operand
from experiments import _common
from experiments._common import within

from ._optiland import SETTINGS

_PEERS = ["ours", "optimistix", "adam", "optiland", *(f"optiland {name}" for name in SETTINGS)]
_GAPS = {"glass_centre", "glass_edge", "air_centre", "air_edge"}
_TELLS = "{}: knows curvatures, thicknesses and the sensor, a spot, limits of gaps, a focal length"
_TELLS += " and a pupil, no ties, weights or clear apertures; leave it out"
_TELLS_RADII = "{}: knows a singlet's curvatures and spot on the axis, one start, 0.55 um, 5 rings"


@dataclasses.dataclass(frozen=True)
class Beside:
    """Other optimisers from the same starts.

    peers: which; "ours": each start alone to its end. "optiland NAME": of the radii of a singlet,
    as `_optiland.SETTINGS` say. starts: how many of them; 0: all. seconds: at most of "optiland"
    from one start. steps, rate: of "adam", the rate in scales of the variables.
    """

    peers: Annotated[tuple[str, ...], _common.different]
    starts: Annotated[int, within(0, 1e5)] = 0
    seconds: Annotated[float, within(1e-3, 1e5)] = 30.0
    steps: Annotated[int, within(1, 1e6)] = 2000
    rate: Annotated[float, within(1e-6, 10)] = 0.01

    def __post_init__(self) -> None:
        _common.require_known("peers", self.peers, _PEERS)


def require_told(config: Any, peers: tuple[str, ...]) -> None:
    """ConfigError for settings of a design that Optiland's optimisers cannot be told."""
    kinds, solves = ({one.kind for one in some} for some in (config.variables, config.solves))
    limits = {operand.kind for operand in config.operands if operand.limits}
    spots = [operand for operand in config.operands if not operand.limits] == [Operand("spot")]
    lens = spots and kinds <= {"curvature", "thickness", "sensor"} and limits <= _GAPS
    lens = lens and solves <= {"focal_length", "entrance_pupil"} and config.floating
    lens = lens and not (config.ties or config.colour_weights or config.field_weights)
    scene = config.fields_deg, config.wavelengths_um, config.rings, config.starts.count
    radii = lens and kinds == {"curvature"} and scene == ((0.0,), (0.55,), 5, 1)
    radii = radii and not limits and not solves
    for name in (name for name in peers if name.startswith("optiland")):
        good, tells = (lens, _TELLS) if name == "optiland" else (radii, _TELLS_RADII)
        _common.require(good, "peers: " + tells.format(name))
