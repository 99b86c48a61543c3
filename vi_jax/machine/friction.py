"""Dry friction, with sticking as a mode."""

from collections.abc import Callable
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._checks import NOT_NEGATIVE, Range, real, real_or_law, require_ranges
from .._types import Flag, Machine, Scalar, State
from .event import AbstractSwitch


class DryFriction(AbstractSwitch):
    """Coulomb friction on one body: it slides against a force, or sticks.

    While it slides forward (mode +1) or backward (-1) friction is `level` against the motion. Where
    the velocity vanishes the body sticks (mode 0) as long as what else acts on it stays below
    `static_ratio` times the level at no speed; there friction balances it. A body that is pulled
    harder goes through, or off. In the machine's field, with everything else that acts on the body
    as `force`:

        acceleration = (force + friction.contribution(machine, s, state, mode)) / mass

    **Arguments:**

    - `level`: μN in the machine's unit of force, not negative; or a function of the speed of
      sliding (Stribeck's curve), smooth from a little below zero on. One with numbers of its own is
      a pytree, an `equinox.Module` with `__call__`.
    - `load(machine, s, state)`: what the level is multiplied by, not negative: the force N that
      presses the surfaces together, where it varies, `level` then being μ. One if left out.
    - `static_ratio`: μ_s/μ, at least 1.
    - `velocity(machine, state)`: of the body against what it rubs on.
    - `force(machine, s, state)`: what acts on it besides.
    - `stopped(machine, state)`: the state with that velocity set to zero.
    """

    level: Any = eqx.field(converter=real_or_law("level"))
    velocity: Callable[..., Any] = eqx.field(static=True, kw_only=True)
    force: Callable[..., Any] = eqx.field(static=True, kw_only=True)
    stopped: Callable[..., Any] = eqx.field(static=True, kw_only=True)
    static_ratio: Float[Array, "..."] = eqx.field(
        kw_only=True, default=1.0, converter=real("static_ratio")
    )
    load: Callable[..., Any] | None = eqx.field(static=True, kw_only=True, default=None)
    ranges: ClassVar = {"level": NOT_NEGATIVE, "static_ratio": Range(1.0, float("inf"))}

    def __check_init__(self):
        require_ranges(self)

    @property
    def may_slide(self) -> bool:
        """Never along its own surface: where both sides point at it, the body sticks."""
        return False

    def sliding(self, machine: Machine, s: Scalar, state: State, mode: Scalar) -> Any:
        """The size of friction on a body that slides forward or backward; in mode 0 on one that
        begins to."""
        level = self.level
        if callable(level):
            level = level(mode * self.velocity(machine, state))
        return level if self.load is None else level * self.load(machine, s, state)

    def sticking(self, machine: Machine, s: Scalar, state: State) -> Any:
        """The largest force that friction can balance on a body at rest."""
        return self.sliding(machine, s, state, jnp.zeros_like(s)) * self.static_ratio

    def contribution(self, machine, s, state, mode):
        """What friction adds to the force on the body."""
        slides = self.sliding(machine, s, state, mode) * mode
        return -jnp.where(mode == 0, self.force(machine, s, state), slides)

    def begin(self, machine, s, state):
        """Sliding, or sticking where the velocity is zero and the force too small."""
        velocity, force = self.velocity(machine, state), self.force(machine, s, state)
        sticks = jnp.abs(force) <= self.sticking(machine, s, state)
        return jnp.where(velocity != 0, jnp.sign(velocity), self._from_rest(sticks, force))

    def guard(self, machine, s, state, mode):
        """The velocity coming to zero; or the force coming to what friction can hold."""
        excess = jnp.abs(self.force(machine, s, state)) - self.sticking(machine, s, state)
        return jnp.where(mode == 0, excess, -mode * self.velocity(machine, state))

    def sides(self, machine, s, state, mode):
        """The guard for a force forward and for one backward."""
        force, holds = self.force(machine, s, state), self.sticking(machine, s, state)
        slows = -mode * self.velocity(machine, state)
        return tuple(jnp.where(mode == 0, way * force - holds, slows) for way in (1.0, -1.0))

    def after(self, machine, s, state, mode):
        """Sticking, or sliding the way the force pulls."""
        state, force = self.stopped(machine, state), self.force(machine, s, state)
        sticks = (jnp.abs(force) <= self.sticking(machine, s, state)) & (mode != 0)
        return state, self._from_rest(sticks, force)

    def _from_rest(self, sticks: Flag, force: Scalar) -> Scalar:
        return jnp.where(sticks, 0.0, jnp.where(force < 0, -1.0, 1.0))
