"""Coordinates that contacts act on, components of a state by name, and angles that grow. Whole
turns are removed at the end of a cycle, and ignored where states are compared."""

import functools
from collections.abc import Callable
from math import pi
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.lax import stop_gradient

from .._types import Machine, Scalar, State
from .leaves import components, split_index


class Row(NamedTuple):
    """The row of a coordinate in the equations of contacts."""

    push: State
    """The change of the state by an impulse that changes the velocity by one."""
    mass: Any
    """The effective mass."""
    slopes: State | None = None
    """The derivative of its velocity with respect to the state's velocities, with zeros in place of
    positions; `None` if unknown."""


class Coordinate(NamedTuple):
    """A coordinate that stops limit."""

    position: Callable[[State], Scalar]
    velocity: Callable[[State], Scalar]
    """The velocity that an impact reverses; it has the sign of d(position)/ds."""
    placed: Callable[[State, Any, Any], State]
    """The state with another position and velocity, and all other changes by an impact."""
    mass: Any = 1.0
    """The effective mass of an impact, in the machine's unit of mass: for two bodies the reduced
    mass. A number, or a function `mass(s, state)`."""
    push: Callable[[State], State] | None = None
    """The change of the state by an impulse that changes the velocity by one; by default the
    derivative of `placed` with respect to the velocity."""
    row: Callable[[State], Row] | None = None
    """Its `Row`, if push, mass and slopes are computed together."""
    moves_at_velocity: bool = False
    """True if d(position)/ds is the velocity, exactly."""

    def mass_at(self, s: Scalar, state: State) -> Any:
        """Return the mass in a state."""
        return self.mass(s, state) if callable(self.mass) else self.mass


def coordinate_by_name(on: Any, mass: Any) -> Coordinate:
    """Return the coordinate of these components of a state. **Arguments:** `on`, the names of
    position and velocity, or of a velocity; `mass`, as `Coordinate.mass`, 1 if it is `None`."""
    position, velocity = (on, on) if isinstance(on, str) else on
    get = functools.partial(component, position), functools.partial(component, velocity)
    placed = functools.partial(_placed, position, velocity)
    return Coordinate(*get, placed, 1.0 if mass is None else mass)


def component(name: str, state: State) -> Any:
    """Return a component of a state by its name: `"x"`, `"v.x"`, `"x[3]"`."""
    base, index = split_index(name)
    found = functools.reduce(getattr, base.split("."), state)
    if not index:
        return found  # the leaf itself, so that a stop can set it exactly
    shape = jnp.shape(found)
    if len(index) != len(shape) or any(not -n <= i < n for i, n in zip(index, shape, strict=True)):
        raise LookupError(f"The state has no component {name!r}; {base!r} has the shape {shape}.")
    return found[index]


def has_component(name: str, state: State) -> bool:
    """Return whether the state has a component of this name."""
    try:
        component(name, state)
    except (AttributeError, LookupError):
        return False
    return True


def with_component(name: str, state: State, value: Any) -> State:
    """Return the state with another value of this component."""
    base, index = split_index(name)
    if index:
        value = component(base, state).at[index].set(value)
    return eqx.tree_at(functools.partial(component, base), state, value)


def _placed(position: str, velocity: str, state: State, Y: Scalar, V: Scalar) -> State:
    if position == velocity:
        return with_component(velocity, state, V)
    return with_component(velocity, with_component(position, state, Y), V)


def wrap_angles(*names: str) -> Callable[[Any, State], State]:
    """Return a method `renewed` for a machine with angles that grow by whole turns: `renewed =
    vi.wrap_angles("phi")`.

    At the end of each cycle an angle is reduced to [-π, π], so that a rotation is a periodic
    motion. Orbits and branches close up to whole turns, and may pass ±π. Basins and kicks compare
    angles in the same way.

    **Arguments:** `names`, the names of the angles in the state (radians).
    """

    def renewed(machine: Any, state: State) -> State:
        for name in names:
            angle = component(name, state)
            state = with_component(name, state, without_turns(angle))
        return state

    renewed.angles = frozenset(names)  # pyright: ignore[reportFunctionMemberAccess]
    return renewed


def without_turns(angle: Any) -> Any:
    """Return an angle, or a difference of angles, reduced to [-π, π]."""
    if isinstance(angle, np.ndarray):
        return angle - 2 * pi * np.round(angle / (2 * pi))
    return angle - 2 * pi * stop_gradient(jnp.round(angle / (2 * pi)))


def is_angle(machine: Machine, name: str) -> bool:
    """Return whether a component, or its array, is an angle of `wrap_angles`."""
    return not {name, split_index(name)[0]}.isdisjoint(_angles(machine))


def _angles(machine: Machine) -> frozenset[str]:
    return getattr(type(machine).renewed, "angles", frozenset())


def angles_in(machine: Machine, like: State) -> np.ndarray | None:
    """Return which components of a state are angles of `wrap_angles`, or `None` without angles.
    **Arguments:** `like`, one state, without modes."""
    if not _angles(machine):
        return None
    return np.array([is_angle(machine, name) for name in components(like)])


def nearest_images(angles: np.ndarray | None, states: Any, references: Any) -> Any:
    """Return the images of `states`, under whole turns of angles, nearest to `references`.
    **Arguments:** `angles`, from `angles_in`; states as rows of numbers, the last axis."""
    if angles is None:
        return states
    images = references + without_turns(states - references)
    return (np if isinstance(images, np.ndarray) else jnp).where(angles, images, states)
