"""Conditions added to the equations of a motion; each frees one more parameter of the machine.

With one condition fewer than parameters, the motions form a curve, which `follow_both_ways`
follows. `boundary` requires a special motion, `continue_orbit` a fixed quantity of the motion.
Quantities of a motion have names and are differentiable functions of its unknowns.
"""

import abc
import dataclasses
import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._types import Scalar, Vector
from ..flow import average_names, quantities_on, quantity_names
from ..machine import components, frequency_ratio, in_unit, quantity_of, units_of, with_leaf
from .corrector import Step, host_program, jacobian_at
from .equations import Observed, Shooting
from .kinds import CROSSING, DOUBLING, FOLD, KINDS, REST, SLIDING, TORUS, TOUCHING, TURNS
from .linear import solve
from .rest import Chatter
from .results import compound
from .sliding import excess_rates
from .tolerances import FAINT, LOCATED

_SECTION = "section_"


def known_names(problem: Shooting) -> tuple[str, ...]:
    names = ["y_min", "y_max", "clearance", "duration", "multiplier"]
    if frequency_ratio(problem.machine, jnp.ones(())) is not None:
        names.append("frequency_ratio")
    if problem.impacts:
        names += ["fastest_impact", "slowest_impact"]
    names += average_names(problem.machine, problem.like)
    section_names = (*components(problem.like), *quantity_names(problem.machine, problem.like))
    return (*names, *(_SECTION + name for name in section_names))


def quantity_at(problem: Shooting, x: Vector, observed: Observed, name: str) -> Scalar:
    """Return a quantity, one of `known_names`, of a solution with these observations."""
    if name in observed.averages:
        return observed.averages[name]
    if name in ("y_min", "y_max", "duration"):
        return getattr(observed, name)
    if name == "clearance":
        return observed.nearest.margin
    if name == "multiplier":
        return jnp.abs(observed.multipliers[0])
    if name == "frequency_ratio":
        ratio = frequency_ratio(problem.at(x), observed.duration / problem.cycles)
        return jnp.asarray(ratio, x.dtype)
    if name in ("fastest_impact", "slowest_impact"):
        speeds = observed.approach[np.asarray(problem.impacts, int)]
        return jnp.nanmax(speeds) if name == "fastest_impact" else jnp.nanmin(speeds)
    if problem.events:
        state = jax.tree.map(lambda a: a[0], problem.on_sections(x, problem.sections(x)))
    else:
        state = problem.unravel(problem.parts(x)[1][0])
    component = name.removeprefix(_SECTION)
    components_here = components(state)
    if component in components_here:
        return jnp.asarray(components_here[component])
    row = jax.tree.map(lambda a: jnp.asarray(a)[None], state)
    return quantities_on(problem.at(x), row)[component][0]


@host_program
def rates_at(
    problem: Shooting, names: tuple[str, ...], x: Vector, direction: Vector
) -> tuple[dict[str, Scalar], dict[str, Scalar]]:
    """Return quantities of a motion, and their derivatives along a direction of its unknowns."""

    def values(x):
        observed = problem.observe(x)
        return {name: quantity_at(problem, x, observed, name) for name in names}

    return jax.jvp(values, (x,), (direction,))


class AbstractCondition(eqx.Module):
    @property
    def observes(self) -> bool:
        """True if it is an equation of the quantities observed of the motion."""
        return True

    @abc.abstractmethod
    def residual(self, problem: Shooting, x: Vector, observed: Observed, begins: Chatter) -> Scalar:
        """Return the residual; `begins` holds the ends of the chatters that begin the legs."""

    def replace_equations(self, problem: Shooting, x: Vector, values: Vector) -> Vector:
        """Return the residual of the motion's own equations, with some replaced if necessary."""
        return values


class HeldQuantity(AbstractCondition):
    name: str = eqx.field(static=True)
    value: Scalar

    def residual(self, problem, x, observed, begins):
        return quantity_at(problem, x, observed, self.name) - self.value


class HeldMultiplier(AbstractCondition):
    """The condition that the greatest multiplier has a given modulus. Its residual is a
    characteristic polynomial, of the monodromy matrix or, for a pair, of its second compound.
    Unlike the moduli it is smooth where two multipliers meet on the real axis."""

    value: Scalar
    """The multiplier, with its sign; for a complex pair the modulus."""
    pair: bool = eqx.field(static=True)

    def residual(self, problem, x, observed, begins):
        matrix, root = observed.monodromy, self.value
        if self.pair:
            matrix, root = compound(matrix), self.value**2
        return jnp.linalg.det(matrix - root * jnp.eye(len(matrix), dtype=matrix.dtype))

    def dominance_margin(self, observed: Observed) -> float:
        """Return a number that is negative while the held multiplier is the greatest, or the held
        pair is complex and the greatest; host-side."""
        values, value = np.asarray(observed.multipliers), float(self.value)
        if not self.pair:
            others = np.delete(values, np.argmin(np.abs(values - value)))
            return float(np.abs(others).max(initial=0.0) - abs(value))
        i, j = min(
            itertools.combinations(range(len(values)), 2),
            key=lambda indices: abs(np.prod(values[list(indices)]) - value**2),
        )
        others = np.abs(np.delete(values, [i, j])).max(initial=0.0) - value
        return float(max(others, np.real((values[i] - values[j]) ** 2)))


def in_one_parameter(problem: Shooting, step: Step) -> tuple[Shooting, Step]:
    """Return equations and step in the last parameter only; the others keep their values."""
    count = len(problem.parameters)
    if not problem.conditions:
        return problem, step
    dropped, machine = list(range(-count, -1)), problem.machine
    for i in dropped:
        machine = with_leaf(machine, problem.parameters[i], step.x[i])
    single = dataclasses.replace(
        problem, machine=machine, parameters=problem.parameters[-1:], widths=problem.widths[-1:],
        conditions=(),
    )  # fmt: skip
    x, tangent = (np.delete(np.asarray(a), dropped) for a in (step.x, step.tangent))
    return single, step._replace(x=x, tangent=tangent / (float(np.linalg.norm(tangent)) or 1.0))


def hold_values(values: dict[str, float], multipliers: np.ndarray) -> tuple[AbstractCondition, ...]:
    greatest = complex(multipliers[0])
    is_pair = abs(greatest.imag) > 1e-9
    sign = 1 if is_pair or greatest.real > 0 else -1
    return tuple(
        HeldMultiplier(jnp.asarray(sign * value, float), is_pair)
        if name == "multiplier"
        else HeldQuantity(name, jnp.asarray(value, float))
        for name, value in values.items()
    )


def held_in_words(problem: Shooting) -> str:
    held = (c for c in problem.conditions if isinstance(c, HeldQuantity | HeldMultiplier))
    named = (
        (c.name if isinstance(c, HeldQuantity) else "multiplier", float(c.value)) for c in held
    )
    units = units_of(problem.machine)
    return ", ".join(
        f"{name} = {in_unit(f'{value:.9g}', units, quantity_of(name) or name)}"
        for name, value in named
    )


class Replacement(eqx.Module):
    """A replacement for one equation of a motion where branches of it cross.

    There the equations F(x, p) = 0 from event to event cannot be solved for x. The Jacobian J =
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

    def apply(self, problem: Shooting, residual: Array, x: Array) -> Array:
        jacobian, n = jax.jacfwd(problem.motion_residual)(x), self.left.size
        corner = jnp.zeros((1, 1), x.dtype)
        bordered = jnp.block([[jacobian[:, :n].T, self.right[:, None]], [self.left[None], corner]])
        left_null = solve(bordered, jnp.eye(n + 1, dtype=x.dtype)[-1])[:n]
        return residual + self.left * (left_null @ jacobian[:, -1] - self.left @ residual)


def replacement_at(problem: Shooting, x: np.ndarray) -> Replacement | None:
    """Return the replacement at a crossing of branches, from the singular vectors of the motion's
    Jacobian without the parameters' columns; `None` if the second parameter separates them."""
    jacobian = jacobian_at(problem, x)
    left, sizes, right = np.linalg.svd(jacobian[:, :-2])
    if abs(left[:, -1] @ jacobian[:, -2]) > LOCATED * sizes[0]:
        return None
    return Replacement(jnp.asarray(left[:, -1]), jnp.asarray(right[-1] * problem.scale[:-2]))


class Special(AbstractCondition):
    """The condition that a motion is special.

    M is the monodromy matrix, with second compound M₂ (`compound`). Factors of the speeds of
    approach remove the poles of M at grazing impacts.

    - Fold or branch point: det(M - I) = 0. Period doubling: det(M + I) = 0.
    - Neimark–Sacker bifurcation: det(M₂ - I) = 0, the product of two multipliers is 1.
    - Grazing: V⁻ = 0 of the lost impact, or a clearance of zero.
    - Lost rest: the chatter takes until the release (`escape_margin`), or the force is zero.
    - Sliding: the force at the event of a switch is at the limit of holding it.
    """

    kind: str = eqx.field(static=True)
    impact: int | None = eqx.field(static=True)
    """The event that grazes, or at which a switch is at the limit of being held, or `None`."""
    replacement: Replacement | None = None
    speed: Scalar | float = 0.0
    """V⁻ of that impact, for motions near a grazing."""

    @property
    def observes(self) -> bool:
        """False for a lost rest, or a switch at the limit of being held."""
        return not (self.kind == REST or (self.kind in SLIDING and self.impact is not None))

    def replace_equations(self, problem, x, values):
        return values if self.replacement is None else self.replacement.apply(problem, values, x)

    def residual(self, problem, x, observed, begins):
        if self.kind == REST:
            return problem.rest_margin(x, self.impact, begins)
        i = self.impact
        if i is None and self.kind in TOUCHING:
            return observed.nearest.margin
        if i is not None and self.kind in SLIDING:
            machine, (clock, states) = problem.at(x), problem.parts(x)
            number, state = problem.events[i].number, problem.unravel(states[i])
            return excess_rates(problem, machine, i, number, clock[i], state).x
        if self.kind in TOUCHING:
            return observed.approach[i] - self.speed
        matrix = compound(observed.monodromy) if self.kind == TORUS else observed.monodromy
        matrix = matrix - KINDS[self.kind].multiplier * jnp.eye(matrix.shape[0], dtype=x.dtype)
        return jnp.linalg.det(matrix) * jnp.prod(observed.approach)


def bifurcation_tests(step: Step) -> dict[str, float]:
    """Return the tests of a solution for bifurcations, by kind; each changes its sign there."""
    M, values = step.observed.monodromy, step.observed.multipliers

    def determinant(kind: str) -> float:
        with np.errstate(invalid="ignore"):  # without an answer of the corrector it is NaN
            return float(np.linalg.det(M - KINDS[kind].multiplier * np.eye(len(M))))

    pairs = [1 - a * b for a, b in itertools.combinations(values, 2)]
    turns = float(step.tangent[-1])
    return {
        FOLD: turns,
        TURNS: turns,
        DOUBLING: determinant(DOUBLING),
        CROSSING: determinant(CROSSING),
        TORUS: float(np.real(np.prod(pairs))),
    }


def sum_of_minors(matrix: Array | np.ndarray) -> Array:
    """Return the sum of the principal minors of one row less. If one eigenvalue is zero, it is the
    product of the others, and smooth, unlike them."""
    if len(matrix) == 1:
        return jnp.ones((), matrix.dtype)
    rest = (np.delete(np.arange(len(matrix)), i) for i in range(len(matrix)))
    return jnp.sum(jnp.stack([jnp.linalg.det(matrix[np.ix_(rows, rows)]) for rows in rest]))


def is_defective(problem: Shooting, step: Step, multiplier: float) -> bool:
    """Return whether at most one eigenvector belongs to a multiplier: it is simple, or double so
    that a complex pair can begin."""
    from scipy.linalg import schur  # slow to load

    sizes, M = np.asarray(problem.sizes)[1:], step.observed.monodromy
    matrix = M * sizes / sizes[:, None]
    is_equal = lambda value: abs(value - multiplier) <= FAINT
    # Only the part of the matrix in the plane of both counts: near a grazing the others are large.
    found: Any = schur(matrix, output="complex", sort=is_equal)
    triangle, _, equal = found
    return bool(equal < 2 or abs(triangle[0, 1]) > FAINT)
