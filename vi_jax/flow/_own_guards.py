"""Guards that are never negative, so that their events never happen."""

import functools

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer

from .._messages import warn
from .._types import Scalar, State
from ..machine import AbstractMachine, begin_modes, events_of, guard_of
from ._by_numpy import by_numpy

# So many states are tried, with modes among these beside those that a motion begins with, and
# places at these distances from the start (beside 1 + its size): choices.
_TRIED, _MODES, _FAR = 48, (-1.0, 0.0, 1.0), (0.1, 1.0, 10.0)


def check_guards(machine: AbstractMachine, start: State) -> None:
    """Warn once of an event whose guard is never below zero, as far as states around the start
    tell; machines whose numbers are traced are not looked at, nor are ours."""
    kind, leaves = type(machine), jtu.tree_leaves((machine, start))
    ours = kind.__module__.partition(".")[0] == __name__.partition(".")[0]
    if ours or not machine.others or any(isinstance(x, Tracer) for x in leaves):
        return
    try:
        cycle, *modes = by_numpy(_begins, machine, start)
        risen = [True] * len(machine.others)
        for s, state, now in _around(cycle, start, modes):
            values = by_numpy(_guards, machine, s, state, tuple(now))
            risen = [up and not x < 0 for up, x in zip(risen, values, strict=True)]
            if not any(risen):
                return
    except Exception:  # said in words where the guard is traced
        return
    for i in np.flatnonzero(risen):
        _warn_of_guard(kind, int(i), machine.others[i].name or type(machine.others[i]).__name__)


def _begins(machine: AbstractMachine, start: State) -> list[Scalar]:
    """The cycle, and the modes of a motion that begins in `start`."""
    zero = jnp.zeros_like(machine.position(start))
    return [zero + machine.cycle, *begin_modes(machine, zero, start)]


def _guards(machine: AbstractMachine, s: Scalar, state: State, modes: tuple) -> list[Scalar]:
    first = len(machine.stops) + len(machine.switches)
    events = range(first, len(events_of(machine)) - 1)
    return [guard_of(machine, number, s, state, modes) for number in events]


def _around(cycle, start: State, modes: list):
    """Values of s, states and modes, the start first."""
    random, held = np.random.default_rng(0), start
    yield np.zeros_like(cycle), start, modes
    for n in range(_TRIED):
        far = _FAR[n % len(_FAR)]

        def moved(x, far: float = far):
            size = far * (1 + np.abs(x))
            return np.asarray(x + size * random.standard_normal(np.shape(x)), np.asarray(x).dtype)

        now = [random.choice((float(m), *_MODES)).astype(cycle.dtype) for m in modes]
        s = np.asarray(cycle * random.uniform(), cycle.dtype)
        yield s, jtu.tree_map(moved, held), now


@functools.lru_cache(maxsize=64)
def _warn_of_guard(kind: type, i: int, name: str) -> None:
    warn(
        f"The guard of event {i} ({name}) of a {kind.__name__} was not below zero in any of "
        f"{_TRIED + 1} states around the start, and an event whose guard is never negative never "
        "happens. Return a number that is negative before the event and positive after it: "
        "`x - 1`, not `jnp.maximum(x - 1, 0)`."
    )
