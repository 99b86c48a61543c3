"""The field of a machine with the forces of its contacts, and the coupling of contacts that share
bodies, in impacts and at rest.

The force of a contact changes the state as `Coordinate.placed` does with its velocity. The *push*
of a contact is the change of the state for a unit change of that velocity. The amounts of pushes
that give several contacts the required velocities solve a linear system with a row per contact.
"""

import inspect
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from .._checks import returned
from .._messages import count_of
from .._types import Flag, Machine, Scalar, Scalars, State
from .coordinates import Row
from .elimination import is_known, solved
from .parts import friction_on, limited_in, stops_of, switches_of
from .settle import Strike
from .state import like

# A smaller pivot (each row's begins as 1) is that of a redundant contact, whose velocity the other
# contacts determine, such as the fourth leg of a table: it gets no force. A choice, far above
# rounding and far below the pivots of contacts that matter.
_REDUNDANT = 1e-9


def push_of(coordinate: Any, state: State) -> State:
    """Return a contact's push: the change of the state for a unit change of its velocity."""
    if coordinate.push is not None:
        return coordinate.push(state)
    place, velocity = coordinate.position(state), coordinate.velocity(state)
    one = jnp.ones_like(velocity)
    return jax.jvp(lambda V: coordinate.placed(state, place, V), (velocity,), (one,))[1]


def row_of(coordinate: Any, s: Scalar, state: State) -> Row:
    """Return the row of a coordinate in the equations of contacts."""
    if coordinate.row is not None:
        return coordinate.row(state)
    return Row(push_of(coordinate, state), coordinate.mass_at(s, state))


def velocity_change(coordinate: Any, state: State, change: State) -> Scalar:
    """Return the change of a coordinate's velocity for this change of the state."""
    return jnp.asarray(jax.jvp(coordinate.velocity, (state,), (change,))[1])


def push_gains(
    bodies: Sequence[Any], rows: Sequence[Row], state: State, pushes: Sequence[State]
) -> list[list[Any]]:
    """Return the change of each coordinate's velocity (row) by each push (column)."""

    def gain(body: Any, row: Row, push: State) -> Any:
        if push is row.push:
            return 1.0
        change = velocity_change(body, state, push) if row.slopes is None else None
        return _product(row.slopes, push) if change is None else change

    each = list(zip(bodies, rows, strict=True))
    return [[gain(body, row, push) for push in pushes] for body, row in each]


def _product(slopes: State, push: State) -> Any:
    """Return the sum of the products of two trees' numbers, without known zeros."""
    terms = []
    for a, b in zip(jtu.tree_leaves(slopes), jtu.tree_leaves(push), strict=True):
        if not any(isinstance(x, np.ndarray) and not x.any() for x in (a, b)):
            is_one = isinstance(a, np.ndarray) and (a == 1).all()
            term = b if is_one else a * b
            terms.append(jnp.sum(term) if jnp.ndim(term) else term)
    return jnp.asarray(sum(terms[1:], terms[0])) if terms else 0.0


def forces(
    gains: Sequence[Sequence[Any]], acting: Sequence[Flag], wanted: Sequence[Scalar]
) -> list[Scalar]:
    """Return the amount of each push that changes the velocities of the `acting` contacts as
    `wanted`, with `gains` from `push_gains`; 0 for the others."""

    def entry(j: int, k: int, x: Any) -> Any:
        if is_known(x, 0.0 if j != k else 1.0):
            return x
        return jnp.where(acting[j], x, 1.0 if j == k else 0.0)

    rows = [[entry(j, k, x) for k, x in enumerate(row)] for j, row in enumerate(gains)]
    sides = [jnp.where(on, x, 0.0) for on, x in zip(acting, wanted, strict=True)]
    return solved(rows, sides, _inverse_or_zero)


def _inverse_or_zero(pivot: Any) -> Any:
    if is_known(pivot, 1.0):
        return 1.0
    is_independent = jnp.abs(stop_gradient(pivot)) > _REDUNDANT
    return jnp.where(is_independent, 1 / jnp.where(is_independent, pivot, 1.0), 0.0)


def added(state: State, amounts: Sequence[Scalar], changes: Sequence[State]) -> State:
    """Return a tree plus each change times its amount."""

    def add_part(amount: Scalar, a: Any, b: Any) -> Any:
        is_constant = isinstance(b, np.ndarray)  # in a push: zeros, and 1 for its velocity
        if is_constant and not b.any():
            return a
        return a + (amount if is_constant and (b == 1).all() else amount * b)

    for amount, change in zip(amounts, changes, strict=True):
        state = jtu.tree_map(partial(add_part, amount), state, change)
    return state


class Impact(NamedTuple):
    """The equations of an impact on some stops, in the state before it. Arrays have a number for
    each stop, then for each friction on one of them."""

    before: State
    rows: list[Row]
    outward: Array
    """The sign of the velocity that opens a contact; 1 for a friction."""
    strike: Strike
    """Without restitution across the stops."""
    of: tuple[int, ...]
    """The stop of each friction, by its place among these stops."""

    def after(self, impulse: Array) -> State:
        """Return the state after these impulses."""
        amounts = self.outward * impulse / jnp.stack([1.0 * x.mass for x in self.rows])
        return added(self.before, list(amounts), [row.push for row in self.rows])


def impact_on(machine: Any, numbers: Sequence[int], s: Scalar, before: State) -> Impact:
    """Return the equations of an impact on the stops of these numbers."""
    stops = [stops_of(machine)[i] for i in numbers]
    frictions = [friction_on(machine, i) for i in numbers]
    of = tuple(place for place, x in enumerate(frictions) if x is not None)
    on = [*(x.coordinate for x in stops), *(frictions[i].along for i in of)]
    bodies = {k: machine.coordinates[k] for k in dict.fromkeys(on)}
    rows = {k: row_of(body, s, before) for k, body in bodies.items()}
    each = list(bodies.values()), list(rows.values())
    found = push_gains(*each, before, [x.push for x in each[1]])
    at, zero = [list(bodies).index(k) for k in on], jnp.zeros_like(s)
    gains = jnp.stack([jnp.stack([found[i][j] for j in at]) for i in at])
    signs = [*(-float(x.sign) for x in stops), *(1.0 for _ in of)]
    outward = jnp.asarray(np.asarray(signs), s.dtype)
    masses = jnp.stack([jnp.asarray(1.0 * rows[k].mass, s.dtype) for k in on])
    velocity = outward * jnp.stack([bodies[k].velocity(before) for k in on])

    def of_frictions(value_of: Callable[[Any], Any]) -> Array:
        return jnp.stack([value_of(frictions[i]) + zero for i in of]) if of else velocity[:0]

    strike = Strike(
        outward[:, None] * gains * outward / masses, velocity,
        of_frictions(lambda x: x.level), jnp.zeros((len(stops),), s.dtype),
        of_frictions(lambda x: x.restitution), jnp.ones((len(stops),), bool),
    )  # fmt: skip
    return Impact(before, [rows[k] for k in on], outward, strike, of)


class ContactConstraints(NamedTuple):
    """The constraints of bodies at rest on stops and of dry frictions: a row for each coordinate
    that stops limit, in their order, then for each friction on a stop, then for each dry one."""

    coordinates: list[Any]
    """The coordinates whose velocities are held; for a friction the one along the stop."""
    rows: list[Row]
    acts: list[Flag]
    """True in the rows that hold; a friction holds while the body sticks."""
    stop_frictions: list[tuple[int, Any, int, Scalar]]
    """For each friction on a stop: its index among the switches, the friction, the row of its stop,
    and the share of the friction's push in the stop's."""
    dry: list[int]
    """The indices of the dry frictions among the switches."""

    def amounts(self, state: State, wanted: Sequence[Scalar]) -> list[Scalar]:
        """Return the amount of each row's push that changes the held velocities as `wanted`. A stop
        drags a slipping body along, too."""
        gains = push_gains(self.coordinates, self.rows, state, self.pushes)
        first = len(self.rows) - len(self.dry) - len(self.stop_frictions)
        slips = [(i, x[2], x[3]) for i, x in enumerate(self.stop_frictions, start=first)]
        for i, stop, share in slips:
            for row in gains:
                if not is_known(row[i], 0.0):
                    change = share if is_known(row[i], 1.0) else share * row[i]
                    row[stop] = change if is_known(row[stop], 0.0) else row[stop] + change
        amounts = forces(gains, self.acts, wanted)
        for i, stop, share in slips:
            amounts[i] = amounts[i] + share * amounts[stop]
        return amounts

    @property
    def pushes(self) -> list[State]:
        return [row.push for row in self.rows]


def contact_constraints(
    machine: Any, s: Scalar, state: State, modes: Sequence[Scalar], contact: Sequence[Scalar],
    *, with_dry: bool = True,
) -> ContactConstraints:  # fmt: skip
    """Return the constraints of bodies at rest on stops, and of dry frictions if `with_dry`; these
    take no part in impacts, since their forces are finite. **Arguments:** `modes`, those of
    switches first; `contact`, as in `EventContext`; empty for no rest."""
    limited = limited_in(machine) if contact else []
    coordinates: Any = machine.coordinates if limited else ()
    stops: Any = stops_of(machine) if contact else ()
    switches = switches_of(machine)
    frictions = [(i, x) for i, x in enumerate(switches) if contact and x.friction_stop is not None]
    numbers = [*limited, *(x.along for _, x in frictions)]
    by_number = {k: row_of(coordinates[k], s, state) for k in numbers}
    rows, acts = [by_number[k] for k in numbers], [contact[k] > 0 for k in limited]
    stop_frictions = []
    for i, friction in frictions:
        stop = stops[friction.friction_stop]
        row = limited.index(stop.coordinate)
        rests = contact[stop.coordinate] == 1.0 + friction.friction_stop
        # The stop pushes the body away, and friction acts against the slip.
        ratio = by_number[stop.coordinate].mass / by_number[friction.along].mass
        ratio = jnp.round(modes[i]) * friction.level * stop.sign * ratio
        share = jnp.where(rests, ratio, 0.0)
        acts = [*acts, rests & (modes[i] == 0)]
        stop_frictions.append((i, friction, row, share))
    bodies = [coordinates[k] for k in numbers]
    dry = [i for i, x in enumerate(switches) if x.is_dry] if with_dry else []
    for i in dry:
        row = switches[i].row(machine, s, state)
        bodies, rows = [*bodies, switches[i].as_velocity(machine, s)], [*rows, row]
        acts = [*acts, modes[i] == 0]
    return ContactConstraints(bodies, rows, acts, stop_frictions, dry)


def constrained_rate(
    machine: Machine, flow: State, s: Scalar, state: State, modes: Sequence[Scalar],
    contact: Sequence[Scalar],
) -> tuple[State, ContactConstraints, list[Scalar]]:  # fmt: skip
    """Return the rate along `flow`, corrected so that resting coordinates keep their velocities.
    Forces on shared bodies are solved for together. Also return the constraints and the amounts of
    their pushes."""
    held = contact_constraints(machine, s, state, modes, contact)
    first, switches = len(held.rows) - len(held.dry), switches_of(machine)
    wanted = [-velocity_change(body, state, flow) for body in held.coordinates[:first]]
    wanted += [-switches[i].slip_rate(machine, s, state, flow) for i in held.dry]
    amounts = held.amounts(state, wanted)
    return added(flow, amounts, held.pushes), held, amounts


def on_held_surfaces(
    machine: Machine, s: Scalar, state: State, modes: Scalars, contact: Sequence[Scalar]
) -> State:
    """Return a state in which bodies stick, or that slides along surfaces, without the rounding of
    its slips and of its distances from the surfaces. A motion that begins with a small slip sticks
    at once, so a slip has no derivatives."""
    held = contact_constraints(machine, s, state, modes, contact)
    amounts = held.amounts(state, [-body.velocity(state) for body in held.coordinates])
    state = added(state, amounts, held.pushes)
    for i, switch in enumerate(switches_of(machine)):
        if switch.blends:
            both = ((*modes[:i], jnp.full_like(s, m), *modes[i + 1 :]) for m in (1.0, -1.0))
            flows = tuple(field_in(machine, s, state, x) for x in both)
            state = on_surface(switch.function, machine, s, state, flows, modes[i] == 0)
    return state


def on_surface(
    function: Any, machine: Machine, s: Scalar, state: State, flows: tuple[State, State], when: Flag
) -> State:
    """Return a state near the surface on which a function vanishes, moved onto it along the
    difference of the fields on both sides: both lead to the same place of the surface."""
    up, down = stop_gradient(flows)
    rates = (rate_of(function, machine, s, state, x) for x in (up, down))
    rate = jnp.subtract(*stop_gradient(tuple(rates)))
    when = when & (rate != 0)
    amount = jnp.where(when, -function(machine, s, state) / jnp.where(when, rate, 1.0), 0.0)
    return added(state, (amount,), (jtu.tree_map(jnp.subtract, up, down),))


def shown_modes(machine: Machine, modes: Scalars) -> Scalars:
    """Return the modes that a machine's own functions receive: all but those of contacts, which add
    their forces themselves. The modes of switches come first, in their order."""
    hidden = {i for i, x in enumerate(switches_of(machine)) if x.acts}
    return tuple(mode for i, mode in enumerate(modes) if i not in hidden)


def check_takes(
    function: Callable[..., Any], whose: str, first: str, arguments: tuple[Any, ...], modes: int
) -> None:
    """Raise `TypeError` if a user's function does not accept these arguments, modes last."""
    try:
        signature = inspect.signature(function)
    except ValueError:
        return  # it has no signature
    try:
        signature.bind(*arguments)
    except TypeError as error:
        number = count_of(modes, "mode")
        and_modes = f" and {number} (of switches, then the machine's own)" if modes else ""
        takes = ", ".join(f"`{name}`" for name in signature.parameters) or "nothing"
        needed = [x.name for x in signature.parameters.values() if x.default is x.empty]
        more = needed[len(arguments) :] if "missing" in str(error) else []
        text = f"{whose} must take {first}{and_modes}, but takes {takes}."
        if more:
            modes_ = ", ".join(f"{name}=0.0" for name in more)
            text += f" If {' and '.join(more)} are modes, declare them: `modes = dict({modes_})`."
        raise TypeError(text) from None


def call_checked(function: Callable[..., Any], whose: str, *arguments: Any) -> Any:
    """Return the result of a function of a machine's event. **Raises:** `TypeError` with the
    function's name `whose`, if it takes other arguments or returns `None`."""
    try:
        return returned(function(*arguments), whose, "a value")
    except TypeError:
        check_takes(function, whose, "the machine, `t`, the state", arguments, len(arguments) - 3)
        raise


def acting(machine: Machine, s: Scalar, state: State, modes: Scalars) -> State:
    """Return the machine's field in these modes, with the forces of its contacts that act."""
    flow = machine.field(s, state, *shown_modes(machine, modes))
    flow = like(state, flow, f"`field` of a {type(machine).__name__}")
    pace = machine.pace(s, state)
    for switch, mode in zip(switches_of(machine), modes, strict=False):
        pushed = switch.push_in(machine, s, state, mode) if switch.acts else None
        if pushed is not None:
            amount, push = pushed
            flow = added(flow, (amount if pace is None else amount * pace,), (push,))
    return flow


def field_in(machine: Any, s: Scalar, state: State, modes: Scalars, first: int = 0) -> State:
    """Return the machine's field in these modes. On a surface along which the motion slides, it is
    the weighted mean of the fields on both sides. **Arguments:** `first`, the number of the first
    switch that may be in mode 0."""
    switches = switches_of(machine)
    sliding = [i for i, x in enumerate(switches) if x.blends and i >= first]
    if not sliding:
        return acting(machine, s, state, modes)
    i = sliding[0]
    up, down = (
        field_in(
            machine, s, state, (*modes[:i], jnp.full_like(modes[i], m), *modes[i + 1 :]), i + 1
        )
        for m in (1.0, -1.0)
    )
    rate_up, rate_down = (rate_of(switches[i].function, machine, s, state, x) for x in (up, down))
    delta = rate_down - rate_up
    weight = jnp.where(modes[i] == 0, rate_down / jnp.where(delta == 0, 1.0, delta), modes[i] > 0)
    # Not clipped to [0, 1]: the field is smooth until the step ends, where the weight leaves it.
    return jtu.tree_map(lambda a, b: b + weight * (a - b), up, down)


def rate_of(function: Any, machine: Machine, s: Scalar, state: State, flow: State) -> Scalar:
    """Return d/ds of a function of machine, `s` and state along a flow."""
    tangents = (s, state), (jnp.ones_like(s), flow)
    return jax.jvp(lambda s, state: function(machine, s, state), *tangents)[1]
