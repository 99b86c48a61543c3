"""The last part of a way to an event, as `drift` asks for it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._lane import Lane, Plan
from ..moving import Moving
from .trial import Crossing, Trial

Scalar = Float[Array, ""]


class Way(NamedTuple):
    """What `drift` asks for."""

    moving: tuple[Scalar, Any, Scalar | None]
    fixed: Any
    rest: Any
    rate: Callable
    guards: tuple[Callable, ...]
    """Of each crossing."""
    places: tuple[Callable, ...]
    """Of each coordinate."""


def way_of(plan: Plan, lane: Lane, trial: Trial, time: Scalar | None) -> Way:
    """The way from the end of a step that was tried, with the elapsed time if it is asked for.

    Its functions close over no number: everything that may have a derivative is an argument.
    """
    given = trial.holding, plan.end(lane.part)
    fixed, others = eqx.partition(given, eqx.is_inexact_array)
    rest, static = eqx.partition(others, eqx.is_array)

    def rate(moving, fixed, rest):
        (machine, _), (s, state, time) = eqx.combine(fixed, rest, static), moving
        pace = None if time is None else machine.pace(s, state)
        if time is not None and pace is None:
            pace = jnp.ones_like(s)
        return jnp.ones_like(s), machine.field(s, state), pace

    def guard(c: Crossing) -> Callable:
        def event(moving, fixed, rest):
            (machine, bound), (s, state, _) = eqx.combine(fixed, rest, static), moving
            scene = _whole(machine)
            if c.kind == "stop":
                stop = scene.stops[c.number]
                return stop.beyond(place(stop.coordinate)(moving, fixed, rest))
            if c.kind == "switch":
                mode = machine.modes[c.number]
                return scene.switches[c.number].guard(scene, s, state, mode)
            section: Any = scene.section(state)
            return scene.clock(state) - bound if section is None else section

        return event

    def place(k: int) -> Callable:
        def coordinate(moving, fixed, rest):
            machine, _ = eqx.combine(fixed, rest, static)
            return _whole(machine).coordinates[k].position(moving[1])

        return coordinate

    moving = trial.s, trial.state, time
    around: list[Any] = []

    def pure(function: Callable) -> Callable:
        # A scene may be written as a function of numbers around it.
        written, found = jax.closure_convert(function, moving, fixed, rest)
        here = slice(len(around), len(around) + len(found))
        around.extend(found)
        return lambda moving, fixed, rest: written(moving, fixed[0], rest, *fixed[1][here])

    whole = pure(rate)
    guards = tuple(pure(guard(c)) for c in trial.crossings)
    places = tuple(pure(place(k)) for k in range(len(trial.paths)))
    return Way(moving, (fixed, around), rest, whole, guards, places)


def _whole(machine: Any) -> Any:
    return machine.scene if isinstance(machine, Moving) else machine
