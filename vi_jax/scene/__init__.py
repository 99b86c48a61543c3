"""What is modelled: parameters, crank, drive, stops, and the scene that composes them."""

from .base import AbstractScene as AbstractScene
from .crank import AbstractCrank as AbstractCrank
from .crank import CosineCrank as CosineCrank
from .crank import SliderCrank as SliderCrank
from .drive import IdealDrive as IdealDrive
from .drive import Motor as Motor
from .parameters import Parameters as Parameters
from .scene import LABELS as LABELS
from .scene import MotorState as MotorState
from .scene import Oscillator as Oscillator
from .scene import OscillatorState as OscillatorState
from .scene import Scene as Scene
from .scene import TimedMotorState as TimedMotorState
from .stop import RigidStop as RigidStop
