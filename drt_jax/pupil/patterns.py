"""Points on the unit disc of the stop with their weights, as NumPy arrays.

Every rule integrates over the area of the disc, with weights that sum to 1. The order n of a Gauss
rule is its number of nodes in r^2, because a rotationally symmetric aberration is a smooth function
of r^2. The moments use the Gauss rules. The patterns of equal weights are those that other programs
use. All functions raise ValueError if an order or a number of rays is not a whole number of at
least 1.

Source: Forbes, JOSA A 5, 1943 (1988).
"""

import numpy as np


def _count(what: str, value: int) -> None:
    """ValueError unless `value` is a whole number of at least 1; `what` names it in the message."""
    if not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{what}: expected at least 1, a whole number, got {value!r}")


def _gauss(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes in r^2 on [0, 1]: radii (n,) and weights (n,) with the sum 1."""
    _count("order", order)
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return np.sqrt((nodes + 1) / 2), weights / 2


def meridian(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes on one radius, for an object on the axis of a rotationally symmetric lens.

    order: n, number of nodes.

    Returns points (n, 1) and weights (n,).
    """
    radius, weights = _gauss(order)
    return radius[:, None], weights


def half_disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes on the half disc x > 0, for a field along y, where x -> -x is a symmetry.

    order: n, number of Gauss nodes in r^2.
    azimuths: m, number of uniform azimuths on the half disc: half of those of a rule of 2 m
        azimuths.

    Returns points (n m, 2) and weights (n m,).
    """
    radius, weights = _gauss(order)
    _count("azimuths", azimuths)
    angle = np.pi * ((np.arange(azimuths) + 0.5) / azimuths - 0.5)
    points = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))], axis=-1)
    return points.reshape(-1, 2), np.repeat(weights / azimuths, azimuths)


def disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Gauss nodes on the whole disc: the points of `half_disc` and their mirror images x -> -x.

    order, azimuths: as in `half_disc`.

    Returns points (2 n m, 2) and weights (2 n m,).
    """
    points, weights = half_disc(order, azimuths)
    mirrored = points * np.array([-1.0, 1.0])
    return np.concatenate([points, mirrored]), np.tile(weights / 2, 2)


def random_disc(rays: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Uniform random points on the disc, like the 256 rays of the paper.

    rays: number of points.
    seed: seed of NumPy's generator.

    Returns points (rays, 2) and equal weights (rays,).
    """
    _count("rays", rays)
    return _of_square(*np.random.default_rng(seed).random((2, rays)))


def _of_square(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps points of the unit square to the disc, r = sqrt(u), azimuth 2 pi v, with equal
    weights."""
    radius, angle = np.sqrt(u), 2 * np.pi * v
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return points, np.full(len(u), 1 / len(u))


def square_grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of a square grid with equal weights.

    side: number of cells along each side of the square that circumscribes the disc. The points are
        the centres of those of the `side` x `side` cells whose centre lies in the disc.

    Returns points (Q, 2) and weights (Q,).
    """
    _count("side", side)
    line = (np.arange(side) + 0.5) / side * 2 - 1
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    points = points[np.sum(points**2, axis=-1) <= 1]
    return points, np.full(len(points), 1 / len(points))


def hexapolar(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Hexapolar pattern: the centre and n rings of 6, 12, 18, ... points, with equal weights.

    rings: n, number of rings.

    Returns points (Q, 2), Q = 1 + 3 n (n + 1), and weights (Q,). Each ray represents the same area
    of the disc: the radius of a ring divides its annulus into two equal areas. (Lens design
    programs often put the outermost ring on the rim, which gives the rim twice its weight.)
    """
    _count("rings", rings)
    k = np.arange(1, rings + 1)
    total = 1 + 3 * rings * (rings + 1)
    radius = np.sqrt((1 + 3 * k * k) / total)  # the mean of r^2 at its edges, 1 + 3 k (k +- 1)
    points = [np.zeros((1, 2))]
    for ring, r in zip(k, radius):
        angle = 2 * np.pi * (np.arange(6 * ring) + 0.5) / (6 * ring)
        points.append(r * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    return np.concatenate(points), np.full(total, 1 / total)


def sobol(count: int) -> np.ndarray:
    """First points of the two-dimensional Sobol sequence in the unit square, not scrambled.

    count: number of points; best a power of two.

    Returns an array (count, 2), from `scipy.stats.qmc`.
    """
    from scipy.stats import qmc  # takes a second to import

    _count("count", count)
    sequence = qmc.Sobol(2, scramble=False)
    return sequence.random_base2(int(count - 1).bit_length())[:count]


def sobol_disc(rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of the Sobol sequence in (r^2, azimuth), with equal weights.

    rays: number of points.

    Returns points (rays, 2) and weights (rays,).
    """
    return _of_square(*sobol(rays).T)
