"""Pictures: numbers and lenses in, figures out. Alone imports matplotlib.

from drt_jax import show

figure, axes = show.new()
show.lens_drawing(axes, show.draw(lens))
figure.savefig("lens.png")
"""

from .figures import (
    by_family,
    convergence,
    error_curves,
    growth,
    kernels,
    new,
    patch_grid,
    programs,
    sigma_over_depth,
)
from .layout import Drawing, draw, lens_drawing

__all__ = [
    "Drawing",
    "by_family",
    "convergence",
    "draw",
    "error_curves",
    "growth",
    "kernels",
    "lens_drawing",
    "new",
    "patch_grid",
    "programs",
    "sigma_over_depth",
]
