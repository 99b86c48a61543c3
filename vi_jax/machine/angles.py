"""Angles that grow: whole turns are taken off at the end of a cycle, and left out where states are
compared."""

from collections.abc import Callable
from math import pi
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from .._types import Machine, State
from .coordinates import component, with_component
from .numbers import components, split_place


def wrap_angles(*names: str) -> Callable[[Any, State], State]:
    """Return a method `renewed` for a machine with angles that grow by whole turns:
    `renewed = vi.wrap_angles("phi")`.

    At the end of each cycle an angle is set back into [-π, π], so that a rotation is a periodic
    motion. Orbits and branches close up to whole turns, and may pass ±π; basins and kicks compare
    angles in the same way.

    **Arguments:** `names`, of the angles in the state (radians).
    """

    def renewed(machine: Any, state: State) -> State:
        for name in names:
            angle = component(name, state)
            state = with_component(name, state, without_turns(angle))
        return state

    renewed.angles = frozenset(names)  # pyright: ignore[reportFunctionMemberAccess]
    return renewed


def without_turns(angle: Any) -> Any:
    """An angle, or a difference of angles, in [-π, π]."""
    if isinstance(angle, np.ndarray):
        return angle - 2 * pi * np.round(angle / (2 * pi))
    return angle - 2 * pi * stop_gradient(jnp.round(angle / (2 * pi)))


def is_angle(machine: Machine, name: str) -> bool:
    """Whether a number of the state is an angle of `wrap_angles`, by its name or its array's."""
    return not {name, split_place(name)[0]}.isdisjoint(_angles(machine))


def _angles(machine: Machine) -> frozenset[str]:
    return getattr(type(machine).renewed, "angles", frozenset())


def angles_in(machine: Machine, like: State) -> np.ndarray | None:
    """Which numbers of a state are angles of `wrap_angles`; `None` if none is.

    **Arguments:** `like`, one state, without modes.
    """
    if not _angles(machine):
        return None
    return np.array([is_angle(machine, name) for name in components(like)])


def nearest_images(angles: np.ndarray | None, here: Any, there: Any) -> Any:
    """States moved by whole turns of their angles to where they are nearest to other states.

    **Arguments:** `angles`, of `angles_in`; states as rows of numbers, the last axis.
    """
    if angles is None:
        return here
    moved = there + without_turns(here - there)
    return (np if isinstance(moved, np.ndarray) else jnp).where(angles, moved, here)
