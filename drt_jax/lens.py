"""The lens: a frozen pytree of arrays over surfaces, read from a YAML prescription."""

import dataclasses
import difflib
import math
import pathlib

import jax
import jax.numpy as jnp
import yaml
from jax import Array

from .glass import Dispersion, Glass, check_wavelengths, find_glass, refractive_index

__all__ = ["Lens", "LensError", "lens_names", "load_lens"]

_BUNDLED = pathlib.Path(__file__).parent / "lenses"


class LensError(ValueError):
    """A prescription that cannot be used; the message names the file, the key and the remedy."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lens:
    """A rotationally symmetric lens of S surfaces and a flat sensor.

    All arrays are differentiable leaves of one floating dtype; `jax.grad` with respect to a
    lens returns a `Lens`. Lengths in mm, z along the axis from the first vertex.

    curvature (S,) 1/mm; conic (S,), 0 a sphere, -1 a paraboloid; coefficients (S, K), of
    r^2, r^4, ... in mm^-1, mm^-3, ...; thickness (S - 1,) between vertices; semi_diameter
    (S,), the clear aperture (inf: none), at the stop the aperture itself; sensor (), its z;
    dispersion of the S + 1 media, the first before the first surface. Static: stop, the
    index of the stop surface; glasses, the names of the S + 1 media; name.
    """

    curvature: Array
    conic: Array
    coefficients: Array
    thickness: Array
    semi_diameter: Array
    sensor: Array
    dispersion: Dispersion
    stop: int = dataclasses.field(metadata={"static": True})
    glasses: tuple[str, ...] = dataclasses.field(metadata={"static": True})
    name: str = dataclasses.field(metadata={"static": True}, default="")

    @property
    def vertices(self) -> Array:
        """z of the S vertices, shape (S,), mm; the first is 0."""
        return jnp.concatenate([jnp.zeros_like(self.curvature[:1]), jnp.cumsum(self.thickness)])

    def index(self, wavelengths: Array) -> Array:
        """Refractive index (S + 1, W) of every medium at `wavelengths` (W,), um.

        ValueError, naming the range, for a known wavelength outside that of a glass.
        """
        check_wavelengths(self.glasses, wavelengths)
        return refractive_index(self.dispersion, wavelengths)


def lens_names() -> list[str]:
    """Names of the bundled prescriptions."""
    return sorted(path.stem for path in _BUNDLED.glob("*.yaml"))


def load_lens(name_or_path: str | pathlib.Path) -> Lens:
    """Read a lens: a bundled name (see `lens_names`) or the path of a YAML prescription.

    The arrays have JAX's default floating dtype: float64 where the caller enabled it.
    LensError for a missing file, an unknown key or glass, or numbers that make no lens.
    """
    path = pathlib.Path(name_or_path)
    if path.suffix not in (".yaml", ".yml"):
        path = _BUNDLED / f"{name_or_path}.yaml"
        if not path.is_file():
            raise LensError(
                f"no bundled lens {str(name_or_path)!r}; bundled: {', '.join(lens_names())}; "
                "for a file of your own give a path that ends in .yaml"
            )
    try:
        entry = yaml.safe_load(path.read_text())
    except OSError as error:
        raise LensError(f"{path}: cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise LensError(f"{path}: not a YAML file: {error}") from error
    return _build(entry, path)


def _known(entry: object, keys: tuple[str, ...], where: str) -> dict:
    if not isinstance(entry, dict):
        raise LensError(f"{where}: expected a mapping with the keys {', '.join(keys)}")
    for key in entry:
        if key not in keys:
            near = difflib.get_close_matches(str(key), keys, n=1)
            hint = f"did you mean {near[0]!r}? " if near else ""
            raise LensError(f"{where}: unknown key {key!r}; {hint}known: {', '.join(keys)}")
    return entry


def _number(entry: dict, key: str, where: str, default: float | None = None) -> float:
    value = entry.get(key, default)
    if isinstance(value, str):  # YAML 1.1 reads 1e-3 and inf as text
        try:
            value = float(value)
        except ValueError:
            pass
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        raise LensError(f"{where}.{key}: expected a number, got {value!r}")
    return float(value)


def _finite(entry: dict, key: str, where: str, default: float | None = None) -> float:
    value = _number(entry, key, where, default)
    if math.isinf(value):
        raise LensError(f"{where}.{key}: must be finite")
    return value


def _curvature(entry: dict, where: str) -> float:
    if ("radius" in entry) == ("curvature" in entry):
        raise LensError(f"{where}: give either radius (inf for a plane) or curvature")
    if "curvature" in entry:
        return _finite(entry, "curvature", where)
    radius = _number(entry, "radius", where)
    if radius == 0:
        raise LensError(f"{where}.radius: 0 is no surface; a plane is radius: inf")
    return 1 / radius


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


def _coefficients(entry: dict, where: str) -> list[float]:
    powers = entry.get("coefficients", {})
    if not isinstance(powers, dict):
        raise LensError(f"{where}.coefficients: expected powers of r, such as {{4: 1.0e-6}}")
    for power in powers:
        if not isinstance(power, int) or power < 2 or power % 2:
            raise LensError(f"{where}.coefficients: {power!r} is not an even power 2, 4, 6, ...")
    values = [0.0] * (max(powers, default=0) // 2)
    for power in powers:
        values[power // 2 - 1] = _finite(powers, power, f"{where}.coefficients")
    return values


def _semi_diameter(entry: dict, where: str, curvature: float, conic: float) -> float:
    value = _number(entry, "semi_diameter", where, math.inf)
    if value <= 0:
        raise LensError(f"{where}.semi_diameter: must be positive")
    if math.isfinite(value) and (1 + conic) * (curvature * value) ** 2 >= 1:
        raise LensError(
            f"{where}.semi_diameter: {value:g} mm reaches beyond the surface, which ends at "
            f"{1 / (abs(curvature) * math.sqrt(1 + conic)):g} mm"
        )
    return value


_SURFACE_KEYS = (
    "radius", "curvature", "conic", "coefficients",
    "thickness", "glass", "index", "semi_diameter", "stop",
)  # fmt: skip


def _build(entry: object, path: pathlib.Path) -> Lens:
    entry = _known(entry, ("name", "source", "surfaces", "sensor"), str(path))
    surfaces = entry.get("surfaces")
    if not isinstance(surfaces, list) or not surfaces:
        raise LensError(f"{path}: surfaces: expected a list of at least one surface")
    curvature, conic, powers, thickness, semi_diameter, media, stops = [], [], [], [], [], [], []
    for i, surface in enumerate(surfaces):
        where = f"{path}: surfaces[{i}]"
        surface = _known(surface, _SURFACE_KEYS, where)
        curvature.append(_curvature(surface, where))
        conic.append(_finite(surface, "conic", where, 0.0))
        powers.append(_coefficients(surface, where))
        semi_diameter.append(_semi_diameter(surface, where, curvature[-1], conic[-1]))
        media.append(_medium(surface, where))
        if not isinstance(surface.get("stop", False), bool):
            raise LensError(f"{where}.stop: expected true or false")
        if surface.get("stop", False):
            stops.append(i)
        if i < len(surfaces) - 1:
            thickness.append(_finite(surface, "thickness", where))
            if thickness[-1] <= 0:
                raise LensError(
                    f"{where}.thickness: must be positive; where the stop touches a surface, "
                    "mark that surface itself with stop: true"
                )
    if len(stops) != 1:
        raise LensError(f"{path}: surfaces: {len(stops)} have stop: true, exactly one must")
    stop = stops[0]
    if math.isinf(semi_diameter[stop]):
        raise LensError(f"{path}: surfaces[{stop}].semi_diameter: the stop needs one")
    sensor = _sensor(entry, surfaces[-1], sum(thickness), path)
    order = max(map(len, powers))
    return Lens(
        curvature=jnp.asarray(curvature, float),
        conic=jnp.asarray(conic, float),
        coefficients=jnp.asarray(
            [p + [0.0] * (order - len(p)) for p in powers], float
        ).reshape(len(powers), order),
        thickness=jnp.asarray(thickness, float),
        semi_diameter=jnp.asarray(semi_diameter, float),
        sensor=jnp.asarray(sensor, float),
        dispersion=Dispersion.of([find_glass("air"), *media]),
        stop=stop,
        glasses=("air", *(medium.name for medium in media)),
        name=str(entry.get("name", path.stem)),
    )


def _sensor(entry: dict, last: dict, length: float, path: pathlib.Path) -> float:
    if ("sensor" in entry) == ("thickness" in last):
        raise LensError(
            f"{path}: give either sensor (mm from the first vertex) or the last surface's "
            "thickness (its distance to the sensor)"
        )
    if "sensor" in entry:
        sensor = _finite(entry, "sensor", str(path))
    else:
        sensor = length + _finite(last, "thickness", f"{path}: surfaces[-1]")
    if sensor <= length:
        raise LensError(
            f"{path}: sensor: {sensor:g} mm lies before the last vertex at {length:g} mm"
        )
    return sensor
