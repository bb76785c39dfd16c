"""The oracle's derivatives compared with differences of 50 digits."""

import mpmath
import numpy as np
import pytest

from .. import oracle
from ..lens import test_surface
from .test_derivatives import POINTS, SCENES, WAVELENGTHS, parameters


def exact_place(scene, i, z0):
    """Origin of row `i`, the rotation from its axes to those of the lens, and its sag."""
    turn = mpmath.eye(3)
    for axis, angle in enumerate(scene["tilt"][i]):
        one = mpmath.eye(3)
        p, q = (axis + 1) % 3, (axis + 2) % 3
        one[p, p] = one[q, q] = mpmath.cos(angle)
        one[q, p], one[p, q] = mpmath.sin(angle), -mpmath.sin(angle)
        turn = turn * one
    formula = getattr(test_surface, f"exact_{scene['forms'][i]}")
    shape = scene["curvature"][i], scene["conic"][i], scene["coefficients"][i]
    return mpmath.matrix([*scene["decentre"][i], z0]), turn, lambda x, y: formula(x, y, *shape)


def exact_trace(scene, x, y):
    """One ray of the first wavelength in mpmath: stop point, path, sensor point. `scene` has nested
    lists of mpf; it shares only the sags, with the tests of `surface`."""
    mpf, small = mpmath.mpf, mpmath.mpf(10) ** -17
    tangent = [mpmath.tan(a) for a in scene["field"]]
    source = mpmath.matrix([-t * scene["distance"] for t in tangent] + [-scene["distance"]])
    point = mpmath.matrix([x, y, 0])
    d = (point - source) / mpmath.norm(point - source)
    point = source
    n = exact_indices(scene)
    path, z0, count = -mpmath.norm(source) * n[0], mpf(0), len(scene["mirrors"])
    for i in range(count + 1):
        if i:
            z0 = scene["sensor"] if i == count else z0 + scene["thickness"][i - 1]
        origin, turn, sag = exact_place(scene, i, z0)
        p, t = turn.T * (point - origin), turn.T * d

        def above(s):
            return p[2] + s * t[2] - sag(p[0] + s * t[0], p[1] + s * t[1])

        s = -p[2] / t[2]
        for _ in range(7):
            s -= above(s) * 2 * small / (above(s + small) - above(s - small))
        hit = p + s * t
        if i == scene["stop"]:
            at_stop = hit[0], hit[1]
        if i < count and scene["joined"][i]:
            continue
        path += n[i] * s
        point = turn * hit + origin
        if i == count:
            return at_stop, path, [point[j] for j in range(3)]
        h, x, y = small, hit[0], hit[1]
        slopes = [
            (sag(x - h, y) - sag(x + h, y)) / (2 * h),
            (sag(x, y - h) - sag(x, y + h)) / (2 * h),
        ]
        normal = turn * mpmath.matrix([*slopes, 1])
        normal = normal / mpmath.norm(normal)
        cosine = (normal.T * d)[0]
        along = (d - cosine * normal) * (n[i] / n[i + 1])
        side = mpmath.sign(cosine) * (-1 if scene["mirrors"][i] else 1)
        d = along + side * mpmath.sqrt(1 - mpmath.norm(along) ** 2) * normal


def exact_indices(scene):
    """Indices at the first wavelength; behind a surface that is off the path, the index in front of
    it."""
    square = mpmath.mpf(WAVELENGTHS[0]) ** 2
    n = []
    for i, (bs, cs, s) in enumerate(zip(scene["strength"], scene["resonance"], scene["schott"])):
        if i and scene["joined"][i - 1]:
            n.append(n[-1])
            continue
        n2 = sum(b * square / (square - c) for b, c in zip(bs, cs))
        n2 += sum(a * square ** (p // 2) for a, p in zip(s, (0, 2, -2, -4, -6, -8)))
        n.append(mpmath.sqrt(n2))
    return n


@pytest.mark.slow
@pytest.mark.parametrize("name, rays", [("freeform", 2), ("folded", 1)])
def test_oracle_against_50_digits(name, rays):
    """Along a random direction in each array: paths and sensor points to 1e-12."""
    arguments, rows = parameters(name, SCENES[name][2][0])
    _, field, (distance,), _ = SCENES[name]
    scene = oracle.Scene.of(arguments["lens"], field, distance, WAVELENGTHS[:1])
    points, generator = POINTS[:rays].T, np.random.default_rng(4)
    start = oracle._aimed(scene, points)
    for row in rows:
        value = scene.values[row]
        # The step of a high power that is 0 would be too large for accurate differences.
        still = 0 if row == "coefficients" else 1e-3
        step = generator.uniform(0.5, 1, value.shape) * np.where(value == 0, still, np.abs(value))
        step = np.where(np.isinf(value), 0, step)
        imaginary = np.where(np.isinf(value), value, value + 1j * oracle.STEP * step)
        moved = scene.replace(**{row: imaginary})
        traced = oracle.trace(moved, *oracle.aim(moved, points, start))
        ours = [traced.path, *traced.hits[-1]]
        ours = [np.imag(np.broadcast_to(a, traced.path.shape)) / oracle.STEP for a in ours]
        for ray in range(rays):
            with mpmath.workdps(50):
                wanted = exact_difference(scene, row, step, points[:, ray], start, ray)
            scale = np.max(np.abs(wanted[1:]))
            for got, exact, size in zip(ours, wanted, [abs(wanted[0])] + [scale] * 3):
                assert abs(got[0, ray] - exact) <= 1e-12 * size, (row, ray)


def exact_difference(scene, row, step, point, start, ray):
    """d(path, sensor point) along `step` in the array `row`, by a central difference."""
    h = mpmath.mpf(10) ** -10
    ends = []
    for side in (1, -1):
        values = {k: _exact(v) for k, v in scene.values.items() if k != row}
        values[row] = _exact(scene.values[row], side * h, step)
        values |= {k: getattr(scene, k) for k in ("forms", "mirrors", "joined", "stop")}
        x, y = (mpmath.mpf(float(a[0, ray])) for a in start[:2])
        inverse = mpmath.matrix(start[2][:, :, 0, ray].tolist())
        radius = values["semi_diameter"][scene.stop]
        for _ in range(5):
            at_stop, path, end = exact_trace(values, x, y)
            miss = [a - radius * mpmath.mpf(float(b)) for a, b in zip(at_stop, point)]
            x, y = mpmath.matrix([x, y]) - inverse * mpmath.matrix(miss)
        ends.append([path, *end])
    return [float((a - b) / (2 * h)) for a, b in zip(*ends)]


def _exact(value, h=0, step=None):
    """Nested lists of mpf, of value + h step."""
    if np.ndim(value):
        steps = np.zeros_like(value) if step is None else step
        return [_exact(v, h, s) for v, s in zip(value, steps)]
    return mpmath.mpf(float(value)) + h * mpmath.mpf(0.0 if step is None else float(step))
