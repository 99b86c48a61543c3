"""Periodic motion: the cycle map, closed-form solutions, finding orbits and judging them."""

# The names that other packages import. Those for branches and tori, which the stub lists too, are
# loaded on first access.
# ruff: noqa: F401, I001
# fmt: off
from .._loading import on_first_access
from .delay import as_chain
from .cycle_map import CycleMap, cycle_map, map_state
from .find import find_orbit, is_equilibrium
from .results import (
    ORBIT_RESULTS, STABILITY, Orbit, Orbits, MotionSections, check_multipliers, distance,
    distinct_among, distinct_orbits, in_one_line, index_of, multipliers_in_words, multipliers_of,
    stability_of,
)
from .root_finders import AbstractRootFinder, Gradient, Newton
from .birkhoff import (
    QUASIPERIODIC, WANDERS, agreement, checked_rotation_number, digits_of, rotation_number,
    weights, without_angles,
)
from .tolerances import ALIKE, CORRECTED, FAINT, LOCATED, ROUNDINGS

__all__, __getattr__ = on_first_access(__name__, __file__)  # pyright: ignore
__dir__ = lambda: __all__
