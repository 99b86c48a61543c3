"""What is modelled: parameters, crank, drive, stops, and the scene that composes them."""

from .base import AbstractScene as AbstractScene
from .base import Coordinate as Coordinate
from .crank import AbstractCrank as AbstractCrank
from .crank import CosineCrank as CosineCrank
from .crank import SliderCrank as SliderCrank
from .dc_motor import DCMotor as DCMotor
from .drive import AbstractDrive as AbstractDrive
from .drive import IdealDrive as IdealDrive
from .friction import DryFriction as DryFriction
from .law import AbstractContactLaw as AbstractContactLaw
from .law import HuntCrossley as HuntCrossley
from .law import PowerLaw as PowerLaw
from .motor import Motor as Motor
from .parameters import Parameters as Parameters
from .scene import Oscillator as Oscillator
from .scene import Scene as Scene
from .shaft import ShaftScene as ShaftScene
from .soft import SoftStop as SoftStop
from .states import DCMotorState as DCMotorState
from .states import MotorState as MotorState
from .states import OscillatorState as OscillatorState
from .states import TimedDCMotorState as TimedDCMotorState
from .states import TimedMotorState as TimedMotorState
from .stop import RigidStop as RigidStop
from .switch import AbstractSwitch as AbstractSwitch
from .switch import Switch as Switch
