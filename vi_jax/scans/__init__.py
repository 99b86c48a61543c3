"""Batches of motions: grids, sweeps, basins, Lyapunov exponents, regimes."""

# The names that other packages import.
# ruff: noqa: F401
# fmt: off
from ._all_orbits import AllOrbits, all_orbits
from ._basins import Attractor, Basins, Integrity, IntegrityProfile, basins, integrity_profile
from ._geometry import BasinEntropy, Uncertainty
from ._lyapunov import Lyapunov, lyapunov
from ._scan import scan
from ._sweep import Sweep, moved_by_stops, sweep
from .forces import ContactForces
from .measures import REGIMES, AbstractMeasure, Exponent, Regime, Rotation, Sections
from .program import make_program
from .statistics import Density, Escape, Statistics, escape_rate
from .store import NOT_COMPUTED
