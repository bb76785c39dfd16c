"""Designing a lens: variables, operands, least squares, many starts, tolerances."""

from ..lens.bend import bent as bent, split as split
from ..lens.edit import named as named
from ..lens.insert import (
    cemented as cemented,
    inserted as inserted,
    removed as removed,
    with_asphere as with_asphere,
    with_dummy as with_dummy,
    with_plate as with_plate,
    with_stop as with_stop,
)
from ..lens.join import joined as joined
from ..lens.temperature import (
    ThermalModel as ThermalModel,
    at_temperature as at_temperature,
)
from . import least_squares as least_squares
from .assembly import Assembly as Assembly, as_built as as_built
from .compensation import AsBuilt as AsBuilt
from .configurations import Configurations as Configurations
from .configured import configured as configured
from .field_rays import FieldRays as FieldRays
from .focusing import Focusing as Focusing, focusing as focusing
from .glasses import (
    Snap as Snap,
    Snapped as Snapped,
    ordinary_glass as ordinary_glass,
    snap_glasses as snap_glasses,
)
from .grades import GRADES as GRADES, Grade as Grade, graded as graded
from .growth import Growth as Growth, grow as grow, part_of as part_of
from .insertions import Insertion as Insertion, insertions as insertions
from .least_squares import Evaluation as Evaluation, Search as Search
from .limits import Limit as Limit
from .media import elements_of as elements_of
from .operands import Operand as Operand
from .optimum import Optimum as Optimum, optimise as optimise
from .perturbed import PerturbedLens as PerturbedLens, Tolerance as Tolerance
from .problem import (
    Problem as Problem,
    fit_apertures as fit_apertures,
    open_apertures as open_apertures,
    trace_fields as trace_fields,
)
from .ray_steps import RaySteps as RaySteps, cosine as cosine
from .sensitivities import (
    Sensitivity as Sensitivity,
    inverse_sensitivity as inverse_sensitivity,
    sensitivity as sensitivity,
    yields as yields,
)
from .solves import Solve as Solve
from .starts import (
    Minimum as Minimum,
    Starts as Starts,
    as_built_starts as as_built_starts,
    many_starts as many_starts,
    normal_starts as normal_starts,
    rays_of as rays_of,
    sobol_starts as sobol_starts,
)
from .tolerance import (
    Predicted as Predicted,
    draw_perturbations as draw_perturbations,
    monte_carlo as monte_carlo,
    predict as predict,
    spots_as_built as spots_as_built,
    variances as variances,
    worst_case as worst_case,
)
from .values import OPERANDS as OPERANDS
from .variables import Tie as Tie, Variables as Variables, Vary as Vary
from .waves import filter_error as filter_error, psf as psf
from .within_limits import within_limits as within_limits
