"""Ready machines: the paper's scene and its drives, linear machines, and others, each in a file
that shows how to write one."""

import importlib
from typing import TYPE_CHECKING, Any

from .drives import AbstractCrank as AbstractCrank
from .drives import AbstractDrive as AbstractDrive
from .drives import CosineCrank as CosineCrank
from .drives import IdealDrive as IdealDrive
from .drives import Motor as Motor
from .drives import OscillatorState as OscillatorState
from .drives import Slide as Slide
from .drives import SliderCrank as SliderCrank
from .linear import LinearMachine as LinearMachine
from .linear import ModalMachine as ModalMachine
from .linear import StructureState as StructureState
from .linear import modal as modal
from .scene import Parameters as Parameters
from .scene import Scene as Scene

if TYPE_CHECKING:
    from .beam import Beam as Beam
    from .bouncing_ball import BouncingBall as BouncingBall
    from .capsule import Capsule as Capsule
    from .duffing import Duffing as Duffing
    from .impact_pair import ImpactPair as ImpactPair
    from .relief_valve import ReliefValve as ReliefValve
    from .structure import Structure as Structure
    from .unbalanced_rotor import UnbalancedRotor as UnbalancedRotor
    from .woodpecker import Woodpecker as Woodpecker

# The others, with their files. They are loaded when used: each class takes some milliseconds.
READY = {
    "Beam": "beam", "BouncingBall": "bouncing_ball", "Capsule": "capsule", "Duffing": "duffing",
    "ImpactPair": "impact_pair", "ReliefValve": "relief_valve", "Structure": "structure",
    "UnbalancedRotor": "unbalanced_rotor", "Woodpecker": "woodpecker",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in READY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f".{READY[name]}", __name__)
    return globals().setdefault(name, getattr(module, name))


def __dir__() -> list[str]:
    return [*READY, "StructureState"]
