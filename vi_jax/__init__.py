"""vi_jax: differentiable, vectorised simulation of vibro-impact systems."""

from .flow import RESULTS as RESULTS
from .flow import AbstractMethod as AbstractMethod
from .flow import Adaptive as Adaptive
from .flow import ExactFlight as ExactFlight
from .flow import FixedStep as FixedStep
from .flow import ImpactLog as ImpactLog
from .flow import Run as Run
from .flow import Samples as Samples
from .flow import Unrolled as Unrolled
from .flow import jit as jit
from .flow import simulate as simulate
from .orbit import ClosedFormOrbits as ClosedFormOrbits
from .orbit import closed_form_orbits as closed_form_orbits
from .scene import AbstractCrank as AbstractCrank
from .scene import AbstractScene as AbstractScene
from .scene import CosineCrank as CosineCrank
from .scene import IdealDrive as IdealDrive
from .scene import Motor as Motor
from .scene import MotorState as MotorState
from .scene import Oscillator as Oscillator
from .scene import OscillatorState as OscillatorState
from .scene import Parameters as Parameters
from .scene import RigidStop as RigidStop
from .scene import Scene as Scene
from .scene import SliderCrank as SliderCrank
from .scene import TimedMotorState as TimedMotorState
