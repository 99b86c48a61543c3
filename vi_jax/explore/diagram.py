"""A bifurcation diagram that is computed while a slider moves: all its values at once."""

import functools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from .._programs import compiled
from ..flow import simulate
from ..machine import OscillatorState, Scene
from ..scans import taken_along

VALUES, SETTLE, CYCLES = 281, 250, 16
"""Values across a diagram, drive cycles before what is drawn, and drive cycles drawn."""

SHOWN = {
    "min Y in a cycle": "y_min",
    "Y on the section": "Y",
    "V on the section": "V",
    "greatest V⁻ in a cycle": "impact_speed",
}
"""What can be drawn upwards: its name on the page, and the array of a `Diagram`."""


class Diagram(NamedTuple):
    """What motions from one start settle on, over one number; arrays of shape (values, cycles)."""

    parameter: str
    values: np.ndarray
    Y: np.ndarray
    V: np.ndarray
    y_min: np.ndarray
    impact_speed: np.ndarray

    def nearest(self, value: float) -> float:
        """The value of the diagram next to a place on it."""
        return float(self.values[np.argmin(abs(self.values - value))])


def diagram(
    numbers: Mapping[str, float], parameter: str, bounds: tuple[float, float], *, Y: float, V: float
) -> Diagram:
    """Bifurcation diagram of the ideal scene over one of its numbers, each value from one start.

    **Arguments:** the numbers of `Scene.ideal`; the name of the one that changes; its least and
    greatest value; the start.
    """
    fixed = {name: float(value) for name, value in numbers.items() if name != parameter}
    return _diagram(tuple(fixed.items()), parameter, bounds, Y, V)


@functools.lru_cache(maxsize=8)  # moving the slider along the diagram needs no new one
def _diagram(
    fixed: tuple[tuple[str, float], ...],
    parameter: str,
    bounds: tuple[float, float],
    Y: float,
    V: float,
) -> Diagram:
    """The diagram, remembered.

    **Arguments:** `fixed`, names and values of the numbers that stay as they are; all else as for
    `diagram`.
    """
    values = np.linspace(*bounds, VALUES)
    rows = {name: np.full(VALUES, value) for name, value in fixed} | {parameter: values}
    found = _settled(rows, np.asarray(float(Y)), np.asarray(float(V)))
    return Diagram(parameter, values, *map(np.asarray, found))


@compiled
def _settled(rows: Any, Y: Any, V: Any) -> tuple[jax.Array, ...]:
    def one(numbers):
        scene = Scene.ideal(**numbers)
        start = taken_along(scene, OscillatorState(Y, V))
        run = simulate(scene, start, CYCLES, settle=jnp.asarray(float(SETTLE)))
        assert run.y_min is not None and run.impact_speed is not None
        return run.sections.Y[1:], run.sections.V[1:], run.y_min, run.impact_speed

    return jax.vmap(one)(rows)
