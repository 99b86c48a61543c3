"""Conditions beside the equations of a motion: each frees one number of the machine more.

With as many of them as there are parameters less one, the motions are a curve again, which
`_follow.both_ways` follows: `boundary` asks that a motion be special, `continue_orbit` that a
number of it be held. Numbers of a motion have names; as functions of its unknowns they can be
differentiated.
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

# Branches cross for all values of a second parameter if its part of the derivative along the left
# null vector is no more than this share of the largest: a choice, above what a point is off by.
_APART = 1e-6


def names_of(problem: Shooting) -> tuple[str, ...]:
    """The numbers of a motion that these equations tell, those of the machine's own included."""
    found = ["y_min", "y_max", "clearance", "duration", "multiplier"]
    if frequency_ratio(problem.machine, jnp.ones(())) is not None:
        found.append("frequency_ratio")
    if problem.impacts:
        found += ["fastest_impact", "slowest_impact"]
    found += average_names(problem.machine, problem.like)
    own = (*components(problem.like), *quantity_names(problem.machine, problem.like))
    return (*found, *(_SECTION + name for name in own))


def quantity_of(problem: Shooting, x: Vector, seen: Observed, name: str) -> Scalar:
    """A number, one of `names_of`, of a solution of which `seen` is observed."""
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
        legs, places = problem.sections(x)
        state = problem.state_at(x, legs[0], places[0])
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
    """Numbers of a motion, and how they change where its unknowns go in a direction."""

    def values(x):
        seen = problem.observe(x)
        return {name: quantity_of(problem, x, seen, name) for name in names}

    return jax.jvp(values, (x,), (direction,))


# A singular value of M - I is zero within this share of the largest one: a choice.
_DOUBLE = 1e-4


class AbstractCondition(eqx.Module):
    """An equation more for a motion."""

    @property
    def observes(self) -> bool:
        """Whether it is an equation of what is observed of the motion."""
        return True

    @abc.abstractmethod
    def missing(self, problem: Shooting, x: Vector, seen: Observed, chatters: Hops) -> Scalar:
        """Return what `x` lacks to meet the condition; `chatters`, those that begin its legs."""

    def exchanged(self, problem: Shooting, x: Vector, missing: Vector) -> Vector:
        """The residual of the motion's own equations, some of them exchanged if need be."""
        return missing


class Held(AbstractCondition):
    """A number of the motion, one of `names_of`, has a given value."""

    name: str = eqx.field(static=True)
    value: Scalar

    def missing(self, problem, x, seen, chatters):
        return quantity_of(problem, x, seen, self.name) - self.value


class HeldMultiplier(AbstractCondition):
    """The greatest multiplier has a given modulus, as an equation that is smooth where two of them
    meet on the real axis, as their moduli are not there: a root of the characteristic polynomial of
    the monodromy matrix, or of that of its second compound (`compound`)."""

    value: Scalar
    """The multiplier, with its sign; of a complex pair its modulus."""
    pair: bool = eqx.field(static=True)

    def missing(self, problem, x, seen, chatters):
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


def alone(problem: Shooting, step: Step) -> tuple[Shooting, Step]:
    """The equations and the step in the last parameter only, the others as they are at the step."""
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
        else Held(name, jnp.asarray(value, float))
        for name, value in values.items()
    )


def held_in_words(problem: Shooting) -> str:
    held = (c for c in problem.conditions if isinstance(c, Held | HeldMultiplier))
    named = ((c.name if isinstance(c, Held) else "multiplier", float(c.value)) for c in held)
    units = units_of(problem.machine)
    return ", ".join(
        f"{name} = {in_unit(f'{value:.9g}', units, measured(name) or name)}"
        for name, value in named
    )


class Exchange(eqx.Module):
    """Another equation in the place of one of a motion's own, where branches of it cross.

    There the equations F(x, p) = 0 from event to event cannot be solved for x: the Jacobian
    J = ∂F/∂x has a null vector r and a left null vector l. Where branches cross for all values of a
    second parameter, as those of symmetric and other motions do, l·F = 0 follows from the other
    equations, and l(x)·∂F/∂p = 0, with the left null vector at x, gives way to it:

        F + l (l(x)·∂F/∂p - l·F) = 0.

    These equations are regular, and the curve's own condition det(M - I) = 0 is added to them.
    """

    left: Float[Array, " equations"]
    """l, where the curve begins."""
    right: Float[Array, " equations"]
    """r, there."""

    def instead(self, problem: Shooting, missing: Array, x: Array) -> Array:
        jacobian, n = jax.jacfwd(problem.lacks)(x), self.left.size
        corner = jnp.zeros((1, 1), x.dtype)
        bordered = jnp.block([[jacobian[:, :n].T, self.right[:, None]], [self.left[None], corner]])
        left = jnp.linalg.solve(bordered, jnp.eye(n + 1, dtype=x.dtype)[-1])[:n]
        return missing + self.left * (left @ jacobian[:, -1] - self.left @ missing)


def exchange_at(problem: Shooting, x: np.ndarray) -> Exchange | None:
    """The exchange at a motion at which branches cross, by the singular vectors of its Jacobian
    without the columns of the two parameters; `None` if the second one takes them apart."""
    scale = problem.scale
    jacobian = jacobian_at(problem, x) * scale
    left, sizes, right = np.linalg.svd(jacobian[:, :-2])
    if abs(left[:, -1] @ jacobian[:, -2]) > _APART * sizes[0]:
        return None
    return Exchange(jnp.asarray(left[:, -1]), jnp.asarray(right[-1] * scale[:-2]))


class Apart(AbstractCondition):
    """The unknowns have a given component."""

    row: Float[Array, " unknowns"]
    value: Scalar

    def missing(self, problem, x, seen, chatters):
        return self.row @ x - self.value


class Special(AbstractCondition):
    """The condition that a motion is special.

    With the monodromy matrix M that is det(M - I) = 0 at a fold or where branches cross,
    det(M + I) = 0 at a period doubling, and where a pair of multipliers leaves the unit circle that
    the product of two is 1, det(M₂ - I) = 0 with the compound matrix M₂ (see `compound`). M has
    poles where an impact grazes, which the speeds of approach take away. At a grazing the condition
    is V⁻ = 0 of the impact that is lost, or a clearance of zero; where a rest is lost that its
    chatter takes until the release (`escape`), or that the force on the body is zero; where a
    switch is held no longer, or not yet, that the force at its event is just what holds it.
    """

    kind: str = eqx.field(static=True)
    impact: int | None = eqx.field(static=True)
    """The event that grazes, or at which a switch is only just held; `None` without one."""
    exchange: Exchange | None = None
    speed: Scalar | float = 0.0
    """V⁻ of that impact, for motions beside a grazing."""
    double: bool = eqx.field(static=True, default=False)
    """Whether two multipliers are 1 all along a curve of folds, with an eigenvector each, as of
    equal machines that do not know of each other: det(M - I) is zero twice then, and the condition
    is that the product of its other factors is, the sum of the principal minors."""

    @property
    def observes(self) -> bool:
        """False where a rest is lost, or a switch is only just held."""
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
    """The sum of the principal minors of one row less: the product of all eigenvalues but one,
    where that one is zero, and smooth, unlike them."""
    if len(matrix) == 1:
        return jnp.ones((), matrix.dtype)
    rest = (np.delete(np.arange(len(matrix)), i) for i in range(len(matrix)))
    return jnp.sum(jnp.stack([jnp.linalg.det(matrix[np.ix_(rows, rows)]) for rows in rest]))


def is_defective(problem: Shooting, step: Step, multiplier: float) -> bool:
    """Whether a double multiplier has only one eigenvector, so that a complex pair can arise."""
    sizes, M = np.asarray(problem.sizes)[1:], step.seen.monodromy
    values = np.linalg.svd(M * sizes / sizes[:, None] - multiplier * np.eye(len(M)))[1]
    return bool(len(values) < 2 or values[-2] > _DOUBLE * values[0])
