"""Designing a lens: variables, operands, least squares, many starts, tolerances."""

from . import least_squares as least_squares
from .errors import Tolerance as Tolerance, elements_of as elements_of
from .field_rays import FieldRays as FieldRays
from .least_squares import Evaluation as Evaluation, Search as Search
from .limits import Limit as Limit
from .operands import Operand as Operand
from .optimum import Optimum as Optimum, optimise as optimise
from .perturbed import Perturbed as Perturbed
from .problem import Problem as Problem, trace_fields as trace_fields
from .solves import Solve as Solve
from .starts import (
    Minimum as Minimum,
    Starts as Starts,
    around as around,
    many_starts as many_starts,
    rays_of as rays_of,
    within as within,
)
from .tolerance import (
    Made as Made,
    Predicted as Predicted,
    draw_errors as draw_errors,
    made as made,
    monte_carlo as monte_carlo,
    predict as predict,
    variances as variances,
    worst_case as worst_case,
)
from .values import OPERANDS as OPERANDS
from .variables import Tie as Tie, Variables as Variables, Vary as Vary
