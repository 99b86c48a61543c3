"""Conditions beside the equations of a motion: each frees one number of the machine more.

With as many of them as there are parameters less one, the motions are a curve again, which
`curve.walk` follows: `boundary` asks that a motion be special, `continue_orbit` that a number of it
be held.
"""

import abc
import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from .._types import Scalar, Vector
from ..machine import in_unit, with_leaf
from ..machine import quantity_of as measured
from ._corrector import Step
from ._observed import Observed
from ._quantities import quantity_of
from ._shooting import Shooting
from .floquet import compound


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


class HeldMultiplier(AbstractCondition):
    """The greatest multiplier has a given modulus, as an equation that is smooth where two of them
    meet on the real axis, as their moduli are not there: a root of the characteristic polynomial of
    the monodromy matrix, or of that of its second compound (`compound`)."""

    value: Scalar
    """The multiplier, with its sign; of a complex pair its modulus."""
    pair: bool = eqx.field(static=True)

    def missing(self, problem, x, seen):
        """The characteristic polynomial at the value held."""
        matrix, root = seen.monodromy, self.value
        if self.pair:
            matrix, root = compound(matrix), self.value**2
        return jnp.linalg.det(matrix - root * jnp.eye(len(matrix), dtype=matrix.dtype))

    def overtaken(self, seen: Observed) -> float:
        """Negative while the multiplier held is the greatest, or the pair complex; host-side."""
        values, value = np.asarray(seen.multipliers), float(self.value)
        if not self.pair:
            others = np.delete(values, np.argmin(np.abs(values - value)))
            return float(np.abs(others).max(initial=0.0) - abs(value))
        i, j = min(
            itertools.combinations(range(len(values)), 2),
            key=lambda pair: abs(np.prod(values[list(pair)]) - value**2),
        )
        others = np.abs(np.delete(values, [i, j])).max(initial=0.0) - value
        return float(max(others, np.real((values[i] - values[j]) ** 2)))


def alone(problem: Shooting, step: Step, scale: np.ndarray) -> tuple[Shooting, Step, np.ndarray]:
    """The equations of a motion in the last of their parameters only, without conditions, the
    others as they are at a step; and the step and the sizes of the unknowns as theirs."""
    count = len(problem.parameters)
    if not problem.conditions:
        return problem, step, scale
    gone, machine = list(range(-count, -1)), problem.machine
    for i in gone:
        machine = with_leaf(machine, problem.parameters[i], step.x[i])
    one = dataclasses.replace(
        problem, machine=machine, parameters=problem.parameters[-1:], conditions=()
    )
    x, tangent, sizes = (np.delete(np.asarray(a), gone) for a in (step.x, step.tangent, scale))
    size = float(np.linalg.norm(tangent)) or 1.0
    return one, step._replace(x=x, tangent=tangent / size), sizes


def as_held(values: dict[str, float], multipliers: np.ndarray) -> tuple[AbstractCondition, ...]:
    """The conditions that numbers of these names have these values.

    **Arguments:** `multipliers`, those of the motion that is begun with.
    """
    return tuple(
        _multiplier(value, complex(multipliers[0]))
        if name == "multiplier"
        else Held(name, jnp.asarray(value, float))
        for name, value in values.items()
    )


def _multiplier(size: float, greatest: complex) -> HeldMultiplier:
    pair = abs(greatest.imag) > 1e-9
    value = size if pair or greatest.real > 0 else -size
    return HeldMultiplier(jnp.asarray(value, float), pair)


def held_in_words(problem: Shooting) -> str:
    """What is held, and where; host-side."""
    held = (c for c in problem.conditions if isinstance(c, Held | HeldMultiplier))
    named = ((c.name if isinstance(c, Held) else "multiplier", float(c.value)) for c in held)
    units = problem.machine.units
    return ", ".join(
        f"{name} = {in_unit(f'{value:.9g}', units, measured(name) or name)}"
        for name, value in named
    )


def overtaken(problem: Shooting, step: Step) -> float:
    """Positive where another multiplier is greater than the one that is held."""
    held = (c for c in problem.conditions if isinstance(c, HeldMultiplier))
    return max((c.overtaken(step.seen) for c in held), default=-1.0)
