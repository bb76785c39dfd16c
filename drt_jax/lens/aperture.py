"""Apertures other than circles about a vertex: ellipses, rectangles, polygons, decentred apertures
and obscurations.
"""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..inputs import require
from ..numerics import concrete, safe_divide, safe_sqrt, selected
from .polygon import convex_pieces


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Apertures:
    """A apertures, each along the axes of its surface.

    half: (A, 2), half widths along x and y, mm. Of a circle the first is the radius, and the second
        is not used. Of a polygon they are the units of its corners along x and y.
    centre: (A, 2), from the vertex, mm; None if all are centred on their vertices.
    corners: (A, N, 2), corners of polygons from their centres, in units of `half`, in their order
        around the polygon; rows behind the last corner are not used. None without polygons.

    Static, A of each:
    surfaces: indices of the surfaces.
    kinds: "circle", "ellipse", "rectangle" or "polygon".
    blocks: True for an obscuration, which stops the light inside; False for an aperture that stops
        the light outside.
    pieces: the convex pieces of each polygon, each piece the numbers of its corners
        counterclockwise, see `convex_pieces`; () for other kinds. If () is given in place of all,
        the pieces are computed from the corners, for polygons that use all N corners. ValueError if
        the corners are not known, as inside `jax.jit`, or if sides cross.
    """

    half: Array
    centre: Array | None = None
    corners: Array | None = None
    surfaces: tuple[int, ...] = dataclasses.field(metadata={"static": True}, kw_only=True)
    kinds: tuple[str, ...] = dataclasses.field(metadata={"static": True}, kw_only=True)
    blocks: tuple[bool, ...] = dataclasses.field(metadata={"static": True}, kw_only=True)
    pieces: tuple[tuple[tuple[int, ...], ...], ...] = dataclasses.field(
        metadata={"static": True}, kw_only=True, default=()
    )
    only = selected

    def __post_init__(self) -> None:
        if not self.pieces and self.corners is None:
            object.__setattr__(self, "pieces", ((),) * len(self.kinds))
        elif not self.pieces:
            known = concrete(self.corners)
            require(known, "apertures: the pieces of a polygon need known corners")
            each = zip(self.kinds, np.asarray(self.corners, float), strict=True)
            found = [convex_pieces(own) if kind == "polygon" else () for kind, own in each]
            object.__setattr__(self, "pieces", tuple(found))

    @property
    def sizes(self) -> Array:
        """Half widths (A, 2) along x and y, mm.

        Of a circle both are the radius; of a polygon they are the largest distances of its corners
        from its centre.
        """
        rows = []
        for k, kind in enumerate(self.kinds):
            if kind == "polygon":
                rows.append(jnp.max(jnp.abs(self.outline(k)), axis=0))
            else:
                rows.append(self.half[k, np.array([0, int(kind != "circle")])])
        return jnp.stack(rows)

    def outline(self, k: int) -> Array:
        """The corners (N, 2) of polygon k from its centre, mm."""
        assert self.corners is not None
        return self.half[k : k + 1] * self.corners[k, : 1 + max(itertools.chain(*self.pieces[k]))]

    @property
    def most(self) -> int:
        """Largest number of corners of a convex piece; 0 without polygons."""
        return max(map(len, itertools.chain(*self.pieces)), default=0)

    def terms(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The open area as a signed sum of T areas, each the intersection of convex shapes.

        Light passes inside of all clear apertures and outside of all obscurations. By inclusion and
        exclusion, the product of (1 - B) over the obscurations B is the sum over all sets of
        obscurations of the area inside of all of the set, with a negative sign for an odd number of
        them. A polygon is the sum of its convex pieces.

        Returns signs (T,); which apertures shape each area (T, A), bool; and the corners of the
        pieces of polygons (T, A, N).
        """
        none, options = (0,) * self.most, []  # a polygon with one corner has no edge
        for blocks, pieces in zip(self.blocks, self.pieces, strict=True):
            sign = -1 if blocks else 1
            rows = [(sign, True, own + own[-1:] * (self.most - len(own))) for own in pieces]
            rows = rows or [(sign, True, none)]
            options.append(rows + [(1, bool(pieces), none)] * blocks)
        parts = [[*zip(*row, strict=True)] for row in itertools.product(*options)]
        signs, shapes, corners = (np.array(part) for part in zip(*parts, strict=True))
        return np.prod(signs, axis=1), shapes, corners

    def part(self, shapes: Array, corners: Array) -> "Apertures":
        """The apertures of one of the `terms`; its polygons are convex."""
        half, own = jnp.where(shapes[:, None], self.half, jnp.inf), self.corners
        if own is not None:
            own = jnp.take_along_axis(own, corners[..., None], axis=1)
        return dataclasses.replace(self, half=half, corners=own)

    def edges(self) -> tuple[Array, Array, np.ndarray]:
        """Edges q.q = 1 of convex apertures, with q = matrix (hit - centre).

        A side of a polygon is one side of a strip that is twice as wide as the polygon.

        Returns matrices (E, 2, 2), centres (E, 2), mm, and surfaces (E,).
        """
        found, eye = [], jnp.eye(2, dtype=self.half.dtype)
        for k, kind in enumerate(self.kinds):
            middle = jnp.zeros((1, 2), eye.dtype) if self.centre is None else self.centre[k : k + 1]
            if kind == "polygon":
                assert self.corners is not None
                matrix, off = _strips(self.half[k : k + 1] * self.corners[k])
                middle = middle + off
            else:
                matrix = eye / self.sizes[k : k + 1]
                matrix = eye[..., None] * matrix[None] if kind == "rectangle" else matrix[None]
            found.append((matrix, jnp.broadcast_to(middle, matrix.shape[:2])))
        own = np.repeat(np.array(self.surfaces), [len(matrix) for matrix, _ in found])
        matrices, centres = (jnp.concatenate(part) for part in zip(*found, strict=True))
        return matrices, centres, own


def _strips(corners: Array) -> tuple[Array, Array]:
    """Matrices (N, 2, 2) and centres (N, 2) of the edges of a convex polygon (N, 2).

    A side of length 0 is no edge.
    """
    along = jnp.roll(corners, -1, axis=0) - corners
    outwards = jnp.stack([along[:, 1], -along[:, 0]], axis=1)
    length = safe_sqrt(jnp.sum(along**2, axis=1, keepdims=True))
    outwards = safe_divide(outwards, jnp.broadcast_to(length, outwards.shape))
    depth = jnp.sum(outwards[:, None] * (corners[:, None] - corners[None]), axis=2)
    width = jax.lax.stop_gradient(jnp.max(depth, axis=1, keepdims=True))
    row = safe_divide(outwards, jnp.broadcast_to(width, outwards.shape))
    return jnp.stack([row, 0 * row], axis=1), corners - width * outwards


def depths(apertures: Apertures, hits: tuple[Array, ...]) -> Array:
    """Distance of hits from the edge of each aperture, (A, ...), mm, to first order; negative
    outside.

    For a rectangle it is the distance from the nearest side; for a polygon the distance from the
    nearest side segment. For an ellipse with q = (x / a, y / b) it is (1 - |q|) / |grad |q||.

    hits: D arrays (S + 1, ...), on all surfaces, mm; D = 1 on the meridian.
    """
    found = []
    for k, (surface, kind) in enumerate(zip(apertures.surfaces, apertures.kinds, strict=True)):
        point = [hit[surface] for hit in hits]
        if apertures.centre is not None:
            centre = apertures.centre[k, 2 - len(point) :]
            point = [p - c for p, c in zip(point, centre, strict=True)]
        if kind == "polygon":
            found.append(_polygon_depth(apertures.outline(k), point[-1], *point[:-1]))
            continue
        half = apertures.sizes[k, 2 - len(point) :]
        if kind == "rectangle":
            found.append(jnp.min(jnp.stack([h - abs(p) for h, p in zip(half, point)]), axis=0))
            continue
        scaled = jnp.stack([p / h for p, h in zip(point, half, strict=True)])
        size = safe_sqrt(jnp.sum(scaled**2, axis=0))
        slope = safe_sqrt(sum((q / h) ** 2 for q, h in zip(scaled, half, strict=True)))
        length = jnp.where(slope > 0, safe_divide(size, slope), jnp.min(half))
        found.append((1 - size) * length)
    return jnp.stack(found)


def _polygon_depth(corners: Array, y: Array, x: Array | None = None) -> Array:
    """Distance (...) of points from the nearest side of a polygon (N, 2), negative outside."""
    point = jnp.stack([0 * y if x is None else x, y])
    end = jnp.roll(corners, -1, axis=0)
    a, b = (c.T.reshape(2, -1, *[1] * y.ndim) for c in (corners, end))
    along, offset = b - a, point[:, None] - a
    fraction = jnp.clip(jnp.sum(offset * along, axis=0) / jnp.sum(along**2, axis=0), 0, 1)
    far = safe_sqrt(jnp.min(jnp.sum((offset - fraction[None] * along) ** 2, axis=0), axis=0))
    # The point lies inside if an odd number of sides cross its height to its right.
    passes = (a[1] > y[None]) != (b[1] > y[None])
    right = (along[0] * offset[1] > along[1] * offset[0]) == (along[1] > 0)
    inside = jnp.sum(passes & right, axis=0) % 2 == 1
    return jnp.where(inside, far, -far)
