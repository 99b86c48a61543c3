"""Ready machines: the paper's scene and its drives, linear machines, and others, each in a file
that shows how to write one."""

from .beam import Beam as Beam
from .bouncing_ball import BouncingBall as BouncingBall
from .capsule import Capsule as Capsule
from .drives import AbstractCrank as AbstractCrank
from .drives import AbstractDrive as AbstractDrive
from .drives import CosineCrank as CosineCrank
from .drives import IdealDrive as IdealDrive
from .drives import Motor as Motor
from .drives import OscillatorState as OscillatorState
from .drives import Slide as Slide
from .drives import SliderCrank as SliderCrank
from .duffing import Duffing as Duffing
from .impact_pair import ImpactPair as ImpactPair
from .linear import LinearMachine as LinearMachine
from .linear import ModalMachine as ModalMachine
from .linear import StructureState as StructureState
from .linear import modal as modal
from .relief_valve import ReliefValve as ReliefValve
from .scene import Parameters as Parameters
from .scene import Scene as Scene
from .structure import Structure as Structure
from .unbalanced_rotor import UnbalancedRotor as UnbalancedRotor
from .woodpecker import Woodpecker as Woodpecker
