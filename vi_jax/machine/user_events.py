"""Events that a user writes by functions: switches by a sign, and resets of the state."""

from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient

from .._checks import one_of
from .._types import Machine, Scalar, Scalars, State
from .contacts import called, field_in, rate_of, shown_modes
from .event import AbstractEvent, AbstractSwitch, Around
from .events import modes_after, struck_modes
from .numbers import size_of
from .own import with_static
from .state import changed


class Switch(AbstractSwitch):
    """A mode that is the sign of a function: +1 where `function(machine, s, state)` is positive.

    At zero it is the sign of `rate(machine, s, state)`, the derivative of the function, if that is
    given, else +1.

    If the fields of both modes point at the surface on which the function vanishes, the motion
    cannot leave it. With `slides=True` it slides along (mode 0) by Filippov's rule: its field is
    the mean of the two, weighted between 0 and 1, that keeps the function at zero. It leaves when
    one of the two points away. Otherwise such a lane ends as `RESULTS.sliding`. The machine's field
    is never called with mode 0.
    """

    function: Callable[..., Any] = eqx.field(static=True)
    rate: Callable[..., Any] | None = eqx.field(static=True, default=None)
    slides: bool = eqx.field(static=True, default=False, kw_only=True)

    @property
    def may_slide(self) -> bool:  # pyright: ignore
        """True if it has no mode for that."""
        return not self.slides

    @property
    def blends(self) -> bool:  # pyright: ignore
        """Whether it slides: then mode 0 is the motion along its surface."""
        return self.slides

    @property
    def sees_around(self) -> bool:  # pyright: ignore
        """True if it slides: the directions of both fields depend on the other modes."""
        return self.slides

    def begin(self, machine, s, state):
        """The sign of the function."""
        whose = f"The function of {self.name or 'a Switch'} of a {type(machine).__name__}"
        value = called(self.function, whose, machine, s, state)
        rate = jnp.ones_like(value) if self.rate is None else self.rate(machine, s, state)
        positive = (value > 0) | ((value == 0) & (rate >= 0))
        return jnp.where(positive, 1.0, -1.0).astype(value.dtype)

    def struck(self, machine, s, state, mode, *, around: Around | None = None):
        """The mode after an impact or another jump: the sign of the function; 0 on a surface that
        both fields point at."""
        side = self.begin(machine, s, state)
        if around is None:
            return side
        up, down = stop_gradient(self._rates(machine, s, state, around))
        function = partial(self.function, machine, s)
        size = size_of(function, state, jtu.tree_map(jnp.abs, state))
        size = size + jnp.asarray(machine.cycle) / (2 * jnp.pi) * (jnp.abs(up) + jnp.abs(down))
        rounding = 64 * float(jnp.finfo(up.dtype).eps) * size
        here = jnp.abs(stop_gradient(function(state))) <= stop_gradient(rounding)
        return jnp.where(here & (up < 0) & (down > 0), 0.0, side)

    def guard(self, machine, s, state, mode, *, around: Around | None = None):
        """The function, falling from above or rising from below; while the motion slides, the rate
        of the field that points away first."""
        value = -mode * self.function(machine, s, state)
        if around is None:
            return value
        up, down = self._rates(machine, s, state, around)
        return jnp.where(mode == 0, jnp.maximum(up, -down), value)

    def sides(self, machine, s, state, mode, *, around: Around | None = None):
        """The guard; of a motion that slides the two of which it is the greater."""
        value = -mode * self.function(machine, s, state)
        if around is None:
            return (value,)
        up, down = self._rates(machine, s, state, around)
        return jnp.where(mode == 0, up, value), jnp.where(mode == 0, -down, value)

    def after(self, machine, s, state, mode, *, around: Around | None = None):
        """On the other side, or along the surface."""
        if around is None:
            return state, -mode
        up, down = self._rates(machine, s, state, around)
        slides = (mode != 0) & (up < 0) & (down > 0)
        leaves = jnp.where(up > -down, 1.0, -1.0)
        return state, jnp.where(slides, 0.0, jnp.where(mode == 0, leaves, -mode))

    def _rates(self, machine: Machine, s: Scalar, state: State, around: Around) -> Scalars:
        """d/ds of the function in the modes +1 and -1."""
        up, down = (field_in(machine, s, state, around.instead(mode)) for mode in (1.0, -1.0))
        return tuple(rate_of(self.function, machine, s, state, x) for x in (up, down))


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
