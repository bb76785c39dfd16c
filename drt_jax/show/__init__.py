"""Pictures: numbers and lenses in, figures out. Alone imports matplotlib.

from drt_jax import show

figure, axes = show.new()
show.lens_drawing(axes, show.draw(lens))
figure.savefig("lens.png")
"""

from .designs import (
    merits as merits,
    ranks as ranks,
    searching as searching,
    spots as spots,
)
from .figures import (
    by_family as by_family,
    convergence as convergence,
    curves as curves,
    error_curves as error_curves,
    growth as growth,
    kernels as kernels,
    new as new,
    patch_grid as patch_grid,
    programs as programs,
    shares as shares,
    sigma_over_depth as sigma_over_depth,
)
from .layout import Drawing as Drawing, draw as draw, lens_drawing as lens_drawing
from .tolerances import histogram as histogram, offenders as offenders, yields as yields
