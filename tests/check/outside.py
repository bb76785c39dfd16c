"""The reference values of `drt-jax check` that no other program prints, computed without the
package: closed forms, the trace of `tests.oracle`, and SciPy."""

import numpy as np
from scipy.integrate import dblquad
from scipy.signal import convolve2d
from scipy.special import erf, j1

from drt_jax.check import scenes
from drt_jax.pupil.rules import gauss_points

from .. import oracle

STEP = 1e-30
PIXEL = 0.0044


def gradient():
    """The gradient by a complex step through the oracle's sequential trace, with 16 x 16 Gauss
    nodes."""
    lens = scenes.zemax_double_gauss()
    scene = oracle.Scene.of(lens, np.radians(14), np.inf, [0.5876])
    points, weights = map(np.asarray, gauss_points(16, "bilateral"))
    rule, one = (points.T, weights / np.sum(weights)), np.array([[0.0], [0.5]])
    found = oracle.outputs(scene, rule, "bilateral", one)["covariance"]
    size = np.sqrt(np.trace(np.real(found)[0]))
    moved = oracle.jacobian(scene, rule, "bilateral", one, ("curvature", "thickness"))
    by = {k: 1e3 * np.trace(v[0]) / (2 * size) for k, v in moved["covariance"].items()}
    curved = np.flatnonzero(np.asarray(lens.curvature))
    return np.concatenate([1e-4 * by["curvature"][curved], 0.01 * by["thickness"]])


def kernel():
    """Airy's pattern integrated over the area of each pixel, for light that is even in direction
    cosines."""
    wave, aperture = 2 * np.pi / 0.5e-3, 1 / np.hypot(1, 100 - 1 / 400)

    def light(y, x):
        v = wave * aperture * np.hypot(x, y) + 1e-12
        return (wave * aperture) ** 2 / (4 * np.pi) * (2 * j1(v) / v) ** 2

    half = 0.0025
    sides = [(0.005 * k - half, 0.005 * k + half) for k in range(11)]
    return np.array([100 * dblquad(light, *side, -half, half, epsrel=1e-11)[0] for side in sides])


def clipped():
    """The overlap of two discs of the radius 1 with centres 0.7 apart. The beam is parallel, so
    that the spot on the sensor has the shape of the stop."""
    half = 0.35
    angle = np.arccos(half)
    area = 2 * (angle - half * np.sin(angle))
    nodes, weights = np.polynomial.legendre.leggauss(60)
    t = np.pi / 4 * (nodes + 1)  # y = (1 - half) sin t: smooth at the tips
    y, slope = (1 - half) * np.sin(t), (1 - half) * np.cos(t) * np.pi / 4 * weights
    chord = np.sqrt(1 - (half + y) ** 2)
    yy, xx = (4 * np.sum(slope * a) / area for a in (chord * y**2, chord**3 / 3))
    return np.array([area / np.pi, np.sqrt(xx), np.sqrt(yy)])


def gaussian(offset, variance, size=9):
    """The integrals of a Gaussian over the pixels of a row, normalised to the sum 1; also for a
    complex step."""
    edges = (np.arange(size + 1) - size / 2) * PIXEL
    t = (edges - offset) / np.sqrt(2 * variance)
    below = erf(t.real) + 2 / np.sqrt(np.pi) * np.exp(-(t.real**2)) * 1j * t.imag
    return np.diff(below) / np.sum(np.diff(below))


def blurred(plane, row, column):
    """The inner part of a picture, convolved along x and y."""
    return convolve2d(plane, np.outer(column, row), "valid")


def sensor():
    """SciPy's convolution with Gaussian integrals, three times, for three ways of the package."""
    offset = ([0.0, 0.0], [0.002, 0.0], [0.0, -0.003])
    spread = ([3e-5, 2e-5], [2e-5, 5e-5], [1e-5, 1e-5])
    picture = scenes.chart(14, 20)[1]
    rows = [[gaussian(o, s) for o, s in zip(*each)] for each in zip(offset, spread)]
    images = [blurred(picture[..., c], *rows[c]).real for c in range(3)]
    found = 255 * np.stack(images, -1)[0, ::4].ravel()
    return np.concatenate([found] * 3)


def convolved(images, layer):
    """A layer of 3 x 3 weights on pictures (B, H, W, in), with zeros beyond the edges."""
    height, width = images.shape[1:3]
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1), (0, 0)))
    shifted = (padded[:, i : i + height, j : j + width] for i in range(3) for j in range(3))
    taps = layer["kernel"].reshape(9, *layer["kernel"].shape[2:])
    return sum(a @ tap for a, tap in zip(shifted, taps)) + layer["bias"]


def loss(place, layers):
    """Mean absolute error of the restored pictures, in grey levels of 255. A ray of the height h
    meets the sensor at step h / (f - h^2 / (4 f)); h^2 is uniformly distributed from 0 to 4
    mm^2."""
    picture, focal, step = np.round(255 * scenes.chart(24, 24)) / 255, 50.0, place + 50
    nodes, weights = np.polynomial.legendre.leggauss(20)
    square = 2 * (nodes + 1)
    variance = step**2 * np.sum(weights / 2 * square / (focal - square / (4 * focal)) ** 2) / 2
    line = gaussian(0.0, variance)
    image = np.stack(
        [[blurred(plane, line, line) for plane in np.moveaxis(one, -1, 0)] for one in picture]
    )
    image = np.moveaxis(image, 1, -1)
    inner = convolved(image, layers[0])
    inner = np.where(inner.real > 0, inner, 0)
    error = image + convolved(inner, layers[1]) - picture[:, 4:-4, 4:-4]
    return 255 * np.mean(np.where(error.real > 0, error, -error))


def training():
    """Three steps of Adam (Kingma and Ba 2015) with gradients by a complex step for each weight.
    The network's weights are rounded to float32, as in the package."""
    names = [(i, k) for i in range(2) for k in ("kernel", "bias")]
    layers = scenes.network()
    values = [layers[i][k].astype(np.float32).astype(complex) for i, k in names]
    flat = np.concatenate([[-50.1 + 0j], *(v.ravel() for v in values)])
    cuts = np.cumsum([1, *(v.size for v in values)])

    def of(flat):
        parts = [p.reshape(v.shape) for p, v in zip(np.split(flat, cuts[:-1])[1:], values)]
        found = [dict(zip(("kernel", "bias"), parts[2 * i : 2 * i + 2])) for i in range(2)]
        return loss(flat[0], found)

    rates = np.where(np.arange(flat.size) == 0, 0.02, 1e-3)
    first = second = np.zeros(flat.size)
    losses = []
    for step in range(1, 4):
        losses.append(of(flat).real)
        slope = [np.imag(of(flat + 1j * STEP * row)) / STEP for row in np.eye(flat.size)]
        slope = np.array(slope) / 255
        first, second = 0.9 * first + 0.1 * slope, 0.999 * second + 0.001 * slope**2
        unit = first / (1 - 0.9**step) / (np.sqrt(second / (1 - 0.999**step)) + 1e-8)
        flat = flat - rates * unit
    return np.array(losses)
