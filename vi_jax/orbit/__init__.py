"""Periodic motion: the cycle map, closed-form solutions, finding orbits and judging them."""

# The names that other packages import.
# ruff: noqa: F401, I001
# fmt: off
from .delay import as_chain
from .continuation import boundary, continue_orbit
from .cycle_map import CycleMap, cycle_map, map_state
from .closed_form import ClosedFormOrbits, closed_form_orbits
from .curve import Boundary, Branch, branch_hits_in_words, column_names
from .find import find_orbit, is_equilibrium
from .forecast import SCENARIOS
from .grazing import Grazing, Motions, grazing
from .kinds import KINDS
from .results import (
    ORBIT_RESULTS, STABILITY, Orbit, Orbits, MotionSections, check_multipliers, distance,
    distinct_among, distinct_orbits, in_one_line, index_of, multipliers_in_words, multipliers_of,
    stability_of,
)
from .root_finders import AbstractRootFinder, Gradient, Newton
from .special import Point
from .birkhoff import (
    QUASIPERIODIC, WANDERS, agreement, digits_of, rotation_number, weights, without_angles,
)
from .tolerances import ALIKE, CORRECTED, FAINT, LOCATED, ROUNDINGS
from .torus import Torus, find_torus
from .torus_branch import TorusBranch, Window, continue_torus
from . import switch  # registers what begins at special points
