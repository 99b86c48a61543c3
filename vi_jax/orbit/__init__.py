"""Periodic motion: the cycle map, closed-form solutions, finding orbits and judging them."""

from .boundary import Boundary as Boundary
from .boundary import boundary as boundary
from .branch import Branch as Branch
from .branch import continue_orbit as continue_orbit
from .closed_form import ClosedFormOrbits as ClosedFormOrbits
from .closed_form import closed_form_orbits as closed_form_orbits
from .cycle_map import CycleMap as CycleMap
from .cycle_map import cycle_map as cycle_map
from .distinct import distinct_orbits as distinct_orbits
from .find import find_orbit as find_orbit
from .floquet import STABILITY as STABILITY
from .results import ORBIT_RESULTS as ORBIT_RESULTS
from .results import Orbit as Orbit
from .root_finders import AbstractRootFinder as AbstractRootFinder
from .root_finders import Gradient as Gradient
from .root_finders import Newton as Newton
from .special import SpecialPoint as SpecialPoint
