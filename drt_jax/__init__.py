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
  before loading a lens; the library changes no global setting by itself.
"""

from . import results as results
from .compilation import keep_programs as keep_programs
from .files.entry import LensError as LensError
from .files.load import (
    System as System,
    lens_names as lens_names,
    load_lens as load_lens,
    load_system as load_system,
)
from .files.write import save_lens as save_lens
from .image.beam_psf import Sampling as Sampling
from .image.chief import (
    chief_ray_angle as chief_ray_angle,
    distortion as distortion,
    field_curvature as field_curvature,
    lateral_colour as lateral_colour,
)
from .image.converge import converge as converge
from .image.converged import focus_moments as focus_moments, psf_moments as psf_moments
from .image.encircled import encircled_energy as encircled_energy
from .image.fans import axial_colour as axial_colour, ray_fans as ray_fans
from .image.field import field_of_image as field_of_image, image_point as image_point
from .image.fields import kernel_grid as kernel_grid
from .image.psf import gaussian_error as gaussian_error, psf as psf
from .image.render import render as render, sensor_noise as sensor_noise
from .image.spots import (
    relative_illumination as relative_illumination,
    solid_angle as solid_angle,
    spot_diagram as spot_diagram,
    vignetting as vignetting,
)
from .image.transfer import strehl as strehl, transfer as transfer
from .image.wavefront import rms_wavefront as rms_wavefront, wavefront as wavefront
from .image.zernike import (
    zernike_fringe as zernike_fringe,
    zernike_standard as zernike_standard,
)
from .lens.aperture import Apertures as Apertures
from .lens.edit import (
    flipped as flipped,
    scaled as scaled,
    with_paraxial_pupil as with_paraxial_pupil,
)
from .lens.elements import Elements as Elements
from .lens.glasses import find_glass as find_glass, nearest_glasses as nearest_glasses
from .lens.lens import (
    Lens as Lens,
    sag as sag,
    with_glass as with_glass,
    with_model_glass as with_model_glass,
)
from .lens.paraxial import first_order as first_order, focal_length as focal_length
from .lens.phase import Phase as Phase
from .lens.scene import Scene as Scene
from .lens.seidel import third_order as third_order
from .pupil.clipped import Clipped as Clipped
from .pupil.rules import (
    Gauss as Gauss,
    Mask as Mask,
    Masked as Masked,
    Pattern as Pattern,
    Soft as Soft,
)
from .rays.rays import trace_rays as trace_rays
from .rays.status import Status as Status
