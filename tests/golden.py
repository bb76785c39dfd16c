"""Answers of all analyses for lenses of every kind, each as one number: to tell that code which
moved computes what it computed before.

`python -m tests.golden` compares them with golden.json, names each that differs and by how much;
`python -m tests.golden --write NAME...` writes those of the scenes named anew.
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
from drt_jax.image.converged import focus_moments
from drt_jax.lens.lens import Lens

FILE = pathlib.Path(__file__).with_suffix(".json")
RGB = np.array([0.6563, 0.5876, 0.4861])
POINTS = np.array([[0.0, 0.0], [0.0, 0.7], [0.0, -0.7], [0.5, 0.1], [0.2, 0.95]])


def number(array: Any) -> float:
    """A sum with weights between 1/2 and 3/2, all different, of what is finite; the weights of
    what is not are added, so that a number that becomes finite shows."""
    flat = np.ravel(np.asarray(array))
    flat = np.concatenate([flat.real, flat.imag]) if np.iscomplexobj(flat) else flat.astype(float)
    weights = 1 + np.sin(1 + np.arange(flat.size, dtype=float)) / 2
    return float(np.sum(np.where(np.isfinite(flat), weights * flat, 1e3 * weights)))


def size(array: Any) -> float:
    """The largest finite number of an array, and at least 1e-12: the scale of its differences."""
    flat = np.abs(np.asarray(array)).astype(float)
    return float(max(np.max(np.where(np.isfinite(flat), flat, 0), initial=0.0), 1e-12))


def fields_of(tree: Any) -> Iterator[tuple[str, Any]]:
    """Names and arrays of a result: of a tuple with names, a pytree or an array."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(tree)[0]:
        yield jax.tree_util.keystr(path), leaf


# Of each scene: the lens, fields in degrees, the distance in mm, the pixel in mm, the rule.
SCENES = {
    "double_gauss": ((0.0, 8.0, 14.0), np.inf, 0.01, "open"),
    "camera_50mm": ((0.0, 10.0, 18.0), 2000.0, 0.01, "clipped"),
    "hubble": ((0.0, 0.02, 0.04), np.inf, 0.015, "clipped"),
    "phone": ((0.0, 15.0, 30.0), 500.0, 0.002, "open"),
    "double_gauss_addon": ((0.0, 8.0, 14.0), 3000.0, 0.01, "open"),
    "fisheye_8mm": ((0.0, 40.0, 60.0), np.inf, 0.01, "open"),
}


def analyses(name: str) -> dict[str, Callable[[Lens], Any]]:
    """Functions of a lens, by name, for a scene."""
    degrees, distance, pixel, kind = SCENES[name]
    fields = np.radians(degrees)
    one, seen = fields[1], (distance, RGB)
    order = drt.Clipped(5, "bilateral") if kind == "clipped" else drt.Gauss(6, "bilateral")
    beam = beam_rule(8, "bilateral", order)
    model = lambda of: drt.PsfModel(of, beam, 48)  # noqa: E731
    lines = np.array([10.0, 40.0])
    slanted = np.array([0.3 * one, one])
    given = {"rule": order, "degree": 8, "cells": 48}
    return {
        "first_order": lambda lens: drt.first_order(lens, *seen),
        "third_order": lambda lens: drt.third_order(lens, one, *seen),
        "rays": lambda lens: drt.trace_rays(lens, slanted, *seen, POINTS)[:4],
        "moments": lambda lens: drt.psf_moments(lens, one, *seen, rule=order),
        "focus_moments": lambda lens: focus_moments(lens, one, *seen, rule=order),
        "image_point": lambda lens: drt.image_point(lens, one, *seen),
        "chief_ray_angle": lambda lens: drt.chief_ray_angle(lens, fields, *seen),
        "field_curvature": lambda lens: drt.field_curvature(lens, fields, *seen),
        "lateral_colour": lambda lens: drt.lateral_colour(lens, fields, *seen),
        "distortion": lambda lens: drt.distortion(lens, fields, *seen),
        "fans": lambda lens: drt.ray_fans(lens, fields, *seen, count=9),
        "axial_colour": lambda lens: drt.axial_colour(lens, *seen),
        "spot_diagram": lambda lens: drt.spot_diagram(lens, fields, *seen, rule=order),
        "illumination": lambda lens: drt.relative_illumination(lens, fields, *seen, rule=order),
        "vignetting": lambda lens: drt.vignetting(lens, fields, *seen, rule=order),
        "solid_angle": lambda lens: drt.solid_angle(lens, fields, *seen, rule=order),
        "wavefront": lambda lens: drt.wavefront(lens, one, *seen, POINTS)[:1],
        "zernike_standard": lambda lens: drt.zernike_standard(lens, fields[:2], *seen, 15),
        "zernike_fringe": lambda lens: drt.zernike_fringe(lens, fields[:2], *seen, 16),
        "transfer": lambda lens: drt.transfer(lens, fields[:2], *seen, lines, **given),
        "transfer_rays": lambda lens: drt.transfer(lens, fields[:2], *seen, lines, "rays", **given),
        "strehl": lambda lens: drt.strehl(lens, fields[:2], *seen, **given),
        "energy": lambda lens: drt.encircled_energy(
            lens, fields[:2], *seen, np.array([0.01, 0.03]), **given
        ),
        "psf_waves": lambda lens: drt.psf(lens, one, *seen, pixel, 15, model("waves")),
        "psf_rays": lambda lens: drt.psf(lens, one, *seen, pixel, 15, model("rays")),
        "psf_gaussian": lambda lens: drt.psf(lens, one, *seen, pixel, 15, model("gaussian")),
        "operands": lambda lens: operands(lens, fields, distance, order),
    }


def operands(lens: Lens, fields: np.ndarray, distance: float, rule: Any) -> Any:
    """Values of all operands that the lens has."""
    names = [n for n in design.OPERANDS if n not in ("glass_map", "magnification")]
    named = [
        design.Operand(n, at=20.0, target=1.0)
        if n == "mtf"
        else design.Operand(n, at=0.02, target=1.0)
        if n == "encircled_energy"
        else design.Operand(n, target=1.0 if n == "strehl" else 0.0)
        for n in names
    ]
    variables = design.Variables.from_lens(lens, ["sensor"])
    problem = design.Problem.from_variables(variables, named, fields, RGB, distance, rule)

    @jax.jit
    def values(lens: Lens) -> dict[str, Any]:
        rays = design.trace_fields(problem, lens)
        return {o.name: o.values(lens, rays) for o in problem.operands}

    return values(lens)


# Analyses whose derivatives by the lens are golden, too, and for which scenes.
SLOPES = ("rays", "moments", "distortion", "spot_diagram", "transfer", "psf_waves", "psf_rays")
MOVED = ("curvature", "thickness")
SLOPED = ("double_gauss", "camera_50mm", "hubble", "phone")


def slope(function: Callable[[Lens], Any], lens: Lens) -> dict[str, Any]:
    """The gradient of a weighted sum of the finite numbers of an analysis by curvatures and
    thicknesses."""

    def scalar(moved: tuple) -> Any:
        made = dataclasses.replace(lens, **dict(zip(MOVED, moved)))
        total = jnp.zeros(())
        for _, leaf in fields_of(function(made)):
            if jnp.issubdtype(leaf.dtype, jnp.inexact):
                flat = jnp.ravel(jnp.abs(leaf) if jnp.iscomplexobj(leaf) else leaf)
                weights = 1 + np.sin(1 + np.arange(flat.size, dtype=float)) / 2
                total += jnp.sum(jnp.where(jnp.isfinite(flat), weights * flat, 0))
        return total

    return dict(zip(MOVED, jax.grad(scalar)(tuple(getattr(lens, name) for name in MOVED))))


def answers(name: str) -> Iterator[tuple[str, float, float]]:
    """Names, numbers and scales of all answers of a scene."""
    lens = drt.load_lens(name)
    for what, function in analyses(name).items():
        for part, leaf in fields_of(function(lens)):
            yield f"{what}{part}", number(leaf), size(leaf)
        if what in SLOPES and name in SLOPED:
            for part, leaf in slope(function, lens).items():
                yield f"d {what} / d {part}", number(leaf), size(leaf)


def differences(name: str) -> list[str]:
    """A line for each answer of a scene that differs from golden.json: relative to its scale."""
    known, lines = json.loads(FILE.read_text())[name], []
    found = {what: (value, scale) for what, value, scale in answers(name)}
    lines += [f"{name}: {what}: is missing" for what in known.keys() - found.keys()]
    for what, (value, scale) in found.items():
        if what not in known:
            lines.append(f"{name}: {what}: is new")
        elif (before := float.fromhex(known[what])) != value:
            lines.append(
                f"{name}: {what}: {value:.6g}, differs by {abs(value - before) / scale:.1e}"
            )
    return lines


def main() -> None:
    """Compares or writes."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", nargs="*", choices=SCENES)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore")
    if given.write is None:
        print("\n".join(line for name in SCENES for line in differences(name)) or "no difference")
        return
    known = json.loads(FILE.read_text()) if FILE.exists() else {}
    for name in given.write or SCENES:
        known[name] = {what: value.hex() for what, value, _ in answers(name)}
        FILE.write_text(json.dumps(known, indent=0) + "\n")
        print(name, len(known[name]), flush=True)


if __name__ == "__main__":
    main()
