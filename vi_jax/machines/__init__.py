"""Ready machines besides the paper's, each in a file that shows how to write one."""

from ..machine import StructureState as StructureState
from .beam import Beam as Beam
from .bouncing_ball import BouncingBall as BouncingBall
from .capsule import Capsule as Capsule
from .duffing import Duffing as Duffing
from .impact_pair import ImpactPair as ImpactPair
from .relief_valve import ReliefValve as ReliefValve
from .structure import Structure as Structure
from .unbalanced_rotor import UnbalancedRotor as UnbalancedRotor
from .woodpecker import Woodpecker as Woodpecker
