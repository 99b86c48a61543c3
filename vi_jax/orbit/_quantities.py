"""Numbers of a motion by name, as functions of its unknowns that can be differentiated: what a
branch can be asked for extremes of."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._programs import compiled
from .._types import Scalar, State, Vector
from ..flow import average_names, quantities_on, quantity_names
from ..machine import components
from ._observed import Observed
from ._shooting import Shooting

_SECTION = "section_"


def names_of(problem: Shooting) -> tuple[str, ...]:
    """The numbers of a motion that these equations tell, those of the machine's own included."""
    found = ["y_min", "y_max", "clearance", "duration", "multiplier"]
    if problem.machine.frequency_ratio(jnp.ones(())) is not None:
        found.append("frequency_ratio")
    if problem.impacts or not problem.follows_events:
        found += ["fastest_impact", "slowest_impact"]
    found += average_names(problem.machine, problem.like)
    own = (*components(problem.like), *quantity_names(problem.machine, problem.like))
    return (*found, *(_SECTION + name for name in own))


def quantity_of(problem: Shooting, x: Vector, seen: Observed, name: str) -> Scalar:
    """A number of a motion, one of `names_of`.

    **Arguments:** the equations; a solution, and what is observed of it; the name.
    """
    if name in seen.averages:
        return seen.averages[name]
    if name in ("y_min", "y_max", "duration"):
        return getattr(seen, name)
    if name == "clearance":
        return seen.nearest.room
    if name == "multiplier":
        return jnp.abs(seen.multipliers[0])
    if name == "frequency_ratio":
        ratio = problem.at(x).frequency_ratio(seen.duration / problem.cycles)
        return jnp.asarray(ratio, x.dtype)
    if name in ("fastest_impact", "slowest_impact"):
        speeds = _speeds(problem, seen)
        return jnp.nanmax(speeds) if name == "fastest_impact" else jnp.nanmin(speeds)
    state = _on_section(problem, x)
    inner = name.removeprefix(_SECTION)
    there = components(state)
    if inner in there:
        return jnp.asarray(there[inner])
    row = jax.tree.map(lambda a: jnp.asarray(a)[None], state)
    return quantities_on(problem.at(x), row)[inner][0]


def _speeds(problem: Shooting, seen: Observed) -> Array:
    """V⁻ of each impact; NaN where there is none."""
    if seen.counted is not None:
        return seen.counted.speed
    return seen.approach[np.asarray(problem.impacts, int)]


def _on_section(problem: Shooting, x: Vector) -> State:
    """The state on the first section of a solution."""
    clock, states = problem.parts(x)
    if not problem.events:
        return problem.unravel(states[0])
    begins = [i for i, event in enumerate(problem.events) if event.cycle is not None]
    if begins:
        return problem.state_at(x, begins[0], clock[begins[0]])
    place = clock[0] + jnp.mod(-clock[0], problem.period(x))
    leg = jnp.searchsorted(clock, place, side="right") - 1
    return problem.state_at(x, leg, place)


@compiled
def rates_at(
    problem: Shooting, names: tuple[str, ...], x: Vector, direction: Vector
) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
    """Numbers of a motion, and how they change where its unknowns go in a direction."""

    def values(x):
        seen = problem.observe(x)
        return {name: quantity_of(problem, x, seen, name) for name in names}

    return jax.jvp(values, (x,), (direction,))
