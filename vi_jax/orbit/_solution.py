"""A solution of an orbit's equations as data."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._checks import count
from .._programs import compiled
from .._types import Scalar, State
from ..flow import simulate
from ..machine import frequency_ratio, phase_at, with_modes
from ._corrector import Step
from ._shooting import Shooting
from .results import ORBIT_RESULTS, Orbit

# Impacts of a cycle that are listed, hops of a chatter included: a choice. Others are counted only.
_LISTED = 32


class Counted(NamedTuple):
    """The impacts of a motion that rests, as the simulator finds them."""

    impacts: Int[Array, ""]
    """Their number in the period, hops of a chatter included."""
    clock: Float[Array, " log"]
    """Clock of each impact since the section; NaN where there is none."""
    speed: Float[Array, " log"]
    """V⁻ of each."""
    stop: Int[Array, " log"]
    """Number of the rigid stop of each, -1 where there is none."""


@compiled
def _compiled_sections(problem, x):
    states = jax.vmap(lambda leg, s: problem.state_at(x, leg, s))(*problem.sections(x))
    return states, jnp.max(jnp.abs(problem.lacks(x)))


def _clock_of(problem: Shooting, x: Array) -> tuple[np.ndarray, float]:
    """Clock of each event, and the period by the clock."""
    return np.asarray(problem.parts(x)[0])[: len(problem.events)], float(problem.period(x))


def sections_of(problem: Shooting, x: np.ndarray | Array) -> tuple[State, Scalar]:
    """The states on the sections of a solution, leaves (cycles,), and the largest component of its
    residual."""
    return _compiled_sections(problem, jnp.asarray(x))


def _own_modes(problem: Shooting, x: Array) -> tuple[Array, ...]:
    """The machine's own modes on the first section of a solution."""
    return problem.own_modes(int(problem.sections(x)[0][0]))


def counted_of(problem: Shooting, step: Step, state: State | None = None) -> Counted:
    """The impacts of a motion that rests.

    **Arguments:** its bare state on the section, if that is known.
    """
    x = jnp.asarray(step.x)
    state = _first(problem, x) if state is None else with_modes(state, _own_modes(problem, x))
    return jax.tree.map(np.asarray, _simulated(problem, x, state))


def _first(problem: Shooting, x: Array) -> State:
    """The state on the first section of a solution, with the machine's own modes."""
    state = jax.tree.map(lambda x: x[0], sections_of(problem, x)[0])
    return with_modes(state, _own_modes(problem, x))


@compiled
def _simulated(problem: Shooting, x: Array, state: State) -> Counted:
    machine, cycles = problem.at(x), problem.cycles
    run = simulate(machine, state, cycles, method=problem.method, impact_log=_LISTED, rests=True)
    log = run.impact_log
    assert log is not None
    begins = jnp.asarray(machine.cycle, x.dtype) * jnp.arange(cycles)
    clock = (log.phase + begins[:, None]).ravel()
    return Counted(jnp.sum(run.impacts), clock, log.speed.ravel(), log.stop.ravel())


def energies_of(problem: Shooting, steps: Sequence[Step]) -> np.ndarray:
    """The energy that impacts take in a cycle, in the mean of the period, at each step."""
    xs = [jnp.asarray(step.x) for step in steps]
    states = jax.tree.map(lambda *x: jnp.stack(x), *(_first(problem, x) for x in xs))
    return np.asarray(_lost(problem, jnp.stack(xs), states))


@compiled
def _lost(problem: Shooting, xs: Array, states: State) -> Array:
    def one(x, state):
        run = simulate(problem.at(x), state, problem.cycles, method=problem.method)
        assert run.impact_energy is not None
        return jnp.mean(run.impact_energy)

    return jax.vmap(one)(xs, states)


def _impacts_of(
    problem: Shooting, step: Step, clock: np.ndarray, period: float, state: State
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Clock within the period, V⁻ and stop of each impact that is listed, and their number."""
    if problem.landings:
        counted = counted_of(problem, step, state)
        listed = np.asarray(counted.stop) >= 0
        clock, speed, stop = (
            np.asarray(a)[listed] for a in (counted.clock, counted.speed, counted.stop)
        )
        return clock, speed, stop.astype(np.int32), int(counted.impacts)
    impacts = np.asarray(problem.impacts, int)
    stops = np.asarray([problem.events[i].number for i in impacts], np.int32)
    return (
        np.mod(clock[impacts], period),
        np.asarray(step.seen.approach)[impacts],
        stops,
        len(impacts),
    )


def orbit_at(problem: Shooting, steps: Sequence[Step], index: int) -> Orbit:
    """The solution at one of the steps; a negative `index` counts from the end."""
    many = len(steps)
    return orbit_of(problem, steps[count("index", index, least=-many, most=many - 1)])


def orbit_of(problem: Shooting, step: Step) -> Orbit:
    """The solution at a step as an `Orbit`."""
    x, seen = jnp.asarray(step.x), step.seen
    machine = problem.at(x)
    clock, period = _clock_of(problem, x)
    sections, residual = sections_of(problem, x)
    admissible = seen.admissible(range(len(problem.events)))
    # Along a branch an impact may move past the section: an orbit's clocks lie within its period.
    state = jax.tree.map(lambda x: x[0], sections)
    within, speeds, stops, count = _impacts_of(problem, step, clock, period, state)
    order = np.argsort(within)
    since = phase_at(machine, within[order])
    duration = jnp.asarray(seen.duration)
    return Orbit(
        machine=machine,
        method=problem.method,
        state=with_modes(state, _own_modes(problem, x)),
        sections=sections,
        cycles=jnp.asarray(problem.cycles, jnp.int32),
        duration=duration,
        frequency_ratio=frequency_ratio(machine, duration / problem.cycles),
        impact_phase=jnp.asarray(since),
        impact_speed=jnp.asarray(speeds[order]),
        impact_stop=jnp.asarray(stops[order]),
        impacts=jnp.asarray(count, jnp.int32),
        rests=jnp.asarray(len(problem.landings), jnp.int32),
        y_min=jnp.asarray(seen.y_min),
        y_max=jnp.asarray(seen.y_max),
        clearance=jnp.asarray(seen.nearest.room),
        monodromy=jnp.asarray(seen.monodromy),
        multipliers=jnp.asarray(seen.multipliers),
        residual=residual,
        error=jnp.asarray(step.size),
        iterations=jnp.asarray(step.iterations, jnp.int32),
        history=jnp.zeros((0,)),
        result=ORBIT_RESULTS.successful if admissible else ORBIT_RESULTS.inadmissible,
        averages={name: jnp.asarray(x) for name, x in seen.averages.items()},
    )
