"""Events: a guard, and what happens where it rises through zero."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._types import Machine, Scalar, Scalars, State
from .numbers import Shown

Modes = Scalars


class Around(NamedTuple):
    """What an event may have to know besides its own mode (see `AbstractEvent.sees_around`)."""

    modes: Modes
    """All modes of the machine."""
    own: int
    """Which of them is the event's."""
    contact: Scalars
    """Of each coordinate, 1 + i while it rests on stop number i, else 0; empty where none can."""

    def instead(self, mode: object) -> Modes:
        """All modes, with another one in the place of the event's."""
        mode = jnp.asarray(mode, jnp.result_type(self.modes[self.own]))
        return (*self.modes[: self.own], mode, *self.modes[self.own + 1 :])


class AbstractEvent(Shown):
    """A guard, a function that rises through zero where the event happens, and what happens then.

    The first argument of each method is the machine. An event that holds a mode (`holds_mode`) gets
    that mode behind the state, and returns it; another gets all modes of the machine, as its field
    does, and returns them all.

    A subclass defines `guard` and `after`; a machine lists its events in `events`. Simulations,
    orbits, branches, logs and pictures need nothing else.
    """

    word: ClassVar[str] = "event"
    """What messages call it that has no `name`."""

    ends_cycle: bool = eqx.field(static=True, kw_only=True, default=False, repr=False)
    """Whether a cycle ends with it; static."""
    name: str = eqx.field(static=True, kw_only=True, default="")
    """What messages call it; static."""
    ends: str = eqx.field(static=True, kw_only=True, default="")
    """The name of the outcome with which the motion ends there; "" if it continues; static."""

    holds_mode: ClassVar[bool] = False
    """Whether the event holds one of the machine's modes; then it has `begin` and `struck`."""
    is_dry: ClassVar[bool] = False
    """Whether it is friction that may hold a body anywhere."""
    sees_around: ClassVar[bool] = False
    """Whether `guard`, `after` and `struck` of an event that holds a mode get a keyword argument
    `around` as well, an `Around`."""
    may_slide: ClassVar[bool] = False
    """Whether the field may point at the guard's surface from both sides. A motion would have to
    slide along it, but the event has no mode for that: such a lane ends as `RESULTS.sliding`."""
    from_below: ClassVar[bool] = True
    """Whether the event happens only once its guard has been below zero since the last jump. That
    is not required if its guard is another function after the event."""
    looked_at_within: ClassVar[bool] = True
    """Whether the guard may be positive for a part of a step only and must be evaluated within each
    step. It need not be if the length of steps depends on it already."""

    @abc.abstractmethod
    def guard(self, *args: Any, **kwargs: Any) -> Scalar:
        """`guard(machine, s, state, *modes)`: what rises through zero at the event."""

    def sides(self, *args: Any, **kwargs: Any) -> tuple[Scalar, ...]:
        """`sides(machine, s, state, *modes)`: smooth functions of which the greatest is the guard,
        for a guard with a kink; by default the guard alone."""
        return (self.guard(*args, **kwargs),)

    @abc.abstractmethod
    def after(self, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """`after(machine, s, state, *modes)`: state and modes after the event."""

    def jump(self, *args: Any, **kwargs: Any) -> Any:
        """`jump(machine, s, state, *modes)`: the state after the event as a smooth function of that
        before it, for derivatives. It has to hold for states near the event too, and leaves out
        corrections of `after` to rounding."""
        return self.after(*args, **kwargs)[0]

    def happens(self, machine: Machine, s: Scalar, state: State, *modes: Any) -> Any:
        """Whether the event happens where its guard has risen through zero; `None` if always."""
        return None

    def value(self, machine: Machine, s: Scalar, state: State, *modes: Any) -> Any:
        """A number for the event log, a function of the state before the event."""
        return jnp.nan

    def begin(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """The mode of a motion that begins in `state`, of an event that holds one."""
        raise NotImplementedError(f"A {type(self).__name__} holds no mode.")

    def struck(self, machine: Machine, s: Scalar, state: State, mode: Scalar) -> Scalar:
        """Its mode after an impact or another jump of the state; by default that of a new
        motion."""
        return self.begin(machine, s, state)

    def speed(self, machine: Machine, state: State, rate: Scalar) -> Scalar:
        """How fast the event is approached, in the machine's unit: by default `rate`, the
        derivative of its guard with respect to s."""
        return rate


class AbstractSwitch(AbstractEvent):
    """A mode, and the event that changes it without a jump.

    Within a step the mode is constant, so the method integrates a smooth field. The step ends where
    the guard rises through zero, and there the mode changes. So a method keeps its order across a
    kink, and a body can stick. `after` returns the state and the mode; it may correct the state by
    rounding (a velocity set to zero where it vanishes), no more.

    A hump of the guard within one step is detected if the guard is as smooth as the machine's first
    coordinate. Every method may step over shorter ones (`step_limit` bounds the steps).
    """

    word: ClassVar = "switch"

    acts: bool = eqx.field(static=True, kw_only=True, default=False, repr=False)
    """Whether it adds its own force to the machine's field, which then does not receive its mode:
    true for everything that is listed in `contacts`; static."""

    holds_mode: ClassVar[bool] = True
    from_below: ClassVar[bool] = False  # behind the event the guard is that of another mode
    may_slide: ClassVar[bool] = True  # the mode is another on either side of the surface
    analytic: ClassVar[bool] = True
    """Whether the force of a mode has a power series up to the event that ends it."""
    friction_stop: ClassVar[int | None] = None
    """The number of the stop on which this is friction, also in its impacts (see
    `ContactFriction`)."""
    blends: ClassVar[bool] = False
    """Whether the field of mode 0 is a mean of the fields of modes -1 and +1, with which the motion
    stays on the surface between them (see `Switch`)."""

    @abc.abstractmethod
    def begin(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """The mode of a motion that begins in `state`."""

    def jump(self, machine, s, state, mode):
        """The state as it is: a switch changes a mode, not the state."""
        return state

    def push_in(
        self, machine: Machine, s: Scalar, state: State, mode: Scalar
    ) -> tuple[Any, State] | None:
        """The push of a switch that `acts`, and its amount with respect to time; `None` for a force
        that is solved for together with others."""
        raise NotImplementedError(f"A {type(self).__name__} adds nothing by itself.")


class Section(AbstractEvent):
    """The end of a cycle: where the function of `rising` or `falling` passes zero, or what counts
    its cycles has come to their length."""

    word: ClassVar = "section"
    ends_cycle: bool = eqx.field(static=True, kw_only=True, default=True, repr=False)

    def guard(self, machine, s, state, *modes):
        """That function, or what is left to a full cycle."""
        rises = machine._section(state)
        if rises is not None:
            return rises
        clock = machine._clock(state)
        return (s if clock is None else clock) - jnp.asarray(machine.cycle, jnp.result_type(s))

    def after(self, machine, s, state, *modes):
        """The state as the next cycle begins."""
        return machine.renewed(state), modes
