"""Figures of lenses and of results. No other folder imports matplotlib.

from drt_jax import show

figure, axes = show.new()
show.lens_drawing(axes, show.draw(lens))
figure.savefig("lens.png")
"""

from .aberrations import (
    focal_shift as focal_shift,
    footprints as footprints,
    grid_distortion as grid_distortion,
    longitudinal as longitudinal,
    mtf_through_focus as mtf_through_focus,
    point_spread as point_spread,
    wavefront_map as wavefront_map,
)
from .analyses import (
    distortion as distortion,
    encircled_energy as encircled_energy,
    fan as fan,
    field_curvature as field_curvature,
    gaussian_error as gaussian_error,
    illumination as illumination,
    lateral_colour as lateral_colour,
    mtf as mtf,
    mtf_over_field as mtf_over_field,
    path_fan as path_fan,
    seidel as seidel,
    spots as spots,
)
from .configurations import (
    configuration_table as configuration_table,
    configurations as configurations,
)
from .figures import kernels as kernels, new as new
from .glasses import glass_map as glass_map
from .layout import Drawing as Drawing, draw as draw, lens_drawing as lens_drawing
from .more import more_panels as more_panels
from .page import page as page
from .prescription import prescription as prescription
from .sheet import panels as panels, sheet as sheet
from .tolerances import sensitivity as sensitivity, yields as yields
