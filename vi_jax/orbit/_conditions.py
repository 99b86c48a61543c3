"""Conditions added to the equations of a motion; each frees one more parameter of the machine.

With one condition fewer than parameters, the motions form a curve, which `_follow.both_ways`
follows. `boundary` requires a special motion, `continue_orbit` a fixed quantity of the motion.
Quantities of a motion have names and are differentiable functions of its unknowns.
"""

import abc
import dataclasses
import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar, Vector
from ..flow import average_names, quantities_on, quantity_names
from ..machine import components, frequency_ratio, in_unit, units_of, with_leaf
from ..machine import quantity_of as measured
from ._chatter import Hops
from ._shooting import Observed, Shooting
from ._sliding import SLIDING, holding
from ._solution import Step, jacobian_at, on_host
from ._words import DOUBLING, REST, TORUS, TOUCHING
from .results import compound

_SECTION = "section_"

# Branches cross for all values of a second parameter if the component of its derivative along the
# left null vector is at most this share of the largest: a choice, above the error of a point.
_APART = 1e-6


def names_of(problem: Shooting) -> tuple[str, ...]:
    """Return the names of the quantities of a motion, the machine's own included."""
    found = ["y_min", "y_max", "clearance", "duration", "multiplier"]
    if frequency_ratio(problem.machine, jnp.ones(())) is not None:
        found.append("frequency_ratio")
    if problem.impacts:
        found += ["fastest_impact", "slowest_impact"]
    found += average_names(problem.machine, problem.like)
    own = (*components(problem.like), *quantity_names(problem.machine, problem.like))
    return (*found, *(_SECTION + name for name in own))


def quantity_of(problem: Shooting, x: Vector, seen: Observed, name: str) -> Scalar:
    """Return a quantity, one of `names_of`, of a solution with the observations `seen`."""
    if name in seen.averages:
        return seen.averages[name]
    if name in ("y_min", "y_max", "duration"):
        return getattr(seen, name)
    if name == "clearance":
        return seen.nearest.room
    if name == "multiplier":
        return jnp.abs(seen.multipliers[0])
    if name == "frequency_ratio":
        ratio = frequency_ratio(problem.at(x), seen.duration / problem.cycles)
        return jnp.asarray(ratio, x.dtype)
    if name in ("fastest_impact", "slowest_impact"):
        speeds = seen.approach[np.asarray(problem.impacts, int)]
        return jnp.nanmax(speeds) if name == "fastest_impact" else jnp.nanmin(speeds)
    if problem.events:
        state = jax.tree.map(lambda a: a[0], problem.on_sections(x, problem.sections(x)))
    else:
        state = problem.unravel(problem.parts(x)[1][0])
    inner = name.removeprefix(_SECTION)
    there = components(state)
    if inner in there:
        return jnp.asarray(there[inner])
    row = jax.tree.map(lambda a: jnp.asarray(a)[None], state)
    return quantities_on(problem.at(x), row)[inner][0]


@on_host
def rates_at(
    problem: Shooting, names: tuple[str, ...], x: Vector, direction: Vector
) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
    """Return quantities of a motion, and their derivatives along a direction of its unknowns."""

    def values(x):
        seen = problem.observe(x)
        return {name: quantity_of(problem, x, seen, name) for name in names}

    return jax.jvp(values, (x,), (direction,))


# A singular value of M - I is zero within this share of the largest one: a choice.
_DOUBLE = 1e-4


class AbstractCondition(eqx.Module):
    """An additional equation for a motion."""

    @property
    def observes(self) -> bool:
        """True if it is an equation of the quantities observed of the motion."""
        return True

    @abc.abstractmethod
    def missing(self, problem: Shooting, x: Vector, seen: Observed, chatters: Hops) -> Scalar:
        """Return the residual of the condition; `chatters` holds those that begin the legs."""

    def exchanged(self, problem: Shooting, x: Vector, missing: Vector) -> Vector:
        """Return the residual of the motion's own equations, with some replaced if necessary."""
        return missing


class ContactConstraints(AbstractCondition):
    """The condition that a quantity of the motion, one of `names_of`, has a given value."""

    name: str = eqx.field(static=True)
    value: Scalar

    def missing(self, problem, x, seen, chatters):
        return quantity_of(problem, x, seen, self.name) - self.value


class HeldMultiplier(AbstractCondition):
    """The condition that the greatest multiplier has a given modulus: a root of the characteristic
    polynomial of the monodromy matrix or of its second compound (`compound`). Unlike the moduli it
    is smooth where two multipliers meet on the real axis."""

    value: Scalar
    """The multiplier, with its sign; for a complex pair the modulus."""
    pair: bool = eqx.field(static=True)

    def missing(self, problem, x, seen, chatters):
        matrix, root = seen.monodromy, self.value
        if self.pair:
            matrix, root = compound(matrix), self.value**2
        return jnp.linalg.det(matrix - root * jnp.eye(len(matrix), dtype=matrix.dtype))

    def dominance_margin(self, seen: Observed) -> float:
        """Return a number that is negative while the held multiplier is the greatest, or the held
        pair is complex and the greatest; host-side."""
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


def alone(problem: Shooting, step: Step) -> tuple[Shooting, Step]:
    """Return equations and step in the last parameter only; the others keep their values."""
    count = len(problem.parameters)
    if not problem.conditions:
        return problem, step
    gone, machine = list(range(-count, -1)), problem.machine
    for i in gone:
        machine = with_leaf(machine, problem.parameters[i], step.x[i])
    one = dataclasses.replace(
        problem, machine=machine, parameters=problem.parameters[-1:], widths=problem.widths[-1:],
        conditions=(),
    )  # fmt: skip
    x, tangent = (np.delete(np.asarray(a), gone) for a in (step.x, step.tangent))
    return one, step._replace(x=x, tangent=tangent / (float(np.linalg.norm(tangent)) or 1.0))


def as_held(values: dict[str, float], multipliers: np.ndarray) -> tuple[AbstractCondition, ...]:
    """Return the conditions that these numbers of a motion have these values."""
    greatest = complex(multipliers[0])
    pair = abs(greatest.imag) > 1e-9
    sign = 1 if pair or greatest.real > 0 else -1
    return tuple(
        HeldMultiplier(jnp.asarray(sign * value, float), pair)
        if name == "multiplier"
        else ContactConstraints(name, jnp.asarray(value, float))
        for name, value in values.items()
    )


def held_in_words(problem: Shooting) -> str:
    held = (c for c in problem.conditions if isinstance(c, ContactConstraints | HeldMultiplier))
    named = (
        (c.name if isinstance(c, ContactConstraints) else "multiplier", float(c.value))
        for c in held
    )
    units = units_of(problem.machine)
    return ", ".join(
        f"{name} = {in_unit(f'{value:.9g}', units, measured(name) or name)}"
        for name, value in named
    )


class Exchange(eqx.Module):
    """A replacement for one equation of a motion where branches of it cross.

    There the equations F(x, p) = 0 from event to event cannot be solved for x: the Jacobian J =
    ∂F/∂x has a null vector r and a left null vector l. Let branches cross for all values of a
    second parameter, as symmetric and other motions do. Then l·F = 0 follows from the other
    equations. It is replaced by l(x)·∂F/∂p = 0, with the left null vector at x:

        F + l (l(x)·∂F/∂p - l·F) = 0.

    These equations are regular, and the curve's own condition det(M - I) = 0 is added to them.
    """

    left: Float[Array, " equations"]
    """The vector l at the begin of the curve."""
    right: Float[Array, " equations"]
    """The vector r there."""

    def instead(self, problem: Shooting, missing: Array, x: Array) -> Array:
        jacobian, n = jax.jacfwd(problem.motion_residual)(x), self.left.size
        corner = jnp.zeros((1, 1), x.dtype)
        bordered = jnp.block([[jacobian[:, :n].T, self.right[:, None]], [self.left[None], corner]])
        left = jnp.linalg.solve(bordered, jnp.eye(n + 1, dtype=x.dtype)[-1])[:n]
        return missing + self.left * (left @ jacobian[:, -1] - self.left @ missing)


def exchange_at(problem: Shooting, x: np.ndarray) -> Exchange | None:
    """Return the exchange at a crossing of branches, from the singular vectors of the motion's
    Jacobian without the parameters' columns; `None` if the second parameter separates them."""
    jacobian = jacobian_at(problem, x)
    left, sizes, right = np.linalg.svd(jacobian[:, :-2])
    if abs(left[:, -1] @ jacobian[:, -2]) > _APART * sizes[0]:
        return None
    return Exchange(jnp.asarray(left[:, -1]), jnp.asarray(right[-1] * problem.scale[:-2]))


class FixedComponent(AbstractCondition):
    """The condition that the unknowns have a given component along a row."""

    row: Float[Array, " unknowns"]
    value: Scalar

    def missing(self, problem, x, seen, chatters):
        return self.row @ x - self.value


class Special(AbstractCondition):
    """The condition that a motion is special.

    M is the monodromy matrix, with second compound M₂ (`compound`). Factors of the speeds of
    approach remove the poles of M at grazing impacts.

    - Fold or branch point: det(M - I) = 0. Period doubling: det(M + I) = 0.
    - Neimark–Sacker bifurcation: det(M₂ - I) = 0, the product of two multipliers is 1.
    - Grazing: V⁻ = 0 of the lost impact, or a clearance of zero.
    - Lost rest: the chatter takes until the release (`escape`), or the force on the body is zero.
    - Sliding: the force at the event of a switch is at the limit of holding it.
    """

    kind: str = eqx.field(static=True)
    impact: int | None = eqx.field(static=True)
    """The event that grazes, or at which a switch is at the limit of being held, or `None`."""
    exchange: Exchange | None = None
    speed: Scalar | float = 0.0
    """V⁻ of that impact, for motions near a grazing."""
    double: bool = eqx.field(static=True, default=False)
    """True if two multipliers are 1 all along a curve of folds, with an eigenvector each, as for
    uncoupled equal machines. Then det(M - I) has a double zero, and the condition is that the
    product of its other factors, the sum of the principal minors, is zero."""

    @property
    def observes(self) -> bool:
        """False for a lost rest, or a switch at the limit of being held."""
        return not (self.kind == REST or (self.kind in SLIDING and self.impact is not None))

    def exchanged(self, problem, x, missing):
        return missing if self.exchange is None else self.exchange.instead(problem, missing, x)

    def missing(self, problem, x, seen, chatters):
        if self.kind == REST:
            return problem.rest_lost(x, self.impact, chatters)
        i = self.impact
        if i is None and self.kind in TOUCHING:
            return seen.nearest.room
        if i is not None and self.kind in SLIDING:
            machine, (clock, states) = problem.at(x), problem.parts(x)
            number, state = problem.events[i].number, problem.unravel(states[i])
            return holding(problem, machine, i, number, clock[i], state).x
        if self.kind in TOUCHING:
            return seen.approach[i] - self.speed
        matrix = compound(seen.monodromy) if self.kind == TORUS else seen.monodromy
        sign = 1 if self.kind == DOUBLING else -1
        matrix = matrix + sign * jnp.eye(matrix.shape[0], dtype=x.dtype)
        zero = minors(matrix) if self.double else jnp.linalg.det(matrix)
        return zero * jnp.prod(seen.approach)


def minors(matrix: Array | np.ndarray) -> Array:
    """Return the sum of the principal minors of one row less. If one eigenvalue is zero, it is the
    product of the others, and smooth, unlike them."""
    if len(matrix) == 1:
        return jnp.ones((), matrix.dtype)
    rest = (np.delete(np.arange(len(matrix)), i) for i in range(len(matrix)))
    return jnp.sum(jnp.stack([jnp.linalg.det(matrix[np.ix_(rows, rows)]) for rows in rest]))


def is_defective(problem: Shooting, step: Step, multiplier: float) -> bool:
    """Return whether a double multiplier has one eigenvector only: a complex pair can begin."""
    sizes, M = np.asarray(problem.sizes)[1:], step.seen.monodromy
    values = np.linalg.svd(M * sizes / sizes[:, None] - multiplier * np.eye(len(M)))[1]
    return bool(len(values) < 2 or values[-2] > _DOUBLE * values[0])
