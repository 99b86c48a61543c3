"""Many motions at once: grids, sweeps, basins, Lyapunov exponents, regimes."""

from ._basins import Attractor as Attractor
from ._basins import Basins as Basins
from ._basins import basins as basins
from ._lyapunov import Lyapunov as Lyapunov
from ._lyapunov import lyapunov as lyapunov
from ._scan import LanesFailed as LanesFailed
from ._scan import ScanInterrupted as ScanInterrupted
from ._scan import scan as scan
from ._sweep import COLUMNS as COLUMNS
from ._sweep import Sweep as Sweep
from ._sweep import sweep as sweep
from ._sweep import taken_along as taken_along
from .corners import check_corners as check_corners
from .grid import Blocks as Blocks
from .grid import axes_of as axes_of
from .measures import AbstractMeasure as AbstractMeasure
from .measures import Exponent as Exponent
from .measures import Regime as Regime
from .measures import Sections as Sections
from .program import make_program as make_program
from .regime import REGIMES as REGIMES
from .regime import periods_of as periods_of
from .store import NOT_COMPUTED as NOT_COMPUTED
