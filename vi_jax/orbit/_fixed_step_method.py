"""The method that a smooth system of equations is solved with, and the steps of its flights."""

from math import ceil
from typing import Any

import jax.numpy as jnp

from .._programs import compiled
from ..flow import AbstractMethod, ExactFlight, FixedStep
from ..flow.methods import MethodLike, chosen
from ..machine import AbstractMachine


def fixed_step_method(
    asked: MethodLike, found_with: AbstractMethod, machine: AbstractMachine
) -> AbstractMethod:
    """A method of fixed steps, which a smooth system of equations needs: the one asked for, else
    that of the orbit if it is one, else `ExactFlight` where it applies, else 20 steps of
    `Verner9` a cycle, whose error is 1e-13.

    **Raises:** `ValueError` if one is asked for that has no fixed steps.
    """
    if asked is not None:
        method = chosen(machine, asked)
        if not isinstance(method, FixedStep | ExactFlight):
            raise ValueError(
                "Argument `method` must be of fixed steps, `FixedStep(...)` or `ExactFlight()`, "
                f"to follow an orbit, but got {method!r}."
            )
        method.check(machine)
        return method
    if isinstance(found_with, FixedStep):
        return found_with
    return chosen(machine, None, FixedStep(steps_per_cycle=20))


def steps_of(
    method: AbstractMethod, machines: list[AbstractMachine], like: Any, cycles: int
) -> int:
    """Steps that a flight over the whole period needs, in the most demanding of the machines."""
    # Turning points are looked for between steps: more of them than flying needs.
    most = max(method.steps_per_cycle, 16)
    for machine in machines:
        most = max(most, ceil(1.02 * float(_fewest(method, machine, like))))
    return most * cycles


@compiled
def _fewest(method: AbstractMethod, machine: AbstractMachine, like: Any) -> Any:
    """Steps of a cycle where they are as long as they may be."""
    return machine.cycle / method.longest(machine, jnp.zeros(()), like)
