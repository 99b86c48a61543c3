"""Simulation: methods of integration, the hybrid step, closed forms, `simulate` and its results."""

from typing import TYPE_CHECKING, Any

# The names that other packages import.
# ruff: noqa: F401, I001
# fmt: off
from .plan import has_fixed_cycle
from .machine_checks import check_parts, check_values, depends_on_time
from ._quantities import average_names, has_averages, has_quantities, quantities_on, quantity_names
from ._simulate import compiling, jit, simulate, simulate_pool, simulate_states
from .arguments import (
    RunOptions, as_floats, check_finite, check_leaves, check_reals, check_start, machine_of,
    make_plan, shape_of,
)
from .history import history_of_function, with_first_history
from ._step.roots import Rates, force_rate, guard_rates
from .sizes import rounding_bounds, row_sizes, sizes_on_host, unit_of
from .methods import (
    AbstractMethod, Adaptive, ExactFlight, FixedStep, ImplicitSteps, MethodLike, Taylor,
    chosen, preset,
)
from .methods.exact import lack_of_closed_form
from .noise import WhiteNoise, check_noise, lane_key, words_of
from .results import (
    EVENTS, REASON_NAMES, RESULTS, Errors, EventKind, EventLog, ImpactLog, NamedEnumeration,
    Run, Samples, batch_names, in_names, number_of, present, raised, span_of_position, states, tidy,
)
from .smooth import (
    TIME, Integrals, SmoothMachine, carried, elapsed, in_modes, means,
)
from .suggest import Suggestion, suggest_method

if TYPE_CHECKING:
    from .methods.solvers import Unrolled, Verner9


def __getattr__(name: str) -> Any:
    if name not in ("Unrolled", "Verner9"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from .methods import solvers  # loads diffrax

    return getattr(solvers, name)
