"""Methods of integration over one step: Runge–Kutta, power series, closed form; their choice."""

# The names that other packages import.
# ruff: noqa: F401
# fmt: off
from .base import AbstractMethod, Foreseen, Stage, stages_to_step_to
from .choice import MethodLike, chosen, preset
from .exact import ExactFlight
from .runge_kutta import Adaptive, FixedStep, ImplicitSteps
from .taylor import Taylor
