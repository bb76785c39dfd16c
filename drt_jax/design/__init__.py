"""Designing a lens: variables, operands, least squares, many starts, tolerances."""

from .errors import Tolerance as Tolerance, elements_of as elements_of
from .least_squares import BoundedLM as BoundedLM
from .limits import Limit as Limit
from .operands import Operand as Operand
from .optimum import Optimum as Optimum, Search as Search, optimise as optimise
from .perturbed import Perturbed as Perturbed
from .problem import Judged as Judged, Problem as Problem
from .seen import Seen as Seen
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
