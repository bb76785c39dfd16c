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

from .compilation import keep_programs as keep_programs
from .files.agf import load_agf as load_agf
from .files.entry import LensError as LensError
from .files.system import System as System
from .files.write import save_lens as save_lens
from .files.yaml import (
    lens_names as lens_names,
    load_lens as load_lens,
    load_system as load_system,
)
from .image.beam_psf import Psf as Psf, PsfModel as PsfModel
from .image.chief import (
    Distortion as Distortion,
    FieldCurvature as FieldCurvature,
    chief_ray_angle as chief_ray_angle,
    distortion as distortion,
    field_curvature as field_curvature,
    lateral_colour as lateral_colour,
)
from .image.coefficients import (
    zernike_fringe as zernike_fringe,
    zernike_standard as zernike_standard,
)
from .image.converged import (
    converged_focus_rule as converged_focus_rule,
    converged_rule as converged_rule,
    focus_moments as focus_moments,
    psf_moments as psf_moments,
)
from .image.depth import depth_moments as depth_moments, moments_model as moments_model
from .image.encircled import encircled_energy as encircled_energy
from .image.fans import (
    AxialColour as AxialColour,
    RayFans as RayFans,
    axial_colour as axial_colour,
    ray_fans as ray_fans,
)
from .image.field import field_of_image as field_of_image, image_point as image_point
from .image.fields import (
    GridMethod as GridMethod,
    KernelGrid as KernelGrid,
    kernel_grid as kernel_grid,
    kernels_at as kernels_at,
)
from .image.gaussian_error import (
    GaussianError as GaussianError,
    gaussian_error as gaussian_error,
)
from .image.grid_method import grid_method as grid_method
from .image.kernel import (
    SeparableKernel as SeparableKernel,
    gaussian_psf as gaussian_psf,
    separable_psf as separable_psf,
)
from .image.moments import FocusMoments as FocusMoments, moments as moments
from .image.psf import psf as psf, psfs as psfs
from .image.psf_model import converged_psf as converged_psf
from .image.render import (
    RenderMethod as RenderMethod,
    render as render,
    sensor_noise as sensor_noise,
)
from .image.render_method import render_method as render_method
from .image.sensor import (
    convolve as convolve,
    convolve_each as convolve_each,
    sensor_layer as sensor_layer,
)
from .image.spot import Moments as Moments
from .image.spots import (
    Spots as Spots,
    light_rule as light_rule,
    relative_illumination as relative_illumination,
    solid_angle as solid_angle,
    spot_diagram as spot_diagram,
    vignetting as vignetting,
)
from .image.transfer import Transfer as Transfer, strehl as strehl, transfer as transfer
from .image.wavefront import (
    Wavefront as Wavefront,
    rms_wavefront as rms_wavefront,
    wavefront as wavefront,
)
from .learn.adam import adam as adam, apply_updates as apply_updates
from .learn.network import red_net as red_net
from .lens.aperture import Apertures as Apertures
from .lens.edit import flipped as flipped, scaled as scaled
from .lens.elements import Elements as Elements
from .lens.entrance import with_paraxial_pupil as with_paraxial_pupil
from .lens.glass import refractive_index as refractive_index
from .lens.glasses import find_glass as find_glass, nearest_glasses as nearest_glasses
from .lens.lens import (
    Lens as Lens,
    movable as movable,
    sag as sag,
    with_glass as with_glass,
    with_model_glass as with_model_glass,
)
from .lens.paraxial import (
    FirstOrder as FirstOrder,
    Pupil as Pupil,
    first_order as first_order,
    focal_length as focal_length,
    image_height as image_height,
)
from .lens.phase import Phase as Phase
from .lens.scene import Scene as Scene, field_of_height as field_of_height, scene_of as scene_of
from .lens.seidel import ThirdOrder as ThirdOrder, third_order as third_order
from .pupil.clipped import Clipped as Clipped
from .pupil.mask import Mask as Mask, Masked as Masked
from .pupil.rules import (
    Gauss as Gauss,
    Pattern as Pattern,
    PupilRule as PupilRule,
    Soft as Soft,
    pupil_points as pupil_points,
    symmetry_of as symmetry_of,
)
from .rays.status import Status as Status
from .rays.trace import Rays as Rays, trace_rays as trace_rays
