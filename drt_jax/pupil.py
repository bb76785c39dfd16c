"""Where rays cross the stop: quadrature points on the unit disc and their weights.

All rules integrate over the area of the disc with weights that sum to 1. The order n of a
Gauss rule is its number of nodes in t = r^2, the variable in which a rotationally symmetric
aberration is smooth. Source: Forbes, JOSA A 5, 1943 (1988).
"""

import numpy as np

__all__ = ["disc", "half_disc", "meridian", "random_disc"]


def _gauss(order: int) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = np.polynomial.legendre.leggauss(order)
    return np.sqrt((nodes + 1) / 2), weights / 2


def meridian(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (1, n) and weights (n,) on one radius: enough for an axial object."""
    radius, weights = _gauss(order)
    return radius[None], weights


def half_disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (2, n m) in the half x > 0 and weights: enough for a field along y.

    n Gauss nodes in r^2 times m uniform azimuths, the mirror half of a rule of 2 m.
    """
    radius, weights = _gauss(order)
    angle = np.pi * ((np.arange(azimuths) + 0.5) / azimuths - 0.5)
    points = np.stack([np.outer(radius, np.cos(angle)), np.outer(radius, np.sin(angle))])
    return points.reshape(2, -1), np.repeat(weights / azimuths, azimuths)


def disc(order: int, azimuths: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (2, 2 n m) and weights of the same rule on the whole disc."""
    points, weights = half_disc(order, azimuths)
    mirrored = points * np.array([[-1.0], [1.0]])
    return np.concatenate([points, mirrored], axis=1), np.tile(weights / 2, 2)


def random_disc(rays: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Uniform random points (2, rays), as the paper's 256 rays, and equal weights."""
    generator = np.random.default_rng(seed)
    radius = np.sqrt(generator.random(rays))
    angle = 2 * np.pi * generator.random(rays)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)])
    return points, np.full(rays, 1 / rays)
