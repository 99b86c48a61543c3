"""Conditions beside the equations of a motion: each frees one number of the machine more.

With as many of them as there are parameters less one, the motions are a curve again, which
`curve.walk` follows: `boundary` asks that a motion be special, `continue_orbit` that a number of it
be held.
"""

import abc
import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._types import Scalar, Vector
from ..machine import with_leaf
from ._observed import Observed
from ._quantities import quantity_of
from ._shooting import Shooting
from .curve import Step


class AbstractCondition(eqx.Module):
    """An equation more for a motion."""

    @abc.abstractmethod
    def missing(self, problem: Shooting, x: Vector, seen: Observed) -> Scalar:
        """What the solution `x`, of which `seen` is observed, lacks to meet the condition."""

    def exchanged(self, problem: Shooting, x: Vector, missing: Vector) -> Vector:
        """The residual of the motion's own equations, some of them exchanged if need be."""
        return missing


class Held(AbstractCondition):
    """A number of the motion, one of `names_of`, has a given value."""

    name: str = eqx.field(static=True)
    value: Scalar

    def missing(self, problem, x, seen):
        """Its difference from that value."""
        return quantity_of(problem, x, seen, self.name) - self.value


def alone(
    problem: Shooting, step: Step, scale: np.ndarray, kept: int = -1
) -> tuple[Shooting, Step, np.ndarray]:
    """The equations of a motion in one of their parameters only, without conditions, the others as
    they are at a step; and the step and the sizes of the unknowns as theirs.

    **Arguments:** `kept`, which parameter, from the last one back: -1 is that one.
    """
    count = len(problem.parameters)
    if not problem.conditions:
        return problem, step, scale
    gone, machine = [i for i in range(-count, 0) if i != kept], problem.machine
    for i in gone:
        machine = with_leaf(machine, problem.parameters[i], step.x[i])
    one = dataclasses.replace(
        problem, machine=machine, parameters=(problem.parameters[kept],), conditions=()
    )
    x, tangent, sizes = (np.delete(np.asarray(a), gone) for a in (step.x, step.tangent, scale))
    size = float(np.linalg.norm(tangent)) or 1.0
    return one, step._replace(x=x, tangent=tangent / size), sizes


def as_held(values: dict[str, float]) -> tuple[Held, ...]:
    """The conditions that numbers of these names have these values."""
    return tuple(Held(name, jnp.asarray(value, float)) for name, value in values.items())
