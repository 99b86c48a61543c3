"""What is checked of the parts of a machine that a user wrote: stops, coordinates, events."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._checks import concrete
from .._types import Scalar, Scalars, State
from ..machine import (
    AbstractEvent,
    AbstractMachine,
    AbstractSwitch,
    Coordinate,
    LinearMachine,
    Reset,
    RigidStop,
    SoftStop,
    event_of,
    events_of,
    listed,
)
from ._own import in_short, in_words_of, rows_of

_KINDS = {
    "contacts": (
        (RigidStop, AbstractSwitch),
        "contacts: `RigidStop`s, `SoftStop`s and `DryFriction`s",
    ),
    "stops": (RigidStop, "`RigidStop`s"),
    "switches": (AbstractSwitch, "`AbstractSwitch`es, as `SoftStop` and `DryFriction` are"),
    "events": (AbstractEvent, "`AbstractEvent`s, as `Reset` and `Switch` are"),
}


def check_parts(machine: AbstractMachine) -> None:
    """**Raises:** `TypeError` or `ValueError` for a machine whose parts are not what they must be;
    before anything is traced."""
    name = type(machine).__name__
    for what, (kind, words) in _KINDS.items():
        parts = listed(getattr(machine, what))
        if not isinstance(parts, tuple) or not all(isinstance(part, kind) for part in parts):
            hint = " Write `@property` above its `def`." if callable(parts) else ""
            raise TypeError(
                f"`{what}` of a {name} must be a tuple of {words}, but is {parts!r}.{hint}"
            )
    _check_names(machine)
    if callable(machine.cycle):
        raise TypeError(f"`cycle` of a {name} must be a number, or a property that gives one.")
    if jnp.shape(machine.cycle):
        raise ValueError(
            f"`cycle` of a {name} must be one number, but has shape {jnp.shape(machine.cycle)}."
            f"{rows_of(machine)}"
        )
    cycle = concrete(machine.cycle)
    if cycle is not None and not (np.isfinite(cycle) & (cycle > 0)).all():
        raise ValueError(f"`cycle` of a {name} must be positive and finite, but is {cycle}.")
    many = len(machine.coordinates)
    for i, stop in enumerate(machine.stops):
        for part in ("gap", "restitution"):
            shape = () if callable(getattr(stop, part)) else jnp.shape(getattr(stop, part))
            if shape:
                raise ValueError(
                    f"Stop {i} of a {name} must have one number as `{part}`, but has shape {shape}."
                    f"{rows_of(machine)}"
                )
        if stop.coordinate >= many:
            raise ValueError(
                f"Stop {i} of a {name} limits coordinate {stop.coordinate}, but there are {many}: "
                "name each in `coordinates`."
            )
        if stop.at is not None and not isinstance(machine, LinearMachine):
            raise ValueError(
                f"Stop {i} of a {name} has an `at`, which only a linear machine "
                "(`vi.machines.Structure`) takes; other machines name what stops limit in "
                "`coordinates`, and stops its number in `coordinate`."
            )
    _check_frictions(machine)


def _check_names(machine: AbstractMachine) -> None:
    """**Raises:** `ValueError` for a stop that names no velocity."""
    if type(machine).coordinate_on is not AbstractMachine.coordinate_on:
        return
    for stop in listed(machine.contacts):
        on = getattr(stop, "on", None)
        if isinstance(stop, RigidStop | SoftStop) and on is not None and not _is_pair(on):
            raise ValueError(
                f"Argument `on` of a stop of a {type(machine).__name__} must be the names of "
                f'position and velocity, `on=("x", "u")`, but got {on!r}.'
            )


def _is_pair(on: Any) -> bool:
    return isinstance(on, tuple) and len(on) == 2 and all(isinstance(x, str) for x in on)


def _check_frictions(machine: AbstractMachine) -> None:
    """**Raises:** `ValueError` for friction on a stop that there is not, or not along it."""
    name = type(machine).__name__
    known = {
        "stop": ("stop", len(machine.stops)),
        "along": ("coordinate", len(machine.coordinates)),
    }
    for switch in machine.switches:
        if switch.rubs_on is None:
            continue
        for argument, (what, count) in known.items():
            number = getattr(switch, argument)
            if number >= count:
                raise ValueError(
                    f"Argument `{argument}` of a ContactFriction must be the number of a {what} of "
                    f"the {name}, which has {count}, but got {number}."
                )
        across = machine.stops[switch.rubs_on].coordinate
        if switch.along == across:  # pyright: ignore[reportAttributeAccessIssue]
            raise ValueError(
                f"Argument `along` of a ContactFriction must be the number of the coordinate that "
                f"slips along the stop, but got {across}, which stop {switch.rubs_on} of the "
                f"{name} limits."
            )


def check_events(machine: AbstractMachine, s: Scalar, state: State, modes: Scalars) -> None:
    """**Raises:** `TypeError` for a coordinate or an event whose functions do not return what they
    must; while the loop is traced, and at no cost where it runs."""
    name = type(machine).__name__
    for k, coordinate in enumerate(machine.coordinates if machine.stops else ()):
        _check_mass(f"`mass` of coordinate {k} of a {name}", coordinate, s, state)
        whose = f"`placed` of coordinate {k} of a {name}"
        place, velocity = coordinate.position(state), coordinate.velocity(state)
        with in_words_of(whose):
            _check_state(whose, state, jax.eval_shape(coordinate.placed, state, place, velocity))
    first = len(machine.stops)
    for number, event in enumerate(events_of(machine)[first:-1], start=first):
        _check_event(machine, number, event, (s, state, modes))


def _check_mass(whose: str, coordinate: Coordinate, s: Scalar, state: State) -> None:
    """**Raises:** `TypeError` unless a mass is one number, or a function that returns one."""
    mass = coordinate.mass
    if callable(mass):
        with in_words_of(whose):
            mass = jax.eval_shape(lambda: jnp.asarray(coordinate.mass_at(s, state)))
    kind = getattr(mass, "dtype", None) or jnp.result_type(type(mass))
    if jnp.shape(mass) or not jnp.issubdtype(kind, jnp.number):
        raise TypeError(
            f"{whose} must be one number, or a function `mass(s, state)` that returns one, but "
            f"is {in_short(mass)}."
        )


def _check_event(
    machine: AbstractMachine, number: int, event: AbstractEvent, at: tuple[Scalar, State, Scalars]
) -> None:
    s, state, modes = at
    switches, name = len(machine.switches), type(machine).__name__
    i = number - len(machine.stops)
    what, i = ("switch", i) if i < switches else ("event", i - switches)
    whose = f"{what} {i} ({event.name or type(event).__name__}) of a {name}"
    contact = tuple(jnp.zeros_like(s) for _ in machine.coordinates)
    _, own, more = event_of(machine, number, modes, contact)
    with in_words_of(f"`guard` of {whose}"):
        guard = jax.eval_shape(lambda: event.guard(machine, s, state, *modes[own], **more))
    if not _is_number(guard):
        raise TypeError(
            f"`guard` of {whose} must return one floating-point number, but returned "
            f"{in_short(guard)}."
        )
    with in_words_of(f"`when` of {whose}"):
        when = jax.eval_shape(lambda: event.happens(machine, s, state, *modes[own]))
    if when is not None and (jnp.shape(when) or not jnp.issubdtype(when.dtype, bool)):
        raise TypeError(
            f"`when` of {whose} must return a flag, but returned {in_short(when)}. Compare it with "
            "a number: `state.V > 0`."
        )
    if isinstance(event, Reset):  # its modes are asked for in the state after it
        with in_words_of(f"`reset` of {whose}"):
            new = eqx.filter_eval_shape(lambda: event.jump(machine, s, state, *modes))
        _check_state(f"The state after {whose}", state, new)
    with in_words_of(f"`after` of {whose}"):
        found = eqx.filter_eval_shape(lambda: event.after(machine, s, state, *modes[own], **more))
    if type(found) is not tuple or len(found) != 2:
        raise TypeError(
            f"`after` of {whose} must return the state and the modes afterwards, but returned "
            f"{in_short(found)}."
        )
    new, changed = found
    _check_state(f"The state after {whose}", state, new)
    if not event.holds_mode and _length(changed) != len(modes):
        raise TypeError(
            f"The modes after {whose} must be {len(modes)} in number, as many as the machine has "
            f"(those of its switches, then those of its `begin`), but are {in_short(changed)}."
        )


def _is_number(x: Any) -> bool:
    return getattr(x, "shape", None) == () and jnp.issubdtype(x.dtype, jnp.floating)


def _length(modes: object) -> int:
    return len(modes) if isinstance(modes, Sequence) else -1


def _check_state(whose: str, state: State, found: Any) -> None:
    """**Raises:** `TypeError` for what is no state like the one given."""

    def kind(x: Any) -> Any:
        floats = jnp.issubdtype(jnp.result_type(x), jnp.inexact)
        return jnp.shape(x), floats

    alike = jtu.tree_structure(state) == jtu.tree_structure(found)
    if not alike or jtu.tree_map(kind, state) != jtu.tree_map(kind, found):
        raise TypeError(
            f"{whose} must be like its state, {in_short(state)}, but is {in_short(found)}."
        )
