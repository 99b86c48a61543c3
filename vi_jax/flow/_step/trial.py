"""A step that is tried, and what it meets on its way."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ...lanes import pin, pin_flag
from ...scene import AbstractScene
from .._lane import FREE, SECTION, Lane, Plan, to_stop, to_switch, to_turn_of, total
from ..events import Rates, force_rate, guard_rates, landing, rates, turns_within
from ..methods.taylor import Expansion
from ..moving import Moving, exact, in_modes
from .rest import Release, release

Scalar = Float[Array, ""]
Flag = Bool[Array, ""]

# Newton's method on a smooth flow needs two or three aims. Where rounding keeps it from gaining
# more, a lane that has aimed this often accepts a thousand times the tolerance.
_PATIENCE = 12.0

# A window of force shorter than this share of the longest step moves the body by its third power.
_SLIVER = 1e-3


class Crossing(NamedTuple):
    """An event g = 0 seen by a step: g at both ends, and how a step aimed at it landed."""

    name: float
    kind: str
    """"stop", "switch" or "section"."""
    number: int
    """Of the stop or switch."""
    slack: Scalar | None
    """By so much, which is rounding's, a step may begin or end beyond it; `None` where places on it
    are exact."""
    begin: Rates
    end: Rates
    offset: Scalar
    """δ to the event from the step's end."""
    landed: Flag
    again: Flag
    """The step was aimed at it and has to be corrected by δ."""


class Trial(NamedTuple):
    """A step that was tried, and what it met."""

    s: Scalar
    h: Scalar
    state: Any
    time: Scalar | None
    error: Scalar
    good: Flag
    ends_interval: Flag
    crossings: tuple[Crossing, ...]
    paths: tuple["Path", ...]
    """Of each coordinate; none where nothing asks for it."""
    alone: tuple[Any, ...]
    """Of each coordinate, the machine in its modes with the other bodies held that rest."""
    holding: Any
    """The machine as the step saw it: its bodies held where they rest."""
    below: Scalar | None
    """As in `Lane`, at the step's end."""


class Path(NamedTuple):
    """What a step saw of a coordinate."""

    begin: Rates
    end: Rates
    at_turn: Flag
    """The step was aimed at a turning point of it, and met it."""
    leaves: Release | None
    """Whether and where it is released, if it can rest."""
    surge: tuple[Scalar, Scalar, Scalar] | None
    """How fast the force changes at both ends, and the shortest step that is cut at a turn of the
    force; absent where the body cannot rest."""


def held(plan: Plan, lane: Lane) -> AbstractScene:
    """The machine in its modes, with the bodies held that rest."""
    scene = plan.scene
    if lane.contact is None:
        return in_modes(scene, lane.modes)
    rests = tuple(x > 0 for x in lane.contact)
    return Moving(scene=scene, modes=lane.modes, held=rests, stops=scene.stops)


def alone(plan: Plan, lane: Lane, k: int) -> AbstractScene:
    """As `held`, but without a hold on coordinate number k."""
    scene = plan.scene
    if lane.contact is None or len(scene.coordinates) == 1:
        return in_modes(scene, lane.modes)
    rests = tuple((x > 0) & (j != k) for j, x in enumerate(lane.contact))
    return Moving(scene=scene, modes=lane.modes, held=rests, stops=scene.stops)


def timing(plan: Plan, lane: Lane) -> Scalar | None:
    """The elapsed time, where the method has to carry it along."""
    paced = plan.motion and plan.scene.pace(lane.s, lane.state) is not None
    return lane.record.time if paced else None


def attempt(
    plan: Plan, lane: Lane, active: Flag, holding: AbstractScene, motion: Expansion | None
) -> Trial:
    """Try the next step and see what it meets; of length zero for a lane that has ended."""
    scene, method = plan.scene, plan.method
    free = lane.target == FREE
    bound = plan.end(lane.part)
    limit = method.longest(scene, lane.s, lane.state)
    h = stop_gradient(jnp.where(free, jnp.minimum(lane.attempt, limit), lane.attempt))
    s1, last = lane.s + h, jnp.zeros_like(free)
    if plan.ticks(lane.state):
        # The margin spares a step for the last sliver that rounding leaves.
        last = free & (stop_gradient(bound - lane.s) <= h * (1 + 1e-6))
        s1 = jnp.where(last, bound, s1)
    s1 = jnp.where(active, s1, lane.s)
    s1 = pin(s1)
    h = s1 - lane.s

    time = timing(plan, lane)
    paced = time is not None
    if motion is not None:
        (new, time), error = motion.at(h), jnp.zeros_like(h)
    else:
        moved: Any = holding if method.uses_field else scene
        new, time, error = method.step(moved, lane.s, s1, lane.state, time)
    if not paced and lane.record.time is not None:
        time = lane.record.time + h
    if lane.contact is not None and not method.uses_field:
        rests = lane.contact[0] > 0
        new = jtu.tree_map(lambda a, b: jnp.where(rests, a, b), lane.state, new)
    new = pin(new)
    good = jnp.isfinite(total(new, jnp.zeros_like(h)))
    alive = scene.alive(new)
    if alive is not None:
        good = good & alive
    if method.adaptive:
        error = pin(error)
        good = good & (error <= 1)
    good = pin_flag(good, h)

    each_alone = tuple(alone(plan, lane, k) for k in range(len(scene.coordinates)))
    paths = []
    if plan.motion or scene.stops:
        for k, one in enumerate(each_alone):
            paths.append(_path(plan, lane, k, one, holding, (s1, new, h, limit), good))
    section, below = _section(plan, lane, holding, s1, new)
    guards = [*_stops(scene, paths), *_switches(lane, scene, holding, s1, new), *section]
    # The stops of one coordinate and a clock are never met together but on a section, where a step
    # ends; other events can be.
    together = scene.switches or scene.section(lane.state) is not None
    if together or not exact(scene, lane.state):
        eps = float(jnp.finfo(h.dtype).eps)
        guards = [guard._replace(slack=4 * eps * guard.scale) for guard in guards]
    seen = tuple(_seen(lane, good & last, good, h, each, guards) for each in guards)
    return Trial(
        s1, h, new, time, error, good, last, seen, tuple(paths), each_alone, holding, below
    )


def _path(
    plan: Plan, lane: Lane, k: int, free: Any, holding: Any, there: tuple, good: Flag
) -> Path:
    """What a step that ends `there` saw of coordinate number k."""
    s1, new, h, limit = there
    position = plan.scene.coordinates[k].position
    begin = rates(free.field, position, lane.s, lane.state)
    end = rates(free.field, position, s1, new)
    if lane.contact is not None and not exact(plan.scene, lane.state):
        # Of a body at rest place and velocity are known better than the state tells them, where
        # the coordinate is a difference. Its force is that on a free body.
        rests, place = lane.contact[k] > 0, plan.place(k, lane.contact[k], begin.x)
        begin, end = (
            Rates(jnp.where(rests, place, r.x), jnp.where(rests, 0.0, r.v), r.a)
            for r in (begin, end)
        )
    met = turns_within(_turn_tolerance(h) * _leniency(lane), end)
    aimed = lane.target == to_turn_of(k)
    for j in range(len(plan.scene.coordinates)):  # several may turn at once
        aimed = aimed if j == k else aimed | (lane.target == to_turn_of(j))
    if plan.scene.switches:  # such an event may be a turning point as well
        aimed = aimed | (lane.target >= to_switch(0))
    if plan.scene.section(lane.state) is not None:
        aimed = aimed | (lane.target == SECTION)
    at_turn = good & aimed & met
    leaves, surge = None, None
    if lane.contact is not None:
        leaves = release(lane, k, plan.scene.stops, begin, end, good, h)
        surge = (
            force_rate(free, position, holding, lane.s, lane.state),
            force_rate(free, position, holding, s1, new),
            stop_gradient(_SLIVER * limit + jnp.zeros_like(h)),
        )
    return Path(begin, end, at_turn, leaves, surge)


class _Guard(NamedTuple):
    """An event g = 0: g at both ends of a step."""

    name: float
    kind: str
    number: int
    begin: Rates
    end: Rates
    scale: Any
    """Of g, for its rounding."""
    coordinate: int | None = None
    """That a stop limits."""
    slack: Scalar | None = None


def _stops(scene: AbstractScene, paths: list[Path]) -> list[_Guard]:
    found = []
    for i, stop in enumerate(scene.stops):
        path = paths[stop.coordinate]
        begin, end = (x.scaled(stop.sign, stop.gap) for x in (path.begin, path.end))
        scale = 1 + jnp.abs(stop.gap)
        found.append(_Guard(to_stop(i), "stop", i, begin, end, scale, stop.coordinate))
    return found


def _switches(lane: Lane, scene: AbstractScene, moving: Any, s1: Scalar, new: Any) -> list[_Guard]:
    found = []
    for j, (switch, mode) in enumerate(zip(scene.switches, lane.modes, strict=True)):

        def guard(s: Scalar, state: Any, switch=switch, mode=mode) -> Scalar:
            return switch.guard(scene, s, state, mode)

        begin = guard_rates(moving.field, guard, lane.s, lane.state)
        end = guard_rates(moving.field, guard, s1, new)
        scale = 1 + stop_gradient(jnp.abs(end.v))
        found.append(_Guard(to_switch(j), "switch", j, begin, end, scale))
    return found


def _section(
    plan: Plan, lane: Lane, moving: Any, s1: Scalar, new: Any
) -> tuple[list[_Guard], Scalar | None]:
    """What ends a cycle, unless `s` itself does; and `Lane.below`."""
    scene = plan.scene
    if plan.ticks(lane.state):
        return [], None
    if scene.section(lane.state) is None:
        bound = plan.end(lane.part)

        def clock(state: Any) -> Scalar:
            return jnp.asarray(scene.clock(state))

        ends = (
            rates(moving.field, clock, lane.s, lane.state).scaled(1, bound),
            rates(moving.field, clock, s1, new).scaled(1, bound),
        )
        return [_Guard(SECTION, "section", 0, *ends, bound)], None

    def section(state: Any) -> Scalar:
        return jnp.asarray(scene.section(state))

    begin = rates(moving.field, section, lane.s, lane.state)
    end = rates(moving.field, section, s1, new)
    scale = 1 + stop_gradient(jnp.abs(end.v))
    # From the section it rises: it ends the next cycle only once it has been below, where one that
    # is started on the section and falls already is.
    assert lane.below is not None
    # On it is also what a search's step left so close to it: a cycle is no shorter.
    rounding = float(jnp.finfo(end.x.dtype).eps) ** 0.5 * scale
    here = stop_gradient(begin)
    falls = (here.x <= rounding) & (here.v < 0)
    armed = (lane.below > 0) | (here.x < -rounding) | falls
    below = jnp.where(armed | (stop_gradient(end.x) < -rounding), 1.0, lane.below)
    begin, end = (
        Rates(jnp.where(armed, r.x, -1.0), *(jnp.where(armed, x, 0.0) for x in (r.v, r.a)))
        for r in (begin, end)
    )
    return [_Guard(SECTION, "section", 0, begin, end, scale)], below


def beyond(event: _Guard | Crossing) -> Flag:
    """Whether a step ends beyond an event. One that begins there to rounding, after the event
    before, and still falls has not met it: it may end at once, at a turning point. Nor has one that
    stays there to rounding, as of bodies that touch at rest."""
    begin, end = event.begin, event.end
    if event.slack is None:
        return end.x > 0
    return (end.x > event.slack) & ~((begin.v < 0) & (end.v < 0) & (begin.x >= end.x))


def _seen(
    lane: Lane, ends: Flag, good: Flag, h: Scalar, guard: _Guard, all_of_them: list[_Guard]
) -> Crossing:
    """Whether a step that was aimed at this event met it.

    A step that ends an interval as it meets a stop, to rounding, is aimed at it: an impact on the
    section belongs to the cycle that ends there, so that it is not now in one, now in the next.
    """
    name, begin, end = guard.name, guard.begin, guard.end
    aimed = good & (lane.target == name)
    eps = float(jnp.finfo(h.dtype).eps)
    for other in all_of_them:
        if other.name == name:
            continue
        # What lies beyond another event was not reached. Events may come together, but for the
        # stops of one coordinate: then one is met after the other.
        alone = guard.coordinate is not None and guard.coordinate == other.coordinate
        if alone or other.slack is None:
            aimed = aimed & ~beyond(other)
        else:
            reached = (other.end.x <= 4 * other.slack) | ~beyond(other)
            aimed, ends = aimed & reached, ends & reached
    offset, square = landing(end)
    size = stop_gradient(jnp.abs(offset))
    # Two ways of being there to rounding: in place along the path, or, near grazing, in position.
    close = size <= _landing_tolerance(h) * _leniency(lane)
    there = (jnp.abs(end.x) <= 4 * eps * guard.scale) & (end.v >= 0)
    real = stop_gradient(square) > 0
    # One that is there may have no way left along a parabola: a body that is at rest on a surface.
    landed = pin_flag(aimed & (close & real | there), h)
    again = aimed & ~landed & real & (size < 0.25 * h)
    # Where bodies touch at rest, what is left of their speed is rounding.
    rises = end.v > 0 if guard.slack is None else end.v * h > guard.slack
    again = again | ends & there & close & rises
    return Crossing(name, guard.kind, guard.number, guard.slack, begin, end, offset, landed, again)


def _leniency(lane: Lane) -> Scalar:
    return jnp.where(lane.aims >= _PATIENCE, 1e3, jnp.ones_like(lane.aims))


def _landing_tolerance(x: Scalar) -> float:
    """Largest accepted |δ|: a derivative's error is of its order, the state's of its square."""
    return 1e-9 if x.dtype == jnp.float64 else 1e-4


def furthest_landing(x: Scalar) -> float:
    """Largest |δ| that is believed: one near grazing, or accepted after many aims."""
    return max(_turn_tolerance(x), 1e3 * _landing_tolerance(x))


def _turn_tolerance(x: Scalar) -> float:
    """Largest accepted offset from a turning point, whose height it enters in third order."""
    return 1e-5 if x.dtype == jnp.float64 else 1e-2
