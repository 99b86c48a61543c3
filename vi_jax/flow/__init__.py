"""How a machine moves: methods, the hybrid step, the closed-form flight, `simulate`, results."""

from ._lane import has_fixed_cycle as has_fixed_cycle
from .fusion import jit as jit
from .methods import AbstractMethod as AbstractMethod
from .methods import Adaptive as Adaptive
from .methods import ExactFlight as ExactFlight
from .methods import FixedStep as FixedStep
from .methods import Taylor as Taylor
from .methods import Unrolled as Unrolled
from .methods import Verner9 as Verner9
from .methods import preset as preset
from .results import EVENTS as EVENTS
from .results import RESULTS as RESULTS
from .results import Errors as Errors
from .results import EventLog as EventLog
from .results import ImpactLog as ImpactLog
from .results import Run as Run
from .results import Samples as Samples
from .simulate import simulate as simulate
from .suggest import Suggestion as Suggestion
from .suggest import suggest_method as suggest_method
