"""What `simulate` asks of a machine. A class of your own with these few methods runs like ours."""

import abc
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.tree_util as jtu
from jaxtyping import Array, Bool, Float

from .._checks import in_range
from .event import AbstractEvent, AbstractSwitch
from .shown import Shown
from .stop import RigidStop
from .units import PLAIN, unit_in

State = Any
"""A pytree of numbers (or arrays, which not every verb takes); the defaults below expect the fields
`Y` and `V`."""


class Coordinate(NamedTuple):
    """A coordinate that stops limit."""

    position: Callable[[State], Float[Array, ""]]
    velocity: Callable[[State], Float[Array, ""]]
    """What an impact reverses; of the sign of d(position)/ds."""
    placed: Callable[[State, Any, Any], State]
    """A state with another position and velocity, and with all that an impact changes besides."""
    mass: Any = 1.0
    """What an impact acts on, in the machine's unit of mass: of two bodies the reduced mass."""


def _position(machine: Any, state: State) -> Float[Array, ""]:
    return state.Y if machine.stops or hasattr(state, "Y") else jtu.tree_leaves(state)[0]


def _velocity(machine: Any, state: State) -> Float[Array, ""]:
    return state.V if machine.has_velocity(state) else jtu.tree_leaves(state)[:2][-1]


def _placed(machine: Any, state: State, Y: Float[Array, ""], V: Float[Array, ""]) -> State:
    if machine.has_velocity(state):
        return eqx.tree_at(lambda x: (x.Y, x.V), state, (Y, V))
    leaves, structure = jtu.tree_flatten(state)
    return jtu.tree_unflatten(structure, [Y, V, *leaves[2:]][-len(leaves) :])


# Of a state with the fields `Y` and `V`, or of a machine without stops.
_DEFAULTS: dict[str, Callable[..., Any]] = {
    "position": _position, "velocity": _velocity, "placed": _placed,
}  # fmt: skip


class AbstractMachine(Shown):
    """A machine: smooth motion between events, observed cycle by cycle.

    Its independent variable is called `s`. The machine is driven, and its field periodic in `s`
    (`s` restarts from zero in each cycle); or it is autonomous, and a cycle ends where `section`
    rises through zero.

    To write a machine of your own, give it `stops`, `cycle` and `field`, and `start` if there is a
    state to begin from where none is given. All else has a default; those below suit a state with
    the fields `Y` and `V` whose independent variable is time. A machine without stops needs
    neither: extremes are those of the first number of its state then.

    | a machine must say | |
    |---|---|
    | `stops` | the rigid stops, `()` if there are none |
    | `cycle` | the length of a cycle in `s` |
    | `field` | how the state changes between events |

    | it may say | and gets |
    |---|---|
    | `start` | verbs without an explicit start |
    | `position`, `velocity`, `placed` | a state of any names; what else an impact changes |
    | `coordinates` | stops on several coordinates (`RigidStop(..., coordinate=1)`) |
    | `switches` | a field with modes, landed upon where they change: soft stops, dry friction |
    | `events` | resets (`Reset`), cycles that any event ends, kinds of events of its own |
    | `begin` | modes of its own, which any event may change |
    | `section` | an autonomous machine, whose cycles are counted by an event |
    | `observed_every` | its Lyapunov exponents, and samples of its orbits |
    | `averages` | means over a cycle, integrated beside its state: a power, a mean force |
    | `quantities` | functions of its state, by name, where results show the state |
    | `renewed` | a drift, counted by the cycle |
    | `clock`, `rewound`, `pace` | another variable than `s` that counts cycles or measures time |
    | `step_limit`, `relaxation` | steps that fit time scales shorter than the cycle |
    | `may_rest` | programs without rest on a stop |
    | `mirrored` | branches that name a loss of symmetry |
    | `labels`, `units`, `period_of`, `place_of` | pictures and messages in its own words |
    | `in_range`, `check_start`, `alive` | its own limits, checked before and while it runs |

    Ready machines, each written in this way, are in `vi_jax.machines`.
    """

    stops: eqx.AbstractVar[tuple[RigidStop, ...]]

    @property
    @abc.abstractmethod
    def cycle(self) -> Float[Array, ""] | float:
        """Length of one cycle in `s` (or in `clock(state)`, where that is not `None`); where
        `section` ends a cycle, its usual length, by which steps are sized."""

    @abc.abstractmethod
    def field(self, *args: Any, **kwargs: Any) -> State:
        """`field(s, state)`: d(state)/ds between events, a pytree like `state`.

        With `switches`, or modes of its own, it is `field(s, state, mode, ...)`, which gets them.
        """

    @property
    def switches(self) -> tuple[AbstractSwitch, ...]:
        """Where the field changes without an impact."""
        return ()

    @property
    def events(self) -> tuple[AbstractEvent, ...]:
        """Events of other kinds: resets (`Reset`), and kinds of one's own."""
        return ()

    def begin(self, s: Float[Array, ""], state: State) -> tuple[Any, ...]:
        """The machine's own modes in a motion that begins in `state`: numbers that its field gets
        behind the state and behind the modes of its switches, and that events change."""
        return ()

    def section(self, state: State) -> Float[Array, ""] | None:
        """What rises through zero where a cycle ends; `None` where `s` or `clock` counts them."""
        return None

    def observed_every(self, interval: Any) -> "AbstractMachine":
        """An autonomous machine observed at equal intervals of `s` instead of on its section."""
        name = type(self).__name__
        what = "a `section`"
        if type(self).section is AbstractMachine.section:
            if not any(x.ends_cycle for x in (*self.stops, *self.switches, *self.events)):
                raise ValueError(f"A {name} is driven: its cycle is its drive's.")
            what = "an event that ends its cycles"
        raise ValueError(
            f"A {name} has {what} but no `observed_every`: give it this method, which returns "
            "the same machine with `interval` as its cycle, `None` as its section and no event "
            "that ends a cycle (and without a `renewed` that belongs to the section)."
        )

    @property
    def coordinates(self) -> tuple[Coordinate, ...]:
        """What stops limit; extremes are recorded of the first."""
        return (Coordinate(*(self._said(name) for name in ("position", "velocity", "placed"))),)

    def _said(self, name: str) -> Callable[..., Any]:
        """A method of the machine's own; else the default for a state with `Y` and `V`, which does
        not ask `coordinates` again where these ask their `super()`."""
        default = getattr(AbstractMachine, name)
        if self._has_coordinates and getattr(type(self), name) is default:
            return partial(_DEFAULTS[name], self)
        return getattr(self, name)

    def position(self, state: State) -> Float[Array, ""]:
        """The coordinate that stops limit: by default the first of `coordinates`, or `state.Y`; of
        a machine without stops whose state has no `Y` what extremes are of, its first number."""
        first = self.coordinates[0].position if self._has_coordinates else partial(_position, self)
        return first(state)

    def velocity(self, state: State) -> Float[Array, ""]:
        """The velocity that an impact reverses; of the sign of d(position)/ds. Of a machine without
        stops whose state has no `V`, what pictures draw over the position: its second number."""
        first = self.coordinates[0].velocity if self._has_coordinates else partial(_velocity, self)
        return first(state)

    def placed(self, state: State, Y: Float[Array, ""], V: Float[Array, ""]) -> State:
        """`state` with this position and velocity: how a landing and a rebound are applied."""
        first = self.coordinates[0].placed if self._has_coordinates else partial(_placed, self)
        return first(state, Y, V)

    def has_velocity(self, state: State) -> bool:
        """Whether `velocity` is one; it need not be where there is nothing to meet."""
        own = type(self).velocity is not AbstractMachine.velocity or self._has_coordinates
        return own or bool(self.stops) or hasattr(state, "V")

    @property
    def _has_coordinates(self) -> bool:
        """Whether a machine names its coordinates itself."""
        return type(self).coordinates is not AbstractMachine.coordinates

    def clock(self, state: State) -> Float[Array, ""] | None:
        """The state component that counts cycles, or `None` where `s` itself does."""
        return None

    def start(self) -> State:
        """The state to begin from where none is given.

        **Raises:** `ValueError` where this machine has none.
        """
        raise ValueError(
            f"Argument `start` must be given for a {type(self).__name__}, which has no `start` of "
            "its own."
        )

    def adopt(self, start: Any) -> State:
        """A start as this machine needs it. **Raises:** `TypeError` if it is none."""
        return start

    def in_clock(self, clock: str) -> "AbstractMachine":
        """The same machine with another independent variable, for one that has several."""
        raise ValueError(
            f"Argument `clock` must be left out for a {type(self).__name__}, which has its own "
            f"clock, but got {clock!r}."
        )

    def in_cycle_clock(self) -> "AbstractMachine":
        """The same machine with what counts its cycles as its independent variable."""
        return self

    def in_cycle_state(self, name: str, state: Any) -> State:
        """A state on the section, of any of its clocks, as the machine in that clock needs it."""
        return state

    def observed_later(self, since_section: Any) -> "AbstractMachine | None":
        """The same machine with its section moved by so much of its clock; `None` if it cannot."""
        return None

    def at_section(self, phase: Any) -> "AbstractMachine":
        """The same machine observed elsewhere in its cycle, for one that can be."""
        raise ValueError(
            f"Argument `section` must be left out for a {type(self).__name__}, which has its own "
            f"section, but got {phase!r}."
        )

    def phase_at(self, since_section: Any) -> Any:
        """What the clock reads, from what it counted since the section."""
        return since_section

    def mirrored(self, state: State) -> State | None:
        """The image of a state under the symmetry of this machine, for one whose motions have an
        image among them half a cycle later; `None` for one without."""
        return None

    def period_of(self, cycles: int) -> str:
        """A duration of so many cycles, in words."""
        return f"{cycles} cycle{'' if cycles == 1 else 's'}"

    def place_of(self, since_section: float, cycles: int) -> str:
        """A reading of the clock within a motion of so many cycles, in words."""
        return f"clock {since_section:.6g} of its {self.period_of(cycles)}"

    @property
    def labels(self) -> tuple[str, str]:
        """What pictures write beside position and velocity, with units."""
        return PLAIN

    @property
    def units(self) -> Mapping[str, str]:
        """The units of its quantities by their names: `position`, `velocity`, `time`, `rate` (of
        what grows in time, as exponents do), `energy`, `power`, and each number and component of a
        state by its own name. "1" is without unit; the name "" stands for all that is not named,
        and what is not stated is shown without. By default what the `labels` say in brackets."""
        found = map(unit_in, self.labels)
        return {x: unit for x, unit in zip(("position", "velocity"), found, strict=True) if unit}

    @property
    def turn(self) -> Float[Array, ""] | float:
        """What an impact log counts in one cycle."""
        return self.cycle

    def as_logged(self, clock: Float[Array, "..."]) -> Float[Array, "..."]:
        """A reading of what counts the cycles, as the impact log tells it; by default itself."""
        return clock

    def rewound(self, state: State) -> State:
        """`state` with its clock set back by one cycle (only asked where there is a clock)."""
        return state

    def renewed(self, state: State) -> State:
        """`state` as the next cycle begins, where something is counted by the cycle: a drift, say,
        is given as the progress in the last cycle and begins again from zero."""
        return state

    def pace(self, s: Float[Array, ""], state: State) -> Float[Array, ""] | None:
        """d(time)/ds where it varies along the motion, or `None` where `s` measures time."""
        return None

    def averages(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """`averages(s, state)`: what is averaged over time between events, by name.

        Each is integrated beside the state with the method's own accuracy and divided by the time
        that it took: `Run.averages` of each cycle, `Orbit.averages` and columns of a `Branch` over
        the period. What jumps with an impact is not in it. Its name must be its own, its unit is
        that of the same name in `units`. As the field, it gets the modes of a machine that has
        some; nothing is integrated where no motion is recorded (`record="sections"`)."""
        return {}

    def quantities(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """`quantities(s, state)`: functions of the state, by name, which results tell beside it: on
        sections, in samples, along branches. `s` counts from the section; it is 0 where the state
        has a clock of its own and for autonomous machines."""
        return {}

    @property
    def period(self) -> Float[Array, ""] | float:
        """Duration of a cycle, where it is fixed."""
        return self.cycle

    def frequency_ratio(self, duration: Float[Array, "..."]) -> Float[Array, "..."] | None:
        """Mean drive speed over cycles of these durations, or `None` where nothing is driven."""
        return None

    def step_limit(self, s: Float[Array, ""], state: State) -> Float[Array, ""] | float:
        """The longest step that holds at most one extremum of the motion; at most `cycle`/5."""
        return self.cycle / 5

    @property
    def scales_known(self) -> bool:
        """Whether the usual number of fixed steps in a cycle is known to be enough; static."""
        return False

    def relaxation(self, s: Float[Array, ""], state: State) -> Float[Array, ""] | None:
        """The shortest time constant (in `s`) with which something fades, `None` if nothing does.

        Explicit Runge–Kutta methods are unstable with steps much longer than this.
        """
        return None

    def may_rest(self) -> bool:
        """Whether the body can come to rest on a stop, as far as is known; static."""
        return bool(self.stops)

    def alive(self, state: State) -> jax.Array | None:
        """False where the clock of this machine breaks down; `None` where it cannot."""
        return None

    def in_range(self, start: State) -> Bool[Array, ""]:
        """Whether the numbers of this machine, traced ones too, are such that it can be run from
        `start`; asked once, when a lane begins. By default what its parts say (`ranges`)."""
        return in_range((self, self.stops, self.switches))

    def check_start(self, start: State) -> None:
        """Raise a `ValueError` if the concrete `start` cannot be simulated (stops apart)."""
        return None


def renews(machine: AbstractMachine) -> bool:
    """Whether a machine begins each cycle with something set back."""
    return type(machine).renewed is not AbstractMachine.renewed
