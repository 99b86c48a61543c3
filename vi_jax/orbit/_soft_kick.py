"""What a brief contact does to a motion, by its depth: the discontinuity mapping of a switch.

At a rigid stop it is the root of the depth. A prestressed soft stop has a root as well, by the jump
of its field; of others the field is continuous, and the power depends on the law. It is measured
then, by flights in contact and without.
"""

from math import log2
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from .._programs import compiled
from ..machine import after_event, guard_of
from ._flight import Flight
from ._shooting import Shooting

# A field that differs by less than this (relative to its own size) is continuous where a switch is
# touched: a choice.
_CONTINUOUS = 1e-9

# The first contact lasts so much of a cycle, each further one a quarter of that, at most so many of
# them. Measured powers that agree within this are settled. Steps of a flight. Choices.
_SHARE, _TRIES, _AGREE, _STEPS = 0.02, 6, 0.03, 8


class Kick(NamedTuple):
    """By how much an impact changes the state: vector·(-h)^order, at a fixed reading of the
    clock, h being the least distance that there would be without it."""

    vector: np.ndarray
    order: float


def soft_kick(
    problem: Shooting, x: np.ndarray, number: int, leg: int, clock: float, u: np.ndarray,
    gradient: np.ndarray, fast: np.ndarray, rate: float,
) -> Kick:  # fmt: skip
    """The kick of a switch that a motion grazes.

    **Arguments:** the equations of the motion and their solution; event, leg and clock of the
    touch; the state there, the gradients of the distance h and of dh/ds, and d²h/ds².

    **Raises:** `ValueError` if the field beyond the surface does not turn the motion back.
    """
    at = jnp.asarray(x)
    jump = np.asarray(_jump_of_field(problem, at, number, leg, jnp.asarray(clock), jnp.asarray(u)))
    size = np.abs(jump[0]).max()
    change = jump[1] - jump[0]
    if np.abs(change).max() > _CONTINUOUS * size:
        back = rate + float(fast @ change)
        if back <= 0:
            raise ValueError(
                "Argument `point` must be a grazing of something that lets the motion go again, "
                "but beyond the surface it would stick or go on: d²h/ds² changes from "
                f"{rate:.3g} to {back:.3g}."
            )
        return Kick(2 * np.sqrt(2 * rate) / back * change, 0.5)
    length = _SHARE * float(problem.period(at)) / problem.cycles
    measured: list[tuple[float, np.ndarray]] = []
    orders: list[float] = []
    for _ in range(_TRIES):
        y = length * np.sqrt(rate / 8)
        deep = u - gradient / (gradient @ gradient) * y * y
        measured.append((y, _flown(problem, at, number, leg, clock, jnp.asarray(deep), length)))
        if len(measured) > 1:
            (y0, k0), (y1, k1) = measured[-2:]
            order = log2(np.linalg.norm(k0) / np.linalg.norm(k1)) / log2(y0 / y1) / 2
            orders.append(order)
            if len(orders) > 1 and abs(orders[-1] - orders[-2]) < _AGREE:
                break
        length /= 4
    order = round(2 * orders[-1]) / 2 if abs(orders[-1] % 0.5 - 0.25) > 0.2 else orders[-1]
    (y0, k0), (y1, k1) = measured[-2:]
    first, second = k0 / y0 ** (2 * order), k1 / y1 ** (2 * order)
    # What is left of the first falls by four with the length, as its size does.
    return Kick(second + (second - first) / 3, order)


def _modes(problem: Shooting, machine, number, leg, s, u):
    """The machine's modes before and after the switch."""
    before = problem.modes_in(leg)
    return before, after_event(machine, number, s, problem.unravel(u), before)[1]


@compiled
def _jump_of_field(problem: Shooting, x, number: int, leg, s, u):
    """The field on either side of the surface."""
    machine = problem.at(x)
    modes = _modes(problem, machine, number, leg, s, u)
    flights = [Flight(machine, m, problem.method, problem.like) for m in modes]
    state = problem.unravel(u)
    return jnp.stack([ravel_pytree(flight.smooth.field(s, state))[0] for flight in flights])


@compiled
def _fly(problem: Shooting, x, number: int, leg, touching: bool, s0, s1, u):
    """The state at `s1` and the guard there, in contact or apart."""
    machine = problem.at(x)
    # A body that just comes in: which mode that is, no rounding is to decide.
    modes = _modes(problem, machine, number, leg, s0, u)[int(touching)]
    end = Flight(machine, modes, problem.method, problem.like).fly(s0, s1, u, _STEPS)[0]
    return end, guard_of(machine, number, s1, problem.unravel(end), modes)


def _flown(problem: Shooting, x, number, leg, s, deep, length) -> np.ndarray:
    """The state after a contact, less what it would be without.

    **Arguments:** as `soft_kick`; the state at the greatest depth of the free flight, and how long
    that would be beyond the surface.
    """
    from scipy.optimize import brentq  # slow to load

    def root(function: Any, low: float, high: float) -> float:
        found: Any = brentq(lambda s1: float(function(s1)[1]), low, high, xtol=1e-15)
        return float(found)

    def apart(s1):
        return _fly(problem, x, number, leg, False, jnp.asarray(s), jnp.asarray(s1), deep)

    enters = root(apart, s - length, s)
    begin = apart(enters)[0]

    def inside(s1):
        return _fly(problem, x, number, leg, True, jnp.asarray(enters), jnp.asarray(s1), begin)

    places = enters + length * np.linspace(0, 1.5, 49)[1:]
    values = [float(inside(place)[1]) for place in places]
    below = [i for i, value in enumerate(values) if value < 0]
    first = below[0] if below else 0
    out = next((i for i in range(first, len(values)) if values[i] >= 0), None)
    if out is None:
        raise ValueError(
            "Argument `point` must be a grazing of something that lets the motion go again, but "
            "a brief contact does not end."
        )
    leaves = places[out]
    if out > 0 and values[out - 1] < 0:
        leaves = root(inside, places[out - 1], places[out])
    free = _fly(problem, x, number, leg, False, jnp.asarray(enters), jnp.asarray(leaves), begin)[0]
    return np.asarray(inside(leaves)[0]) - np.asarray(free)
