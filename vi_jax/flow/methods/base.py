"""What the hybrid step asks of a method, which is an argument of every verb."""

import abc
from collections.abc import Callable, Sequence
from math import pi
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from ..._types import Scalar, State
from ...machine import AbstractMachine
from ..smooth import Integrals, SmoothMachine

# Where guards are evaluated within a step of a method without stages, as shares of it.
QUARTERS = (0.25, 0.5, 0.75)


@runtime_checkable
class Foreseen(Protocol):
    """A motion that is known before a step is taken."""

    def at(self, h: Scalar) -> tuple[State, Integrals]:
        """State, and what is integrated beside it, a length h away."""
        ...

    def of(self, function: Callable[[State], Any]) -> Any:
        """A scalar function of the state along it, as a power series (`Along` of `taylor.py`)."""
        ...

    def reach(self, limit: Scalar) -> Scalar:
        """How far it is known well enough, up to this limit."""
        ...


class Stage(NamedTuple):
    """A place within a step at which its method knows the state, or nearly."""

    share: float
    """Of the step; static."""
    s: Scalar
    state: State | None
    """`None` of a method that can tell it by another step, where it is asked for."""
    weight: float = 0.0
    """Of the stage in the error estimate of the step; static, 0 of a method that has none."""


def stages_to_step_to(shares: Sequence[float], s: Scalar, h: Scalar) -> list[Stage]:
    """Places within a step at which the state is asked for by another step."""
    return [Stage(share, s + share * h, None) for share in shares]


def fading_is_known(machine: AbstractMachine, s: Scalar, state: State) -> bool:
    """Whether a machine defines how fast it fades (`relaxation`); static, without an equation."""
    return jax.eval_shape(machine.relaxation, s, state) is not None


class AbstractMethod(eqx.Module):
    """The interface of a method to the hybrid step."""

    @property
    @abc.abstractmethod
    def steps_per_cycle(self) -> int:
        """The fewest ordinary steps in a cycle; static."""

    @property
    def adaptive(self) -> bool:
        """Whether steps can be rejected and resized."""
        return False

    @property
    def wander(self) -> Any:
        """How far the states of a periodic motion may differ from one period to the next, relative
        to the size of each number; 0 if only by rounding, since each period has the same steps."""
        return 0.0

    def with_sizes(self, sizes: State) -> "AbstractMethod":
        """The method for a motion whose numbers are about so large."""
        return self

    def holds(self, machine: AbstractMachine) -> bool:
        """Whether a step moves the rest of the machine while a body rests, as methods that evaluate
        the field do; otherwise the whole state is constant then."""
        return True

    def resolves(self, machine: AbstractMachine) -> bool:
        """Whether steps are so short that a free body cannot turn twice in one without being seen;
        static."""
        return False

    def check(self, machine: AbstractMachine) -> None:
        """Raise a `ValueError` if this method cannot move `machine`."""

    @property
    def follows_fading(self) -> bool:
        """Whether steps must be short compared with fading components, or they grow instead;
        static."""
        return True

    def may_be_unstable(self, machine: AbstractMachine, s: Scalar, state: State) -> bool:
        """Whether a step may be so long that its error grows from step to step; static."""
        return False

    def longest(self, machine: AbstractMachine, s: Scalar, state: State) -> Scalar | float:
        """The longest step from here.

        A method of so many steps in a drive cycle takes as many in a natural period, where that is
        shorter. With the fewest, five, a step may be as long as 0.8π relaxation times: up to there
        explicit Runge–Kutta methods are stable, and the series of `ExactFlight` exact.
        """
        limit = machine.step_limit(s, state)
        fading = machine.relaxation(s, state) if self.follows_fading else None
        if fading is not None:
            limit = jnp.minimum(limit, 0.8 * pi * fading)
        return limit * (5 / self.steps_per_cycle)

    def clear(self, machine: AbstractMachine, s: Scalar, state: State) -> Scalar | None:
        """A length of the motion from here in which no stop can be met, so that a step of this
        length is not searched for events; `None` if the method has no such bound."""
        return None

    @abc.abstractmethod
    def step(
        self, smooth: SmoothMachine, s0: Scalar, s1: Scalar, state: State, beside: Integrals
    ) -> tuple[State, Integrals, Scalar]:
        """State, and what is integrated `beside` it (rates: `rate_of_integrals`), at `s1` from
        those at `s0`, and the step's error relative to the tolerance: a step is accepted up to 1.
        Methods that are not adaptive return 0, or more than 1 where `may_be_unstable` and the step
        is."""

    def step_with_stages(
        self, smooth: SmoothMachine, s0: Scalar, s1: Scalar, state: State, beside: Integrals
    ) -> tuple[State, Integrals, Scalar, list[Stage]]:
        """Return what `step` does, and the stages of the step: states within it, at which guards
        are evaluated that its ends do not resolve. By default they are three places to step to."""
        new, beside, error = self.step(smooth, s0, s1, state, beside)
        if not self.holds(smooth.machine):
            return new, beside, error, []
        return new, beside, error, stages_to_step_to(QUARTERS, s0, s1 - s0)

    def guard_error(
        self, stages: list[Stage], values: Array, h: Scalar, longest: Scalar, *, acts: bool,
        size: Scalar | float,
    ) -> Scalar | None:  # fmt: skip
        """Return the error of the integral of a guard, by its `values` at the `stages` of a step,
        relative to the tolerance, or `None` of a method that estimates none. `acts` is whether the
        guard is a force on a body that is held, `longest` the longest step, `size` that of the
        integral."""
        return None

    def foresee(
        self, smooth: SmoothMachine, s: Scalar, state: State, beside: Integrals
    ) -> Foreseen | None:
        """The motion from here, for a method that computes it before a step is taken (see
        `Taylor`). A step then ends at the first event on it, and `Foreseen.at` replaces `step`."""
        return None

    @abc.abstractmethod
    def tighter(self) -> "AbstractMethod":
        """A method of the same kind with a much smaller error, for an estimate of this method's
        error. Its steps are at most half as long, so that it also resolves shorter inputs."""

    def resize(self, error: Scalar) -> Scalar:
        """Factor from one step's length to the next one's."""
        return jnp.ones_like(error)
