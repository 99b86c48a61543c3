"""The names that other packages import; `__init__.py` loads those for branches and tori late."""

# ruff: noqa: I001
# fmt: off
from .birkhoff import (
    QUASIPERIODIC as QUASIPERIODIC, WANDERS as WANDERS, agreement as agreement,
    checked_rotation_number as checked_rotation_number, digits_of as digits_of,
    rotation_number as rotation_number, weights as weights, without_angles as without_angles,
)
from .closed_form import (
    ClosedFormOrbits as ClosedFormOrbits, closed_form_orbits as closed_form_orbits,
)
from .continuation import boundary as boundary, continue_orbit as continue_orbit
from .curve import (
    Boundary as Boundary, Branch as Branch, branch_hits_in_words as branch_hits_in_words,
    column_names as column_names,
)
from .cycle_map import CycleMap as CycleMap, cycle_map as cycle_map, map_state as map_state
from .delay import as_chain as as_chain
from .find import find_orbit as find_orbit, is_equilibrium as is_equilibrium
from .forecast import SCENARIOS as SCENARIOS
from .grazing import Grazing as Grazing, Motions as Motions
from .kinds import KINDS as KINDS
from .results import (
    ORBIT_RESULTS as ORBIT_RESULTS, STABILITY as STABILITY, MotionSections as MotionSections,
    Orbit as Orbit, Orbits as Orbits, check_multipliers as check_multipliers, distance as distance,
    distinct_among as distinct_among, distinct_orbits as distinct_orbits,
    in_one_line as in_one_line, index_of as index_of, multipliers_in_words as multipliers_in_words,
    multipliers_of as multipliers_of, stability_of as stability_of,
)
from .root_finders import (
    AbstractRootFinder as AbstractRootFinder, Gradient as Gradient, Newton as Newton,
)
from .special import Point as Point
from .tolerances import (
    ALIKE as ALIKE, CORRECTED as CORRECTED, FAINT as FAINT, LOCATED as LOCATED,
    ROUNDINGS as ROUNDINGS,
)
from .torus import Torus as Torus, find_torus as find_torus
from .torus_branch import (
    TorusBranch as TorusBranch, Window as Window, continue_torus as continue_torus,
)
