"""What is integrated beside the state: the elapsed time, and the machine's averages over it.

Neither is part of the state, and nothing that moves depends on them; but a method carries them with
its own accuracy, and an event that is landed upon ends them with its derivatives.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp

from .._types import Scalar, State
from .smooth import SmoothMachine


class Beside(NamedTuple):
    """What has passed since the last record point."""

    time: Scalar | None
    """Elapsed time; absent where every cycle takes the same."""
    integrals: dict[str, Scalar]
    """Of each of the machine's averages, by name, its integral over time; where the machine has no
    `pace`, over s."""


def rate_beside(
    smooth: SmoothMachine, s: Scalar, state: State, beside: Beside | None
) -> Beside | None:
    """d/ds of what is integrated beside the state, the elapsed time and the averages; `None` where
    neither is.

    **Arguments:** `smooth`, the machine in its modes (so that its averages are asked with these);
    `beside`, what is integrated, for its structure.
    """
    if beside is None:
        return None
    pace, integrals = smooth.pace(s, state), {}
    if beside.integrals:
        for name, value in smooth.averages(s, state).items():
            value = jnp.asarray(value, s.dtype)
            integrals[name] = value if pace is None else pace * value
    time = beside.time
    if time is not None:
        time = jnp.ones_like(s) if pace is None else pace
    return Beside(time, integrals)


def elapsed(old: Beside, carried: Beside | None, h: Scalar) -> Beside:
    """Time and integrals after a step.

    **Arguments:** `old`, before it; `carried`, what the method integrated along with the state,
    `None` if nothing; `h`, the step's length, which is the time where s measures that.
    """
    time = None if carried is None else carried.time
    if time is None and old.time is not None:
        time = old.time + h
    return Beside(time, {} if carried is None else carried.integrals)


def means(integrals: dict[str, Any], duration: object) -> dict[str, Any]:
    """The averages of the integrals over this duration."""
    return {name: x / duration for name, x in integrals.items()}
