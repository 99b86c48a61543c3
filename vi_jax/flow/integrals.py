"""Integrals along the motion: the elapsed time, and those of the machine's averages, by name.

They are not part of the state, and nothing that moves depends on them. A method carries them with
its own accuracy, and an event that is landed upon ends them with its derivatives.
"""

from typing import Any

import jax.numpy as jnp

from .._types import Scalar, State
from .smooth import SmoothMachine

Integrals = dict[str, Scalar]
"""Integrals since the last record point: the elapsed time by the name `TIME`, where it is recorded;
of each average, by its name, the integral over time (over s if the machine has no `pace`)."""

TIME = "elapsed time"
"""The name of the elapsed time; no name of an average, since it is no identifier."""


def rate_of_integrals(
    smooth: SmoothMachine, s: Scalar, state: State, integrals: Integrals
) -> Integrals:
    """Return d/ds of the integrals of these names.

    **Arguments:** `smooth`, the machine in its modes, with which its averages are evaluated.
    """
    if not integrals:
        return {}
    pace, rates = smooth.pace(s, state), {}
    if set(integrals) - {TIME}:
        for name, value in smooth.averages(s, state).items():
            value = jnp.asarray(value, s.dtype)
            rates[name] = value if pace is None else pace * value
    if TIME in integrals:
        rates[TIME] = jnp.ones_like(s) if pace is None else pace
    return rates


def carried(smooth: SmoothMachine, s: Scalar, state: State, integrals: Integrals) -> Integrals:
    """Return those integrals that a method has to carry along: not a time that `s` measures."""
    paced = TIME in integrals and smooth.pace(s, state) is not None
    return {name: x for name, x in integrals.items() if name != TIME or paced}


def elapsed(old: Integrals, new: Integrals, h: Scalar) -> Integrals:
    """Return the integrals after a step.

    **Arguments:** `old`, those before it; `new`, those that were `carried`; `h`, the length of the
    step, which is the time where s measures that.
    """
    return {TIME: old[TIME] + h, **new} if TIME in old else new


def means(integrals: dict[str, Any], duration: object) -> dict[str, Any]:
    """Return the averages of integrals over this duration."""
    return {name: x / duration for name, x in integrals.items()}
