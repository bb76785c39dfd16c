"""What float32, JAX's default, costs: every analysis of every bundled lens against float64.

The same rays in both precisions, on the axis and at the full field, an object at infinity. The Airy
radius is 0.61 wavelength / numerical aperture on the axis. Writes results.json: a row of each lens
holds `lens`, `field_deg`, `told`, what float32 says of its path differences (empty: nothing), and
the error of each analysis, the largest of both fields.

spot: RMS radius, um. focus: where along the axis the spot is smallest, in depths of focus,
wavelength / numerical aperture^2. path: RMS path difference of all rays, waves. strehl; mtf: at a
fifth of the cut-off; energy: encircled, within two Airy radii. rays, waves: sum of the absolute
errors of a kernel of 15 x 15 pixels, each as wide as the Airy radius. distortion; angle: of the
chief ray, radians; light: relative illumination.
"""

import dataclasses
import functools
import pathlib
import sys
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import drt_jax
from drt_jax import Lens, design, show
from drt_jax.compilation import ONCE, jit

from . import _command, _common
from .lenses import LensFields
from .runs.folder import Run

COLUMNS = ("spot", "focus", "path", "strehl", "mtf", "energy", "rays", "waves")
COLUMNS += ("distortion", "angle", "light")
_KINDS = {"spot": "rms_spot", "path": "path_difference", "strehl": "strehl", "mtf": "mtf"}
_KINDS |= {"energy": "encircled_energy", "angle": "chief_ray_angle"}
_KINDS |= {"distortion": "distortion", "light": "relative_illumination"}
_UM = 1e3  # per mm


@dataclasses.dataclass(frozen=True)
class Config:
    """Settings of the experiment; see configs/float32.yaml.

    order: of the Gauss rule of the pupil.
    """

    lenses: tuple[LensFields, ...]
    order: int = 8
    wavelength_um: float = 0.55
    seed: int = 0

    def __post_init__(self) -> None:
        _common.require(len(self.lenses) > 0, "lenses: needs at least one item")
        _common.require_within("", self, order=(2, 16), wavelength_um=(1e-4, 1e6))


@functools.partial(jit, wanted=ONCE)
def values(problem: design.Problem, lens: Lens) -> dict[str, Array]:
    """Every analysis, from rays of one trace."""
    rays = design.trace_fields(problem, lens)
    aperture = design.OPERANDS["numerical_aperture"].function(lens, rays)[0, 0]
    wavelength = rays.wavelengths[0] / _UM
    airy = 0.61 * wavelength / aperture
    at = {"mtf": (0.4 * aperture / wavelength,), "energy": (2 * airy,)}
    found = {
        name: design.OPERANDS[kind].function(lens, rays, *at.get(name, ()))
        for name, kind in _KINDS.items()
    }
    light = jnp.where(rays.arrives, rays.weights, 0)[None]
    slope = jnp.where(rays.arrives, jnp.stack(rays.bundle.arrival[:-1]), 0)
    slope = slope / jnp.where(rays.arrives, rays.bundle.arrival[-1], 1)
    hits, slope = (a - jnp.sum(light * a, -1, keepdims=True) for a in (rays.sensor_hits, slope))
    focus = -jnp.sum(light * hits * slope, (0, -1)) / jnp.sum(light * slope**2, (0, -1))
    kernels = {kind: design.psf(lens, rays, airy, 15, kind) for kind in ("rays", "waves")}
    return found | {"focus": focus * aperture**2 / wavelength} | kernels


def measure(config: Config, scene: LensFields) -> dict[str, Any]:
    """The row of a lens."""
    double = drt_jax.load_lens(scene.lens)
    fields, um = np.radians([0.0, scene.field_deg]), (config.wavelength_um,)
    found = []
    for dtype in (jnp.float64, jnp.float32):
        lens = jax.tree.map(lambda a, dtype=dtype: a.astype(dtype), double)
        variables = design.Variables.from_lens(lens, ["sensor"])
        given = variables, ["path_difference"], fields, um, np.inf, config.order
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            problem = design.Problem.from_variables(*given)
        found.append(jax.tree.map(lambda a: np.asarray(a, float), values(problem, lens)))
    double_, single_ = found
    errors = {name: np.abs(single_[name] - double_[name]) for name in COLUMNS}
    row = {name: float(np.max(error)) for name, error in errors.items()}
    row["spot"] *= _UM
    for name in ("rays", "waves"):
        row[name] = float(np.max(np.sum(errors[name], axis=(-2, -1))))
    row["path"] = float(np.max(np.sqrt(np.sum(errors["path"] ** 2, axis=-1))))
    told = str(said[0].message).split(",")[0] if said else ""
    return {"lens": scene.lens, "field_deg": scene.field_deg, "told": told} | row


def run(config: Config, run: Run) -> dict[str, Any]:
    """Measures all lenses."""

    def one(scene: LensFields) -> dict[str, Any]:
        row = measure(config, scene)
        run.log(scene.lens, 0, {c: np.array([row[c]]) for c in COLUMNS})
        jax.clear_caches()
        return row

    jobs = {s.lens: lambda s=s: one(s) for s in config.lenses}
    return {"rows": _common.measured(run, "lens", jobs), "seconds": run.seconds}


def tables(results: dict[str, Any]) -> dict[str, str]:
    """Errors by lens and analysis."""
    header = "lens", "field, degrees", *COLUMNS, "told"
    rows = [
        (r["lens"], r["field_deg"], *(f"{r[c]:.0e}" for c in COLUMNS), "yes" if r["told"] else "")
        for r in results["rows"]
    ]
    return {"float32": _common.table(header, rows)}


def draw(results: dict[str, Any], figures: pathlib.Path) -> None:
    """Draws the errors of path differences and of what follows from them."""
    figure, axes = show.new(1, 1, 8, 4)
    names = [row["lens"] for row in results["rows"]]
    for column in ("path", "strehl", "mtf", "waves", "rays"):
        axes.semilogy(names, [row[column] for row in results["rows"]], "o", label=column)
    axes.tick_params(axis="x", rotation=60)
    axes.legend()
    figure.savefig(figures / "float32.png")


if __name__ == "__main__":
    _command.main(sys.modules[__name__])
