"""States of the paper's scene."""

import equinox as eqx
from jaxtyping import Array, Float

Number = Float[Array, "..."]


class OscillatorState(eqx.Module):
    """State of an ideally driven scene."""

    Y: Number
    """Position of the body (unit: a)."""
    V: Number
    """dY/dτ (unit: a ω)."""


class MotorState(OscillatorState):
    """State of a motor scene whose independent variable is the crank angle."""

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


# The states of motors, and what they are called where time is the independent variable.
TIMED = {MotorState: TimedMotorState, DCMotorState: TimedDCMotorState}
