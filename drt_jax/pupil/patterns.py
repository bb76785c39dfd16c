"""Points on the unit disc of the stop and their weights, as arrays.

All rules integrate over the area of the disc with weights that sum to 1. The order n of a
Gauss rule is its number of nodes in t = r^2, the variable in which a rotationally symmetric
aberration is smooth. Source: Forbes, JOSA A 5, 1943 (1988). The moments use the Gauss rules;
the patterns of equal weights are what other programs use, for comparison. ValueError for an
order or a number that is not whole or below 1.
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
    """Points (n, 1) and weights (n,) on one radius: enough for an axial object."""
    radius, weights = _gauss(order)
    return radius[:, None], weights


def half_disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (n m, 2) in the half x > 0 and weights: enough for a field along y.

    n Gauss nodes in r^2 times m uniform azimuths, the mirror half of a rule of 2 m.
    """
    radius, weights = _gauss(order)
    _count("azimuths", azimuths)
    angle = np.pi * ((np.arange(azimuths) + 0.5) / azimuths - 0.5)
    points = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))], axis=-1)
    return points.reshape(-1, 2), np.repeat(weights / azimuths, azimuths)


def disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (2 n m, 2) and weights of the same rule on the whole disc."""
    points, weights = half_disc(order, azimuths)
    mirrored = points * np.array([-1.0, 1.0])
    return np.concatenate([points, mirrored]), np.tile(weights / 2, 2)


def random_disc(rays: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Uniform random points (rays, 2), as the paper's 256 rays, and equal weights."""
    _count("rays", rays)
    generator = np.random.default_rng(seed)
    return _of_square(generator.random(rays), generator.random(rays))


def _of_square(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points of the unit square on the disc: r = sqrt(u), azimuth 2 pi v; equal weights."""
    radius, angle = np.sqrt(u), 2 * np.pi * v
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    return points, np.full(len(u), 1 / len(u))


def square_grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (Q, 2) of a square grid inside the disc and equal weights.

    The centres of `side` x `side` cells of the square round the disc; those in the disc stay.
    """
    _count("side", side)
    line = (np.arange(side) + 0.5) / side * 2 - 1
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    points = points[np.sum(points**2, axis=-1) <= 1]
    return points, np.full(len(points), 1 / len(points))


def hexapolar(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (Q, 2), Q = 1 + 3 n (n + 1): the centre and n rings of 6, 12, 18, ...; equal weights.

    Each ray stands for the same area of the disc: a ring of 6 k lies at the radius that halves
    the area of its annulus. (Lens design programs often put the outermost ring on the rim and
    so count the rim twice.)
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
    """The first points (count, 2) of the Sobol sequence in the unit square, not scrambled: those of
    `scipy.stats.qmc`. Best at powers of two."""
    from scipy.stats import qmc  # takes a second to import

    _count("count", count)
    sequence = qmc.Sobol(2, scramble=False)
    return sequence.random_base2(int(count - 1).bit_length())[:count]


def sobol_disc(rays: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (rays, 2) of the Sobol sequence and equal weights: r^2 and azimuth are its axes."""
    return _of_square(*sobol(rays).T)
