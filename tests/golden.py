"""Results of all analyses as numbers, stored in golden.json, to check that code which only moved
gives the same results.

`python -m tests.golden` computes them again and names each that differs, with the difference
relative to the largest number of the result; `--write` stores the new ones. A scene takes some
minutes, nearly all of it compilation; `--scenes` selects some (by default those that are stored).
"""

import argparse
import dataclasses
import json
import pathlib
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import drt_jax as drt
from drt_jax import design
from drt_jax.image.beam import beam_rule

FILE = pathlib.Path(__file__).with_suffix(".json")
COLOURS = np.array([0.6563, 0.5876, 0.4861])
POINTS = np.array([[0.0, 0.0], [0.0, 0.7], [0.0, -0.7], [0.5, 0.1], [0.2, 0.95]])
# Fields in degrees, distance and pixel in mm, whether the pupil is clipped.
SCENES = {
    "double_gauss": ((0.0, 8.0, 14.0), np.inf, 0.01, False),
    "camera_50mm": ((0.0, 10.0, 18.0), 2000.0, 0.01, True),
    "hubble": ((0.0, 0.02, 0.04), np.inf, 0.015, True),
    "phone": ((0.0, 15.0, 30.0), 500.0, 0.002, False),
    "double_gauss_addon": ((0.0, 8.0, 14.0), 3000.0, 0.01, False),
    "fisheye_8mm": ((0.0, 40.0, 60.0), np.inf, 0.01, False),
}
# Analyses for which gradients by these arrays of the lens are stored, too.
SLOPES = ("rays", "moments", "distortion", "spot_diagram", "transfer", "psf_waves", "psf_rays")
MOVED = ("curvature", "thickness")


def analyses(name: str) -> dict[str, Callable[[drt.Lens], Any]]:
    """Functions of a lens by name, for a scene."""
    degrees, distance, pixel, clipped = SCENES[name]
    fields = np.radians(degrees)
    seen = distance, COLOURS
    point, skew = (drt.Scene.point(f, *seen) for f in (fields[1], np.array([0.3, 1]) * fields[1]))
    line, pair = (drt.Scene.radians(f, *seen) for f in (fields, fields[:2]))
    rule = drt.Clipped(5, "bilateral") if clipped else drt.Gauss(6, "bilateral")
    lines, radii = np.array([10.0, 40.0]), np.array([0.01, 0.03])
    waves, rays = (drt.Sampling.of(kind, rule, 48, 8) for kind in ("waves", "rays"))

    of_design = lambda lens: operands(lens, fields, distance, rule)  # noqa: E731

    def kernel(kind: Any) -> Callable[[drt.Lens], Any]:
        model = drt.Sampling(kind, beam_rule(8, "bilateral", rule), 48)
        return lambda lens: drt.psf(lens, point, pixel, 15, sampling=model)

    return {
        "first_order": lambda lens: drt.first_order(lens, *seen),
        "third_order": lambda lens: drt.third_order(lens, point),
        "rays": lambda lens: drt.trace_rays(lens, skew, POINTS)[:4],
        "moments": lambda lens: drt.psf_moments(lens, point, sampling=rule),
        "focus_moments": lambda lens: drt.focus_moments(lens, point, sampling=rule),
        "image_point": lambda lens: drt.image_point(lens, point),
        "chief_ray_angle": lambda lens: drt.chief_ray_angle(lens, line),
        "field_curvature": lambda lens: drt.field_curvature(lens, line),
        "lateral_colour": lambda lens: drt.lateral_colour(lens, line),
        "distortion": lambda lens: drt.distortion(lens, line),
        "fans": lambda lens: drt.ray_fans(lens, line, count=9),
        "axial_colour": lambda lens: drt.axial_colour(lens, point),
        "spot_diagram": lambda lens: drt.spot_diagram(lens, line, sampling=rule),
        "illumination": lambda lens: drt.relative_illumination(lens, line, sampling=rule),
        "wavefront": lambda lens: drt.wavefront(lens, point, POINTS)[:1],
        "zernike_standard": lambda lens: drt.zernike_standard(lens, pair, 15),
        "zernike_fringe": lambda lens: drt.zernike_fringe(lens, pair, 16),
        "transfer": lambda lens: drt.transfer(lens, pair, lines, sampling=waves),
        "transfer_rays": lambda lens: drt.transfer(lens, pair, lines, sampling=rays),
        "strehl": lambda lens: drt.strehl(lens, pair, waves),
        "energy": lambda lens: drt.encircled_energy(lens, pair, radii, sampling=waves),
        "psf_waves": kernel("waves"),
        "psf_rays": kernel("rays"),
        "psf_gaussian": kernel("gaussian"),
        **({} if name == "hubble" else {"operands": of_design}),  # without glass, obscured
    }


def operands(lens: drt.Lens, fields: np.ndarray, distance: float, rule: drt.pupil.PupilRule) -> Any:
    """Values of all kinds of operands that every lens has, in one program."""
    special = {"mtf": {"at": 20.0}, "encircled_energy": {"at": 0.02}, "strehl": {}}
    asked = [
        design.Operand(kind, 1.0, **special[kind]) if kind in special else design.Operand(kind)
        for kind in design.OPERANDS
        if kind not in ("glass_map", "magnification")
    ]
    variables = design.Variables.from_lens(lens, ["sensor"])
    problem = design.Problem.from_variables(
        variables, asked, drt.Scene.radians(fields, distance, COLOURS), rule
    )

    @jax.jit
    def values(lens: drt.Lens) -> dict[str, Any]:
        rays = design.trace_fields(problem, lens)
        return {operand.name: operand.values(lens, rays) for operand in problem.operands}

    return values(lens)


def weights(count: int) -> np.ndarray:
    """Weights (count,) between 1/2 and 3/2, all different."""
    return 1 + np.sin(1 + np.arange(count, dtype=float)) / 2


def number(array: Any) -> float:
    """A weighted sum of the numbers of an array, in which 1000 replaces numbers that are not
    finite, so that these are noticed."""
    flat = np.ravel(np.asarray(array))
    flat = np.concatenate([flat.real, flat.imag]) if np.iscomplexobj(flat) else flat.astype(float)
    return float(weights(flat.size) @ np.where(np.isfinite(flat), flat, 1e3))


def scale(array: Any) -> float:
    """The largest finite number of an array, at least 1e-12."""
    sizes = np.abs(np.asarray(array)).astype(float)
    return float(max(np.max(np.where(np.isfinite(sizes), sizes, 0), initial=0), 1e-12))


def slope(function: Callable[[drt.Lens], Any], lens: drt.Lens) -> dict[str, Any]:
    """The gradient of a weighted sum of the finite numbers of an analysis, by `MOVED`."""

    def total(moved: dict[str, Any]) -> Any:
        found = jnp.zeros(())
        for leaf in jax.tree.leaves(function(dataclasses.replace(lens, **moved))):
            if jnp.issubdtype(leaf.dtype, jnp.inexact):
                flat = jnp.ravel(leaf.real + leaf.imag if jnp.iscomplexobj(leaf) else leaf)
                finite = jnp.isfinite(flat)
                found += jnp.sum(jnp.where(finite, weights(flat.size) * flat, 0))
        return found

    return jax.grad(total)({name: getattr(lens, name) for name in MOVED})


def answers(scene: str, wanted: Callable[[str], bool]) -> Iterator[tuple[str, float, float]]:
    """Names, numbers and scales of the results of the selected analyses for a scene."""
    lens = drt.load_lens(scene)
    for name, function in analyses(scene).items():
        if not wanted(name):
            continue
        found = {name: function(lens)}
        if name in SLOPES:
            found[f"d {name}"] = slope(function, lens)
        for path, leaf in jax.tree_util.tree_flatten_with_path(found)[0]:
            yield jax.tree_util.keystr(path), number(leaf), scale(leaf)


def differences(scene: str, wanted: Callable[[str], bool] = lambda name: True) -> dict[str, float]:
    """For each result that differs from the stored number in the last digit: the difference
    relative to its scale; inf for a new result."""
    kept, found = json.loads(FILE.read_text())[scene], {}
    for name, value, size in answers(scene, wanted):
        before = float.fromhex(kept[name]) if name in kept else np.inf
        if value != before:
            found[name] = abs(value - before) / size
    return found


def main() -> None:
    """Compares the results, or writes them."""
    parser = argparse.ArgumentParser(prog="tests.golden", description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=SCENES)
    parser.add_argument("--write", action="store_true")
    given = parser.parse_args()
    scenes = given.scenes or [*(SCENES if given.write else json.loads(FILE.read_text()))]
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    for scene in scenes:
        if given.write:
            found = {n: value.hex() for n, value, _ in answers(scene, lambda name: True)}
            kept = json.loads(FILE.read_text()) if FILE.exists() else {}
            kept[scene] = found
            FILE.write_text(json.dumps(kept, indent=0) + "\n")
            print(f"{scene}: {len(kept[scene])} answers written", flush=True)
        else:
            found = differences(scene)
            print(f"{scene}: {len(found)} differ", flush=True)
            for name, apart in sorted(found.items(), key=lambda item: -item[1]):
                print(f"  {name}: {apart:.1e}")


if __name__ == "__main__":
    main()
