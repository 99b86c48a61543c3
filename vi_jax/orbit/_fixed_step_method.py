"""The method by which a branch's motions are followed from event to event, and its steps.

Newton's method on the equations of an orbit needs flights that depend smoothly on their unknowns.
Steps that are sized by a tolerance do not: their number jumps.
"""

from math import ceil

import jax.numpy as jnp
import numpy as np

from .._programs import compiled
from .._types import Scalar, State
from ..flow import AbstractMethod, Adaptive, FixedStep, ImplicitSteps, MethodLike, chosen
from ..machine import AbstractMachine


def has_fixed_steps(method: AbstractMethod) -> bool:
    """Whether a method takes the same steps along the same motion, sized by no tolerance."""
    return not method.adaptive and not np.any(np.asarray(method.wander))


def fixed_step_method(
    asked: MethodLike, found_with: AbstractMethod, machine: AbstractMachine
) -> AbstractMethod:
    """A method of fixed steps for the branch of an orbit.

    **Arguments:** the method that the caller asked for, or `None`; the one with which the orbit
    was found; the orbit's machine.

    **Returns:** the one asked for; else that of the orbit, if its steps are fixed; else
    `ExactFlight` where it applies; else 20 steps of `Verner9` a cycle, whose error is 1e-13. Of an
    implicit solver equal steps. Where the motion paces its own clock, and of such a solver, there
    are as many steps as it takes (see `problem_of`).

    **Raises:** `ValueError` if the one asked for is explicit and sizes its steps by a tolerance.
    """
    method = found_with if asked is None else asked
    if isinstance(method, Adaptive) and method.solver.implicit:
        return ImplicitSteps(method.solver, 20)
    if asked is not None:
        method = chosen(machine, asked)
        if not has_fixed_steps(method):
            raise ValueError(
                "Argument `method` must be of fixed steps to follow an orbit, as `FixedStep(...)`, "
                "`ExactFlight()` or a `Taylor(...)` without `rtol`, since steps sized by a "
                f"tolerance do not depend smoothly on the motion, but got {method!r}."
            )
        method.check(machine)
        return method
    if has_fixed_steps(found_with):
        return found_with
    return chosen(machine, None, FixedStep(steps_per_cycle=20))


def steps_of(
    method: AbstractMethod, machines: list[AbstractMachine], like: State, cycles: int
) -> int:
    """Steps that a flight over the whole period needs, in the most demanding of the machines.

    **Arguments:** the method; the machines at the ends of the interval of a parameter; a state, for
    its structure; the period in cycles.
    """
    # Turning points are looked for between steps: more of them than flying needs.
    fewest = (ceil(1.02 * float(_fewest(method, machine, like))) for machine in machines)
    return max(method.steps_per_cycle, 16, *fewest) * cycles


@compiled
def _fewest(method: AbstractMethod, machine: AbstractMachine, like: State) -> Scalar | float:
    """The number of steps in a cycle if each is as long as the method allows."""
    return machine.cycle / method.longest(machine, jnp.zeros(()), like)
