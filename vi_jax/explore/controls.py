"""The numbers that the page's sliders change, and the scenes made of them."""

from collections.abc import Mapping
from math import isfinite
from typing import Any, NamedTuple

from ..machine import Parameters, Scene


class Control(NamedTuple):
    """One slider: its label, its range, its step and where it begins."""

    label: str
    low: float
    high: float
    step: float
    value: float
    """The value that it has when the page opens."""

    def nearest(self, value: float) -> float:
        """The place of the slider next to a value; for NaN the one where it begins."""
        if not isfinite(value):
            return self.value
        steps = round((min(max(value, self.low), self.high) - self.low) / self.step)
        return round(self.low + steps * self.step, 6)

    def holds(self, value: object) -> bool:
        """Whether this is a number that the slider can be at."""
        if not isinstance(value, int | float):
            return False
        return self.low - _ROUNDING <= value <= self.high + _ROUNDING


# Rounding error of places reached in steps.
_ROUNDING = 1e-9

NUMBERS: Mapping[str, Control] = {
    "frequency_ratio": Control("frequency ratio ζ", 0.3, 2.5, 0.002, 0.9),
    "restitution": Control("restitution k", 0.0, 1.0, 0.005, 0.5),
    "gap": Control("gap d (a)", 0.0, 5.0, 0.01, 2.0),
    "damping_ratio": Control("damping ratio ξ", 0.0, 0.2, 0.001, 0.01),
}
"""Sliders of the arguments of `Scene.ideal`."""

_START = {
    "Y": Control("start Y (a)", -6.0, 5.0, 0.02, 0.0),
    "V": Control("start V (a ω)", -6.0, 6.0, 0.02, 0.0),
    "settle": Control("cycles before", 0.0, 2000.0, 10.0, 1000.0),
}

IDEAL: Mapping[str, Control] = {**NUMBERS, **_START}
"""Sliders of the ideal drive."""

MOTOR: Mapping[str, Control] = {
    "torque": Control("torque T0 (N·m)", 0.05, 15.0, 0.05, 1.0),
    "control": Control("control κ", 0.3, 2.5, 0.005, 0.9),
    "restitution": Control("restitution k", 0.0, 1.0, 0.005, 0.5),
    "gap": Control("gap Δ (m)", 0.0, 0.2, 0.001, 0.08),
    "damping": Control("damping c (N·s/m)", 0.0, 3.0, 0.02, 0.5),
    "W": Control("crank speed at the start (ω)", 0.1, 2.5, 0.01, 0.9),
    **_START,
    "settle": Control("cycles before", 0.0, 1000.0, 10.0, 300.0),
}
"""Sliders of the motor, in SI units as in Table 1 of the paper; the start is dimensionless."""


def beginning(controls: Mapping[str, Control]) -> dict[str, float]:
    """The values of sliders when the page opens, by the names of the numbers."""
    return {name: control.value for name, control in controls.items()}


def fault(controls: Mapping[str, Control], values: Mapping[str, Any]) -> str | None:
    """What is wrong with values that did not come from the sliders, in a sentence; else `None`."""
    for name, control in controls.items():
        if not control.holds(values.get(name)):
            return (
                f"The {control.label} must be a number from {control.low:g} to {control.high:g}, "
                f"but is {values.get(name)!r}."
            )
    return None


def ideal(values: Mapping[str, float]) -> tuple[Scene, Any]:
    """Scene and start with the ideal drive."""
    numbers: dict[str, Any] = {name: float(values[name]) for name in NUMBERS}
    scene = Scene.ideal(**numbers)
    return scene, scene.start(Y=float(values["Y"]), V=float(values["V"]))


def motor(values: Mapping[str, float]) -> tuple[Scene, Any]:
    """Scene and start with a motor."""
    names = [name for name in MOTOR if name not in ("W", *_START)]
    scene = Parameters(**{name: float(values[name]) for name in names}).scene()
    Y, V, W = (float(values[name]) for name in "YVW")
    return scene, scene.start(Y=Y, V=V, W=W)
