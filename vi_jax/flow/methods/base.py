"""The interface of a method of integration to the hybrid step."""

import abc
from collections.abc import Callable, Sequence
from math import pi
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._types import Scalar, State
from ...machine import AbstractMachine, Shown, longest_step
from ..smooth import Integrals, SmoothMachine

# Places, as shares of a step, where guards are evaluated for a method without stages.
QUARTERS = (0.25, 0.5, 0.75)


@runtime_checkable
class Foreseen(Protocol):
    """A motion that is known before a step is taken."""

    def at(self, h: Scalar) -> tuple[State, Integrals]:
        """Return the state and the integrals after a length h."""
        ...

    def of(self, function: Callable[[State], Any]) -> Any:
        """Return a scalar function of the state as a power series (`Along` of `taylor.py`)."""
        ...

    def reach(self, limit: Scalar) -> Scalar:
        """Return the length up to which the motion is accurate, at most `limit`."""
        ...


class Stage(NamedTuple):
    """A place within a step at which its method computes the state, at least approximately."""

    share: float
    """The place, as a share of the step; static."""
    s: Scalar
    state: State | None
    """`None` if the method would need another step to compute it."""
    weight: float = 0.0
    """The weight of the stage in the error estimate of the step; static, 0 for methods without."""


def stages_to_step_to(shares: Sequence[float], s: Scalar, h: Scalar) -> list[Stage]:
    """Return places within a step at which the state is computed by another step."""
    return [Stage(share, s + share * h, None) for share in shares]


def has_relaxation(machine: AbstractMachine, s: Scalar, state: State) -> bool:
    """Return whether a machine defines its fastest decay (`relaxation`); known at trace time."""
    return jax.eval_shape(machine.relaxation, s, state) is not None


class AbstractMethod(Shown):
    """The interface of a method to the hybrid step."""

    @property
    @abc.abstractmethod
    def steps_per_cycle(self) -> int:
        """The fewest ordinary steps in a cycle; static."""

    @property
    def adaptive(self) -> bool:
        """True if steps can be rejected and resized."""
        return False

    @property
    def wander(self) -> Any:
        """The greatest difference of the states of a periodic motion between two periods, relative
        to the size of each number; 0 for rounding only, since each period has the same steps."""
        return 0.0

    def with_sizes(self, sizes: State) -> "AbstractMethod":
        """Return the method for a motion whose numbers have these sizes."""
        if not hasattr(self, "sizes"):
            return self
        # Not `replace`: it would check options again, which may be traced by now.
        return eqx.tree_at(lambda m: m.sizes, self, sizes, is_leaf=lambda x: x is None)

    def holds(self, machine: AbstractMachine) -> bool:
        """Return whether a step moves the rest of the machine while a body rests, as with methods
        that evaluate the field; otherwise the whole state is constant then."""
        return True

    def resolves(self, machine: AbstractMachine) -> bool:
        """Return whether steps are so short that their ends show whether a free body turned twice
        in one; static."""
        return False

    def check(self, machine: AbstractMachine) -> None:
        """Raise a `ValueError` if this method cannot integrate `machine`."""

    @property
    def is_limited_by_decay(self) -> bool:
        """True if steps must be short compared with the fastest decay, since decaying components
        would grow otherwise; static."""
        return True

    def may_be_unstable(self, machine: AbstractMachine, s: Scalar, state: State) -> bool:
        """Return whether a step may be so long that its error grows from step to step; static."""
        return False

    def longest(self, machine: AbstractMachine, s: Scalar, state: State) -> Scalar | float:
        """Return the longest step from this state.

        A method with a number of steps in a drive cycle takes as many in a natural period, if that
        is shorter. With the fewest, five, a step may be as long as 0.8π relaxation times: up to
        that explicit Runge–Kutta methods are stable, and the series of `ExactFlight` accurate.
        """
        limit = longest_step(machine, s, state)
        decay_time = machine.relaxation(s, state) if self.is_limited_by_decay else None
        if decay_time is not None:
            limit = jnp.minimum(limit, 0.8 * pi * decay_time)
        return limit * (5 / self.steps_per_cycle)

    def clear(self, machine: AbstractMachine, s: Scalar, state: State) -> Scalar | None:
        """Return a length of the motion from this state in which no stop can be met, so that a step
        of this length is not searched for events; `None` if the method has no such bound."""
        return None

    @abc.abstractmethod
    def step(
        self, smooth: SmoothMachine, s0: Scalar, s1: Scalar, state: State, beside: Integrals
    ) -> tuple[State, Integrals, Scalar]:
        """Return the state and the integrals `beside` it (rates: `rate_of_integrals`) at `s1` from
        those at `s0`, and the step's error relative to the tolerance. A step is accepted up to an
        error of 1. Methods that are not adaptive return 0, or more than 1 if `may_be_unstable` and
        the step is unstable."""

    def step_with_stages(
        self, smooth: SmoothMachine, s0: Scalar, s1: Scalar, state: State, beside: Integrals
    ) -> tuple[State, Integrals, Scalar, list[Stage]]:
        """Return the results of `step` and its stages: states within the step, for guards that its
        ends do not resolve; by default three places to step to."""
        new, beside, error = self.step(smooth, s0, s1, state, beside)
        return new, beside, error, stages_to_step_to(QUARTERS, s0, s1 - s0)

    def guard_error(
        self, stages: list[Stage], values: Array, h: Scalar, longest: Scalar, *, acts: bool,
        size: Scalar | float,
    ) -> Scalar | None:  # fmt: skip
        """Return the error of the integral of a guard, from its `values` at the `stages` of a step,
        relative to the tolerance, or `None` for a method without an estimate. `acts`: the guard is
        a force on a held body; `longest`: the longest step; `size`: the size of the integral."""
        return None

    def foresee(
        self, smooth: SmoothMachine, s: Scalar, state: State, beside: Integrals
    ) -> Foreseen | None:
        """Return the motion from this state, if the method computes it before a step (`Taylor`), or
        `None`. A step then ends at its first event, and `Foreseen.at` replaces `step`."""
        return None

    @abc.abstractmethod
    def tighter(self) -> "AbstractMethod":
        """Return a method of the same kind with a much smaller error, for an error estimate. Its
        steps are at most half as long, so that it also resolves shorter inputs."""

    def resize(self, error: Scalar) -> Scalar:
        """Return the factor from one step's length to the next one's."""
        return jnp.ones_like(error)
