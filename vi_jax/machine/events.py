"""The events of a machine by number: their guards, their jumps, their modes; and the switches and
resets that users define by functions.

An argument `number` is that of an event. `modes` are all of the machine, before the event, and
`contact` is as in `EventContext`.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient

from .._checks import one_of
from .._types import Machine, Scalar, Scalars, State
from .contacts import call_checked, field_in, impact_on, on_surface, rate_of, shown_modes
from .event import AbstractEvent, AbstractSwitch, EventContext, Modes
from .friction import Friction, frictions_in, settled_modes
from .leaves import size_of
from .modes import constant_modes, modes_after, modes_at_start
from .overrides import with_static
from .parts import (
    events_of,
    friction_on,
    limited_in,
    mode_number,
    section_in,
    stops_of,
    switches_of,
)
from .settle import strike
from .state import changed


def is_autonomous(machine: Machine, state: State) -> bool:
    """Return whether an event, not the clock, ends the cycles of a machine."""
    if any(event.ends_cycle for event in events_of(machine)[:-1]):
        return True
    return jax.eval_shape(machine._section, state) is not None


def section_number(machine: Machine) -> int:
    """Return the number of the section, the last of the machine's events."""
    return len(events_of(machine)) - 1


def events_of_steps(machine: Machine, state: State) -> list[int]:
    """Return the numbers of the events, other than stops, whose guards each step checks."""
    last = section_number(machine) + (section_in(machine, state) is not None)
    return list(range(len(stops_of(machine)), last))


def guard_of(
    machine: Machine, number: int, s: Scalar, state: State, modes: Modes, contact: Scalars = (),
    loads: Any = None, new: Modes | None = None,
) -> Scalar:  # fmt: skip
    """Return the guard of an event, which rises through zero where the event happens. If the modes
    `new` after a change of a mode are known, the guard is a smooth function."""
    event, part, keywords = event_of(machine, number, modes, contact, loads)
    if event.holds_mode and new is not None:
        return event.guard_into(new[part.start], machine, s, state, *modes[part], **keywords)
    return event.guard(machine, s, state, *modes[part], **keywords)


def sides_of(
    machine: Machine, number: int, s: Scalar, state: State, modes: Modes, contact: Scalars = (),
    loads: Any = None,
) -> Scalars:  # fmt: skip
    """Return smooth functions whose maximum is the guard of an event."""
    event, part, keywords = event_of(machine, number, modes, contact, loads)
    return tuple(map(jnp.asarray, event.sides(machine, s, state, *modes[part], **keywords)))


def jump_of(machine: Machine, number: int, s: Scalar, state: State, modes: Modes) -> State:
    """Return the state after an event as a smooth function of that before it
    (`AbstractEvent.jump`)."""
    event, part, _ = event_of(machine, number, modes, ())
    return _with_friction(machine, number, s, state, event.jump(machine, s, state, *modes[part]))


def after_event(
    machine: Machine, number: int, s: Scalar, state: State, modes: Modes, contact: Scalars = (),
    *, alone: bool = True,
) -> tuple[State, Modes]:  # fmt: skip
    """Return state and modes after an event. If it happens `alone`, those of all frictions are
    settled after that of a friction."""
    event, part, keywords = event_of(machine, number, modes, contact)
    new, changed = event.after(machine, s, state, *modes[part], **keywords)
    if event.holds_mode:
        changed = (*modes[: part.start], changed, *modes[part.stop :])
    new = _with_friction(machine, number, s, state, new)
    if alone and event.holds_mode and part.start in frictions_in(machine):
        released = {part.start: jnp.asarray(modes[part.start] == 0)}
        # Its slip is zero now, to the rounding of a surface's speed.
        changed = (*changed[: part.start], jnp.zeros_like(s), *changed[part.stop :])
        changed = settled_modes(machine, s, new, constant_modes(changed, s), contact, released)
    return new, constant_modes(changed, s)


def _with_friction(machine: Machine, number: int, s: Scalar, before: State, after: State) -> State:
    """Return the state after an impact with friction, from that after one without it."""
    if friction_on(machine, number) is None:
        return after
    body = machine.coordinates[stops_of(machine)[number].coordinate]
    impact = impact_on(machine, [number], s, before)
    speed = impact.strike.velocity[:1]
    rebound = impact.outward[0] * body.velocity(after)
    restitution = -rebound / jnp.where(speed == 0, 1.0, speed)
    blow = strike(impact.strike._replace(restitution=restitution), impact.of)
    new = impact.after(blow.impulse)
    return body.placed(new, body.position(after), body.velocity(new))


def has_contact_friction(machine: Machine) -> bool:
    """Return whether there is friction on a stop."""
    return any(x.friction_stop is not None for x in switches_of(machine))


def is_compound(machine: Machine) -> bool:
    """Return whether several velocities change in an impact, across stops or along them; static."""
    return len(limited_in(machine)) > 1 or has_contact_friction(machine)


def event_of(
    machine: Machine, number: int, modes: Modes, contact: Scalars, loads: Any = None
) -> tuple[AbstractEvent, slice, dict[str, EventContext]]:
    """Return an event, the slice of the modes that its methods receive, and their keywords."""
    event = events_of(machine)[number]
    if not event.holds_mode:
        return event, slice(None), {}
    index = mode_number(machine, number)
    context = {"around": EventContext(modes, index, contact, loads)}
    return event, slice(index, index + 1), context if event.needs_all_modes else {}


def begin_modes(
    machine: Machine, s: Scalar, state: State, own: Sequence[Any] | None = None, *,
    settles: bool = True,
) -> Modes:  # fmt: skip
    """Return the initial modes of a motion in `state`: those of events, in their order, then the
    machine's own, which are `own` if that is given. Unless it `settles`, no mode depends on
    others."""
    state = jtu.tree_map(jnp.asarray, state)  # a start may hold Python's numbers
    mode_events = [event for event in events_of(machine) if event.holds_mode]
    own = modes_at_start(machine, s, state) if own is None else own
    modes = [*(event.begin(machine, s, state) for event in mode_events), *own]
    modes = constant_modes(modes, s)
    if settles and any(event.needs_all_modes for event in mode_events):
        modes = struck_modes(machine, s, state, modes)
    return modes


def struck_modes(
    machine: Machine, s: Scalar, state: State, modes: Modes, own: Sequence[Any] | None = None,
    contact: Scalars = (), before: State | None = None, released: dict[int, Any] | None = None,
    jump: tuple[Scalar, State] | None = None,
) -> Modes:  # fmt: skip
    """Return the modes after a jump to `state`, from `before` if that is known; the machine's own
    are unchanged, or `own`. `released` as in `settled_modes`. A body that sticks, and whose slip
    the jump does not change, sticks on: its slip is an error of the method. `jump`: the time of the
    jump and the state after it, if `state` at `s` is a later one."""
    event_modes, (at, after) = [], (s, state) if jump is None else jump
    for number, event in enumerate(events_of(machine)):
        if event.holds_mode:
            _, part, keywords = event_of(machine, number, modes, contact)
            mode = event.struck(machine, s, state, *modes[part], **keywords)
            if before is not None and isinstance(event, Switch) and not event.slides:
                # On its surface, where the sign is rounding, only its own event changes the mode.
                was, now = (event.function(machine, at, x) for x in (before, after))
                mode = jnp.where(stop_gradient(was == now), modes[part][0], mode)
            if before is not None and isinstance(event, Friction):
                sticks = (jnp.abs(modes[part][0]) < 1) & ~event.changes(machine, at, before, after)
                mode = jnp.where(sticks, 0.0, mode)
            event_modes.append(mode)
    machine_modes = modes[len(event_modes) :] if own is None else own
    modes = constant_modes([*event_modes, *machine_modes], s)
    if frictions_in(machine):
        released = {} if released is None and before is not None else released
        modes = constant_modes(settled_modes(machine, s, state, modes, contact, released), s)
    return modes


def holds_anywhere(machine: Machine) -> bool:
    """Return whether there is friction that may hold a body anywhere."""
    return any(x.is_dry for x in switches_of(machine))


class Switch(AbstractSwitch):
    """A mode that is the sign of a function, +1 where `function(machine, s, state)` is zero.

    If the fields of both modes point at the surface on which the function vanishes, the motion
    cannot leave it. With `slides=True` it slides along the surface (mode 0) by Filippov's rule. Its
    field is then the weighted mean of the two, with weights in [0, 1], that keeps the function at
    zero. It leaves when one of the two points away. Without `slides` such a lane ends as
    `RESULTS.sliding`. The machine's field is never called with mode 0.
    """

    function: Callable[..., Any] = eqx.field(static=True)
    slides: bool = eqx.field(static=True, default=False, kw_only=True)

    @property
    def is_plain(self) -> bool:
        return True

    @property
    def may_slide(self) -> bool:  # pyright: ignore
        return not self.slides

    @property
    def blends(self) -> bool:  # pyright: ignore
        return self.slides

    @property
    def needs_all_modes(self) -> bool:  # pyright: ignore
        return self.slides

    def begin(self, machine, s, state):
        whose = f"The function of {self.name or 'a Switch'} of a {type(machine).__name__}"
        value = call_checked(self.function, whose, machine, s, state)
        return jnp.where(value >= 0, 1.0, -1.0).astype(value.dtype)

    def struck(self, machine, s, state, mode, *, around: EventContext | None = None):
        """Return the mode after an impact or another jump: the sign of the function, or 0 on a
        surface that both fields point at."""
        side = self.begin(machine, s, state)
        if around is None:
            return side
        up, down = stop_gradient(self._rates(machine, s, state, around))
        function = partial(self.function, machine, s)
        size = size_of(function, state, jtu.tree_map(jnp.abs, state))
        size = size + jnp.asarray(machine.cycle) / (2 * jnp.pi) * (jnp.abs(up) + jnp.abs(down))
        rounding = 64 * float(jnp.finfo(up.dtype).eps) * size
        on_surface = jnp.abs(stop_gradient(function(state))) <= stop_gradient(rounding)
        return jnp.where(on_surface & (up < 0) & (down > 0), 0.0, side)

    def guard(self, machine, s, state, mode, *, around: EventContext | None = None):
        """Return the function, with the sign for which it rises at the event. While the motion
        slides, return the rate of the field that points away first."""
        value = -mode * self.function(machine, s, state)
        if around is None:
            return value
        up, down = self._rates(machine, s, state, around)
        return jnp.where(mode == 0, jnp.maximum(up, -down), value)

    def sides(self, machine, s, state, mode, *, around: EventContext | None = None):
        """Return the guard; while the motion slides, the two rates of which it is the maximum."""
        value = -mode * self.function(machine, s, state)
        if around is None:
            return (value,)
        up, down = self._rates(machine, s, state, around)
        return jnp.where(mode == 0, up, value), jnp.where(mode == 0, -down, value)

    def after(self, machine, s, state, mode, *, around: EventContext | None = None):
        if around is None:
            return state, -mode
        flows = self._flows(machine, s, state, around)
        up, down = (rate_of(self.function, machine, s, state, x) for x in flows)
        slides = (mode != 0) & (up < 0) & (down > 0)
        leaves = jnp.where(up > -down, 1.0, -1.0)
        # The error of steps along the surface would count as an event on the way off it.
        state = on_surface(self.function, machine, s, state, flows, mode == 0)
        return state, jnp.where(slides, 0.0, jnp.where(mode == 0, leaves, -mode))

    def _flows(
        self, machine: Machine, s: Scalar, state: State, around: EventContext
    ) -> tuple[State, State]:
        up, down = (field_in(machine, s, state, around.with_mode(mode)) for mode in (1.0, -1.0))
        return up, down

    def _rates(self, machine: Machine, s: Scalar, state: State, around: EventContext) -> Scalars:
        flows = self._flows(machine, s, state, around)
        return tuple(rate_of(self.function, machine, s, state, x) for x in flows)


class Reset(AbstractEvent):
    """A jump of the state where a guard rises through zero: a walker's heel strike, an impact with
    friction, a switch that is thrown.

    All functions have the arguments `(machine, s, state, *modes)`, with the modes as for the
    machine's field. After a reset, its guard must become negative before it can trigger again. A
    motion that begins on the guard's surface begins after the event.

    Events of one instant happen in the order in which the machine lists them. A jump that takes a
    guard from negative to positive triggers that event at the same instant. An event does not
    trigger itself, and a jump onto the surface triggers nothing. Two resets with the same guard
    both happen, the second in the state after the first. An event that is listed after one that
    ends a cycle belongs to the next cycle.

    A guard may jump, such as `where(x > 1, 1.0, -1.0)`. Its zero is found by bisection, to 1e-12 in
    `s`, in many steps. The time of such an event has no derivative, so that derivatives are NaN. A
    guard without a slope at its zero, such as `(x - 1)**3`, takes many steps too; its derivatives
    are right, or NaN where JAX's derivative of the guard is 0.

    **Arguments:**

    - `guard`: the function that rises through zero: negative before the event, positive after it.
    - `reset`: the state after the event, or a dictionary of the components that change; by default
      the state is unchanged.
    - `when`: a flag, evaluated only at the instant at which the guard rises through zero, such as
      that of a mode: `lambda m, t, z, on: on == 1`. If it is false, the reset does not happen, and
      the guard must become negative before it can rise again. For a reset as soon as two conditions
      hold, use the smaller of two guards. With a mode in the guard, the event happens at the
      instant at which the mode makes it positive.
    - `modes`: the machine's discrete modes after the event: one number, a tuple, or a dictionary of
      those that change; by default unchanged. Switches then have their modes after an impact.
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
        parts = dict(guard=guard, reset=reset, when=when, modes=modes, value=value)
        for part, given in parts.items():
            if not callable(given) and (given is not None or part == "guard"):
                raise TypeError(
                    f"Argument `{part}` of a Reset must be a function, as `lambda m, t, z: ...`, "
                    f"but got {given!r}."
                )
        self._guard, self._reset, self._when = guard, reset, when
        self._modes, self._value = modes, value
        self.ends_cycle, self.ends, self.name = bool(ends_cycle), str(ends), str(name)
        self.direction = one_of("direction", direction, ("rising", "falling", "both"))

    def guard(self, machine, s, state, *modes):
        """Return the function `guard`, with the opposite sign if the direction is falling."""
        found = self._call("guard", self._guard, machine, s, state, modes)
        return -found if self.direction == "falling" else found

    def one_way(self) -> "tuple[Reset, ...]":
        """Return one event for each direction."""
        if self.direction != "both":
            return (self,)
        return tuple(with_static(self, direction=direction) for direction in ("rising", "falling"))

    def after(self, machine, s, state, *modes):
        machine_modes = None
        if self._modes is not None:
            found = self._call("modes", self._modes, machine, s, state, modes)
            machine_modes = modes_after(machine, found, modes, self._whose("modes", machine))
        new = self.jump(machine, s, state, *modes)
        return new, struck_modes(machine, s, new, modes, machine_modes, before=state)

    def jump(self, machine, s, state, *modes):
        if self._reset is None:
            return state
        found = self._call("reset", self._reset, machine, s, state, modes)
        return changed(state, found, self._whose("reset", machine))

    def _call(self, part, function, machine, s, state, modes):
        whose = self._whose(part, machine)
        return call_checked(function, whose, machine, s, state, *shown_modes(machine, modes))

    def _whose(self, part: str, machine: Any) -> str:
        return f"`{part}` of {self.name or 'a Reset'} of a {type(machine).__name__}"

    def happens(self, machine, s, state, *modes):
        if self._when is None:
            return None
        return self._call("when", self._when, machine, s, state, modes)

    def value(self, machine, s, state, *modes):
        if self._value is None:
            return super().value(machine, s, state, *modes)
        return self._call("value", self._value, machine, s, state, modes)
