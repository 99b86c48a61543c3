"""Hopf points: the place at which the cycle of an autonomous machine shrinks onto an equilibrium.

The cycle's equations are singular there: the equilibrium solves them with every period, and, if the
section is a velocity, for every value of the parameter. So the equations of the equilibrium are
solved instead, with the parameter at which two of its eigenvalues are imaginary.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._types import Scalar, Vector
from ..machine import AbstractMachine, jumps_on_section, section_in
from .corrector import Step, host_program, observe
from .equations import Shooting, Unknowns
from .flight import section_of
from .tolerances import LOCATED, ROUNDING

# Size of the motion that represents the branch there, as a share of the one before it.
_TINY = 1e-5

# Largest relative difference of an eigenvalue's period from that of the last motion.
_ALIKE_PERIOD = 0.2


def _rate(problem: Shooting, machine: AbstractMachine, u: Vector) -> Vector:
    return problem.flight(machine, 0).rate(jnp.zeros((), u.dtype), u)


@host_program
def _section_rate(problem: Shooting, x: Vector) -> tuple[Vector, Scalar]:
    """Return the rate of a motion on its section, in the sizes of the state, and its period."""
    machine = problem.at(x)
    u = problem.after(machine, 0, jnp.zeros((), x.dtype), problem.parts(x)[1][0])
    return _rate(problem, machine, u) / problem.sizes[1:], problem.period(x)


def size_of_cycle(problem: Shooting, x: Unknowns) -> float:
    """Return the distance that an autonomous motion would move in its period at its first rate, in
    the sizes of the state."""
    rate, period = _section_rate(problem, x)
    return float(np.linalg.norm(rate) * period)


def hopf_between(problem: Shooting, here: Step, new: Step) -> Step | None:
    """Return a tiny motion about the equilibrium with eigenvalues ±iω onto which the cycle shrinks
    between two points; `None` unless it has a multiplier 1."""
    machine = problem.machine
    if problem.events != (section_of(machine, 0),) or jumps_on_section(machine):
        return None
    rates = [_section_rate(problem, step.x)[0] for step in (here, new)]
    if np.dot(*rates) >= 0:
        return None  # beyond an equilibrium the motion is reversed
    size, other = np.linalg.norm(rates, axis=1)
    guess = here.x + size / (size + other) * (new.x - here.x)
    found = _hopf_equilibrium(problem, guess)
    if found is None:
        return None
    moved, step = ((a - b) / problem.scale for a, b in ((found[0], guess), (new.x, here.x)))
    if np.linalg.norm(moved) > np.linalg.norm(step):
        return None
    return _motion_about(problem, here, *found)


@host_program
def _linearise(problem: Shooting, x: Vector) -> tuple[Array, Scalar, Vector]:
    """Return the field's derivative in the state of `x`, the section there and its derivative."""
    machine, u = problem.at(x), problem.parts(x)[1][0]
    section, slope = jax.value_and_grad(lambda u: section_in(machine, problem.unravel(u)))(u)
    return jax.jacfwd(partial(_rate, problem, machine))(u), section, slope


@host_program
def _residual(problem: Shooting, y: Vector, scale: Vector, like: Array) -> tuple[Vector, Array]:
    """Return the residual of the equations of an equilibrium u with an eigenvector v to iω, and its
    derivative. The unknowns (u, p, ω, Re v, Im v) are y·scale; `like` fixes v in length and
    phase."""
    n = problem.states

    def residual(y):
        unknowns, (c, d) = y * scale, y[n + 2 :].reshape(2, n)
        u, omega, (a, b) = unknowns[:n], unknowns[n + 1], unknowns[n + 2 :].reshape(2, n)
        field = partial(_rate, problem, problem.at(unknowns[: n + 1]))
        matrix = jax.jacfwd(field)(u)
        rates = jnp.stack([field(u), matrix @ a + omega * b, matrix @ b - omega * a])
        normalisation = jnp.stack([like[0] @ c + like[1] @ d - 1, like[0] @ d - like[1] @ c])
        return jnp.concatenate([(rates / (scale[:n] * scale[n + 1])).ravel(), normalisation])

    return residual(y), jax.jacfwd(residual)(y)


def _hopf_equilibrium(problem: Shooting, guess: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the equilibrium near a guess with imaginary eigenvalues, and an eigenvector."""
    n, omega, matrix = problem.states, 2 * np.pi / guess[0], _linearise(problem, guess)[0]
    if not np.isfinite(matrix).all():
        return None
    sizes = problem.scale[1 : n + 1]
    scale = np.concatenate([problem.scale[1:], [omega], sizes, sizes])
    values, vectors = np.linalg.eig(matrix * sizes / sizes[:, None])
    nearest = vectors[:, np.argmin(np.abs(values - 1j * omega))]
    like = np.stack([np.real(nearest), np.imag(nearest)])
    y, size = np.concatenate([guess[1:] / scale[: n + 1], [1.0], like.ravel()]), np.inf
    for _ in range(20):
        residual, jacobian = _residual(problem, y, scale, like)
        if not (np.isfinite(residual).all() and np.isfinite(jacobian).all()):
            return None
        step = np.linalg.lstsq(jacobian, residual)[0]  # the smallest if a component is neutral
        y, size = y - step, np.abs(step).max()
        if size <= 1e-14:
            break
    if not size < ROUNDING or abs(y[n + 1] - 1) >= _ALIKE_PERIOD:
        return None
    y = y * scale
    vector = y[n + 2 : 2 * n + 2] + 1j * y[2 * n + 2 :]
    return np.append(2 * np.pi / y[n + 1], y[: n + 1]), vector / np.linalg.norm(vector / sizes)


def _motion_about(problem: Shooting, here: Step, x: np.ndarray, vector: np.ndarray) -> Step | None:
    """Return a tiny motion about an equilibrium, where it passes the section."""
    _, section, slope = _linearise(problem, x)
    sizes = problem.scale[1:-1]
    section_part, steep = slope @ vector, np.linalg.norm(slope * sizes)
    distance = np.linalg.norm((here.x[1:-1] - x[1:-1]) / sizes)
    if abs(section_part) <= ROUNDING * steep or abs(section) > ROUNDING * steep * distance:
        return None  # the motion does not cross the section
    # The phase of the linear motion in which the section rises through zero.
    direction = (vector * (-1j * np.conj(section_part))).real
    direction /= np.linalg.norm(direction / sizes)
    direction = np.concatenate([[0.0], direction, [0.0]])
    x = x + _TINY * distance * direction
    tangent = -direction / problem.scale
    found = here._replace(x=x, tangent=tangent, observed=observe(problem, x))
    return found if np.abs(found.observed.multipliers - 1).min() < LOCATED else None
