"""What every verb asks of a machine. A class of your own with these few methods runs like ours."""

import abc
from collections.abc import Callable, Mapping
from functools import partial
from math import pi
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._checks import in_range, number, require
from .._types import Flag, Scalar, State
from .coordinates import Coordinate, coordinate_by_name
from .cycles import Passing, Turn, at_intervals, counter_of
from .described import Clocked, Observed, Worded
from .event import AbstractEvent, AbstractSwitch
from .own import by_default, declared_modes, derived, is_own, says
from .parts import coordinates_in, listed, other_events, stops_in, switches_in
from .soft import SoftStop
from .stop import RigidStop, Wall


class Prepared(NamedTuple):
    """A machine as a run follows it, and states on the way in and out."""

    machine: Any
    inward: Callable[[State], State]
    outward: Callable[[State], State]


# What a machine must say, and how.
_MUST_SAY = {
    "cycle": "write `cycle: float = …` in the class, its length in `s`, or a property",
    "field": "write `def field(self, s, state)`, which returns the rate of each part of the state",
}


def _as_it_is(state: State) -> State:
    return state


def _position(machine: "AbstractMachine", state: State) -> Scalar:
    return state.Y if machine.stops or hasattr(state, "Y") else jtu.tree_leaves(state)[0]


def _velocity(machine: "AbstractMachine", state: State) -> Scalar:
    return state.V if machine.has_velocity(state) else jtu.tree_leaves(state)[:2][-1]


def _placed(machine: "AbstractMachine", state: State, Y: Scalar, V: Scalar) -> State:
    if machine.has_velocity(state):
        return eqx.tree_at(lambda x: (x.Y, x.V), state, (Y, V))
    leaves, structure = jtu.tree_flatten(state)
    return jtu.tree_unflatten(structure, [Y, V, *leaves[2:]][-len(leaves) :])


def _plain(machine: "AbstractMachine") -> Coordinate:
    """That of a state with the fields `Y` and `V`, or of a machine without stops."""
    return Coordinate(*(partial(function, machine) for function in (_position, _velocity, _placed)))


class AbstractMachine(Clocked, Observed, Worded):
    """A machine: smooth motion between events, observed cycle by cycle.

    Its independent variable is called `s`. The machine is driven, and its field periodic in `s`
    (`s` restarts from zero in each cycle); or it is autonomous, and an event ends its cycles.

    A subclass defines `cycle` and `field`, and lists its `contacts` and `events`. All else has a
    default. Contacts name the components of the state that they act on. Without names they act on
    the fields `Y` and `V`. Extremes of a machine without contacts are those of its first component.

    | definition | meaning |
    |---|---|
    | `cycle` | the length of a cycle in `s`; or `turn_of`, `rising`, `falling` |
    | `field` | d(state)/ds between contacts and events |
    | `contacts` | rigid and soft stops, dry friction; `()` by default |
    | `events` | switches, resets, other kinds of events; `()` by default |
    | `modes` | discrete modes by name, which events change |

    | motion | meaning |
    |---|---|
    | `start`, `adopt` | the default start; starts of other classes |
    | `position`, `velocity`, `placed` | the coordinate of contacts that name none |
    | `coordinates`, `coordinate_on` | several coordinates by number |
    | `begin` | modes that depend on the start |

    | observation (`Observed`) | meaning |
    |---|---|
    | `section` | a function of the state that ends a cycle where it rises through zero |
    | `observed_every` | the same machine observed at equal intervals |
    | `averages` | means over a cycle: a power, a mean force |
    | `quantities` | functions of the state, by name, shown in results |
    | `renewed` | a drift, counted by the cycle |
    | `mirrored` | the symmetry of the machine, for branches |
    | `at_section`, `observed_later` | another place of the section |

    | clocks and time scales (`Clocked`) | meaning |
    |---|---|
    | `clock`, `rewound`, `pace` | another variable than `s` that counts cycles or measures time |
    | `in_clock`, `phase_at`, … | several clocks to choose from |
    | `step_limit`, `relaxation` | steps that fit time scales shorter than the cycle |

    | words (`Worded`) and limits | meaning |
    |---|---|
    | `labels`, `units`, `period_of`, `place_of` | words of pictures and messages |
    | `in_range`, `check_start`, `alive` | limits, checked before and during a run |
    | `may_rest` | whether programs contain rest on a stop |
    | `prepared` | values that are computed once for each run |

    Ready machines, each written in this way, are in `vi_jax.machines`.
    """

    def __new__(cls, *args: Any, **kwargs: Any):
        missing = {*cls.__abstractmethods__, *getattr(cls, "__abstractvars__", ())}
        if missing:
            name = next((x for x in _MUST_SAY if x in missing), min(missing))
            how = f": {_MUST_SAY[name]}" if name in _MUST_SAY else ""
            raise TypeError(f"A machine must have `{name}`, but `{cls.__name__}` has none{how}.")
        return super().__new__(cls, *args, **kwargs)

    @abc.abstractmethod
    def field(self, *args: Any, **kwargs: Any) -> State:
        """`field(s, state)`: d(state)/ds between events, a pytree like `state`.

        With switches or discrete `modes` it is `field(s, state, mode, ...)`.
        """

    if TYPE_CHECKING:  # a subclass has them as attributes, properties or fields
        contacts: Any = eqx.field(init=False)
        events: Any = eqx.field(init=False)
        modes: Any = eqx.field(init=False)
        stops: Any = eqx.field(init=False)
        switches: Any = eqx.field(init=False)
        coordinates: Any = eqx.field(init=False)
    else:

        @derived
        def contacts(self) -> Any:
            """Rigid and soft stops, dry friction: a tuple, or one of them."""
            return ()

        @derived
        def events(self) -> Any:
            """Switches, resets, and other kinds of events: a tuple, or one of them."""
            return ()

        @derived
        def modes(self) -> Mapping[str, float]:
            """The discrete modes, by name, in which a motion begins. The field receives them after
            the state, and events change them."""
            return {}

        @derived
        def stops(self) -> tuple[RigidStop, ...]:
            """The rigid stops among the contacts."""
            return stops_in(self)

        @derived
        def switches(self) -> tuple[AbstractSwitch, ...]:
            """The contacts that are no rigid stops, and the switches among the events."""
            return switches_in(self)

        @derived
        def coordinates(self) -> tuple[Coordinate, ...]:
            """The coordinates that contacts act on, by number as `RigidStop.coordinate` names them;
            extremes are recorded of the first. By default those that contacts name by `on`, and
            where none does one, the machine's `position`, `velocity` and `placed`."""
            return coordinates_in(self)

    @property
    def others(self) -> tuple[AbstractEvent, ...]:
        """The events that are no switches."""
        return other_events(self)

    @property
    def outcomes(self) -> tuple[str, ...]:
        """The names of the outcomes with which its events and its stops end a motion."""
        names = (x.ends for x in (*self.switches, *self.others, *self.stops) if x.ends)
        return tuple(dict.fromkeys(names))

    @by_default
    def begin(self, s: Scalar, state: State) -> Any:
        """The discrete modes of a motion that begins in `state`, which the field receives after the
        state and events change; by default `modes` of the class. A start that is a `HybridState`,
        as `Run.last` is, has its own instead."""
        return tuple(declared_modes(self).values())

    def observed_every(self, interval: Any) -> "AbstractMachine":
        """An autonomous machine observed at equal intervals of `s` instead of on its section."""
        ends = any(x.ends_cycle for x in (*self.stops, *self.switches, *self.others))
        if not ends and not has_section(self):
            raise ValueError(f"A {type(self).__name__} is driven: its cycle is its drive's.")
        require("interval", number("interval", interval), low=0.0, open_low=True)
        return at_intervals(self, interval)

    @by_default
    def section(self, state: State) -> Scalar | None:
        """The function that rises through zero at the end of a cycle; `None` if `s`, `clock` or an
        event ends cycles."""
        counter = counter_of(self)
        return counter.section(state) if isinstance(counter, Passing) else None

    def step_limit(self, s: Scalar, state: State) -> Scalar | float:
        """The longest step that holds at most one extremum of the motion: `cycle`/5, less near a
        soft stop."""
        counter = counter_of(self)
        limit = counter.longest_step(self, state) if isinstance(counter, Turn) else self.cycle / 5
        for stop in self.switches:
            if stop.acts and isinstance(stop, SoftStop):
                pace, length = self.pace(s, state), stop.longest_step(self, s, state)
                limit = jnp.minimum(limit, length if pace is None else length / pace)
        return limit

    def frequency_ratio(self, duration: Float[Array, "..."]) -> Float[Array, "..."] | None:
        """Mean drive speed over cycles of these durations, or `None` where nothing is driven."""
        return 2 * pi / duration if isinstance(counter_of(self), Turn) else None

    def coordinate_on(self, on: Any, mass: Any = None) -> Coordinate:
        """The coordinate that a contact names by its `on`; of a contact that names none the
        machine's own.

        **Arguments:** `mass`, what acts there, 1 if it is `None`.
        """
        if on is not None:
            return coordinate_by_name(on, mass)
        methods = ("position", "velocity", "placed")
        own = {name: getattr(self, name) for name in methods if is_own(getattr(type(self), name))}
        return _plain(self)._replace(mass=1.0 if mass is None else mass, **own)

    @property
    def _first(self) -> Coordinate:
        """What `position`, `velocity` and `placed` are where the machine does not say it by them:
        the first of its own `coordinates`, if it has some."""
        return self.coordinates[0] if names_coordinates(self) else _plain(self)

    @by_default
    def position(self, state: State) -> Scalar:
        """The coordinate that stops limit: by default the first of `coordinates`, or `state.Y`; for
        a machine without stops whose state has no `Y` the first component, of which extremes are
        recorded."""
        return self._first.position(state)

    @by_default
    def velocity(self, state: State) -> Scalar:
        """The velocity that an impact reverses; of the sign of d(position)/ds. For a machine
        without stops whose state has no `V`, the second component, which pictures draw over the
        position."""
        return self._first.velocity(state)

    @by_default
    def placed(self, state: State, Y: Scalar, V: Scalar) -> State:
        """`state` with this position and velocity: how a landing and a rebound are applied."""
        return self._first.placed(state, Y, V)

    def has_velocity(self, state: State) -> bool:
        """Whether `velocity` is one; it need not be where there is nothing to meet."""
        own = is_own(type(self).velocity) or names_coordinates(self)
        return own or bool(self.stops) or hasattr(state, "V")

    def start(self) -> State:
        """The state to begin from where none is given.

        **Raises:** `ValueError` where this machine has none.
        """
        raise ValueError(
            f"Argument `start` must be given for a {type(self).__name__}, which has no `start` of "
            "its own."
        )

    def prepared(self) -> Prepared:
        """The machine in the form in which a run follows it: what its numbers alone determine is
        worked out here, once, and its state may be another one (natural modes); with the ways from
        its own states to those, and back. By default it is the machine itself."""
        return Prepared(self, _as_it_is, _as_it_is)

    def adopt(self, start: State) -> State:
        """A start in the form that this machine needs. **Raises:** `TypeError` for another
        object."""
        return start

    def may_rest(self) -> bool:
        """Whether the body can come to rest on a stop, as far as is known; static."""
        return bool(self.stops)

    def alive(self, state: State) -> Flag | None:
        """Whether the motion can go on: false where the clock of this machine breaks down, as where
        a crank stops in the phase clock; `None` where it cannot."""
        return None

    def in_range(self, start: State) -> Flag:
        """Whether the numbers of this machine, traced ones too, are such that it can be run from
        `start`; asked once, when a lane begins. By default what its parts say (`ranges`)."""
        return in_range((self, self.stops, self.switches))

    def check_start(self, start: State) -> None:
        """Raise a `ValueError` if the concrete `start` cannot be simulated (stops apart)."""
        return None


def names_coordinates(machine: AbstractMachine) -> bool:
    """Whether a machine defines coordinates, itself or by the names in its contacts."""
    if says(machine, "coordinates"):
        return True
    walls = (x for x in listed(machine.contacts) if isinstance(x, Wall))
    return any(x.on is not None for x in walls)  # pyright: ignore[reportAttributeAccessIssue]


def has_section(machine: AbstractMachine) -> bool:
    """Whether a machine has a section, a function of its state that ends its cycles."""
    return is_own(type(machine).section) or isinstance(counter_of(machine), Passing)


def renews(machine: AbstractMachine) -> bool:
    """Whether a machine begins each cycle with something set back."""
    return is_own(type(machine).renewed)
