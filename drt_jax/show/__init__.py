"""Pictures: numbers and lenses in, figures out. Alone imports matplotlib.

from drt_jax import show

figure, axes = show.new()
show.lens_drawing(axes, show.draw(lens))
figure.savefig("lens.png")
"""

from .figures import kernels as kernels, new as new
from .layout import Drawing as Drawing, draw as draw, lens_drawing as lens_drawing
