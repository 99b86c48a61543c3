"""A step that is tried, and what it meets on its way."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
from jax.lax import stop_gradient
from jaxtyping import Array, Bool, Float

from ..lanes import pin, pin_flag
from ..scene import AbstractScene
from .events import Rates, force_rate, landing, rates
from .lane import FREE, SECTION, TURN, Lane, Plan, total
from .rest import Holding, release
from .taylor import Expansion

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
    position: tuple[Rates, Rates] | None
    at_turn: Flag
    """It was aimed at a turning point and met it."""
    holding: Any
    """The scene as the step saw it: its body held where it rests."""
    leaves: tuple[Flag, Flag, Scalar, Scalar] | None
    """Whether and where a body at rest is released (see `rest.release`)."""
    surge: tuple[Scalar, Scalar, Scalar] | None
    """How fast the force changes at both ends, and the shortest step that is cut at a turn of the
    force; absent where the body cannot rest."""


def held(plan: Plan, lane: Lane) -> AbstractScene:
    """The scene with its body held where it rests."""
    scene = plan.scene
    if lane.contact is None:
        return scene
    return Holding(scene=scene, held=lane.contact > 0, stops=scene.stops)


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
        rests = lane.contact > 0
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

    crossings, position = [], None
    at_turn = jnp.zeros_like(free)
    if plan.motion or scene.stops:
        begin = rates(scene.field, scene.position, lane.s, lane.state)
        end = rates(scene.field, scene.position, s1, new)
        position = begin, end
        shift = to_turn(end)
        met = jnp.abs(shift) <= _turn_tolerance(h) * _leniency(lane)
        at_turn = good & (lane.target == TURN) & met
        for i, stop in enumerate(scene.stops):
            ends = begin.scaled(stop.sign, stop.gap), end.scaled(stop.sign, stop.gap)
            crossings.append((1.0 + i, *ends, 1 + jnp.abs(stop.gap)))
    if not plan.ticks(lane.state):

        def clock(state: Any) -> Scalar:
            return jnp.asarray(scene.clock(state))

        ends = (
            rates(scene.field, clock, lane.s, lane.state).scaled(1, bound),
            rates(scene.field, clock, s1, new).scaled(1, bound),
        )
        crossings.append((SECTION, *ends, bound))
    leaves, surge = None, None
    if position is not None and lane.contact is not None:
        leaves = release(lane, scene.stops, *position, good, h)
        surge = (
            force_rate(scene, holding, lane.s, lane.state),
            force_rate(scene, holding, s1, new),
            stop_gradient(_SLIVER * limit + jnp.zeros_like(h)),
        )
    seen = tuple(_seen(lane, good & last, good, h, each, crossings) for each in crossings)
    return Trial(
        s1, h, new, time, error, good, last, seen, position, at_turn, holding, leaves, surge
    )  # fmt: skip


def _seen(
    lane: Lane, ends: Flag, good: Flag, h: Scalar, crossing: tuple, all_of_them: list
) -> Crossing:
    """Whether a step that was aimed at this event met it.

    A step that ends an interval as it meets a stop, to rounding, is aimed at it: an impact on the
    section belongs to the cycle that ends there, so that it is not now in one, now in the next.
    """
    name, begin, end, scale = crossing
    aimed = good & (lane.target == name)
    for other, _, beyond, _ in all_of_them:
        if other != name:  # what lies beyond another stop was not reached
            aimed = aimed & (beyond.x <= 0)
    offset, square = landing(end)
    size = stop_gradient(jnp.abs(offset))
    eps = float(jnp.finfo(h.dtype).eps)
    # Two ways of being there to rounding: in place along the path, or, near grazing, in position.
    close = size <= _landing_tolerance(h) * _leniency(lane)
    there = jnp.abs(end.x) <= 4 * eps * scale
    close = close | (there & (end.v >= 0))
    real = stop_gradient(square) > 0
    landed = pin_flag(aimed & close & real, h)
    again = aimed & ~close & real & (size < 0.25 * h)
    again = again | ends & there & (end.v > 0)
    return Crossing(name, begin, end, offset, landed, again)


def _leniency(lane: Lane) -> Scalar:
    return jnp.where(lane.aims >= _PATIENCE, 1e3, jnp.ones_like(lane.aims))


def _landing_tolerance(x: Scalar) -> float:
    """Largest accepted |δ|: a derivative's error is of its order, the state's of its square."""
    return 1e-9 if x.dtype == jnp.float64 else 1e-4


def _turn_tolerance(x: Scalar) -> float:
    """Largest accepted offset from a turning point, whose height it enters in third order."""
    return 1e-5 if x.dtype == jnp.float64 else 1e-2


def to_turn(end: Rates) -> Scalar:
    """Offset from a step's end to the turning point near it."""
    bend = stop_gradient(end.a)
    return -stop_gradient(end.v) / jnp.where(bend == 0, 1.0, bend)
