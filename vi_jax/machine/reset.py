"""Resets: where a state jumps by a rule of its own."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx

from .event import AbstractEvent
from .events import struck_modes


class Reset(AbstractEvent):
    """A jump of the state where a guard rises through zero: a walker's heel strike, an impact with
    friction, a switch that is thrown.

    All functions get `(machine, s, state, *modes)`, with the modes as the machine's field gets
    them. The reset happens once the guard has been below zero since the last time, and so does not
    come again at once where it leaves the state on the guard's surface or beyond.

    **Arguments:**

    - `guard`: what rises through zero.
    - `reset`: the state afterwards.
    - `when`: whether the reset happens where the guard has risen through zero, as a flag; where it
      does not hold the motion goes on. Always, if left out.
    - `modes`: the machine's own modes afterwards, a tuple like that of its `begin`; they stay as
      they are if left out. Switches are then in the modes that they have behind an impact.
    - `value`: a number that the log of events keeps of it, of the state before.
    - `ends_cycle`: whether a cycle ends with it.
    - `name`: what messages call it.
    """

    _guard: Callable[..., Any] = eqx.field(static=True)
    _reset: Callable[..., Any] = eqx.field(static=True)
    _when: Callable[..., Any] | None = eqx.field(static=True)
    _modes: Callable[..., Any] | None = eqx.field(static=True)
    _value: Callable[..., Any] | None = eqx.field(static=True)
    word: ClassVar = "reset"

    def __init__(
        self,
        guard: Callable[..., Any],
        reset: Callable[..., Any],
        *,
        when: Callable[..., Any] | None = None,
        modes: Callable[..., Any] | None = None,
        value: Callable[..., Any] | None = None,
        ends_cycle: bool = False,
        name: str = "",
    ):
        self._guard, self._reset, self._when = guard, reset, when
        self._modes, self._value = modes, value
        self.ends_cycle, self.name = bool(ends_cycle), str(name)

    def guard(self, machine, s, state, *modes):
        """The function `guard` of this state."""
        return self._guard(machine, s, state, *modes)

    def after(self, machine, s, state, *modes):
        """As `reset` and `modes` say."""
        own = None if self._modes is None else self._modes(machine, s, state, *modes)
        new = self._reset(machine, s, state, *modes)
        return new, struck_modes(machine, s, new, modes, own)

    def jump(self, machine, s, state, *modes):
        """The state that the function `reset` makes of this one."""
        return self._reset(machine, s, state, *modes)

    def happens(self, machine, s, state, *modes):
        """What the function `when` says of this state, `None` without one."""
        return None if self._when is None else self._when(machine, s, state, *modes)

    def value(self, machine, s, state, *modes):
        """The function `value` of this state, NaN without one."""
        if self._value is None:
            return super().value(machine, s, state, *modes)
        return self._value(machine, s, state, *modes)
