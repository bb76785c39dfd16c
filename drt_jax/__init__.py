"""Design a camera lens and the neural network behind it together, by differential ray tracing.

Conventions, everywhere in the package:

- lengths in mm, wavelengths in um, angles in radians (degrees only in files and on the command
  line); pixels only from `psf` on;
- light travels towards +z, z = 0 at the first vertex; a positive field angle is light that
  travels upwards (+y), whose image lies above the axis;
- curvature c = 1/radius, positive with its centre at larger z; conic k = 0 a sphere, -1 a
  paraboloid;
- axes in the order (field, wavelength, ray, surface, xyz) and (batch, y, x, channel);
- dtypes follow the inputs: enable float64 with `jax.config.update("jax_enable_x64", True)`
  before loading a lens; the library changes no global setting.
"""

from .learn.adam import adam, apply_updates
from .image.depth import depth_moments, moments_model
from .rays.fermat import Status
from .lens.glass import find_glass, refractive_index
from .lens.lens import Lens
from .image.moments import focus_moments, psf_moments, pupil_order
from .learn.network import red_net
from .lens.paraxial import (
    FirstOrder,
    Pupil,
    back_focal_distance,
    entrance_pupil,
    exit_pupil,
    f_number,
    first_order,
    focal_length,
    front_focal_distance,
    image_distance,
    image_height,
    lateral_magnification,
    numerical_aperture,
)
from .lens.seidel import ThirdOrder, third_order
from .files.specs import LensError
from .files.yaml import lens_names, load_lens
from .image.kernel import SeparableKernel, gaussian_psf
from .image.sensor import convolve, sensor_layer
from .rays.snell import launch_paraxial, trace_snell
from .rays.trace import Rays, field_of_height, trace_rays
from .image.wavefront import Wavefront, rms_wavefront, wavefront

__all__ = [
    "FirstOrder",
    "Lens",
    "LensError",
    "Pupil",
    "Rays",
    "SeparableKernel",
    "Status",
    "ThirdOrder",
    "Wavefront",
    "adam",
    "apply_updates",
    "back_focal_distance",
    "convolve",
    "depth_moments",
    "entrance_pupil",
    "exit_pupil",
    "f_number",
    "field_of_height",
    "find_glass",
    "first_order",
    "focal_length",
    "focus_moments",
    "front_focal_distance",
    "gaussian_psf",
    "image_distance",
    "image_height",
    "lateral_magnification",
    "launch_paraxial",
    "lens_names",
    "load_lens",
    "moments_model",
    "numerical_aperture",
    "psf_moments",
    "pupil_order",
    "red_net",
    "refractive_index",
    "rms_wavefront",
    "sensor_layer",
    "third_order",
    "trace_rays",
    "trace_snell",
    "wavefront",
]
