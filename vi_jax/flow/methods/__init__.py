"""Methods of integration over one step: Runge–Kutta, power series, closed form; their choice."""

from .base import AbstractMethod as AbstractMethod
from .base import Foreseen as Foreseen
from .base import Stage as Stage
from .base import stages_to_step_to as stages_to_step_to
from .choice import MethodLike as MethodLike
from .choice import chosen as chosen
from .choice import preset as preset
from .exact import ExactFlight as ExactFlight
from .runge_kutta import Adaptive as Adaptive
from .runge_kutta import FixedStep as FixedStep
from .runge_kutta import ImplicitSteps as ImplicitSteps
from .runge_kutta import Unrolled as Unrolled
from .taylor import Taylor as Taylor
from .verner import Verner9 as Verner9
