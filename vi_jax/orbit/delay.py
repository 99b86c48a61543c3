"""Periodic motions of machines with delays: by a chain, checked by a run with the whole history."""

import dataclasses
from typing import Any

import jax
import numpy as np

from .._checks import from_host, is_traced, on_host
from .._programs import compiled
from ..flow import history_of_function, simulate, sizes_on_host, unit_of
from ..machine import (
    AbstractMachine,
    HybridState,
    delay_chain,
    has_delays,
    history_in,
    in_rows,
    is_autonomous,
    longest_delay,
    machine_of_chain,
    modes_of,
    without_modes,
)
from .cycle_map import axes_of
from .results import Orbit, distance
from .tolerances import SAME

# The pieces of polynomials of degree 7 for a chain's history: a choice, far more accurate than it.
_PIECES, _ROOM = 64, 1025

# A run of a stable motion ends when differences at its start are the share `SAME` of themselves,
# after at most so many periods more: a choice.
_MOST_PERIODS = 400


def as_chain(machine: AbstractMachine, guess: Any) -> tuple[AbstractMachine, Any]:
    """Return a machine with delays as a chain with the default number of nodes, and a guess of its
    orbits as a state of the chain; another machine and its guess unchanged."""
    if not has_delays(machine):
        return machine, guess
    if guess is None or isinstance(guess, Orbit):
        return delay_chain(machine), guess
    state = without_modes(guess)
    is_batch = axes_of(machine, state) > 0
    first = jax.tree.map(lambda x: x[0], state) if is_batch else state
    chain: Any = delay_chain(machine, start=first)
    return chain, (jax.vmap(chain.chained) if is_batch else chain.chained)(guess)


def with_delay_error(orbit: Orbit) -> Orbit:
    """Return a single orbit of a chain with its difference from a run with the whole history."""
    chain: Any = orbit.machine
    machine = machine_of_chain(chain)
    if machine is None or is_traced(orbit):
        return orbit
    if orbit.residual.ndim or not bool(orbit.successful):
        return orbit
    state, cycles = without_modes(orbit.state), int(orbit.cycles)
    history = _history_of_chain(chain, orbit.state)
    # The run begins with the polynomial of the nodes, in which kinks are smooth. A stable motion
    # forgets them; from an unstable one the run departs, and one longest delay must do.
    largest = float(np.abs(orbit.multipliers).max())
    periods = 1 + int(np.ceil(float(longest_delay(machine)) / float(orbit.duration)))
    if largest < 1:
        periods += int(min(np.log(SAME) / np.log(max(largest, 1e-3)), _MOST_PERIODS))
    own = chain._past.own(state)
    start = HybridState(own, modes_of(orbit.state) or (), history)
    hits = bool((np.asarray(orbit.impact_speed) > 0).any())
    record = "motion" if hits or is_autonomous(chain, state) else "sections"
    run = simulate(machine, start, periods * cycles, method=orbit.method, record=record)
    last, row = in_rows(on_host(run.sections))[-1], in_rows(on_host(own), 0)
    sizes = sizes_on_host(chain, state, in_rows(on_host(state), 0))
    error = distance(last, row, sizes[: row.size])
    if run.duration is not None:  # on a section one number of the state is always the same
        duration = np.asarray(run.duration)[-cycles:].sum()
        error = np.maximum(error, abs(duration / np.asarray(orbit.duration) - 1))
    if hits and run.impact_speed is not None:  # a body that rests on the section has no error there
        fastest = np.asarray(run.impact_speed)[-cycles:].max() / np.nanmax(orbit.impact_speed)
        error = np.maximum(error, abs(fastest - 1))
    return dataclasses.replace(orbit, delay_error=from_host(error))


@compiled
def _history_of_chain(chain: Any, state: Any) -> Any:
    """Return the history in a state of a chain, for a run of its machine."""
    machine, past = machine_of_chain(chain), history_in(chain, state)
    return history_of_function(machine, past, unit_of(machine), _PIECES, _ROOM)
