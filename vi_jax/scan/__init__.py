"""Many motions at once: grids, sweeps, basins, Lyapunov exponents, regimes."""

from .basins import Attractor as Attractor
from .basins import Basins as Basins
from .basins import basins as basins
from .lyapunov import Lyapunov as Lyapunov
from .lyapunov import lyapunov as lyapunov
from .measures import AbstractMeasure as AbstractMeasure
from .measures import Exponent as Exponent
from .measures import Regime as Regime
from .measures import Sections as Sections
from .regime import REGIMES as REGIMES
from .scan import ScanInterrupted as ScanInterrupted
from .scan import scan as scan
from .sweep import Sweep as Sweep
from .sweep import sweep as sweep
