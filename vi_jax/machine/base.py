"""What every verb asks of a machine: a class of your own with these few methods runs like ours. And
its contacts and events, sorted into what a step asks for.

A user lists contacts (rigid and soft stops, dry friction) and events (switches, resets, kinds of
one's own), each with the coordinate that it acts on. A step asks for the stops, for the switches,
for the other events, and for the coordinates that stops limit, by number.
"""

import abc
from collections.abc import Callable, Mapping
from functools import partial, wraps
from types import FunctionType
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu

try:
    from jax.extend.core import get_opaque_trace_state
except ImportError:  # JAX 0.9
    from jax.core import get_opaque_trace_state  # pyright: ignore

from .._checks import fields_with, number, require
from .._types import Machine, Scalar, State
from .coordinates import Coordinate, coordinate_by_name
from .cycles import Passing, Turn, at_intervals, counter_of
from .event import AbstractEvent, AbstractSwitch
from .events import Reset
from .friction import ContactFriction
from .numbers import PLAIN, Shown, unit_in
from .own import (
    by_default,
    derived,
    is_own,
    says,
    stops_of,
    switches_of,
    with_own_defaults,
    with_static,
)
from .stop import RigidStop, SoftStop, Wall

# What a machine must say, and how.
_MUST_SAY = {
    "cycle": "write `cycle: float = …` in the class, its length in `s`, or a property",
    "field": "write `def field(self, s, state)`, which returns the rate of each part of the state",
}


def listed(parts: object) -> tuple[Any, ...]:
    """Contacts or events as a tuple, of which one may be given without."""
    single = isinstance(parts, AbstractEvent)
    return (parts,) if single else tuple(parts) if isinstance(parts, list) else parts  # pyright: ignore


def once_a_trace(found: Callable[[Machine], Any]) -> Callable[[Machine], Any]:
    """A function of a machine that is called once while JAX traces a function. A step asks for the
    parts of a machine some hundred times, and each of a user's contacts takes a millisecond."""

    @wraps(found)
    def kept(machine: Machine) -> Any:
        trace, memory = get_opaque_trace_state(), vars(machine).setdefault(_MEMORY, {})
        known = memory.get(found)
        if known is None or known[0] != trace:
            known = memory[found] = trace, found(machine)
        return known[1]

    return kept


# Where a machine keeps what `once_a_trace` found; it is no field, and no part of a copy.
_MEMORY = "_found_in_a_trace"


@once_a_trace
def contacts_in(machine: Machine) -> tuple[Any, ...]:
    """The contacts that a machine lists."""
    return listed(machine.contacts)


@once_a_trace
def _stops_in(machine: Machine) -> tuple[RigidStop, ...]:
    """The rigid stops among a machine's contacts."""
    contacts = contacts_in(machine)
    places = _places(contacts)
    return tuple(_at(x, places) for x in contacts if isinstance(x, RigidStop))


@once_a_trace
def _switches_in(machine: Machine) -> tuple[AbstractSwitch, ...]:
    """The soft stops and frictions among a machine's contacts, which act by themselves, and the
    switches among its events."""
    contacts, found = contacts_in(machine), []
    places, at = _places(contacts), 0
    for x in contacts:
        if isinstance(x, RigidStop):
            if x.friction is not None:
                found.append(with_static(_friction_on(x, at, places), acts=True))
            at += 1
        elif isinstance(x, AbstractSwitch):
            found.append(with_static(_at(x, places) if isinstance(x, SoftStop) else x, acts=True))
    return *found, *(x for x in listed(machine.events) if isinstance(x, AbstractSwitch))


@once_a_trace
def _other_events(machine: Machine) -> tuple[AbstractEvent, ...]:
    """The events of a machine that are no switches, and the turn that ends its cycles."""
    found = []
    for event in listed(machine.events):
        if not isinstance(event, AbstractSwitch):
            found += event.one_way() if isinstance(event, Reset) else (event,)
    counter = counter_of(machine)
    return (*found, counter.event()) if isinstance(counter, Turn) else tuple(found)


def _coordinates_in(machine: Machine) -> tuple[Coordinate, ...]:
    """The coordinates on which a machine's contacts act, in the order of `_places`."""
    contacts = contacts_in(machine)
    stops = [x for x in contacts if isinstance(x, RigidStop | SoftStop) and x.mass is not None]
    masses = {x.on: x.mass for x in reversed(stops)}
    each = {k: on for on, k in reversed(_places(contacts).items())}
    return tuple(machine._coordinate_on(each[k], masses.get(each[k])) for k in sorted(each))


def _places(contacts: tuple[Any, ...]) -> dict[Any, int]:
    """The number of each coordinate by what names it: those of rigid stops, of soft ones, then
    those along which rigid ones rub."""
    rigid = [x for x in contacts if isinstance(x, RigidStop)]
    named = [x.on for x in rigid] + [x.on for x in contacts if isinstance(x, SoftStop)]
    named += [x.along for x in rigid if x.friction is not None]
    numbers: dict[Any, int] = {}
    return {on: numbers.setdefault(_known_as(on), len(numbers)) for on in named or [None]}


def _known_as(on: Any) -> Any:
    """What names a coordinate, or of a gap what it computes: the same one is often written for both
    sides, and two coordinates cost twice as much as one."""
    if not isinstance(on, FunctionType):
        return on
    code, cells = on.__code__, on.__closure__ or ()
    parts = code.co_code, repr(code.co_consts), code.co_names, code.co_varnames, code.co_freevars
    given = (*(x.cell_contents for x in cells), *(on.__defaults__ or ()))
    return *parts, id(on.__globals__), repr(on.__kwdefaults__), tuple(map(id, given))


def number_on(machine: Machine, name: str) -> int | None:
    """The number of the coordinate that contacts name so, as one or by its position; `None` if no
    contact acts on it."""
    for on, k in _places(contacts_in(machine)).items():
        if on == name or (isinstance(on, tuple) and on[0] == name):
            return k
    return None


def names_on(machine: Machine, number: int) -> tuple[str, str] | None:
    """The names in the state of the position and the velocity of a coordinate, by its number;
    `None` where contacts do not name it by them."""
    if says(machine, "coordinates"):
        return None
    on = next((on for on, k in _places(contacts_in(machine)).items() if k == number), None)
    return machine._names_on(on)


def _at(stop: Any, places: dict[Any, int]) -> Any:
    """A stop with the number of its coordinate."""
    if stop.on is None and stop.coordinate:
        return stop
    return with_static(stop, coordinate=places[stop.on])


def _friction_on(stop: RigidStop, number: int, places: dict[Any, int]) -> ContactFriction:
    rebound = stop.tangential_restitution
    return ContactFriction(
        stop.friction,
        stop=number,
        along=places[stop.along],
        restitution=0.0 if rebound is None else rebound,
    )


def _unlisted(kind: type) -> str | None:
    """The name under which a class that lists neither contacts nor events has one, as `stops`."""
    fields = getattr(kind, "__dataclass_fields__", {})
    if any(name in fields or hasattr(kind, name) for name in ("contacts", "events")):
        return None
    values = ((name, x) for base in kind.__mro__ for name, x in vars(base).items())
    parts = ((name, x if isinstance(x, tuple | list) else (x,)) for name, x in values)
    return next((name for name, x in parts if any(isinstance(y, AbstractEvent) for y in x)), None)


def _position(machine: "AbstractMachine", state: State) -> Scalar:
    return state.Y if stops_of(machine) or hasattr(state, "Y") else jtu.tree_leaves(state)[0]


def _velocity(machine: "AbstractMachine", state: State) -> Scalar:
    return state.V if has_velocity(machine, state) else jtu.tree_leaves(state)[:2][-1]


def _placed(machine: "AbstractMachine", state: State, Y: Scalar, V: Scalar) -> State:
    if has_velocity(machine, state):
        return eqx.tree_at(lambda x: (x.Y, x.V), state, (Y, V))
    leaves, structure = jtu.tree_flatten(state)
    return jtu.tree_unflatten(structure, [Y, V, *leaves[2:]][-len(leaves) :])


def _plain(machine: "AbstractMachine") -> Coordinate:
    """That of a state with the fields `Y` and `V`, or of a machine without stops."""
    return Coordinate(*(partial(function, machine) for function in (_position, _velocity, _placed)))


class AbstractMachine(Shown):
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
    | `start` | the default start |
    | `contacts` | rigid and soft stops, dry friction; `()` by default |
    | `events` | switches, resets, other kinds of events; `()` by default |
    | `modes` | discrete modes by name, which events change |
    | `position`, `velocity`, `placed` | the coordinate of contacts that name none |
    | `coordinates` | several coordinates by number |
    | `averages` | means over a cycle: a power, a mean force |
    | `quantities` | functions of the state, by name, shown in results |
    | `renewed` | a drifting component, set back in each cycle |
    | `mirrored` | the symmetry of the machine, for branches |
    | `step_limit`, `relaxation` | steps that fit time scales shorter than the cycle |
    | `pace` | d(time)/ds, if `s` is not time |
    | `labels`, `units` | words of pictures and messages |

    `machine.observed_every(interval)` is the same machine observed at equal intervals. Ready
    machines, each written in this way, are in `vi_jax.machines`.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        with_own_defaults(cls)

    def __new__(cls, *args: Any, **kwargs: Any):
        missing = {*cls.__abstractmethods__, *getattr(cls, "__abstractvars__", ())}
        if missing:
            name = next((x for x in _MUST_SAY if x in missing), min(missing))
            how = f": {_MUST_SAY[name]}" if name in _MUST_SAY else ""
            raise TypeError(f"A machine must have `{name}`, but `{cls.__name__}` has none{how}.")
        lost = _unlisted(cls)
        if lost is not None:
            raise TypeError(
                f"A machine must list its contacts as `contacts` and its events as `events`, but "
                f"`{cls.__name__}` has only `{lost}`."
            )
        return super().__new__(cls, *args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {name: x for name, x in vars(self).items() if name != _MEMORY}

    @abc.abstractmethod
    def field(self, *args: Any, **kwargs: Any) -> State:
        """`field(s, state)`: d(state)/ds between events, a pytree like `state`.

        With switches or discrete `modes` it is `field(s, state, mode, ...)`.
        """

    if TYPE_CHECKING:  # a subclass has them as attributes, properties or fields
        cycle: Any = eqx.field(init=False)
        contacts: Any = eqx.field(init=False)
        events: Any = eqx.field(init=False)
        modes: Any = eqx.field(init=False)
        coordinates: Any = eqx.field(init=False)
    else:

        @property
        @abc.abstractmethod
        def cycle(self) -> Scalar | float:
            """Length of one cycle in `s`; where an event ends a cycle, its usual length, by which
            steps are sized."""

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
            the state, and events change them. A method `modes(s, state)` returns those of a motion
            that begins in `state`: a number, a tuple or a dictionary. A start that is a
            `HybridState`, as `Run.last` is, has its own instead."""
            return {}

        @derived
        def coordinates(self) -> tuple[Coordinate, ...]:
            """The coordinates that contacts act on, by number as `RigidStop.coordinate` names them;
            extremes are recorded of the first. By default those that contacts name by `on`, and
            where none does one, the machine's `position`, `velocity` and `placed`."""
            return _coordinates_in(self)

    def start(self) -> State:
        """The state to begin from where none is given.

        **Raises:** `ValueError` where this machine has none.
        """
        raise ValueError(
            f"Argument `start` is missing, and {type(self).__name__} has no method `start`. Pass a "
            "state, or write `def start(self): return vi.State(...)` in the class."
        )

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

    def observed_every(self, interval: Any) -> "AbstractMachine":
        """An autonomous machine observed at equal intervals of `s` instead of on its section."""
        if counter_of(self) is None and not any(x.ends_cycle for x in _events_in(self)):
            raise ValueError(
                f"`observed_every` needs a machine without a drive, but a {type(self).__name__} is "
                "driven."
            )
        require("interval", number("interval", interval), low=0.0, open_low=True)
        return at_intervals(self, interval)

    @by_default
    def averages(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """`averages(s, state)`: by name, quantities whose means over time are wanted.

        Each is integrated along with the state, with the method's accuracy, and divided by the
        time: `Run.averages` of each cycle, `Orbit.averages` and columns of a `Branch` over the
        period. Impulses of impacts are not included. `units` may have the unit under the same name.
        As the field, it receives the discrete modes. Nothing is integrated with
        `record="sections"`."""
        return {}

    @by_default
    def quantities(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """`quantities(s, state)`: functions of the state, by name, which results contain as well:
        on sections, in samples, along branches. `s` counts from the section; it is 0 for autonomous
        machines, and if the state contains the clock."""
        return {}

    @by_default
    def renewed(self, state: State) -> State:
        """The state at the beginning of the next cycle, for a component that drifts: set back to
        zero here, it is the progress in each cycle."""
        return state

    def mirrored(self, state: State) -> State | None:
        """The image of a state under the symmetry of this machine, by which every motion has an
        image half a cycle later; `None` without such a symmetry."""
        return None

    def step_limit(self, s: Scalar, state: State) -> Scalar | float:
        """The longest step, in which the motion has at most one extremum: `cycle`/5, less near a
        soft stop."""
        counter = counter_of(self)
        limit = counter.longest_step(self, state) if isinstance(counter, Turn) else self.cycle / 5
        for stop in switches_of(self):
            if stop.acts and isinstance(stop, SoftStop):
                pace, length = self.pace(s, state), stop.longest_step(self, s, state)
                limit = jnp.minimum(limit, length if pace is None else length / pace)
        return limit

    def relaxation(self, s: Scalar, state: State) -> Scalar | None:
        """The shortest time constant (in `s`) of what decays, `None` if nothing does. Explicit
        Runge–Kutta methods are unstable with much longer steps."""
        return None

    def pace(self, s: Scalar, state: State) -> Scalar | None:
        """d(time)/ds; `None` if `s` is the time."""
        return None

    @property
    def labels(self) -> tuple[str, str]:
        """The names of position and velocity in pictures, with units; by default those in the
        state, if contacts name the first coordinate by them."""
        return (not is_own(type(self).position) and names_on(self, 0)) or PLAIN

    @property
    def units(self) -> Mapping[str, str]:
        """Units by name: of `position`, `velocity`, `time`, `rate` (of exponents), `energy`,
        `power`, and of each parameter and component of the state under its own name. "1" is without
        unit; the name "" stands for all others. By default those of `labels`, in brackets, and of
        the fields' metadata."""
        found = zip(("position", "velocity"), map(unit_in, self.labels), strict=True)
        own = {**dict(found), **fields_with(type(self), "unit")}
        return {x: unit for x, unit in own.items() if unit}

    # The parts as a step asks for them (`stops_of` and the others). Machines of this room that sort
    # them in another way have their own.
    _stops = property(_stops_in)
    _switches = property(_switches_in)
    _others = property(_other_events)

    def _section(self, state: State) -> Scalar | None:
        """See `section_in`."""
        counter = counter_of(self)
        return counter.section(self, state) if isinstance(counter, Passing) else None

    def _clock(self, state: State) -> Scalar | None:
        """See `clock_of`."""
        return None

    def _coordinate_on(self, on: Any, mass: Any = None) -> Coordinate:
        """The coordinate that a contact names by its `on`; of a contact that names none the
        machine's own.

        **Arguments:** `mass`, what acts there, 1 if it is `None`.
        """
        if on is not None:
            return coordinate_by_name(on, mass)
        methods = ("position", "velocity", "placed")
        own = {name: getattr(self, name) for name in methods if is_own(getattr(type(self), name))}
        return _plain(self)._replace(mass=1.0 if mass is None else mass, **own)

    def _names_on(self, on: Any) -> tuple[str, str] | None:
        """The names of position and velocity in the `on` of a contact; `None` where it has none."""
        return on if isinstance(on, tuple) else None

    @property
    def _first(self) -> Coordinate:
        """What `position`, `velocity` and `placed` are where the machine does not say it by them:
        the first of its own `coordinates`, if it has some."""
        return self.coordinates[0] if names_coordinates(self) else _plain(self)


def _events_in(machine: AbstractMachine) -> tuple[AbstractEvent, ...]:
    return (*machine._stops, *machine._switches, *machine._others)


def has_velocity(machine: AbstractMachine, state: State) -> bool:
    """Whether a machine's `velocity` is one; it need not be where there is nothing to meet."""
    own = is_own(type(machine).velocity) or names_coordinates(machine)
    return own or bool(stops_of(machine)) or hasattr(state, "V")


def names_coordinates(machine: AbstractMachine) -> bool:
    """Whether a machine defines coordinates, itself or by the names in its contacts."""
    if says(machine, "coordinates"):
        return True
    walls = (x for x in contacts_in(machine) if isinstance(x, Wall))
    return any(x.on is not None for x in walls)  # pyright: ignore[reportAttributeAccessIssue]


def renews(machine: AbstractMachine) -> bool:
    """Whether a machine begins each cycle with something set back."""
    return is_own(type(machine).renewed)
