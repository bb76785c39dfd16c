"""Figures of lenses and of results. No other folder imports matplotlib.

from drt_jax import show

figure, axes = show.new()
show.lens_drawing(axes, show.draw(lens))
figure.savefig("lens.png")
"""

from .analyses import (
    distortion as distortion,
    encircled_energy as encircled_energy,
    fan as fan,
    field_curvature as field_curvature,
    gaussian_error as gaussian_error,
    illumination as illumination,
    lateral_colour as lateral_colour,
    mtf as mtf,
    spots as spots,
)
from .figures import kernels as kernels, new as new
from .glasses import glass_map as glass_map
from .layout import Drawing as Drawing, draw as draw, lens_drawing as lens_drawing
from .page import page as page
from .sheet import panels as panels, sheet as sheet
from .tolerances import sensitivity as sensitivity, yields as yields
