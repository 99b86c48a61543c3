"""A lane as its loop begins: what it begins with, and whether it can be run at all."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu

from .._types import Flag, Scalar, State
from ..machine import begin_modes, holds_anywhere, rubs, struck_modes
from ._lane import Lane, Plan, to_event, total
from .events import Rates, force_rate, rates
from .results import code
from .smooth import in_modes, rounding


def launched(plan: Plan, start: State, wanted: Flag | bool = True) -> Lane:
    """The lane as its loop begins, in the state `start`; one that cannot be run, or is not
    `wanted`, has ended already."""
    machine = plan.machine
    Y = machine.position(start)
    bad = ~jnp.isfinite(total((start, machine.cycle), plan.settle)) | ~jnp.asarray(wanted)
    bad = bad | ~machine.in_range(start)
    for number in jtu.tree_leaves(eqx.filter(machine, eqx.is_inexact_array)):
        bad = bad | jnp.any(jnp.isnan(number))  # infinite is allowed: no limit
    slack = rounding(machine, start)
    for stop in machine.stops:
        bad = bad | (stop.beyond(machine.coordinates[stop.coordinate].position(start)) > slack)
    bad = jax.lax.stop_gradient(bad)
    zero = jnp.zeros_like(Y)
    s = zero if plan.begin is None else zero + plan.begin
    modes = begin_modes(machine, s, start, plan.own)
    free = in_modes(machine, modes)
    here = [rates(free.field, x.position, s, start) for x in machine.coordinates]
    # At rest the acceleration says which way the motion goes.
    direction = tuple(jnp.where(x.v == 0, jnp.sign(x.a), jnp.sign(x.v)) for x in here)
    contact = None
    if plan.rests:
        growth = [force_rate(free, x.position, free, s, start) for x in machine.coordinates]
        both = enumerate(zip(here, growth, strict=True))
        contact = tuple(_rests_on(plan, k, *x, slack) for k, x in both)
        direction = tuple(
            jnp.where((x.v == 0) & (x.a == 0), jnp.sign(j), along)
            for x, j, along in zip(here, growth, direction, strict=True)
        )
        for i, stop in enumerate(machine.stops):
            # A little off the stop it would come to rest there: no derivative by the start.
            at = machine.coordinates[stop.coordinate].placed(start, stop.place, zero)
            rests = contact[stop.coordinate] == to_event(i)
            start = jtu.tree_map(lambda a, b, rests=rests: jnp.where(rests, a, b), at, start)
        if rubs(machine) or (machine.stops and holds_anywhere(machine)):
            modes = struck_modes(machine, s, start, modes, contact=contact)
    length = zero + jax.lax.stop_gradient(machine.cycle) / plan.method.steps_per_cycle
    if plan.method.adaptive:
        length = length / 8
    return Lane(
        s=s,
        state=start,
        record=plan.fresh(start),
        direction=jax.lax.stop_gradient(direction),
        contact=contact,
        modes=modes,
        below=tuple(zero - 1 for _ in plan.from_below(start)),
        length=length,
        attempt=length,
        target=zero,
        aims=zero,
        part=plan.first_part(zero) if plan.instants > 1 else zero,
        done=zero,
        fault=jnp.where(bad, code("bad_start"), zero),
        steps=zero,
        spent=zero,
        rejected=zero,
        shaken=zero if plan.noise is not None and plan.noise.timed else None,
    )


def _rests_on(plan: Plan, k: int, here: Rates, growth: Scalar, slack: Scalar | float) -> Scalar:
    """The stop that coordinate number k rests on as the motion begins: pressed on, or about to
    be by a force that grows; place and velocity are known to within `slack`."""
    contact = jnp.zeros_like(here.x)
    for i, stop in enumerate(plan.machine.stops):
        if stop.coordinate == k:
            pressed = (stop.sign * here.a > 0) | (here.a == 0) & (stop.sign * growth > 0)
            rests = (stop.beyond(here.x) >= -slack) & (jnp.abs(here.v) <= slack) & pressed
            contact = jnp.where(rests, to_event(i), contact)
    return contact
