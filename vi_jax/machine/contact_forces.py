"""The forces of contacts in a given state: of rests, soft stops and dry friction."""

from math import pi
from typing import Any

import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .. import lanes
from .._types import Flag, Machine, Scalar, State
from .contacts import contact_constraints, field_in, push_gains, velocity_change
from .events import begin_modes
from .friction import frictions_in, settled_forces
from .leaves import size_of
from .modes import modes_of, without_modes
from .parts import limited_in, stops_of, switches_of
from .state import State as Named
from .stop import SoftStop, stop_in_words

# A distance from a stop, or a speed, below this share of its size is that of a body that rests: a
# choice, far above the error of a step, which moves held bodies.
_RESTS = 1e-7


def contact_forces(machine: Any, state: State, t: Any = 0.0) -> dict[str, Named]:
    """Return the forces of all contacts in a state, by the contact's name.

    A rigid stop pushes a body that rests on it, a soft stop one that penetrates it, and friction
    acts on bodies that slide or stick. The impulses of impacts are not forces. For the forces along
    a run use `jax.vmap` over its samples: `jax.vmap(lambda z, t: vi.contact_forces(machine, z,
    t))(run.samples.state, run.samples.time)`; their means and extremes are those of the arrays.

    **Arguments:** `state`, a state of the machine, as in `Run.samples`; `t`, the clock `s`.

    **Returns:** for each contact a `State` with the components `normal`, the force away from the
    stop, and `tangential`, that of friction on the body, along its velocity (the machine's unit of
    force). Each has only those that it can have. A contact without a name is called by its side or
    number, as in prints. Without a solution (Painlevé) forces are NaN. Forces of redundant
    contacts, such as the fourth leg of a table, are one of many possible choices.
    """
    own, state = modes_of(state), jtu.tree_map(lambda x: 1.0 * jnp.asarray(x), without_modes(state))
    # By a kernel: XLA compiles the forces of two corners four times as long.
    return lanes.once_with(machine, _forces, (jnp.asarray(t, float), state, own))


def _forces(machine: Any, inputs: tuple[Scalar, State, Any]) -> dict[str, Named]:
    s, state, own = inputs
    modes = begin_modes(machine, s, state, own)
    contact, slips, holds = closed_contacts(machine, s, state, modes)
    found: dict[str, Named] = {}
    stops, switches = stops_of(machine), switches_of(machine)
    order, force = [], jnp.zeros((0,))
    if contact or slips:
        order, _, answer = settled_forces(machine, s, state, modes, contact, slips, holds)
        force = jnp.where(answer.unsolved, jnp.nan, answer.force)
    n = len(limited_in(machine)) if contact else 0
    along = {switches[i].friction_stop: n + row for row, i in enumerate(order)}
    for number, stop in enumerate(stops):
        row = limited_in(machine).index(stop.coordinate)
        rests = contact[stop.coordinate] == 1.0 + number
        parts = dict(normal=jnp.where(rests, force[row], 0.0))
        if number in along:
            parts["tangential"] = jnp.where(rests, force[along[number]], 0.0)
        found[stop_in_words(machine, stop)] = Named(**parts)
    count = 0
    for row, i in enumerate(order):
        if switches[i].is_dry:
            found[switches[i].name or f"friction {count}"] = Named(tangential=force[n + row])
            count += 1
    for i, stop in enumerate(switches):
        if isinstance(stop, SoftStop):
            mass = machine.coordinates[stop.coordinate].mass_at(s, state)
            push = -stop.sign * mass * stop.contribution(machine, s, state, modes[i])
            found[stop_in_words(machine, stop)] = Named(normal=push)
    return found


def closed_contacts(machine: Machine, s: Scalar, state: State, modes: Any) -> tuple[Any, Any, Any]:
    """Return the closed contacts, as in `EventContext`, and for each friction its slip and the
    greatest force without slip relative to that of a slipping body."""
    indices, switches = frictions_in(machine), switches_of(machine)
    free = tuple(0.0 * x if i in indices else x for i, x in enumerate(modes))
    contact = [jnp.zeros_like(s) for _ in machine.coordinates] if stops_of(machine) else []
    held = contact_constraints(machine, s, state, free, contact)
    changes, unit = _changes(machine, s, state, free, held), jnp.asarray(machine.cycle) / (2 * pi)
    sizes = jtu.tree_map(jnp.abs, state)

    def is_small(part: Any, change: Scalar) -> Flag:
        return jnp.abs(part(state)) <= _RESTS * (size_of(part, state, sizes) + change)

    for number, stop in enumerate(stops_of(machine)):
        k = stop.coordinate
        body, change = machine.coordinates[k], unit * changes[limited_in(machine).index(k)]
        near = is_small(lambda x, f=stop, b=body: f.beyond(b.position(x)), unit * change)
        contact[k] = jnp.where(near & is_small(body.velocity, change), 1.0 + number, contact[k])
    slips, holds, rows = [], [], [i for i, *_ in held.stop_frictions] + held.dry
    for i in indices:
        friction, change = switches[i], changes[len(held.rows) - len(rows) + rows.index(i)]
        speed = lambda x, f=friction: f.speed_of_slip(machine, s, x)
        still = is_small(speed, unit * change)
        slips.append(jax.lax.stop_gradient(jnp.where(still, 0.0, jnp.sign(speed(state)))))
        holds.append(getattr(friction, "static_ratio", 1.0) + jnp.zeros_like(s))
    return tuple(contact), tuple(slips), tuple(holds)


def _changes(machine: Machine, s: Scalar, state: State, free: Any, held: Any) -> list[Scalar]:
    """Return a size of the rate of each row's velocity, by which rounding is judged: that of the
    force without contacts, of the friction that it may cause, and of the other rows' pushes. A
    block that stands has no other size along the floor."""
    switches, dry = switches_of(machine), len(held.rows) - len(held.dry)
    flow = field_in(machine, s, state, free)
    rates = [velocity_change(body, state, flow) for body in held.coordinates[:dry]]
    rates += [switches[i].slip_rate(machine, s, state, flow) for i in held.dry]
    rates = [jnp.abs(x) for x in rates]
    for n, (_, friction, stop, _) in enumerate(held.stop_frictions, dry - len(held.stop_frictions)):
        pressed = rates[stop] * held.rows[stop].mass / held.rows[n].mass
        rates[n] = rates[n] + friction.level * pressed
    for n, i in enumerate(held.dry, dry):
        level = switches[i].sliding(machine, s, state, jnp.zeros_like(s))
        rates[n] = rates[n] + level / held.rows[n].mass
    gains = push_gains(held.coordinates, held.rows, state, held.pushes)
    sizes = [[jnp.abs(x) * rate for x, rate in zip(row, rates, strict=True)] for row in gains]
    return [sum(row[1:], row[0]) for row in sizes]
