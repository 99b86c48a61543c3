"""The first lane of a simulation: which bodies rest, stick or slip at the start."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._types import Flag, Scalar, Scalars, State
from ..machine import (
    Mechanical,
    begin_modes,
    chosen_stop,
    frictions_in,
    has_contact_friction,
    holds_anywhere,
    is_compound,
    is_definite,
    is_in_range,
    on_held_surfaces,
    pressed_contacts,
    stops_of,
    stops_on,
    struck_modes,
    switches_of,
)
from ._step.roots import Rates, force_rate, force_rounding, rates
from .lane import Lane, to_event, total
from .plan import Plan
from .results import code
from .smooth import in_modes, stops_are_exact


def initial_lane(plan: Plan, start: State, wanted: Flag | bool = True) -> Lane:
    """Return the lane at the first step of its loop, in the state `start`. A lane that cannot be
    simulated, or is not `wanted`, has ended already."""
    machine = plan.machine
    Y = machine.position(start)
    bad = ~jnp.isfinite(total((start, machine.cycle), plan.settle)) | ~jnp.asarray(wanted)
    bad = bad | ~is_in_range(machine, start)
    for number in jtu.tree_leaves(eqx.filter(machine, eqx.is_inexact_array)):
        bad = bad | jnp.any(jnp.isnan(number))  # infinite is allowed: no limit
    bad = bad | plan.beyond_a_stop(start) | (jnp.asarray(machine.cycle) <= 0)
    if isinstance(machine, Mechanical):
        bad = bad | ~is_definite(machine._masses(machine._places(start)))
    bad = jax.lax.stop_gradient(bad)
    zero = jnp.zeros_like(Y)
    s = zero if plan.begin is None else zero + plan.begin
    modes = plan.first_modes
    if modes is None:
        modes = begin_modes(machine, s, start, plan.start_modes)
    free = in_modes(machine, modes)
    current = [rates(free.field, x, s, start) for x in machine.coordinates]
    # At rest the sign of the acceleration is the direction of motion.
    direction = tuple(jnp.where(x.v == 0, jnp.sign(x.a), jnp.sign(x.v)) for x in current)
    contact = None
    if plan.rests:
        jerks = [force_rate(free, x, free, s, start) for x in machine.coordinates]
        least = [zero for _ in jerks]
        if is_compound(machine):
            least = [force_rounding(free.field, x, s, start) for x in machine.coordinates]
        contact, touching = _contacts_at(plan, start, current, jerks, least)
        direction = tuple(
            jnp.where((x.v == 0) & (x.a == 0), jnp.sign(j), sign)
            for x, j, sign in zip(current, jerks, direction, strict=True)
        )
        for i, stop in enumerate(stops_of(machine)):
            # From slightly off the stop it would come to rest there too: no derivatives.
            on_stop = machine.coordinates[stop.coordinate].placed(start, stop.place, zero)
            rests = contact[stop.coordinate] == to_event(i)
            start = jtu.tree_map(lambda a, b, rests=rests: jnp.where(rests, a, b), on_stop, start)
        if is_compound(machine):
            contact = pressed_contacts(machine, s, start, modes, contact, touching=touching)[1]
        if has_contact_friction(machine) or (stops_of(machine) and holds_anywhere(machine)):
            modes = struck_modes(machine, s, start, modes, contact=contact)
    slides = any(x.blends for x in switches_of(machine))
    if slides or holds_anywhere(machine) or has_contact_friction(machine):
        start = on_held_surfaces(machine, s, start, modes, contact or ())
    fault = jnp.where(bad, code("bad_start"), zero)
    for i in frictions_in(machine):
        fault = jnp.where(jnp.isnan(modes[i]) & ~bad, code("jammed"), fault)
    length = zero + jax.lax.stop_gradient(machine.cycle) / plan.method.steps_per_cycle
    if plan.method.adaptive:
        length = length / 8
    return Lane(
        s=s,
        state=start,
        record=plan.empty_record(start),
        direction=jax.lax.stop_gradient(direction),
        contact=contact,
        modes=modes,
        below=tuple(zero - 1 for _ in plan.from_below(start)),
        length=length,
        attempt=length,
        target=zero,
        attempts=zero,
        part=plan.first_part(zero) if plan.instants > 1 else zero,
        done=zero,
        fault=fault,
        steps=zero,
        spent=zero,
        rejected=zero,
        last_impulse=zero if plan.noise is not None and plan.noise.measures_time else None,
    )


def _contacts_at(
    plan: Plan, start: State, current: list[Rates], jerks: list[Scalar], forces: list[Scalar]
) -> tuple[Scalars, tuple[Flag, ...]]:
    """Return the stops on which the coordinates rest, and for each coordinate whether no force
    presses it on its stop. By their rates and those of the forces they are pressed on, or about to
    be by a force that grows. Of several contacts all that touch are returned: another body may
    press on them, and `pressed_contacts` decides. Positions and velocities are known to the
    rounding of a search that ends there, forces to those of `forces`.
    """
    machine, found, touching, any_pressed = plan.machine, [], [], jnp.zeros((), bool)
    for k, (here, jerk, force) in enumerate(zip(current, jerks, forces, strict=True)):
        eps = float(jnp.finfo(here.x.dtype).eps)
        (slack, slow), least = plan.rounding_bounds(k, start), 4 * eps * plan.extent(k)
        if not stops_are_exact(machine, start):
            # A resting body gathers the rounding of the force on it: a woodpecker 0.03 of this.
            slow = jnp.maximum(slow, 4 * eps * machine.cycle * jnp.abs(here.a))
        slack, slow = jnp.maximum(slack, least), jnp.maximum(slow, least / plan.unit)
        rests, pressed = {}, jnp.zeros((), bool)
        is_free = jnp.abs(here.a) <= force
        for i in stops_on(machine, k):
            stop = stops_of(machine)[i]
            stands = (stop.beyond(here.x) >= -slack) & (jnp.abs(here.v) <= slow)
            pushes = stop.sign * here.a > force
            pushes = pushes | is_free & (stop.sign * jerk * plan.unit > force)
            pressed = pressed | stands & pushes
            rests[i] = stands if is_compound(machine) else stands & pushes
        found.append(chosen_stop(machine, k, rests, jnp.zeros_like(here.x)))
        touching.append(is_free & ~pressed)
        any_pressed = any_pressed | pressed
    found = [jnp.where(x & ~any_pressed, 0.0, y) for x, y in zip(touching, found, strict=True)]
    return tuple(found), tuple(touching)
