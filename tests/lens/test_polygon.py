"""Convex pieces of polygons and depths inside of them, compared with areas and the nearest of many
points."""

import jax.numpy as jnp
import numpy as np
import pytest

from drt_jax import LensError, load_lens
from drt_jax.lens.aperture import Apertures, depths
from drt_jax.lens.polygon import convex_pieces, tidied

TURN = np.pi / 5 * np.arange(10)
STAR = np.where(np.arange(10) % 2, 2.0, 5.0)[:, None] * np.stack([np.cos(TURN), np.sin(TURN)], 1)
SHAPES = {
    "slit": [[-0.5, -10], [0.5, -10], [0.5, 10], [-0.5, 10]],
    "clockwise": [[-3, -1], [-2, 4], [5, 1]],
    "L": [[-1, -1], [1, -1], [1, 0], [0, 0], [0, 1], [-1, 1]],
    "star": STAR.tolist(),
    # Corners in a line across, teeth whose tops lie on one line.
    "comb": [[0, 0], [5, 0], [5, 2], [4, 2], [4, 1], [3, 1], [3, 2], [1, 2], [1, 1], [0, 1]],
}  # fmt: skip


def area(corners):
    x, y = np.asarray(corners).T
    return np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) / 2


@pytest.mark.parametrize("name", SHAPES)
def test_pieces_are_convex_and_fill_the_polygon(name):
    corners = tidied(np.array(SHAPES[name], float))
    pieces = [corners[list(piece)] for piece in convex_pieces(corners)]
    assert len(pieces) <= {"slit": 1, "clockwise": 1, "L": 2, "star": 6, "comb": 6}[name]
    np.testing.assert_allclose(sum(map(area, pieces)), abs(area(corners)), rtol=1e-14)
    for piece in pieces:
        for k in range(len(piece)):
            assert area(np.roll(piece, k, axis=0)[:3]) > 0


def test_depth_is_the_distance_from_the_sides():
    """For points everywhere; the sum of the angles of the sides as seen from a point shows whether
    it is inside."""
    corners = np.array(SHAPES["comb"], float)
    centre = np.array([0.3, -0.4])
    one = Apertures(
        jnp.ones((1, 2)), jnp.asarray(centre[None]), jnp.asarray(corners[None]),
        surfaces=(0,), kinds=("polygon",), blocks=(False,),
    )  # fmt: skip
    point = np.random.default_rng(0).uniform([-1, -1], [6, 3], (200, 2))
    share = np.linspace(0, 1, 4001)[:, None, None]
    edge = (corners + share * (np.roll(corners, -1, 0) - corners)).reshape(-1, 2) + centre
    far = np.min(np.hypot(*(edge[:, None] - point).T), axis=1)
    seen = (corners + centre - point[:, None]) @ [1, 1j]
    inside = np.abs(np.sum(np.angle(np.roll(seen, -1, 1) / seen), axis=1)) > 1
    found = depths(one, tuple(jnp.asarray(point.T[:, None])))[0]
    np.testing.assert_allclose(found, np.where(inside, far, -far), atol=1e-3)
    np.testing.assert_allclose(one.sizes, [[5, 2]])


def lens_of(**keys):
    stop = {"radius": "inf", "semi_diameter": 4.0, "stop": True, **keys}
    return load_lens({"surfaces": [stop], "sensor": 10.0})


def test_what_is_no_polygon_is_refused():
    for corners, why in (
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "aperture.polygon: its sides cross or touch"),
        ([[0, 0], [1, 1], [2, 2]], "polygon: needs three corners that do not lie on one line"),
        ([[0, 0], [1, 1]], "polygon: expected 3 to 64 corners"),
        ([[0, 0], [1, 1], [2]], r"polygon\.2: expected a list of 2 numbers"),
        ("square", "polygon: expected 3 to 64 corners"),
    ):
        with pytest.raises(LensError, match=why):
            lens_of(aperture={"polygon": corners})
    square = [[0, 0], [2, 0], [2, 2], [0, 2]]
    for more in ([0, 2], [0, 1]):
        own = jnp.asarray([[*square, more]], float)
        with pytest.raises(ValueError, match="a corner twice, or one on a straight side"):
            Apertures(
                jnp.ones((1, 2)), jnp.zeros((1, 2)), own,
                surfaces=(0,), kinds=("polygon",), blocks=(False,),
            )  # fmt: skip
    with pytest.raises(LensError, match="216 sets of rays, 64 at most"):
        lens_of(obscuration=[{"polygon": SHAPES["star"], "centre": [i, 0]} for i in range(3)])
    with pytest.raises(LensError, match="reaches beyond the surface"):
        lens_of(aperture={"polygon": SHAPES["L"], "centre": [0, 30]}, radius=25.0)
