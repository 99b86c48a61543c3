"""Many motions at once: quasi-static sweeps, and what a settled motion is."""

from .regime import least_period as least_period
from .sweep import Sweep as Sweep
from .sweep import sweep as sweep
