"""A solution of an orbit's equations as data."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._programs import compiled
from .._types import Scalar, State
from ..flow import simulate
from ..machine import frequency_ratio, phase_at, with_modes
from ._corrector import Step
from ._shooting import Shooting, Unknowns
from .results import ORBIT_RESULTS, Orbit

# Impacts of a cycle that are listed, hops of a chatter included: a choice. Others are counted only.
_LISTED = 32


class Hits(NamedTuple):
    """The impacts of a motion; of one that rests as the simulator finds them, hops included."""

    clock: np.ndarray
    """Clock of each impact that is listed, since the section."""
    speed: np.ndarray
    """V⁻ of each."""
    stop: np.ndarray
    """Number of the rigid stop of each."""
    number: int
    """How many there are in the period."""


@compiled
def _sections(problem: Shooting, x: Array):
    states = jax.vmap(lambda leg, s: problem.state_at(x, leg, s))(*problem.sections(x))
    return states, jnp.max(jnp.abs(problem.lacks(x)))


def sections_of(problem: Shooting, x: Unknowns) -> tuple[State, Scalar]:
    """The states on the sections of a solution, leaves (cycles,), and the largest component of its
    residual."""
    return _sections(problem, jnp.asarray(x))


def _first(problem: Shooting, x: Unknowns, sections: State | None = None) -> State:
    """The state on the first section of a solution, with the machine's own modes."""
    sections = sections_of(problem, x)[0] if sections is None else sections
    modes = problem.own_modes(int(problem.sections(jnp.asarray(x))[0][0]))
    return with_modes(jax.tree.map(lambda x: x[0], sections), modes)


def hits_of(problem: Shooting, step: Step, state: State | None = None) -> Hits:
    """The impacts of a solution, whose state on the section may be known."""
    if problem.landings:
        state = _first(problem, step.x) if state is None else state
        count, *listed = map(np.asarray, _simulated(problem, jnp.asarray(step.x), state))
        clock, speed, stop = (a[listed[2] >= 0] for a in listed)
        return Hits(clock, speed, stop.astype(np.int32), int(count))
    # Along a branch an impact may move past the section: an orbit's clocks lie within its period.
    impacts, (clock, _, period) = np.asarray(problem.impacts, int), problem.values(step.x)
    stops = np.asarray([problem.events[i].number for i in impacts], np.int32)
    speed = np.asarray(step.seen.approach)[impacts]
    return Hits(np.mod(clock[impacts], period), speed, stops, len(impacts))


@compiled
def _simulated(problem: Shooting, x: Array, state: State) -> tuple[Array, ...]:
    """Number, clock, V⁻ and stop of the impacts."""
    machine, cycles = problem.at(x), problem.cycles
    run = simulate(machine, state, cycles, method=problem.method, impact_log=_LISTED, rests=True)
    log = run.impact_log
    assert log is not None
    begins = jnp.asarray(machine.cycle, x.dtype) * jnp.arange(cycles)
    clock = (log.phase + begins[:, None]).ravel()
    return jnp.sum(run.impacts), clock, log.speed.ravel(), log.stop.ravel()


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


def orbit_of(problem: Shooting, step: Step) -> Orbit:
    seen, machine = step.seen, problem.at(step.x)
    sections, residual = sections_of(problem, step.x)
    state = _first(problem, step.x, sections)
    admissible = seen.admissible(range(len(problem.events)))
    hits = hits_of(problem, step, state)
    order = np.argsort(hits.clock)
    duration = jnp.asarray(seen.duration)
    return Orbit(
        machine=machine,
        method=problem.method,
        state=state,
        sections=sections,
        cycles=jnp.asarray(problem.cycles, jnp.int32),
        duration=duration,
        frequency_ratio=frequency_ratio(machine, duration / problem.cycles),
        impact_phase=jnp.asarray(phase_at(machine, hits.clock[order])),
        impact_speed=jnp.asarray(hits.speed[order]),
        impact_stop=jnp.asarray(hits.stop[order]),
        impacts=jnp.asarray(hits.number, jnp.int32),
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
