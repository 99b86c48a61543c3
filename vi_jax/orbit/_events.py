"""The events of a periodic motion, and what they do to its state."""

from typing import Any, NamedTuple

import jax.numpy as jnp

from ..scene import AbstractScene, Coordinate, RigidStop


class Event(NamedTuple):
    """What begins a flight: an impact, a switch, or a section that counts for the motion."""

    kind: str
    """"stop", "switch" or "section"."""
    number: int
    """Of the stop or switch; of the cycle that a section begins."""


def jump(
    scene: AbstractScene, event: Event, s: Any, state: Any, mode: Any, *, landed: bool = True
) -> Any:
    """The state after an event, from that in which it is met; without `landed` from one beside it,
    whose position, or what a switch puts right, is left as it is."""
    if event.kind == "stop":
        stop, body = _met(scene, event)
        place = stop.place if landed else body.position(state)
        return body.placed(state, place, stop.rebound(body.velocity(state)))
    if event.kind == "switch":
        return scene.switches[event.number].after(scene, s, state, mode)[0] if landed else state
    return scene.renewed(state)


def _met(scene: AbstractScene, event: Event) -> tuple[RigidStop, Coordinate]:
    """The stop of an impact, and what meets it."""
    stop = scene.stops[event.number]
    return stop, scene.coordinates[stop.coordinate]


def approach_of(scene: AbstractScene, event: Event, state: Any, rate: Any) -> Any:
    """V⁻ of an impact; of another event how fast its guard rises."""
    if event.kind == "stop":
        stop, body = _met(scene, event)
        return stop.approach(body.velocity(state))
    return rate


def guard_of(scene: AbstractScene, event: Event, s: Any, state: Any, mode: Any) -> Any:
    """What is zero at an event, and rises there."""
    if event.kind == "stop":
        stop, body = _met(scene, event)
        return stop.beyond(body.position(state))
    if event.kind == "switch":
        return scene.switches[event.number].guard(scene, s, state, mode)
    rises = scene.section(state)
    return s - jnp.asarray(scene.cycle, s.dtype) * event.number if rises is None else rises
