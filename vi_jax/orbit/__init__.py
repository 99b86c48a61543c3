"""Periodic motion: the cycle map, closed-form solutions, finding orbits and judging them."""

from ._boundary import Boundary as Boundary
from ._boundary import boundary as boundary
from ._cycle_map import CycleMap as CycleMap
from ._cycle_map import adopted as adopted
from ._cycle_map import cycle_map as cycle_map
from .branch import Branch as Branch
from .branch import column_names as column_names
from .branch import continue_orbit as continue_orbit
from .closed_form import ClosedFormOrbits as ClosedFormOrbits
from .closed_form import closed_form_orbits as closed_form_orbits
from .curve import check_walk as check_walk
from .distinct import distinct_orbits as distinct_orbits
from .find import find_orbit as find_orbit
from .floquet import STABILITY as STABILITY
from .floquet import stability_of as stability_of
from .results import ORBIT_RESULTS as ORBIT_RESULTS
from .results import Orbit as Orbit
from .results import complex_in_words as complex_in_words
from .results import impacts_in_words as impacts_in_words
from .results import trimmed as trimmed
from .root_finders import AbstractRootFinder as AbstractRootFinder
from .root_finders import Gradient as Gradient
from .root_finders import Newton as Newton
from .special import SpecialPoint as SpecialPoint
