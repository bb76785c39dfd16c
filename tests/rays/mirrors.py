"""Off-axis three-mirror systems, with stops at and around their mirrors.

A mirror is (y, z, tilt about x in degrees, radius, conic, coefficient of r^4): a vertex in the
plane x = 0 along the axes of the lens. A stop is (place in the list, y, z, tilt, semi-diameter).
"""

import itertools
import math

from drt_jax import load_lens


def _along(angle, length, start=(0.0, 0.0)):
    """The point (y, z) `length` mm from `start` along a z axis tilted by `angle` degrees."""
    angle = math.radians(angle)
    return start[0] - length * math.sin(angle), start[1] + length * math.cos(angle)


def _confocal(second, third):
    """A paraboloid, a hyperboloid and an ellipsoid with common foci, each of which images the focus
    of the one before: on axis all rays meet. The axes of the latter two are tilted by `second` and
    `third` degrees about the foci."""
    focus = (0.0, -100.0)
    at = _along(second, 20.0, focus)
    focus = _along(second, 120.0, focus)
    last = _along(third, 60.0, focus)
    mirrors = [
        (0.0, 0.0, 0.0, -200.0, -1.0, 0.0),
        (*at, second, -50.0, -2.25, 0.0),  # magnifies 5 times: k = -(6 / 4)^2
        (*last, third, -80.0, -1 / 9, 0.0),  # twice: k = -(1 / 3)^2
    ]
    return mirrors, (*_along(third, -120.0, last), third)


# The axial ray meets each mirror at its vertex, at 30, 20 and 40 degrees to the axis; the light
# between the second and the third is nearly parallel.
_SECOND = 100 * math.sin(math.radians(30)), -100 * math.cos(math.radians(30))
_THIRD = _along(-20.0, 110.0, _SECOND)
ZIGZAG = (
    [
        (0.0, 0.0, 15.0, -600.0, -1.1, 1e-9),
        (*_SECOND, 5.0, -400.0, -0.7, -3e-8),
        (*_THIRD, 10.0, -240.0, -0.3, 2e-9),
    ],
    (*_along(40.0, -120.0, _THIRD), 40.0),
)
SYSTEMS = {"coaxial": _confocal(0.0, 0.0), "tilted": _confocal(8.0, -6.0), "zigzag": ZIGZAG}

# In the confocal systems the light fills the part of the first mirror from 15 to 55 mm off its
# axis. The rim of this mirror lies 7.6 mm in front of its vertex.
STOPS = {
    ("coaxial", "in front"): (0, 35.0, -60.0, 0.0, 20.0),
    ("coaxial", "at the vertex of the first mirror, behind its rim"): (0, 35.0, 0.0, 0.0, 20.0),
    ("coaxial", "behind the first mirror"): (0, 35.0, 5.0, 0.0, 20.0),
    ("coaxial", "tangent to the first mirror where it is used"): (
        0,
        35.0,
        -(35.0**2) / 400,
        math.degrees(math.atan(35 / 200)),
        20.0,
    ),
    ("coaxial", "tangent to the second mirror"): (1, 7.0, -80.0, 0.0, 4.0),
    ("coaxial", "beyond the first mirror"): (1, 35.0, 2.0, 0.0, 20.0),
    ("coaxial", "behind the second mirror"): (2, 6.0, -85.0, 0.0, 3.0),
    ("tilted", "at the vertex of the first mirror, behind its rim"): (0, 35.0, 0.0, 0.0, 20.0),
    ("tilted", "tangent to the second mirror"): (1, *SYSTEMS["tilted"][0][1][:2], 8.0, 8.0),
    ("tilted", "between the second and the third mirror"): (2, -4.0, -30.0, 5.0, 3.0),
    ("zigzag", "tangent to the first mirror"): (0, 0.0, 0.0, 15.0, 20.0),
    ("zigzag", "tangent to the second mirror"): (1, *_SECOND, 5.0, 12.0),
    ("zigzag", "tangent to the second mirror, listed behind it"): (2, *_SECOND, 5.0, 12.0),
    ("zigzag", "tangent to the third mirror"): (2, *_THIRD, 10.0, 12.0),
    ("zigzag", "behind the third mirror"): (3, *_along(40.0, -30.0, _THIRD), 40.0, 9.0),
}


def load(system, stop):
    """The lens of a system with a stop of `STOPS`."""
    mirrors, (y, z, tilt) = SYSTEMS[system]
    place, *at, semi_diameter = stop
    rows = [
        {"radius": radius, "conic": conic, "coefficients": {4: bent}, "mirror": True}
        for *_, radius, conic, bent in mirrors
    ]
    rows.insert(place, {"radius": "inf", "semi_diameter": semi_diameter, "stop": True})
    places = [mirror[:3] for mirror in mirrors]
    places.insert(place, tuple(at))
    for row, (own_y, _, angle) in zip(rows, places):
        row |= {"decentre": [0.0, own_y], "tilt": [angle, 0.0, 0.0]}
    for row, (here, after) in zip(rows, itertools.pairwise(places)):
        row["thickness"] = after[1] - here[1]
    moved = {"sensor_decentre": [0.0, y], "sensor_tilt": [tilt, 0.0, 0.0]}
    return load_lens({"surfaces": rows, "sensor": z - places[0][1], **moved})
