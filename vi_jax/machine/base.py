"""The base class of all machines, and their contacts and events sorted by kind.

A user lists contacts (rigid and soft stops, dry friction) and events (switches, resets, other
kinds). Each contact has the coordinate that it acts on. A time step needs the stops, the switches,
the other events, and by index the coordinates that stops limit.
"""

import abc
import dataclasses
from collections.abc import Callable, Mapping
from functools import partial, wraps
from types import FunctionType
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

try:
    from jax.extend.core import get_opaque_trace_state
except ImportError:  # JAX 0.9
    from jax.core import get_opaque_trace_state  # pyright: ignore

from .._checks import fields_with, number, require, returned
from .._types import Machine, Scalar, State
from .coordinates import Coordinate, coordinate_by_name
from .cycles import Turn, at_intervals, counter_of, counts_turns
from .event import AbstractEvent, AbstractSwitch, Section
from .events import Reset
from .friction import ContactFriction, DryFriction, joined
from .leaves import components
from .overrides import (
    defines,
    derived,
    is_builtin,
    overridden,
    with_own_defaults,
    with_static,
)
from .parts import stops_of, switches_of
from .printing import Shown
from .stop import RigidStop, SoftStop, Wall
from .units import PLAIN, unit_in

# Required members, each with advice for an error message.
_REQUIRED = {
    "cycle": "write `cycle: float = …` in the class, its length in `s`, or a property",
    "field": "write `def field(self, s, state)`, which returns the rate of each part of the state",
    "force": "write `def force(self, t, q, v)`, which returns the force on each coordinate by name",
}


# Members of every machine that are neither methods nor numbers.
_NO_NUMBERS = ("labels", "units", "coordinates")


def _refuse_taken_names(kind: type, members: Mapping[str, Any]) -> None:
    """**Raises:** `TypeError` if a parameter of a user's machine has the name of a method, or a
    number that of another member of every machine."""
    base: Any = next(x for x in kind.__mro__ if is_builtin(x))
    for name, x in members.items():
        x = getattr(x, "default", x) if isinstance(x, dataclasses.Field) else x
        is_known = x is not dataclasses.MISSING and not hasattr(x, "__get__")
        is_method = callable(getattr(base, name, None)) and name not in base.__dataclass_fields__
        is_number = isinstance(x, int | float | jax.Array | np.ndarray | np.number)
        is_taken = (is_method and not callable(x)) or (name in _NO_NUMBERS and is_number)
        is_private = name[0] == "_" and name[:4] != "_abc" and hasattr(base, name)
        if name[:2] != "__" and ((is_known and is_taken) or is_private):
            raise TypeError(
                f"Field {name!r} of a {kind.__name__} must have another name, since it is a "
                f"{'method' if is_method else 'member'} of every machine."
            )


def listed(parts: object) -> tuple[Any, ...]:
    """Return contacts or events as a tuple; a single one may be given without a tuple."""
    single = isinstance(parts, AbstractEvent)
    return (parts,) if single else tuple(parts) if isinstance(parts, list) else parts  # pyright: ignore


def cached_in_trace(function: Callable[[Machine], Any]) -> Callable[[Machine], Any]:
    """Cache a function of a machine while JAX traces another. A step reads the parts of a machine
    some hundred times, and each contact that a user defines takes a millisecond."""

    @wraps(function)
    def cached(machine: Machine) -> Any:
        trace, cache = get_opaque_trace_state(), vars(machine).setdefault(_CACHE, {})
        entry = cache.get(function)
        if entry is None or entry[0] != trace:
            entry = cache[function] = trace, function(machine)
        return entry[1]

    return cached


# The attribute with the cache of `cached_in_trace`. It is not a field, and copies leave it out.
_CACHE = "_found_in_a_trace"


@cached_in_trace
def contacts_in(machine: Machine) -> tuple[Any, ...]:
    """Return the contacts of a machine as a tuple."""
    return listed(machine.contacts)


@cached_in_trace
def _stops_in(machine: Machine) -> tuple[RigidStop, ...]:
    contacts = contacts_in(machine)
    index = _index_by_on(contacts)
    return tuple(_indexed(x, index) for x in contacts if isinstance(x, RigidStop))


@cached_in_trace
def _switches_in(machine: Machine) -> tuple[AbstractSwitch, ...]:
    """Return the soft stops and frictions among contacts, marked `acts`, then the switches. Dry
    frictions on one velocity are one friction."""
    contacts, found = contacts_in(machine), []
    index, stop_number = _index_by_on(contacts), 0
    on_surface: dict[Any, list[DryFriction]] = {}
    for x in contacts:
        if isinstance(x, DryFriction):
            on_surface.setdefault(x.surface(_coordinate_key), []).append(x)
    for x in contacts:
        if isinstance(x, DryFriction):
            same = on_surface[x.surface(_coordinate_key)]
            if x is not same[0]:
                continue
            x = joined(same)
        if isinstance(x, RigidStop):
            if x.friction is not None:
                found.append(with_static(_friction_on(x, stop_number, index), acts=True))
            stop_number += 1
        elif isinstance(x, AbstractSwitch):
            found.append(
                with_static(_indexed(x, index) if isinstance(x, SoftStop) else x, acts=True)
            )
    return *found, *(x for x in listed(machine.events) if isinstance(x, AbstractSwitch))


@cached_in_trace
def _other_events(machine: Machine) -> tuple[AbstractEvent, ...]:
    """Return the events that are not switches."""
    found = []
    for event in listed(machine.events):
        if not isinstance(event, AbstractSwitch):
            found += event.one_way() if isinstance(event, Reset) else (event,)
    return tuple(found)


def _coordinates_in(machine: Machine) -> tuple[Coordinate, ...]:
    contacts = contacts_in(machine)
    stops = [x for x in contacts if isinstance(x, RigidStop | SoftStop) and x.mass is not None]
    masses = {x.on: x.mass for x in reversed(stops)}
    on_of = {k: on for on, k in reversed(_index_by_on(contacts).items())}
    return tuple(machine._coordinate_on(on_of[k], masses.get(on_of[k])) for k in sorted(on_of))


def _index_by_on(contacts: tuple[Any, ...]) -> dict[Any, int]:
    """Return the index of each coordinate by its `on`: those of rigid stops, then of soft stops,
    then those along which rigid stops have friction."""
    rigid = [x for x in contacts if isinstance(x, RigidStop)]
    ons = [x.on for x in rigid] + [x.on for x in contacts if isinstance(x, SoftStop)]
    ons += [x.along for x in rigid if x.friction is not None]
    known: dict[Any, int] = {}
    return {on: known.setdefault(_coordinate_key(on), len(known)) for on in ons or [None]}


def _coordinate_key(on: Any) -> Any:
    """Return a key for a coordinate: its name, or the code and closure of a gap function. The same
    gap is often written for both sides, and two coordinates cost twice as much as one."""
    if not isinstance(on, FunctionType):
        return on
    code, cells = on.__code__, on.__closure__ or ()
    parts = code.co_code, repr(code.co_consts), code.co_names, code.co_varnames, code.co_freevars
    values = (*(x.cell_contents for x in cells), *(on.__defaults__ or ()))
    return *parts, id(on.__globals__), repr(on.__kwdefaults__), tuple(map(id, values))


def number_on(machine: Machine, name: str) -> int | None:
    """Return the index of the coordinate that contacts name `name`, alone or as its position;
    `None` if no contact acts on it."""
    for on, k in _index_by_on(contacts_in(machine)).items():
        if on == name or (isinstance(on, tuple) and on[0] == name):
            return k
    return None


def names_on(machine: Machine, number: int) -> tuple[str, str] | None:
    """Return the names of a coordinate's position and velocity in the state, by its index; `None`
    if contacts do not name them, or the machine defines `coordinates`."""
    if defines(machine, "coordinates"):
        return None
    on = next((on for on, k in _index_by_on(contacts_in(machine)).items() if k == number), None)
    return machine._names_on(on)


def longest_step(machine: Machine, s: Scalar, state: State) -> Scalar | float:
    """Return the longest step from a state: the machine's `step_limit`, less near a soft stop."""
    limit = machine.step_limit(s, state)
    limit = returned(limit, f"`step_limit` of a {type(machine).__name__}", "the longest step")
    for stop in switches_of(machine):
        if stop.acts and isinstance(stop, SoftStop):
            pace, length = machine.pace(s, state), stop.longest_step(machine, s, state)
            limit = jnp.minimum(limit, length if pace is None else length / pace)
    return limit


def _indexed(stop: Any, index: dict[Any, int]) -> Any:
    if stop.on is None and stop.coordinate:
        return stop
    return with_static(stop, coordinate=index[stop.on])


def _friction_on(stop: RigidStop, number: int, index: dict[Any, int]) -> ContactFriction:
    restitution = stop.tangential_restitution
    return ContactFriction(
        stop.friction,
        stop=number,
        along=index[stop.along],
        restitution=0.0 if restitution is None else restitution,
    )


def _unlisted(kind: type) -> str | None:
    """Return the name, such as `stops`, of an attribute with contacts or events, of a class without
    `contacts` and `events`."""
    fields = getattr(kind, "__dataclass_fields__", {})
    if any(name in fields or hasattr(kind, name) for name in ("contacts", "events")):
        return None
    values = ((name, x) for base in kind.__mro__ for name, x in vars(base).items())
    parts = ((name, x if isinstance(x, tuple | list) else (x,)) for name, x in values)
    return next((name for name, x in parts if any(isinstance(y, AbstractEvent) for y in x)), None)


def _position(machine: "AbstractMachine", state: State) -> Scalar:
    return state.Y if stops_of(machine) or hasattr(state, "Y") else jtu.tree_leaves(state)[0]


def _velocity(machine: "AbstractMachine", state: State) -> Scalar:
    if has_velocity(machine, state):
        return state.V
    leaves = jtu.tree_leaves(state)
    return [x for x in leaves[:2] if jnp.shape(x) == jnp.shape(leaves[0])][-1]


def _placed(machine: "AbstractMachine", state: State, Y: Scalar, V: Scalar) -> State:
    if has_velocity(machine, state):
        return eqx.tree_at(lambda x: (x.Y, x.V), state, (Y, V))
    leaves, structure = jtu.tree_flatten(state)
    return jtu.tree_unflatten(structure, [Y, V, *leaves[2:]][-len(leaves) :])


def _default_coordinate(machine: "AbstractMachine") -> Coordinate:
    """Return the coordinate of a state with fields `Y` and `V`, or of a machine without stops."""
    position, velocity, placed = (partial(x, machine) for x in (_position, _velocity, _placed))
    return Coordinate(position, velocity, placed)


class AbstractMachine(Shown):
    """A machine: smooth motion between events, observed cycle by cycle.

    Its independent variable is called `s`. The field of a driven machine is periodic in `s`, which
    restarts from zero in each cycle. The cycles of an autonomous machine end with an event.

    A subclass defines `cycle` and `field`, and lists its `contacts` and `events`. Everything else
    has a default. Contacts name the components of the state that they act on, by default the fields
    `Y` and `V`. Without contacts, extremes are those of the first component.

    | definition | meaning |
    |---|---|
    | `cycle` | the length of a cycle in `s`; or `turn_of`, `rising`, `falling` |
    | `field` | d(state)/ds between contacts and events |
    | `start` | the default start |
    | `contacts` | rigid and soft stops, dry friction; `()` by default |
    | `events` | switches, resets, other kinds of events; `()` by default |
    | `modes` | discrete modes by name, which events change |
    | `position`, `velocity`, `placed` | the coordinate of contacts that name none |
    | `coordinates` | several coordinates by index |
    | `delays` | delays by name; then the past follows the state in functions |
    | `recorded`, `before` | what is delayed, by default the state; its history before the start |
    | `averages` | means over a cycle: a power, a mean force |
    | `quantities` | functions of the state, by name, included in results |
    | `renewed` | a drifting component, set back in each cycle |
    | `mirrored` | the symmetry of the machine, for branches |
    | `step_limit`, `relaxation` | limits of time steps, for time scales shorter than the cycle |
    | `pace` | d(time)/ds, if `s` is not time |
    | `labels`, `units` | names and units in pictures and messages |

    `machine.observed_every(interval)` is the same machine observed at equal intervals. The machines
    in `vi_jax.machines` are written in this way.
    """

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        # A class with the name of its base is a form that the package makes of a user's machine.
        if not is_builtin(cls) and cls.__qualname__ != cls.__mro__[1].__qualname__:
            _refuse_taken_names(cls, vars(cls))
        with_own_defaults(cls)

    def __check_init__(self):
        if not is_builtin(type(self)):
            _refuse_taken_names(type(self), vars(self))

    def __new__(cls, *args: Any, **kwargs: Any):
        missing = {*cls.__abstractmethods__, *getattr(cls, "__abstractvars__", ())}
        if missing:
            name = next((x for x in _REQUIRED if x in missing), min(missing))
            how = f": {_REQUIRED[name]}" if name in _REQUIRED else ""
            raise TypeError(f"A machine must have `{name}`, but `{cls.__name__}` has none{how}.")
        unlisted = _unlisted(cls)
        if unlisted is not None:
            raise TypeError(
                f"A machine must list its contacts as `contacts` and its events as `events`, but "
                f"`{cls.__name__}` has only `{unlisted}`."
            )
        return super().__new__(cls, *args, **kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {name: x for name, x in vars(self).items() if name != _CACHE}

    @abc.abstractmethod
    def field(self, *args: Any, **kwargs: Any) -> State:
        """Return d(state)/ds between events, a pytree like `state`: `field(s, state)`.

        With switches or discrete `modes` it is `field(s, state, mode, ...)`.
        """

    if TYPE_CHECKING:  # a subclass has them as attributes, properties or fields
        cycle: Any = eqx.field(init=False)
        contacts: Any = eqx.field(init=False)
        events: Any = eqx.field(init=False)
        modes: Any = eqx.field(init=False)
        coordinates: Any = eqx.field(init=False)
        delays: Any = eqx.field(init=False)
        before: Any = eqx.field(init=False)
    else:

        @property
        @abc.abstractmethod
        def cycle(self) -> Scalar | float:
            """The length of a cycle in `s`. If an event ends cycles, their usual length, from which
            the lengths of steps follow."""

        @derived
        def contacts(self) -> Any:
            """The rigid and soft stops and dry frictions: a tuple, or one of them."""
            return ()

        @derived
        def events(self) -> Any:
            """The switches, resets and other events: a tuple, or one of them."""
            return ()

        @derived
        def modes(self) -> Mapping[str, float]:
            """The initial discrete modes, by name. The field receives them after the state, and
            events change them. Initial modes that depend on the state are returned by a method
            `modes(s, state)`: a number, a tuple or a dictionary. A start that is a `HybridState`,
            such as `Run.last`, has its own."""
            return {}

        @derived
        def coordinates(self) -> tuple[Coordinate, ...]:
            """The coordinates that contacts act on, in the order of `RigidStop.coordinate`.
            Extremes are those of the first. The default is the coordinates that contacts name by
            `on`; a contact without `on` acts on the machine's `position`, `velocity` and
            `placed`."""
            return _coordinates_in(self)

        @derived
        def delays(self) -> Mapping[str, Any]:
            """The delays by name, lengths in `s` that may depend on parameters. The field, guards
            and resets then receive the past after the state: `past.turn.x` is x one delay `turn`
            ago."""
            return {}

        @derived
        def before(self) -> Any:
            """The history before the start: a state like `recorded`, or a function of t ≤ 0; by
            default the start."""
            return None

    def recorded(self, *args: Any, **kwargs: Any) -> Any:
        """Return what is delayed, numbers by name: `recorded(s, state, past, *modes)`, by default
        the state."""
        return args[1]

    def start(self) -> State:
        """Return the default start. **Raises:** `ValueError` if the machine defines none."""
        raise ValueError(
            f"Argument `start` is missing, and {type(self).__name__} has no method `start`. Pass a "
            "state, or write `def start(self): return vi.State(...)` in the class."
        )

    def position(self, state: State) -> Scalar:
        """Return the coordinate that stops limit: by default the first of `coordinates`, or
        `state.Y`. Without stops and `Y` it is the first component. Extremes are recorded of it."""
        return self._first_coordinate.position(state)

    def velocity(self, state: State) -> Scalar:
        """Return the velocity that an impact reverses; it has the sign of d(position)/ds. Without
        stops and `V` it is the second component, which pictures draw over the position; the first
        if the second is an array."""
        return self._first_coordinate.velocity(state)

    def placed(self, state: State, Y: Scalar, V: Scalar) -> State:
        """Return `state` with this position and velocity, as after a landing or a rebound."""
        return self._first_coordinate.placed(state, Y, V)

    def observed_every(self, interval: Any) -> "AbstractMachine":
        """Return an autonomous machine observed at equal intervals of `s`, not on its section."""
        if counter_of(self) is None and not any(x.ends_cycle for x in _events_in(self)):
            raise ValueError(
                f"`observed_every` needs a machine without a drive, but a {type(self).__name__} is "
                "driven."
            )
        require("interval", number("interval", interval), low=0.0, open_low=True)
        return at_intervals(self, interval, renews(self))

    def averages(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return quantities, by name, whose means over time are computed: `averages(s, state)`.

        Each is integrated along with the state, with the method's accuracy, and divided by the
        time. The means over a cycle are in `Run.averages`, those over the period in
        `Orbit.averages` and in columns of a `Branch`. Impulses of impacts are not included.
        Discrete modes are further arguments, as of the field. `units` may have the unit under the
        same name. `record="sections"` omits averages. A function that jumps is refused: its jump
        must be that of the mode of a `Switch`.
        """
        return {}

    def quantities(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return functions of the state, by name, that results include: `quantities(s, state)`.
        They are evaluated on sections, in samples and along branches. `s` counts from the section;
        it is 0 for autonomous machines, and if the state contains the clock."""
        return {}

    def renewed(self, state: State) -> State:
        """Return the state at the beginning of the next cycle. A drifting component that is set to
        zero here is the progress in each cycle."""
        return state

    def mirrored(self, state: State) -> State | None:
        """Return the image of a state under the symmetry of this machine, or `None` without a
        symmetry. Half a cycle later, the image of a motion is a motion, too."""
        return None

    def step_limit(self, s: Scalar, state: State) -> Scalar | float:
        """Return the longest step in which the motion has at most one extremum: by default
        `cycle`/5. Steps near a soft stop are shorter in any case."""
        counter = counter_of(self)
        return counter.longest_step(self, state) if isinstance(counter, Turn) else self.cycle / 5

    def relaxation(self, s: Scalar, state: State) -> Scalar | None:
        """Return the shortest time constant of a decay (in `s`), or `None` if nothing decays.
        Explicit Runge–Kutta methods are unstable with much longer steps."""
        return None

    def pace(self, s: Scalar, state: State) -> Scalar | None:
        """Return d(time)/ds, or `None` if `s` is the time."""
        return None

    @property
    def labels(self) -> tuple[str, str]:
        """The labels of position and velocity in pictures, with units; by default their names in
        the state, if contacts name the first coordinate by them."""
        own = overridden(self, AbstractMachine, "position")
        return PLAIN if own else names_on(self, 0) or PLAIN

    @property
    def units(self) -> Mapping[str, str]:
        """The units of `position`, `velocity`, `time`, `rate` (of exponents), `energy`, `power`,
        and each parameter and component of the state, by name. "1" is dimensionless, and "" is the
        name of all others. The defaults are those in brackets in `labels` and fields' metadata."""
        found = zip(("position", "velocity"), map(unit_in, self.labels), strict=True)
        units = {**dict(found), **fields_with(type(self), "unit")}
        return {x: unit for x, unit in units.items() if unit}

    # The parts by kind (see `stops_of`). Some subclasses in this package sort them in another way.
    _stops = property(_stops_in)
    _switches = property(_switches_in)
    _others = property(_other_events)

    @property
    def _end(self) -> Section:
        counter = counter_of(self)
        return Section() if counter is None else counter.end

    def _section(self, state: State) -> Scalar | None:
        counter = counter_of(self)
        return None if counter is None else counter.section(self, state)

    def _clock(self, state: State) -> Scalar | None:
        return None

    def _with_earlier_clock(self, state: State) -> State:
        counter = counter_of(self)
        return state if counter is None else counter.with_earlier_angle(state)

    def _coordinate_on(self, on: Any, mass: Any = None) -> Coordinate:
        """Return the coordinate that a contact names by its `on`, with this effective mass (1 if
        `None`). If `on` is `None`, it is the machine's own coordinate."""
        if on is not None:
            return coordinate_by_name(on, mass)
        methods = ("position", "velocity", "placed")
        own = [name for name in methods if overridden(self, AbstractMachine, name)]
        given = {name: getattr(self, name) for name in own}
        return _default_coordinate(self)._replace(mass=1.0 if mass is None else mass, **given)

    def _names_on(self, on: Any) -> tuple[str, str] | None:
        """Return the names of position and velocity in a contact's `on`, or `None`."""
        return on if isinstance(on, tuple) else None

    @property
    def _first_coordinate(self) -> Coordinate:
        """The coordinate of the default `position`, `velocity` and `placed`: the first of the
        machine's `coordinates`, if it defines some."""
        return self.coordinates[0] if names_coordinates(self) else _default_coordinate(self)


def _events_in(machine: AbstractMachine) -> tuple[AbstractEvent, ...]:
    return (*machine._stops, *machine._switches, *machine._others)


def has_velocity(machine: AbstractMachine, state: State) -> bool:
    """Return whether `velocity` is a velocity. Without stops it may be another component."""
    defined = overridden(machine, AbstractMachine, "velocity") or names_coordinates(machine)
    return bool(defined) or bool(stops_of(machine)) or hasattr(state, "V")


def names_coordinates(machine: AbstractMachine) -> bool:
    """Return whether a machine has coordinates by name: a `Mechanical`, one with `coordinates`, or
    one whose contacts name them."""
    if defines(machine, "coordinates"):
        return True
    ons = (x.on for x in contacts_in(machine) if isinstance(x, Wall))  # pyright: ignore[reportAttributeAccessIssue]
    return any(on is not None for on in ons) or machine._names_on(None) is not None


def labels_in(machine: AbstractMachine, state: State) -> tuple[str, str]:
    """Return the labels of position and velocity, which are the first components of a state by name
    if nothing else names them."""
    labels = machine.labels
    own = overridden(machine, AbstractMachine, "position") is not None
    if labels != PLAIN or own or stops_of(machine) or hasattr(state, "Y"):
        return labels
    named = [x for x in components(state) if x[:1].isalpha()][:2]
    if not named:
        return labels
    in_array = ["[" in x for x in named]
    return named[0], named[-1] if in_array[-1] == in_array[0] else named[0]


def renews(machine: AbstractMachine) -> bool:
    """Return whether a machine defines `renewed`."""
    return overridden(machine, AbstractMachine, "renewed") is not None


def jumps_on_section(machine: AbstractMachine) -> bool:
    """Return whether the state jumps at the end of a cycle: by `renewed`, or by a whole turn."""
    return renews(machine) or counts_turns(machine)
