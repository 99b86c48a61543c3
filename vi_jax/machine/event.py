"""Events: a guard, and a jump where it rises through zero."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._types import Machine, Scalar, Scalars, State
from .printing import Shown

Modes = Scalars


class EventContext(NamedTuple):
    """Arguments of some events besides their own mode (see `AbstractEvent.needs_all_modes`)."""

    modes: Modes
    """All modes of the machine."""
    mode_index: int
    """The index of the event's mode among them."""
    contact: Scalars
    """For each coordinate, 1 + i while it rests on stop number i, else 0; empty without rests."""
    loads: Any = None
    """The forces of all frictions (see `shared_loads`), if they are known."""

    def with_mode(self, mode: object) -> Modes:
        """Return all modes, with another one in place of the event's."""
        mode = jnp.asarray(mode, jnp.result_type(self.modes[self.mode_index]))
        return (*self.modes[: self.mode_index], mode, *self.modes[self.mode_index + 1 :])


class AbstractEvent(Shown):
    """A guard, a function that rises through zero at the event, and the jump that follows.

    The first argument of each method is the machine. An event with its own mode (`holds_mode`)
    receives that mode after the state, and returns it. Another event receives all modes of the
    machine, as the field does, and returns all.

    A subclass defines `guard` and `after`, and a machine lists its events in `events`. Simulations,
    orbits, branches, logs and pictures need nothing else.
    """

    word: ClassVar[str] = "event"
    """Its name in messages, if it has no `name`."""

    ends_cycle: bool = eqx.field(static=True, kw_only=True, default=False, repr=False)
    """True if a cycle ends with it; static."""
    name: str = eqx.field(static=True, kw_only=True, default="")
    """Its name in messages; static."""
    ends: str = eqx.field(static=True, kw_only=True, default="")
    """The name of the outcome with which the motion ends there, or ""; static."""

    holds_mode: ClassVar[bool] = False
    """True if the event has one of the machine's modes; then it has `begin` and `struck`."""
    is_dry: ClassVar[bool] = False
    """True for friction that may hold a body anywhere."""
    needs_all_modes: ClassVar[bool] = False
    """True if `guard`, `after` and `struck` of an event with a mode have a keyword argument
    `around`, an `EventContext`."""
    may_slide: ClassVar[bool] = False
    """True if the field may point at the guard's surface from both sides, and the event has no mode
    for sliding along it. Such a lane ends as `RESULTS.sliding`."""
    from_below: ClassVar[bool] = True
    """True if the guard must have been negative since the last jump before the event can happen.
    False if the guard is another function after the event."""

    @property
    def is_plain(self) -> bool:
        """True if the guard is a function of the user's that may have no slope at its zero, or may
        jump; static."""
        return self.from_below

    checked_within_step: ClassVar[bool] = True
    """True if the guard may be positive for a part of a step only, and must be evaluated within
    each step. False if the length of steps depends on it already."""

    @abc.abstractmethod
    def guard(self, *args: Any, **kwargs: Any) -> Scalar:
        """Return the guard, which rises through zero: `guard(machine, s, state, *modes)`."""

    def sides(self, *args: Any, **kwargs: Any) -> tuple[Scalar, ...]:
        """Return smooth functions whose maximum is the guard, if the guard has a kink:
        `sides(machine, s, state, *modes)`; by default the guard alone."""
        return (self.guard(*args, **kwargs),)

    def guard_into(self, new: Scalar, *args: Any, **kwargs: Any) -> Scalar:
        """Return the guard of a change into the mode `new`, if the guard is the largest of several
        functions: that one which is zero at this change. By default return `guard`."""
        return self.guard(*args, **kwargs)

    @abc.abstractmethod
    def after(self, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """Return state and modes after the event: `after(machine, s, state, *modes)`."""

    def jump(self, *args: Any, **kwargs: Any) -> Any:
        """Return the state after the event as a smooth function of that before it, for derivatives:
        `jump(machine, s, state, *modes)`. It must hold for states near the event too, and omits the
        corrections of `after` by rounding."""
        return self.after(*args, **kwargs)[0]

    def happens(self, machine: Machine, s: Scalar, state: State, *modes: Any) -> Any:
        """Return whether the event happens when its guard rises through zero; `None` for always."""
        return None

    def value(self, machine: Machine, s: Scalar, state: State, *modes: Any) -> Any:
        """Return a number for the event log, a function of the state before the event."""
        return jnp.nan

    def begin(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """Return the initial mode of a motion that begins in `state`, if the event has a mode."""
        raise NotImplementedError(f"A {type(self).__name__} holds no mode.")

    def struck(self, machine: Machine, s: Scalar, state: State, mode: Scalar) -> Scalar:
        """Return its mode after an impact or another jump; by default the initial mode."""
        return self.begin(machine, s, state)

    def speed(self, machine: Machine, state: State, rate: Scalar) -> Scalar:
        """Return the speed of approach to the event, in the machine's unit: by default `rate`, the
        derivative of its guard with respect to s."""
        return rate


class AbstractSwitch(AbstractEvent):
    """A mode, and the event that changes it without a jump.

    Within a step the mode is constant, so that the method integrates a smooth field. The step ends
    where the guard rises through zero, and there the mode changes. A method therefore keeps its
    order across a kink, and a body can stick. `after` returns the state and the mode. It may
    correct the state only by rounding, such as a vanishing velocity set to zero.

    A hump of the guard within one step is detected if the guard is as smooth as the machine's first
    coordinate. Every method may step over shorter ones (`step_limit` bounds the steps).
    """

    word: ClassVar = "switch"

    acts: bool = eqx.field(static=True, kw_only=True, default=False, repr=False)
    """True if it adds its own force to the machine's field, as all switches in `contacts` do. The
    field then does not receive its mode. Static."""

    holds_mode: ClassVar[bool] = True
    from_below: ClassVar[bool] = False  # after the event the guard is that of another mode
    may_slide: ClassVar[bool] = True  # the mode differs on either side of the surface
    friction_stop: ClassVar[int | None] = None
    """The index of the stop on which this is friction, also in impacts (see `ContactFriction`)."""
    sized_in: ClassVar[tuple[float, float]] = (1.0, 0.0)
    """The modes in which the guard has the size of that in any other mode, and in mode 0."""
    blends: ClassVar[bool] = False
    """True if the motion may slide along the surface in mode 0. Its field there is a weighted mean
    of the fields of modes -1 and +1 (see `Switch`)."""

    @abc.abstractmethod
    def begin(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """Return the initial mode of a motion that begins in `state`."""

    def jump(self, machine, s, state, mode):
        return state

    def push_in(
        self, machine: Machine, s: Scalar, state: State, mode: Scalar
    ) -> tuple[Any, State] | None:
        """Return the force of a switch that `acts`: its amount with respect to time, and its push;
        `None` if it is solved for together with others."""
        raise NotImplementedError(f"A {type(self).__name__} adds nothing by itself.")


class Section(AbstractEvent):
    """The end of a cycle, by `rising`, `falling` or the clock that counts cycles."""

    word: ClassVar = "section"
    ends_cycle: bool = eqx.field(static=True, kw_only=True, default=True, repr=False)

    def guard(self, machine, s, state, *modes):
        rises = machine._section(state)
        if rises is not None:
            return rises
        clock = machine._clock(state)
        return (s if clock is None else clock) - jnp.asarray(machine.cycle, jnp.result_type(s))

    def after(self, machine, s, state, *modes):
        return machine.renewed(machine._with_earlier_clock(state)), modes


class TurnEnd(Section):
    """The end of a turn, after which the angle is a whole turn less."""

    from_below: ClassVar = False
    checked_within_step: ClassVar = False  # a shaft does not reverse twice in a step
