"""Print what float32, JAX's default, costs: every analysis of every bundled lens against float64.

    python tools/float32.py [LENS ...]

A minute a lens on one core. The same rays in both precisions, of a rule fitted to the light, at
0.55 um, on the axis and at the full field, an object at infinity; the larger error of the two. The
Airy radius is 0.61 wavelength / numerical aperture on the axis.

spot: RMS radius, um. focus: where along the axis the spot is smallest, in depths of focus,
wavelength / numerical aperture^2. path: path differences, waves RMS. strehl; mtf: at a fifth of the
cut-off; energy: encircled, within two Airy radii. rays, waves: sums of the absolute errors of
kernels of 15 x 15 pixels, each as wide as the Airy radius. distortion; angle: of the chief ray,
radians; light: relative illumination.

Bold: above its bound (`BOUNDS`), which for path differences and foci is that above which calls
warn. told: of what float32 warns, path differences or foci.
"""

import functools
import pathlib
import sys
import warnings

import jax
import jax.numpy as jnp
import numpy as np

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent.parent))
jax.config.update("jax_enable_x64", True)

import drt_jax  # noqa: E402
from drt_jax import design  # noqa: E402
from drt_jax.compilation import ONCE, jit  # noqa: E402
from drt_jax.image.rounding import warn_of_focus  # noqa: E402

FIELDS = {
    "camera_50mm": 23.5, "cooke_triplet": 20, "dagor_240mm": 26.6, "double_gauss": 14,
    "double_gauss_addon": 14, "fisheye_8mm": 85, "heliar_100mm": 26.6, "hubble": 0.1,
    "hypergon_100mm": 67, "microscope_objective": 2, "petzval_100mm": 8, "phone": 32.2,
    "phone_tele": 20, "ritchey_chretien": 0.2, "singlet": 7, "telephoto_300mm": 4,
}  # fmt: skip
KINDS = {"spot": "rms_spot", "path": "path_difference", "strehl": "strehl", "mtf": "mtf"}
KINDS |= {"energy": "encircled_energy", "distortion": "distortion"}
KINDS |= {"angle": "chief_ray_angle", "light": "relative_illumination"}
COLUMNS = ("spot", "focus", "path", "strehl", "mtf", "energy", "rays", "waves")
COLUMNS += ("distortion", "angle", "light")
BOUNDS = {"focus": 0.02, "path": 1e-3}
BOUNDS |= dict.fromkeys(("strehl", "mtf", "energy", "rays", "waves", "distortion", "light"), 4e-3)
WAVELENGTH = 0.55e-3  # mm


@functools.partial(jit, wanted=ONCE)
def values(problem, lens):
    """Every analysis, from rays of one trace."""
    rays = design.trace_fields(problem, lens)
    aperture = design.OPERANDS["numerical_aperture"].function(lens, rays)[0, 0]
    airy = 0.61 * WAVELENGTH / aperture
    at = {"mtf": (0.4 * aperture / WAVELENGTH,), "energy": (2 * airy,)}
    found = {
        name: design.OPERANDS[kind].function(lens, rays, *at.get(name, ()))
        for name, kind in KINDS.items()
    }
    light = jnp.where(rays.arrives, rays.weights, 0)[None]
    both = map(jnp.stack, (rays.bundle.sensor, rays.bundle.slopes))
    hits, slope = (a - jnp.sum(light * a, -1, keepdims=True) for a in both)
    focus = -jnp.sum(light * hits * slope, (0, -1)) / jnp.sum(light * slope**2, (0, -1))
    kernels = {kind: design.psf(lens, rays, airy, 15, kind).kernel for kind in ("rays", "waves")}
    return found | {"focus": focus * aperture**2 / WAVELENGTH} | kernels


def cell(column, error):
    """A number of the table, bold above its bound."""
    text = f"{error:.0e}"
    return f"**{text}**" if float(text) > BOUNDS.get(column, np.inf) else text


def row(name):
    """The cells of a lens."""
    double, found = drt_jax.load_lens(name), []
    scene = drt_jax.Scene.degrees([0.0, FIELDS[name]], np.inf, 1e3 * WAVELENGTH)
    blocked = double.apertures is not None and any(double.apertures.blocks)
    # What an obscuration takes counts: problems have no other rule for it.
    rule = 8 if blocked else drt_jax.converge(drt_jax.spot_diagram, double, scene, 8)
    for dtype in (jnp.float64, jnp.float32):
        lens = jax.tree.map(lambda a, dtype=dtype: a.astype(dtype), double)
        variables = design.Variables.from_lens(lens, ["sensor"])
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            warn_of_focus(lens, scene)
            problem = design.Problem.from_variables(
                variables, [design.Operand("strehl", target=1.0)], scene, rule
            )
        found.append(jax.tree.map(lambda a: np.asarray(a, float), values(problem, lens)))
    errors = {column: np.abs(found[1][column] - found[0][column]) for column in COLUMNS}
    errors["spot"] *= 1e3
    errors["path"] = np.sqrt(np.sum(errors["path"] ** 2, axis=-1))
    for kind in ("rays", "waves"):
        errors[kind] = np.sum(errors[kind], axis=(-2, -1))
    cells = [cell(column, np.max(errors[column])) for column in COLUMNS]
    told = [what for what in ("path", "focus") if what in " ".join(map(str, said))]
    return [name, str(FIELDS[name]), *cells, ", ".join(told)]


def main(names):
    """Print the table."""
    header = ["lens", "field, degrees", *COLUMNS, "told"]
    print("| " + " | ".join(header) + " |\n" + "|--" * len(header) + "|")
    for name in names or FIELDS:
        print("| " + " | ".join(row(name)) + " |", flush=True)
        jax.clear_caches()


if __name__ == "__main__":
    main(sys.argv[1:])
