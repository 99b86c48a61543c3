"""Pictures of motions: every function takes an `ax`, or makes one, and returns it; animations."""

from .animate import MotionAnimation as MotionAnimation
from .animate import animate as animate
from .branch import plot_boundary as plot_boundary
from .branch import plot_branch as plot_branch
from .branch import plot_sweep as plot_sweep
from .motion import plot_history as plot_history
from .motion import plot_phase_portrait as plot_phase_portrait
from .orbit import plot_multipliers as plot_multipliers
from .path import MotionPath as MotionPath
from .path import motion_path as motion_path
from .pen import Pen as Pen
from .save import save_picture as save_picture
from .scan import plot_basins as plot_basins
from .scan import plot_regimes as plot_regimes
from .schematic import plot_sketch as plot_sketch
