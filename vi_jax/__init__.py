"""vi_jax: differentiable, vectorised simulation of vibro-impact systems."""

import importlib
import sys
import types
import typing

from . import _version
from . import machines as machines
from ._interrupted import Interrupted as Interrupted
from ._renamed import NAMES as _NEW_NAMES
from .flow import EVENTS as EVENTS
from .flow import RESULTS as RESULTS
from .flow import AbstractMethod as AbstractMethod
from .flow import Adaptive as Adaptive
from .flow import Errors as Errors
from .flow import EventLog as EventLog
from .flow import ExactFlight as ExactFlight
from .flow import FixedStep as FixedStep
from .flow import ImpactLog as ImpactLog
from .flow import Run as Run
from .flow import Samples as Samples
from .flow import Suggestion as Suggestion
from .flow import Taylor as Taylor
from .flow import Unrolled as Unrolled
from .flow import Verner9 as Verner9
from .flow import WhiteNoise as WhiteNoise
from .flow import jit as jit
from .flow import preset as preset
from .flow import simulate as simulate
from .flow import suggest_method as suggest_method
from .lanes import backend as backend
from .lanes import threads as threads
from .machine import AbstractContactLaw as AbstractContactLaw
from .machine import AbstractCrank as AbstractCrank
from .machine import AbstractDrive as AbstractDrive
from .machine import AbstractEvent as AbstractEvent
from .machine import AbstractMachine as AbstractMachine
from .machine import AbstractSwitch as AbstractSwitch
from .machine import ContactFriction as ContactFriction
from .machine import Coordinate as Coordinate
from .machine import CosineCrank as CosineCrank
from .machine import DCMotor as DCMotor
from .machine import DCMotorState as DCMotorState
from .machine import DryFriction as DryFriction
from .machine import HuntCrossley as HuntCrossley
from .machine import IdealDrive as IdealDrive
from .machine import Motor as Motor
from .machine import MotorState as MotorState
from .machine import Oscillator as Oscillator
from .machine import OscillatorState as OscillatorState
from .machine import Parameters as Parameters
from .machine import PowerLaw as PowerLaw
from .machine import Reset as Reset
from .machine import RigidStop as RigidStop
from .machine import Scene as Scene
from .machine import SliderCrank as SliderCrank
from .machine import SoftStop as SoftStop
from .machine import Switch as Switch
from .machine import TimedDCMotorState as TimedDCMotorState
from .machine import TimedMotorState as TimedMotorState
from .orbit import ORBIT_RESULTS as ORBIT_RESULTS
from .orbit import SCENARIOS as SCENARIOS
from .orbit import STABILITY as STABILITY
from .orbit import AbstractRootFinder as AbstractRootFinder
from .orbit import Boundary as Boundary
from .orbit import Branch as Branch
from .orbit import ClosedFormOrbits as ClosedFormOrbits
from .orbit import CodimensionTwo as CodimensionTwo
from .orbit import CycleMap as CycleMap
from .orbit import Gradient as Gradient
from .orbit import Grazing as Grazing
from .orbit import Newton as Newton
from .orbit import Orbit as Orbit
from .orbit import ResonantGrazing as ResonantGrazing
from .orbit import SpecialPoint as SpecialPoint
from .orbit import boundary as boundary
from .orbit import closed_form_orbits as closed_form_orbits
from .orbit import continue_orbit as continue_orbit
from .orbit import cycle_map as cycle_map
from .orbit import distinct_orbits as distinct_orbits
from .orbit import find_orbit as find_orbit
from .orbit import grazing as grazing
from .orbit import resonant_grazings as resonant_grazings
from .robust import EdgeState as EdgeState
from .robust import Manifold as Manifold
from .robust import MinimalKick as MinimalKick
from .robust import edge_state as edge_state
from .robust import manifold as manifold
from .robust import minimal_kick as minimal_kick
from .scan import REGIMES as REGIMES
from .scan import AbstractMeasure as AbstractMeasure
from .scan import AllOrbits as AllOrbits
from .scan import Attractor as Attractor
from .scan import BasinEntropy as BasinEntropy
from .scan import Basins as Basins
from .scan import Density as Density
from .scan import Escape as Escape
from .scan import Exponent as Exponent
from .scan import Integrity as Integrity
from .scan import IntegrityProfile as IntegrityProfile
from .scan import Lyapunov as Lyapunov
from .scan import Regime as Regime
from .scan import ScanInterrupted as ScanInterrupted
from .scan import Sections as Sections
from .scan import Statistics as Statistics
from .scan import Sweep as Sweep
from .scan import Uncertainty as Uncertainty
from .scan import all_orbits as all_orbits
from .scan import basins as basins
from .scan import escape_rate as escape_rate
from .scan import integrity_profile as integrity_profile
from .scan import lyapunov as lyapunov
from .scan import scan as scan
from .scan import spectrum as spectrum
from .scan import sweep as sweep

if typing.TYPE_CHECKING:
    __version__: str
    from .plot import animate as animate
    from .plot import plot_basins as plot_basins
    from .plot import plot_boundary as plot_boundary
    from .plot import plot_branch as plot_branch
    from .plot import plot_grazing as plot_grazing
    from .plot import plot_history as plot_history
    from .plot import plot_integrity as plot_integrity
    from .plot import plot_manifold as plot_manifold
    from .plot import plot_multipliers as plot_multipliers
    from .plot import plot_phase_portrait as plot_phase_portrait
    from .plot import plot_regimes as plot_regimes
    from .plot import plot_sketch as plot_sketch
    from .plot import plot_style as plot_style
    from .plot import plot_sweep as plot_sweep
    from .plot import save_picture as save_picture


def __getattr__(name: str):
    """Plots, loaded when the first of them is asked for: matplotlib takes long to load."""
    if name == "__version__":
        return _version.installed_version()
    if name == "plot" or name.startswith("plot_") or name in ("animate", "save_picture"):
        plot = importlib.import_module(".plot", __name__)
        return plot if name == "plot" else getattr(plot, name)
    if name in _NEW_NAMES:
        raise AttributeError(f"`vi_jax.{name}` is called `vi_jax.{_NEW_NAMES[name]}` now.")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """What this package offers: its names, the plots and the packages of ready parts."""
    from . import plot

    pictures = [name for name in vars(plot) if name.startswith("plot_")]
    offered = (
        name
        for name, value in globals().items()
        if not name.startswith("_") and not isinstance(value, types.ModuleType)
    )
    return sorted(
        {*offered, *pictures, "__version__", "animate", "machines", "plot", "save_picture"}
    )


def _show_modules_on(verb: typing.Any) -> None:
    """Give a verb the modules of the package that it hides by its name, so that `import` finds
    them: `import vi_jax.scan.store`, while `vi_jax.scan(...)` scans."""
    package = sys.modules[f"{__name__}.{verb.__name__}"]
    for name, value in list(vars(package).items()):
        if isinstance(value, types.ModuleType) and value.__name__ == f"{package.__name__}.{name}":
            setattr(verb, name, value)


_show_modules_on(scan)
