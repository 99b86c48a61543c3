"""The events of a machine by their numbers: their guards, what happens then; and its modes, in a
state or beside it.

An argument `number` is that of an event, `modes` are all of the machine, before the event, and
`contact` is as in `Around`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax.flatten_util import ravel_pytree
from jax.lax import stop_gradient

from .._types import Machine, Scalar, Scalars, State, Vector
from .contacts import with_friction_impulse
from .event import AbstractEvent, Around, Modes, Section
from .friction import chosen_together, frictions_in
from .own import declared_modes, has_own_modes, others_of, stops_of, switches_of
from .shown import Shown


def events_of(machine: Machine) -> tuple[AbstractEvent, ...]:
    """All events of a machine, in the order in which they are numbered: its stops, its switches,
    its other events, its section."""
    return (*stops_of(machine), *switches_of(machine), *others_of(machine), Section())


def is_autonomous(machine: Machine, state: State) -> bool:
    """Whether an event ends the cycles of a machine, instead of its clock."""
    ends = any(event.ends_cycle for event in events_of(machine)[:-1])
    return ends or machine._section(state) is not None


def section_number(machine: Machine) -> int:
    """The section's number among the machine's events: the last."""
    return len(events_of(machine)) - 1


def guard_of(
    machine: Machine, number: int, s: Scalar, state: State, modes: Modes, contact: Scalars = ()
) -> Scalar:
    """The guard of one of a machine's events, which rises through zero where it happens."""
    event, own, more = event_of(machine, number, modes, contact)
    return event.guard(machine, s, state, *modes[own], **more)


def sides_of(
    machine: Machine, number: int, s: Scalar, state: State, modes: Modes, contact: Scalars = ()
) -> Scalars:
    """Smooth functions of which the greatest is the guard of one of a machine's events."""
    event, own, more = event_of(machine, number, modes, contact)
    return tuple(map(jnp.asarray, event.sides(machine, s, state, *modes[own], **more)))


def jump_of(machine: Machine, number: int, s: Scalar, state: State, modes: Modes) -> State:
    """The state after one of a machine's events as a smooth function of that before it (see
    `AbstractEvent.jump`)."""
    event, own, _ = event_of(machine, number, modes, ())
    return _with_friction(machine, number, s, state, event.jump(machine, s, state, *modes[own]))


def happens_at(machine: Machine, number: int, s: Scalar, state: State, modes: Modes) -> Any:
    """Whether one of a machine's events happens where its guard has risen; `None` if always."""
    event, own, _ = event_of(machine, number, modes, ())
    return event.happens(machine, s, state, *modes[own])


def value_of(machine: Machine, number: int, s: Scalar, state: State, modes: Modes) -> Any:
    """What the log of events keeps of one of a machine's events."""
    event, own, _ = event_of(machine, number, modes, ())
    return event.value(machine, s, state, *modes[own])


def after_event(
    machine: Machine, number: int, s: Scalar, state: State, modes: Modes, contact: Scalars = ()
) -> tuple[State, Modes]:
    """State and modes after one of a machine's events."""
    event, own, more = event_of(machine, number, modes, contact)
    new, changed = event.after(machine, s, state, *modes[own], **more)
    if event.holds_mode:
        changed = (*modes[: own.start], changed, *modes[own.stop :])
        if event.is_dry and len(frictions_in(machine)) > 1:
            changed, held = settled_modes(changed, s), modes[own.start] == 0
            changed = chosen_together(machine, s, new, changed, contact, (own.start, held))
    return _with_friction(machine, number, s, state, new), settled_modes(changed, s)


def _with_friction(machine: Machine, number: int, s: Scalar, before: State, after: State) -> State:
    friction = friction_on(machine, number)
    if friction is None:
        return after
    return with_friction_impulse(machine, number, friction, s, before, after).state


def friction_on(machine: Machine, number: int) -> Any:
    """The friction on stop number `number`, or `None`."""
    if number >= len(stops_of(machine)):
        return None
    return next((x for x in switches_of(machine) if x.friction_stop == number), None)


def has_contact_friction(machine: Machine) -> bool:
    """Whether there is friction on one of its stops."""
    return any(x.friction_stop is not None for x in switches_of(machine))


def mode_number(machine: Machine, number: int) -> int:
    """The place among the machine's modes of the one that an event holds."""
    return sum(event.holds_mode for event in events_of(machine)[:number])


def own_modes(machine: Machine, modes: Modes) -> Modes:
    """Return those of a machine's modes that no event holds: its own."""
    return modes[mode_number(machine, len(events_of(machine))) :]


def event_of(
    machine: Machine, number: int, modes: Modes, contact: Scalars
) -> tuple[AbstractEvent, slice, dict[str, Around]]:
    """An event, which of the machine's modes its methods get (its own or all), and what keyword
    arguments besides."""
    event = events_of(machine)[number]
    if not event.holds_mode:
        return event, slice(None), {}
    own = mode_number(machine, number)
    more = {"around": Around(modes, own, contact)} if event.sees_around else {}
    return event, slice(own, own + 1), more


def begin_modes(
    machine: Machine, s: Scalar, state: State, own: Sequence[Any] | None = None
) -> Modes:
    """The modes of a motion that begins in `state`: those that events hold, in their order, then
    the machine's own, which are `own` where that is given."""
    state = jtu.tree_map(jnp.asarray, state)  # a start may hold Python's numbers
    held = [event for event in events_of(machine) if event.holds_mode]
    own = modes_at_start(machine, s, state) if own is None else own
    modes = [*(event.begin(machine, s, state) for event in held), *own]
    modes = settled_modes(modes, s)
    if any(event.sees_around for event in held):  # which looks at the other modes
        modes = struck_modes(machine, s, state, modes)
    return modes


def struck_modes(
    machine: Machine, s: Scalar, state: State, modes: Modes, own: Sequence[Any] | None = None,
    contact: Scalars = (),
) -> Modes:  # fmt: skip
    """The modes after the state has jumped to this one, the machine's own as they are or `own`."""
    held = []
    together = holds_anywhere(machine) and len(frictions_in(machine)) > 1
    for number, event in enumerate(events_of(machine)):
        if together and (event.is_dry or getattr(event, "friction_stop", None) is not None):
            held.append(event.slip_sign(machine, s, state))  # pyright: ignore
        elif event.holds_mode:
            _, place, more = event_of(machine, number, modes, contact)
            held.append(event.struck(machine, s, state, *modes[place], **more))
    kept = modes[len(held) :] if own is None else own
    modes = settled_modes([*held, *kept], s)
    if together:
        modes = settled_modes(chosen_together(machine, s, state, modes, contact), s)
    return modes


def holds_anywhere(machine: Machine) -> bool:
    """Whether there is friction that may hold a body wherever that is."""
    return any(x.is_dry for x in switches_of(machine))


def modes_at_start(machine: Machine, s: Scalar, state: State) -> tuple[Any, ...]:
    """The machine's own modes of a motion that begins in `state`."""
    modes = machine.modes
    return _values(modes(s, state) if callable(modes) else declared_modes(machine))


def _values(modes: Any) -> tuple[Any, ...]:
    """Modes as a user gives them, one, several or by name, in a tuple."""
    if isinstance(modes, Mapping):
        return tuple(modes.values())
    return tuple(modes) if isinstance(modes, tuple | list) else (modes,)


def modes_after(machine: Machine, found: Any, modes: Modes, whose: str) -> tuple[Any, ...]:
    """The machine's own modes after an event, of which a user's function, `whose`, returned all, or
    a dictionary of those that change.

    **Raises:** `TypeError` for a name that the machine does not declare.
    """
    names = tuple(declared_modes(machine))
    if not isinstance(found, Mapping) or not names:
        return _values(found)
    extra = [name for name in found if name not in names]
    if extra:
        raise TypeError(
            f"{whose} returned the mode {extra[0]!r}, which the machine does not have. Its `modes` "
            f"are {', '.join(names)}."
        )
    pairs = zip(names, own_modes(machine, modes), strict=True)
    return tuple(found.get(name, old) for name, old in pairs)


def settled_modes(modes: Sequence[Any], s: Scalar) -> Modes:
    """Modes as the loop carries them: floats, which nothing is differentiated by."""
    return tuple(stop_gradient(jnp.asarray(mode, jnp.result_type(s))) for mode in modes)


class HybridState(Shown):
    """A state together with the machine's discrete modes, a start that continues another motion.

    A machine with discrete modes (`AbstractMachine.modes`) is not determined by its state alone.
    `Run.last` and `Orbit.state` of such a machine are of this class. Its components are those of
    `state`: `run.last.Y` is `run.last.state.Y`.

    **Arguments:**

    - `state`: the state, as the machine's field receives it.
    - `modes`: the machine's discrete modes, a tuple in the order of its `modes`.
    """

    state: Any
    modes: tuple[Any, ...]

    def __getattr__(self, name: str) -> Any:
        if name in ("state", "modes") or name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.state, name)

    def __getitem__(self, place: Any) -> Any:
        return self.state[place]


def bare(state: State) -> State:
    """The state without modes."""
    return state.state if isinstance(state, HybridState) else state


def modes_of(state: State) -> tuple[Any, ...] | None:
    """The machine's own modes in a state; `None` if it says nothing of them."""
    return state.modes if isinstance(state, HybridState) else None


def with_modes(state: State, modes: tuple[Any, ...] | None) -> State:
    """Return the state in these modes of the machine's own; as it is if there are none."""
    return HybridState(state, modes) if modes else state


def replaced(state: State, new: State) -> State:
    """Another state in the same modes."""
    return HybridState(new, state.modes) if isinstance(state, HybridState) else new


def begun(machine: Machine, state: State, axes: int = 0) -> State:
    """The state with the modes of a motion that begins in it; as it is if it has some, or the
    machine has none of its own.

    **Arguments:** `axes`, how many axes the state has in front.
    """
    if isinstance(state, HybridState) or not has_own_modes(machine):
        return state

    def begin(state: State) -> Any:
        zero = jnp.zeros_like(machine.position(state))
        return settled_modes(modes_at_start(machine, zero, state), zero)

    for _ in range(axes):
        begin = jax.vmap(begin)
    return with_modes(state, begin(state))


def raveled(state: State) -> tuple[Vector, Callable[[Vector], State]]:
    """`ravel_pytree` of a state whose modes stay what they are: they are no unknowns."""
    row, unravel = ravel_pytree(bare(state))
    return row, lambda row: replaced(state, unravel(row))
