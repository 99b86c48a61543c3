"""Schematics of machines: each part drawn where it is."""

from math import pi
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .._checks import instance_of
from .._types import State
from ..machine import AbstractMachine, ShaftMachine, adopt
from .motion import all_stops, new_axes
from .pen import Pen


def sketch(machine: AbstractMachine, pen: Pen, state: State, phase: float) -> None:
    """Draw a machine in a state: by its own `sketch(pen, state, phase)`, if it has one."""
    own = getattr(machine, "sketch", None)
    if own is not None:
        own(pen, state, phase)
    else:
        _bodies(machine, pen, state)


def plot_sketch(
    machine: AbstractMachine, state: State = None, *, phase: Any = None, ax: Axes | None = None
) -> Axes:
    """Draw a schematic of a machine with the names of its parts.

    A machine of your own is drawn by its method `sketch(pen, state, phase)`, if it has one: `pen`
    (a `vi_jax.plot.Pen`) draws bodies, springs and walls. Otherwise its bodies are drawn between
    their stops.

    **Arguments:**

    - `machine`: the machine.
    - `state`: the state to draw; by default its own start.
    - `phase`: the reading of its clock, by default 0; where a shaft turns its angle, by default
      0.3π.
    - `ax`: axes to draw into; a new figure if left out.

    **Returns:** the axes.
    """
    instance_of("machine", machine, AbstractMachine, "a `Scene` or an `AbstractMachine`")
    state = machine.start() if state is None else adopt(machine, state)
    if phase is None:  # a crank or a rotor is shown turned out of line
        phase = 0.3 * pi if isinstance(machine, ShaftMachine) else 0.0
    ax = new_axes(ax)
    sketch(machine, pen_for(machine, ax, _positions(machine, state), labels=True), state, phase)
    ax.set_aspect("equal", adjustable="datalim")
    ax.axis("off")
    ax.margins(0.06)
    return ax


def _positions(machine: AbstractMachine, state: State) -> np.ndarray:
    return np.array([float(c.position(state)) for c in machine.coordinates])


def pen_for(
    machine: AbstractMachine, ax: Axes, positions: np.ndarray, *, labels: bool = False
) -> Pen:
    """A pen whose reach holds these positions and the stops."""
    stops = [abs(float(stop.place)) for stop in all_stops(machine)]
    reach = max(0.0, *map(float, np.abs(positions).ravel()), *stops) or 1.0
    return Pen(ax, reach=reach, size=0.35 * reach, labels=labels)


def _bodies(machine: AbstractMachine, pen: Pen, state: State) -> None:
    """Every coordinate as a body between its stops, one below the other."""
    size = pen.size
    for i, place in enumerate(_positions(machine, state)):
        row = -2.2 * size * i
        ends = pen.reach + 1.4 * size
        pen.floor(-ends, ends, row - 0.5 * size)
        pen.body(place, row, width=size)
        for stop in all_stops(machine, i):
            pen.stop(stop, row=row)
        pen.mark(0.0, row - 0.5 * size, row + 1.1 * size)
        pen.mark(place, row, row + 1.1 * size)
        if place:
            pen.length(0.0, place, row + size, machine.labels[0], down=0.25 * size)
