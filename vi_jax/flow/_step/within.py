"""What the stages of a step show of guards that its ends do not resolve.

The error of a step is that of its state. A guard that is another function of the state and of `s`
is no part of it: the force that holds a body at rest, the pull on a body that sticks, the distance
from a curved stop, a threshold that moves. These guards are evaluated at the stages as well. Their
integral over the step counts in its error, and `hidden.crests` tells where they may be positive.
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.lax import stop_gradient
from jaxtyping import Array

from ..._types import Flag, Scalar, State
from ...machine import AbstractMachine, RigidStop, events_of, sides_of, stops_of
from .._lane import Lane, Plan, any_of
from ..events import Rates, rates
from ..methods import Stage
from ..smooth import SmoothMachine, exact, is_affine

# Of a motion known beforehand, where guards are evaluated within a step, as shares of it.
SHARES = tuple(n / 8 for n in range(1, 8))

# Stages that are closer to each other than this share of a step show the same. A choice.
_APART = 0.08


class Within(NamedTuple):
    """Guards at the stages of a step: of each an array with a value for each stage."""

    forces: dict[int, Array]
    """By coordinate, the force that pulls a body at rest away from its stop; negative while it is
    pressed on. Of a body that is free and slow its velocity, positive once it has turned; -1 of a
    faster one."""
    events: dict[int, tuple[Array, ...]]
    """By event, the values of each side of its guard (see `AbstractEvent.sides`)."""
    slow: dict[int, Flag]
    """By coordinate, whether it is so slow, and so close to a stop, that it may turn twice within
    the step and touch in between."""
    error: Scalar | None = None
    """The largest error of the forces, relative to the tolerance."""
    slack: dict[int, Scalar] | None = None
    """What rounding leaves of the forces."""

    def only(self, places: list[int]) -> "Within":
        """The values at some of the stages."""
        kept = self.forces, self.events
        forces, events = jtu.tree_map(lambda x: x[np.asarray(places)], kept)
        return self._replace(forces=forces, events=events)


def looks_within(plan: Plan, state: State) -> bool:
    """Whether there are guards to be evaluated at stages; static."""
    return plan.rests or bool(events_looked_at(plan, state))


def events_looked_at(plan: Plan, state: State) -> list[int]:
    """The numbers of the events whose guards are evaluated at stages: not those of stops on
    coordinates that are known as well as the state."""
    machine, events, stops = plan.machine, events_of(plan.machine), []
    if not exact(machine, state):
        known = [is_affine(x.position, state) for x in machine.coordinates]
        stops = [i for i, stop in enumerate(stops_of(machine)) if not known[stop.coordinate]]
    others = [number for number in plan.others(state) if events[number].looked_at_within]
    return [*stops, *others]


def guards_error(
    plan: Plan, seen: Within, stages: list[Stage], h: Scalar, longest: Scalar
) -> Scalar | None:
    """Return the largest error of the guards at the stages of a step, relative to the tolerance;
    `None` without guards, or of a method that estimates none."""
    events, errors = events_of(plan.machine), [seen.error]
    for number, sides in seen.events.items():
        acts = events[number].holds_mode
        errors += [
            plan.method.guard_error(stages, x, h, longest, acts=acts, size=plan.unit) for x in sides
        ]
    known = [error for error in errors if error is not None]
    return functools.reduce(jnp.maximum, known) if known else None


def apart(stages: list[Stage]) -> list[Stage]:
    """Return those stages within a step that are apart from each other."""
    found: list[Stage] = []
    for stage in sorted(stages, key=lambda x: x.share):
        if 0 < stage.share < 1 and (not found or stage.share - found[-1].share >= _APART):
            found.append(stage)
    return found


def within(
    plan: Plan, lane: Lane, alone: tuple[SmoothMachine, ...], ends: list[tuple[Rates, Rates]],
    stages: list[Stage], at: Callable[[Scalar], State], h: Scalar, longest: Scalar,
) -> Within:  # fmt: skip
    """Return the guards at the stages of a step.

    **Arguments:** `alone`, of each coordinate the machine with the other bodies held that rest;
    `ends`, its rates where the step begins and ends; `at(share)`, the state at a share of the step,
    asked for where the stages have none; `h`, the length of the step; `longest`, that of the
    longest one.
    """
    if not stages:
        return Within({}, {}, {})
    machine, around = plan.machine, (lane.modes, lane.contact or ())
    limited = sorted({stop.coordinate for stop in stops_of(machine)}) if plan.rests else []
    contacts: Any = lane.contact
    looked_at = events_looked_at(plan, lane.state)

    def moves(k: int, s: Scalar, state: State) -> Rates:
        return rates(alone[k].field, machine.coordinates[k].position, s, state)

    slow = {k: jnp.zeros((), bool) for k in limited}
    if not plan.method.resolves(machine):
        slow = {k: _is_slow(plan, lane, k, stop_gradient(ends[k]), h) for k in limited}

    def pulls(s: Scalar, state: State) -> dict[int, Scalar]:
        found = {}
        for k in limited:
            here, rests = moves(k, s, state), contacts[k] > 0
            free = jnp.where(slow[k], -lane.direction[k] * here.v, -1.0)
            found[k] = jnp.where(rests, plan.away(k, contacts[k]) * here.a, free)
        return found

    def guards(s: Scalar, state: State) -> dict[int, tuple[Scalar, ...]]:
        found = {}
        for number in looked_at:
            if number < len(stops_of(machine)):
                found[number] = (_distance(machine, lane, number, state),)
            else:
                found[number] = sides_of(machine, number, s, state, *around)
        return found

    known = stages[0].state is not None
    places = [(x.s, x.state if known else jnp.asarray(x.share, h.dtype)) for x in stages]
    places = jtu.tree_map(lambda *x: jnp.stack(x), *stop_gradient(places))

    def seen(function: Callable[..., Any]) -> Callable[[tuple], Any]:
        there = function if known else lambda s, share: function(s, at(share))
        return functools.partial(for_each, there)

    events = seen(guards)(places) if looked_at else {}
    if not limited:
        return Within({}, events, slow)
    # The integral of a force is a velocity.
    size = 1.0 if isinstance(plan.unit, float) else 1 / plan.unit

    def of_forces(places: tuple) -> tuple[dict[int, Array], Scalar, dict[int, Scalar]]:
        forces, error, slack = seen(pulls)(places), jnp.zeros_like(h), {}
        for k, x in forces.items():
            own = plan.method.guard_error(stages, x, h, longest, acts=True, size=size)
            error = error if own is None else jnp.maximum(error, own)
            slack[k] = 64 * float(jnp.finfo(h.dtype).eps) * jnp.max(jnp.abs(x))
        return forces, error, slack

    def of_none(_: tuple) -> tuple[dict[int, Array], Scalar, dict[int, Scalar]]:
        nothing = jnp.full(len(stages), -1.0, lane.s.dtype)
        zero = jnp.zeros_like(h)
        return dict.fromkeys(limited, nothing), zero, dict.fromkeys(limited, zero)

    asked = any_of(slow[limited[0]], ((contacts[k] > 0) | slow[k] for k in limited))
    forces, error, slack = jax.lax.cond(asked, of_forces, of_none, places)
    return Within(forces, events, slow, error, slack)


def for_each(function: Callable[..., Any], given: tuple) -> Any:
    """Constant values of a function for each of some arguments, stacked along their first axis.

    On a CPU a loop, which is compiled once. On a GPU each turn of a loop starts kernels of its own,
    and `vmap` took 0.7 of its time (H200, 100,000 lanes).
    """
    if jax.default_backend() != "cpu":
        return jax.vmap(lambda x: stop_gradient(function(*x)))(given)
    return jax.lax.scan(lambda c, x: (c, stop_gradient(function(*x))), None, given)[1]


def may_be_above(
    begin: Sequence[Scalar], end: Sequence[Scalar], inner: Array, shares: Sequence[float],
    zero: Scalar | float,
) -> Flag:  # fmt: skip
    """Whether a function may be above zero within a step, at a glance.

    The top of a parabola between two places is above both by at most an eighth of what it falls to
    the next place; half of that is granted here. Where the function falls at the begin of the step,
    or rises at its end, it has no top there.

    **Arguments:** `begin`, `end`, its value and slope there; `inner`, its values at stages, and
    their places as `shares` of the step; `zero`, what counts as zero.
    """
    (x0, v0), (x1, v1) = begin, end
    seen = jnp.concatenate([x0[None], inner[np.argsort(shares)], x1[None]])
    apart = 0.5 * jnp.abs(seen[1:] - seen[:-1])
    within = jnp.any(seen[1:-1] + jnp.maximum(apart[1:], apart[:-1]) > zero)
    return within | (v0 > 0) & (x0 + apart[0] > zero) | (v1 < 0) & (x1 + apart[-1] > zero)


def _is_slow(plan: Plan, lane: Lane, k: int, ends: tuple[Rates, Rates], h: Scalar) -> Flag:
    """Whether a body may turn twice within a step and touch a stop in between, as one that has just
    left it: slow where the step begins, going the same way where it ends, and as close to the stop
    at both as it may get in this time."""
    begin, end = ends
    slow = (jnp.abs(begin.v) <= jnp.abs(begin.a) * h) & (lane.direction[k] * end.v >= 0)
    stops = [stop for stop in stops_of(plan.machine) if stop.coordinate == k]
    return slow & any_of(slow, (_reaches(x, begin, h) & _reaches(x, end, h) for x in stops))


def _reaches(stop: RigidStop, here: Rates, h: Scalar) -> Flag:
    """Whether a body may get to a stop in the time h, before or after, if its acceleration stays
    that large."""
    return -stop.beyond(here.x) <= (jnp.abs(here.v) + 0.5 * jnp.abs(here.a) * h) * h


def _distance(machine: AbstractMachine, lane: Lane, number: int, state: State) -> Scalar:
    """How far a coordinate is beyond one of its stops; -1 of one that rests."""
    stop = stops_of(machine)[number]
    beyond = stop.beyond(machine.coordinates[stop.coordinate].position(state))
    if lane.contact is None:
        return beyond
    return jnp.where(lane.contact[stop.coordinate] > 0, -1.0, beyond)
