"""Events: a guard, and what happens where it rises through zero."""

import abc
from typing import Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp

from .._types import Machine, Scalar, Scalars, State
from .shown import Shown

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

    A kind of one's own is a subclass with `guard` and `after`; a machine lists its events in
    `events`. Simulations, orbits, branches, logs and pictures ask nothing else of it.
    """

    word: ClassVar[str] = "event"
    """What messages call it that has no `name`."""

    ends_cycle: bool = eqx.field(static=True, kw_only=True, default=False, repr=False)
    """Whether a cycle ends with it; static."""
    name: str = eqx.field(static=True, kw_only=True, default="")
    """What messages call it; static."""
    ends: str = eqx.field(static=True, kw_only=True, default="")
    """The outcome with which the motion ends there, by name; it goes on without one; static."""

    @property
    def holds_mode(self) -> bool:
        """Whether one of the machine's modes is this event's; then it has `begin` and `struck`."""
        return False

    @property
    def is_dry(self) -> bool:
        """Whether it is friction that may hold a body anywhere."""
        return False

    @property
    def sees_around(self) -> bool:
        """Whether `guard`, `after` and `struck` of an event that holds a mode get a keyword
        argument `around` as well, an `Around`."""
        return False

    @property
    def may_slide(self) -> bool:
        """Whether the field may point at the guard's surface from both sides, so that a motion has
        to slide along it, which is no mode yet: a lane that would ends, and says so."""
        return False

    @property
    def from_below(self) -> bool:
        """Whether the event happens only once its guard has been below zero since the last jump. It
        need not ask for that if its guard is another function after the event."""
        return True

    @property
    def looked_at_within(self) -> bool:
        """Whether the guard may be positive for a part of a step only, and has to be evaluated
        within each one; static. Not where the length of a step is chosen by it already."""
        return True

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
        """A number that the log of events keeps of it, of the state in which it is met."""
        return jnp.nan

    def begin(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """The mode of a motion that begins in `state`, of an event that holds one."""
        raise NotImplementedError(f"A {type(self).__name__} holds no mode.")

    def struck(self, machine: Machine, s: Scalar, state: State, mode: Scalar) -> Scalar:
        """Its mode after an impact or another jump of the state; by default that of a new
        motion."""
        return self.begin(machine, s, state)

    def speed(self, machine: Machine, state: State, rate: Scalar) -> Scalar:
        """How fast the event is met, in the machine's words: by default `rate`, how fast its guard
        rises by s."""
        return rate


class AbstractSwitch(AbstractEvent):
    """A mode, and the event that changes it without a jump.

    Within a step the mode is constant, so that what a method integrates is smooth; the step ends
    where the guard rises through zero, and there the mode changes. That is how a method keeps its
    order across a kink, and how a body can stick. `after` returns the state and the mode; it may
    correct the state by rounding (a velocity set to zero where it vanishes), no more.

    A hump of the guard within one step is seen if the guard is as smooth as the machine's first
    coordinate; shorter ones are passed by, as by every method of steps (`step_limit` bounds them).
    """

    word: ClassVar = "switch"

    acts: bool = eqx.field(static=True, kw_only=True, default=False, repr=False)
    """Whether it adds its own force to the machine's field, which gets no mode of it then: so does
    each one that is listed in `contacts`; static."""

    @property
    def holds_mode(self) -> bool:
        """True: each switch has a mode."""
        return True

    @property
    def from_below(self) -> bool:
        """False: behind the event the guard is that of another mode."""
        return False

    @property
    def analytic(self) -> bool:
        """Whether what a mode adds to the field has power series up to the event that ends it."""
        return True

    @property
    def may_slide(self) -> bool:
        """True: the mode is another on either side of the surface."""
        return True

    @abc.abstractmethod
    def begin(self, machine: Machine, s: Scalar, state: State) -> Scalar:
        """The mode of a motion that begins in `state`."""

    def jump(self, machine, s, state, mode):
        """The state as it is: a switch changes a mode, not the state."""
        return state

    @property
    def rubs_on(self) -> int | None:
        """The number of the stop that this is friction on, whose impacts rub too (see
        `ContactFriction`)."""
        return None

    @property
    def blends(self) -> bool:
        """Whether in mode 0 the field is the mean of those of modes -1 and +1 that stays on the
        surface where they meet (see `Switch`)."""
        return False

    def push_in(
        self, machine: Machine, s: Scalar, state: State, mode: Scalar
    ) -> tuple[Any, State] | None:
        """The push of a switch that `acts`, and how much of it there is, by time; `None` for a
        force that is found with others."""
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
