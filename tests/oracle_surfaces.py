"""The surfaces of `oracle`: sags, slopes, and intersections with rays; plain NumPy, analytic."""

import numpy as np

# As in the package: a conic ends where the square of the cosine of its normal falls below this.
RIM = 1e-4


def _powers(x, count):
    """1, x, x^2, ... by multiplication, which is exact for an imaginary part of 1e-30."""
    powers = [np.ones_like(x)]
    for _ in range(count):
        powers.append(powers[-1] * x)
    return powers


def _series(powers, first, step, a):
    """sum_j a_j x^(first + j step), and its derivative by x."""
    total, slope = 0 * powers[0], 0 * powers[0]
    for j, coefficient in enumerate(a):
        p = first + j * step
        total = total + coefficient * powers[p]
        slope = slope + p * coefficient * powers[p - 1]
    return total, slope


def surface(form, x, y, c, k, a):
    """Sag and its slopes along x and y; `a` is a list of coefficients."""
    if form == "biconic":
        (cx, kx), rest = a[:2], a[2:]
        root = np.sqrt(1 - (1 + kx) * cx**2 * x**2 - (1 + k) * c**2 * y**2)
        top = cx * x**2 + c * y**2
        z = top / (1 + root)
        zx = 2 * cx * x / (1 + root) + top * (1 + kx) * cx**2 * x / (root * (1 + root) ** 2)
        zy = 2 * c * y / (1 + root) + top * (1 + k) * c**2 * y / (root * (1 + root) ** 2)
        r2 = x**2 + y**2
        more, slope = _series(_powers(r2, len(rest) + 1), 1, 1, rest)
        return z + more, zx + 2 * x * slope, zy + 2 * y * slope
    if form == "toroid":
        cx, rest = a[0], a[1:]
        root = np.sqrt(1 - (1 + k) * c**2 * y**2)
        more, slope = _series(_powers(y, 2 * len(rest) + 1), 2, 2, rest)
        g, bent = c * y**2 / (1 + root) + more, c * y / root + slope
        # The circle (z - 1/cx)^2 + x^2 = (1/cx - g)^2, without its cancellation.
        z = (2 * g - cx * g**2 + cx * x**2) / (1 + np.sqrt((1 - cx * g) ** 2 - (cx * x) ** 2))
        return z, cx * x / (1 - cx * z), bent * (1 - cx * g) / (1 - cx * z)
    r2 = x**2 + y**2
    root = np.sqrt(1 - (1 + k) * c**2 * r2)
    z, zx, zy = c * r2 / (1 + root), c * x / root, c * y / root
    if form == "asphere":
        more, slope = _series(_powers(r2, len(a) + 1), 1, 1, a)
        return z + more, zx + 2 * x * slope, zy + 2 * y * slope
    if form == "odd_asphere":
        r = np.sqrt(r2)
        more, slope = _series(_powers(r, len(a) + 1), 1, 1, a)
        return z + more, zx + slope * x / r, zy + slope * y / r
    if form != "polynomial_xy":
        raise ValueError(form)
    xs, ys = _powers(x, len(a) + 1), _powers(y, len(a) + 1)
    degree, j = 1, 0
    for coefficient in a:  # x, y, x^2, x y, y^2, x^3, ...
        i = degree - j
        z = z + coefficient * xs[i] * ys[j]
        if i:
            zx = zx + i * coefficient * xs[i - 1] * ys[j]
        if j:
            zy = zy + j * coefficient * xs[i] * ys[j - 1]
        degree, j = (degree, j + 1) if i else (degree + 1, 0)
    return z, zx, zy


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def _to_conic(p, d, c, k):
    """Real distance along p + s d to the conic of c and k, where the ray crosses it from the side
    on which its vertex plane lies in front; to the vertex plane if the ray misses the conic."""
    p, d, c, k = ([np.real(a) for a in p], [np.real(a) for a in d], np.real(c), np.real(k))
    plane = -p[2] / d[2]
    p = [p[0] + plane * d[0], p[1] + plane * d[1]]
    # c (x^2 + y^2 + (1 + k) z^2) = 2 z: square s^2 - 2 linear s + constant = 0
    square = c * (1 + k * d[2] ** 2)
    linear, constant = d[2] - c * dot(p, d[:2]), c * dot(p, p)
    discriminant = linear**2 - square * constant
    root = np.sign(d[2]) * np.sqrt(np.maximum(discriminant, 0))
    alike = linear * root < 0
    above = np.where(alike, linear - root, constant)
    below = np.where(alike, square, linear + root)
    meets = (discriminant > 0) & (below != 0)
    return plane + np.where(meets, above / np.where(meets, below, 1), 0)


def _rim(form, x, y, c, k, a):
    """The quantity that must be above `RIM` on the surface."""
    if form == "biconic":
        return 1 - (1 + a[1]) * a[0] ** 2 * x**2 - (1 + k) * c**2 * y**2
    if form == "toroid":
        z = surface(form, 0 * y, y, c, k, a)[0]
        return np.minimum(1 - (1 + k) * c**2 * y**2, (1 - a[0] * z) ** 2 - (a[0] * x) ** 2)
    return 1 - (1 + k) * c**2 * (x**2 + y**2)


def cross(form, p, d, shape):
    """Intersection of p + s d with a surface: the point, the slopes there, s, and whether there is
    one."""
    conic = form in ("asphere", "odd_asphere", "polynomial_xy")
    s = (_to_conic(p, d, *shape[:2]) if conic else -p[2] / d[2]) + 0j
    for _ in range(14):
        q = [a + b * s for a, b in zip(p, d)]
        z, zx, zy = surface(form, q[0], q[1], *shape)
        s = s + (z - q[2]) / (d[2] - zx * d[0] - zy * d[1])
    q = [a + b * s for a, b in zip(p, d)]
    z, zx, zy = surface(form, q[0], q[1], *shape)
    z_miss, (c, k, a) = np.real(z - q[2]), shape
    real = [np.real(v) for v in (q[0], q[1], c, k)]
    met = _rim(form, *real, [np.real(v) for v in a]) > RIM
    # A ray that misses ends anywhere, or circles, or meets the formula off the real numbers.
    small = 1e-10 * (1 + np.abs(np.real(s)))
    met &= (np.abs(z_miss) < small) & (np.abs(np.imag(s)) < small)
    met &= np.real(d[2] - zx * d[0] - zy * d[1]) * np.real(d[2]) > 0
    return [q[0], q[1], z], (zx, zy), s, met
