"""Quadrature on the part of the pupil that clear apertures leave: nodes fitted to its boundary.

A rule on the whole stop whose clipped rays drop out one by one converges like a sum of pixels.
Here the boundary is found: in polar coordinates about a point inside, the distance to it is
smooth but for the corners where one aperture takes over from another. Gauss rules between the
corners and along the radii converge as fast as without clipping, and because each boundary
point follows the lens (one Newton step of the aperture's equation), so do the derivatives.
"""

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from ..rays.fermat import Status
from ..lens.lens import Lens
from ..rays.trace import trace_bundle

__all__ = ["Boundary", "ClippedPupil", "find_boundary", "fitted_nodes"]

_BATCH = 128  # rays of one search call
_TRIALS = 60
_CORNER_STEPS = 8
_STENCIL = np.array([-2.0, -1.0, 1.0, 2.0])
_STENCIL_WEIGHTS = np.array([1.0, -8.0, 8.0, -1.0]) / 12
_STEP = 1e-3


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class ClippedPupil:
    """A quadrature rule on a clipped pupil, in units of the stop's semi-diameter.

    B boundary points about `centre` (D, W): along unit vectors `direction` (D, W, B) at
    `radius` (W, B), where the aperture of `surface` (W, B) ends the beam (S: none that moves)
    with d(r^2)/d(radius) = `slope` (W, B), mm^2. Q nodes: on the way to boundary point `spoke`
    (Q,) at `fraction` (Q,) of it, with `weight` (W, Q) for a radius of 1.

    order: that of the Gauss rules.
    """

    centre: Array
    direction: Array
    radius: Array
    surface: Array
    slope: Array
    spoke: Array
    fraction: Array
    weight: Array
    order: int


def fitted_nodes(
    lens: Lens,
    field: Array,
    distance: Array,
    wavelengths: Array,
    rule: ClippedPupil,
    forward: bool,
) -> tuple[Array, Array]:
    """Nodes (D, W, Q) and weights (W, Q) of the rule, following the lens; the weights add up to
    the fraction of the stop that is left. Differentiable; arguments as `trace_bundle`."""
    dtype = lens.curvature.dtype
    centre, direction, radius, slope, fraction, weight = (
        jnp.asarray(a, dtype)
        for a in (
            rule.centre[..., None],
            rule.direction,
            rule.radius,
            rule.slope,
            rule.fraction,
            rule.weight,
        )
    )
    surface, spoke = jnp.asarray(rule.surface), jnp.asarray(rule.spoke)
    spokes = centre + radius * direction
    bundle = trace_bundle(lens, field, distance, wavelengths, spokes, forward)
    r2 = jnp.sum(bundle.hits**2, axis=0)
    r2 = jnp.take_along_axis(r2, surface[None], axis=0)[0]
    edge = jnp.append(lens.semi_diameter, jnp.ones_like(lens.sensor))[surface]
    whole = (bundle.status == Status.OK) | (bundle.status == Status.CLIPPED)
    moves = (surface < len(lens.forms)) & whole
    excess = jnp.where(moves, r2 - jnp.where(moves, edge, 1) ** 2, 0)
    along = (radius - excess / jnp.where(moves, slope, 1))[:, spoke]
    return centre + fraction * along * direction[..., spoke], weight * along**2


@jax.jit
def _reach(
    lens: Lens, field: Array, distance: Array, wavelengths: Array, points: Array
) -> tuple[Array, Array]:
    bundle = trace_bundle(lens, field, distance, wavelengths, points)
    failed = (bundle.status != Status.OK) & (bundle.status != Status.CLIPPED)
    return jnp.sum(bundle.hits[:, :-1] ** 2, axis=0), failed


class Boundary:
    """The boundary of the clipped pupil of one known scene: see `find_boundary`."""

    def __init__(self, scene: tuple, symmetry: str):
        self.scene, self.symmetry = scene, symmetry
        lens = scene[0]
        self.dtype = lens.curvature.dtype
        self.edges = np.asarray(lens.semi_diameter, float).copy()
        self.edges[lens.stop] = np.inf
        self.colours = len(scene[3])
        self.dim = 1 if symmetry == "meridian" else 2
        self.centre = np.zeros((self.dim, self.colours))
        self.corners: list[np.ndarray] = [np.zeros(0)] * self.colours

    def _squares(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """r^2 (S, W, N) on the surfaces and which rays fail (W, N), points (D, W, N)."""
        r2, failed = [], []
        for i in range(0, points.shape[-1], _BATCH):
            part = points[..., i : i + _BATCH]
            full = np.pad(part, ((0, 0), (0, 0), (0, _BATCH - part.shape[-1])))
            a, b = _reach(*self.scene, jnp.asarray(full, self.dtype))
            r2.append(np.asarray(a, float)[..., : part.shape[-1]])
            failed.append(np.asarray(b)[..., : part.shape[-1]])
        return np.concatenate(r2, -1), np.concatenate(failed, -1)

    def _excess(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """r^2 / edge^2 - 1 of each aperture (S, W, N); which rays fail."""
        r2, failed = self._squares(points)
        return r2 / self.edges[:, None, None] ** 2 - 1, failed  # -1 without an aperture

    def _worst(self, points: np.ndarray) -> np.ndarray:
        """How far (W, N) rays are outside the aperture that they meet worst: above 0, clipped; 1 for
        a ray that fails."""
        excess, failed = self._excess(points)
        return np.where(failed, 1.0, np.max(excess, axis=0))

    def _inside(self, points: np.ndarray) -> np.ndarray:
        return self._worst(points) <= 0

    def _unit(self, angle: np.ndarray) -> np.ndarray:
        if self.dim == 1:
            return np.ones((1, *angle.shape))
        return np.stack([np.cos(angle), np.sin(angle)])

    def _rim(self, unit: np.ndarray) -> np.ndarray:
        """Radius (W, N) at which the spokes reach the edge of the stop."""
        c = self.centre[..., None]
        along = np.sum(c * unit, axis=0)
        return -along + np.sqrt(along**2 + 1 - np.sum(c * c, axis=0))

    def at(self, angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Radius (W, N) of the boundary at `angle` (W, N), and the surface that makes it (S: the
        stop, or rays that fail)."""
        unit, c = self._unit(angle), self.centre[..., None]
        rim = self._rim(unit)
        low, high = np.zeros_like(rim), rim.copy()
        f_low, f_high = self._worst(c + 0 * unit), self._worst(c + rim * unit)
        whole = f_high <= 0
        found = np.where(whole, rim, low)
        # The Illinois method, every third step a bisection: a ray that fails has no height.
        tiny = 16 * float(np.finfo(self.dtype).eps)
        side = np.zeros(rim.shape, int)
        for k in range(_TRIALS):
            done = whole | (high - low <= tiny)
            if np.all(done):
                break
            secant = (low * f_high - high * f_low) / np.where(done, 1, f_high - f_low)
            middle = (low + high) / 2 if k % 3 == 0 else np.clip(secant, low, high)
            f = self._worst(c + middle * unit)
            inside, hit = f <= 0, np.abs(f) <= tiny
            f_low = np.where(inside, f, f_low * np.where(side == -1, 0.5, 1))
            f_high = np.where(inside, f_high * np.where(side == 1, 0.5, 1), f)
            side = np.where(inside, 1, -1)
            low, high = np.where(inside | hit, middle, low), np.where(inside & ~hit, high, middle)
            found = np.where(done, found, low)
        low = found
        excess, _ = self._excess(c + low * unit)
        surface = np.argmax(excess, axis=0)
        met = np.max(excess, axis=0) > -10 * float(np.sqrt(np.finfo(self.dtype).eps))
        return low, np.where(whole | ~met, len(self.edges), surface)

    def _value(self, points: np.ndarray, surface: np.ndarray) -> np.ndarray:
        """The function (W, N) whose zero is the edge of `surface` (W, N), smooth in the points."""
        excess, _ = self._excess(points)
        padded = np.concatenate([excess, np.sum(points**2, axis=0)[None] - 1])
        return np.take_along_axis(padded, surface[None], axis=0)[0]

    def _corner(self, angle, radius, first, second):
        """Where two edges cross: Newton's method in (radius, angle), all corners (W, N) at once."""
        h = 1e-5
        for _ in range(_CORNER_STEPS):
            moves = [(0, 0), (h, 0), (-h, 0), (0, h), (0, -h)]
            spokes = [(radius + a) * self._unit(angle + b) for a, b in moves]
            points = self.centre[..., None] + np.concatenate(spokes, -1)
            values = [
                self._value(points, np.tile(surface, 5)).reshape(*angle.shape[:-1], 5, -1)
                for surface in (first, second)
            ]
            f, g = (v[:, 0] for v in values)
            (fr, fa), (gr, ga) = (
                ((v[:, 1] - v[:, 2]) / (2 * h), (v[:, 3] - v[:, 4]) / (2 * h)) for v in values
            )
            det = fr * ga - fa * gr
            det = np.where(det == 0, 1, det)
            dr, da = (f * ga - g * fa) / det, (fr * g - gr * f) / det
            radius, angle = radius - np.clip(dr, -0.05, 0.05), angle - np.clip(da, -0.02, 0.02)
        return angle

    def locate(self) -> bool:
        """Find a centre and the corners; False if no ray passes."""
        half = self.symmetry == "half"
        if self.dim == 1:
            return bool(np.all(self._inside(np.zeros((1, self.colours, 1)))))
        side = np.linspace(-1, 1, 41)
        x, y = np.meshgrid(side[side >= 0] if half else side, side)
        grid = np.stack([x, y]).reshape(2, -1)
        grid = grid[:, np.sum(grid**2, axis=0) <= 1]
        inside = self._inside(np.repeat(grid[:, None], self.colours, axis=1))
        if not np.all(np.any(inside, axis=-1)):
            return False
        count = np.sum(inside, axis=-1)
        self.centre = np.stack([np.sum(inside * g, axis=-1) / count for g in grid])
        if half:
            self.centre[0] = 0
        low, high = (-np.pi / 2, np.pi / 2) if half else (-np.pi, np.pi)
        angle = np.linspace(low, high, 2 * _BATCH + 1)
        angle = np.repeat(angle[None], self.colours, axis=0)
        radius, surface = self.at(angle)
        changes = surface[:, 1:] != surface[:, :-1]
        most = int(np.max(np.sum(changes, axis=-1)))
        if most == 0:
            return True
        # The same number of corners for every colour, those that are missing repeated.
        places = [np.flatnonzero(row) for row in changes]
        count = [len(row) for row in places]
        places = np.stack([np.resize(row, most) if row.size else [0] * most for row in places])
        here = partial(np.take_along_axis, indices=places, axis=-1)
        next_ = partial(np.take_along_axis, indices=places + 1, axis=-1)
        start = (here(angle) + next_(angle)) / 2
        middle = (here(radius) + next_(radius)) / 2
        found = self._corner(start, middle, here(surface), next_(surface))
        step = angle[0, 1] - angle[0, 0]
        found = np.where(np.abs(found - start) < 2 * step, found, start)
        self.corners = [np.sort(row[:n]) for row, n in zip(found, count)]
        return True

    def _panels(self, order: int) -> tuple[np.ndarray, np.ndarray]:
        """Azimuths (W, B) and weights (W, B): a Gauss rule between neighbouring corners."""
        half = self.symmetry == "half"
        if self.dim == 1:
            return np.zeros((self.colours, 1)), np.ones((self.colours, 1))
        count = order + 2
        low, turn = -np.pi / 2, np.pi if half else 2 * np.pi
        nodes, weights = np.polynomial.legendre.leggauss(count)
        rows = []
        for corners in self.corners:
            if not corners.size:  # a smooth boundary: uniform azimuths
                many = 2 * count
                angle = low + turn * (np.arange(many) + 0.5) / many
                rows.append((angle, np.full(many, turn / many)))
                continue
            if half:
                ends = np.concatenate([[low], corners, [low + turn]])
            else:
                ends = np.append(corners, corners[0] + turn)
            middle, width = (ends[1:] + ends[:-1]) / 2, np.diff(ends) / 2
            angle = middle[:, None] + width[:, None] * nodes
            rows.append((angle.ravel(), (width[:, None] * weights).ravel()))
        most = max(len(angle) for angle, _ in rows)
        angles = np.stack([np.pad(a, (0, most - len(a)), mode="edge") for a, _ in rows])
        return angles, np.stack([np.pad(w, (0, most - len(w))) for _, w in rows]) / (turn / 2)

    def rule(self, order: int) -> ClippedPupil:
        """The rule of an order: as many nodes along a spoke, two more spokes between corners."""
        angle, width = self._panels(order)
        radius, surface = self.at(angle)
        unit = self._unit(angle)
        along = radius[..., None] + _STEP * _STENCIL
        points = self.centre[..., None, None] + along * unit[..., None]
        r2, _ = self._squares(points.reshape(self.dim, self.colours, -1))
        r2 = r2.reshape(len(self.edges), *points.shape[1:])
        own = np.minimum(surface, len(self.edges) - 1)[None, ..., None]
        slope = np.sum(np.take_along_axis(r2, own, axis=0)[0] * _STENCIL_WEIGHTS, -1) / _STEP
        surface = np.where(slope > 0, surface, len(self.edges))
        nodes, weights = np.polynomial.legendre.leggauss(order)
        nodes, weights = (nodes + 1) / 2, weights / 2
        if self.dim == 1:  # on the axis r^2 is the variable, as without clipping
            fraction, along = np.sqrt(nodes), weights
        else:
            fraction, along = nodes, weights * nodes
        spokes = angle.shape[1]
        spoke, fraction = np.repeat(np.arange(spokes), order), np.tile(fraction, spokes)
        weight = (width[..., None] * along).reshape(self.colours, -1)
        # A few sizes for all orders and scenes, so that they share compiled programs.
        more = _size(spokes, 8 if self.dim == 1 else 128) - spokes
        fill = _size(weight.shape[1], 48 if self.dim == 1 else 2048) - weight.shape[1]

        def pad(a, n, mode="constant"):
            return np.pad(a, [(0, 0)] * (a.ndim - 1) + [(0, n)], mode=mode)

        return ClippedPupil(
            self.centre,
            pad(unit, more, "edge"),
            pad(radius, more, "edge"),
            pad(surface, more, "edge"),
            pad(slope, more, "edge"),
            pad(spoke, fill),
            pad(fraction, fill),
            pad(weight, fill),
            order,
        )


def _size(count: int, smallest: int) -> int:
    while smallest < count:
        smallest *= 4
    return smallest


def find_boundary(
    lens: Lens, field: Array, distance: Array, wavelengths: Array, symmetry: str
) -> Boundary | None:
    """The boundary of the part of the pupil that clear apertures leave, None if nothing is left.

    `field` (D,), `distance` (), `wavelengths` (W,) as in `trace_bundle`, all known. The part must
    be seen whole from its centre, as the overlap of the images of circular apertures is.
    """
    boundary = Boundary((lens, field, distance, wavelengths), symmetry)
    return boundary if boundary.locate() else None
