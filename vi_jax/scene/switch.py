"""Switches: where the field of a machine changes without an impact.

A switch holds a mode, a number that the field is given. Within a step the mode is constant, so that
what a method integrates is smooth; the step ends where the guard rises through zero, and there the
mode changes. That is how a method keeps its order across a kink, and how a body can stick.
"""

import abc
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .shown import Shown

Scalar = Float[Array, ""]


class AbstractSwitch(Shown):
    """A mode, and the event that changes it.

    The first argument of each method is the machine. A hump of the guard within one step is seen if
    the guard is as smooth as the machine's first coordinate; shorter ones are passed by, as by
    every method of steps (`step_limit` bounds them).
    """

    @property
    def analytic(self) -> bool:
        """Whether what a mode adds to the field has power series up to the event that ends it."""
        return True

    @property
    def may_slide(self) -> bool:
        """Whether the field may point at the guard's surface from both sides, so that a motion has
        to slide along it, which is no mode yet: a lane that would ends, and says so."""
        return True

    @abc.abstractmethod
    def begin(self, machine: Any, s: Scalar, state: Any) -> Scalar:
        """The mode of a motion that begins in `state`."""

    @abc.abstractmethod
    def guard(self, machine: Any, s: Scalar, state: Any, mode: Scalar) -> Scalar:
        """What rises through zero where this mode ends."""

    @abc.abstractmethod
    def after(self, machine: Any, s: Scalar, state: Any, mode: Scalar) -> tuple[Any, Scalar]:
        """State and mode after the event. The state may be put right by what is below rounding
        (a velocity set to zero where it vanishes), and must not jump."""

    def contribution(self, machine: Any, s: Scalar, state: Any, mode: Scalar) -> Any:
        """What it adds to the machine's field in this mode, where it knows: of a soft stop the
        acceleration of its coordinate, of dry friction the force on the body that rubs."""
        raise NotImplementedError(f"A {type(self).__name__} has no `contribution`.")

    def struck(self, machine: Any, s: Scalar, state: Any, mode: Scalar) -> Scalar:
        """The mode after an impact elsewhere in the machine; by default that of a new motion."""
        return self.begin(machine, s, state)


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
