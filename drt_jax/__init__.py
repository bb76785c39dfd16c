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

from .files.specs import LensError
from .files.yaml import lens_names, load_lens
from .image.converged import (
    converged_focus_rule,
    converged_rule,
    focus_moments,
    psf_moments,
)
from .image.depth import depth_moments, moments_model
from .image.kernel import SeparableKernel, gaussian_psf
from .image.moments import FocusMoments, Moments, moments
from .image.sensor import convolve, sensor_layer
from .image.wavefront import Wavefront, rms_wavefront, wavefront
from .learn.adam import adam, apply_updates
from .learn.network import red_net
from .lens.glass import find_glass, refractive_index
from .lens.lens import Lens, sag
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
from .lens.scene import Scene, field_of_height, scene_of
from .lens.seidel import ThirdOrder, third_order
from .pupil.clipped import Clipped
from .pupil.rules import Gauss, Pattern, PupilRule, Soft, pupil_points, symmetry_of
from .rays.status import Status
from .rays.trace import Rays, trace_rays

__all__ = [
    "Clipped",
    "FirstOrder",
    "FocusMoments",
    "Gauss",
    "Lens",
    "LensError",
    "Moments",
    "Pattern",
    "Pupil",
    "PupilRule",
    "Rays",
    "Scene",
    "SeparableKernel",
    "Soft",
    "Status",
    "ThirdOrder",
    "Wavefront",
    "adam",
    "apply_updates",
    "back_focal_distance",
    "converged_focus_rule",
    "converged_rule",
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
    "lens_names",
    "load_lens",
    "moments",
    "moments_model",
    "numerical_aperture",
    "psf_moments",
    "pupil_points",
    "red_net",
    "refractive_index",
    "rms_wavefront",
    "sag",
    "scene_of",
    "sensor_layer",
    "symmetry_of",
    "third_order",
    "trace_rays",
    "wavefront",
]
