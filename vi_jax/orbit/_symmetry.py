"""Motions whose second half is as the first, or its image under the symmetry of their machine."""

from collections.abc import Iterable

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..machine import AbstractMachine, stops_of
from ._flight import Event
from ._shooting import Shooting

# Halves of a period that differ by less than this are alike, or images of each other; and by less
# than this but for rounding: choices.
ALIKE, ROUNDED = 1e-3, 1e-7


def may_be_symmetric(problem: Shooting, machines: Iterable[AbstractMachine]) -> bool:
    """Whether a motion with these events can be its own image, on each of these machines.

    A machine that is driven is its own image after half a drive cycle, so that only periods of an
    odd number of cycles can be.
    """
    events, half = problem.events, len(problem.events) // 2
    if problem.cycles % 2 == 0 or problem.autonomous or len(events) % 2:
        return False
    if any(machine.mirrored(problem.like) is None for machine in machines):
        return False
    pairs = zip(events[:half], events[half:], strict=True)
    return all(_are_images(problem.machine, one, other) for one, other in pairs)


def _are_images(machine: AbstractMachine, one: Event, other: Event) -> bool:
    stops = stops_of(machine)
    if one.use != other.use:
        return False
    if max(one.number, other.number) < len(stops):  # stops come first among the events
        left, right = stops[one.number], stops[other.number]
        return left.coordinate == right.coordinate and left.sign == -right.sign
    return one.of(machine).holds_mode and other.of(machine).holds_mode


def may_repeat(problem: Shooting) -> bool:
    """Whether the second half of a period with these events can be as the first."""
    events, half = problem.events, len(problem.events) // 2
    later = tuple(event.later(-(problem.cycles // 2)) for event in events[half:])
    return problem.cycles % 2 == 0 and events[:half] == later


def halves(
    problem: Shooting, x: Float[Array, " unknowns"], mirrored: bool
) -> Float[Array, " differences"]:
    """How the second half of a period differs from the first, or from its image; smooth along a
    branch, as the events of both halves are compared."""
    half, turn = len(problem.events) // 2, 0.5 * problem.period(x)

    def image(u):
        if not mirrored:
            return u
        return ravel_pytree(problem.machine.mirrored(problem.unravel(u)))[0]

    clock, states = problem.parts(x)
    if not half:
        return ravel_pytree(problem.state_at(x, 0, turn))[0] - image(states[0])
    late = clock[half:] - clock[:half] - turn
    return jnp.concatenate([late, (states[half:] - jax.vmap(image)(states[:half])).ravel()])
