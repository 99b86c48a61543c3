"""vi_jax: differentiable, vectorised simulation of vibro-impact systems."""

import importlib
import types
import typing

from . import _version
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

if typing.TYPE_CHECKING:
    __version__: str
    from . import machines as machines
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
    from .robust import EdgeState as EdgeState
    from .robust import Manifold as Manifold
    from .robust import MinimalKick as MinimalKick
    from .robust import edge_state as edge_state
    from .robust import manifold as manifold
    from .robust import minimal_kick as minimal_kick
    from .scans import REGIMES as REGIMES
    from .scans import AbstractMeasure as AbstractMeasure
    from .scans import AllOrbits as AllOrbits
    from .scans import Attractor as Attractor
    from .scans import BasinEntropy as BasinEntropy
    from .scans import Basins as Basins
    from .scans import Density as Density
    from .scans import Escape as Escape
    from .scans import Exponent as Exponent
    from .scans import Integrity as Integrity
    from .scans import IntegrityProfile as IntegrityProfile
    from .scans import Lyapunov as Lyapunov
    from .scans import Regime as Regime
    from .scans import ScanInterrupted as ScanInterrupted
    from .scans import Sections as Sections
    from .scans import Statistics as Statistics
    from .scans import Sweep as Sweep
    from .scans import Uncertainty as Uncertainty
    from .scans import all_orbits as all_orbits
    from .scans import basins as basins
    from .scans import escape_rate as escape_rate
    from .scans import integrity_profile as integrity_profile
    from .scans import lyapunov as lyapunov
    from .scans import scan as scan
    from .scans import spectrum as spectrum
    from .scans import sweep as sweep

# Loaded when something of them is first asked for: what simulates is there in half the time
# (0.27 for 0.53 s; matplotlib, which pictures load, takes as long again).
_LATER = {
    "orbit": """
        ORBIT_RESULTS SCENARIOS STABILITY AbstractRootFinder Boundary Branch
        ClosedFormOrbits CodimensionTwo CycleMap Gradient Grazing Newton Orbit
        ResonantGrazing SpecialPoint boundary closed_form_orbits continue_orbit cycle_map
        distinct_orbits find_orbit grazing resonant_grazings
    """,
    "robust": """
        EdgeState Manifold MinimalKick edge_state manifold minimal_kick
    """,
    "scans": """
        REGIMES AbstractMeasure AllOrbits Attractor BasinEntropy Basins Density Escape
        Exponent Integrity IntegrityProfile Lyapunov Regime ScanInterrupted Sections
        Statistics Sweep Uncertainty all_orbits basins escape_rate integrity_profile
        lyapunov scan spectrum sweep
    """,
    "plot": """
        animate plot_basins plot_boundary plot_branch plot_grazing plot_history
        plot_integrity plot_manifold plot_multipliers plot_phase_portrait plot_regimes
        plot_sketch plot_style plot_sweep save_picture
    """,
}
_HOME = {name: package for package, names in _LATER.items() for name in names.split()}


def __getattr__(name: str):
    """What is loaded later, when it is first asked for."""
    if name == "__version__":
        return _version.installed_version()
    if name in ("machines", "plot"):
        return importlib.import_module(f".{name}", __name__)
    if name in _HOME:
        value = getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)
        return globals().setdefault(name, value)
    if name in _NEW_NAMES:
        raise AttributeError(f"`vi_jax.{name}` is called `vi_jax.{_NEW_NAMES[name]}` now.")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    """What this package offers: its names and the packages of ready parts."""
    loaded = (
        name
        for name, value in globals().items()
        if not name.startswith("_") and not isinstance(value, types.ModuleType)
    )
    return sorted({*loaded, *_HOME, "__version__", "machines", "plot"})
