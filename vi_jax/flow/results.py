"""Reasons why a simulation ended, and the classes of its results."""

import difflib
import enum
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from .._checks import array_module, concrete, from_host, one_of
from .._messages import count_of
from .._types import Scalar, State, xr
from ..machine import (
    PLAIN,
    Shown,
    Stated,
    Summarized,
    by_name,
    in_unit,
    name_in,
    plain,
    state_in_words,
    unit_of,
    with_modes,
    with_units,
    without_modes,
)

# A batch of at most this many members is listed one by one: a choice, as many as fit a line.
_MOST_LISTED = 8

if TYPE_CHECKING:
    _Member: Any = None

    class NamedEnumeration(eqx.Enumeration):
        def __getitem__(self, place: Any) -> Self: ...
        def __iter__(self) -> Iterator[Self]: ...

else:

    class _Member(eqx.Module):
        """A member of an enumeration, or one for each lane of a batch."""

        number: Any
        kind: type = eqx.field(static=True)

        def __eq__(self, other):
            if not isinstance(other, self.kind):
                raise ValueError(f"A {self.kind.__name__} has no order with {other!r}.")
            known = concrete(self.number), concrete(other.number)
            if known[0] is None or known[1] is None:
                return jnp.equal(self.number, other.number)
            same = np.asarray(np.equal(*known))
            return from_host(same) if isinstance(self.number, jax.Array) else same

        def __ne__(self, other):
            return ~(self == other)

        def __getitem__(self, place):
            return _Member(_at(self.number, place), self.kind)

        def __iter__(self):  # Python's own would not end: JAX repeats the last lane
            return (self[i] for i in range(len(self.number)))

        def __int__(self) -> int:
            name = self.kind.__name__
            first = next(iter(self.kind._texts))
            raise TypeError(
                f"A {name} is no integer. Compare it with `vi.{name}.{first}` or another member; "
                f"`vi.{name}[...]` is its text."
            )

        def __repr__(self) -> str:
            name, number = self.kind.__name__, self.number
            if isinstance(number, Tracer):
                return f"{name}<traced>"
            if not isinstance(number, jnp.ndarray | np.ndarray):
                return f"{name}<unknown>"
            found = names_of(self.kind)[number]
            if not found.ndim:
                return f"{name}.{found}"
            if found.size <= _MOST_LISTED:
                return f"{name}{found.tolist()}".replace("'", "")
            kinds, counts = np.unique(found, return_counts=True)
            parts = (f"{count:,} {kind}" for kind, count in zip(kinds, counts, strict=True))
            return f"{name}[{', '.join(parts)}; shape {found.shape}]"

    class _Kind(type):
        def __new__(mcs, name, bases, namespace):
            texts = {k: x for k, x in namespace.items() if isinstance(x, str) and k[0] != "_"}
            cls = super().__new__(mcs, name, bases, namespace)
            cls._texts = texts
            for number, word in enumerate(texts):
                setattr(cls, word, _Member(np.asarray(number, np.int32), cls))
            return cls

        def __instancecheck__(cls, value):
            return isinstance(value, _Member) and value.kind is cls

        def __getitem__(cls, item):
            number = getattr(item, "number", item)
            if np.ndim(number):
                raise TypeError(
                    f"`{cls.__name__}[...]` must get one lane, but got {np.size(number)}. Take the "
                    f"text of each: `{cls.__name__}[run.result[0]]`."
                )
            return list(cls._texts.values())[int(number)]

        def __getattr__(cls, name: str) -> Any:
            if name.startswith("_"):
                raise AttributeError(name)
            near = difflib.get_close_matches(name, cls._texts, n=3, cutoff=0.5)
            words = f"{'near names' if near else 'its members'}: {', '.join(near or cls._texts)}"
            raise AttributeError(f"`{cls.__name__}` has no member {name!r}; {words}.")

    class NamedEnumeration(metaclass=_Kind):
        """Names with a text each, as class attributes. Members are pytrees, which may be traced and
        batched, and `RESULTS[item]` is the text of one, or of its number."""

        @classmethod
        def where(cls, condition, a, b):
            """Apply `jnp.where` to two members."""
            array = array_module(condition, a.number, b.number)
            return _Member(array.where(condition, a.number, b.number), cls)


def names_of(kind: Any) -> np.ndarray:
    """Return the names of the members of an enumeration, in their order."""
    return np.asarray(list(kind._texts))


def in_names(member: Any) -> np.ndarray:
    """Return the names of members, one for each lane."""
    return np.asarray(names_of(member.kind)[np.asarray(member.number)])


def raised(result: Any, failed: Any, what: str, member: Any) -> Any:
    """Return a result. **Raises:** `RuntimeError` with the reasons, `member`, if any lane failed;
    one without reasons while it is traced."""
    if isinstance(failed, Tracer):
        return eqx.error_if(result, failed, f"{what}; see its `result`.")
    names = np.ravel(in_names(member))[np.ravel(failed)]
    if names.size:
        texts = (f"{name}: {member.kind[getattr(member.kind, name)]}" for name in sorted({*names}))
        raise RuntimeError(f"{what}, {' '.join(texts)}")
    return result


def number_of(member: Any) -> Int[Array, "..."]:
    """Return the index of a member in its enumeration; one for each lane."""
    return jnp.asarray(member.number)


def member_of(kind: Any, number: Any) -> Any:
    """Return the member of an enumeration with this index; one for each lane."""
    return _Member(jnp.asarray(number, jnp.int32), kind)


def _at(x: Any, place: Any) -> Any:
    """Return x[place], by NumPy if `x` is known and in this computer's memory."""
    in_memory = isinstance(x, jax.Array) and not isinstance(x, Tracer)
    if not in_memory or any(device.platform != "cpu" for device in x.devices()):
        return x[place]
    return from_host(np.asarray(x)[place])


class EventKind(enum.IntEnum):
    """The kinds of events in an `EventLog`."""

    impact = 0
    """A body hits a rigid stop."""
    rest = 1
    """A body comes to rest on a stop."""
    release = 2
    """A body leaves the stop on which it rested."""
    mode = 3
    """A switch changes its mode."""
    reset = 4
    """One of the machine's `events`."""


EVENTS = tuple(kind.name for kind in EventKind)
"""The names of the kinds of events in an `EventLog`: `impact` on a stop; `rest` on a stop;
`release` from it; change of a switch's `mode`; `reset`, one of the machine's `events`."""

Variables = dict[str, tuple[tuple[str, ...], np.ndarray]]


def batch_names(dims: Sequence[str] | None, number: int) -> tuple[str, ...]:
    """Return the names of the batch axes. **Raises:** `ValueError` if `dims` has another number."""
    if dims is None:
        return ("lane",) if number == 1 else tuple(f"lane_{i}" for i in range(number))
    if isinstance(dims, str) or len(dims) != number:
        raise ValueError(
            f"Argument `dims` must name the {number} batch axes of this result, but got {dims!r}."
        )
    return tuple(dims)


def states(prefix: str, state: State, dims: tuple[str, ...]) -> Variables:
    """Return the components of a state as variables; arrays among them have further dimensions."""
    found = {}
    for name, x in by_name(state).items():
        name, x = name or "state", np.asarray(x)
        inner = tuple(f"{name}_{i}" for i in range(x.ndim - len(dims)))
        found[f"{prefix}_{name}"] = (*dims, *inner), x
    return found


def present(values: Mapping[str, Any], dims: tuple[str, ...]) -> Variables:
    """Return the entries that are not `None`, as variables."""
    return {name: (dims, np.asarray(x)) for name, x in values.items() if x is not None}


def tidy(data: "xr.Dataset", along: str | None) -> "xr.Dataset":
    """Return the variables of a data set along one dimension, as a table with a row for each of its
    points; by default the data set. **Raises:** `ValueError` if there is no such dimension."""
    if along is None:
        return data
    columns = {}
    for name, x in data.data_vars.items():
        columns |= _columns(str(name), x)
    last = {name: str(x.dims[-1]) for name, x in columns.items() if x.dims}
    one_of("along", along, tuple(dict.fromkeys(last.values())))
    return data.assign(columns)[[name for name, dim in last.items() if dim == along]]


def _columns(name: str, x: Any) -> dict[str, Any]:
    """Return a variable, or one for each number of an array in the state (see `states`)."""
    inner = [dim for dim in map(str, x.dims) if name.endswith("_" + dim.rpartition("_")[0])]
    if not inner:
        return {name: x}
    shape = [x.sizes[dim] for dim in inner]
    return {
        name + str(list(place)): x.isel(dict(zip(inner, place, strict=True)))
        for place in np.ndindex(*shape)
    }


_IMPACT = ("phase", "speed", "stop", "impulse", "drag")

# Logs, by their dimension, and the variable that is negative in unused places.
_LOGS = {"impact": "log_stop", "event": "event_number"}


def _used_rows(log: Any, number: str) -> Any:
    """Return the entries of a log as rows, without unused places, in which `number` is negative."""
    rows = log.stack(row=log[number].dims).reset_index("row")
    return rows.isel(row=np.flatnonzero(np.asarray(rows[number]) >= 0))


def run_dataset(
    run: Any, dims: Sequence[str] | None, result: np.ndarray, along: str | None
) -> "xr.Dataset":
    batch = batch_names(dims, run.steps.ndim)
    cycle, section = (*batch, "cycle"), (*batch, "section")
    names = ("y_max", "y_min", "impacts", "impact_speed", "rests", "reduced", "impact_energy",
             "clearance", "duration", "frequency_ratio")  # fmt: skip
    variables = states("section", run.sections, section)
    variables |= present({name: getattr(run, name) for name in names} | run.averages, cycle)
    variables |= states("section", run.quantities, section)
    variables |= states("section", {f"mode_{i}": x for i, x in enumerate(run.modes)}, section)
    count = run.impacts.shape[-1]
    coordinates: dict[str, Any] = {
        "cycle": np.arange(1, count + 1), "section": np.arange(count + 1),
    }  # fmt: skip
    if run.samples is not None:
        sample = (*batch, "sample")
        variables |= states("sample", run.samples.state, sample)
        variables |= states("sample", run.samples.quantities, sample)
        variables["sample_time"] = sample, np.asarray(run.samples.time)
        place = np.asarray(run.samples.cycles)
        coordinates["sample"] = place.reshape(-1, place.shape[-1])[0]
    if run.impact_log is not None:
        log = (*cycle, "impact")
        more = {f"log_{name}": getattr(run.impact_log, name) for name in _IMPACT}
        variables |= present(more, log)
    if run.event_log is not None:
        names = ("phase", "number", "value")
        more = {f"event_{name}": getattr(run.event_log, name) for name in names}
        more["event_kind"] = np.asarray([*EVENTS, ""])[np.asarray(run.event_log.kind)]
        variables |= present(more, (*cycle, "event"))
    if run.errors is not None:
        variables |= states("error_section", run.errors.sections, section)
        more = {f"error_{name}": getattr(run.errors, name) for name in ("y_max", "y_min")}
        variables |= present(more, cycle)
    variables |= present({"result": result, "steps": run.steps, "rejected": run.rejected}, batch)
    if run.outcome is not None:
        more = {name: getattr(run, name) for name in ("outcome_cycle", "outcome_phase")}
        more["outcome"] = np.asarray([*run.outcomes, ""])[np.asarray(run.outcome)]
        variables |= present(more, batch) | states("outcome_state", run.outcome_state, batch)
    averages = {name: name for name in run.averages}
    data = tidy(with_units(xr.Dataset(variables, coordinates), dict(run.units), averages), along)
    return _used_rows(data, _LOGS[along]) if along in _LOGS else data


class RESULTS(NamedEnumeration):
    """The reason why a lane ended, one for each lane."""

    successful = ""
    bad_start = (
        "The start or a number of the machine is not finite or out of its range, or the start lies "
        "beyond a stop."
    )
    stalled = (
        "The crank stopped turning forward, which the phase clock cannot follow. Simulate with "
        '`clock="time"`.'
    )
    chatter = (
        "The impacts within one cycle exceeded `max_impacts` (perhaps no event ends the cycle), "
        "or followed each other too fast to be told apart (chatter)."
    )
    underflow = (
        "The step size fell below what the precision resolves: the motion goes to infinity in "
        "finite time, or the tolerance is too small."
    )
    not_finite = "The state ceased to be finite."
    unresolved = "An impact could not be located within the step."
    max_steps = (
        "The number of steps exceeded `max_steps` before the last cycle was complete, or 65,536 "
        "within one, as where an autonomous machine comes to rest off its section, or a relay "
        "without hysteresis switches ever faster."
    )
    switch_unresolved = "The event of a switch could not be located within the step."
    section_unresolved = (
        "The end of a cycle (an event, or the clock) could not be located within the step."
    )
    turn_unresolved = (
        "A turning point, or the release of a body from rest, could not be located within the "
        "step. The `on` of a stop must have the position first, then its velocity."
    )
    bad_impact = (
        "An impact left faster than it came, or further into its stop: a restitution law must have "
        "values in [0, 1]."
    )
    simultaneous = (
        "The impacts of bodies that touch each other, or the events that trigger each other, did "
        "not come to an end within one instant."
    )
    sliding = (
        "The field on both sides of a switch points at its surface, so the motion would have to "
        "slide along it. A `Switch` allows this with `slides=True`."
    )
    reset_unresolved = "The event of a reset could not be located within the step."
    bad_reset = "A reset put a body beyond a stop."
    unstable = (
        "The error of a fixed step was as large as the state, as under strong damping. Take more "
        "steps, define the machine's `relaxation` or `step_limit`, or use `Adaptive`."
    )
    jammed = (
        "No motion with a closed contact or a sticking body fulfils Coulomb's law of friction, as "
        "for a rod that is pushed into rough ground (Painlevé's paradox), or the `level` or `load` "
        "of a `DryFriction` became negative. Write `jnp.maximum(..., 0)` for a body that lifts off."
    )
    full_history = (
        "The steps within the longest delay are more than the history holds. Write a larger "
        "`history_size` in the machine's class, such as `history_size = 1024`."
    )
    ended = "An event of the machine ended the motion, with the outcome `Run.outcome`."


REASON_NAMES = tuple(names_of(RESULTS).tolist())
"""The names of `RESULTS`, in the order of the numbers by which the loop represents them."""


def code(name: str) -> float:
    """Return the number that represents the reason of this name in the loop; 0 is success."""
    return float(REASON_NAMES.index(name))


# The number of an outcome is added as a fraction to the common reason, `ended`.
_OUTCOMES = 4096


def code_of_outcome(number: int) -> float:
    """Return the reason of a lane that an event ended, with the number of its outcome."""
    return code("ended") + number / _OUTCOMES


def outcome_of(reason: Scalar) -> Int[Array, ""]:
    """Return the index of the outcome among the machine's; -1 if no event ended the lane."""
    number = jnp.round((reason - code("ended")) * _OUTCOMES).astype(jnp.int32)
    return jnp.where(jnp.floor(reason) == code("ended"), number, -1)


def reason_of(reason: Scalar) -> RESULTS:
    return member_of(RESULTS, jnp.floor(reason))


def span_of_position(
    labels: tuple[str, str], units: Mapping[str, str], ends: tuple[Any, Any], digits: int
) -> str:
    """Return the interval of the position, with its name and unit."""
    name, size = name_in(labels[0]), max(abs(float(x)) for x in ends)
    low, high = (plain(x, digits, size) for x in ends)
    quantity = "position" if unit_of(units, "position") else name
    return f"{name} in {in_unit(f'[{low}, {high}]', units, quantity)}"


class Samples(Shown):
    """Dense samples, evenly spaced in the cycle; arrays have shape (cycles · samples + 1,)."""

    cycles: Float[Array, " points"]
    """Positions of the samples on the drive's clock, in cycles since the start."""
    time: Float[Array, " points"]
    """Time τ since the start (in units of `s` for machines of your own)."""
    state: State
    """The states, a pytree like the start."""
    quantities: dict[str, Float[Array, " points"]] = eqx.field(default_factory=dict)
    """The machine's own quantities at the samples, by name (see `AbstractMachine.quantities`)."""
    modes: tuple[Float[Array, " points"], ...] = ()
    """The machine's own modes at the samples (see `AbstractMachine.modes`)."""


# Greatest numbers of cycles, and of events in each, in a printed summary.
_CYCLES, _EVENTS = 8, 6


def _listing(what: str, used: object, text: Callable[[int, int], str]) -> str:
    """Return the number of entries and a line for each of the first cycles. `used`, (…, cycles,
    size), is true for entries in use; `text` returns the text of the entry at a cycle and place."""
    used = np.asarray(used)
    if used.ndim > 2:
        return f"{int(used.sum())} {what}s in lanes of shape {used.shape[:-2]}"
    many = count_of(int(used.sum()), what)
    lines = [f"{many} listed in {count_of(len(used), 'cycle')}"]
    some = np.flatnonzero(used.any(axis=1))
    for i in some[:_CYCLES]:
        places = np.flatnonzero(used[i])
        words = [text(int(i), int(j)) for j in places[:_EVENTS]]
        more = [f"and {len(places) - _EVENTS} more"] * (len(places) > _EVENTS)
        lines.append(f"  cycle {i + 1}: {', '.join([*words, *more])}")
    if len(some) > _CYCLES:
        lines.append(f"  and {len(some) - _CYCLES} more cycles")
    full = int(used.all(axis=1).sum()) if used.shape[1] else 0
    if full:
        cycles, size = count_of(full, "cycle"), used.shape[1]
        lines.append(f"  {what}s after the first {size} are not listed; {cycles} may have more")
    return "\n".join(lines)


class ImpactLog(Summarized):
    """The first impacts of each cycle in their order; arrays have shape (cycles, size).

    Unused places hold NaN, and -1 in `stop`.
    """

    phase: Float[Array, "cycles size"]
    """Clock of the cycle at the impact, in the machine's units: the crank angle in [0, 2π] for a
    `Scene`, the variable that counts the cycles for any other."""
    speed: Float[Array, "cycles size"]
    """V⁻, speed of approach just before the impact."""
    stop: Int[Array, "cycles size"]
    """Number of the rigid stop."""
    impulse: Float[Array, "cycles size"]
    """Impulse of the stop on the body, away from the stop (unit of mass times that of speed)."""
    drag: Float[Array, "cycles size"]
    """Impulse of friction along the stop; 0 without friction."""
    stop_names: tuple[str, ...] = eqx.field(static=True, default=())
    """The names of the rigid stops, by number."""

    def summary(self) -> str:
        """Return the impacts of the first cycles: clock, stop and speed."""

        def word(i: int, j: int) -> str:
            stop = self.stop_names[int(self.stop[i, j])]
            return f"{stop} at {self.phase[i, j]:.6g} by {self.speed[i, j]:.4g}"

        return _listing("impact", self.stop >= 0, word)


class EventLog(Summarized):
    """The first events of each cycle, of all kinds, in their order; arrays have shape (cycles,
    size).

    Unused places hold NaN, and -1 in `kind` and `number`.
    """

    phase: Float[Array, "cycles size"]
    """Clock of the cycle at the event, as in `ImpactLog`."""
    kind: Int[Array, "cycles size"]
    """The kind of the event: an index into `EVENTS`."""
    number: Int[Array, "cycles size"]
    """The number of the stop, switch or event: among the rigid stops; for a mode among soft stops,
    frictions and switches; for a reset among the other events."""
    value: Float[Array, "cycles size"]
    """V⁻ of an impact, or of the impact before rest; the mode of a switch after its change; the
    `value` of a reset; NaN for a release."""
    names: tuple[str, ...] = eqx.field(static=True, default=())
    """The names of the machine's resets, by number; "" for one without a name."""
    mode_names: tuple[str, ...] = eqx.field(static=True, default=())
    """The names of the parts with a mode, by number: a friction, a soft stop, a switch."""
    stop_names: tuple[str, ...] = eqx.field(static=True, default=())
    """The names of the rigid stops, by number."""

    def summary(self) -> str:
        """Return the events of the first cycles: kind; stop, switch or event; clock."""

        def word(i: int, j: int) -> str:
            kind, number = EVENTS[int(self.kind[i, j])], int(self.number[i, j])
            after = f" becomes {self.value[i, j]:g}" if kind == "mode" else ""
            names = {"mode": self.mode_names, "reset": self.names}.get(kind, self.stop_names)
            return f"{kind} ({names[number] or f'event {number}'}{after}) at {self.phase[i, j]:.6g}"

        return _listing("event", self.number >= 0, word)


class Errors(Shown):
    """Estimated errors of a run: its differences from a run by the method's `tighter` one.

    They are NaN if either run failed. In a chaotic motion they grow until they are as large as the
    motion. Under `vmap` batch axes come first.
    """

    sections: State
    """Errors of the section states, a pytree like them; leaves (cycles + 1,)."""
    y_max: Float[Array, " cycles"] | None
    """Error of the greatest Y in each cycle."""
    y_min: Float[Array, " cycles"] | None
    """Error of the smallest Y in each cycle."""
    impacts: Int[Array, " cycles"]
    """Difference of the impact counts in each cycle."""


class Run(Summarized):
    """The result of `simulate`, cycle by cycle. After a failure the rest is NaN (counts: 0).

    Under `vmap` every array has the batch axes in front. Numbers are in the machine's units (see
    `AbstractMachine.units`): those of a `Scene` in a, ω and m_C.
    """

    sections: State
    """States at the start and after each cycle, a pytree like the start; leaves (cycles + 1,), with
    further axes for an array in the state."""
    y_max: Float[Array, " cycles"] | None
    """Greatest position (of the first coordinate) in each cycle, also between sample points."""
    y_min: Float[Array, " cycles"] | None
    """Smallest position of the motion in each cycle."""
    impacts: Int[Array, " cycles"]
    """Number of impacts in each cycle."""
    impact_speed: Float[Array, " cycles"] | None
    """Greatest V⁻ in each cycle, 0 without impact."""
    rests: Int[Array, " cycles"] | None
    """Number of times that the body came to rest on a stop. Its infinitely many last impacts are
    completed at once, and are not among `impacts`."""
    reduced: Int[Array, " cycles"] | None
    """Number of impacts with less than Newton's restitution: with friction or several contacts the
    whole would gain energy (see `RigidStop`). `None` if no impact can."""
    impact_energy: Float[Array, " cycles"] | None
    """Energy lost in impacts in each cycle: ½(1 - k²)V⁻² for each impact, ½V⁻² where the body came
    to rest, times the mass on which the impact acts."""
    clearance: Float[Array, " cycles"] | None
    """Smallest distance to a stop at which the body turned back in each cycle without touching it;
    infinite if it did not. If stops limit several coordinates, it is that of the coordinate that
    comes nearest during the run, as a share of its motion. It is recorded if `impact_log` is set.
    """
    duration: Float[Array, " cycles"] | None
    """Time τ that each cycle took."""
    frequency_ratio: Float[Array, " cycles"] | None
    """ζ: mean speed of the drive over each cycle."""
    samples: Samples | None
    """States within cycles, if `samples` is given."""
    impact_log: ImpactLog | None
    """Impacts one by one, if `impact_log` is given."""
    event_log: EventLog | None
    """Events of all kinds, if `event_log` is given."""
    errors: Errors | None
    """Estimated errors, if `estimate` is set."""
    result: RESULTS
    """The reason why the run ended: `RESULTS.successful`, or a failure."""
    steps: Int[Array, ""]
    """Steps tried, including those rejected or shortened to end at an event (in single precision
    they are counted up to 2²⁴)."""
    rejected: Int[Array, ""]
    """Steps rejected on their error estimate."""
    averages: dict[str, Float[Array, " cycles"]] = eqx.field(default_factory=dict)
    """The machine's own averages in each cycle, by name (see `AbstractMachine.averages`)."""
    quantities: dict[str, Float[Array, " sections"]] = eqx.field(default_factory=dict)
    """The machine's own functions of its state on the sections, by name; (cycles + 1,)."""
    labels: tuple[str, str] = eqx.field(static=True, default=PLAIN)
    """The names of position and velocity for this machine."""
    units: Stated = eqx.field(static=True, default=())
    """The units of its quantities, as the machine states them."""
    modes: tuple[Float[Array, " sections"], ...] = ()
    """The machine's own modes on the sections (see `AbstractMachine.modes`), each (cycles + 1,)."""
    outcome: Int[Array, ""] | None = None
    """The outcome with which an event ended the motion, as an index into `outcomes`; -1 without,
    and `None` for a machine without outcomes."""
    outcome_cycle: Int[Array, ""] | None = None
    """The number of cycles before that event, those of `settle` included; -1 without."""
    outcome_phase: Float[Array, ""] | None = None
    """The clock at the event, since the end of these cycles, as in `ImpactLog`; NaN without."""
    outcome_state: State | None = None
    """The state after the event, a pytree like the start; NaN without."""
    outcomes: tuple[str, ...] = eqx.field(static=True, default=())
    """The names of the outcomes with which events and stops of the machine end a motion."""
    history: Any = None
    """The history at the end, of a machine with delays, from which `last` continues."""

    @property
    def successful(self) -> jax.Array:
        """True if the lane completed all its cycles."""
        return self.result == RESULTS.successful

    @property
    def failed(self) -> jax.Array:
        """True if the lane has not completed its cycles, and no event of the machine ended it."""
        return ~self.successful & (self.result != RESULTS.ended)

    @property
    def last(self) -> State:
        """The state on the last section: a start to continue from, or a guess for `find_orbit`. For
        a machine with discrete modes or delays it is a `HybridState`, which contains them and the
        history."""
        # Batch axes come before the axis of the sections, those of an array in the state after it.
        # `steps` has one number for each lane, so that its axes are the batch axes.
        place = (*[slice(None)] * self.steps.ndim, -1)
        last, modes = jtu.tree_map(lambda x: _at(x, place), (self.sections, self.modes))
        return with_modes(last, modes, self.history)

    def mean_averages(self) -> dict[str, Scalar]:
        """Return the machine's own averages over the time of all cycles, of one lane."""
        if self.duration is None:
            return {}
        whole = jnp.sum(self.duration)
        return {name: jnp.sum(x * self.duration) / whole for name, x in self.averages.items()}

    def to_xarray(
        self, dims: Sequence[str] | None = None, *, along: str | None = None
    ) -> "xr.Dataset":
        """Return this run as an `xarray.Dataset`, labelled by cycle, section and sample.

        States become a variable for each component: `section_Y` (cycles + 1), `sample_Y`. An array
        in the state keeps its axes, as `q_0`, and a state that is one array is `section_state`. The
        impact log becomes `log_phase`, `log_speed` and `log_stop`; the log of all events
        `event_phase`, `event_kind` (in words), `event_number` and `event_value`. An `outcome` is in
        words, the state there `outcome_state_Y`. The machine's own quantities are `section_lift`
        and `sample_lift`. All other variables, averages included, keep their names, and `result` is
        the name of the reason. It runs on the host and cannot be traced.

        As a table, everything together would have a row for each combination of a cycle, a section,
        a sample and an impact. `to_xarray(along="cycle").to_dataframe()` has one for each cycle.

        **Arguments:** `dims`, names of the batch axes of a run under `vmap`, by default `lane`;
        `along`, the dimension to keep: `"cycle"`, `"section"`, `"sample"`, `"impact"` or `"event"`
        (with a row for each that happened), or a batch axis.

        **Raises:** `ValueError` if there are not as many names as batch axes, or no such dimension.
        """
        return run_dataset(self, dims, in_names(self.result), along)

    def _outcome_in_words(self) -> str | None:
        if self.outcome is None or self.outcome_cycle is None or self.outcome < 0:
            return None
        name = self.outcomes[int(self.outcome)]
        before = count_of(int(self.outcome_cycle), "cycle")
        clock = in_unit(f"{self.outcome_phase:.6g}", dict(self.units), "phase")
        return f"{name}, {before} and {clock} after the start"

    def summary(self) -> str:
        """Return the last section and cycle, and the reason why the run ended, as text."""
        if self.steps.ndim:
            good = int(np.sum(self.successful))
            ended = "" if self.outcome is None else f", {int(np.sum(self.outcome >= 0))} ended"
            return f"Run of {self.steps.size} lanes {self.steps.shape}, {good} successful{ended}"
        cycles = self.impacts.shape[-1]
        lines = [
            f"Run of {count_of(cycles, 'cycle')}, {count_of(int(np.sum(self.impacts)), 'impact')}"
        ]
        units, outcome = dict(self.units), self._outcome_in_words()
        last = without_modes(self.last) if outcome is None else self.outcome_state
        where = "section" if outcome is None else "state"
        lines.append(f"  last {where}: {state_in_words(last, 9, units)}")
        if outcome is None and self.y_min is not None and self.y_max is not None:
            ends = self.y_min[-1], self.y_max[-1]
            lines.append(f"  last cycle: {span_of_position(self.labels, units, ends, 6)}")
        for average, x in self.averages.items() if outcome is None else ():
            lines.append(f"    mean {average}: {in_unit(f'{x[-1]:.6g}', units, average)}")
        if self.errors is not None:
            worst = max(float(np.max(x)) for x in jtu.tree_leaves(self.errors.sections))
            lines.append(f"  error of the sections, estimated: {worst:.2g}")
        lines.append(f"  steps: {int(self.steps)} tried, {int(self.rejected)} rejected")
        ended = outcome or ("completed" if bool(self.successful) else RESULTS[self.result])
        return "\n".join([*lines, f"  ended: {ended}"])
