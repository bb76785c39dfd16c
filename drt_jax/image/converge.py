"""The sampling that an analysis needs, made outside of `jax.jit` and passed on into it."""

from collections.abc import Callable
from typing import Any

from .converged import converged_focus_rule, converged_rule, focus_moments, psf_moments
from .encircled import encircled_energy
from .fields import grid_method, kernel_grid
from .psf import converged_psf, psf
from .render import render, render_method
from .spots import light_rule, relative_illumination, solid_angle, spot_diagram, vignetting
from .transfer import strehl, transfer

_OF_LIGHT = (
    spot_diagram, vignetting, relative_illumination, solid_angle, transfer, strehl, encircled_energy
)  # fmt: skip
_MAKERS: dict[Callable, Callable] = {
    psf_moments: converged_rule,
    focus_moments: converged_focus_rule,
    psf: converged_psf,
    kernel_grid: grid_method,
    render: render_method,
    **dict.fromkeys(_OF_LIGHT, light_rule),
}


def converge(function: Callable, *arguments: Any, **settings: Any) -> Any:
    """What a function takes as `sampling=`, inside of `jax.jit`, too.

    function: the analysis. The further arguments, all of them known numbers, are
        - psf_moments, focus_moments: (lens, scene, tolerance=1e-6). Returns a pupil rule.
        - spot_diagram, vignetting, solid_angle, relative_illumination, transfer, strehl,
          encircled_energy: (lens, scene, order=12), the number of nodes along a radius. Returns a
          pupil rule.
        - psf: (lens, scene, pixel, size=21, kind="auto", tolerance=1e-2, norm=1, of="kernel").
          Returns a `Sampling`.
        - kernel_grid: (lens, scene, pixel, size, nodes=8, kind="rays", sampling=5e-3,
          together=False, norm=1). Returns settings of the grid.
        - render: (lens, shape, distance, pixel, wavelengths, size, nodes, layers, kind, tolerance,
          sampling). Returns settings of the picture.

    The sampling is valid for every point of the scene. ValueError for another function, inside a
    trace, and if no light arrives. Warns if the tolerance is not met.
    """
    if function not in _MAKERS:
        names = ", ".join(each.__name__ for each in _MAKERS)
        raise ValueError(f"converge: expected one of {names}, got {function!r:.80}")
    return _MAKERS[function](*arguments, **settings)
