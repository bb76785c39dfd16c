"""The types of results, to name them in annotations: `results.Spots`."""

from .image.beam_psf import Psf as Psf
from .image.chief import Distortion as Distortion, FieldCurvature as FieldCurvature
from .image.fans import AxialColour as AxialColour, RayFans as RayFans
from .image.fields import KernelGrid as KernelGrid
from .image.kernel import SeparableKernel as SeparableKernel
from .image.moments import FocusMoments as FocusMoments
from .image.psf import GaussianError as GaussianError
from .image.spot import Moments as Moments
from .image.spots import Spots as Spots
from .image.transfer import Transfer as Transfer
from .image.wavefront import Wavefront as Wavefront
from .lens.paraxial import FirstOrder as FirstOrder, Pupil as Pupil
from .lens.seidel import ThirdOrder as ThirdOrder
from .rays.rays import Rays as Rays
