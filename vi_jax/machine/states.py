"""States of the paper's scene."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import ClassVar

from jaxtyping import Array, Float

from .shown import Shown

# The units of the paper's scene, by names of quantities, of components of a state and of numbers.
UNITS: Mapping[str, str] = MappingProxyType({
    "position": "a", "velocity": "a ω", "time": "1/ω", "rate": "ω", "energy": "m_C a² ω²",
    "power": "m_C a² ω³", "Y": "a", "V": "a ω", "W": "ω", "M": "J ω²", "phase": "rad",
    "gap": "a", "frequency_ratio": "ω", "no_load_speed": "ω", "electrical_time": "1/ω",
    "section_phase": "rad", "": "1",
})  # fmt: skip

Number = Float[Array, "..."]


class OscillatorState(Shown):
    """State of an ideally driven scene, or of another machine, whose units are its own."""

    Y: Number
    """Position of the body (unit: a)."""
    V: Number
    """dY/dτ (unit: a ω)."""


class MotorState(OscillatorState):
    """State of a motor scene whose independent variable is the crank angle."""

    units: ClassVar = UNITS
    W: Number
    """Speed of the crank dφ/dτ (unit: ω)."""


class TimedMotorState(MotorState):
    """State of a motor scene whose independent variable is time."""

    phase: Number
    """Crank angle since the last section (radians)."""


class DCMotorState(MotorState):
    """State of a scene with a `DCMotor` whose independent variable is the crank angle."""

    M: Number
    """Torque of the motor, which its armature current gives (unit: J ω²)."""


class TimedDCMotorState(DCMotorState):
    """State of a scene with a `DCMotor` whose independent variable is time."""

    phase: Number
    """Crank angle since the last section (radians)."""
