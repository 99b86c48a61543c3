"""Resets: where a state jumps by a rule of its own."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx

from .._checks import one_of
from .event import AbstractEvent
from .events import modes_after, struck_modes
from .field import called, shown_modes
from .own import with_static
from .state import changed


class Reset(AbstractEvent):
    """A jump of the state where a guard rises through zero: a walker's heel strike, an impact with
    friction, a switch that is thrown.

    All functions get `(machine, s, state, *modes)`, with the modes as the machine's field gets
    them. A reset happens where its guard rises through zero, once it has been negative since the
    last time. A motion that begins on the guard's surface begins after the event.

    Events of one instant happen in the order in which the machine lists them. A jump that takes a
    guard from below zero to above triggers that event at the same instant. An event does not
    trigger itself, and a jump onto the surface triggers nothing. Two resets with the same guard
    both happen, the second in the state that the first leaves. An event that is listed after one
    that ends a cycle belongs to the next cycle.

    A guard may jump, such as `where(x > 1, 1.0, -1.0)`. The place is found by bisection, to 1e-12
    in `s`, in many steps; its time has no derivative.

    **Arguments:**

    - `guard`: the function that rises through zero: negative before the event, positive after it.
    - `reset`: the state afterwards, or a dictionary of the components that change; the state stays
      as it is if left out.
    - `when`: a flag, evaluated only at the instant at which the guard rises through zero. If it is
      false the reset does not happen, and the guard must fall below zero before it can rise again.
      For a reset as soon as two conditions hold take the smaller of two guards, or of a mode and a
      guard: `jnp.where(on == 1, z.T - 296, -1.0)`.
    - `modes`: the machine's discrete modes afterwards: one number, a tuple, or a dictionary of
      those that change; by default all stay. Switches then have the modes that they have after an
      impact.
    - `value`: a number for the event log, a function of the state before.
    - `ends_cycle`: whether a cycle ends with it.
    - `ends`: the name of an outcome with which the motion ends there, such as `"overturned"`.
    - `direction`: `"rising"`, or `"falling"` for a guard that falls through zero, or `"both"`.
    - `name`: its name in messages.
    """

    _guard: Callable[..., Any] = eqx.field(static=True)
    _reset: Callable[..., Any] | None = eqx.field(static=True)
    _when: Callable[..., Any] | None = eqx.field(static=True)
    _modes: Callable[..., Any] | None = eqx.field(static=True)
    _value: Callable[..., Any] | None = eqx.field(static=True)
    direction: str = eqx.field(static=True)
    word: ClassVar = "reset"

    def __init__(
        self,
        guard: Callable[..., Any],
        reset: Callable[..., Any] | None = None,
        *,
        when: Callable[..., Any] | None = None,
        modes: Callable[..., Any] | None = None,
        value: Callable[..., Any] | None = None,
        ends_cycle: bool = False,
        ends: str = "",
        direction: str = "rising",
        name: str = "",
    ):
        self._guard, self._reset, self._when = guard, reset, when
        self._modes, self._value = modes, value
        self.ends_cycle, self.ends, self.name = bool(ends_cycle), str(ends), str(name)
        self.direction = one_of("direction", direction, ("rising", "falling", "both"))

    def guard(self, machine, s, state, *modes):
        """The function `guard` of this state."""
        found = self._called("guard", self._guard, machine, s, state, modes)
        return -found if self.direction == "falling" else found

    def one_way(self) -> "tuple[Reset, ...]":
        """The same event as one for each direction."""
        if self.direction != "both":
            return (self,)
        return tuple(with_static(self, direction=way) for way in ("rising", "falling"))

    def after(self, machine, s, state, *modes):
        """As `reset` and `modes` say."""
        own = None
        if self._modes is not None:
            found = self._called("modes", self._modes, machine, s, state, modes)
            own = modes_after(machine, found, modes, self._whose("modes", machine))
        new = self.jump(machine, s, state, *modes)
        return new, struck_modes(machine, s, new, modes, own)

    def jump(self, machine, s, state, *modes):
        """The state that the function `reset` makes of this one."""
        if self._reset is None:
            return state
        found = self._called("reset", self._reset, machine, s, state, modes)
        return changed(state, found, self._whose("reset", machine))

    def _called(self, part, function, machine, s, state, modes):
        whose = self._whose(part, machine)
        return called(function, whose, machine, s, state, *shown_modes(machine, modes))

    def _whose(self, part: str, machine: Any) -> str:
        return f"`{part}` of {self.name or 'a Reset'} of a {type(machine).__name__}"

    def happens(self, machine, s, state, *modes):
        """The result of the function `when` for this state, `None` without one."""
        if self._when is None:
            return None
        return self._called("when", self._when, machine, s, state, modes)

    def value(self, machine, s, state, *modes):
        """The function `value` of this state, NaN without one."""
        if self._value is None:
            return super().value(machine, s, state, *modes)
        return self._called("value", self._value, machine, s, state, modes)
