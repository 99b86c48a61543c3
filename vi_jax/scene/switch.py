"""A switch by the sign of a function."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp

from .event import AbstractSwitch


class Switch(AbstractSwitch):
    """A mode that is the sign of a function: +1 where `function(machine, s, state)` is positive.

    At zero it is the sign that the function is about to take by `rate(machine, s, state)`, if that
    is given, else +1.
    """

    function: Callable[..., Any] = eqx.field(static=True)
    rate: Callable[..., Any] | None = eqx.field(static=True, default=None)

    def begin(self, machine, s, state):
        """The sign of the function."""
        value = self.function(machine, s, state)
        rate = jnp.ones_like(value) if self.rate is None else self.rate(machine, s, state)
        positive = (value > 0) | ((value == 0) & (rate >= 0))
        return jnp.where(positive, 1.0, -1.0).astype(value.dtype)

    def guard(self, machine, s, state, mode):
        """The function, falling from above or rising from below."""
        return -mode * self.function(machine, s, state)

    def after(self, machine, s, state, mode):
        """On the other side."""
        return state, -mode
