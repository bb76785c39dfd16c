"""Points on the unit disc of the stop and their weights, as arrays.

Every rule integrates over the area of the disc with weights that sum to 1. The order n of a Gauss
rule is its number of nodes in r^2, the variable in which a rotationally symmetric aberration is
smooth. The moments use Gauss rules; other programs use the patterns of equal weights. ValueError
for an order or a number that is not a whole number of at least 1.

Source: Forbes, JOSA A 5, 1943 (1988).
"""

import numpy as np


def _count(what: str, value: int) -> None:
    if not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{what}: expected at least 1, a whole number, got {value!r}")


def _gauss(order: int) -> tuple[np.ndarray, np.ndarray]:
    _count("order", order)
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return np.sqrt((nodes + 1) / 2), weights / 2


def meridian(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 1) and weights (n,) on one radius, for an axial object."""
    radius, weights = _gauss(order)
    return radius[:, None], weights


def half_disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n m, 2) in the half x > 0 and weights (n m,), for a field along y.

    n Gauss nodes in r^2 times m uniform azimuths, half of a rule of 2 m azimuths.
    """
    radius, weights = _gauss(order)
    _count("azimuths", azimuths)
    angle = np.pi * ((np.arange(azimuths) + 0.5) / azimuths - 0.5)
    points = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))], axis=-1)
    return points.reshape(-1, 2), np.repeat(weights / azimuths, azimuths)


def disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (2 n m, 2) and weights (2 n m,) of the rule of `half_disc` on the whole disc."""
    points, weights = half_disc(order, azimuths)
    mirrored = points * np.array([-1.0, 1.0])
    return np.concatenate([points, mirrored]), np.tile(weights / 2, 2)


def random_disc(rays: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Uniform random points (rays, 2), as the 256 rays of the paper, and equal weights (rays,)."""
    _count("rays", rays)
    generator = np.random.default_rng(seed)
    return _of_square(generator.random(rays), generator.random(rays))


def _of_square(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maps points of the unit square to the disc: r = sqrt(u), azimuth 2 pi v; equal weights."""
    radius, angle = np.sqrt(u), 2 * np.pi * v
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return points, np.full(len(u), 1 / len(u))


def square_grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (Q, 2) of a square grid and equal weights (Q,): those centres of `side` x `side` cells
    of the square about the disc that lie in the disc."""
    _count("side", side)
    line = (np.arange(side) + 0.5) / side * 2 - 1
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    points = points[np.sum(points**2, axis=-1) <= 1]
    return points, np.full(len(points), 1 / len(points))


def hexapolar(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (Q, 2), Q = 1 + 3 n (n + 1): the centre and n rings of 6, 12, 18, ... points; equal
    weights (Q,).

    Each ray stands for the same area of the disc: a ring lies at the radius that halves the area of
    its annulus. (Lens design programs often put the outermost ring on the rim, which gives the rim
    twice its weight.)
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
    """The first points (count, 2) of the Sobol sequence of `scipy.stats.qmc` in the unit square,
    not scrambled. Best for powers of two."""
    from scipy.stats import qmc  # takes a second to import

    _count("count", count)
    sequence = qmc.Sobol(2, scramble=False)
    return sequence.random_base2(int(count - 1).bit_length())[:count]


def sobol_disc(rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (rays, 2) of the Sobol sequence in r^2 and azimuth, and equal weights (rays,)."""
    return _of_square(*sobol(rays).T)
