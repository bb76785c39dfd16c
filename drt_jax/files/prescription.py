"""Prescriptions: a lens read from YAML or a mapping, and checked before anything is traced."""

import difflib
import functools
import math
import pathlib
from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
import yaml
from jax import Array

from ..lens.glass import Dispersion, Glass, find_glass
from ..lens.lens import Lens
from ..lens.surface import FORMS, Shape, by_form, powers_xy, sag

__all__ = ["LensError", "lens_names", "load_lens"]

_BUNDLED = pathlib.Path(__file__).resolve().parents[1] / "lens" / "catalogue" / "lenses"
_TOP_KEYS = ("name", "source", "object", "surfaces", "sensor", "sensor_tilt", "sensor_decentre")
_MEDIUM_KEYS = ("glass", "index")
_SURFACE_KEYS = (
    "form",
    "radius",
    "curvature",
    "conic",
    "radius_x",
    "curvature_x",
    "conic_x",
    "coefficients",
    "thickness",
    *_MEDIUM_KEYS,
    "mirror",
    "semi_diameter",
    "stop",
    "tilt",
    "decentre",
)
# Neighbours that overlap by less at their rims touch (mm).
_TOUCH = 1e-4
# The direction of a ray between vertices closer than this (mm) drowns in rounding.
_CLOSEST = 1e-6


class LensError(ValueError):
    """A prescription that cannot be used; the message names the file, the key and the remedy."""


def lens_names() -> list[str]:
    """Names of the bundled prescriptions."""
    return sorted(path.stem for path in _BUNDLED.glob("*.yaml"))


def load_lens(source: str | pathlib.Path | Mapping) -> Lens:
    """Read a lens: a bundled name (see `lens_names`), the path of a YAML prescription, or a
    mapping with the keys of one.

    The arrays have JAX's default floating dtype: float64 where the caller enabled it.
    LensError for a missing file, an unknown key or glass, or numbers that make no lens.
    """
    with jax.core.eval_context():  # a lens loaded inside a jitted function is a constant
        return _load(source)


def _load(source: str | pathlib.Path | Mapping) -> Lens:
    if isinstance(source, Mapping):
        return _build(dict(source), "lens")
    path = pathlib.Path(source)
    if path.suffix not in (".yaml", ".yml"):
        path = _BUNDLED / f"{source}.yaml"
        if not path.is_file():
            raise LensError(
                f"no bundled lens {str(source)!r}; bundled: {', '.join(lens_names())}; "
                "for a file of your own give a path that ends in .yaml"
            )
    try:
        entry = yaml.safe_load(path.read_text())
    except OSError as error:
        raise LensError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise LensError(f"{path}: not a YAML file: {error}") from error
    return _build(entry, str(path), path.stem)


def _known(entry: object, keys: tuple[str, ...], where: str) -> dict:
    if not isinstance(entry, dict):
        raise LensError(f"{where}: expected a mapping with the keys {', '.join(keys)}")
    for key in entry:
        if key not in keys:
            near = difflib.get_close_matches(str(key), keys, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise LensError(f"{where}: unknown key {key!r}; {hint}known: {', '.join(keys)}")
    return entry


def _number(entry: dict, key: str | int, where: str, default: float | None = None) -> float:
    value = entry.get(key, default)
    if isinstance(value, str):  # YAML 1.1 reads 1e-3 and inf as text
        try:
            value = float(value)
        except ValueError:
            pass
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise LensError(f"{where}.{key}: expected a number, got {value!r}")
    return float(value)


def _finite(entry: dict, key: str | int, where: str, default: float | None = None) -> float:
    value = _number(entry, key, where, default)
    if math.isinf(value):
        raise LensError(f"{where}.{key}: must be finite")
    return value


def _vector(entry: dict, key: str, where: str, length: int) -> list[float]:
    values = entry.get(key, [0.0] * length)
    if not isinstance(values, list) or len(values) != length:
        raise LensError(f"{where}.{key}: expected a list of {length} numbers, got {values!r}")
    return [_finite(dict(enumerate(values)), i, f"{where}.{key}") for i in range(length)]


def _flag(entry: dict, key: str, where: str) -> bool:
    if not isinstance(entry.get(key, False), bool):
        raise LensError(f"{where}.{key}: expected true or false")
    return entry.get(key, False)


def _curvature(entry: dict, where: str, suffix: str = "") -> float:
    radius, curvature = f"radius{suffix}", f"curvature{suffix}"
    if (radius in entry) == (curvature in entry):
        raise LensError(f"{where}: give either {radius} (inf for a plane) or {curvature}")
    if curvature in entry:
        return _finite(entry, curvature, where)
    value = _number(entry, radius, where)
    if value == 0:
        raise LensError(f"{where}.{radius}: 0 is no surface; a plane is {radius}: inf")
    return 1 / value


def _medium(entry: dict, where: str) -> Glass:
    if "glass" in entry and "index" in entry:
        raise LensError(f"{where}: give either glass or index, not both")
    if "index" in entry:
        value = _finite(entry, "index", where)
        if value < 1:
            raise LensError(f"{where}.index: {value:g} is below 1")
        return Glass(f"index {value!r}", schott=(value**2, 0.0, 0.0, 0.0, 0.0, 0.0))
    try:
        return find_glass(str(entry.get("glass", "air")))
    except ValueError as error:
        raise LensError(f"{where}.glass: {error}") from error


def _even(power: object) -> int | None:
    return power // 2 - 1 if isinstance(power, int) and power > 1 and power % 2 == 0 else None


def _any(power: object) -> int | None:
    return power - 1 if isinstance(power, int) and power > 0 else None


def _pair(power: object) -> int | None:
    pairs = {f"x{i}y{j}": k for k, (i, j) in enumerate(powers_xy(230))}
    return pairs.get(str(power))


# The column of a power among those of `coefficients`, the columns before them, the powers.
_COLUMNS = {
    "asphere": (_even, 0, "an even power of r: 2, 4, 6, ..."),
    "odd_asphere": (_any, 0, "a power of r: 1, 2, 3, ..."),
    "biconic": (_even, 2, "an even power of r: 2, 4, 6, ..."),
    "toroid": (_even, 1, "an even power of y: 2, 4, 6, ..."),
    "polynomial_xy": (_pair, 0, "a power of x and y: x1y0, x0y1, x2y0, x1y1, ..."),
}


def _coefficients(entry: dict, where: str, form: str) -> list[float]:
    column, before, wanted = _COLUMNS[form]
    values: list[float] = []
    for key in ("radius_x", "curvature_x", "conic_x"):
        if key in entry and not (before == 2 or (before == 1 and key != "conic_x")):
            raise LensError(f"{where}.{key}: a surface of the form {form} has none")
    if before:
        values.append(_curvature(entry, where, "_x"))
    if before == 2:
        values.append(_finite(entry, "conic_x", where, 0.0))
    powers = entry.get("coefficients", {})
    if not isinstance(powers, dict):
        raise LensError(f"{where}.coefficients: expected powers, such as {{4: 1.0e-6}}")
    for power in powers:
        if column(power) is None:
            raise LensError(f"{where}.coefficients: {power!r} is not {wanted}")
        place = before + column(power)
        values += [0.0] * (place + 1 - len(values))
        values[place] = _finite(powers, power, f"{where}.coefficients")
    return values


def _semi_diameter(entry: dict, where: str, curvature: float, conic: float, form: str) -> float:
    value = _number(entry, "semi_diameter", where, math.inf)
    if value <= 0:
        raise LensError(f"{where}.semi_diameter: must be positive")
    round_ = form in ("asphere", "odd_asphere", "polynomial_xy")
    if round_ and math.isfinite(value) and (1 + conic) * (curvature * value) ** 2 >= 1:
        raise LensError(
            f"{where}.semi_diameter: {value:g} mm reaches beyond the surface, which ends at "
            f"{1 / (abs(curvature) * math.sqrt(1 + conic)):g} mm; lower it, or the curvature"
        )
    return value


def _build(entry: object, where: str, name: str = "lens") -> Lens:
    top = where
    entry = _known(entry, _TOP_KEYS, top)
    surfaces = entry.get("surfaces")
    if not isinstance(surfaces, list) or not surfaces:
        raise LensError(f"{top}: surfaces: expected a list of at least one surface")
    curvature, conic, powers, thickness, semi_diameter = [], [], [], [], []
    space = f"{top}: object"
    media = [_medium(_known(entry.get("object", {}), _MEDIUM_KEYS, space), space)]
    stops, forms, mirrors, decentre, tilt, sense = [], [], [], [], [], 1
    moved = any(isinstance(s, dict) and ("tilt" in s or "decentre" in s) for s in surfaces) or bool(
        {"sensor_tilt", "sensor_decentre"} & set(entry)
    )
    for i, surface in enumerate(surfaces):
        where = f"{top}: surfaces[{i}]"
        surface = _known(surface, _SURFACE_KEYS, where)
        forms.append(surface.get("form", "asphere"))
        if forms[-1] not in FORMS:
            raise LensError(f"{where}.form: unknown form {forms[-1]!r}; known: {', '.join(FORMS)}")
        curvature.append(_curvature(surface, where))
        conic.append(_finite(surface, "conic", where, 0.0))
        powers.append(_coefficients(surface, where, forms[-1]))
        semi_diameter.append(_semi_diameter(surface, where, curvature[-1], conic[-1], forms[-1]))
        mirrors.append(_flag(surface, "mirror", where))
        if mirrors[-1]:
            for key in _MEDIUM_KEYS:
                if key in surface:
                    raise LensError(f"{where}.{key}: behind a mirror is the medium before it")
            media.append(media[-1])
            sense = -sense
        else:
            media.append(_medium(surface, where))
        if _flag(surface, "stop", where):
            stops.append(i)
        decentre.append(_vector(surface, "decentre", where, 2))
        tilt.append(_vector(surface, "tilt", where, 3))
        if i < len(surfaces) - 1:
            thickness.append(_finite(surface, "thickness", where))
            if thickness[-1] * sense < _CLOSEST and not moved:
                raise LensError(
                    f"{where}.thickness: must be {'positive' if sense > 0 else 'negative'}"
                    f"{'' if sense > 0 else ', as a mirror has turned the light'}, at least "
                    f"{_CLOSEST} mm; leave out one of two surfaces that touch, and where the stop "
                    "touches a surface, mark that surface itself with stop: true"
                )
    if len(stops) != 1:
        raise LensError(f"{top}: surfaces: {len(stops)} have stop: true, exactly one must")
    stop = stops[0]
    if math.isinf(semi_diameter[stop]):
        raise LensError(f"{top}: surfaces[{stop}].semi_diameter: the stop needs one")
    sensor = _sensor(entry, surfaces[-1], sum(thickness), 0 if moved else sense, top)
    decentre.append(_vector(entry, "sensor_decentre", top, 2))
    tilt.append(_vector(entry, "sensor_tilt", top, 3))
    order = max(map(len, powers))
    lens = Lens(
        curvature=jnp.asarray(curvature, float),
        conic=jnp.asarray(conic, float),
        coefficients=jnp.asarray([p + [0.0] * (order - len(p)) for p in powers], float).reshape(
            len(powers), order
        ),
        thickness=jnp.asarray(thickness, float),
        semi_diameter=jnp.asarray(semi_diameter, float),
        sensor=jnp.asarray(sensor, float),
        dispersion=Dispersion.of(media),
        decentre=jnp.asarray(decentre, float) if moved else None,
        tilt=jnp.radians(jnp.asarray(tilt, float)) if moved else None,
        stop=stop,
        glasses=tuple(medium.name for medium in media),
        forms=tuple(forms),
        mirrors=tuple(mirrors),
        name=str(entry.get("name", name)),
    )
    if not moved:
        _check_crossing(lens, top)
    return lens


def _sensor(entry: dict, last: dict, length: float, sense: int, top: str) -> float:
    if ("sensor" in entry) == ("thickness" in last):
        raise LensError(
            f"{top}: give either sensor (mm from the first vertex) or the last surface's "
            "thickness (its distance to the sensor)"
        )
    if "sensor" in entry:
        sensor = _finite(entry, "sensor", top)
    else:
        sensor = length + _finite(last, "thickness", f"{top}: surfaces[-1]")
    if sense and (sensor - length) * sense <= 0:
        raise LensError(
            f"{top}: sensor: {sensor:g} mm lies before the last vertex at {length:g} mm"
            + (", for light that a mirror has turned" if sense < 0 else "")
        )
    return sensor


@functools.partial(jax.jit, static_argnums=2)
def _sags(radius: Array, shape: Shape, forms: tuple[str, ...]) -> Array:
    w = jnp.stack([jnp.zeros_like(radius), radius])
    shape = Shape(shape.curvature[:, None], shape.conic[:, None], shape.coefficients[..., None])
    return by_form(sag, w, shape, forms)


def _check_crossing(lens: Lens, top: str) -> None:
    """LensError where neighbours overlap inside both their clear apertures."""
    semi = np.asarray(lens.semi_diameter)
    common = np.minimum(semi[:-1], semi[1:])
    reach = np.where(np.isfinite(common), common, 0.0)
    radius = (reach[:, None] * np.linspace(0, 1, 17)).astype(lens.curvature.dtype)
    if not radius.size:
        return
    shape = Shape(*(np.asarray(a) for a in (lens.curvature, lens.conic, lens.coefficients)))
    shape = shape._replace(coefficients=shape.coefficients.T)
    front = _sags(radius, jax.tree.map(lambda a: a[..., :-1], shape), lens.forms[:-1])
    back = _sags(radius, jax.tree.map(lambda a: a[..., 1:], shape), lens.forms[1:])
    gap = np.asarray(lens.thickness)[:, None] + np.asarray(back) - np.asarray(front)
    gap = gap * lens.senses[1:-1, None]
    for i, j in zip(*np.nonzero(gap < -_TOUCH)):
        raise LensError(
            f"{top}: surfaces[{i}].thickness: {float(lens.thickness[i]):g} mm makes surfaces {i} "
            f"and {i + 1} cross at {radius[i, j]:.3g} mm from the axis, within their semi-diameters "
            f"of {semi[i]:g} and {semi[i + 1]:g} mm; raise the thickness or lower a semi-diameter"
        )
